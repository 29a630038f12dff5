"""Alpha where plate and subject mix, from the plate behind it and the subject's colours nearby.

A pixel is ``alpha * F + (1 - alpha) * B`` in linear light, for that is what a lens averages. B, the
plate, is known but for noise; F has the mean and the covariance of the subject's colours nearby.
The likeliest alpha under both is the Bayesian matting of Chuang et al. 2001 with B given: the
covariance lets a strand be lighter or darker than its neighbours without being called more or
less opaque. Its deviation says what alpha is worth where F and B are alike.
"""

from __future__ import annotations

import cv2
import numpy as np

from express50.files.images import srgb_to_linear

ROUNDS = 3  # the covariance a pixel sees depends on its alpha; settled to 0.01 after two
OCTAVES = 4  # of reach, in which colours are looked for
TINT = 0.1  # share of the spread in brightness by which colour spreads too
CHUNK = 1 << 18  # pixels solved at once, so that memory is bounded
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MATRIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def to_light(values: np.ndarray, linear: bool) -> np.ndarray:
    """Light in [0, 1] of sRGB values in 8-bit steps; with ``linear`` false the values scaled."""
    shares = np.clip(values, 0, 255) / 255.0
    return srgb_to_linear(shares).astype(np.float32) if linear else shares.astype(np.float32)


def light_noise(
    plate: np.ndarray, sigma: np.ndarray, whiten: np.ndarray, linear: bool
) -> np.ndarray:
    """Covariance (N, 3, 3) of light, from that of 8-bit steps at plate values (N, 3)."""
    level = np.clip(plate, 1, 254)
    slope = (to_light(level + 1, linear) - to_light(level - 1, linear)) / 2
    deviation = (slope * sigma).astype(np.float64)
    mixing = np.linalg.inv(whiten.astype(np.float64))
    return deviation[:, :, None] * (mixing @ mixing.T) * deviation[:, None, :]


def local_colours(
    light: np.ndarray, weight: np.ndarray, where: np.ndarray, reach: float, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (N, 3) and covariance (N, 3, 3) of colours near the pixels of `where` (H, W).

    Args:
        light: (H, W, 3) colours.
        weight: (H, W), which of them count.
        where: (H, W) bool, N of them true.
        reach: pixels; the nearest of OCTAVES reaches that holds any colour decides.
        spread: share by which brightness may differ from what is seen nearby.
    """
    # A blur this wide has no detail, so sums are kept small; one channel at a time, for memory.
    factor = max(1, int(reach / 3))
    height, width = weight.shape
    size = (max(1, width // factor), max(1, height // factor))

    def nearby(values: np.ndarray) -> np.ndarray:
        small = cv2.resize(values * weight, size, interpolation=cv2.INTER_AREA)
        total = np.full_like(small, 1e-3 * 1e-2**OCTAVES * small.mean())  # where none is in reach
        for octave in range(OCTAVES):
            total += 1e-2**octave * _blurred(small, reach / factor * 2**octave)
        return cv2.resize(total, (width, height), interpolation=cv2.INTER_LINEAR)[where]

    share = np.maximum(nearby(np.ones_like(weight)), 1e-20)
    channels = [np.ascontiguousarray(light[..., c]) for c in range(3)]
    mean = np.stack([nearby(c) / share for c in channels], axis=1).astype(np.float64)
    squares = [nearby(channels[i] * channels[j]) / share for i, j in _PAIRS]
    outer = mean[:, :, None] * mean[:, None, :]
    covariance = np.stack(squares, axis=1)[:, _MATRIX] - outer
    tint = (TINT * spread) ** 2 * (mean**2).mean(axis=1)
    return mean, covariance + spread**2 * outer + tint[:, None, None] * np.eye(3)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur, at reduced size where that is wide."""
    factor = max(1, int(sigma / 3))
    height, width = image.shape
    size = (max(1, width // factor), max(1, height // factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def solve_opacity(
    seen: np.ndarray,
    behind: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likeliest alpha (N,), not clipped, and its deviations (N,) as found and near alpha 0.

    Args:
        seen: (N, 3) light of the pixels.
        behind: (N, 3) light of the plate.
        mean: (N, 3) of the subject's colours.
        covariance: (N, 3, 3) of the subject's colours.
        noise: (N, 3, 3) covariance of seen light that shows plate.
    """
    out = np.zeros((3, len(seen)))
    for start in range(0, len(seen), CHUNK):
        part = slice(start, start + CHUNK)
        out[:, part] = _solve(
            seen[part] - behind[part],
            mean[part] - behind[part],
            covariance[part],
            noise[part] + 1e-10 * np.eye(3),
        )
    return out[0], out[1], out[2]


def _solve(
    difference: np.ndarray, reach: np.ndarray, covariance: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`solve_opacity` of differences from the plate: seen, and of the subject's mean, (N, 3)."""
    precision = _precision(noise, reach)[1]
    at_zero = 1 / np.sqrt(np.maximum(precision, 1e-12))
    alpha = np.full(len(reach), 0.5)
    for _ in range(ROUNDS):
        share = np.clip(alpha, 0, 1)[:, None, None] ** 2
        direction, precision = _precision(noise + share * covariance, reach)
        alpha = np.einsum("ni,ni->n", difference, direction) / np.maximum(precision, 1e-12)
    return alpha, 1 / np.sqrt(np.maximum(precision, 1e-12)), at_zero


def _precision(covariance: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``C^-1 r`` (N, 3) and ``r' C^-1 r`` (N,): the weights and the worth of a projection on r."""
    direction = np.linalg.solve(covariance, reach[..., None].astype(np.float64))[..., 0]
    return direction, np.einsum("ni,ni->n", reach, direction)


def shrunk(values: np.ndarray, doubt: np.ndarray) -> np.ndarray:
    """Shrink values (N,) by their doubt (N,): to 0 within it, and hardly far above it.

    This is the non-negative garrote (Breiman 1995): unlike a ramp it keeps large values.
    """
    kept = 1 - (doubt / np.maximum(values, 1e-9)) ** 2
    return np.where(values > 0, values * np.clip(kept, 0, 1), 0.0)
