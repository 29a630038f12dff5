"""Make what people wear and hold: glasses, a hand, beards, fringes, a microphone, a mask.

Worn hair grows as on the scalp. Glasses and microphones are rigid with the skull; beards and masks
follow the skin below them. A hand is in front of another part of the face in each cue window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from express50.geometry.sampling import smoothstep
from express50.geometry.transforms import make_transform, unit
from express50.head.model import HeadModel, landmarks_of
from express50.landmarks.training.scene import RING, glasses_lines
from express50.twin.hair import HairMesh, grow_hair
from express50.twin.subjects import PersonLook
from express50.twin.surface import (
    Caster,
    Material,
    StarMap,
    joined_arrays,
    make_lattice,
    noise,
    vertex_normals,
)

HAIRY = ("beard", "moustache", "fringe")
WITH_SKULL, WITH_HAND = -1, -2
"""What a vertex moves with if it does not follow a vertex of the skin."""

# A lens of -2.5 dioptres: radii of its surfaces, and its thickness in the middle, metres.
FRONT_M, BACK_M, LENS_M = 0.090, 0.062, 0.0016
HAND_CELL_M = 0.0025
# Ends and radii of a right hand's bones, metres: fingers along +y, palm towards -z. The thumb comes
# after the fingers, the forearm last.
_BONES = np.array([
    *([x, -0.04, 0, 0.012, 1.15 * x, 0.042 - 6 * x * x, 0, 0.011] for x in (-.03, -.01, .01, .03)),
    *([1.15 * x, y0 - 6 * x * x, 0, 0.0098, 1.2 * x, y0 + a, b, 0.009]
      for x, y0, a, b in ((-.03, .042, .032, -.004), (-.01, .042, .044, -.005),
                          (.01, .042, .046, -.005), (.03, .042, .038, -.004))),
    *([1.2 * x, y, z, 0.009, 1.22 * x, y + a, z - 0.012, 0.0072]
      for x, y, z, a in ((-.03, .074, -.004, .030), (-.01, .086, -.005, .036),
                         (.01, .088, -.005, .038), (.03, .080, -.004, .034))),
    [0.02, -0.035, -0.004, 0.014, 0.052, -0.002, -0.014, 0.011],
    [0.052, -0.002, -0.014, 0.011, 0.066, 0.038, -0.020, 0.009],
    [0.0, -0.045, 0.0, 0.024, 0.0, -0.085, 0.004, 0.023],
    [0.0, -0.085, 0.004, 0.023, 0.0, -0.40, 0.02, 0.036],
])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WornMesh:
    """Things in rest head space, except for the hand, in its own space; lenses come last."""

    vertices: np.ndarray  # (N, 3) metres
    faces: np.ndarray  # (M, 3)
    material: np.ndarray  # (M,) uint8
    colours: np.ndarray  # (N, 3) linear light
    # (N,) the head vertex that a vertex moves with, WITH_SKULL or WITH_HAND
    moves: np.ndarray


def bare() -> WornMesh:
    """Return an empty mesh."""
    none = np.zeros((0, 3), np.float32)
    few = np.zeros(0, np.int32)
    return WornMesh(vertices=none, faces=none.astype(np.int32), material=few.astype(np.uint8),
                    colours=none, moves=few)  # fmt: skip


def wear(
    kinds: tuple[str, ...], model: HeadModel, rest: np.ndarray, skin_faces: np.ndarray,
    look: PersonLook, rng: np.random.Generator,
) -> WornMesh:  # fmt: skip
    """Make what a head with rest vertices (V, 3) wears and holds, except for hair."""
    marks = _marks_on(model, rest)
    shade = rng.uniform(0.02, 0.35, 3)
    found = [bare()]
    if "glasses" in kinds:
        found += _glasses(marks, rng, 0.3 * shade)
    if "microphone" in kinds:
        ear, mouth = marks[0], marks[48] + (-0.012, -0.012, 0.016)
        bend = 0.5 * (ear + mouth) + (-0.015, -0.01, 0.0)
        share = np.linspace(0, 1, 24)[:, None]
        path = (1 - share) ** 2 * ear + 2 * share * (1 - share) * bend + share**2 * mouth
        ball = np.sqrt(np.maximum(1 - ((1 - share[:, 0]) / 0.14 - 1) ** 2, 0.0))
        found.append(_tube(path, np.maximum(0.0016, 0.009 * ball), np.full(3, 0.02)))
    if "mask" in kinds:
        found.append(_mask(marks, rest, skin_faces, shade + 0.3))
    if "hand" in kinds:
        found.append(_hand(look.skin, rng))
    parts = joined_arrays(found)
    order = np.argsort(parts["material"] == Material.LENS, kind="stable")
    return WornMesh(**parts | {name: parts[name][order] for name in ("faces", "material")})


def grow_worn(
    kinds: tuple[str, ...], model: HeadModel, rest: np.ndarray, scalp: np.ndarray, star: StarMap,
    look: PersonLook, detail: float, seed: list[int],
) -> list[HairMesh]:  # fmt: skip
    """Grow beards, moustaches and fringes on a head with rest vertices (V, 3)."""
    marks = _marks_on(model, rest)
    x, y, z = rest.T
    nose, lip, mouth, chin = marks[33], marks[51], marks[[48, 54]].mean(0), marks[8]
    cheek = np.abs(x - mouth[0]) / 0.06
    face = (model.regions["face"] & ~model.regions["lips"]).numpy()
    line = mouth[1] - 0.012 + 0.05 * np.maximum(cheek - 0.55, 0.0)
    areas = {
        "beard": smoothstep(y, line + 0.006, line - 0.004)
        * smoothstep(y, chin[1] - 0.03, chin[1] - 0.01) * smoothstep(z, -0.02, 0.01) * face,
        "moustache": np.exp(-(((x - nose[0]) / 0.024) ** 4))
        * (y < nose[1] - 0.003) * (y > lip[1]) * (z > mouth[2] - 0.02) * face,
        "fringe": scalp * smoothstep(z, np.quantile(z[scalp > 0.5], 0.6), z[scalp > 0.5].max())
        * (np.abs(x) < 0.055),
    }  # fmt: skip
    lengths = {"beard": 0.022, "moustache": 0.014, "fringe": 0.085}
    grown = []
    for kind in [name for name in HAIRY if name in kinds]:
        rng = np.random.default_rng([*seed, HAIRY.index(kind)])
        style = replace(look, hair_style=kind, hair_length_m=lengths[kind])
        faces = model.faces.numpy()
        grown.append(
            grow_hair(rng, rest, faces, areas[kind], star, style, detail, kind == "fringe")
        )
    return grown


def hold(
    worn: WornMesh, heads: Callable[[int], tuple[np.ndarray, np.ndarray]], model: HeadModel,
    cues: tuple[tuple[str, int, int], ...], peaks: dict[str, int], count: int, seed: list[int],
) -> np.ndarray:  # fmt: skip
    """Draw the hand's pose in every frame: (F, 4, 4), rest head space from hand space.

    ``heads`` returns the vertices and normals (V, 3) of a frame with the skull at rest.
    """
    poses = np.tile(np.eye(4), (count, 1, 1))
    own = worn.vertices[worn.moves == WITH_HAND].astype(float)
    if not len(own):
        return poses
    skin = (model.regions["face"] | model.regions["neck"]).numpy()
    for name, first, last in cues:
        rng = np.random.default_rng([*seed, *name.encode()])
        vertices, normals = heads(peaks[name])
        marks = _marks_on(model, vertices)
        mirror = rng.choice([-1.0, 1.0])
        side = 54 if mirror > 0 else 48  # the corner of the mouth nearer to the hand
        target = marks[[[side, 33], [side, 8], [side, 57], [side, 27]][rng.integers(4)]].mean(0)
        near = np.argmin(((vertices - target) ** 2).sum(1) + 1e3 * ~skin)
        # The palm lies on the skin; fingers point up and across the face.
        out = normals[near] + np.array([0, 0, 0.6])
        out[1] = min(out[1], 0.0)  # the arm hangs down
        out /= np.linalg.norm(out)
        lean = rng.uniform(0.15, 0.8)
        along = np.array([-mirror * np.sin(lean), np.cos(lean), 0.0])
        along -= out * (along @ out)
        along /= np.linalg.norm(along)
        turn = np.stack([np.cross(along, out), along, out], axis=1)
        place = vertices[near] + 0.02 * out - 0.03 * along
        tree, clearance = cKDTree(vertices[skin]), rng.uniform(0.001, 0.012)
        for _ in range(4):  # move it to the clearance off the skin
            gap, which = tree.query(own @ turn.T + place)
            above = ((own @ turn.T + place - vertices[skin][which]) * normals[skin][which]).sum(1)
            close = gap < 0.03
            if close.any():
                place = place + (clearance - above[close].min()) * out
        poses[first : last + 1] = make_transform(turn, place)
    return poses


def _marks_on(model: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """Return the landmarks (68, 3) of a head with these vertices (V, 3)."""
    return landmarks_of(model, vertices.astype(np.float32)).astype(np.float64)


def _tube(path: np.ndarray, radius: np.ndarray | float, colour: np.ndarray, closed: bool = False):
    """Make a round rod along points (n, 3)."""
    sides, count = 8, len(path)
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    ahead = unit(ahead)
    helper = np.where(np.abs(ahead[:, 1:2]) < 0.8, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    across = unit(np.cross(helper, ahead))
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * np.cross(ahead, across)[:, None]
    vertices = path[:, None] + np.broadcast_to(radius, count)[:, None, None] * ring
    return _sheet(vertices, colour, Material.APPAREL, (closed, True))


def _sheet(
    grid: np.ndarray, colour: np.ndarray, material: Material, closed: tuple[bool, bool]
) -> WornMesh:
    """Make a sheet from a grid (n, k, 3), closed along n and k if asked."""
    n, k = grid.shape[:2]
    index = np.pad(np.arange(n * k).reshape(n, k), [(0, int(c)) for c in closed], mode="wrap")
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([c, b, d], -1)]).reshape(-1, 3)
    return WornMesh(
        vertices=grid.reshape(-1, 3).astype(np.float32), faces=faces.astype(np.int32),
        material=np.full(len(faces), material, np.uint8),
        colours=np.broadcast_to(colour, (n * k, 3)).astype(np.float32),
        moves=np.full(n * k, WITH_SKULL, np.int32),
    )  # fmt: skip


def _glasses(marks: np.ndarray, rng: np.random.Generator, colour: np.ndarray) -> list[WornMesh]:
    """Make frames, and lenses, each between two spheres."""
    size = rng.uniform([0.022, 0.017], [0.027, 0.022])
    square, lift = rng.uniform(0.6, 1.0), rng.uniform(0.013, 0.017)
    rings, bridge, temples = glasses_lines(marks, size, square, lift)
    thick = rng.uniform(0.0013, 0.0024)
    found = [_tube(ring, thick, colour, closed=True) for ring in rings]
    # Bars need many points, or their ends would bend.
    found += [_tube(line, 0.8 * thick, colour) for line in (bridge, *temples)]
    for ring in rings:
        middle = ring.mean(0)
        arms = ring - middle
        ahead = np.linalg.svd(arms)[2][2]
        ahead = ahead * np.sign(ahead[2])
        shares = np.linspace(1.0, 0.0, 8)[:, None, None]
        flat = middle + shares * arms
        square_m = ((shares * arms) ** 2).sum(-1, keepdims=True)
        edge = square_m.max()
        for radius, shift, flip in ((FRONT_M, LENS_M, False), (BACK_M, 0.0, True)):
            rise = _sag(FRONT_M, edge) + shift - _sag(radius, square_m)
            sheet = _sheet(flat + rise * ahead, np.ones(3), Material.LENS, (False, True))
            outwards = vertex_normals(sheet.vertices, sheet.faces)[:RING].mean(0) @ ahead > 0
            turned = sheet.faces[:, ::-1] if outwards == flip else sheet.faces
            found.append(replace(sheet, faces=turned))
    return found


def _sag(radius: float, square: np.ndarray) -> np.ndarray:
    """Return how far a sphere recedes at squared distances from its axis, metres."""
    return radius - np.sqrt(radius**2 - square)


def _mask(
    marks: np.ndarray, rest: np.ndarray, skin_faces: np.ndarray, colour: np.ndarray
) -> WornMesh:
    """Make a cloth over nose, mouth and chin, which follows the skin below."""
    middle = marks[[4, 12]].mean(0)
    heights = np.linspace(marks[28, 1], marks[8, 1] - 0.008, 24)
    bearing = np.linspace(-1.15, 1.15, 40)
    out = np.stack([np.sin(bearing), 0 * bearing, np.cos(bearing)], axis=1)
    start = np.stack([0 * heights, heights, 0 * heights + middle[2]], axis=1)[:, None] + 0.3 * out
    towards = np.broadcast_to(-out, start.shape).reshape(-1, 3)
    distance, _, _ = Caster(rest, skin_faces).cast(start.reshape(-1, 3), towards)
    radius = 0.3 - np.minimum(distance, 0.3).reshape(start.shape[:2])
    # Cloth spans hollows and keeps a distance from the skin.
    spanned = gaussian_filter(maximum_filter(radius, 7, mode="nearest"), 1.5, mode="nearest")
    grid = start + (np.maximum(spanned, radius) + 0.003 - 0.3)[..., None] * out
    mesh = _sheet(grid, colour, Material.APPAREL, (False, False))
    skin = np.unique(skin_faces)
    near = cKDTree(rest[skin]).query(mesh.vertices)[1]
    return replace(mesh, moves=skin[near].astype(np.int32))


def _hand(skin: np.ndarray, rng: np.random.Generator) -> WornMesh:
    """Make a hand and its arm, as a level set of rounded bones that merge smoothly."""
    ends = _BONES.reshape(-1, 4)[:, :3]
    low, high = ends.min(0) - 0.045, ends.max(0) + 0.045
    low[1] = -0.40
    axes = [np.arange(a, b, HAND_CELL_M) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
    total = np.zeros(points.shape[:3], np.float32)
    for bone in _BONES.astype(np.float32):
        start, along = bone[:3], bone[4:7] - bone[:3]
        share = np.clip((points - start) @ along / (along @ along), 0, 1)
        reach = np.linalg.norm(points - start - share[..., None] * along, axis=-1)
        total += np.exp((bone[3] + (bone[7] - bone[3]) * share - reach) / 0.0022)
    vertices, faces, _, _ = marching_cubes(total, 1.0, spacing=(HAND_CELL_M,) * 3)
    vertices, faces = (vertices + low).astype(np.float32), faces[:, ::-1].astype(np.int32)
    grain = noise(vertices / 0.004, make_lattice(rng)) + noise(vertices / 0.012, make_lattice(rng))
    tone = skin * rng.uniform(0.85, 1.1) * (1.0 + 0.09 * grain[:, None] * (0.6, 1.0, 1.0))
    return WornMesh(
        vertices=vertices, faces=faces, material=np.full(len(faces), Material.HAND, np.uint8),
        colours=tone.astype(np.float32), moves=np.full(len(vertices), WITH_HAND, np.int32),
    )  # fmt: skip
