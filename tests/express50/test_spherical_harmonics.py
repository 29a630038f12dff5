"""Spherical harmonics: orthonormal on the sphere, by exact quadrature."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.spherical_harmonics import SH_DC, SH_NORMS, sh_polynomials


def test_harmonics_are_orthonormal() -> None:
    heights, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * 2 * np.pi / 16
    z, angle = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    across = np.sqrt(1 - z**2)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    Y = sh_polynomials(directions) * SH_NORMS
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    assert np.allclose(Y.T @ (area[:, None] * Y), np.eye(9), atol=1e-12)


def test_the_constant_harmonic() -> None:
    assert pytest.approx(0.28209479177387814) == SH_DC
