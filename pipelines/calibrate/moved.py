"""Does the footage still fit the cameras it was calibrated with? A rig is bumped between shots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from express50.capture.index import Index
from express50.geometry.cameras import Camera
from express50.landmarks.network import load_network
from pipelines.calibrate.camera_moves import FootageVerdict, check_footage, reduce_image
from pipelines.calibrate.footage_views import read_footage


def look_at_footage(
    index: Index, cameras: Mapping[str, Camera], moments: int
) -> FootageVerdict | None:
    """What frames at so many moments, spread over the cues, say of the cameras.

    None where there is nothing to say: no moments asked for, or fewer than three cameras.
    """
    if moments < 1 or len(cameras) < 3:
        return None
    frames: dict[int, dict[str, np.ndarray]] = {}
    for frame, name, image in read_footage(index, cameras, moments):
        small = reduce_image(cameras[name], image, f"frame {frame}")
        frames.setdefault(frame, {})[name] = small
    return check_footage(cameras, frames, load_network())


def footage_metrics(verdict: FootageVerdict | None) -> dict[str, Any]:
    """The verdict as metrics: figures, and a warning for each camera that has moved."""
    if verdict is None:
        return {"footage": None, "warnings": []}
    return {
        "footage": {
            "points": verdict.points,
            "error_px": round(verdict.error_px, 4) if np.isfinite(verdict.error_px) else None,
            "unchecked": sorted(verdict.unchecked),
        },
        "warnings": [
            {
                "what": name,
                "why": f"seems to have moved since it was calibrated: its picture is off by"
                f" {move.shift_px:.1f} px (turned {move.turn_deg:.2f} degrees, moved"
                f" {move.move_mm:.1f} mm); calibrate the rig again, or leave the camera out",
            }
            for name, move in verdict.moved.items()
        ],
    }
