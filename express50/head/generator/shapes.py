"""Named shape directions: anthropometric changes of one unit (about a standard deviation) each."""

from __future__ import annotations

import numpy as np

from express50.head.generator.eyes import lid_motion
from express50.head.generator.influence import (
    Pull,
    displacement,
    eye_center,
    scope_weights,
    settle_eyes,
)
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray
Triple = tuple[float, float, float]

_WIDE: Triple = (1e5, 1e5, 1e5)


def _all(
    at: Triple,
    radius: Triple,
    move: Triple = (0, 0, 0),
    stretch: Triple = (0, 0, 0),
    sides: str = "middle",
) -> Pull:
    return Pull(at=at, radius=radius, move=move, stretch=stretch, sides=sides, scope="all")


def _pair(
    at: Triple,
    radius: Triple,
    move: Triple = (0, 0, 0),
    stretch: Triple = (0, 0, 0),
    scope: str = "skin",
    sides: str = "both",
) -> Pull:
    return Pull(at=at, radius=radius, move=move, stretch=stretch, sides=sides, scope=scope)


def _mid(
    at: Triple,
    radius: Triple,
    move: Triple = (0, 0, 0),
    stretch: Triple = (0, 0, 0),
    scope: str = "skin",
) -> Pull:
    return Pull(at=at, radius=radius, move=move, stretch=stretch, sides="middle", scope=scope)


_HEAD: dict[str, tuple[Pull, ...]] = {
    "head_size": (_all((0, 0, 0), _WIDE, stretch=(0.035,) * 3),),
    "head_width": (_all((0, 30, 0), (120, 130, 140), stretch=(0.05, 0, 0)),),
    "head_height": (_all((0, 0, 0), (150, 150, 150), stretch=(0, 0.045, 0)),),
    "skull_length": (_all((0, 50, -40), (110, 90, 80), stretch=(0, 0, 0.07)),),
    "skull_width": (_all((0, 65, -20), (100, 55, 90), stretch=(0.06, 0, 0)),),
    "crown_height": (_all((0, 125, -10), (80, 50, 80), move=(0, 6, 0)),),
    "occiput": (_all((0, 35, -95), (60, 45, 35), move=(0, 0, -6)),),
    "forehead_slope": (_all((0, 85, 75), (60, 32, 50), move=(0, 0, -6)),),
    "forehead_height": (_all((0, 80, 60), (80, 40, 60), move=(0, 5, 0)),),
    "forehead_width": (_pair((55, 65, 45), (30, 35, 40), move=(4, 0, 0)),),
    "forehead_bulge": (_mid((0, 72, 88), (35, 22, 30), move=(0, 0, 4)),),
    "temple": (_pair((66, 40, 45), (16, 24, 26), move=(-3, 0, 0)),),
    "brow_ridge": (_pair((24, 39, 88), (22, 9, 16), move=(0, 0, 3.2)),),
    "brow_height": (_pair((30, 41, 82), (26, 11, 20), move=(0, 3, 0)),),
    "brow_slant": (
        _pair((48, 37, 72), (14, 10, 18), move=(0, 3, 0)),
        _pair((12, 37, 90), (12, 10, 16), move=(0, -2, 0)),
    ),
    "glabella": (_mid((0, 37, 95), (12, 11, 14), move=(0, 0, 2.6)),),
    "face_width": (_all((0, -20, 40), (110, 75, 80), stretch=(0.055, 0, 0)),),
    "face_length": (_all((0, 10, 50), (110, 130, 110), stretch=(0, 0.05, 0)),),
    "face_depth": (_all((0, -10, 30), (90, 90, 80), stretch=(0, 0, 0.06)),),
    "lower_face_length": (_all((0, -75, 75), (60, 35, 60), move=(0, -5, 0)),),
    "midface_length": (_all((0, -40, 80), (60, 42, 60), move=(0, -4, 0)),),
    "face_convexity": (_all((0, -25, 95), (50, 36, 50), move=(0, 0, 4)),),
}
_EYES: dict[str, tuple[Pull, ...]] = {
    "eye_distance": (_pair((31.5, 20, 72), (16, 16, 30), move=(2.2, 0, 0), scope="all"),),
    "eye_height": (_pair((31.5, 20, 72), (22, 20, 30), move=(0, 2.5, 0), scope="all"),),
    "eye_depth": (_pair((31.5, 20, 74), (20, 17, 26), move=(0, 0, -2.5), scope="all"),),
    "eye_bags": (_pair((33, 6, 80), (12, 6, 12), move=(0, 0, 2)),),
    "orbit_height": (_pair((31.5, 20, 80), (24, 18, 24), stretch=(0, 0.2, 0)),),
    "orbit_hollow": (_pair((30, 31, 84), (15, 7, 14), move=(0, 0, -2.6)),),
    "canthus_inner": (_pair((14, 18, 82), (6, 7, 14), move=(-1.6, -0.6, 0)),),
}
_NOSE: dict[str, tuple[Pull, ...]] = {
    "nose_length": (_mid((0, -20, 106), (24, 18, 26), move=(0, -4, 0)),),
    "nose_width": (_mid((0, -17, 100), (26, 16, 24), stretch=(0.14, 0, 0)),),
    "nose_protrusion": (_mid((0, -14, 112), (18, 20, 22), move=(0, 0, 4)),),
    "nose_tip_height": (_mid((0, -14, 116), (11, 11, 14), move=(0, 3, 0)),),
    "nose_tip_size": (_mid((0, -14, 108), (13, 12, 15), stretch=(0.18, 0.14, 0.12)),),
    "nose_bridge_height": (_mid((0, 12, 96), (11, 20, 18), move=(0, 0, 3.4)),),
    "nose_bridge_width": (_mid((0, 10, 92), (17, 20, 18), stretch=(0.22, 0, 0)),),
    "nose_hump": (_mid((0, 4, 104), (9, 8, 12), move=(0, 0, 2.6)),),
    "nasion_depth": (_mid((0, 25, 90), (11, 9, 14), move=(0, 0, -2.6)),),
    "nose_wing_height": (_pair((16, -19, 96), (9, 9, 12), move=(0, 2.2, 0)),),
    "nostril_size": (_pair((8, -23, 104), (8, 7, 9), stretch=(0.35, 0, 0.25)),),
    "columella": (_mid((0, -26, 104), (7, 6, 12), move=(0, -2.2, 0)),),
}
_MOUTH: dict[str, tuple[Pull, ...]] = {
    "mouth_width": (_mid((0, -49, 94), (36, 17, 30), stretch=(0.12, 0, 0)),),
    "mouth_height": (_mid((0, -49, 96), (36, 18, 34), move=(0, 3, 0)),),
    "mouth_forward": (_all((0, -49, 98), (34, 22, 34), move=(0, 0, 3.4)),),
    "lip_fullness": (
        _mid((0, -42.5, 104), (22, 6.5, 16), move=(0, 1.2, 1.6), scope="upper"),
        _mid((0, -56, 102), (22, 7, 16), move=(0, -1.4, 1.6), scope="lower"),
    ),
    "upper_lip_fullness": (_mid((0, -43, 104), (20, 6, 14), move=(0, 1.2, 1.8), scope="upper"),),
    "lower_lip_fullness": (_mid((0, -56, 102), (20, 7, 14), move=(0, -1.4, 1.8), scope="lower"),),
    "cupids_bow": (_pair((6, -41, 104), (5.5, 5, 10), move=(0, 1.3, 0.4), scope="upper"),),
    "philtrum_length": (_mid((0, -24, 104), (26, 11, 28), move=(0, 2.6, 0)),),
    "philtrum_depth": (_mid((0, -34, 103), (4.5, 7, 12), move=(0, 0, -1.5)),),
    "mouth_corner_height": (_pair((25, -49.5, 88), (11, 9, 18), move=(0, 2.2, 0)),),
    "overbite": (
        _mid((0, -43, 100), (28, 10, 24), move=(0, 0, 2.2), scope="upper"),
        _mid((0, -56, 98), (28, 10, 24), move=(0, 0, -1.6), scope="lower"),
    ),
    "labiomental_fold": (_mid((0, -67, 96), (18, 7, 14), move=(0, 0, -2.6)),),
}
_JAW: dict[str, tuple[Pull, ...]] = {
    "jaw_width": (_pair((52, -58, 22), (24, 30, 36), move=(4.5, 0, 0)),),
    "jaw_angle_height": (_pair((50, -60, 16), (24, 20, 26), move=(0, -4.5, 0)),),
    "jaw_length": (_all((0, -75, 80), (55, 34, 55), move=(0, 0, 5)),),
    "jaw_line_definition": (
        _pair((40, -86, 40), (24, 11, 34), move=(1.0, -2.6, 0)),
        _pair((36, -103, 42), (24, 10, 30), move=(0, 2.0, 0)),
    ),
    "chin_forward": (_mid((0, -83, 94), (24, 16, 24), move=(0, 0, 4)),),
    "chin_width": (_mid((0, -83, 86), (30, 18, 24), stretch=(0.2, 0, 0)),),
    "chin_height": (_mid((0, -90, 86), (28, 15, 28), move=(0, -4, 0)),),
    "chin_cleft": (_mid((0, -84, 98), (4, 7, 12), move=(0, 0, -1.6)),),
    "double_chin": (_mid((0, -106, 55), (32, 15, 28), move=(0, -5, 2)),),
    "cheekbone": (_pair((55, 4, 60), (20, 14, 22), move=(2.6, 0, 2.0)),),
    "cheekbone_height": (_pair((54, 0, 62), (20, 18, 22), move=(0, 4, 0)),),
    "cheek_fullness": (_pair((48, -28, 62), (22, 22, 26), move=(3.5, 0, 3)),),
    "cheek_hollow": (_pair((54, -30, 48), (14, 17, 20), move=(-3.4, 0, -1)),),
    "jowl": (_pair((40, -70, 55), (17, 15, 20), move=(2.5, -3, 1)),),
    "nasolabial_fold": (_pair((24, -28, 92), (6, 11, 13), move=(0, 0, -1.8)),),
}
_EARS_AND_NECK: dict[str, tuple[Pull, ...]] = {
    "ear_size": (_pair((76, 5, -18), (16, 42, 26), stretch=(0.1, 0.14, 0.14)),),
    "ear_height": (_pair((74, 6, -16), (18, 42, 30), move=(0, 4, 0)),),
    "ear_protrusion": (_pair((88, 8, -30), (16, 34, 18), move=(4.5, 0, 1.5)),),
    "ear_lobe": (_pair((76, -24, -10), (14, 10, 14), move=(0.6, -3.4, 0.6)),),
    "neck_width": (_mid((0, -140, -20), (100, 52, 90), stretch=(0.09, 0, 0)),),
    "neck_depth": (_mid((0, -140, -20), (90, 52, 90), stretch=(0, 0, 0.09)),),
    "neck_forward": (_mid((0, -160, -20), (90, 50, 80), move=(0, 0, -7)),),
    "trapezius": (_pair((62, -165, -40), (32, 32, 36), move=(2, 7, 0)),),
    "adams_apple": (_mid((0, -134, 38), (10, 13, 18), move=(0, 0, 3.4)),),
}
_ASYMMETRIC: dict[str, tuple[Pull, ...]] = {
    "nose_deviation": (_mid((0, -8, 106), (20, 24, 26), move=(2.4, 0, 0)),),
    "jaw_asymmetry": (_all((0, -80, 60), (60, 40, 60), move=(3.4, 0, 0)),),
    "mouth_asymmetry": (
        _pair((25, -49, 90), (17, 12, 20), move=(0, 2, 0), sides="left"),
        _pair((25, -49, 90), (17, 12, 20), move=(0, -1.4, 0), sides="right"),
    ),
    "brow_asymmetry": (
        _pair((31, 40, 82), (22, 10, 18), move=(0, 2.4, 0), sides="left"),
        _pair((31, 40, 82), (22, 10, 18), move=(0, -1.8, 0), sides="right"),
    ),
    "cheek_asymmetry": (_pair((48, -22, 62), (22, 24, 26), move=(2.8, 0, 1.6), sides="left"),),
    "ear_asymmetry": (_pair((76, 5, -18), (20, 42, 28), move=(2, 3, 0), sides="left"),),
    "skull_asymmetry": (_pair((55, 50, -60), (45, 50, 45), move=(3, 0, -3), sides="left"),),
}
# The pulls are written as strong as one of them alone may be; drawn together from a normal
# distribution they must give people, not caricatures.
_UNIT = 0.5

PULLS = _HEAD | _EYES | _NOSE | _MOUTH | _JAW | _EARS_AND_NECK | _ASYMMETRIC


def _eye_scaling(mesh: WholeMesh, kind: str) -> Array:
    """Return directions of the lids and eyeballs that need the eye's own frame."""
    motion = np.zeros_like(mesh.vertices)
    for side in ("left", "right"):
        center, ball = eye_center(side), mesh.tag("eyeball", side)
        for k in range(8):
            ring = mesh.tag(f"lid{k}", side)
            offset = mesh.vertices[ring] - center
            share = 1 - (k / 7) ** 2
            if kind == "eye_size":
                motion[ring] = 0.08 * share * offset
            else:  # eye_slant: the outer corner up, the inner down
                motion[ring] = _turn(offset, share * offset[:, 0] * np.sign(center[0]) * 0.0075)
        for tag in ("lid_edge", "lid_hidden"):
            motion[mesh.tag(tag, side)] = motion[mesh.tag("lid0", side)]
        if kind == "eye_size":
            motion[ball] = 0.08 * (mesh.vertices[ball] - center)
    return motion


def _turn(offset: Array, angle: Array) -> Array:
    """Turn offsets upwards about the x axis by small angles (N,): displacements (N,3)."""
    up = np.stack([np.zeros(len(offset)), offset[:, 2], -offset[:, 1]], 1)
    return angle[:, None] * up


def shape_directions(
    mesh: WholeMesh, regions: dict[str, Array], jaw: Array
) -> tuple[tuple[str, ...], Array]:
    """Return names (S) and directions (V,3,S) in mm per unit. `jaw` (V,) separates the lips."""
    scopes = scope_weights(mesh, regions, jaw)
    result = {}
    for name, pulls in PULLS.items():
        motion = displacement(mesh, pulls, scopes)
        result[name] = motion if name == "head_size" else settle_eyes(mesh, motion, "rigid")
    for name in ("eye_size", "eye_slant"):
        result[name] = _eye_scaling(mesh, name)
    wider = [lid_motion(mesh, side, -0.12, -0.06) for side in ("left", "right")]
    result["eye_opening"] = wider[0] + wider[1]
    return tuple(result), _UNIT * np.stack(list(result.values()), -1)
