"""Cameras whose landmarks stand off from where all others say, the same way in every expression.

A detector errs differently from face to face; a camera that was bumped, or calibrated wrongly, is
off by the same pixels every time. Such a camera is named, with the offset, so that its calibration
gets mended: leaving its landmarks out quietly would only hide it.
"""

from __future__ import annotations

import numpy as np

from pipelines.track.observe import View, facing
from pipelines.track.pinhole import project_pinhole
from pipelines.track.state import Target

LEAST_EXPRESSIONS, LEAST_CAMERAS = 3, 3
# A share of the face's size, a multiple of the other cameras' offsets, and of the offset's own
# standard error: a suspect passes all three.
LEAST_SHARE, OVER_OTHERS, OVER_ERROR = 0.03, 3.0, 3.0
# Landmarks of nearer profiles are too poor to accuse a camera.
FACING = 0.2


def suspect_cameras(
    targets: list[Target], marks: np.ndarray, rotations: np.ndarray, middles: np.ndarray
) -> dict[str, dict[str, object]]:
    """Cameras that seem wrongly calibrated, with how far off they are.

    Args:
        targets: E expressions; views that were refused speak here too.
        marks: (E, 68, 3) fitted landmarks, world.
        rotations: (E, 3, 3) world from head.
        middles: (E, 3) middle of each head, world.

    Returns:
        Camera to `offset_px` (mean offset x, y of what is seen from what is expected), `of_face`
        (a share of the face's size) and `expressions` (how many tell).
    """
    seen: dict[str, list[tuple[np.ndarray, float]]] = {}
    for target, points, rotation, middle in zip(targets, marks, rotations, middles, strict=True):
        for view in (*target.observation.views, *target.observation.refused):
            if facing(view, rotation, middle) > FACING:
                seen.setdefault(view.camera_id, []).append(_offset(view, points))
    told = {name: rows for name, rows in seen.items() if len(rows) >= LEAST_EXPRESSIONS}
    if len(told) < LEAST_CAMERAS:
        return {}
    shares = {name: np.stack([o / size for o, size in rows]) for name, rows in told.items()}
    lengths = {name: float(np.linalg.norm(rows.mean(0))) for name, rows in shares.items()}
    suspects = {}
    for name in sorted(told):
        others = float(np.median([lengths[other] for other in told if other != name]))
        spread = shares[name].std(0, ddof=1)
        error = float(np.linalg.norm(spread)) / len(shares[name]) ** 0.5
        if lengths[name] > max(LEAST_SHARE, OVER_OTHERS * others, OVER_ERROR * error):
            mean = np.mean([offset for offset, _ in told[name]], axis=0)
            suspects[name] = {
                "offset_px": [round(float(value), 2) for value in mean],
                "of_face": round(lengths[name], 4),
                "expressions": len(told[name]),
            }
    return suspects


def _offset(view: View, points: np.ndarray) -> tuple[np.ndarray, float]:
    """Median offset (2,) of the points between brows and mouth, pixels, and the face's size."""
    pixels, _ = project_pinhole(view.camera, points)
    inner = np.isfinite(view.sigma)
    inner[:17] = False
    if not inner.any():
        return np.zeros(2), 1.0
    size = float(np.ptp(pixels, axis=0).max())
    return np.median((view.points - pixels)[inner], axis=0), max(size, 1.0)
