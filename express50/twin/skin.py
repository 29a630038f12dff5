"""Paint skin as a texture over directions from the head's centre.

A place on the mean head is looked up by its azimuth and elevation, not in the head model's UV map,
so that any head model can be painted. Hidden places (nostrils, the back of the ear) have the colour
of the surface in front of them.

If `twin.personal` is above 0, the skin changes from frame to frame: folds darken and brighten where
a muscle gathers it, and effort reddens or pales it. The model that the stages fit has none of this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from express50.geometry.conventions import cell_centres, cell_to_corner, corner_to_cell
from express50.geometry.sampling import smoothstep
from express50.head.model import HeadModel, landmarks_of
from express50.twin.body import Body, model_materials
from express50.twin.surface import (
    MISS,
    Caster,
    Material,
    fractal,
    make_lattice,
    noise,
    sample_panorama,
    smooth_over_mesh,
    spherical_to_unit,
    spot,
    unit_to_spherical,
)


@dataclass(frozen=True, kw_only=True)
class SkinTexture:
    """Colour and gloss by direction: (H, W, 4) float32, linear light and a factor."""

    pixels: np.ndarray
    centre: np.ndarray


def texture_width(image_short_side: int) -> int:
    """Return the number of texels around the head, each about as wide as a pixel of the images."""
    wanted = 2 * np.pi * 0.1 / 0.43 * image_short_side * 1.2
    return int(np.clip(2 ** np.ceil(np.log2(wanted)), 256, 4096))


def sample_skin(texture: SkinTexture, points: np.ndarray) -> np.ndarray:
    """Sample the texture (N, 4) bilinearly at places (N, 3) on the mean head."""
    height, width = texture.pixels.shape[:2]
    az, el = unit_to_spherical(points - texture.centre.astype(np.float32))
    x = corner_to_cell((az * np.float32(0.5 / np.pi) + np.float32(0.5)) * width)
    y = corner_to_cell((el * np.float32(1.0 / np.pi) + np.float32(0.5)) * height)
    y = np.clip(y, 0, np.float32(height - 1.01))
    return sample_panorama(texture.pixels, x, y)


def paint_skin(body: Body, seed: int, width: int) -> SkinTexture:
    """Paint one subject's texture, ``width`` texels around."""
    height = width // 2
    step = max(1, 262_144 // width)
    bands = [
        _paint_rows(body, seed, width, range(y, min(y + step, height)))
        for y in range(0, height, step)
    ]
    pixels = np.concatenate(bands).reshape(height, width, 4)
    return SkinTexture(pixels=pixels, centre=body.centre)


def _paint_rows(body: Body, seed: int, width: int, rows: range) -> np.ndarray:
    """Paint the texels (N, 4) of some rows."""
    model, look = body.model, body.subject.look
    points, masks = _surface_at(body, width, rows)
    marks = landmarks_of(model).astype(np.float64)
    rng = np.random.default_rng([seed, body.subject.number, 8])
    lattices = [make_lattice(rng) for _ in range(6)]
    albedo = np.broadcast_to(look.skin.astype(np.float32), points.shape).copy()
    tone = fractal(points, lattices[0], 0.030, 4, 0.55)
    albedo *= 1.0 + 0.085 * tone[:, None] * np.array([0.6, 1.0, 1.1], np.float32)
    flush = look.flush * _flush(model, marks, points)
    flush = flush * (0.7 + 0.5 * noise(points / 0.012, lattices[1]))
    albedo *= 1.0 + flush[:, None] * np.array([0.02, -0.25, -0.22], np.float32)
    pores = fractal(points, lattices[2], 0.0022, 2, 0.7)
    albedo *= 1.0 + 0.05 * pores[:, None]
    spots = smoothstep(fractal(points, lattices[3], 0.0032, 2, 0.35), 0.48, 0.85)
    where = masks["face"] * smoothstep(noise(points / 0.02, lattices[4]), -0.4, 0.3)
    albedo *= 1.0 - look.freckles * (spots * where)[:, None] * np.array([0.22, 0.34, 0.40])
    places = model.template.numpy()[(model.regions["face"] | model.regions["neck"]).numpy()]
    for mole in places[rng.integers(0, len(places), look.moles)]:
        radius = rng.uniform(0.0007, 0.0018)
        inside = smoothstep(np.linalg.norm(points - mole, axis=1), 1.25 * radius, 0.75 * radius)
        albedo = albedo * (1.0 - inside[:, None] * np.array([0.55, 0.65, 0.7]))
    brow = 0.5 * (marks[21] + marks[22]) + np.array([0.0, 0.03, 0.0])
    oily = spot(points, brow, 0.03) + spot(points, 0.5 * (marks[28] + marks[30]), 0.014)
    gloss = look.gloss * (1.0 + 0.25 * pores) * (0.8 + 0.5 * oily)
    lips = smoothstep(masks["lips"] + 0.10 * noise(points / 0.004, lattices[5]), 0.35, 0.65)
    creases = fractal(points * (1.0, 0.25, 1.0), lattices[1], 0.0025, 2)
    lip_colour = look.lips * (1.0 + 0.12 * creases)[:, None]
    albedo += lips[:, None] * (lip_colour - albedo)
    gloss += lips * 1.3
    hairs = _hairiness(body, marks, points, masks, lattices)
    albedo += hairs[:, None] * (look.hair * 0.8 + 0.01 - albedo)
    gloss = gloss * (1 - 0.8 * hairs)
    return np.concatenate([albedo, gloss[:, None]], axis=1).astype(np.float32)


def _surface_at(body: Body, width: int, rows: range) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the places (N, 3) on the mean head of the texels of some rows, and masks there."""
    model = body.model
    az = cell_centres(width) / width * 2 * np.pi - np.pi
    el = cell_to_corner(np.array(rows)) / (width // 2) * np.pi - 0.5 * np.pi
    out = spherical_to_unit(*np.meshgrid(az, el)).reshape(-1, 3)
    faces = model.faces.numpy()
    faces = faces[model_materials(model)[faces].min(1) == Material.SKIN]
    distance, face, bary = Caster(body.template, faces).cast(body.centre + out, -out)
    # A hit beyond the centre came in through the open neck and struck the skull from inside.
    hit = (face != MISS) & (distance < 1.0)
    corners = faces[np.where(hit, face, 0)]
    weights = np.column_stack([1 - bary.sum(1), bary])

    def at(values: np.ndarray) -> np.ndarray:
        return np.where(hit, (values[corners] * weights).sum(1), 0.0).astype(np.float32)

    points = body.centre + out * np.where(hit, 1.0 - distance, 0.1)[:, None]
    masks = {
        name: at(smooth_over_mesh(model.regions[name].numpy().astype(np.float32), faces, 1))
        for name in ("lips", "face")
    }
    masks["scalp"] = at(body.scalp)
    return points.astype(np.float32), masks


def _flush(model: HeadModel, marks: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the redness (N,) of cheeks, tip of the nose, chin and ears."""
    left = 0.35 * marks[46] + 0.35 * marks[14] + 0.3 * marks[54]
    right = 0.35 * marks[41] + 0.35 * marks[2] + 0.3 * marks[48]
    spots = [(left, 0.026, 1.0), (right, 0.026, 1.0), (marks[30], 0.014, 0.9),
             (marks[8], 0.018, 0.4)]  # fmt: skip
    template = model.template.numpy()
    ears = (model.regions["left_ear"] | model.regions["right_ear"]).numpy()
    for side in (1.0, -1.0):
        spots.append((template[ears & (template[:, 0] * side > 0)].mean(0), 0.02, 0.8))
    total = np.zeros(len(points), np.float32)
    for centre, radius, weight in spots:
        total += weight * spot(points, centre, radius)
    return total


def _hairiness(
    body: Body,
    marks: np.ndarray,
    points: np.ndarray,
    masks: dict[str, np.ndarray],
    lattices: list[np.ndarray],
) -> np.ndarray:
    """Return the cover (N,) by short hair without geometry: brows, stubble, roots on the scalp."""
    look = body.subject.look
    cover = np.zeros(len(points), np.float32)
    for ids in (range(17, 22), range(22, 27)):
        # Position along the brow, 0 to 1 and beyond its ends, and height above it, from the front.
        line = marks[list(ids)]
        x, first, last = points[:, 0], line[0, 0], line[-1, 0]
        beyond = (np.minimum(x - first, 0) + np.maximum(x - last, 0)) / (last - first)
        along = (np.interp(x, line[:, 0], np.linspace(0, 1, 5)) + beyond).astype(np.float32)
        if ids[0] == 17:
            along = 1.0 - along  # from the inner end outwards, on both sides
        away = np.abs(points[:, 2] - np.interp(x, line[:, 0], line[:, 2])) > 0.03
        height = points[:, 1] - np.interp(x, line[:, 0], line[:, 1])
        off = np.where(away, 1.0, height).astype(np.float32)
        thick = 0.0046 * (1.0 - 0.55 * along) * smoothstep(along, -0.06, 0.12) + 0.0006
        fibres = noise(np.stack([along * 60 + off * 900, off * 500, along * 10], 1), lattices[3])
        body_of_brow = smoothstep(np.abs(off) / thick + 0.28 * fibres, 1.25, 0.55)
        ends = smoothstep(along, -0.10, 0.02) * smoothstep(along, 1.10, 0.92)
        cover = np.maximum(cover, look.brow_density * body_of_brow * ends)
    if look.stubble > 0:
        mouth, chin, nose = marks[[48, 54]].mean(0), marks[8], marks[33]
        below = smoothstep(points[:, 1], nose[1] - 0.001, nose[1] - 0.012)
        jaw = smoothstep(points[:, 1], chin[1] - 0.035, chin[1] - 0.005)
        cheek = np.abs(points[:, 0] - mouth[0]) / 0.06
        edge = smoothstep(points[:, 1] - (mouth[1] + 0.05 * (cheek - 0.75)), 0.02, -0.004)
        front = smoothstep(points[:, 2], mouth[2] - 0.10, mouth[2] - 0.06)
        upper = np.exp(-(((points - (nose + marks[51]) / 2) / (0.022, 0.009, 0.03)) ** 2).sum(1))
        dots = smoothstep(noise(points / 0.0011, lattices[2]), -0.1, 0.5)
        area = below * jaw * front * np.maximum(edge, 1.3 * upper) * (1 - masks["lips"])
        beard = np.clip(area, 0, 1) * (0.30 + 0.35 * dots)
        cover = np.maximum(cover, look.stubble * beard)
    if look.hair_length_m > 0 and len(body.extras.hair.vertices):
        cover = np.maximum(cover, 0.85 * masks["scalp"])
    return np.clip(cover, 0.0, 1.0)


DEPTH, FLUSH = 0.35, 0.2  # strength of folds and of redness at full effort
EFFORT = 2.5  # sum of coefficients that is full effort
# Folds by the muscles that make them, on the subject's left and right.
MUSCLES = {
    "forehead": ("browInnerUp", "browOuterUp"),
    "glabella": ("browDown",),
    "crow": ("eyeSquint", "cheekSquint", "cheekRaiser", "mouthSmile"),
    "cheek": ("mouthSmile", "noseSneer", "mouthUpperUp"),
}
SIDES = {"L": 1.0, "R": -1.0}  # the subject's left is +x


@dataclass(frozen=True, kw_only=True)
class LivingSkin:
    """Light and colour of one frame's skin, over places on the mean head."""

    folds: Mapping[str, float]  # activation, 0 to 1, by name and side such as ``crow_L``
    flush: float  # how much redder the flushed places are; negative is paler
    marks: np.ndarray  # (68, 3) landmarks of the mean head
    lattice: np.ndarray  # random values that make the person's folds irregular

    def factor(self, places: np.ndarray) -> np.ndarray:
        """Return the factor (N, 3) on the skin's colour at places (N, 3) of the mean head."""
        light = np.ones(len(places), np.float32)
        for name, depth in self.folds.items():
            if depth > 0.01:
                kind, side = name.split("_")
                light *= 1 - DEPTH * depth * self._fold(kind, SIDES[side], places)
        # Cheeks, nose, forehead and chin redden.
        marks = self.marks
        spots = [(0.5 * (marks[46] + marks[54]), 0.03, 1.0), (marks[30], 0.02, 0.7),
                 (0.5 * (marks[41] + marks[48]), 0.03, 1.0), (marks[8], 0.025, 0.4),
                 (marks[27] + [0, 0.04, 0], 0.04, 0.5)]  # fmt: skip
        total = np.zeros(len(places), np.float32)
        for centre, radius, weight in spots:
            total += weight * spot(places, centre, radius).astype(np.float32)
        red = self.flush * np.minimum(total, 1.0)
        tint = np.stack([0.15 * red, -red, -0.85 * red], 1)
        return (light[:, None] * (1 + FLUSH * tint)).astype(np.float32)

    def _fold(self, kind: str, side: float, places: np.ndarray) -> np.ndarray:
        """Return the darkness (N,) of folds, negative on the ridges beside them."""
        marks, wander = self.marks, noise(places / 0.012, self.lattice)
        x, y = side * places[:, 0], places[:, 1]
        ends = np.array([side, 1.0, 1.0])
        front = smoothstep(places[:, 2], marks[27, 2] - 0.07, marks[27, 2] - 0.04)
        brow, eye, mouth = (marks[i] * ends for i in ((24, 45, 54) if side > 0 else (19, 36, 48)))
        if kind == "forehead":
            up = y - brow[1]
            area = smoothstep(up, 0.006, 0.016) * smoothstep(up, 0.055, 0.035)
            return front * area * smoothstep(x, -0.012, 0.006) * _ripple(up / 0.009 + 0.35 * wander)
        if kind == "glabella":
            middle = 0.5 * (marks[21] + marks[22])
            area = spot(places[:, :2], middle[:2], 0.011) * smoothstep(x, -0.002, 0.001)
            return front * area * _ripple(x / 0.008 + 0.2 + 0.2 * wander)
        if kind == "crow":
            dx, dy = x - eye[0], y - eye[1]
            away = np.hypot(dx, dy)
            area = smoothstep(away, 0.006, 0.012) * smoothstep(away, 0.032, 0.018)
            angle = np.arctan2(dy, np.maximum(dx, 1e-6))
            return area * smoothstep(dx, 0.002, 0.008) * _ripple(angle / 0.45 + 0.3 * wander)
        wing = marks[35 if side > 0 else 31] * ends
        start, end = wing + [0.006, 0.004, 0], mouth + [0.012, -0.004, 0]
        along = end[:2] - start[:2]
        share = ((np.stack([x, y], 1) - start[:2]) @ along) / (along @ along)
        line = start[:2] + np.clip(share, 0, 1)[:, None] * along
        off = np.stack([x, y], 1) - line
        across = off @ np.array([along[1], -along[0]]) / np.linalg.norm(along)
        faded = spot(off, 0.0, 0.006) * smoothstep(share, -0.15, 0.1) * smoothstep(share, 1.3, 0.9)
        return 1.3 * front * faded * np.cos(np.clip(across / 0.004, -np.pi, np.pi))


def _ripple(phase: np.ndarray) -> np.ndarray:
    """Return 1 in valleys, one per period, and slightly under 0 on the ridges between."""
    return 1.2 * np.exp(-((((phase % 1.0) - 0.5) / 0.16) ** 2)) - 0.2


def living_skin(
    model: HeadModel, number: int, seed: int, age: int, amount: float, expression: np.ndarray
) -> LivingSkin:
    """Return how a person's skin looks in an expression (X,)."""
    values = dict(zip(model.expression_names, expression, strict=True))
    rng = np.random.default_rng([seed, number, 16])
    lattice, lines = make_lattice(rng), amount * np.clip(0.5 + (age - 19) / 60, 0, 1.2)
    folds = {}
    for kind, muscles in MUSCLES.items():
        for side in SIDES:
            # No face folds equally on both sides.
            depth, gain = sum(values.get(f"{m}_{side}", 0.0) for m in muscles), rng.uniform(0.6, 1)
            folds[f"{kind}_{side}"] = float(gain * lines * np.clip(depth, 0, 1))
    # Two people of three redden with effort, the others turn pale.
    temper = rng.uniform(0.6, 1.0) * (1 if rng.uniform() < 2 / 3 else -0.7)
    flush = amount * temper * np.tanh(np.abs(expression).sum() / EFFORT)
    marks = landmarks_of(model).astype(np.float64)
    return LivingSkin(folds=folds, flush=float(flush), marks=marks, lattice=lattice)
