"""Grow hair: thin ribbons that run over the head and make its silhouette irregular.

Strands follow a flow field over the head (away from the crown, combed, falling), in layers above
the skin. They are rigid with the skull; the mesh is made once per subject.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.geometry.sampling import smoothstep
from express50.twin.subjects import PersonLook
from express50.twin.surface import StarMap, unit

_CLEARANCE = 2.2e-3  # metres


@dataclass(frozen=True)
class HairStyle:
    """Number and shape of the strands; lengths in metres."""

    strands: int
    steps: int
    lift: float
    curl: float
    back: float
    fall: float
    side: float
    away: float
    width: float


#              strands, steps, lift, curl, back, fall, side, away, width
_STYLES = {
    "short": HairStyle(4500, 5, 0.012, 0.0015, 0.0, 0.3, 0.25, 1.0, 5.5e-4),
    "side": HairStyle(4500, 7, 0.018, 0.001, 0.5, 0.35, 0.9, 0.6, 5.5e-4),
    "curly": HairStyle(5200, 8, 0.034, 0.006, 0.1, 0.2, 0.0, 1.0, 6e-4),
    "bob": HairStyle(5200, 14, 0.016, 0.002, 0.25, 1.0, 0.0, 0.5, 6e-4),
    "buzz": HairStyle(5800, 3, 0.006, 0.0, 0.0, 0.2, 0.0, 0.7, 5e-4),
    "swept": HairStyle(4800, 8, 0.022, 0.0015, 1.3, 0.3, 0.2, 0.3, 5.5e-4),
    "beard": HairStyle(8000, 5, 0.011, 0.002, 0.0, 0.9, 0.0, 0.2, 6e-4),
    "moustache": HairStyle(1600, 4, 0.006, 0.001, 0.0, 1.0, 0.0, 0.0, 5.5e-4),
    "fringe": HairStyle(2200, 9, 0.010, 0.001, 0.0, 0.9, 0.0, 0.8, 6e-4),
}


@dataclass(frozen=True, kw_only=True)
class HairMesh:
    """Ribbons in rest head space."""

    vertices: np.ndarray
    faces: np.ndarray
    tangents: np.ndarray  # unit
    normals: np.ndarray  # outward
    colours: np.ndarray
    moves: np.ndarray  # (N,) the head vertex that each vertex moves with, or -1 for the skull


def grow_hair(
    rng: np.random.Generator,
    vertices: np.ndarray,
    faces: np.ndarray,
    scalp: np.ndarray,
    star: StarMap,
    look: PersonLook,
    detail: float,
    on_skull: bool = True,
) -> HairMesh:
    """Grow the hair of a neutral head with vertices (V, 3) and faces (F, 3), rest head space.

    `scalp` (V,) is the density of roots, 0 to 1; `star` is the outer surface of the head. A
    `detail` over 1 gives more and thinner strands, under 1 fewer and thicker ones, 0 none. Strands
    move with the skull if `on_skull`, else with the skin at their roots.
    """
    style = _STYLES[look.hair_style]
    # Roots are spread evenly over the scalp's area.
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * scalp[faces].mean(1) ** 2
    count = round(style.strands * detail)
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    roots = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    points = _march(rng, roots, star, style, look.hair_length_m)
    moves = np.full(count, -1, np.int32) if on_skull else faces[chosen, 0].astype(np.int32)
    return _ribbons(rng, points, star.centre, style.width / max(detail, 0.1), look.hair, moves)


def _march(
    rng: np.random.Generator, roots: np.ndarray, star: StarMap, style: HairStyle, length: float
) -> np.ndarray:
    """Return the points (N, steps + 1, 3) of strands, which start at the roots."""
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
        # The clearance keeps chords of the ribbons out of the skin.
        rise = layer * (1.0 - np.exp(-6.6 * k / style.steps))
        height = np.maximum(rise, min(_CLEARANCE, 0.4 * style.lift))
        distance = np.linalg.norm(at - star.centre, axis=1)
        ray = (at - star.centre) / np.maximum(distance, 1e-9)[:, None]
        wanted = star.radius(ray) + height
        # At the shoulders the surface jumps outwards: hanging hair moves out in small steps only,
        # and never inwards.
        pushed = np.minimum(np.maximum(distance, wanted), distance + 0.004)
        at = star.centre + ray * np.where(ray[:, 1] < -0.25, pushed, wanted)[:, None]
        turn = phase + wobble + 2.4 * k
        side = np.cross(out, unit(flow))
        curl = style.curl * (k / style.steps) ** 0.5
        points.append(
            at + curl * (np.cos(turn)[:, None] * side + np.abs(np.sin(turn))[:, None] * out)
        )
    return np.stack(points, axis=1)


def _flow(at: np.ndarray, out: np.ndarray, star: StarMap, style: HairStyle) -> np.ndarray:
    """Return the direction (N, 3) of hair at points (N, 3), along the surface."""
    crown = unit(np.array([0.0, 0.9, -0.45]))
    away = unit(out * (out @ crown)[:, None] - crown)
    flow = style.away * away
    front = smoothstep(out[:, 2], -0.1, 0.6) * smoothstep(out[:, 1], -0.2, 0.3)
    flow = flow + style.back * front[:, None] * np.array([0.0, 0.35, -1.0])
    flow = flow + style.side * smoothstep(out[:, 1], 0.2, 0.8)[:, None] * np.array([1.0, 0.0, 0.0])
    if style.fall >= 1.0:
        # A middle parting: hair runs off the face to both sides.
        sides = np.sign(at[:, :1]) * smoothstep(out[:, 2], -0.1, 0.5)[:, None]
        flow = flow + 2.2 * sides * np.array([1.0, 0.0, 0.0])
    flow = flow + style.fall * np.array([0.0, -1.0, 0.0])
    low = smoothstep(-(at[:, 1] - star.centre[1]), 0.02, 0.06)[:, None]
    along = flow - out * (flow * out).sum(-1, keepdims=True)
    return (1 - low) * along + low * np.array([0.0, -1.0, 0.0])


def _ribbons(
    rng: np.random.Generator,
    points: np.ndarray,
    centre: np.ndarray,
    width: float,
    colour: np.ndarray,
    moves: np.ndarray,
) -> HairMesh:
    """Make a ribbon along each strand (N, P, 3), rolled at random and thin at the tip."""
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
        moves=np.repeat(moves, 2 * length),
    )
