"""Plates estimated from footage: what is known, what is not, and when there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.alpha.config import AlphaConfig
from pipelines.alpha.footage import (
    MOST_DOUBT,
    filled,
    plate_of_another,
    plate_over_subjects,
    plate_over_time,
    time_median,
)
from pipelines.alpha.keyer import Keyer
from tests.pipelines.alpha_scenes import clutter

SIZE = 128
PEOPLE = ((110, 80, 65), (215, 170, 150), (60, 42, 36), (150, 110, 85))


def backdrop(rng: np.random.Generator, light: float = 1.0) -> np.ndarray:
    """A smooth grey backdrop with a falloff, (SIZE, SIZE, 3) float."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    grey = 150 + 25 * x - 20 * y
    return light * np.stack([grey, grey - 3, grey - 8], axis=-1)


def shot(
    rng: np.random.Generator, plate: np.ndarray, who: int, x: float = 0.5, width: float = 0.2
) -> tuple[np.ndarray, np.ndarray]:
    """Frame (SIZE, SIZE, 3) uint8 of a head and shoulders before a plate, and its alpha."""
    fine = np.zeros((4 * SIZE, 4 * SIZE), np.float32)
    s = 4 * SIZE
    axes = (int(width * s), int(1.3 * width * s))
    cv2.ellipse(fine, (int(x * s), int(0.5 * s)), axes, 0, 0, 360, 1, -1)
    cv2.ellipse(fine, (int(x * s), s), (int(1.6 * width * s), int(0.25 * s)), 0, 0, 360, 1, -1)
    alpha = cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    grain = cv2.resize(rng.normal(size=(16, 16)).astype(np.float32), (SIZE, SIZE))[..., None]
    subject = np.array(PEOPLE[who]) * (1 + 0.1 * grain)
    image = alpha[..., None] * subject + (1 - alpha[..., None]) * plate
    noisy = image + rng.normal(size=image.shape) * 1.5
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), alpha


def still(rng: np.random.Generator, plate: np.ndarray, who: int, **how) -> np.ndarray:
    """Time median of a subject that sits still."""
    return time_median([shot(rng, plate, who, **how)[0] for _ in range(5)])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_a_subject_that_moves_about_uncovers_the_plate(rng) -> None:
    plate = clutter(rng, SIZE)
    frames = [shot(rng, plate, 0, x, 0.1)[0] for x in np.linspace(0.1, 0.9, 15)]
    found = plate_over_time(frames)
    assert found is not None and not found.flaw
    off = np.abs(found.plate - plate).max(axis=-1)
    assert found.known.mean() > 0.8
    assert np.percentile(off[found.known], 99) < 8 and (off[found.known] > 20).mean() < 0.01


def test_a_subject_that_sits_still_does_not(rng) -> None:
    frames = [shot(rng, backdrop(rng), 0, 0.5 + 0.005 * (i % 2))[0] for i in range(9)]
    assert plate_over_time(frames) is None


def test_what_never_changes_inside_what_does_is_unknown(rng) -> None:
    plate = backdrop(rng)
    frames = [shot(rng, plate, 0, x, 0.3)[0] for x in np.linspace(0.3, 0.7, 15)]
    found = plate_over_time(frames)
    assert found is not None and not found.known[64, 64] and found.known[5, 64]


def test_subjects_of_one_rig_show_all_but_what_all_cover(rng) -> None:
    plate = backdrop(rng)
    widths = (0.2, 0.16, 0.18, 0.22)
    found = plate_over_subjects(
        [still(rng, plate, who, width=width) for who, width in enumerate(widths)]
    )
    _, alpha = shot(rng, plate, 0, width=0.16)
    assert not found.flaw and 0 < found.doubt < MOST_DOUBT
    assert not found.known[alpha == 1].any()
    off = np.abs(found.plate - plate).max(axis=-1)
    assert off[found.known].max() < 6
    # Filled in, and by no more off than it says.
    assert np.median(off[~found.known]) < 3 * max(found.doubt, 1)


def test_the_key_works_on_an_estimated_plate(rng) -> None:
    plate = backdrop(rng)
    found = plate_over_subjects([still(rng, plate, who) for who in (0, 1)])
    frame, alpha = shot(rng, plate, 0)
    doubt = np.where(found.known, 0, max(found.doubt, 1)).astype(np.float32)
    keyer = Keyer(found.plate, [frame], np.ones((SIZE, SIZE), bool), AlphaConfig(), doubt)
    assert np.abs(keyer.alpha(frame) - alpha).mean() < 0.01


def test_another_exposure_of_the_other_subject_is_undone(rng) -> None:
    plate, dim = backdrop(rng), backdrop(rng, 0.9)
    found = plate_over_subjects([still(rng, plate, 0), still(rng, dim, 1)])
    assert np.abs(found.plate - plate).max(axis=-1)[found.known].max() < 8
    assert found.known.mean() > 0.5


def test_the_plate_of_another_subject_serves_where_the_set_is_the_same(rng) -> None:
    plate = clutter(rng, SIZE)
    shown = np.rint(plate).astype(np.uint8)
    found = plate_of_another(shown, still(rng, plate, 0))
    assert found is not None and found.known.all() and not found.flaw
    assert np.abs(found.plate - plate).max() < 8
    dim = plate_of_another(shown, still(rng, 0.9 * plate, 0))
    assert dim is not None and np.abs(dim.plate - 0.9 * plate).mean() < 4
    moved = np.roll(plate, 9, axis=1)
    assert plate_of_another(shown, still(rng, moved, 0)) is None


def test_clutter_behind_a_head_cannot_be_filled_in(rng) -> None:
    plate = clutter(rng, SIZE)
    found = plate_over_subjects([still(rng, plate, who) for who in range(3)])
    assert "always covered" in found.flaw and "inf" not in found.flaw


def test_rigs_with_different_backgrounds_have_no_common_plate(rng) -> None:
    found = plate_over_subjects([still(rng, clutter(rng, SIZE), who) for who in range(3)])
    assert "shows one background" in found.flaw


def test_two_subjects_alike_are_not_a_plate(rng) -> None:
    """Skin agrees with skin in the middle of the image, where nothing known surrounds it."""
    plate = backdrop(rng)
    found = plate_over_subjects([still(rng, plate, 0, width=w) for w in (0.2, 0.15)])
    assert not found.known[64, 64]


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 3), (33, 17)])
def test_filling_keeps_what_is_known_at_any_size(rng, shape) -> None:
    image = rng.random((*shape, 3)).astype(np.float32)
    known = rng.random(shape) > 0.5
    known[0, 0] = True
    out = filled(image, known)
    assert np.array_equal(out[known], image[known]) and np.isfinite(out).all()
    low, high = image[known].min(axis=0), image[known].max(axis=0)
    assert (out >= low - 1e-4).all() and (out <= high + 1e-4).all()


@pytest.mark.parametrize("shape", [(1, 1), (2, 9)])
def test_tiny_frames_have_a_plate_or_none(shape) -> None:
    frames = [np.full((*shape, 3), value, np.uint8) for value in (9, 9, 200, 9, 9)]
    assert plate_over_time(frames) is None
    assert plate_over_subjects(frames).plate.shape == (*shape, 3)
