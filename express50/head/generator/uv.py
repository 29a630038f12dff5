"""Packing of the head's UV charts into one square without overlaps."""

from __future__ import annotations

import numpy as np

from express50.head.generator.mesh import WholeMesh

Array = np.ndarray

# Chart -> left, bottom, right, top in the unit square.
RECTANGLES = {
    "skin": (0.005, 0.250, 0.995, 0.995),
    "ear_right": (0.005, 0.010, 0.155, 0.240),
    "ear": (0.162, 0.010, 0.312, 0.240),
    "mouth": (0.320, 0.040, 0.500, 0.240),
    "tongue": (0.508, 0.010, 0.622, 0.240),
    "eye_front_right": (0.630, 0.120, 0.750, 0.240),
    "eye_front": (0.757, 0.120, 0.877, 0.240),
    "eye_back_right": (0.640, 0.010, 0.740, 0.110),
    "eye_back": (0.767, 0.010, 0.867, 0.110),
    "upper_teeth": (0.885, 0.130, 0.995, 0.240),
    "lower_teeth": (0.885, 0.010, 0.995, 0.120),
}


def pack_uv(mesh: WholeMesh) -> tuple[Array, Array]:
    """UV coordinates (T,2) in [0,1] and their faces (F,3): each chart fills its rectangle."""
    corner_uv = np.empty_like(mesh.corner_uv)
    for chart, (left, bottom, right, top) in RECTANGLES.items():
        of_chart = mesh.face_chart == chart
        uv = mesh.corner_uv[of_chart]
        low, high = uv.min((0, 1)), uv.max((0, 1))
        size = np.array([right - left, top - bottom])
        corner_uv[of_chart] = [left, bottom] + (uv - low) / (high - low) * size
    # A vertex has one position a chart, two where the chart is cut on the mid plane.
    chart_id = np.unique(mesh.face_chart, return_inverse=True)[1]
    side = (mesh.corner_uv[..., 0] > 0).astype(np.int64)
    key = (mesh.faces * len(RECTANGLES) + chart_id[:, None]) * 2 + side
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return corner_uv.reshape(-1, 2)[first], inverse.reshape(-1, 3).astype(np.int64)
