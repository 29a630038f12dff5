"""Hair and skin where noise or blur hides what tells them from the plate."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.matte_scenes import exposed, make_scene, plain
from pipelines.matte import MatteConfig
from pipelines.matte.key import key_alpha


def keyed(frame: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Alpha (H, W) with the default settings."""
    return key_alpha(frame, plate, np.ones(plate.shape[:2], bool), MatteConfig().shadow)


@pytest.mark.parametrize("blur", [0.0, 0.9])
def test_skin_under_dark_hair_is_solid_before_grey(blur: float) -> None:
    """It differs from grey by less than half of what dark hair does."""
    scene = make_scene("dark", "plain", 320, np.random.default_rng(0))
    frame, plate, true = scene.frame, scene.plate, scene.true
    if blur:
        frame, plate, true = (cv2.GaussianBlur(x, (0, 0), blur) for x in (frame, plate, true))
    alpha = keyed(frame, plate)
    face = np.s_[110:205, 130:190]
    assert alpha[face].min() > 0.9
    assert np.abs(alpha - true).mean() < 0.02


def test_coarse_noise_opens_no_holes_in_the_face() -> None:
    scene = make_scene("dark", "plain", 320, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    frame, plate = (
        np.clip(np.rint(x + rng.normal(size=x.shape) * 6), 0, 255).astype(np.uint8)
        for x in (scene.frame, scene.plate)
    )
    alpha = keyed(frame, plate)
    assert alpha[110:205, 130:190].mean() > 0.98
    assert np.abs(alpha - scene.true).mean() < 0.03


def test_only_strands_and_no_solid() -> None:
    rng = np.random.default_rng(2)
    plate = plain(rng, 200)
    strands = np.zeros((1600, 1600), np.float32)
    for x in range(200, 1500, 60):
        cv2.line(strands, (x, 100), (x + 90, 1500), 1.0, 6)
    alpha = cv2.resize(strands, (200, 200), interpolation=cv2.INTER_AREA)
    frame = exposed((1 - alpha[..., None]) * plate + alpha[..., None] * 0.02, rng)
    found = keyed(frame, exposed(plate, rng))
    assert np.abs(found - alpha).mean() < 0.05
    assert np.corrcoef(found.ravel(), alpha.ravel())[0, 1] > 0.95
