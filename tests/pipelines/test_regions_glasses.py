"""Frames before the eyes are found by colour from all sides; brows and half rims are not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.geometry.cameras import project
from express50.geometry.conventions import corner_to_cell
from pipelines.regions.geometry import render_head
from pipelines.regions.stage import label_view
from pipelines.regions.things import CELL_M, Picture, find_glasses, shown_in_front
from tests.pipelines.region_scenes import RegionScene, make_scene

RADIUS, TUBE_M, LIFT_M, DARK = 0.022, 0.0018, 0.014, (25, 25, 30)
ANGLES = (-70, -40, -15, 0, 20, 45, 70)


@lru_cache(maxsize=1)
def scenes() -> tuple[RegionScene, ...]:
    """Views of the bare face, one and a half millimetres a pixel."""
    return tuple(make_scene(angle, size=300, hair=False, seed=k) for k, angle in enumerate(ANGLES))


def eyes() -> np.ndarray:
    """Foremost points (2, 3) of the eyes."""
    head = scenes()[0].head
    ball = head.vertices[head.labels.vertices == LABELS.index("eyes")]
    sides = [ball[np.sign(ball[:, 0]) == side] for side in (-1, 1)]
    return np.array([[*side.mean(0)[:2], side[:, 2].max()] for side in sides])


def rims(share: float = 1.0, radius: float = RADIUS, lift: float = LIFT_M) -> np.ndarray:
    """Points (N, 3) along two rims, from the bearing of the temples on."""
    turn = np.linspace(0, share * 2 * np.pi, 400)
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn + lift], axis=1)
    return (eyes()[:, None] + ring).reshape(-1, 3)


def painted(scene: RegionScene, places: np.ndarray) -> RegionScene:
    """Draw places (N, 3) that the head does not hide as dark dots."""
    rgb, (pixels, ahead) = scene.rgb.copy(), project(scene.camera, places)
    radius = TUBE_M * scene.camera.K[0, 0]  # a metre away
    alpha = scene.alpha.copy()
    for (x, y), z in zip(corner_to_cell(pixels).round().astype(int), ahead, strict=True):
        if scene.depth[y, x] == 0 or z < scene.depth[y, x] + 0.001:
            cv2.circle(rgb, (int(x), int(y)), round(radius), DARK, -1)
            cv2.circle(alpha, (int(x), int(y)), round(radius), 1.0, -1)
    return replace(scene, rgb=rgb, alpha=alpha)


def pictures(places: np.ndarray) -> list[Picture]:
    """Views with places drawn."""
    drawn = [painted(scene, places) for scene in scenes()]
    return [(scene.camera, scene.rgb, scene.alpha) for scene in drawn]


def test_glasses_are_found_with_their_lenses_and_labelled() -> None:
    scene = scenes()[ANGLES.index(0)]
    found = find_glasses(scene.head, pictures(rims()))
    near = np.abs(found[:, None] - eyes() - [0, 0, LIFT_M]).max(-1).min(1)
    assert len(found) > 500 and near.max() < RADIUS + 2 * CELL_M
    _, depth = render_head(scene.head, scene.camera)
    middle = project(scene.camera, eyes() + [0, 0, LIFT_M])[0]
    true = np.zeros(depth.shape, np.uint8)
    for x, y in corner_to_cell(middle).round().astype(int):
        radius = round((RADIUS + TUBE_M) * scene.camera.K[0, 0] / (1 - LIFT_M))
        cv2.circle(true, (int(x), int(y)), radius, 1, -1)
    shown = shown_in_front(found, scene.camera, depth)
    assert (shown & (true > 0)).sum() > 0.8 * (shown | (true > 0)).sum()
    worn = painted(scene, rims())
    labels = label_view(
        scene.head, scene.camera, worn.rgb, worn.alpha, None, True, 300, None, found
    ).labels
    assert label_mask(labels, "apparel")[shown & (true > 0) & (depth > 0)].mean() > 0.95
    away = found[:, 2] < -1  # none: a view without glasses keeps its labels
    bare = label_view(scene.head, scene.camera, scene.rgb, scene.alpha, None, True, 300, None,
                      found[away]).labels  # fmt: skip
    assert not label_mask(bare, "apparel").any()


def beard_and_hair() -> np.ndarray:
    """Points (N, 3) all over the chin, and over the forehead's upper half."""
    head = scenes()[0].head
    lips = head.vertices[head.labels.vertices == LABELS.index("lips"), 1]
    kind = (head.labels.vertices[head.labels.faces] == LABELS.index("skin")).all(1)
    skin = head.vertices[head.labels.faces[kind]]
    low, high = skin[..., 1].min(1), skin[..., 1].max(1)
    corners = np.random.default_rng(0).dirichlet(np.ones(3), 8)  # dots over every triangle
    return (corners @ skin[(high < lips.max() + 0.012) | (low > 0.065)]).reshape(-1, 3)


def test_sunglasses_between_beard_and_hair_are_found() -> None:
    """Together they cover as much of the face as skin does."""
    discs = [rims(radius=radius) for radius in np.arange(0.002, RADIUS, 0.002)]
    places = np.concatenate([*discs, rims(), beard_and_hair()])
    found = find_glasses(scenes()[0].head, pictures(places))
    for eye in eyes():
        near = np.linalg.norm(found - eye - [0, 0, LIFT_M], axis=1)
        assert (near < RADIUS).sum() > 1000


def test_a_rim_with_a_gap_is_closed() -> None:
    found = find_glasses(scenes()[0].head, pictures(rims(0.8)))
    for eye in eyes():
        x, y = (found[:, :2] - eye[:2]).T
        gap = np.abs(np.arctan2(y, x) + 0.2 * np.pi) < 0.05 * np.pi  # its middle
        assert np.hypot(x, y)[gap & (np.hypot(x, y) < 1.5 * RADIUS)].max() > RADIUS


def brows() -> np.ndarray:
    """Points (N, 3) on the skin along dark brows, and around dark eyes."""
    head = scenes()[0].head
    skin = head.vertices[head.labels.faces].mean(1)
    skin = skin[skin[:, 2] > eyes()[:, 2].mean() - 0.02]
    off = np.abs(skin[:, None, :2] - eyes()[:, :2])
    brow = (off[..., 0] < 0.02) & (np.abs(off[..., 1] - 0.02) < 0.004)
    return skin[(brow.any(1) & (skin[:, 1] > eyes()[:, 1].mean())) | (off < 0.008).all(2).any(1)]


@pytest.mark.parametrize(
    "places",
    [rims(0.45), brows(), rims(radius=0.0115, lift=0.006)],
    ids=["half a rim", "brows", "long dark lashes"],
)
def test_what_is_not_a_rim_before_the_face_is_not_glasses(places: np.ndarray) -> None:
    assert len(places) > 100
    assert len(find_glasses(scenes()[0].head, pictures(places))) == 0


def test_bare_faces_few_views_and_heads_without_eyes_have_no_glasses() -> None:
    head, worn = scenes()[0].head, pictures(rims())
    assert len(find_glasses(head, pictures(rims()[:0]))) == 0
    assert len(find_glasses(head, worn[:3])) == 0 and len(find_glasses(head, [])) == 0
    blind = replace(head.labels, vertices=np.zeros_like(head.labels.vertices))
    assert len(find_glasses(replace(head, labels=blind), worn)) == 0
