"""Learn the wall behind a person who moves, and solve the person's opacity in front of it.

A capture without plates still shows most of its wall: at other moments the head is elsewhere.
Several moments of a camera are cut out roughly (`cutout.py`), and the wall is averaged over those
that show it.

Around an outline, alpha is the posterior mean of a mixture (Bayesian matting, Chuang et al. 2001)
of two colours, the person's nearby and the wall's. Where no moment shows the wall, it is
interpolated from what is seen beside the person. How wrong each of the two is, is measured where
the frame itself shows the wall.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from express50.capture.frames import read_written
from express50.contract.layout import Dataset
from express50.errors import CaptureError, NoFaceError
from express50.geometry.cameras import Camera, pinhole, resized
from express50.geometry.pixels import edge_distance, shrink
from express50.geometry.sampling import undistorted_mask
from pipelines.matte.cutout import FACES, Cut, CutView, HeadPlace, cut_out, find_head, make_cut_view
from pipelines.matte.plates import (
    LEAST_SHARE,
    exposed,
    exposure_gain,
    light_per_step,
    local_colours,
    nearest_first,
    open_share,
    to_light,
)
from pipelines.matte.visual_hull import Ball, ball_of

# Lengths on the head, metres.
OUTER_M, INNER_M = 0.014, 0.010  # alpha is solved this far outside and inside the outline
RIM_M = (0.004, 0.015)  # the person's colours are sampled this deep inside the outline
REACH_M, WALL_M = 0.006, 0.004  # nearest distance from which colours of person and wall are taken
RING_M = 0.014  # width of the ring in which the wall's error is measured
DOUBT_M = 0.0018  # scale of an outline's logistic error; 1.8 times as much is the deviation
SPREAD = 0.15  # share by which hair may be brighter or darker than visible hair nearby
NOISE = 1.5  # standard deviation of a pixel, 8-bit steps
OPACITIES = np.linspace(0.0, 1.0, 9)
MIXED, ODD = 0.2, 0.02  # probability of a soft pixel on the outline, of a wrong one far from it

WALL_SIDE = 1920  # pixels, longer side of a wall; at 4K it would take five times as long
MOMENTS = 8  # at which the wall is looked for
# Size on the head of a pixel of the pictures that are cut, and their least longer side, pixels:
# these outlines need not be exact, and smaller pictures take a quarter of the time.
PIXEL_M, LEAST_SIDE = 0.003, 64
STAINED = 100.0  # 8-bit steps by which an opaque pixel may differ from the wall
CLEAR = 0.7  # pixels of more opacity say nothing about the wall
LEAST_MOMENTS = 4  # of a few long clips
SIDE, WINDOW = 512, 5  # pixels: of the pictures, and of the windows, in which stillness is judged
STILL = 2.0  # times the wall's own deviation
UNSEEN = 255  # error where no moment shows the wall


@dataclass(frozen=True)
class Wall:
    """The wall that a camera sees at some moment: colour (H, W, 3) uint8, sRGB.

    `error` (H, W) uint8 is its deviation in 8-bit steps, `UNSEEN` where no moment shows it.
    """

    colour: np.ndarray
    error: np.ndarray

    def sized(self, frame: np.ndarray) -> Wall:
        """Return the wall at the size of a frame (H, W, 3)."""
        size = frame.shape[1::-1]
        if size == self.error.shape[::-1]:
            return self
        way = cv2.INTER_AREA if size < self.error.shape[::-1] else cv2.INTER_LINEAR
        return Wall(*(cv2.resize(i, size, interpolation=way) for i in (self.colour, self.error)))

    def fits(self, frame: np.ndarray, valid: np.ndarray) -> bool:
        """Return whether a frame's top and upper sides show this wall: its camera did not move."""
        wall = self.sized(frame)
        known = valid & (wall.error < UNSEEN)
        return open_share(wall.colour, frame, known) >= LEAST_SHARE

    def before(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return colour (H, W, 3) and error (H, W) float32 at a frame's size and exposure."""
        wall = self.sized(frame)
        shown = exposed(wall.colour, exposure_gain(frame, wall.colour))
        return shown, np.where(wall.error < UNSEEN, wall.error, np.inf).astype(np.float32)

    def picture(self) -> np.ndarray:
        """Return it as a picture (H, W, 4), whose opacity is 255 less the error."""
        return np.dstack([self.colour, UNSEEN - self.error])


def read_wall(dataset: Dataset, subject: str, camera: str) -> Wall | None:
    """Read the wall that a camera saw at several moments; None if none was learned.

    Raises:
        CaptureError: the file is damaged, or another picture.
    """
    path = dataset.wall_file(subject, camera)
    if not path.is_file():
        return None
    image = read_written(path, None, channels=4)
    return Wall(np.ascontiguousarray(image[..., :3]), UNSEEN - image[..., 3])


def learn_walls(
    cameras: Mapping[str, Camera],
    read: Callable[[str, int], np.ndarray],
    frames: Sequence[int],
    wanted: Collection[str],
) -> Iterator[tuple[str, Wall]]:
    """Learn the walls of the `wanted` cameras from what all of them show at some frames.

    The cameras are those of recorded pictures at the size of undistorted ones. `read` makes such a
    picture (H, W, 3) uint8 of a camera and a frame; it is called twice, because all pictures
    together do not fit in memory. A camera that lacks a frame has no wall.
    """
    valid = {name: valid_pixels(camera) for name, camera in cameras.items()}
    views: dict[str, list[CutView]] = {}
    for name, camera in cameras.items():
        with suppress(CaptureError):
            views[name] = [
                make_cut_view(pinhole(camera), read(name, frame), valid[name]) for frame in frames
            ]
    cuts = cut_moments(list(zip(*views.values(), strict=True)), ball_of(cameras))
    cut = [(frame, cut) for frame, cut in zip(frames, cuts, strict=False) if cut]
    for name in views:
        if name in wanted and len(cut) > 1:
            pictures = [shrink(read(name, frame), WALL_SIDE) for frame, _ in cut]
            seen = shrink(valid[name].astype(np.uint8) * 255, WALL_SIDE) == 255
            yield name, learn_wall(pictures, [found[name] for _, found in cut], seen)


def cut_moments(moments: Sequence[Sequence[CutView]], ball: Ball | None) -> list[dict[str, Cut]]:
    """Find the person's outlines at several moments; a moment without a face has none."""
    cuts: list[dict[str, Cut]] = []
    place: HeadPlace | None = None
    for views in moments:
        found: dict[str, Cut] = {}
        with suppress(NoFaceError):
            place = find_head(views if place is None else _facing(views, place))
            small = [reduced_view(view, place.density(view.camera)) for view in views]
            found = cut_out(small, ball, place, others={})
        cuts.append(found)
    return cuts


def reduced_view(view: CutView, density: float) -> CutView:
    """Reduce a view of `density` pixels per metre of the head, unless its pixels are large."""
    size = max(view.valid.shape)
    side = min(size, max(LEAST_SIDE, round(size / (PIXEL_M * density))))
    valid = shrink(view.valid.astype(np.uint8) * 255, side) == 255
    rgb = shrink(view.rgb, side)
    return CutView(resized(view.camera, rgb.shape[1], rgb.shape[0]), rgb, valid)


def _facing(views: Sequence[CutView], place: HeadPlace) -> list[CutView]:
    """Return the views that a head faces most, which find it at all moments but the first."""

    def turned_away(view: CutView) -> float:
        way = view.camera.center - place.shift
        return -float(way @ place.rotation[:, 2]) / max(float(np.linalg.norm(way)), 1e-9)

    return sorted(views, key=turned_away)[:FACES]


def learn_wall(frames: Sequence[np.ndarray], cuts: Sequence[Cut], valid: np.ndarray) -> Wall:
    """Average the wall over frames (H, W, 3) uint8 of one camera, with the person cut out of each.

    Only pixels that are `valid` (H, W) are used.
    """
    gains = [exposure_gain(frames[0], frame) for frame in frames]
    total = np.zeros(valid.shape, np.float32)
    light, square = np.zeros((2, *valid.shape, 3), np.float32)
    for frame, gain, cut in zip(frames, gains, cuts, strict=True):
        alpha, image = soft_alpha(frame, valid, cut), exposed(frame, gain)
        weight = (valid & (alpha < CLEAR)) / (NOISE**2 + (STAINED * alpha) ** 2)
        total += weight
        light += weight[..., None] * image
        square += weight[..., None] * image**2
    seen = np.maximum(total, 1e-9)
    light /= seen[..., None]
    spread = np.maximum(square / seen[..., None] - light**2, 0).max(-1)
    error = np.ceil(np.sqrt(1 / seen + spread))
    error[_still_body(frames, gains, cuts, valid)] = UNSEEN
    colour = np.where((error < UNSEEN)[..., None], np.rint(np.clip(light, 0, 255)), 0)
    return Wall(colour.astype(np.uint8), np.minimum(error, UNSEEN).astype(np.uint8))


def _still_body(
    frames: Sequence[np.ndarray], gains: Sequence[np.ndarray], cuts: Sequence[Cut],
    valid: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Find pixels (H, W) bool below the neck that stay the same in all frames.

    They may be a body: cuts sometimes leave out a shirt of the wall's colour.
    """
    small = np.stack([exposed(shrink(f, SIDE), g) for f, g in zip(frames, gains, strict=True)])
    size = small.shape[2], small.shape[1]

    def sized(mask: np.ndarray, size: tuple[int, int] = size) -> np.ndarray:
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0

    spread = np.sqrt(((small - np.median(small, axis=0)) ** 2).mean(0)).max(-1)
    spread = cv2.blur(spread, (WINDOW, WINDOW))
    outside = sized(valid) & ~np.any([sized(cut.mask) for cut in cuts], axis=0)
    limit = STILL * np.median(spread[outside]) if outside.any() else np.inf
    body = np.any([sized(cut.body) for cut in cuts if cut.body is not None], axis=0)
    return sized(body & (spread < limit), valid.shape[::-1])


def valid_pixels(camera: Camera) -> np.ndarray:
    """Return the pixels (H, W) bool with footage, except the outermost, which resampling mixes."""
    return cv2.erode(undistorted_mask(camera).astype(np.uint8), np.ones((3, 3))) > 0


def soft_alpha(
    frame: np.ndarray, valid: np.ndarray, cut: Cut, wall: Wall | None = None
) -> np.ndarray:
    """Solve opacity (H, W) float32 around an outline that was cut in a reduced picture.

    The frame is (H, W, 3) uint8, undistorted; pixels outside ``valid`` (H, W) get 0. The `wall`
    helps where it was seen.
    """
    height, width = valid.shape
    mask = cv2.resize(cut.mask.astype(np.float32), (width, height)) > 0.5
    density = cut.density * max(height, width) / max(cut.mask.shape)
    if not mask.any():
        return np.zeros(valid.shape, np.float32)
    depth = edge_distance(mask) - edge_distance(~mask) if not mask.all() else mask * np.inf
    depth = (depth / density).astype(np.float32)  # metres inside the outline
    band = valid & (depth > -OUTER_M) & (depth < INNER_M)
    alpha = (valid & (depth >= INNER_M)).astype(np.float32)
    if band.any():
        behind = _behind(frame, valid & (depth <= -OUTER_M), depth, WALL_M * density, wall)
        alpha[band] = _posterior(frame.astype(np.float32), valid, depth, band, density, *behind)
    return alpha


def _behind(
    frame: np.ndarray, seen: np.ndarray, depth: np.ndarray, reach: float, wall: Wall | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the wall behind the person, and its error, (H, W, 3) each, 8-bit steps.

    It is interpolated from where it is `seen` (H, W). The error of that is measured in a ring, by
    filling it from further outside. So is the error of a wall that other moments showed.
    """
    image = frame.astype(np.float32)
    ring = seen & (depth > -OUTER_M - RING_M)
    further, weight = (mask.astype(np.float32) for mask in (seen & ~ring, ring))

    def error_of(guess: np.ndarray) -> np.ndarray:
        missed = np.where(ring[..., None], image - guess, 0) ** 2
        return np.maximum(_filled(missed, weight, 4 * reach), NOISE**2)

    colour = _filled(image, seen.astype(np.float32), reach)
    square = error_of(_filled(image, further, reach))
    if wall is None:
        return colour, np.sqrt(square)
    other, stated = wall.before(frame)
    known = np.isfinite(stated)[..., None]
    other = np.where(known, other, colour)
    trust = np.where(known, square / (error_of(other) + stated[..., None] ** 2), 0)
    mixed = colour + trust / (1 + trust) * (other - colour)
    return mixed, np.sqrt(np.maximum(square / (1 + trust), NOISE**2))


def _posterior(
    image: np.ndarray, valid: np.ndarray, depth: np.ndarray, band: np.ndarray, density: float,
    wall: np.ndarray, wall_error: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the posterior mean opacity (N,) of a band's pixels (H, W), from person and wall."""
    light, behind = to_light(image), to_light(wall)[band]
    rim = (valid & (depth > RIM_M[0]) & (depth < RIM_M[1])).astype(np.float32)
    mean, covariance = local_colours(light, rim, band, REACH_M * density, SPREAD)
    slope = light_per_step(wall[band])
    own, error = (NOISE * slope) ** 2, (wall_error[band] * slope) ** 2
    inside = np.clip(1 / (1 + np.exp(-depth[band] / DOUBT_M)), ODD, 1 - ODD)
    soft = MIXED * np.exp(-np.abs(depth[band]) / (4 * DOUBT_M)) + ODD
    chances = np.log([
        (1 - inside) * (1 - soft), *([soft / (len(OPACITIES) - 2)] * (len(OPACITIES) - 2)),
        inside * (1 - soft),
    ])  # fmt: skip
    for row, opacity in enumerate(OPACITIES):
        off = light[band] - opacity * mean - (1 - opacity) * behind
        variance = own + (1 - opacity) ** 2 * error
        chances[row] += _log_density(off, opacity**2 * covariance, variance)
    weight = np.exp(chances - chances.max(0))
    return (OPACITIES @ weight / weight.sum(0)).astype(np.float32)


def _log_density(off: np.ndarray, covariance: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return log densities (N,) of normal errors (N, 3), up to a constant.

    The covariance is `covariance` (N, 3, 3) plus `variance` (N, 3) on its diagonal. Solved with
    cofactors: NumPy's solver takes ten times as long for this many small matrices.
    """
    a, b, c = (covariance[:, k, k] + variance[:, k] + 1e-8 for k in range(3))
    d, e, f = covariance[:, 1, 2], covariance[:, 0, 2], covariance[:, 0, 1]
    x, y, z = off.T.astype(np.float64)
    A, B, C = b * c - d * d, a * c - e * e, a * b - f * f
    D, E, F = e * f - a * d, d * f - b * e, d * e - c * f
    determinant = np.maximum(a * A + f * F + e * E, 1e-30)
    square = A * x * x + B * y * y + C * z * z + 2 * (D * y * z + E * x * z + F * x * y)
    return -0.5 * (square / determinant + np.log(determinant))


def _filled(image: np.ndarray, weight: np.ndarray, reach: float) -> np.ndarray:
    """Average an image (H, W, 3) by weights (H, W) over the nearest distance that has any."""
    mass = nearest_first(weight, reach, 6, least=1e-12)
    return nearest_first(image * weight[..., None], reach, 6) / mass[..., None]
