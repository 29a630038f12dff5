"""Region masks of the procedural head (see express50.head.model for the names)."""

from __future__ import annotations

import numpy as np

from express50.head.generator.mesh import WholeMesh

Array = np.ndarray


def _mask(mesh: WholeMesh, tags: list[str], side: str = "both") -> Array:
    mask = np.zeros(len(mesh.vertices), bool)
    for tag in tags:
        mask[mesh.tag(tag, side)] = True
    return mask


def skin_mask(mesh: WholeMesh) -> Array:
    """Vertices of the skin and ears, without the mouth's cavity."""
    used = np.isin(mesh.face_chart, ("skin", "ear", "ear_right"))
    mask = np.zeros(len(mesh.vertices), bool)
    mask[np.unique(mesh.faces[used])] = True
    return mask


def region_masks(mesh: WholeMesh) -> dict[str, Array]:
    """Boolean masks (V,) by region name."""
    x, y, z = np.abs(mesh.vertices[:, 0]), mesh.vertices[:, 1], mesh.vertices[:, 2]
    skin = skin_mask(mesh)
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
