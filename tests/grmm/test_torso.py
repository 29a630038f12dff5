from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.contract.segmentation_labels import TORSO
from grmm.config import DataConfig
from grmm.data import HeadViews
from grmm.head_crop import torso_mask
from grmm.model import PinholeView
from grmm.train import objective
from grmm.train_state import prepare
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config

IGNORE = DataConfig(torso="ignore")


def collared_head():
    """The ellipsoid: its lower third is the neck, its lowest ring the open end."""
    head = ellipsoid_head(24, 32)
    height = head.template[:, 1]
    regions = head.regions | {"neck": height < -0.03, "boundary": height < -0.105}
    return replace(head, regions=regions)


def frontal_view(size=64):
    K = torch.tensor([[140.0, 0, 32], [0, 140, 32], [0, 0, 1]], dtype=torch.float64)
    camera = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    camera[2, 3] = 0.6
    return PinholeView(K=K, cam_from_head=camera, width=size, height=size)


def test_what_stands_off_the_neck_is_torso_and_the_head_is_not():
    head, size = collared_head(), 64
    alpha = np.zeros((size, size), np.uint8)
    depth = np.zeros((size, size), np.float32)
    alpha[10:30, 25:40], depth[10:30, 25:40] = 255, 0.51  # the face, where the mesh is
    alpha[52:64, 5:60], depth[52:64, 5:60] = 255, 0.45  # shoulders, in front of the neck
    mask = torso_mask(head, head.template, frontal_view(), alpha, depth)
    assert mask[54:, 7:58].all()
    assert not mask[:45].any()


def test_hair_far_off_the_scalp_is_not_torso():
    head = collared_head()
    alpha = np.zeros((64, 64), np.uint8)
    alpha[:20] = 255
    depth = np.full((64, 64), 0.6, np.float32)
    assert not torso_mask(head, head.template, frontal_view(), alpha, depth).any()


@pytest.mark.parametrize("depth", [None, np.zeros((64, 64), np.float32)])
def test_unknown_depth_falls_back_to_the_meshs(depth):
    head = collared_head()
    alpha = np.zeros((64, 64), np.uint8)
    alpha[10:30, 25:40] = 255
    alpha[60:64] = 255  # 12 cm under the centre
    mask = torso_mask(head, head.template, frontal_view(), alpha, depth)
    assert mask[61:, ::4].any() and not mask[:45].any()


def test_empty_mattes_and_heads_without_a_neck_have_no_torso():
    head, view = ellipsoid_head(), frontal_view()
    full = np.full((64, 64), 255, np.uint8)
    assert not torso_mask(head, head.template, view, full, None).any()
    assert not torso_mask(collared_head(), head.template, view, 0 * full, None).any()


class Dressed(EllipsoidSource):
    """The toy head with a bright shirt before its lower end."""

    def read(self, index):
        sample = super().read(index)
        rows = slice(int(0.8 * self.size), None)
        sample.image[rows], sample.alpha[rows] = 255, 255
        sample.depth[rows] = 0.55
        return sample


def test_torso_neither_teaches_nor_counts():
    config = tiny_config(model={"refine_widths": ()})
    views = HeadViews(Dressed(size=64), collared_head(), IGNORE)
    run = prepare(views, config)
    item = views.item(0)
    assert float(item.counts[54:, 10:54].float().mean()) < 0.5 and item.counts[:40].all()
    rendering = run.model(0, 0, item.state, item.view)
    spoiled = replace(item, target=torch.where(item.counts, item.target, 0.123))
    terms, again = (objective(run, rendering, i, config) for i in (item, spoiled))
    assert terms["rgb"].item() == pytest.approx(again["rgb"].item(), abs=2e-3)  # SSIM's window
    assert terms["depth"].item() == again["depth"].item()


def test_torso_is_background_by_default():
    item = HeadViews(Dressed(size=64), collared_head()).item(0)
    ignored = HeadViews(Dressed(size=64), collared_head(), IGNORE).item(0)
    torso = ~ignored.counts
    assert torso.any() and item.counts.all()
    assert float(item.target[:, 58:, 20:44].max()) == 0 and not item.mask[58:, 20:44].any()
    assert not (item.depth_valid & torso).any()
    kept = ignored.mask & ~item.mask  # the dilated border alone
    assert torch.equal(item.target[:, :40], ignored.target[:, :40]) and not kept.any()


def test_a_matte_without_torso_is_taken_as_it_is():
    class Bare(Dressed):
        def read(self, index):
            return replace(super().read(index), bare=True)

    item = HeadViews(Bare(size=64), collared_head()).item(0)
    assert float(item.target[:, 58:, 20:44].min()) == 1 and item.counts.all()


class Labelled(Dressed):
    """Dressed, with labels that call other rows torso than the depth map would."""

    def read(self, index):
        sample = super().read(index)
        parts = np.ones(sample.alpha.shape, np.uint8)
        parts[: self.size // 2] = TORSO
        return replace(sample, parts=parts)


def test_labels_of_parts_go_before_distances():
    item = HeadViews(Labelled(size=64), collared_head(), IGNORE).item(0)
    assert not item.counts[:34].any() and item.counts[36:].all()
    assert not item.depth_valid[:34].any() and not item.mask[:34].any()
    background = HeadViews(Labelled(size=64), collared_head()).item(0)
    assert background.counts.all() and float(background.target[:, :32].max()) == 0
