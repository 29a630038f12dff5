"""Define the expression directions: ARKit's and some more; 1 is full activation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from express50.geometry.sampling import smoothstep
from express50.head.generator.features import lid_motion, turned
from express50.head.generator.field import window
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray
Triple = tuple[float, float, float]

# Share of the surrounding skin's motion that each lid loop follows, from the margin outwards.
LID_SHARE = (0.0, 0.08, 0.2, 0.38, 0.58, 0.78, 0.92, 1.0)


@dataclass(frozen=True)
class Pull:
    """A Gaussian-windowed motion (mm): translation `move` and scaling `stretch` about `at`."""

    at: Triple
    radius: Triple
    move: Triple = (0.0, 0.0, 0.0)
    stretch: Triple = (0.0, 0.0, 0.0)
    sides: str = "both"  # "both" adds the mirrored pull; "left", "right" or "middle" do not
    scope: str = "skin"  # "skin", or its part that is "upper" or "lower" than the mouth's slit


def displacement(mesh: WholeMesh, pulls: tuple[Pull, ...], scopes: dict[str, Array]) -> Array:
    """Return the sum (V,3) of pulls in mm; `scopes` has the vertex weights (V,) of each scope."""
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


def settle_eyes(mesh: WholeMesh, motion: Array) -> Array:
    """Return the motion (V,3) with eyeballs and lid margins fixed, growing outwards on the lids."""
    result = motion.copy()
    for tag in ("eyeball", "lid_edge", "lid_hidden"):
        result[mesh.tag(tag)] = 0.0
    for k, share in enumerate(LID_SHARE):
        result[mesh.tag(f"lid{k}")] *= share
    return result


# Share, per loop from the slit on, by which a motion of shut lips through each other is reduced.
SHUT_SHARE = (1.0, 0.7, 0.3)


def part_lips(mesh: WholeMesh, motion: Array) -> Array:
    """Return the motion (V, 3) with shut lips moving together where they would overlap.

    Then no sum of motions pushes shut lips through each other.
    """
    result = motion.copy()
    for k, share in enumerate(SHUT_SHARE):
        for side in ("left", "right"):
            ring = mesh.tag(f"lip{k}", side)  # from the middle of the upper lip to the lower's
            upper, lower = ring[: len(ring) // 2], ring[: len(ring) // 2 : -1]
            held = 0.5 * share * np.maximum(motion[lower, 1] - motion[upper, 1], 0.0)
            result[upper, 1] = motion[upper, 1] + held
            result[lower, 1] = motion[lower, 1] - held
    return result


_CORNER: Triple = (25.5, -49.5, 87)
left, middle = partial(Pull, sides="left"), partial(Pull, sides="middle")

# One-sided directions, on the left; "_L" and "_R" are made from them.
PAIRED: dict[str, tuple[Pull, ...]] = {
    "browDown": (
        left((26, 40, 84), (20, 12, 20), (-2.0, -5.0, 1.0)),
        left((10, 38, 92), (9, 11, 14), (-1.5, -3.0, 1.2)),
    ),
    "browInnerUp": (
        left((13, 41, 90), (13, 14, 18), (1.0, 7.0, 0.3)),
        left((12, 60, 92), (18, 16, 20), (0.0, 3.0, 0.0)),
    ),
    "browOuterUp": (
        left((42, 41, 76), (17, 14, 22), (0.5, 6.5, 0.0)),
        left((40, 60, 80), (20, 16, 24), (0.0, 2.5, 0.0)),
    ),
    "cheekPuff": (
        left((42, -46, 70), (21, 20, 26), (8.0, 0.0, 7.0)),
        left((16, -38, 96), (13, 9, 16), (0.5, 0.5, 2.5), scope="upper"),
    ),
    "cheekRaiser": (
        left((38, -6, 74), (20, 15, 22), (0.5, 5.0, 2.5)),
        left((36, 7, 78), (16, 7, 16), (0.0, 2.0, 0.8)),
    ),
    "cheekSquint": (
        left((36, -2, 76), (18, 13, 20), (0.0, 4.0, 2.8)),
        left((22, -22, 92), (9, 12, 14), (0.5, 1.5, -0.6)),
    ),
    "cheekSuck": (left((42, -46, 68), (17, 18, 22), (-6.0, 0.0, -3.0)),),
    "mouthSmile": (
        left(_CORNER, (15, 12, 22), (8.0, 8.5, -5.0)),
        left((38, -22, 74), (19, 15, 22), (2.0, 5.0, 3.5)),
        left((12, -43, 102), (10, 9, 16), (2.0, 1.2, -1.2), scope="upper"),
        left((12, -55, 100), (11, 9, 16), (2.2, 1.6, -1.2), scope="lower"),
        left((27, -31, 90), (8, 11, 14), (0.5, 0.5, -1.0)),
    ),
    "mouthFrown": (
        left(_CORNER, (14, 12, 22), (1.5, -7.5, -1.0)),
        left((30, -64, 80), (13, 13, 20), (0.5, -2.5, 0.6)),
    ),
    "mouthDimple": (
        left(_CORNER, (13, 11, 20), (4.5, 0.5, -3.5)),
        left((34, -48, 80), (7, 8, 13), (0.0, 0.0, -2.0)),
    ),
    "mouthStretch": (
        left(_CORNER, (17, 15, 26), (9.0, -2.5, -5.0)),
        left((12, -54, 100), (12, 10, 16), (2.5, -0.6, -1.2), scope="lower"),
        left((12, -43, 102), (12, 10, 16), (2.5, 0.0, -1.0), scope="upper"),
    ),
    "mouthUpperUp": (
        left((11, -44, 101), (12, 10, 20), (0.8, 6.5, 0.8), scope="upper"),
        left((20, -30, 92), (11, 10, 16), (0.5, 2.5, 0.8), scope="upper"),
    ),
    "mouthLowerDown": (
        left((11, -55, 100), (12, 11, 20), (1.0, -6.5, 0.3), scope="lower"),
        left((14, -68, 95), (13, 9, 16), (0.5, -1.5, 0.6), scope="lower"),
    ),
    "mouthPress": (
        left((11, -44, 102), (14, 6, 16), (0.3, -1.6, -1.2), scope="upper"),
        left((11, -55, 101), (14, 7, 16), (0.3, 1.8, -1.2), scope="lower"),
        left(_CORNER, (10, 8, 16), (1.6, 0.0, -1.0)),
    ),
    "noseSneer": (
        left((14, -16, 98), (10, 11, 14), (1.2, 5.5, -0.4)),
        left((15, -33, 97), (12, 9, 16), (0.6, 4.2, 0.8), scope="upper"),
        left((9, 12, 92), (8, 13, 14), (-1.0, 2.2, 1.4)),
    ),
    "nostrilFlare": (left((15, -20, 99), (7, 8, 10), (3.0, 0.8, 0.0)),),
    "neckTense": (
        left((30, -140, 22), (16, 36, 26), (2.5, 0.0, 2.5)),
        left((30, -72, 74), (16, 14, 22), (1.5, -2.0, 0.0), scope="lower"),
    ),
}
_MIDDLE: dict[str, tuple[Pull, ...]] = {
    "mouthFunnel": (
        middle((0, -44, 102), (22, 10, 22), (0, 4.2, 5.5), scope="upper"),
        middle((0, -56, 100), (22, 11, 22), (0, -4.6, 5.5), scope="lower"),
        Pull(_CORNER, (13, 12, 22), (-8.0, 0.0, 4.0)),
    ),
    "mouthPucker": (
        middle((0, -49, 100), (24, 16, 26), (0, 0, 7.0)),
        middle((0, -49, 96), (26, 15, 30), stretch=(-0.34, 0, 0)),
        Pull(_CORNER, (15, 13, 22), (-4.5, 0.0, 4.0)),
    ),
    "mouthLeft": (middle((0, -50, 96), (34, 20, 34), (11.0, 0.8, 0)),),
    "mouthRight": (middle((0, -50, 96), (34, 20, 34), (-11.0, 0.8, 0)),),
    "mouthRollLower": (
        middle((0, -54, 101), (24, 7, 16), (0, 2.6, -5.5), scope="lower"),
        middle((0, -61, 99), (22, 7, 16), (0, 2.2, -1.0), scope="lower"),
    ),
    "mouthRollUpper": (
        middle((0, -45, 102), (24, 6.5, 16), (0, -2.2, -5.5), scope="upper"),
        middle((0, -38, 102), (22, 7, 16), (0, -1.8, -0.8), scope="upper"),
    ),
    "mouthShrugLower": (
        middle((0, -54, 101), (22, 9, 20), (0, 3.6, 2.6), scope="lower"),
        middle((0, -72, 96), (24, 14, 20), (0, 5.0, 0.8), scope="lower"),
        middle((0, -45, 102), (20, 7, 18), (0, 2.6, 1.6), scope="upper"),
    ),
    "mouthShrugUpper": (
        middle((0, -42, 103), (22, 11, 20), (0, 3.4, 2.0), scope="upper"),
        middle((0, -54, 101), (18, 6, 18), (0, 2.4, 1.2), scope="lower"),
    ),
    "chinWrinkle": (middle((0, -80, 96), (16, 11, 16), (0, 3.0, 1.4)),),
    "browSqueeze": (Pull((13, 38, 90), (10, 12, 16), (-3.4, -0.8, 1.0)),),
    "throatSwallow": (middle((0, -132, 36), (13, 16, 22), (0, 8.0, 1.0)),),
}


def expression_directions(
    mesh: WholeMesh, mean: WholeMesh, regions: dict[str, Array], jaw: Array, hinge: Array
) -> tuple[tuple[str, ...], Array]:
    """Return names (X) and directions (V,3,X) in mm at full activation, for the mean of people.

    Pulls are placed on the head drawn by rule, `mesh`, and move the same vertices of `mean`; the
    motions of lids and jaw come from the mean's own shape. `jaw` (V,) separates the lips; `hinge`
    (3,) is the jaw's joint in the mean.
    """
    others = ("teeth", "gums", "tongue", "left_eyeball", "right_eyeball")
    skin = (~np.any([regions[name] for name in others], axis=0)).astype(float)
    scopes = {"skin": skin, "upper": skin * (1 - jaw), "lower": skin * jaw}

    def moved(pulls: tuple[Pull, ...]) -> Array:
        return part_lips(mesh, settle_eyes(mesh, displacement(mesh, pulls, scopes)))

    result: dict[str, Array] = {}
    for name, pulls in PAIRED.items():
        result |= _both_sides(mesh, name, moved(pulls))
    for name, (upper, lower, aside) in _LIDS.items():
        motion = lid_motion(mean, upper, lower)
        # The cornea carries the lids a little sideways.
        shares = {f"lid{k}": (1 - k / 7) ** 2 for k in range(8)} | {"lid_edge": 1, "lid_hidden": 1}
        for tag, share in shares.items():
            motion[mesh.tag(tag, "left"), 0] += aside * share
        result |= _both_sides(mesh, name, motion)
    for name, pulls in _MIDDLE.items():
        result[name] = moved(pulls)
    result |= _jaw_directions(mesh, mean, jaw, hinge) | _tongue_directions(mesh)
    names = tuple(sorted(result, key=str.lower))
    return names, np.stack([result[name] for name in names], -1)


# By name: shares of the opening that the upper lid moves down and the lower up; motion in x, mm.
_LIDS: dict[str, tuple[float, float, float]] = {
    "eyeBlink": (0.855, 0.14, 0.0),  # lids that touch would pass through each other
    "eyeLookDown": (0.36, -0.1, 0.0),
    "eyeLookUp": (-0.2, 0.1, 0.0),
    "eyeLookIn": (0.0, 0.0, -0.7),
    "eyeLookOut": (0.0, 0.0, 0.7),
    "eyeSquint": (0.16, 0.3, 0.0),
    "eyeWide": (-0.26, -0.06, 0.0),
}


def _both_sides(mesh: WholeMesh, name: str, left: Array) -> dict[str, Array]:
    return {f"{name}_L": left, f"{name}_R": left[mesh.mirror] * [-1.0, 1.0, 1.0]}


def _jaw_directions(mesh: WholeMesh, mean: WholeMesh, jaw: Array, hinge: Array) -> dict[str, Array]:
    """Return the jaw's translations, and the motion that keeps lips shut as it opens by 0.3 rad."""
    share = jaw[:, None]
    sideways = jaw.copy()  # the lips move as one towards their corners
    for tag in ("lip0", "lip1", "lip2", "lip3", "cavity0", "cavity1"):
        for side in ("left", "right"):
            ring = mesh.tag(tag, side)
            own = smoothstep(np.abs(np.arange(len(ring)) - len(ring) // 2), 0.0, 16.0)
            both = 0.5 * (jaw[ring] + jaw[ring[::-1]])
            sideways[ring] = both + own * (jaw[ring] - both)
    slide = sideways[:, None] * np.array([[7.0, 0.0, 0.0]])
    back = turned(mean.vertices - hinge, np.array(0.3))
    lips = window(mesh.vertices, (0.0, -52.0, 95.0), (36.0, 15.0, 30.0))
    for k in range(4):
        lips[mesh.tag(f"lip{k}")] = np.maximum(lips[mesh.tag(f"lip{k}")], 1.0 - 0.06 * k)
    for tag in ("lower_teeth", "lower_gums", "tongue"):
        lips[mesh.tag(tag)] = 0.0
    return {
        "jawForward": share * np.array([[0.0, -0.5, 6.0]]),
        "jawLeft": slide,
        "jawRight": -slide,
        "mouthClose": 0.9 * (share * lips[:, None]) * back,
    }


def _tongue_directions(mesh: WholeMesh) -> dict[str, Array]:
    tongue = mesh.tag("tongue")
    p = mesh.vertices[tongue]
    tip, up = smoothstep(p[:, 2], 44.0, 84.0)[:, None], (p[:, 1] + 58.0) / 8.0
    moves = {
        "tongueOut": tip * [0.0, 3.0, 38.0],
        "tongueUp": tip**2 * [0.0, 15.0, -4.0],
        "tongueDown": tip**2 * [0.0, -6.0, 1.0],
        "tongueLeft": tip**2 * [14.0, 0.0, -2.0],
        "tongueRight": tip**2 * [-14.0, 0.0, -2.0],
        "tongueCurl": tip**3 * np.array([0.0, 12.0, -14.0]),
        "tongueWide": tip * np.stack([0.25 * p[:, 0], -0.8 * up, 0 * p[:, 0]], 1),
        "tongueBack": tip * [0.0, 2.0, -9.0],
    }
    result = {}
    for name, motion in moves.items():
        full = np.zeros_like(mesh.vertices)
        full[tongue] = motion
        result[name] = full
    return result
