"""Define named shape directions of one unit (about a standard deviation) each.

Shape and expression directions are put together from smooth, windowed pulls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from express50.head.generator.eyes import lid_motion
from express50.head.generator.field import eye_center, window
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray
Triple = tuple[float, float, float]

# How much of the surrounding skin's motion each lid loop takes, from the margin outwards.
_LID_SHARE = (0.0, 0.08, 0.2, 0.38, 0.58, 0.78, 0.92, 1.0)


@dataclass(frozen=True)
class Pull:
    """A Gaussian-windowed motion (mm): translation `move` and scaling `stretch` about `at`."""

    at: Triple
    radius: Triple
    move: Triple = (0.0, 0.0, 0.0)
    stretch: Triple = (0.0, 0.0, 0.0)
    sides: str = "both"  # "both" mirrors the pull; "left", "right" or "middle" use it once
    scope: str = "skin"  # "skin", "all" (with teeth and tongue), "upper", "lower" (of the slit)


def displacement(mesh: WholeMesh, pulls: tuple[Pull, ...], scopes: dict[str, Array]) -> Array:
    """Sum (V,3) of pulls in mm; `scopes` maps a scope to its vertex weights (V,)."""
    total = np.zeros_like(mesh.vertices)
    for pull in pulls:
        flips = {"both": (1, -1), "left": (1,), "right": (-1,), "middle": (1,)}[pull.sides]
        for flip in flips:
            mirror = np.array([flip, 1.0, 1.0])
            at = np.array(pull.at) * mirror
            weight = window(mesh.vertices, at, pull.radius) * scopes[pull.scope]
            motion = np.array(pull.move) * mirror + np.array(pull.stretch) * (mesh.vertices - at)
            total += weight[:, None] * motion
    return total


def scope_weights(mesh: WholeMesh, regions: dict[str, Array], jaw: Array) -> dict[str, Array]:
    """Return vertex weights (V,) of each scope. `jaw` separates the lower lip from the upper."""
    hard = regions["teeth"] | regions["gums"] | regions["tongue"]
    balls = regions["left_eyeball"] | regions["right_eyeball"]
    skin = (~hard & ~balls).astype(float)
    return {
        "all": np.ones(len(skin)),
        "skin": skin,
        "upper": skin * (1 - jaw),
        "lower": skin * jaw,
    }


def settle_eyes(mesh: WholeMesh, motion: Array, carry_balls: bool) -> Array:
    """Make lids follow the eyeball, which moves as the field at its centre or keeps still."""
    result = motion.copy()
    for side in ("left", "right"):
        ball = mesh.tag("eyeball", side)
        rigid = motion[ball].mean(0) if carry_balls else np.zeros(3)
        result[ball] = rigid
        for tag in ("lid_edge", "lid_hidden"):
            result[mesh.tag(tag, side)] = rigid
        for k, share in enumerate(_LID_SHARE):
            ring = mesh.tag(f"lid{k}", side)
            result[ring] = rigid + share * (motion[ring] - rigid)
    return result


middle = partial(Pull, sides="middle")
_all = partial(Pull, sides="middle", scope="all")
_WIDE: Triple = (1e5, 1e5, 1e5)

_PULLS: dict[str, tuple[Pull, ...]] = {
    # head
    "head_size": (_all((0, 0, 0), _WIDE, stretch=(0.035,) * 3),),
    "head_width": (_all((0, 30, 0), (120, 130, 140), stretch=(0.05, 0, 0)),),
    "head_height": (_all((0, 0, 0), (150, 150, 150), stretch=(0, 0.045, 0)),),
    "skull_length": (_all((0, 50, -40), (110, 90, 80), stretch=(0, 0, 0.07)),),
    "skull_width": (_all((0, 65, -20), (100, 55, 90), stretch=(0.06, 0, 0)),),
    "crown_height": (_all((0, 125, -10), (80, 50, 80), move=(0, 6, 0)),),
    "occiput": (_all((0, 35, -95), (60, 45, 35), move=(0, 0, -6)),),
    "forehead_slope": (_all((0, 85, 75), (60, 32, 50), move=(0, 0, -6)),),
    "forehead_height": (_all((0, 80, 60), (80, 40, 60), move=(0, 5, 0)),),
    "forehead_width": (Pull((55, 65, 45), (30, 35, 40), move=(4, 0, 0)),),
    "forehead_bulge": (middle((0, 72, 88), (35, 22, 30), move=(0, 0, 4)),),
    "temple": (Pull((66, 40, 45), (16, 24, 26), move=(-3, 0, 0)),),
    "brow_ridge": (Pull((24, 39, 88), (22, 9, 16), move=(0, 0, 3.2)),),
    "brow_height": (Pull((30, 41, 82), (26, 11, 20), move=(0, 3, 0)),),
    "brow_slant": (
        Pull((48, 37, 72), (14, 10, 18), move=(0, 3, 0)),
        Pull((12, 37, 90), (12, 10, 16), move=(0, -2, 0)),
    ),
    "glabella": (middle((0, 37, 95), (12, 11, 14), move=(0, 0, 2.6)),),
    "face_width": (_all((0, -20, 40), (110, 75, 80), stretch=(0.055, 0, 0)),),
    "face_length": (_all((0, 10, 50), (110, 130, 110), stretch=(0, 0.05, 0)),),
    "face_depth": (_all((0, -10, 30), (90, 90, 80), stretch=(0, 0, 0.06)),),
    "lower_face_length": (_all((0, -75, 75), (60, 35, 60), move=(0, -5, 0)),),
    "midface_length": (_all((0, -40, 80), (60, 42, 60), move=(0, -4, 0)),),
    "face_convexity": (_all((0, -25, 95), (50, 36, 50), move=(0, 0, 4)),),
    # eyes
    "eye_distance": (Pull((31.5, 20, 72), (16, 16, 30), move=(2.2, 0, 0), scope="all"),),
    "eye_height": (Pull((31.5, 20, 72), (22, 20, 30), move=(0, 2.5, 0), scope="all"),),
    "eye_depth": (Pull((31.5, 20, 74), (20, 17, 26), move=(0, 0, -2.5), scope="all"),),
    "eye_bags": (Pull((33, 6, 80), (12, 6, 12), move=(0, 0, 2)),),
    "orbit_height": (Pull((31.5, 20, 80), (24, 18, 24), stretch=(0, 0.2, 0)),),
    "orbit_hollow": (Pull((30, 31, 84), (15, 7, 14), move=(0, 0, -2.6)),),
    "canthus_inner": (Pull((14, 18, 82), (6, 7, 14), move=(-1.6, -0.6, 0)),),
    # nose
    "nose_length": (middle((0, -20, 106), (24, 18, 26), move=(0, -4, 0)),),
    "nose_width": (middle((0, -17, 100), (26, 16, 24), stretch=(0.14, 0, 0)),),
    "nose_protrusion": (middle((0, -14, 112), (18, 20, 22), move=(0, 0, 4)),),
    "nose_tip_height": (middle((0, -14, 116), (11, 11, 14), move=(0, 3, 0)),),
    "nose_tip_size": (middle((0, -14, 108), (13, 12, 15), stretch=(0.18, 0.14, 0.12)),),
    "nose_bridge_height": (middle((0, 12, 96), (11, 20, 18), move=(0, 0, 3.4)),),
    "nose_bridge_width": (middle((0, 10, 92), (17, 20, 18), stretch=(0.22, 0, 0)),),
    "nose_hump": (middle((0, 4, 104), (9, 8, 12), move=(0, 0, 2.6)),),
    "nasion_depth": (middle((0, 25, 90), (11, 9, 14), move=(0, 0, -2.6)),),
    "nose_wing_height": (Pull((16, -19, 96), (9, 9, 12), move=(0, 2.2, 0)),),
    "nostril_size": (Pull((8, -23, 104), (8, 7, 9), stretch=(0.35, 0, 0.25)),),
    "columella": (middle((0, -26, 104), (7, 6, 12), move=(0, -2.2, 0)),),
    # mouth
    "mouth_width": (middle((0, -49, 94), (36, 17, 30), stretch=(0.12, 0, 0)),),
    "mouth_height": (middle((0, -49, 96), (36, 18, 34), move=(0, 3, 0)),),
    "mouth_forward": (_all((0, -49, 98), (34, 22, 34), move=(0, 0, 3.4)),),
    "lip_fullness": (
        middle((0, -42.5, 104), (22, 6.5, 16), move=(0, 1.2, 1.6), scope="upper"),
        middle((0, -56, 102), (22, 7, 16), move=(0, -1.4, 1.6), scope="lower"),
    ),
    "upper_lip_fullness": (middle((0, -43, 104), (20, 6, 14), move=(0, 1.2, 1.8), scope="upper"),),
    "lower_lip_fullness": (middle((0, -56, 102), (20, 7, 14), move=(0, -1.4, 1.8), scope="lower"),),
    "cupids_bow": (Pull((6, -41, 104), (5.5, 5, 10), move=(0, 1.3, 0.4), scope="upper"),),
    "philtrum_length": (middle((0, -24, 104), (26, 11, 28), move=(0, 2.6, 0)),),
    "philtrum_depth": (middle((0, -34, 103), (4.5, 7, 12), move=(0, 0, -1.5)),),
    "mouth_corner_height": (Pull((25, -49.5, 88), (11, 9, 18), move=(0, 2.2, 0)),),
    "overbite": (
        middle((0, -43, 100), (28, 10, 24), move=(0, 0, 2.2), scope="upper"),
        middle((0, -56, 98), (28, 10, 24), move=(0, 0, -1.6), scope="lower"),
    ),
    "labiomental_fold": (middle((0, -67, 96), (18, 7, 14), move=(0, 0, -2.6)),),
    # jaw
    "jaw_width": (Pull((52, -58, 22), (24, 30, 36), move=(4.5, 0, 0)),),
    "jaw_angle_height": (Pull((50, -60, 16), (24, 20, 26), move=(0, -4.5, 0)),),
    "jaw_length": (_all((0, -75, 80), (55, 34, 55), move=(0, 0, 5)),),
    "jaw_line_definition": (
        Pull((40, -86, 40), (24, 11, 34), move=(1.0, -2.6, 0)),
        Pull((36, -103, 42), (24, 10, 30), move=(0, 2.0, 0)),
    ),
    "chin_forward": (middle((0, -83, 94), (24, 16, 24), move=(0, 0, 4)),),
    "chin_width": (middle((0, -83, 86), (30, 18, 24), stretch=(0.2, 0, 0)),),
    "chin_height": (middle((0, -90, 86), (28, 15, 28), move=(0, -4, 0)),),
    "chin_cleft": (middle((0, -84, 98), (4, 7, 12), move=(0, 0, -1.6)),),
    "double_chin": (middle((0, -106, 55), (32, 15, 28), move=(0, -5, 2)),),
    "cheekbone": (Pull((55, 4, 60), (20, 14, 22), move=(2.6, 0, 2.0)),),
    "cheekbone_height": (Pull((54, 0, 62), (20, 18, 22), move=(0, 4, 0)),),
    "cheek_fullness": (Pull((48, -28, 62), (22, 22, 26), move=(3.5, 0, 3)),),
    "cheek_hollow": (Pull((54, -30, 48), (14, 17, 20), move=(-3.4, 0, -1)),),
    "jowl": (Pull((40, -70, 55), (17, 15, 20), move=(2.5, -3, 1)),),
    "nasolabial_fold": (Pull((24, -28, 92), (6, 11, 13), move=(0, 0, -1.8)),),
    # ears and neck
    "ear_size": (Pull((76, 5, -18), (16, 42, 26), stretch=(0.1, 0.14, 0.14)),),
    "ear_height": (Pull((74, 6, -16), (18, 42, 30), move=(0, 4, 0)),),
    "ear_protrusion": (Pull((88, 8, -30), (16, 34, 18), move=(4.5, 0, 1.5)),),
    "ear_lobe": (Pull((76, -24, -10), (14, 10, 14), move=(0.6, -3.4, 0.6)),),
    "neck_width": (middle((0, -140, -20), (100, 52, 90), stretch=(0.09, 0, 0)),),
    "neck_depth": (middle((0, -140, -20), (90, 52, 90), stretch=(0, 0, 0.09)),),
    "neck_forward": (middle((0, -160, -20), (90, 50, 80), move=(0, 0, -7)),),
    "trapezius": (Pull((62, -165, -40), (32, 32, 36), move=(2, 7, 0)),),
    "adams_apple": (middle((0, -134, 38), (10, 13, 18), move=(0, 0, 3.4)),),
    # asymmetric
    "nose_deviation": (middle((0, -8, 106), (20, 24, 26), move=(2.4, 0, 0)),),
    "jaw_asymmetry": (_all((0, -80, 60), (60, 40, 60), move=(3.4, 0, 0)),),
    "mouth_asymmetry": (
        Pull((25, -49, 90), (17, 12, 20), move=(0, 2, 0), sides="left"),
        Pull((25, -49, 90), (17, 12, 20), move=(0, -1.4, 0), sides="right"),
    ),
    "brow_asymmetry": (
        Pull((31, 40, 82), (22, 10, 18), move=(0, 2.4, 0), sides="left"),
        Pull((31, 40, 82), (22, 10, 18), move=(0, -1.8, 0), sides="right"),
    ),
    "cheek_asymmetry": (Pull((48, -22, 62), (22, 24, 26), move=(2.8, 0, 1.6), sides="left"),),
    "ear_asymmetry": (Pull((76, 5, -18), (20, 42, 28), move=(2, 3, 0), sides="left"),),
    "skull_asymmetry": (Pull((55, 50, -60), (45, 50, 45), move=(3, 0, -3), sides="left"),),
}
# The pulls are written as strong as one of them alone may be; drawn together from a normal
# distribution they must give people, not caricatures.
_UNIT = 0.5


def shape_directions(
    mesh: WholeMesh, regions: dict[str, Array], jaw: Array
) -> tuple[tuple[str, ...], Array]:
    """Return names (S) and directions (V,3,S) in mm per unit. `jaw` (V,) separates the lips."""
    scopes = scope_weights(mesh, regions, jaw)
    result = {}
    for name, pulls in _PULLS.items():
        motion = displacement(mesh, pulls, scopes)
        result[name] = motion if name == "head_size" else settle_eyes(mesh, motion, True)
    result["eye_size"], result["eye_slant"] = _eye_size_and_slant(mesh)
    wider = [lid_motion(mesh, side, -0.12, -0.06) for side in ("left", "right")]
    result["eye_opening"] = wider[0] + wider[1]
    return tuple(result), _UNIT * np.stack(list(result.values()), -1)


def _eye_size_and_slant(mesh: WholeMesh) -> tuple[Array, Array]:
    """Return two directions of the lids and eyeballs that need the eye's own frame."""
    size, slant = np.zeros_like(mesh.vertices), np.zeros_like(mesh.vertices)
    for side in ("left", "right"):
        center, ball = eye_center(side), mesh.tag("eyeball", side)
        for k in range(8):
            ring = mesh.tag(f"lid{k}", side)
            offset = mesh.vertices[ring] - center
            share = 1 - (k / 7) ** 2
            size[ring] = 0.08 * share * offset
            # The outer corner goes up, the inner one down, about the x axis.
            angle = share * offset[:, 0] * np.sign(center[0]) * 0.0075
            up = np.stack([np.zeros(len(offset)), offset[:, 2], -offset[:, 1]], 1)
            slant[ring] = angle[:, None] * up
        for tag in ("lid_edge", "lid_hidden"):
            for motion in (size, slant):
                motion[mesh.tag(tag, side)] = motion[mesh.tag("lid0", side)]
        size[ball] = 0.08 * (mesh.vertices[ball] - center)
    return size, slant
