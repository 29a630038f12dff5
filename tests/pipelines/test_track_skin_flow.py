"""The skin's texture shows how far an expression's mesh must slide."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from express50.head.model import pose
from pipelines.track.face_uv import FINE, HEIGHT, WIDTH, SkinMap, flow_term, make_uv_map
from pipelines.track.schedule import SKIN_ROUNDS, make_schedule

SIZE = FINE * HEIGHT, FINE * WIDTH


@pytest.fixture(scope="module")
def uv_map(head):
    return make_uv_map(head, FINE)


@pytest.fixture(scope="module")
def mesh(head) -> np.ndarray:
    still = torch.zeros(1, 1)
    return pose(head, still, still)[0].double().numpy()


def textured(shift: tuple[float, float] = (0.0, 0.0), contrast: float = 40.0) -> np.ndarray:
    """Grey noise (H, W) of a few texels, moved by columns and rows."""
    noise = np.random.default_rng(0).normal(size=SIZE)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    moved = cv2.warpAffine(smooth, np.float64([[1, 0, shift[0]], [0, 1, shift[1]]]), SIZE[::-1])
    return np.clip(128 + contrast * moved / smooth.std(), 0, 255).astype(np.uint8)


def everywhere() -> np.ndarray:
    return np.ones(SIZE, bool)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, 0.0), (-1.0, 2.0)])
def test_texture_that_moved_pulls_the_mesh_after_it(uv_map, mesh, shift):
    still, moved = (SkinMap(textured(by), everywhere()) for by in ((0.0, 0.0), shift))
    term = flow_term(uv_map, still, moved, mesh)
    off = 1e3 * (term.goals - term.anchors.at(mesh))
    front = term.normals[:, 2] > 0.95
    assert front.sum() > 100
    # Columns run to the subject's left, +x; rows down. A texel is 0.6 to 0.7 mm in front.
    wanted = 0.65 * np.array([shift[0], -shift[1]])
    assert np.median(off[front, :2], axis=0) == pytest.approx(wanted, abs=0.25)
    assert (term.sigma > 0).all() and np.isfinite(term.goals).all()


def test_flat_hidden_or_replaced_texture_gives_no_term(uv_map, mesh):
    still = SkinMap(textured(), everywhere())
    flat = SkinMap(np.full(SIZE, 128, np.uint8), everywhere())
    hidden = SkinMap(textured(), ~everywhere())
    other = SkinMap(np.random.default_rng(1).integers(0, 255, SIZE).astype(np.uint8), everywhere())
    assert flow_term(uv_map, flat, flat, mesh) is None
    assert flow_term(uv_map, still, hidden, mesh) is None
    lost, kept = flow_term(uv_map, still, other, mesh), flow_term(uv_map, still, still, mesh)
    assert lost is None or len(lost.goals) < 0.1 * len(kept.goals)


def test_the_skin_is_followed_last_and_only_where_patches_and_marks_came_before():
    rounds = make_schedule(outline_rounds=3, patch_rounds=6, uv_rounds=6)
    assert [one.follow_skin for one in rounds] == [False] * 6 + [True] * SKIN_ROUNDS
    for patch, uv in ((0, 6), (6, 0)):
        assert not any(one.follow_skin for one in make_schedule(3, patch, uv))
