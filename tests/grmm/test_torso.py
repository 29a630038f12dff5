from dataclasses import replace

import numpy as np

from express50.contract.segmentation_labels import TORSO
from grmm.data import HeadViews
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head


class Dressed(EllipsoidSource):
    """The toy head with a bright shirt before its lower end."""

    def read(self, index):
        sample = super().read(index)
        rows = slice(int(0.8 * self.size), None)
        sample.image[rows], sample.alpha[rows] = 255, 255
        sample.depth[rows] = 0.55
        return sample


class Labelled(Dressed):
    """Dressed, with labels of the shirt."""

    def read(self, index):
        sample = super().read(index)
        parts = np.ones(sample.alpha.shape, np.uint8)
        parts[int(0.8 * self.size) :] = TORSO
        return replace(sample, parts=parts)


class Bare(Labelled):
    """Labelled, with a matte that is said to leave the torso out."""

    def read(self, index):
        return replace(super().read(index), bare=True)


def test_a_labelled_torso_is_background():
    item = HeadViews(Labelled(size=64), ellipsoid_head()).item(0)
    shirt = slice(int(0.8 * 64), None)
    assert float(item.target[:, shirt].max()) == 0
    assert not item.mask[shirt].any() and not item.depth_valid[shirt].any()
    assert item.mask[20:40].any() and item.depth_valid[20:40].any()


def test_a_matte_without_torso_or_labels_is_taken_as_it_is():
    for source in (Bare, Dressed):
        item = HeadViews(source(size=64), ellipsoid_head()).item(0)
        assert float(item.target[:, 58:, 20:44].min()) == 1 and item.mask[58:].all()
