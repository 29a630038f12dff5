"""How well the pictures of one moment agree on the colour of each place on the skin.

Every sample of the surface is looked up in every picture that sees it. Its own colour is unknown
and eliminated: what remains is how much the views differ from each other (which ties the surface
down in depth) and how much their mean differs from the colour that the sample had in the other
expressions (which ties it down along the surface). Both are reduced to a 3 x 3 normal equation a
sample before the head's parameters enter, so that a step costs the same for four views as for
twenty-four. Lucas and Kanade 1981 for the linearisation; Golub and Pereyra 1973 for the
elimination.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.conventions import corner_to_cell
from pipelines.track.pinhole import project_with_slope

# The most that a moment's pictures may count, as independent observations of the surface.
OBSERVATIONS = 3000.0
# Residuals beyond so many standard deviations lose their pull (Geman and McClure).
OUTLIER, TIE_OUTLIER = 4.0, 4.0


@dataclass(frozen=True)
class Picture:
    """What one camera gives for S samples.

    Attributes:
        camera: pinhole camera of the image.
        image: (H, W, 3) float32 root of linear light.
        weight: (S,) trust in each sample's view, 0 where it is not seen.
        shade: (S, 3) root of light times gain: expected image = shade * root of albedo.
    """

    camera: Camera
    image: np.ndarray
    weight: np.ndarray
    shade: np.ndarray


@dataclass(frozen=True)
class Photometry:
    """The photometric term of one moment.

    Attributes:
        rows: (S, 3) the samples' corners among the fit's points.
        bary: (S, 3).
        pictures: what the cameras see.
        albedo: (S, 3) root of albedo in the other moments; NaN where it is unknown.
        tie: how firmly `albedo` is held to, 0..1.
        sigma: standard deviation of the residuals.
    """

    rows: np.ndarray
    bary: np.ndarray
    pictures: tuple[Picture, ...]
    albedo: np.ndarray
    tie: float
    sigma: float

    def places(self, positions: np.ndarray) -> np.ndarray:
        """Samples (S, 3) for the fit's points (P, 3)."""
        return np.einsum("sk,skc->sc", self.bary, positions[self.rows])

    def cost(self, positions: np.ndarray) -> float:
        """Half the sum of squared residuals over sigma^2, robust."""
        places = self.places(positions)
        values = np.stack([look(p.camera, p.image, places)[0] for p in self.pictures])
        _, mean, off = self._explained(values)
        u = off / (3.0 * self.sigma**2)
        tied = self._mass(self._weights(off)) * self._off(mean) ** 2 / self.sigma**2
        v = tied.sum(1) / 3.0
        within = 3.0 * (self._trust * u / (1.0 + u / OUTLIER**2)).sum()
        return 0.5 * float(within + 3.0 * (self.tie * v / (1.0 + v / TIE_OUTLIER**2)).sum())

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix (S, 3, 3) and gradient (S, 3) by the samples' positions, metres."""
        places = self.places(positions)
        looks = [look(picture.camera, picture.image, places) for picture in self.pictures]
        values = np.stack([value for value, _ in looks])
        residual, mean, off = self._explained(values)
        weights = self._weights(off)
        count = len(places)
        matrix, gradient, drift = (np.zeros((count, *s)) for s in ((3, 3), (3,), (3, 3)))
        for row, picture in enumerate(self.pictures):
            slope = looks[row][1]
            weighted = weights[row][:, None, None] * slope
            matrix += np.swapaxes(weighted, 1, 2) @ slope
            gradient += np.einsum("skc,sk->sc", weighted, residual[row])
            drift += picture.shade[..., None] * weighted
        mass = self._mass(weights)
        drift /= np.maximum(mass, 1e-12)[..., None]
        apart = self._off(mean)
        v = (mass * apart**2).sum(1) / (3.0 * self.sigma**2)
        tie = self.tie / (1.0 + v / TIE_OUTLIER**2) ** 2 * np.isfinite(self.albedo).all(1)
        # The mean follows the views, so what moves all of them alike says nothing; the tie does.
        held = drift * (mass * (1.0 - tie[:, None]))[..., None]
        matrix -= np.swapaxes(drift, 1, 2) @ held
        gradient += np.einsum("skc,sk->sc", drift, tie[:, None] * mass * apart)
        return matrix / self.sigma**2, gradient / self.sigma**2

    @property
    def _trust(self) -> np.ndarray:
        return np.stack([picture.weight for picture in self.pictures])

    def _weights(self, off: np.ndarray) -> np.ndarray:
        """Trust (C, S) in each view, less where its squared residual (C, S) is large."""
        return self._trust / (1.0 + off / (3.0 * self.sigma**2 * OUTLIER**2)) ** 2

    def _mass(self, weights: np.ndarray) -> np.ndarray:
        shade = np.stack([picture.shade for picture in self.pictures])
        return (weights[..., None] * shade**2).sum(0)

    def _explained(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (C, S, 3), robust mean (S, 3) and squared lengths of the residuals (C, S)."""
        shade = np.stack([picture.shade for picture in self.pictures])
        mean = robust_mean(values, shade, self._trust, self.sigma)
        residual = values - shade * mean
        return residual, mean, (residual**2).sum(2)

    def _off(self, mean: np.ndarray) -> np.ndarray:
        """Difference (S, 3) from the albedo in other moments; 0 where that is unknown."""
        return np.where(np.isfinite(self.albedo), mean - self.albedo, 0.0)


def robust_mean(
    values: np.ndarray, shade: np.ndarray, trust: np.ndarray, sigma: float
) -> np.ndarray:
    """Root albedo (S, 3) on which most views agree: values (C, S, 3) = shade (C, S, 3) * mean.

    Hair, highlights and what stands before the skin in one view (trust (C, S)) count for little.
    """
    weights = trust
    for _ in range(3):
        mass = (weights[..., None] * shade**2).sum(0)
        mean = (weights[..., None] * shade * values).sum(0) / np.maximum(mass, 1e-12)
        off = ((values - shade * mean) ** 2).sum(2)
        weights = trust / (1.0 + off / (3.0 * sigma**2 * OUTLIER**2)) ** 2
    return mean


def look(camera: Camera, image: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image values (S, 3) at world points (S, 3) and their slope (S, 3 channels, 3 axes)."""
    pixels, slope = project_with_slope(camera, places)
    value, gradient = bilinear(image, pixels)
    return value, gradient @ slope


def bilinear(image: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (S, C) and slope (S, C, 2) per pixel of an image (H, W, C) at pixels (S, 2).

    Corner origin; outside the image its rim goes on.
    """
    height, width, channels = image.shape
    x, y = np.clip(corner_to_cell(pixels), 0.0, [width - 1.001, height - 1.001]).T
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    flat = image.reshape(-1, channels)
    at = row * width + column
    a, b = flat[at].astype(np.float64), flat[at + 1].astype(np.float64)
    c, d = flat[at + width].astype(np.float64), flat[at + width + 1].astype(np.float64)
    top, low = a + (b - a) * fx, c + (d - c) * fx
    slope = np.stack([(b - a) * (1 - fy) + (d - c) * fy, low - top], axis=2)
    return top + (low - top) * fy, slope
