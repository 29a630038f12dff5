"""Define region masks, the 68 iBUG landmarks, and candidates for the visible jaw line."""

from __future__ import annotations

import numpy as np

from express50.head.generator.field import cast, from_front, labels, project, rays
from express50.head.generator.mesh import WholeMesh, is_skin

Array = np.ndarray


def _mask(mesh: WholeMesh, tags: list[str], side: str = "both") -> Array:
    mask = np.zeros(len(mesh.vertices), bool)
    for tag in tags:
        mask[mesh.tag(tag, side)] = True
    return mask


def region_masks(mesh: WholeMesh) -> dict[str, Array]:
    """Return masks (V,) bool by region name."""
    x, y, z = np.abs(mesh.vertices[:, 0]), mesh.vertices[:, 1], mesh.vertices[:, 2]
    skin = np.zeros(len(x), bool)  # ears included, without the mouth's cavity
    skin[mesh.faces[is_skin(mesh)]] = True
    regions = {
        "lips": _mask(mesh, [f"lip{k}" for k in range(4)]),
        "upper_teeth": _mask(mesh, ["upper_teeth"]),
        "lower_teeth": _mask(mesh, ["lower_teeth"]),
        "tongue": _mask(mesh, ["tongue"]),
        "gums": _mask(mesh, ["upper_gums", "lower_gums"]),
        "boundary": _mask(mesh, ["collar"]),
    }
    regions["teeth"] = regions["upper_teeth"] | regions["lower_teeth"]
    regions["mouth_interior"] = _mask(mesh, ["cavity"]) | regions["gums"]
    for side in ("left", "right"):
        regions[f"{side}_ear"] = _mask(mesh, ["ear"], side)
        lids = [f"lid{k}" for k in range(6)] + ["lid_edge", "lid_hidden"]
        regions[f"{side}_eye_region"] = _mask(mesh, lids, side)
        regions[f"{side}_eyeball"] = _mask(mesh, ["eyeball"], side)
        regions[f"{side}_iris"] = _mask(mesh, ["iris"], side)
        regions[f"{side}_pupil"] = _mask(mesh, ["pupil"], side)
    ears = regions["left_ear"] | regions["right_ear"]
    plain = skin & ~ears & ~regions["lips"]
    azimuth = np.degrees(np.arctan2(x, z))
    neck_top = np.interp(z, [-90, -60, -20, 12, 60, 90], [-42, -38, -32, -70, -101, -106])
    hairline = np.interp(
        azimuth, [0, 25, 45, 60, 72, 84, 92, 100, 180], [84, 88, 82, 66, 44, 20, 6, -30, -42]
    )
    eye_region = regions["left_eye_region"] | regions["right_eye_region"]
    regions["neck"] = plain & (y < neck_top)
    regions["scalp"] = plain & ~regions["neck"] & (y > hairline)
    regions["face"] = skin & ~ears & ~regions["neck"] & ~regions["scalp"]
    regions["forehead"] = regions["face"] & (y > 46) & ~eye_region
    half_width = np.interp(y, [-30, -24, -14, 0, 26, 32], [15, 20, 20, 15, 8, 8])
    nose = plain & (y > -29) & (y < 32) & (x < half_width) & (z > 74) & ~eye_region
    regions["nose"] = nose | _mask(mesh, [f"nostril{k}" for k in range(6)] + ["nostril_top"])
    return regions


# On the subject's left, from the chin (8) to the ear (16), mm; projected to the skin before use.
_JAW = np.array([(0, -95, 86), (16, -94, 79), (31, -87, 62), (44, -77, 44), (53, -64, 28),
                 (61, -46, 16), (67, -26, 10), (70, -6, 9), (71, 14, 8)], float)  # fmt: skip
# Placed, relative to eyes and nose, as in published marks of people (docs/LOG.md).
_BROW = np.array([(10, 32), (19.5, 36.5), (29.5, 38.5), (41, 37), (52.5, 31.5)], float)
_BRIDGE = np.array([(0, 24), (0, 13), (0, 1), (0, -13)], float)
_NOSTRILS = np.array([(0, -28.5), (6.5, -27.5), (13, -25)], float)


def embed_landmarks(mesh: WholeMesh) -> tuple[Array, Array]:
    """Return faces (68,) and barycentric weights (68,3) of the landmarks."""
    jaw, brow = project(_JAW, 6), from_front(_BROW)
    bridge, nostrils = from_front(_BRIDGE), from_front(_NOSTRILS)
    points = np.zeros((68, 3))
    flip = np.array([-1.0, 1, 1])
    points[8:17], points[0:8] = jaw, (jaw * flip)[:0:-1]
    points[22:27], points[17:22] = brow, (brow * flip)[::-1]
    points[27:31] = bridge
    points[33:36], points[31:33] = nostrils, (nostrils * flip)[:0:-1]
    for first, side, order in (
        (42, "left", (0, 7, 13, 20, 27, 33)),
        (36, "right", (20, 13, 7, 0, 33, 27)),
    ):
        points[first : first + 6] = mesh.vertices[mesh.tag("lid0", side)[list(order)]]
    for first, tag, loop in (
        (48, "lip3", (-16, -7, -2, 0, 2, 7, 16, 25, 30.5, 32, -30.5, -25)),
        (60, "lip0", (-16, -4, 0, 4, 16, 28, 32, -28)),
    ):
        # Positions along the loop from the upper to the lower middle, negative on the right.
        row = mesh.vertices[mesh.tag(tag, "left")]
        for k, place in enumerate(loop, first):
            points[k] = [np.interp(abs(place), np.arange(len(row)), axis) for axis in row.T]
            points[k, 0] *= np.sign(place)
    skin = np.flatnonzero(mesh.face_chart == "skin")
    corners = mesh.vertices[mesh.faces[skin]]
    faces, bary = np.zeros(68, np.int64), np.zeros((68, 3))
    for k, point in enumerate(points):
        weights, distance = _closest(corners, point)
        best = int(np.argmin(distance))
        faces[k], bary[k] = skin[best], weights[best]
    return faces, bary


def _closest(corners: Array, p: Array) -> tuple[Array, Array]:
    """Return a point's barycentric weights (F,3) in triangles, clamped, and its distances (F,)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    det = np.maximum(d00 * d11 - d01 * d01, 1e-12)
    v, w = (d11 * d20 - d01 * d21) / det, (d00 * d21 - d01 * d20) / det
    weights = np.clip(np.stack([1 - v - w, v, w], 1), 0, None)
    weights /= weights.sum(1, keepdims=True)
    return weights, np.linalg.norm((weights[..., None] * corners).sum(1) - p, axis=1)


def contour_candidates(mesh: WholeMesh) -> tuple[Array, ...]:
    """Return the skin vertices that may form the visible jaw line, per landmark 0..16."""
    azimuth, latitude = labels(project(_JAW, 6))
    grid = mesh.tag("grid")
    result = []
    for sign in (-1, 1):
        for k in range(9):
            spread = np.radians(np.linspace(-40, 40, 25)) * min(1.0, 0.25 + k / 4)
            around = np.maximum(azimuth[k] + spread, 0.0) if k else spread
            line = cast(*rays(around, np.full(25, latitude[k]))) * [sign, 1, 1]
            nearest = np.linalg.norm(mesh.vertices[grid][None] - line[:, None], axis=-1).argmin(1)
            _, first = np.unique(nearest, return_index=True)
            result.append(grid[nearest[np.sort(first)]].astype(np.int64))
    right, left = result[:9], result[9:]
    return tuple(right[:0:-1]) + tuple(left)
