"""The .ply export: bytes worked by hand and refused values."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from grmm.splat_files import GaussianCloud, ply_bytes


@pytest.fixture
def one():
    """One Gaussian whose logarithms and logit are whole numbers."""
    return GaussianCloud(
        means=np.array([[1.0, 2, 3]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.array([[math.e, 1, 1 / math.e]]),
        opacities=np.array([0.5]),
        colors=np.array([[0.5, 1.0, 0.0]]),
    )


def test_bytes_of_one_gaussian_worked_by_hand(one):
    header, _, body = ply_bytes(one).partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty")
    dc = 0.5 * 2 * math.sqrt(math.pi)  # (1 - 0.5) / (1 / (2 sqrt pi))
    expected = [1, 2, 3, 0, 0, 0, 0, dc, -dc, 0, 1, 0, -1, 1, 0, 0, 0]
    assert struct.unpack("<17f", body) == pytest.approx(expected, abs=1e-6)


def test_extreme_opacities_and_scales_stay_finite(one):
    flat = replace(one, opacities=np.array([1.0]), scales=np.zeros((1, 3)))
    body = ply_bytes(flat).partition(b"end_header\n")[2]
    assert np.isfinite(np.frombuffer(body, "<f4")).all()


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_values_that_are_not_finite_are_refused(one, name):
    broken = np.full_like(getattr(one, name), np.nan)
    with pytest.raises(ValueError, match=name):
        ply_bytes(replace(one, **{name: broken}))
