"""Region masks of ICT-FaceKit's topology, from its README's vertex ranges and its landmarks."""

from __future__ import annotations

import numpy as np

# First and one past the last vertex of each part (README, "Face Model Topology" and below it).
RANGES = {
    "face_area": (0, 9409),
    "narrow_face": (0, 6706),
    "head_and_neck": (9409, 11248),
    "mouth_socket": (11248, 13294),
    "eye_socket_left": (13294, 13678),
    "eye_socket_right": (13678, 14062),
    "gums_tongue": (14062, 17039),
    "upper_teeth": (17039, 19247),
    "lower_teeth": (19247, 21451),
    "left_eyeball": (21451, 23021),
    "right_eyeball": (23021, 24591),
}
_LANDMARKS = {
    "brows": (268, 493, 1914, 2044, 1401, 3615, 4240, 4114, 2734, 2509),
    "nose": (978, 4527, 4942, 4857, 1140, 2075, 1147, 4269, 3360),
    "lips": (5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841),
    "right_eye": (1507, 1542, 1537, 1528, 1518, 1511),
    "left_eye": (3742, 3751, 3756, 3721, 3725, 3732),
}
_CHIN = 966


def ict_regions(
    template: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray
) -> dict[str, np.ndarray]:
    """Region name -> (V,) bool for the template (V, 3) in metres and all triangles (F, 3)."""
    count = template.shape[0]
    part = {name: _span(count, *ends) for name, ends in RANGES.items()}
    x, y, z = template.T
    skin = part["face_area"] | part["head_and_neck"]
    ears = part["face_area"] & (np.abs(x) > 0.069) & (z < 0.031) & (y > -0.024) & (y < 0.044)
    brow_top = template[list(_LANDMARKS["brows"]), 1].max() + 0.005
    face = part["narrow_face"] & ~ears & (y > template[_CHIN, 1] - 0.03)
    # The hair line of the nape: behind the ears the scalp reaches down to the mouth's height.
    scalp = skin & ~face & ~ears & (y > np.where(z < 0.0, -0.035, 0.01))
    regions = {
        "face": face,
        "neck": skin & ~face & ~ears & ~scalp,
        "scalp": scalp,
        "forehead": face & (y > brow_top),
        "nose": face & _inside_hull_box(template, _LANDMARKS["nose"], 0.006, 0.010),
        "lips": face & _inside_polygon(template, _LANDMARKS["lips"]),
        "left_ear": ears & (x > 0),
        "right_ear": ears & (x < 0),
        "teeth": part["upper_teeth"] | part["lower_teeth"],
        "upper_teeth": part["upper_teeth"],
        "lower_teeth": part["lower_teeth"],
        "tongue": _tongue(template, faces, uv_faces, part["gums_tongue"]),
        "mouth_interior": part["mouth_socket"] | part["gums_tongue"],
        "boundary": skin & _open_edge_vertices(faces, count) & (y < np.quantile(y, 0.05)),
    }
    for side in ("left", "right"):
        ball = part[f"{side}_eyeball"]
        centre = template[ball].mean(0)
        radius = np.linalg.norm(template - centre, axis=1)
        regions[f"{side}_eyeball"] = ball
        # An iris of 6 mm radius on a ball of 12 mm spans half a radian from the axis.
        regions[f"{side}_iris"] = ball & (z - centre[2] > np.cos(0.5) * radius)
        near = np.linalg.norm((template - centre) * np.array([1.0, 1.3, 0.7]), axis=1)
        regions[f"{side}_eye_region"] = face & (near < 0.026)
    return regions


def _span(count: int, first: int, end: int) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[first:end] = True
    return mask


def _inside_hull_box(
    template: np.ndarray, ids: tuple[int, ...], margin_x: float, margin_y: float
) -> np.ndarray:
    """Return vertices in the front-view box of some vertices, widened by margins in metres."""
    low, high = template[list(ids), :2].min(0), template[list(ids), :2].max(0)
    margin = np.array([margin_x, 0.4 * margin_y])
    return ((template[:, :2] > low - margin) & (template[:, :2] < high + margin)).all(1)


def _inside_polygon(template: np.ndarray, ids: tuple[int, ...]) -> np.ndarray:
    """Vertices inside the front-view polygon of some vertices, grown by 4 % (even-odd rule)."""
    polygon = template[list(ids), :2]
    polygon = polygon.mean(0) + 1.04 * (polygon - polygon.mean(0))
    x, y = template[:, 0], template[:, 1]
    inside = np.zeros(template.shape[0], dtype=bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crosses = (y0 > y) != (y1 > y)
        inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


def _tongue(
    template: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray, gums: np.ndarray
) -> np.ndarray:
    """Find the tongue (V,) bool: the two large texture islands within 2 cm of the middle.

    Gums and tongue are one piece of mesh, but they are cut apart in the texture map.
    """
    inside = gums[faces].all(1)
    islands = _connected(uv_faces[inside])
    mask = np.zeros(template.shape[0], dtype=bool)
    for island in np.unique(islands):
        ids = np.unique(faces[inside][islands == island])
        if ids.size > 200 and np.abs(template[ids, 0]).max() < 0.0205:
            mask[ids] = True
    return mask


def _connected(faces: np.ndarray) -> np.ndarray:
    """Label (F,) of the connected piece of each face (F, 3): the smallest vertex it reaches."""
    if not faces.size:
        return np.zeros(0, dtype=np.int64)
    labels = np.arange(faces.max() + 1)
    while True:
        updated = labels.copy()
        np.minimum.at(updated, faces.ravel(), np.repeat(labels[faces].min(1), 3))
        updated = updated[updated]
        if np.array_equal(updated, labels):
            return labels[faces[:, 0]]
        labels = updated


def _open_edge_vertices(faces: np.ndarray, count: int) -> np.ndarray:
    """Return vertices (V,) bool that lie on an edge used by one face only."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    mask = np.zeros(count, dtype=bool)
    mask[unique[uses == 1].ravel()] = True
    return mask
