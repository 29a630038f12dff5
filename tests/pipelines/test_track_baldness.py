"""A bare skull is recognised by what the pictures show of it, not by their rims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.geometry.cameras import Camera, pinhole, project
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from express50.head.model import pose
from pipelines.track.outline import BALD_SHARE, bare_share

SIZE, FOCAL = 400, 900.0
SKIN, HAIR = (0.8, 0.6, 0.5), (0.2, 0.15, 0.1)


@pytest.fixture(scope="module")
def scene():
    """The head at rest, a camera before it, and the row where its face begins."""
    head = load_head("procedural")
    still = torch.zeros(1, 1)
    mesh = pose(head, still, still)[0].double().numpy()
    eye = mesh.mean(0) + [0.0, 0.25, 0.9]
    camera_pose = look_at(eye, mesh.mean(0), np.array([0.0, 1.0, 0.0]))
    params = (FOCAL, FOCAL, SIZE / 2, SIZE / 2)
    camera = Camera("cam", SIZE, SIZE, "PINHOLE", params, camera_pose)
    pixels = project(camera, mesh)[0]
    return head, mesh, camera, int(pixels[head.regions["face"].numpy(), 1].min())


def painted(row: int) -> np.ndarray:
    """Hair above a row, skin below."""
    image = np.empty((SIZE, SIZE, 3), np.float32)
    image[:row], image[row:] = HAIR, SKIN
    return image


def test_hair_above_the_face_is_no_bald_head(scene):
    head, mesh, camera, row = scene
    assert bare_share(head, [(painted(row), camera)], mesh) < BALD_SHARE
    assert bare_share(head, [(painted(0), camera)], mesh) > BALD_SHARE


def test_a_skull_outside_the_picture_is_not_seen(scene):
    head, mesh, camera, row = scene
    whole = bare_share(head, [(painted(row), camera)], mesh)
    cut = pinhole(camera)
    fx, fy, cx, cy = cut.params
    cut = replace(cut, height=SIZE - row, params=(fx, fy, cx, cy - row))
    share = bare_share(head, [(painted(row)[row:], cut)], mesh)
    assert 0 < whole < 0.3
    assert share < 0.5, "its rim is skin"
