"""Shade materials in light: the colour that a ray sees where it hits the subject.

Everything is linear light in float32. Lights are distant soft boxes. How much of each, and of the
ambient light, reaches a vertex is found by casting rays once per frame for all cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.geometry.sampling import smoothstep
from express50.head.model import HeadModel
from express50.twin.body import Body, Posed, model_materials
from express50.twin.skin import LivingSkin, SkinTexture, sample_skin
from express50.twin.surface import (
    MISS,
    Caster,
    Material,
    dot,
    make_lattice,
    noise,
    smooth_over_mesh,
    unit,
)
from express50.twin.worn import WITH_HAND

# How far light bleeds into the shadow in skin, per channel: red most (d'Eon et al. 2007).
_BLEED = np.array([0.32, 0.12, 0.06], np.float32)
_AMBIENT_RAYS, _SOFT_RAYS, _SMOOTHING = 6, 2, 4
_INDEX, _SURFACES = 1.5, 6  # lenses' refractive index; a ray ends after this many of their surfaces


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Soft boxes: unit directions towards them (L, 3), colours (L, 3), angular size, ambient."""

    directions: np.ndarray
    colours: np.ndarray
    size: float
    sky: np.ndarray
    ground: np.ndarray


def make_lighting(number: int, seed: int) -> Lighting:
    """Draw the studio's lights for a subject; they differ a little between subjects."""
    rng = np.random.default_rng([seed, number, 9])
    towards = np.array(
        [[0.75, 0.65, 0.9], [-0.85, 0.35, 0.75], [-0.55, 0.55, -0.9], [0.8, 0.3, -0.7]]
    ) + rng.normal(0.0, 0.1, (4, 3))
    power = np.array([0.95, 0.55, 0.6, 0.45]) * rng.uniform(0.8, 1.2, 4)
    if rng.uniform() < 0.5:
        towards[:, 0] *= -1.0
    tint = 1.0 + rng.normal(0.0, 0.035, (4, 1)) * np.array([1.0, 0.0, -1.0])
    return Lighting(
        directions=unit(towards).astype(np.float32),
        colours=(power[:, None] * tint).astype(np.float32),
        size=float(rng.uniform(0.10, 0.22)),
        sky=np.full(3, 0.36, np.float32) * rng.uniform(0.85, 1.15),
        ground=np.array([0.20, 0.18, 0.17], np.float32) * rng.uniform(0.8, 1.2),
    )


@dataclass(frozen=True, kw_only=True)
class TwinEyes:
    """Both eyeballs on the mean head: centres (2, 3), optical axes (2, 3), iris half-angle."""

    centres: np.ndarray
    axes: np.ndarray
    iris: float


def find_eyes(model: HeadModel) -> TwinEyes:
    """Find the centres of a head model's eyeballs and the radii of their irises."""
    template = model.template.double().numpy()
    centres, axes, angles = [], [], []
    for side in ("left", "right"):
        ball = template[model.regions[f"{side}_eyeball"].numpy()]
        iris = template[model.regions[f"{side}_iris"].numpy()]
        # In x and y the middle of the ball; in z a radius behind its front, where the iris is.
        centre = 0.5 * (ball.min(0) + ball.max(0))
        centre[2] = ball[:, 2].max() - 0.5 * np.ptp(ball[:, :2], axis=0).mean()
        axis = unit(iris.mean(0) - centre)
        angles.append(np.percentile(np.arccos(np.clip(unit(iris - centre) @ axis, -1, 1)), 95))
        centres.append(centre)
        axes.append(axis)
    iris_angle = float(np.clip(np.mean(angles), 0.40, 0.56))
    return TwinEyes(
        centres=np.array(centres, np.float32), axes=np.array(axes, np.float32), iris=iris_angle
    )


@dataclass(frozen=True, kw_only=True)
class LitScene:
    """One frame ready for rays: compiled geometry and per-vertex attributes."""

    caster: Caster
    body: Body
    texture: SkinTexture
    eyes: TwinEyes
    lighting: Lighting
    attributes: np.ndarray  # (N, 9 + L) normal, place or colour, diffuse light, share of soft boxes
    posed: Posed
    iris_lattice: np.ndarray
    living: LivingSkin | None


def build_scene(
    body: Body,
    texture: SkinTexture,
    eyes: TwinEyes,
    lighting: Lighting,
    posed: Posed,
    seed: int,
    living: LivingSkin | None = None,
) -> LitScene:
    """Build one frame's Embree scene, and the light at every vertex."""
    caster = Caster(posed.vertices, body.faces)
    heads = len(body.template)
    hairs, cloths = len(body.extras.hair.vertices), len(body.extras.cloth_vertices)
    worn = body.extras.worn
    attributes = np.ones((len(posed.vertices), 9 + len(lighting.colours)), np.float32)
    attributes[:, :3] = posed.normals
    attributes[:heads, 3:6] = body.template
    attributes[heads : heads + hairs, 3:6] = body.extras.hair.colours
    attributes[heads + hairs :, 3:6] = body.subject.look.cloth
    attributes[heads + hairs + cloths :, 3:6] = worn.colours
    solid = np.r_[0:heads, heads + hairs : len(attributes)]
    opaque = Caster(posed.vertices, body.faces[: body.solid])
    reach = _light_at(opaque, posed.vertices[solid], posed.normals[solid], lighting)
    reach[heads + cloths :] = smooth_over_mesh(reach[heads + cloths :], worn.faces, _SMOOTHING)
    reach[:heads] = smooth_over_mesh(reach[:heads], body.model.faces.numpy(), _SMOOTHING)
    skin = np.zeros((len(solid), 1), np.float32)
    skin[:heads, 0] = model_materials(body.model) == Material.SKIN
    skin[heads + cloths :, 0] = worn.moves == WITH_HAND
    attributes[solid, 6:9] = _diffuse(lighting, posed.normals[solid], reach, skin)
    attributes[solid, 9:] = reach[:, 1:]
    return LitScene(
        caster=caster, body=body, texture=texture, eyes=eyes, lighting=lighting,
        attributes=attributes, posed=posed, living=living,
        iris_lattice=make_lattice(np.random.default_rng([seed, body.subject.number, 10])),
    )  # fmt: skip


def _light_at(
    caster: Caster, points: np.ndarray, normals: np.ndarray, lighting: Lighting
) -> np.ndarray:
    """Return the shares (N, 1 + L) of ambient light and of each soft box that reach points."""
    count, starts = len(points), points + 6e-4 * normals
    out = np.zeros((count, 1 + len(lighting.directions)), np.float32)
    helper = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = unit(np.cross(helper, normals))
    other = np.cross(normals, across)
    # Every vertex rotates the pattern by a random angle; smoothing then averages neighbours' rays.
    spin = np.random.default_rng(0).uniform(0, 2 * np.pi, (count, 1))
    free = np.zeros(count, np.float32)
    for k in range(_AMBIENT_RAYS):
        # A cosine-weighted spiral over the hemisphere.
        radius, angle = np.sqrt((k + 0.5) / _AMBIENT_RAYS), 2.399963 * k + spin
        ray = radius * (np.cos(angle) * across + np.sin(angle) * other)
        free += ~caster.blocked(starts, ray + np.sqrt(1.0 - radius**2) * normals, 0.10)
    out[:, 0] = free / _AMBIENT_RAYS
    for light, direction in enumerate(lighting.directions):
        side = unit(np.cross(direction, [0.0, 1.0, 0.1]))
        lift = np.cross(side, direction)
        lit = np.flatnonzero(normals @ direction > -0.3)
        seen = np.zeros(len(lit), np.float32)
        for k in range(_SOFT_RAYS):
            angle = 2 * np.pi / _SOFT_RAYS * k + spin[lit]
            ray = unit(direction + lighting.size * (np.cos(angle) * side + np.sin(angle) * lift))
            seen += ~caster.blocked(starts[lit], ray, 2.0)
        out[lit, 1 + light] = seen / _SOFT_RAYS
    return out


def _diffuse(
    lighting: Lighting, normals: np.ndarray, reach: np.ndarray, skin: np.ndarray
) -> np.ndarray:
    """Return diffuse light (N, 3) at vertices; on skin (N, 1) it bleeds into the shadow."""
    up = 0.5 + 0.5 * normals[:, 1:2]
    total = (lighting.ground * (1 - up) + lighting.sky * up) * reach[:, :1]
    bleed = _BLEED * skin
    for k, towards in enumerate(lighting.directions):
        soft = np.maximum((normals @ towards)[:, None] + bleed, 0.0)
        seen = reach[:, 1 + k : 2 + k]
        # Light that bleeds into a shadow has passed through flesh, so the shadow's edge is red.
        share = seen * (1.0 + 1.5 * bleed * (1.0 - seen))
        total += (lighting.colours[k] / (1 + bleed)) * soft * share
    return total


def shade(
    scene: LitScene, directions: np.ndarray, face: np.ndarray, bary: np.ndarray
) -> np.ndarray:
    """Return premultiplied linear colour and alpha (N, 4) of the hits of `Caster.cast`."""
    out = np.ones((len(face), 4), np.float32)
    glass = scene.body.material[face] == Material.LENS
    plain = ~glass
    out[plain, :3] = _opaque(scene, directions[plain], face[plain], bary[plain])
    if glass.any():
        out[glass] = _through(scene, unit(directions[glass]), face[glass], bary[glass])
    return out


def _through(scene: LitScene, way: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Refract rays of unit directions (N, 3) that hit lenses; surfaces they enter reflect lights.

    Returns premultiplied colour and alpha (N, 4); what is behind the subject shows through.
    """
    out = np.zeros((len(face), 4), np.float32)
    row, share = np.arange(len(face)), np.ones(len(face), np.float32)
    lights, body = scene.lighting, scene.body
    for _ in range(_SURFACES):
        weights = np.column_stack([1 - bary.sum(1), bary])[..., None]
        corners = body.faces[face]
        places = (scene.posed.vertices[corners] * weights).sum(1)
        normal = unit((scene.posed.normals[corners] * weights).sum(1))
        cosine = -dot(normal, way)
        entering = cosine > 0
        normal, cosine = np.where(entering, normal, -normal), np.abs(cosine)
        ratio = np.where(entering, 1 / _INDEX, _INDEX)
        rest = 1 - ratio**2 * (1 - cosine**2)
        fresnel = (0.04 + 0.96 * (1 - cosine[:, 0]) ** 5) * entering[:, 0]
        mirror = way + 2 * cosine * normal
        # Soft boxes appear as uniform discs in a dim room.
        off = np.arccos(np.clip(mirror @ lights.directions.T, -1, 1))
        boxes = smoothstep(off, 1.1 * lights.size, 0.9 * lights.size) / (np.pi * lights.size**2)
        glare = boxes @ lights.colours + 0.3 * lights.ground
        out[row, :3] += (share * fresnel)[:, None] * glare
        share = share * (1 - fresnel) * (rest[:, 0] > 0)
        out[row, 3] = 1 - share
        way = unit(ratio * way + (ratio * cosine - np.sqrt(np.maximum(rest, 0))) * normal)
        _, face, bary = scene.caster.cast(places + 2e-5 * way, way)
        hit = face != MISS
        row, share, way, face, bary = (part[hit] for part in (row, share, way, face, bary))
        ended = body.material[face] != Material.LENS
        seen = _opaque(scene, way[ended], face[ended], bary[ended])
        out[row[ended], :3] += share[ended, None] * seen
        out[row[ended], 3] = 1
        row, share, way, face, bary = (part[~ended] for part in (row, share, way, face, bary))
        if not len(row):
            break
    return out


def _opaque(
    scene: LitScene, directions: np.ndarray, face: np.ndarray, bary: np.ndarray
) -> np.ndarray:
    """Return the linear colour (N, 3) of hits on anything but lenses."""
    body = scene.body
    corners = body.faces[face]
    w1, w2 = bary[:, :1], bary[:, 1:]
    attributes = scene.attributes
    mixed = np.take(attributes, corners[:, 0], axis=0) * (1 - w1 - w2)
    mixed += np.take(attributes, corners[:, 1], axis=0) * w1
    mixed += np.take(attributes, corners[:, 2], axis=0) * w2
    view = -unit(directions)
    normal = unit(mixed[:, :3])
    facing = dot(normal, view)
    normal = np.where(facing < 0, normal - 2 * facing * view, normal)
    material = body.material[face]
    out = np.empty((len(face), 3), np.float32)
    for kind in np.unique(material):
        chosen = np.flatnonzero(material == kind)
        n, v, m = normal[chosen], view[chosen], mixed[chosen]
        if kind == Material.HAIR:
            first = corners[chosen, 0] - len(body.template)
            out[chosen] = _hair(scene.lighting, n, v, m[:, 3:6], scene.posed.tangents[first])
            continue
        albedo, gloss, power = _surface(scene, kind, m[:, 3:6])
        # The vertices' diffuse light, and Phong's highlight, stronger at grazing angles (Fresnel).
        cosine = dot(n, v)
        lobes = np.clip((2.0 * cosine * n - v) @ scene.lighting.directions.T, 0.0, 1.0)
        highlight = (lobes ** np.float32(0.25 * power) * m[:, 9:]) @ scene.lighting.colours
        rim = 0.55 + 2.0 * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 4
        shine = gloss * np.float32((power + 2.0) / 8.0) * rim
        out[chosen] = albedo * m[:, 6:9] + highlight * shine
    return out


def _surface(
    scene: LitScene, kind: int, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray | float, float]:
    """Return albedo (N, 3), strength and sharpness of the highlight at places on the mean head."""
    if kind == Material.SKIN:
        texel = sample_skin(scene.texture, place)
        if scene.living is not None:
            texel[:, :3] *= scene.living.factor(place)
        return texel[:, :3], 0.045 * texel[:, 3:], 22.0
    if kind == Material.EYE:
        return _eye_albedo(scene, place), 0.16, 240.0
    plain = {
        Material.CLOTH: (0.01, 5.0),
        Material.HAND: (0.045, 22.0),
        Material.APPAREL: (0.12, 60.0),
    }
    if kind in plain:
        return place, *plain[Material(kind)]
    colour, gloss, power = {
        Material.TEETH: ((0.66, 0.57, 0.44), 0.2, 90.0),
        Material.MOUTH: ((0.30, 0.10, 0.09), 0.10, 40.0),
        Material.TONGUE: ((0.42, 0.17, 0.16), 0.12, 30.0),
    }[Material(kind)]
    grain = 1.0 + 0.10 * noise(place / 0.0025, scene.iris_lattice)
    return grain[:, None] * np.array(colour, np.float32), gloss, power


def _eye_albedo(scene: LitScene, place: np.ndarray) -> np.ndarray:
    """Return the colours (N, 3) of iris, pupil and sclera by the angle from the optical axis."""
    eyes = scene.eyes
    side = (place[:, 0] < 0).astype(np.int32)  # the left eye is at +x
    out = unit(place - eyes.centres[side])
    axis = eyes.axes[side]
    angle = np.arccos(np.clip((out * axis).sum(1), -1.0, 1.0)) / eyes.iris
    around = np.arctan2(out[:, 1] - axis[:, 1], out[:, 0] - axis[:, 0])
    streaks = noise(np.stack([around * 9.0, angle * 1.5, side * 7.0], 1), scene.iris_lattice)
    colour = scene.body.subject.look.eyes.astype(np.float32)
    ring = 1.0 - 0.65 * smoothstep(angle, 0.78, 1.0)
    inner = 1.0 + 0.5 * smoothstep(angle, 0.75, 0.45)
    iris = colour * ((0.9 + 0.5 * streaks) * ring * inner)[:, None]
    iris = iris * smoothstep(angle, 0.36, 0.42)[:, None] + 0.004
    veins = smoothstep(noise(place / 0.0018, scene.iris_lattice), 0.35, 0.8)
    far = smoothstep(angle, 1.1, 2.4)
    white = np.array([0.60, 0.56, 0.53]) * (1 - 0.12 * far)[:, None]
    white = white - (veins * far)[:, None] * np.array([0.05, 0.16, 0.15])
    mix = smoothstep(angle, 0.95, 1.08)[:, None]
    return (iris * (1 - mix) + white * mix).astype(np.float32)


def _hair(
    lighting: Lighting, n: np.ndarray, v: np.ndarray, albedo: np.ndarray, tangent: np.ndarray
) -> np.ndarray:
    """Return a hair's colour (N, 3): diffuse light, a pale and a tinted highlight (Kajiya 1989)."""
    along, seen_along = tangent @ lighting.directions.T, dot(tangent, v)
    across = np.sqrt(np.clip(1.0 - along * along, 0.0, 1.0))
    shown = np.clip(0.35 + 0.75 * (n @ lighting.directions.T), 0.0, 1.0)
    seen_across = np.sqrt(np.clip(1.0 - seen_along * seen_along, 0.0, 1.0))
    gleam = np.clip(across * seen_across - along * seen_along, 0.0, 1.0)
    up = 0.5 + 0.5 * n[:, 1:2]
    ambient = lighting.ground * (1 - up) + lighting.sky * up
    soft = (0.75 * shown * across + 0.35 * shown * gleam**6) @ lighting.colours
    return albedo * (ambient + soft) + (0.045 * shown * gleam**24) @ lighting.colours
