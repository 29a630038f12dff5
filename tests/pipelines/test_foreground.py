"""The subject's own colour in pixels that also show the plate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.pixels import linear_to_srgb, srgb_to_linear
from pipelines.pack.sample import Crop, cut_own_colours, own_colours


def mixed(subject: np.ndarray, plate: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """8-bit frame of a subject (3,) before a plate (3,), linear light, by alpha (H, W) uint8."""
    share = alpha[..., None] / 255.0
    light = share * srgb_to_linear(subject / 255.0) + (1 - share) * srgb_to_linear(plate / 255.0)
    return np.rint(255 * linear_to_srgb(light)).astype(np.uint8)


def ramp(size: int = 96) -> np.ndarray:
    """Alpha (size, size) from opaque at the left to nothing at the right."""
    steps = np.clip(np.linspace(1.6, -0.6, size), 0, 1)
    return np.rint(255 * np.broadcast_to(steps, (size, size))).astype(np.uint8)


colours = st.tuples(*[st.integers(5, 250)] * 3)


@settings(deadline=None, max_examples=30)
@given(subject=colours, plate=colours)
def test_the_subjects_colour_comes_back_whatever_stands_behind(subject, plate):
    subject, plate, alpha = np.array(subject, float), np.array(plate, float), ramp()
    frame = mixed(subject, plate, alpha)
    own = own_colours(frame, alpha, np.broadcast_to(plate, frame.shape))
    # In light before black: next to a bright plate, rounding alone is a dark subject's colour.
    off = srgb_to_linear(own / 255.0) - srgb_to_linear(subject / 255.0)
    assert np.abs(off * (alpha / 255.0)[..., None]).max() < 0.02  # two levels near white
    assert (own[alpha == 0] == frame[alpha == 0]).all()
    assert (own[alpha == 255] == frame[alpha == 255]).all()


def test_without_a_plate_the_rim_is_much_less_the_studios():
    subject, plate, alpha = np.array([60.0, 40, 30]), np.array([200.0, 210, 205]), ramp()
    frame = mixed(subject, plate, alpha)
    own = own_colours(frame, alpha, None)
    weight = (alpha / 255.0)[..., None]

    def rim(image: np.ndarray) -> float:
        return float((weight * np.abs(image - subject)).mean())

    assert rim(own) < 0.35 * rim(frame)


def test_a_plate_of_another_set_is_not_used():
    alpha, rng = ramp(), np.random.default_rng(0)
    frame = mixed(np.array([60.0, 40, 30]), np.array([200.0, 210, 205]), alpha)
    other = np.repeat(np.repeat(rng.integers(0, 255, (12, 12, 3)), 8, 0), 8, 1).astype(np.uint8)
    whole = Crop(0, 0, 96)
    without = cut_own_colours(frame, alpha, None, whole, 96)
    assert (cut_own_colours(frame, alpha, other, whole, 96) == without).all()
    right = np.full_like(frame, (200, 210, 205))
    expected = own_colours(frame, alpha, right)
    assert (cut_own_colours(frame, alpha, right, whole, 96) == expected).all()


def test_a_lighter_strand_stays_lighter_than_its_neighbours():
    alpha = ramp()
    frame = mixed(np.array([150.0, 120, 80]), np.array([90.0, 90, 90]), alpha)
    light = mixed(np.array([180.0, 145, 96]), np.array([90.0, 90, 90]), alpha)
    place = np.flatnonzero((alpha[0] > 140) & (alpha[0] < 250))
    frame[40, place] = light[40, place]
    own = own_colours(frame, alpha, np.full(frame.shape, 90.0)).astype(float)
    assert (own[40, place] - own[20, place]).mean() > 20


@pytest.mark.parametrize("alpha", [0, 255, 128])
def test_a_frame_without_solid_or_without_soft_pixels_stays_as_it_is(alpha):
    frame = np.full((8, 8, 3), 90, np.uint8)
    assert (own_colours(frame, np.full((8, 8), alpha, np.uint8), None) == frame).all()


def test_one_pixel_and_black_plates_do_not_fail():
    assert own_colours(np.zeros((1, 1, 3), np.uint8), np.full((1, 1), 7, np.uint8), None).shape
    alpha = ramp(16)
    for value in (0, 255):
        frame = np.full((16, 16, 3), value, np.uint8)
        assert np.abs(own_colours(frame, alpha, frame).astype(int) - value).max() <= 1


def test_other_sizes_are_refused():
    frame = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ValueError, match="differ in size"):
        own_colours(frame, np.zeros((8, 9), np.uint8), None)
    with pytest.raises(ValueError, match="differ in size"):
        own_colours(frame, np.zeros((8, 8), np.uint8), np.zeros((4, 4, 3)))
