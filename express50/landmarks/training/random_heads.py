"""Make random heads to train the landmark detector on: shape, expression, pose, skin, hair.

Shapes, skins, hair and light vary far more than in reality, so that the detector learns where
things are on a face and not how one renderer or head model draws them. Most skins are still
realistic. Most heads show entries of the 60-expression script, weaker, stronger, lopsided or two
at once; the others move random muscles, so that unscripted expressions occur too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import open3d as o3d
import torch

from express50.capture.expressions import Expression, load_script
from express50.geometry.raycast import barycentrics, mesh_scene
from express50.head.model import (
    HeadModel,
    in_regions,
    landmarks,
    landmarks_of,
    pose,
    vertex_normals,
)
from express50.landmarks.network import INNER_LIPS

BROWS = slice(17, 27)
SCRIPTED_SHARE = 0.6  # share of the heads that show entries of the script
LASHES = "eyelashes"
BLINKS = 0.22  # share of the heads that close one eye or both
SHUT, TEETH = 0.3, 0.75  # of drawn mouths: share that is shut; share that is shut or shows teeth
Rng = np.random.Generator
INSIDE = (
    "teeth", "tongue", "mouth_interior", "left_eyeball", "right_eyeball", "left_iris", "right_iris",
    "boundary",
)  # fmt: skip
Places = tuple[np.ndarray, np.ndarray]  # faces (N,), weights (N, 3)


@dataclass(frozen=True)
class RandomHead:
    """One random head."""

    vertices: np.ndarray  # (V, 3)
    normals: np.ndarray  # (V, 3)
    skin: np.ndarray  # (V, 3) vertices without hair
    landmarks: np.ndarray
    canvas: Canvas
    look: int  # seed of its colours, painted on the canvas where a view sees it
    gloss: float


@dataclass(frozen=True)
class Canvas:
    """Places on a head that `paint` colours."""

    rest: np.ndarray  # (N, 3) metres, on the head at rest
    region: dict[str, np.ndarray]  # by name, which of the places are in it, (N,) bool
    marks: np.ndarray  # (68, 3) landmarks of the head at rest
    top: float | None = None  # height of the crown; None: of the highest place
    eyes: dict[str, np.ndarray] | None = None  # the eyeballs' centres; None: of their places

    @classmethod
    def of(cls, model: HeadModel) -> Canvas:
        """Make a canvas of a head model's vertices."""
        region = {name: mask.numpy() for name, mask in model.regions.items()}
        marks = landmarks_of(model)
        rest = model.template.numpy()
        eyes = {side: rest[region[f"{side}_eyeball"]].mean(0) for side in ("left", "right")}
        return cls(rest, region, marks, float(rest[:, 1].max()), eyes)

    def at(self, faces: np.ndarray, weights: np.ndarray) -> Canvas:
        """Return the places at weights (N, 3) of faces (N, 3), for a canvas of vertices."""
        nearest = np.take_along_axis(faces, weights.argmax(1)[:, None], 1)[:, 0]
        region = {name: mask[nearest] for name, mask in self.region.items()}
        # Interpolated, so that the rim of the lips is smoother than the triangles.
        lips = (self.region["lips"][faces] * weights).sum(1) > 0.5
        region["face"] = (region["face"] | region["lips"]) & ~lips
        region["lips"] = lips
        rest = (self.rest[faces] * weights[..., None]).sum(1)
        return replace(self, rest=rest.astype(np.float32), region=region)


def random_head(
    model: HeadModel, rng: Rng, blinks: float = BLINKS, mouths: float = 0.0
) -> RandomHead:
    """Draw shape, expression, pose, smooth deformation, hair and colours.

    A share `blinks` of the heads close one eye or both, more or less far. A share `mouths` shut
    their lips, part them a little or show their teeth.
    """
    draw = random_parameters(model, rng, blinks, mouths)
    with torch.no_grad():
        vertices = pose(model, **draw)
    vertices = torch.from_numpy(deform(vertices[0].numpy(), rng))[None]
    canvas = Canvas.of(model)
    marks = canvas.marks.copy()
    # People's brows lie differently on the bone, so the detector must learn to see the hairs.
    brows = marks[BROWS]
    outwards = np.sign(brows[:, 0])
    along = (np.abs(brows[:, 0]) - np.abs(brows[:, 0]).min()) / np.ptp(np.abs(brows[:, 0]))
    brows[:, 0] += outwards * (rng.normal() * 0.002 + along * rng.normal() * 0.003)
    brows[:, 1] += rng.normal() * 0.004 + (along - 0.5) * rng.normal() * 0.004
    brows[:, 1] += outwards * rng.normal() * 0.0007
    places = closest_places(model, brows)
    marks[BROWS] = place_points(model, places)
    canvas = replace(canvas, marks=marks)
    points = landmarks(model, vertices)[0].numpy()
    points[BROWS] = place_points(model, places, vertices[0].numpy())
    # Inner lips that passed through each other are put where they meet.
    upper, lower = (list(ids) for ids in INNER_LIPS)
    through = (points[upper] - points[lower]) @ (points[27] - points[8]) < 0
    middle = 0.5 * (points[upper] + points[lower])
    for ids in (upper, lower):
        points[ids] = np.where(through[:, None], middle, points[ids])
    look = int(rng.integers(2**31))
    hair = paint(canvas, np.random.default_rng(look))[1]
    skin = vertices[0].numpy()
    normals = vertex_normals(vertices, model.faces)
    if hair is not None:
        vertices = vertices + normals * torch.from_numpy(hair)[None, :, None]
        normals = vertex_normals(vertices, model.faces)
    gloss = float(rng.uniform(0.0, 0.5))
    return RandomHead(vertices[0].numpy(), normals[0].numpy(), skin, points, canvas, look, gloss)


def waves(points: np.ndarray, rng: Rng, count: int, low: float, high: float) -> np.ndarray:
    """Draw a smooth field (N,), about unit variance, wave numbers low..high radians per metre."""
    directions = rng.normal(size=(count, 3))
    directions *= (np.exp(rng.uniform(np.log(low), np.log(high), count)))[:, None] / (
        np.linalg.norm(directions, axis=1, keepdims=True)
    )
    phases = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    # In single precision, because sines of doubles take eighty times as long.
    angles = points.astype(np.float32) @ directions.T.astype(np.float32) + phases
    return np.sin(angles).sum(1) * np.float32(np.sqrt(2.0 / count))


def deform(vertices: np.ndarray, rng: Rng) -> np.ndarray:
    """Scale each axis and add a smooth random displacement of a few millimetres."""
    centre = vertices.mean(0)
    scaled = (vertices - centre) * rng.uniform(0.9, 1.1, size=3) * rng.uniform(0.9, 1.1)
    amplitude = rng.uniform(0.0, 0.003)
    moved = np.stack([waves(vertices, rng, 6, 15.0, 60.0) for _ in range(3)], axis=1)
    return (scaled + centre + amplitude * moved).astype(np.float32)


def paint(canvas: Canvas, rng: Rng) -> tuple[np.ndarray, np.ndarray | None]:
    """Draw colours (N, 3) in [0, 1], and the thickness (N,), metres, of hair or None."""
    rest, region, marks = canvas.rest, canvas.region, canvas.marks
    if rng.random() < 0.1:  # any colour, else from dark to pale
        skin = rng.uniform(0.15, 0.95, 3)
    else:
        tones = np.array(
            [[0.26, 0.17, 0.13], [0.62, 0.43, 0.32], [0.85, 0.66, 0.55], [0.95, 0.80, 0.73]]
        )
        place = rng.uniform(0.0, 3.0)
        shade = [np.interp(place, range(4), channel) for channel in tones.T]
        skin = np.clip(shade * rng.uniform(0.9, 1.1, 3), 0.05, 1.0)
    colors = np.tile(skin, (len(rest), 1))
    # Lashes and what is in no region, a small part behind the lids, become dark.
    nothing = ~np.any([mask for name, mask in region.items() if name != LASHES], axis=0)
    for most, count, low, high in ((0.15, 12, 20.0, 150.0), (0.12, 24, 150.0, 900.0)):
        spots = most * rng.beta(1.0, 3.0) * waves(rest, rng, count, low, high)
        colors *= 1 + spots[:, None]
    middle, radius = marks[[2, 14, 30, 8]][rng.integers(4)], rng.uniform(0.02, 0.05)
    blush = np.exp(-((rest - middle) ** 2).sum(1) / radius**2)
    colors = _mix(colors, rng.uniform(0.2, 1.0, 3), blush * rng.uniform(0, 0.3))
    _tint_features(colors, canvas, skin, rng)
    colors[nothing] = rng.uniform(0.02, 0.25)
    hair = _grow_hair(colors, canvas, rng)
    _tint_beard(colors, canvas, rng)
    _color_eyes_and_mouth(colors, canvas, rng)
    return np.clip(colors, 0.0, 1.0).astype(np.float32), hair


def _mix(colors: np.ndarray, color: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return colors + (color - colors) * amount[:, None]


def _tint_features(colors: np.ndarray, canvas: Canvas, tone: np.ndarray, rng: Rng) -> None:
    """Paint lips, brows and eye make-up, in place."""
    rest, region, marks = canvas.rest, canvas.region, canvas.marks
    lips = region["lips"].astype(float) * rng.uniform(0.0, 0.9)
    colors[:] = _mix(colors, colors * rng.uniform([0.7, 0.3, 0.3], [1.2, 0.9, 0.9]), lips)
    brow_color = rng.uniform(0.0, 0.5) * np.array([1.0, rng.uniform(0.5, 1), rng.uniform(0.3, 1)])
    brow_color = np.minimum(brow_color, rng.uniform(0.1, 0.7) * tone)
    skin = np.flatnonzero(region["face"])
    width = rng.uniform(0.0035, 0.0075)  # the line through the marks is slightly below the skin
    taper = rng.uniform(0.0, 0.6)
    strength = rng.choice([0.0, rng.uniform(0.45, 1.0)], p=[0.05, 0.95])
    for line in (marks[17:22], marks[26:21:-1]):
        # The polyline from the outer end; it is shortened so that hairs end at the marks.
        line = line.copy()
        for end, beside in ((0, 1), (-1, -2)):
            inwards = line[beside] - line[end]
            line[end] += inwards * min(0.5, 0.6 * width / np.linalg.norm(inwards))
        start, along = line[:-1], np.diff(line, axis=0)
        relative = rest[skin][:, None] - start[None]
        share = (relative * along).sum(2) / np.maximum((along**2).sum(1), 1e-12)
        off = np.linalg.norm(relative - np.clip(share, 0, 1)[..., None] * along, axis=2)
        place = (np.abs(rest[skin, 0]) - abs(line[-1, 0])) / abs(line[0, 0] - line[-1, 0])
        ragged = 1 + 0.4 * waves(rest[skin], rng, 8, 300.0, 1500.0)
        ragged *= 1 - taper * np.clip(place, 0.0, 1.0)
        hairs = np.clip(1 + rng.uniform(0, 0.7) * waves(rest[skin], rng, 12, 1e3, 4e3), 0.0, 1.0)
        inside = np.clip((off.min(1) - width * ragged) / 0.001, -30.0, 30.0)
        amount = strength * hairs / (1 + np.exp(inside))
        colors[skin] = _mix(colors[skin], brow_color, amount)
    for side in ("left", "right"):
        shade = region[f"{side}_eye_region"] * rng.uniform(0.0, 0.4)
        colors[:] = _mix(colors, rng.uniform(0.0, 0.8, 3), shade)


def _grow_hair(colors: np.ndarray, canvas: Canvas, rng: Rng) -> np.ndarray | None:
    """Paint hair above a tilted plane, in place; return its thickness (N,), None if bald."""
    if rng.random() < 0.3:
        return None
    rest, region, marks = canvas.rest, canvas.region, canvas.marks
    brows, crown = marks[17:27, 1].max(), rest[:, 1].max() if canvas.top is None else canvas.top
    front = np.array([0.0, brows + rng.uniform(0.15, 0.8) * (crown - brows), marks[27, 2]])
    tilt = rng.uniform(0.2, 1.25)
    height = (rest - front) @ np.array([0.0, np.cos(tilt), -np.sin(tilt)])
    height += 0.006 * waves(rest, rng, 10, 40.0, 300.0)
    keep = np.zeros(len(rest))
    keep[region["scalp"] | region["forehead"] | region["neck"]] = 1.0
    keep[region["neck"] & (rest[:, 1] < marks[8, 1] - 0.03)] = 0.0
    amount = keep / (1 + np.exp(-height / 0.004))
    hair_color = rng.uniform(0.02, 0.75) * np.array([1.0, rng.uniform(0.6, 1), rng.uniform(0.3, 1)])
    strands = 1 + 0.4 * waves(rest, rng, 30, 200.0, 1500.0)
    colors[:] += (hair_color * strands[:, None] - colors) * amount[:, None]
    thickness = rng.uniform(0.0, 0.03) * (1 + 0.4 * waves(rest, rng, 10, 30.0, 200.0))
    return (amount * np.maximum(thickness, 0.0)).astype(np.float32)


def _tint_beard(colors: np.ndarray, canvas: Canvas, rng: Rng) -> None:
    """Paint stubble, moustache, chin or full beard, in place."""
    kind = rng.choice(["none", "full", "chin", "moustache"], p=[0.55, 0.25, 0.1, 0.1])
    if kind == "none":
        return
    rest, region, marks = canvas.rest, canvas.region, canvas.marks
    below = 1 / (1 + np.exp((rest[:, 1] - marks[33, 1] + rng.uniform(0, 0.02)) / 0.003))
    cheek = 1 / (1 + np.exp((marks[33, 2] - rng.uniform(0.02, 0.09) - rest[:, 2]) / 0.004))
    if kind == "chin":
        below = 1 / (1 + np.exp((rest[:, 1] - marks[57, 1] + rng.uniform(0, 0.01)) / 0.003))
    if kind == "moustache":
        middle, size = (marks[33] + marks[51]) / 2, rng.uniform([0.018, 0.006], [0.032, 0.011])
        below = np.exp(-((((rest - middle)[:, :2] / size) ** 2).sum(1) ** 2))
    amount = below * cheek * (region["face"] & ~region["lips"]) * rng.uniform(0.2, 0.95)
    grain = 1 + 0.5 * waves(rest * (1.0, 0.4, 1.0), rng, 20, 400.0, 3000.0)
    shade = rng.uniform(0.0, 0.4 if rng.random() < 0.8 else 0.9) * np.ones(3)
    colors[:] = _mix(colors, shade * rng.uniform([1, 0.8, 0.6], 1), np.clip(amount * grain, 0, 1))


def _color_eyes_and_mouth(colors: np.ndarray, canvas: Canvas, rng: Rng) -> None:
    """Paint sclera, iris, pupil, teeth and mouth cavity, in place."""
    rest, region = canvas.rest, canvas.region
    iris = rng.uniform(0.05, 0.7) * rng.uniform([0.4, 0.5, 0.3], 1)
    sclera = rng.uniform(0.6, 1.0) * np.array([1.0, rng.uniform(0.9, 1), rng.uniform(0.85, 1)])
    for side in ("left", "right"):
        ball = region[f"{side}_eyeball"]
        colors[ball] = sclera
        arm = rest[ball] - (rest[ball].mean(0) if canvas.eyes is None else canvas.eyes[side])
        angle = np.arccos(np.clip(arm[:, 2] / np.linalg.norm(arm, axis=1), -1, 1))
        edge = rng.uniform(0.42, 0.55)
        colors[np.flatnonzero(ball)[angle < edge]] = iris * rng.uniform(0.4, 1.0)
        colors[np.flatnonzero(ball)[angle < 0.85 * edge]] = iris
        colors[np.flatnonzero(ball)[angle < rng.uniform(0.15, 0.28)]] = 0.02
    inside = region["mouth_interior"] | region["tongue"]
    colors[inside] = rng.uniform(0.05, 0.5) * np.array([1.0, *rng.uniform(0.3, 0.8, 2)])
    colors[region["teeth"]] = rng.uniform(0.5, 1.0) * np.array([1.0, 0.97, rng.uniform(0.8, 1.0)])


def random_parameters(
    model: HeadModel, rng: Rng, blinks: float = BLINKS, mouths: float = 0.0
) -> dict[str, torch.Tensor]:
    """Draw the arguments of `express50.head.model.pose` for a batch of one."""
    shape = rng.normal(size=len(model.shape_names)) * rng.uniform(0.5, 1.4)
    jaw = rng.normal(size=3) * np.array([0.03, 0.03, 0.02])
    neck = rng.normal(size=3) * 0.15
    gaze = rng.normal(size=2) * np.array([0.2, 0.3])
    expression = np.zeros(len(model.expression_names))
    if not model.unit_expressions:
        expression = rng.normal(size=len(expression))
    elif rng.random() < SCRIPTED_SHARE:
        script = load_script()
        for number in rng.integers(len(script), size=1 + int(rng.random() < 0.25)):
            strength = rng.uniform(0.3, 1.15)
            expression += strength * _lopsided(script[number], model, rng)
            jaw += strength * np.array(script[number].jaw)
            gaze += strength * np.array([-script[number].gaze[1], script[number].gaze[0]])
    else:
        # Up to eight random directions, weak ones likelier than strong ones.
        count = len(expression)
        active = rng.choice(count, size=rng.integers(0, min(9, count + 1)), replace=False)
        expression[active] = rng.beta(1.0, 1.2, size=active.size)
    if model.unit_expressions:
        _close_eyes(expression, model, rng, blinks)
        expression = np.clip(expression, -1.0, 1.2)
    if rng.random() < 0.25:
        jaw[0] = rng.uniform(0.0, 0.65)  # up to a scream
    if model.unit_expressions and mouths and rng.random() < mouths:
        _draw_mouth(expression, jaw, model, rng)
    eyes = np.array([*gaze, 0.0, *gaze, 0.0])
    drawn = {"shape": shape, "expression": expression, "neck": neck, "jaw": jaw, "eyes": eyes}
    return {name: torch.from_numpy(v.astype(np.float32))[None] for name, v in drawn.items()}


def _lopsided(entry: Expression, model: HeadModel, rng: Rng) -> np.ndarray:
    """Return coefficients (X,) of a script entry; in some draws one side of the face is weaker."""
    sides = {"_L": 1.0, "_R": 1.0}
    if rng.random() < 0.3:
        sides[("_L", "_R")[rng.integers(2)]] = rng.uniform(0.0, 1.0)
    names = {name: column for column, name in enumerate(model.expression_names)}
    out = np.zeros(len(names))
    for name, value in entry.controls.items():
        gain = sides.get(name[-2:], 1.0) * rng.normal(1.0, 0.15)
        if name in names:
            out[names[name]] = gain * value
    return out


def _close_eyes(expression: np.ndarray, model: HeadModel, rng: Rng, share: float) -> None:
    """Close both eyes in some draws, one in others, in place."""
    kind = rng.random()
    if kind > share:
        return
    least = 0.6 if share == BLINKS else 0.0
    sides = "LR" if kind < 0.45 * share else "LR"[rng.integers(2)]
    for side in sides:
        name = f"eyeBlink_{side}"
        if name in model.expression_names:
            expression[model.expression_names.index(name)] = rng.uniform(least, 1.0)


def _draw_mouth(expression: np.ndarray, jaw: np.ndarray, model: HeadModel, rng: Rng) -> None:
    """Shut the lips, show the teeth, or open the jaw a little, in place."""
    kind, names = rng.random(), model.expression_names
    jaw[0] = 0.0 if kind < SHUT else rng.uniform(0.0, 0.15 if kind < TEETH else 0.3)
    if kind >= TEETH:
        return
    moves = [k for k, name in enumerate(names) if name.startswith(("mouth", "jaw", "tongue"))]
    expression[moves] *= 0.3 * rng.random() if kind < SHUT else 0.0
    opening = ("mouthUpperUp", "mouthLowerDown", "mouthFunnel", "tongueOut")
    for name in opening if kind < SHUT else ():
        expression[[k for k in moves if names[k].startswith(name)]] = 0.0
    showing = {"mouthUpperUp": 1.0, "mouthLowerDown": 1.0, "mouthSmile": 1.0, "mouthStretch": 0.6}
    for name, most in showing.items() if kind >= SHUT else ():
        expression[[k for k in moves if names[k].startswith(name)]] = rng.uniform(0.0, most)


@lru_cache(maxsize=4)
def _skin(model: HeadModel) -> tuple[o3d.t.geometry.RaycastingScene, np.ndarray]:
    """Return the skin of a head model at rest as a scene, and the ids of its faces."""
    faces = model.faces.numpy()
    skin = np.flatnonzero(~in_regions(model, INSIDE)[faces].any(1))
    return mesh_scene(model.template.numpy(), faces[skin]), skin


def closest_places(model: HeadModel, points: np.ndarray) -> Places:
    """Return the places on the skin of a head model at rest nearest to points (D, 3)."""
    scene, skin = _skin(model)
    found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    weights = barycentrics(found).astype(np.float32)
    return skin[found["primitive_ids"].numpy()], weights


def place_points(
    model: HeadModel, places: Places, vertices: np.ndarray | None = None
) -> np.ndarray:
    """Return the points (D, 3) at places of a head model with vertices (V, 3), or at rest."""
    mesh = model.template.double().numpy() if vertices is None else vertices
    return (mesh[model.faces.numpy()[places[0]]] * places[1][..., None]).sum(1)
