"""Estimate by how much of a frame each camera is late, from a board that moves.

A corner that a camera sees late is off by its velocity times the delay; with a rolling shutter, the
delay grows from row to row. Both are estimated together with small changes of cameras and boards,
so that they are not mistaken for these. A board's velocity is known only where it moves smoothly
through consecutive images: boards that are held still, or shown now and then, give no estimate.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipelines.calibrate.adjuster import eliminate
from pipelines.calibrate.board import BoardCorners
from pipelines.calibrate.board_adjust import BoardRig, corner_errors, derive_corners, rig_covariance

SMOOTH = 0.5
"""Largest share by which the velocity of a smoothly moving board changes from frame to frame."""
SURE = 4.0  # standard deviations from zero, below which a value is taken for zero
LEAST_IMAGES = 6  # in which a board moves, for an estimate


@dataclass(frozen=True)
class CameraTiming:
    """The delay of a camera, in frames of the board's recording, with standard deviations.

    Values that are not surely different from zero are zero.
    """

    late: float  # against the median camera
    readout: float  # how much later its last row is than its first
    late_sigma: float
    readout_sigma: float


def corner_motion(corners: BoardCorners) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the corners' velocities and accelerations (N, 2), pixels, per frame and its square.

    Both are zero where they are not known. Frames are numbered by the last digits in their names,
    or counted if a name has none.
    """
    found = [re.search(r"(\d+)\D*$", name) for name in corners.frames]
    time = np.array([int(m.group(1)) if m else -1 for m in found], float)
    if len(set(time)) < len(time):
        time = np.arange(len(found), dtype=float)
    order = np.argsort(time)  # names without leading zeros are not sorted by number
    time, place = time[order], np.argsort(order)[corners.frame]
    count = int(corners.corner.max(initial=0)) + 1
    motion = np.zeros((2, *corners.pixels.shape))
    for i in np.unique(corners.camera):
        mine = np.flatnonzero(corners.camera == i)
        seen = np.full((len(time), count, 2), np.nan)
        seen[place[mine], corners.corner[mine]] = corners.pixels[mine]
        gap = np.diff(time)[:, None, None]
        steps = np.diff(seen, axis=0) / gap
        velocity = (gap[1:] * steps[:-1] + gap[:-1] * steps[1:]) / (gap[1:] + gap[:-1])
        bend = np.diff(steps, axis=0)
        smooth = np.nansum(bend**2, (1, 2)) < SMOOTH**2 * np.nansum(velocity**2, (1, 2))
        known = np.full((2, *seen.shape), np.nan)
        known[:, 1:-1] = velocity, 2 * bend / (gap[1:] + gap[:-1])
        known[:, 1:-1][:, ~smooth] = np.nan
        motion[:, mine] = np.nan_to_num(known[:, place[mine], corners.corner[mine]])
    return motion[0], motion[1]


def in_step(
    corners: BoardCorners, timing: Mapping[str, CameraTiming], heights: Mapping[str, int]
) -> BoardCorners:
    """Move corners to where they were when the median camera saw them."""
    late = np.zeros((len(corners.corner), 1))
    for name, found in timing.items():
        mine = corners.camera == corners.cameras.index(name)
        row = corners.pixels[mine, 1:] / heights[name] - 0.5
        late[mine] = found.late + found.readout * row
    velocity, acceleration = corner_motion(corners)
    shift = late * velocity - 0.5 * late**2 * acceleration
    return replace(corners, pixels=corners.pixels - shift)


def estimate_timing(
    rig: BoardRig,
    corners: BoardCorners,
    keep: np.ndarray,
    points: np.ndarray,
    scale_px: float,
    known: Mapping[str, CameraTiming],
) -> dict[str, CameraTiming]:
    """Estimate how late cameras are, from the corners that `keep` (N,) marks.

    `corners` are as seen and `rig` fits them after `in_step` by what is `known`. `points` (P, 3)
    are corners on the board. Cauchy's weights fall to a half at errors of `scale_px`. Cameras that
    see too little motion are left out.
    """
    heights = {name: camera.height for name, camera in rig.cameras.items()}
    velocity = corner_motion(corners)[0][keep]
    moving = velocity.any(axis=1)
    errors = corner_errors(rig, in_step(corners, known, heights), points)[keep]
    kept = corners.select(keep)
    names = [corners.cameras[i] for i in np.unique(kept.camera)]
    camera = np.searchsorted(np.unique(kept.camera), kept.camera)
    row = kept.pixels[:, 1] / np.array([heights[name] for name in names])[camera] - 0.5
    by_camera, by_board = derive_corners(rig, kept, points)
    by_time = np.stack([velocity, velocity * row[:, None]], axis=2)
    weight = (1 / (1 + np.sum(errors**2, axis=1) / scale_px**2))[:, None]
    root = np.sqrt(weight)
    normal = eliminate(
        np.concatenate([by_camera, by_time], axis=2) * root[..., None],
        by_board * root[..., None], errors * root, camera, kept.frame, len(names),
    )  # fmt: skip
    each = len(normal.right) // len(names)
    times = np.add.outer(np.arange(len(names)) * each + each - 2, [0, 1])
    held = np.zeros_like(normal.cameras)
    # If all cameras are late, moved boards explain it as well: the cameras' mean is held.
    held[np.ix_(times[:, 0], times[:, 0])] = max(normal.diagonal[times[:, 0]].max(), 1e-12)
    inverse = rig_covariance(normal, held)
    sigma = np.sqrt(np.diag(inverse)[times])
    sigma *= _noise(errors * weight, weight, by_time, camera, kept.frame)
    values = (inverse @ normal.right)[times]
    values += [(k.late, k.readout) if (k := known.get(n)) else (0.0, 0.0) for n in names]
    pairs = {(c, f) for c, f in zip(camera[moving], kept.frame[moving], strict=True)}
    enough = np.bincount([c for c, _ in pairs], minlength=len(names)) >= LEAST_IMAGES
    values[:, 0] -= np.median(values[enough, 0]) if enough.any() else 0.0
    values = np.where(np.abs(values) > SURE * sigma, values, 0.0)
    rows = {n: [*v, *s] for n, v, s in zip(names, values.tolist(), sigma.tolist(), strict=True)}
    return {n: CameraTiming(*rows[n]) for n, ok in zip(names, enough, strict=True) if ok}


def _noise(
    pulls: np.ndarray,
    weight: np.ndarray,
    by_time: np.ndarray,
    camera: np.ndarray,
    frame: np.ndarray,
) -> np.ndarray:
    """Return the factors of standard deviations (C, 2) that hold for errors of one pixel.

    `pulls` (N, 2) are the weighted errors. Corners of one image are off together where exposures
    are not periodic, so that images are independent, not corners.
    """
    noise = np.sqrt(np.mean(pulls**2)) / np.mean(weight**2)
    image = frame * (camera.max() + 1) + camera
    each = np.einsum("nki,nk->ni", by_time, pulls)
    alone = np.einsum("nki,nk->ni", by_time**2, pulls**2)
    found = np.ones((camera.max() + 1, 2))
    for i, k in np.ndindex(found.shape):
        mine = camera == i
        together = np.bincount(image[mine], each[mine, k])
        found[i, k] = max(1.0, np.sum(together**2) / max(alone[mine, k].sum(), 1e-12))
    return noise * np.sqrt(found)
