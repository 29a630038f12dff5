"""Colour of the skin, light of the room and gain of each camera, from pictures and a mesh.

Root of light everywhere: picture = root gain x root light x root albedo. All three are found in
closed form, one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LIGHT_FLOOR = 0.05
RIDGE = 0.02
# Taking turns closes about a quarter of what gains are off, a round: after two, 4 to 8 % was left.
ROUNDS = 10
OUTLIER = 2.5
NOISE_FLOOR = 0.002
EVEN_LIGHT = np.repeat(np.eye(9)[:, :1], 3, axis=1)


@dataclass(frozen=True)
class Seen:
    """What C cameras show at S samples at one moment.

    Attributes:
        cameras: C camera ids.
        values: (C, S, 3) root of linear light.
        weights: (C, S) trust, 0 where a sample is not seen.
        normals: (S, 3) world.
    """

    cameras: tuple[str, ...]
    values: np.ndarray
    weights: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class Appearance:
    """Light (9, 3) of the room, root gain (3,) a camera, root albedo (S, 3), NaN where unseen."""

    light: np.ndarray
    gains: dict[str, np.ndarray]
    albedo: np.ndarray

    def shade(self, camera_id: str, normals: np.ndarray) -> np.ndarray:
        """What root albedo is multiplied with at normals (S, 3) in a camera's pictures: (S, 3)."""
        gain = self.gains.get(camera_id, np.ones(3))
        return gain * np.sqrt(np.maximum(sh_basis(normals) @ self.light, LIGHT_FLOOR))


def sh_basis(normals: np.ndarray) -> np.ndarray:
    """Real spherical harmonics (S, 9) to order two, each scaled to 1, x, y, z, xy, yz, ...

    The irradiance of any distant light is a combination of these to about a per cent (Ramamoorthi
    and Hanrahan 2001); constants are left to the coefficients, so that the first is the mean light.
    """
    x, y, z = normals.T
    columns = [np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return np.stack(columns, axis=1)


def estimate(moments: list[Seen], before: Appearance | None = None) -> Appearance:
    """Albedo, light and gains that explain the moments best; `before` gives light and gains."""
    cameras = sorted({name for seen in moments for name in seen.cameras})
    light = _first_light(moments) if before is None else before.light
    gains = {name: np.ones(3) for name in cameras} | (before.gains if before else {})
    count = moments[0].normals.shape[0]
    appearance = Appearance(light, gains, np.full((count, 3), np.nan))
    for _ in range(ROUNDS):
        appearance = _with_albedo(appearance, moments)
        appearance = _with_gains(appearance, moments)
        appearance = _with_light(appearance, moments)
    return _with_albedo(appearance, moments)


def albedo_sums(appearance: Appearance, seen: Seen) -> tuple[np.ndarray, np.ndarray]:
    """Mass and weighted sum (S, 3) of one moment's root albedo."""
    mass, total = np.zeros_like(seen.normals), np.zeros_like(seen.normals)
    for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
        shade = appearance.shade(camera_id, seen.normals)
        mass += weight[:, None] * shade**2
        total += weight[:, None] * shade * value
    return mass, total


def residuals(appearance: Appearance, seen: Seen, albedo: np.ndarray) -> np.ndarray:
    """Lengths (C, S) of picture minus model over the channels; 0 where nothing is known."""
    rows = []
    for camera_id, value in zip(seen.cameras, seen.values, strict=True):
        model = appearance.shade(camera_id, seen.normals) * albedo
        rows.append(np.sqrt(np.nan_to_num((value - model) ** 2).sum(1)))
    return np.array(rows).reshape(-1, len(seen.normals))


def spread_of(lengths: np.ndarray, weights: np.ndarray) -> float:
    """Robust standard deviation of residual lengths (C, S) over three channels."""
    seen = lengths[weights > 0]
    # The median length of three unit normals is 1.538.
    return max(float(np.median(seen)) / 1.538, NOISE_FLOOR) if seen.size else NOISE_FLOOR


def trust(lengths: np.ndarray, sigma: float) -> np.ndarray:
    """Geman and McClure's weights in 0..1: hair, highlights and cast shadows count for little."""
    return 1.0 / (1.0 + (lengths / (3.0**0.5 * OUTLIER * sigma)) ** 2) ** 2


def _first_light(moments: list[Seen]) -> np.ndarray:
    """Light (9, 3) if all skin had one colour, with mean 1 over the samples."""
    basis, light, weights = [], [], []
    for seen in moments:
        mass = seen.weights.sum(0)
        mean = (seen.weights[..., None] * seen.values).sum(0) / np.maximum(mass, 1e-9)[:, None]
        basis.append(sh_basis(seen.normals))
        light.append(mean**2)
        weights.append(mass)
    B, L, w = np.concatenate(basis), np.concatenate(light), np.concatenate(weights)
    if not (w > 0).any():
        return EVEN_LIGHT
    L = L / np.maximum(np.average(L, axis=0, weights=w), 1e-6)
    start = EVEN_LIGHT
    for _ in range(3):
        off = np.linalg.norm(L - B @ start, axis=1)
        start = _ridge_fit(B, L, w / (1.0 + (off / 0.5) ** 2) ** 2, start)
    return start


def _ridge_fit(B: np.ndarray, target: np.ndarray, w: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Weighted least squares (9, 3), drawn gently to a start."""
    weighted = B * w[:, None]
    # Where nothing is seen the start stays.
    pull = (RIDGE * float(w.sum()) + 1e-9) * np.eye(9)
    return np.linalg.solve(weighted.T @ B + pull, weighted.T @ target + pull @ start)


def _with_albedo(appearance: Appearance, moments: list[Seen]) -> Appearance:
    mass = total = np.zeros_like(moments[0].normals)
    for seen in moments:
        one, sums = albedo_sums(appearance, seen)
        mass, total = mass + one, total + sums
    albedo = np.where(mass > 1e-6, total / np.maximum(mass, 1e-6), np.nan)
    return Appearance(appearance.light, appearance.gains, albedo)


def _with_gains(appearance: Appearance, moments: list[Seen]) -> Appearance:
    """Root gains by least squares, their geometric mean one: the rest is albedo."""
    over: dict[str, np.ndarray] = {name: np.zeros(3) for name in appearance.gains}
    under: dict[str, np.ndarray] = {name: np.zeros(3) for name in appearance.gains}
    plain = Appearance(appearance.light, {}, appearance.albedo)
    for seen in moments:
        expected = np.nan_to_num(plain.shade("", seen.normals) * appearance.albedo)
        for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
            over[camera_id] += (weight[:, None] * expected * value).sum(0)
            under[camera_id] += (weight[:, None] * expected**2).sum(0)
    gains = {n: np.clip((over[n] + 1e-3) / (under[n] + 1e-3), 0.25, 4.0) for n in over}
    if not gains:
        return appearance
    mean = np.exp(np.mean([np.log(gain) for gain in gains.values()], axis=0))
    return Appearance(
        appearance.light, {n: gain / mean for n, gain in gains.items()}, appearance.albedo
    )


def _with_light(appearance: Appearance, moments: list[Seen]) -> Appearance:
    """Light by least squares about the light so far: heads turn, so that normals vary."""
    basis, target, weights = [], [], []
    albedo = np.nan_to_num(appearance.albedo)
    for seen in moments:
        for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
            chosen = np.flatnonzero(weight > 0)
            scale = np.maximum((appearance.gains[camera_id] * albedo[chosen]) ** 2, 1e-4)
            basis.append(sh_basis(seen.normals[chosen]))
            target.append(np.clip(value[chosen] ** 2 / scale, 0.0, 4.0))
            weights.append(weight[chosen])
    if not basis:
        return appearance
    light = _ridge_fit(
        np.concatenate(basis), np.concatenate(target), np.concatenate(weights), appearance.light
    )
    return Appearance(light, appearance.gains, appearance.albedo)
