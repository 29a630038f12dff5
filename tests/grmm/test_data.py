import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.errors import FormatError
from grmm import data
from grmm.config import DataConfig
from grmm.data import HeadViews, Shuffle, pose_state
from tests.grmm.synthetic import STRETCH, EllipsoidSource, ellipsoid_head


@pytest.fixture(scope="module")
def source():
    return EllipsoidSource(size=64)


def test_footage_is_composited_on_the_background(source):
    views = HeadViews(source, ellipsoid_head(), DataConfig(background=0.25))
    item = views.item(0)
    assert torch.equal(
        item.target[:, ~item.mask], torch.full_like(item.target[:, ~item.mask], 0.25)
    )
    sample = source.read(0)
    inside = torch.from_numpy(sample.image).permute(2, 0, 1)[:, item.mask] / 255
    torch.testing.assert_close(item.target[:, item.mask], inside)
    assert torch.equal(item.depth_valid, item.mask)


def test_geometry_is_posed_once_per_frame(views):
    assert views.state(0) is views.state(1)  # another camera
    taller = views.state(3).vertices[:, 1].max() - views.state(0).vertices[:, 1].max()
    assert float(taller) == pytest.approx(STRETCH, rel=1e-5)


def test_cache_is_bounded_and_answers_from_memory(source, monkeypatch):
    monkeypatch.setattr(data, "CACHE_BYTES", 2 * source.read(0).nbytes)
    views = HeadViews(source, ellipsoid_head())
    first = views.sample(0)
    second = views.sample(1)
    assert views.sample(0) is first
    views.sample(2)
    assert views.sample(0) is first and views.sample(1) is not second
    monkeypatch.setattr(data, "CACHE_BYTES", 0)
    views = HeadViews(source, ellipsoid_head())
    assert views.sample(2) is views.sample(2)


def test_every_cache_of_views_is_bounded(monkeypatch):
    monkeypatch.setattr(data, "CACHE_BYTES", 0)
    views = HeadViews(EllipsoidSource(size=32, expressions=4), ellipsoid_head())
    for index in range(len(views.keys)):
        views.item(index)
    caches = (views._samples, views._states)
    assert [len(cache.entries) for cache in caches] == [1, 1]


class Changed(EllipsoidSource):
    """The toy data set, where every sample has these changes."""

    def __init__(self, **changes):
        super().__init__(size=32)
        self.changes = changes

    def read(self, index):
        return replace(super().read(index), **self.changes)


def test_sizes_that_differ_are_named():
    broken = Changed(alpha=np.zeros((3, 3), np.uint8))
    with pytest.raises(FormatError, match=r"S000/e0/cam00: alpha is \(3, 3\)"):
        HeadViews(broken, ellipsoid_head()).item(0)


def test_parameters_of_another_head_model_are_named(source):
    place = source.place(0)
    tracked = replace(place.tracked, expression=np.zeros(9))
    other = Changed(place=replace(place, tracked=tracked))
    with pytest.raises(FormatError, match="9 expression"):
        HeadViews(other, ellipsoid_head()).item(0)


def test_fewer_coefficients_are_padded(source):
    tracked = replace(source.place(0).tracked, expression=np.ones(1), shape=np.zeros(1))
    state = pose_state(ellipsoid_head(), tracked)
    assert state.expression.tolist() == [1, 0, 0, 0]


def test_missing_depth_stays_unknown():
    item = HeadViews(Changed(depth=None), ellipsoid_head()).item(0, crop=True)
    assert not item.depth_valid.any()
    assert item.depth.shape == item.mask.shape


def test_shuffle_visits_everything_each_epoch_and_depends_on_the_seed():
    shuffle = Shuffle([3, 5, 7, 9], seed=1)
    epochs = [sorted(shuffle.next() for _ in range(4)) for _ in range(3)]
    assert epochs == [[3, 5, 7, 9]] * 3
    orders = {tuple(Shuffle(range(9), seed).next() for _ in range(1)) for seed in range(20)}
    assert len(orders) > 3


def test_shuffle_resumes_exactly():
    straight, first, second = (Shuffle(range(5), seed=2) for _ in range(3))
    expected = [straight.next() for _ in range(13)]
    got = [first.next() for _ in range(7)]
    second.restore(first.state())
    assert got + [second.next() for _ in range(6)] == expected


def test_ranks_share_one_order_without_overlap():
    alone = Shuffle(range(7), seed=3)
    ranks = [Shuffle(range(7), seed=3, rank=r, world=3) for r in range(3)]
    together = [rank.next() for _ in range(6) for rank in ranks]
    assert together == [alone.next() for _ in range(18)]


def test_the_next_sample_is_decoded_during_the_step():
    threads = {}

    class Noted(EllipsoidSource):
        def read(self, index):
            threads[index] = threading.current_thread()
            return super().read(index)

    views = HeadViews(Noted(size=32), ellipsoid_head())
    shuffle, order = Shuffle(range(6), seed=1), [Shuffle(range(6), seed=1).next()]
    taken = shuffle.next()
    assert taken == order[0]
    for _ in range(4):
        views.sample(taken)
        following = shuffle.peek()
        views.prefetch(following)
        views.prefetch(following)  # asked again, read once
        taken = shuffle.next()
        assert taken == following
    ours = threading.main_thread()
    assert list(threads.values()).count(ours) == 1  # the first, which nobody announced
    expected = EllipsoidSource(size=32).read(taken).image
    np.testing.assert_array_equal(views.sample(taken).image, expected)


def test_a_damaged_sample_is_named_when_it_is_needed():
    views = HeadViews(Changed(alpha=np.zeros((3, 3), np.uint8)), ellipsoid_head())
    views.prefetch(0)
    with pytest.raises(FormatError, match="S000/e0/cam00: alpha"):
        views.sample(0)
