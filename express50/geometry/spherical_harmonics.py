"""Real spherical harmonics to order two: the one basis for light and for view-dependent colour."""

from __future__ import annotations

import math

import numpy as np

# Orthonormal harmonic = norm x polynomial, in the order of `sh_polynomials`.
SH_NORMS = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4 * math.pi))
SH_DC = float(SH_NORMS[0])
"""Value of the constant harmonic."""


def sh_polynomials(directions: np.ndarray) -> np.ndarray:
    """Evaluate the harmonics (N, 9) at unit directions (N, 3), each without its constant.

    The order is (0,0), (1,-1), (1,0), (1,1), (2,-2) ... (2,2), without the Condon-Shortley sign:
    1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2. Nine coefficients reproduce the irradiance of any
    distant light to about one per cent (Ramamoorthi and Hanrahan 2001, "An efficient representation
    for irradiance environment maps").
    """
    x, y, z = directions.T
    columns = [np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return np.stack(columns, axis=1)
