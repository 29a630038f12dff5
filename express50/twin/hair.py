"""Hair: thin ribbons that grow from the scalp, flow over the head and break its silhouette.

Strands march over the head in a flow field (away from the crown, combed, falling), in layers
above the skin. They hang on the skull rigidly; the whole mesh is made once a subject.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.geometry.smoothstep import smoothstep
from express50.twin.subjects import PersonLook
from express50.twin.surface import StarMap, unit

_CLEARANCE = 2.2e-3  # metres


@dataclass(frozen=True, kw_only=True)
class HairStyle:
    """Shape of the strands; lengths in metres."""

    strands: int
    steps: int
    lift: float
    curl: float
    back: float
    fall: float
    side: float
    away: float
    width: float = 5.5e-4


_STYLES = {
    "short": HairStyle(strands=4500, steps=5, lift=0.012, curl=0.0015, back=0.0, fall=0.3,
                       side=0.25, away=1.0),
    "side": HairStyle(strands=4500, steps=7, lift=0.018, curl=0.001, back=0.5, fall=0.35,
                      side=0.9, away=0.6),
    "curly": HairStyle(strands=5200, steps=8, lift=0.034, curl=0.006, back=0.1, fall=0.2,
                       side=0.0, away=1.0, width=6e-4),
    "bob": HairStyle(strands=5200, steps=14, lift=0.016, curl=0.002, back=0.25, fall=1.0,
                     side=0.0, away=0.5, width=6e-4),
    "buzz": HairStyle(strands=5800, steps=3, lift=0.006, curl=0.0, back=0.0, fall=0.2,
                      side=0.0, away=0.7, width=5e-4),
    "swept": HairStyle(strands=4800, steps=8, lift=0.022, curl=0.0015, back=1.3, fall=0.3,
                       side=0.2, away=0.3),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class HairMesh:
    """Ribbons in rest head space: vertices, faces, unit tangents, outward normals, colours."""

    vertices: np.ndarray
    faces: np.ndarray
    tangents: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def grow_hair(
    rng: np.random.Generator,
    vertices: np.ndarray,
    faces: np.ndarray,
    scalp: np.ndarray,
    star: StarMap,
    look: PersonLook,
    detail: float = 1.0,
) -> HairMesh:
    """Grow a subject's hair.

    Args:
        rng: source of chance.
        vertices: (V, 3) the subject's neutral head, rest head space.
        faces: (F, 3).
        scalp: (V,) density of roots, 0 to 1.
        star: outer surface of the head.
        look: colour, style and length.
        detail: more and thinner strands where above 1, fewer and thicker ones below.
    """
    style = _STYLES[look.hair_style]
    roots = _roots(rng, vertices, faces, scalp, round(style.strands * detail))
    points = _march(rng, roots, star, style, look.hair_length_m)
    return _ribbons(rng, points, star.centre, style.width / detail, look.hair)


def _roots(
    rng: np.random.Generator,
    vertices: np.ndarray,
    faces: np.ndarray,
    scalp: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return root points (N, 3), even over the scalp's area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * scalp[faces].mean(1) ** 2
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def _march(
    rng: np.random.Generator, roots: np.ndarray, star: StarMap, style: HairStyle, length: float
) -> np.ndarray:
    """Return strand points (N, steps + 1, 3) from the roots on."""
    count = len(roots)
    layer = style.lift * rng.uniform(0.08, 1.0, count) ** 1.2
    stray = rng.uniform(size=count) < 0.07
    layer = np.where(stray, layer * rng.uniform(1.2, 1.8, count), layer)
    step = length * rng.uniform(0.6, 1.1, count) / style.steps
    phase, wobble = rng.uniform(0, 2 * np.pi, (2, count))
    drift = rng.normal(0.0, 0.12, (count, 3)) * np.where(stray, 2.5, 1.0)[:, None]
    points, at = [roots], roots
    for k in range(1, style.steps + 1):
        out = unit(at - star.centre)
        flow = _flow(at, out, star, style) + drift
        at = at + step[:, None] * unit(flow)
        # Never nearer than the clearance, or chords of the ribbons dip into the skin.
        rise = layer * (1.0 - np.exp(-6.6 * k / style.steps))
        at = _lay(at, star, np.maximum(rise, min(_CLEARANCE, 0.4 * style.lift)))
        turn = phase + wobble + 2.4 * k
        side = np.cross(out, unit(flow))
        curl = style.curl * (k / style.steps) ** 0.5
        points.append(
            at + curl * (np.cos(turn)[:, None] * side + np.abs(np.sin(turn))[:, None] * out)
        )
    return np.stack(points, axis=1)


def _flow(at: np.ndarray, out: np.ndarray, star: StarMap, style: HairStyle) -> np.ndarray:
    """Return direction (N, 3) in which hair runs at points (N, 3), along the surface."""
    crown = unit(np.array([0.0, 0.9, -0.45]))
    away = unit(out * (out @ crown)[:, None] - crown)
    flow = style.away * away
    front = smoothstep(out[:, 2], -0.1, 0.6) * smoothstep(out[:, 1], -0.2, 0.3)
    flow = flow + style.back * front[:, None] * np.array([0.0, 0.35, -1.0])
    flow = flow + style.side * smoothstep(out[:, 1], 0.2, 0.8)[:, None] * np.array([1.0, 0.0, 0.0])
    if style.fall >= 1.0:
        # A middle parting: hair leaves the face to both sides.
        sides = np.sign(at[:, :1]) * smoothstep(out[:, 2], -0.1, 0.5)[:, None]
        flow = flow + 2.2 * sides * np.array([1.0, 0.0, 0.0])
    flow = flow + style.fall * np.array([0.0, -1.0, 0.0])
    low = smoothstep(-(at[:, 1] - star.centre[1]), 0.02, 0.06)[:, None]
    along = flow - out * (flow * out).sum(-1, keepdims=True)
    return (1 - low) * along + low * np.array([0.0, -1.0, 0.0])


def _lay(at: np.ndarray, star: StarMap, height: np.ndarray) -> np.ndarray:
    """Move points (N, 3) to their layer above the surface; low down only outwards."""
    relative = at - star.centre
    distance = np.linalg.norm(relative, axis=1)
    out = relative / np.maximum(distance, 1e-9)[:, None]
    wanted = star.radius(out) + height
    hanging = out[:, 1] < -0.25
    # Where the shoulders begin, the surface is suddenly far out: yield to it in small steps.
    pushed = np.minimum(np.maximum(distance, wanted), distance + 0.004)
    placed = np.where(hanging, pushed, wanted)
    return star.centre + out * placed[:, None]


def _ribbons(
    rng: np.random.Generator,
    points: np.ndarray,
    centre: np.ndarray,
    width: float,
    colour: np.ndarray,
) -> HairMesh:
    """Two-sided ribbons along strand points (N, P, 3), each rolled at random, thin at the tip."""
    count, length = points.shape[:2]
    tangents = unit(np.gradient(points, axis=1))
    out = unit(points - centre)
    across = unit(np.cross(tangents, out))
    roll = rng.uniform(0, np.pi, (count, 1, 1)) + rng.normal(0, 0.5, (count, 1, 1)) * np.linspace(
        0, 1, length
    ).reshape(1, -1, 1)
    side = np.cos(roll) * across + np.sin(roll) * np.cross(across, tangents)
    taper = np.linspace(1.0, 0.35, length).reshape(1, -1, 1) * width
    taper = taper * rng.uniform(0.7, 1.3, (count, 1, 1))
    pairs = np.stack([points - 0.5 * taper * side, points + 0.5 * taper * side], axis=2)
    index = np.arange(count * length * 2).reshape(count, length, 2)
    a, b, c, d = index[:, :-1, 0], index[:, :-1, 1], index[:, 1:, 0], index[:, 1:, 1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], axis=2).reshape(-1, 3)
    shade = rng.uniform(0.75, 1.3, (count, 1, 1)) * rng.normal(1.0, 0.05, (count, 1, 3))
    tips = np.linspace(0.7, 1.2, length).reshape(1, -1, 1)
    colours = np.clip(colour * shade * tips, 0.004, 0.9)

    def spread(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[:, :, None], 2, axis=2).reshape(-1, 3).astype(np.float32)

    return HairMesh(
        vertices=pairs.reshape(-1, 3).astype(np.float32),
        faces=faces.astype(np.int32),
        tangents=spread(tangents),
        normals=spread(unit(0.75 * out + 0.25 * np.cross(side, tangents))),
        colours=spread(np.broadcast_to(colours, points.shape)),
    )
