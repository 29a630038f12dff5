"""Find cameras whose landmarks are displaced in the same way in every expression.

A detector errs differently from face to face; a camera that was moved or calibrated wrongly is off
by the same pixels, scale or turn every time. Such a camera is named, with its error, so that its
calibration can be corrected; leaving its landmarks out quietly would only hide it. `calibrate`
checks cameras too, on features of its own frames; this check sees the frames that are tracked, and
so a camera that was moved between calibration and take.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from express50.contract.stage import Note
from express50.geometry.pinhole import project_pinhole
from pipelines.track.observe import LandmarkView, facing
from pipelines.track.state import Target

LEAST_EXPRESSIONS, LEAST_CAMERAS = 3, 3
# What a suspect is off by at least: a share of the face's size, a share of its scale, radians.
LEAST = {"offset": 0.03, "scale": 0.06, "roll": 0.06}
# And a multiple of the other cameras', and of its own standard error.
OVER_OTHERS, OVER_ERROR = 3.0, 3.0
# Landmarks of nearer profiles are too poor to accuse a camera.
FACING = 0.2


@dataclass(frozen=True)
class _Deviation:
    """A view's landmarks against the fit's: offset (2,) px, face size px, ln scale, roll."""

    offset: np.ndarray
    size: float
    scale: float
    roll: float


def suspect_cameras(
    targets: list[Target], marks: np.ndarray, rotations: np.ndarray, middles: np.ndarray
) -> dict[str, dict[str, object]]:
    """Find cameras that seem wrongly calibrated, and their errors.

    Args:
        targets: E expressions; views that were refused count here too.
        marks: (E, 68, 3) fitted landmarks, world.
        rotations: (E, 3, 3) world from head.
        middles: (E, 3) middle of each head, world.

    Returns:
        Camera to `offset_px` (mean offset x, y from the expected place), `of_face` (that as a
        share of the face's size), `scale` (seen over expected), `roll_deg` (clockwise in the
        picture) and `expressions` (their number).
    """
    seen: dict[str, list[_Deviation]] = {}
    for target, points, rotation, middle in zip(targets, marks, rotations, middles, strict=True):
        for view in (*target.observation.views, *target.observation.refused):
            if facing(view, rotation, middle) > FACING:
                one = _deviation(view, points)
                if one is not None:
                    seen.setdefault(view.camera_id, []).append(one)
    enough = {name: rows for name, rows in seen.items() if len(rows) >= LEAST_EXPRESSIONS}
    if len(enough) < LEAST_CAMERAS:
        return {}
    tables = {
        "offset": {n: np.stack([s.offset / s.size for s in rows]) for n, rows in enough.items()},
        "scale": _from_middle({n: [s.scale for s in rows] for n, rows in enough.items()}),
        "roll": _from_middle({n: [s.roll for s in rows] for n, rows in enough.items()}),
    }
    off = {name for kind, table in tables.items() for name in _off(table, LEAST[kind])}
    return {name: _account(enough[name]) for name in sorted(off)}


def camera_warnings(suspects: dict[str, dict[str, object]]) -> list[Note]:
    """Write the result of `suspect_cameras` as warnings."""
    return [
        Note(
            f"camera {name}",
            f"its landmarks are off by {row['offset_px']} px ({row['of_face']:.0%} of the face),"
            f" {row['scale']} times the expected size and turned by {row['roll_deg']} degrees, in"
            " every expression; check its calibration",
        )
        for name, row in suspects.items()
    ]


def _from_middle(table: dict[str, list[float]]) -> dict[str, np.ndarray]:
    """Subtract from the numbers (E, 1) per camera what all cameras have in common."""
    middle = float(np.median([np.mean(rows) for rows in table.values()]))
    return {name: np.array(rows)[:, None] - middle for name, rows in table.items()}


def _off(table: dict[str, np.ndarray], least: float) -> list[str]:
    """Find cameras whose numbers (E, D) are large, larger than the others' and significant."""
    lengths = {name: float(np.linalg.norm(rows.mean(0))) for name, rows in table.items()}
    found = []
    for name, rows in table.items():
        others = float(np.median([lengths[other] for other in table if other != name]))
        error = float(np.linalg.norm(rows.std(0, ddof=1))) / len(rows) ** 0.5
        if lengths[name] > max(least, OVER_OTHERS * others, OVER_ERROR * error):
            found.append(name)
    return found


def _account(rows: list[_Deviation]) -> dict[str, object]:
    mean = np.mean([row.offset for row in rows], axis=0)
    share = np.mean([row.offset / row.size for row in rows], axis=0)
    return {
        "offset_px": [round(float(value), 2) for value in mean],
        "of_face": round(float(np.linalg.norm(share)), 4),
        "scale": round(math.exp(float(np.mean([row.scale for row in rows]))), 3),
        "roll_deg": round(math.degrees(float(np.mean([row.roll for row in rows]))), 2),
        "expressions": len(rows),
    }


def _deviation(view: LandmarkView, points: np.ndarray) -> _Deviation | None:
    """Compare points between brows and mouth with the fitted ones (68, 3); None if unseen."""
    pixels, _ = project_pinhole(view.camera, points)
    inner = np.isfinite(view.sigma)
    inner[:17] = False
    if not inner.any():
        return None
    size = max(float(np.ptp(pixels, axis=0).max()), 1.0)
    offset = np.median((view.points - pixels)[inner], axis=0)
    seen, expected = (
        (p[inner] - np.median(p[inner], axis=0)) @ [1, 1j] for p in (view.points, pixels)
    )
    ratio = complex((seen * expected.conj()).sum() / max(float((abs(expected) ** 2).sum()), 1e-12))
    if abs(ratio) < 1e-6:  # all seen points coincide
        return _Deviation(offset, size, 0.0, 0.0)
    return _Deviation(offset, size, math.log(abs(ratio)), math.atan2(ratio.imag, ratio.real))
