"""Build the features of a face: eyelids and eyeballs, lips and what is behind them."""

from __future__ import annotations

import numpy as np

from express50.geometry.transforms import unit
from express50.head.generator.field import (
    EYE_CENTER,
    EYE_RADIUS,
    LID_RADIUS,
    from_front,
    gradient,
    labels,
    skin_field,
)
from express50.head.generator.mesh import HalfMesh, WholeMesh

Array = np.ndarray

LID_SEGMENTS = 20
INNER_CANTHUS = np.array([17.4, 18.2])
OUTER_CANTHUS = np.array([45.8, 20.6])
_ORBIT_CENTER, _ORBIT_RADII = np.array([32.0, 20.5]), np.array([21.5, 17.5])
_FRACTIONS = (0.0, 0.09, 0.2, 0.33, 0.48, 0.65, 0.82, 1.0)
IRIS_RADIUS, PUPIL_RADIUS = 5.9, 1.9


def lid_margin() -> Array:
    """Return the lid margin (40,2), front view, mm: upper lid outwards, lower lid back."""
    s = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, LID_SEGMENTS + 1))
    line = INNER_CANTHUS + s[:, None] * (OUTER_CANTHUS - INNER_CANTHUS)
    upper, lower = line.copy(), line.copy()
    upper[:, 1] += 5.1 * np.abs(np.sin(np.pi * s**0.88)) ** 0.8
    lower[:, 1] -= 5.0 * np.abs(np.sin(np.pi * s**1.12)) ** 0.85
    return np.concatenate([upper, lower[-2:0:-1]])


def add_eye_rings(half: HalfMesh) -> Array:
    """Add lid loops out to the orbit's rim; return the indices of the outer one."""
    margin = lid_margin()
    angle = np.pi - np.pi * np.arange(2 * LID_SEGMENTS) / LID_SEGMENTS
    outer = _ORBIT_CENTER + _ORBIT_RADII * np.stack([np.cos(angle), np.sin(angle)], 1)
    rings = [from_front(margin + f * (outer - margin)) for f in _FRACTIONS]
    outer_label = np.stack(labels(rings[-1]), 1)
    margin_label = np.stack(labels(rings[0]), 1)
    indices = [half.add(ring, f"lid{k}") for k, ring in enumerate(rings)]
    for index, f in zip(indices, _FRACTIONS, strict=True):
        half.labels[index] = margin_label + f * (outer_label - margin_label)
    for inner, out in zip(indices[:-1], indices[1:], strict=True):
        half.strip("skin", inner, out, closed=True)
    # The lid's thickness: an edge down to the eyeball, then a strip hidden under the lid.
    points = rings[0]
    away = points - EYE_CENTER
    edge = EYE_CENTER + away * (EYE_RADIUS + 0.15) / np.linalg.norm(away, axis=1, keepdims=True)
    away_xy = unit(points[:, :2] - points[:, :2].mean(0))
    hidden = edge + np.pad(away_xy * 4.0, ((0, 0), (0, 1))) - EYE_CENTER
    hidden = EYE_CENTER + hidden * (EYE_RADIUS + 0.2) / np.linalg.norm(hidden, axis=1)[:, None]
    middle = margin_label.mean(0)
    rows = [indices[0]]
    for tag, ring, share in (("lid_edge", edge, 0.86), ("lid_hidden", hidden, 0.6)):
        rows.append(half.add(ring, tag))
        half.labels[rows[-1]] = middle + share * (margin_label - middle)
        half.strip("skin", rows[-2], rows[-1], closed=True)
    return indices[-1]


def add_eyeball(half: HalfMesh) -> None:
    """Add a sphere of two charts, with rings at the rims of pupil and iris."""
    iris = np.degrees(np.arcsin(IRIS_RADIUS / EYE_RADIUS))
    pupil = np.degrees(np.arcsin(PUPIL_RADIUS / EYE_RADIUS))
    polar = np.radians([pupil, pupil + 2, 0.5 * (pupil + iris), iris, iris + 2,
                        42, 54, 66, 78, 90, 110, 130, 150, 167])  # fmt: skip
    turn = 2 * np.pi * np.arange(28) / 28
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    front = half.add(EYE_CENTER + [[0, 0, EYE_RADIUS]], "eyeball")
    rings = []
    for k, a in enumerate(polar):
        ring = np.concatenate([np.sin(a) * circle, np.full((28, 1), np.cos(a))], 1)
        rings.append(half.add(EYE_CENTER + EYE_RADIUS * ring, "eyeball"))
        if k <= 9:
            half.set_uv("eye_front", rings[-1], circle * a / np.pi)
        if k >= 9:
            half.set_uv("eye_back", rings[-1], circle * [-1, 1] * (np.pi - a) / np.pi)
    back = half.add(EYE_CENTER - [[0, 0, EYE_RADIUS]], "eyeball")
    pole = np.zeros((1, 2))
    half.set_uv("eye_front", front, pole)
    half.set_uv("eye_back", back, pole)
    half.fan("eye_front", front, rings[0], closed=True)
    half.fan("eye_back", back, rings[-1], closed=True)
    for k in range(len(rings) - 1):
        half.strip("eye_front" if k < 9 else "eye_back", rings[k], rings[k + 1], closed=True)
    half.tags["pupil"] = np.concatenate([front, rings[0]])
    half.tags["iris"] = np.concatenate([front, *rings[:4]])


def ball_centre(mesh: WholeMesh, side: str) -> Array:
    """Return the centre (3,) of an eyeball, mm: halfway between its poles."""
    ball = mesh.vertices[mesh.tag("eyeball", side)]
    return 0.5 * (ball[0] + ball[-1])


_STILL = 5  # the lid loop that does not move; loops inside it share the margin's motion


def lid_motion(mesh: WholeMesh, upper: float, lower: float) -> Array:
    """Return the displacement (V,3), mm, that moves the left lid margins by shares of the opening.

    Loops between the margin and the still loop are spread evenly over the stretched lid, as they
    turn about the eyeball's centre, and the upper lid's fold is smoothed onto the lid's sphere.
    `upper` is the share of the opening that the upper margin moves down, `lower` the share that the
    lower one moves up.
    """
    center = ball_centre(mesh, "left")
    rings = [mesh.tag(f"lid{k}", "left") for k in range(_STILL + 1)]
    loops = mesh.vertices[np.stack(rings)] - center
    margin = loops[0]
    count = len(margin)
    opposite = margin[(-np.arange(count)) % count]
    is_upper = np.arange(count) <= LID_SEGMENTS
    height = margin[:, 1] + np.where(is_upper, upper, lower) * (opposite[:, 1] - margin[:, 1])
    radius = np.hypot(loops[..., 1], loops[..., 2])
    angle = np.arctan2(loops[..., 1], loops[..., 2])
    span = angle[0] - angle[_STILL]
    span = np.where(np.abs(span) > 0.02, span, np.inf)
    open_here = np.abs(margin[:, 1] - opposite[:, 1])
    drawn = max(upper, 0.0) * np.where(is_upper, open_here / open_here.max(), 0.0)
    shell = np.sqrt(np.maximum(LID_RADIUS**2 - loops[..., 0] ** 2, 1.0))
    smooth = np.minimum(drawn, 1.0) * np.array([0.0, 1.0, 1.0, 0.9, 0.5, 0.0])[:, None]
    new_radius = radius + smooth * np.minimum(shell - radius, 4.0).clip(-4.0)
    shut = np.clip(upper + lower, 0.0, 1.0)  # margins that meet need the same depth
    new_radius[0] += shut * 0.5 * (radius[0][(-np.arange(count)) % count] - radius[0])
    new_margin = np.arcsin(np.clip(height / new_radius[0], -1, 1))
    new_angle = angle + (angle - angle[_STILL]) / span * (new_margin - angle[0])
    motion = np.zeros_like(mesh.vertices)
    for k in range(_STILL):
        y, z = new_radius[k] * np.sin(new_angle[k]), new_radius[k] * np.cos(new_angle[k])
        new = np.stack([loops[k, :, 0], y, z], 1)
        motion[rings[k]] = new - loops[k]
    for tag in ("lid_edge", "lid_hidden"):
        ring = mesh.tag(tag, "left")
        motion[ring] = turned(mesh.vertices[ring] - center, new_margin - angle[0])
    return motion


def turned(offset: Array, angle: Array) -> Array:
    """Return the displacement (N,3) of offsets turned upwards about the x axis by angles (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    y = c * offset[:, 1] + s * offset[:, 2]
    z = -s * offset[:, 1] + c * offset[:, 2]
    return np.stack([offset[:, 0], y, z], 1) - offset


LIP_SEGMENTS = 16
CORNER_X = 25.5
_OUTER_CENTER_Y, _OUTER_X, _OUTER_UP, _OUTER_DOWN = -49.0, 41.0, 16.0, 20.0


def _rows() -> tuple[Array, Array, Array, Array]:
    """Return slit, vermilion border and outer loop, front views (33,2), and the slit's x (33,)."""
    s = np.linspace(0, 1, LIP_SEGMENTS + 1)
    x = CORNER_X * np.sin(0.5 * np.pi * s)
    t = x / CORNER_X
    # The line of closed lips is a shallow bow that falls towards the corners.
    y = -48.8 - 0.7 * np.exp(-((x / 7.0) ** 2)) - 0.5 * t**3 + 0.9 * t * (1 - t)
    slit = np.stack([x, y], 1)
    up = 7.6 * (1 - t**1.7) ** 0.9 + 1.2 * np.exp(-(((x - 5.5) / 3.2) ** 2)) + 0.2
    down = 10.0 * (1 - t**2.2) ** 0.8
    wide = x * (1 + 0.03 * t**4)
    upper = np.stack([wide, slit[:, 1] + up], 1)
    lower = np.stack([wide, slit[:, 1] - down], 1)
    upper[-1, 1] = lower[-1, 1] = slit[-1, 1]
    border = np.concatenate([upper, lower[-2::-1]])
    angle = 0.5 * np.pi * (1 - np.linspace(0, 2, 2 * LIP_SEGMENTS + 1))
    radius_y = np.where(angle > 0, _OUTER_UP, _OUTER_DOWN)
    outer = np.stack([_OUTER_X * np.cos(angle), _OUTER_CENTER_Y + radius_y * np.sin(angle)], 1)
    outer[[0, -1], 0] = 0.0
    slit = np.concatenate([slit, slit[-2::-1]])
    return slit, border, outer, np.concatenate([x, x[-2::-1]])


def add_lip_rings(half: HalfMesh) -> Array:
    """Add loops from the slit outwards around the mouth; return the indices of the outer one."""
    slit, border, outer, x = _rows()
    sign = np.concatenate([np.ones(LIP_SEGMENTS), [0.0], -np.ones(LIP_SEGMENTS)])
    thick = 1 - (x / CORNER_X) ** 4
    contact = from_front(slit)
    contact[:, 2] -= 0.3 + 2.2 * thick
    contact[:, 1] += 0.05 * sign
    rows = [contact]
    for f in (0.3, 0.65, 1.0):
        rows.append(from_front(slit + f * (border - slit)))
    for f in (0.25, 0.6, 1.0):
        rows.append(from_front(border + f * (outer - border)))
    outer_label = np.stack(labels(rows[-1]), 1)
    slit_label = np.stack(labels(contact), 1)
    slit_label[:, 1] += 0.5 * sign * thick
    indices = []
    for k, (row, f) in enumerate(zip(rows, (0, 0.12, 0.26, 0.4, 0.55, 0.78, 1.0), strict=True)):
        row[np.abs(row[:, 0]) < 1e-9, 0] = 0.0
        indices.append(half.add(row, f"lip{k}"))
        half.labels[indices[-1]] = slit_label + f * (outer_label - slit_label)
        if k:
            half.strip("skin", indices[k - 1], indices[k], closed=False)
    _add_cavity(half, indices[0], contact, sign, thick)
    return indices[-1]


def _add_cavity(half: HalfMesh, slit: Array, contact: Array, sign: Array, thick: Array) -> None:
    """Add the cavity behind the lips, wide enough for teeth and tongue, inside the skin."""
    n = len(slit)
    angle = 0.5 * np.pi * (1 - np.linspace(0, 2, n))
    up, out = np.sin(angle), np.cos(angle)
    out[[0, -1]] = 0.0
    rows = [slit]
    radii = np.linspace(1.0, 0.12, 8)
    half.set_uv("mouth", slit, radii[0] * np.stack([out, up], 1))
    lip_in = contact + np.stack([0 * up, 1.4 * sign * thick, -4.5 + 0 * up], 1)
    behind = contact + np.stack([0.04 * contact[:, 0], 6.5 * sign * thick, -7.5 + 0 * up], 1)
    shapes = [lip_in, behind]
    for y_up, y_down, width, z_mid, z_side in (
        (-33, -67, 29, 88, 74), (-29, -70, 31, 76, 60), (-30, -69, 28, 60, 50),
        (-36, -64, 18, 46, 44), (-44, -57, 9, 40, 40),
    ):  # fmt: skip
        y = -50 + np.where(up > 0, (y_up + 50) * up, (y_down + 50) * -up)
        shapes.append(np.stack([width * out, y, z_mid + (z_side - z_mid) * out**2], 1))
    for k, shape in enumerate(shapes):
        for _ in range(4):  # push in what is too close to the skin, mm
            excess = np.maximum(skin_field(shape) + (1.5 if k == 0 else 3.0), 0.0)
            shape = shape - excess[:, None] * gradient(shape)
        shape[[0, -1], 0] = 0.0
        rows.append(half.add(shape, "cavity"))
        half.tags[f"cavity{k}"] = rows[-1]
        half.set_uv("mouth", rows[-1], radii[min(k + 1, 7)] * np.stack([out, up], 1))
        half.strip("mouth", rows[-2], rows[-1], closed=False)
    throat = half.tags["throat"] = half.add(np.array([[0.0, -51.0, 37.0]]), "cavity")
    half.set_uv("mouth", throat, np.array([[0.0, 0.0]]))
    half.fan("mouth", throat, rows[-1], closed=False)


# Widths (mm) of the crowns from the mid plane outwards: incisors, canine, premolars, molar.
_UPPER_CROWNS = (8.4, 6.6, 7.6, 6.8, 6.6, 9.6)
_LOWER_CROWNS = (5.4, 5.9, 6.8, 6.9, 7.0, 10.4)


def _arch(upper: bool) -> tuple[Array, Array, Array]:
    """Return places (x, z) (N,2), outward normals (N,2) and tooth phases along half an arch."""
    widths, shares = np.array(_UPPER_CROWNS if upper else _LOWER_CROWNS), (0.16, 0.5, 0.84, 1.0)
    edges = np.concatenate([[0], np.cumsum(widths)])
    along = np.append(0.0, edges[:-1, None] + shares * widths[:, None])
    phase = np.append(0.0, np.tile(shares, len(widths)) % 1.0)
    x = np.linspace(0, 30, 400)
    front = 91.0 if upper else 86.8
    reach = 25.0 if upper else 23.5
    z = front - 31.0 * (x / reach) ** 2.3
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    xs, zs = np.interp(along, length, x), np.interp(along, length, z)
    ahead = along + 1
    tangent = np.stack([np.interp(ahead, length, x) - xs, np.interp(ahead, length, z) - zs], 1)
    tangent = unit(tangent)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    normal[0] = (0.0, 1.0)
    return np.stack([xs, zs], 1), normal, phase


def add_teeth(half: HalfMesh, upper: bool) -> None:
    """Add half a dental arch: outer gum, crown, biting edge, inner crown, inner gum."""
    place, normal, phase = _arch(upper)
    groove = np.where(phase == 0.0, 1.0, 0.0)
    bulge = np.where(phase == 0.5, 0.35, 0.0)
    t = np.linspace(0, 1, len(phase))
    y0, sign = (-42.0, 1.0) if upper else (-61.5, -1.0)  # gum line; sign points to the roots
    crown = 10.3 - 2.5 * t if upper else 10.0 - 2.0 * t
    thick = 3.4 + 5.0 * t**1.5
    rows = []
    #       outward offset, height from the gum line towards the roots
    profile = (
        (1.2 + 0 * t, 7.0 + 0 * t),
        (1.0 - 0.4 * groove, 1.2 + 0.9 * bulge - 1.2 * groove),
        (0.5 + bulge - 0.9 * groove, 0.0 - 1.0 * groove),
        (0.5 + bulge - 1.0 * groove, -0.55 * crown),
        (-0.2 - 0.8 * groove, -crown + 0.5 * groove),
        (-1.5 - 0.7 * (thick - 3.4) + 0.3 * groove, -crown + 0.6 * groove),
        (-thick, -0.5 * crown),
        (-thick - 0.8, 0.0 + 0 * t),
        (-thick - 1.5, 7.0 + 0 * t),
    )
    name = "upper" if upper else "lower"
    for k, (out, up) in enumerate(profile):
        xz = place + out[:, None] * normal
        points = np.stack([xz[:, 0], y0 + sign * up, xz[:, 1]], 1)
        points[0, 0] = 0.0
        tag = f"{name}_teeth" if 2 <= k <= 7 else f"{name}_gums"
        rows.append(half.add(points, tag))
        v = k if upper else len(profile) - 1 - k
        half.set_uv(f"{name}_teeth", rows[-1], np.stack([t, np.full(len(t), -0.1 * v)], 1))
        if k:
            half.strip(f"{name}_teeth", rows[-2], rows[-1], closed=False)


def add_tongue(half: HalfMesh) -> None:
    """Add half the tongue: cross sections from the root to the tip."""
    sections = 13
    s = np.linspace(0, 1, sections)
    z = 42 + 42 * s
    top = -51.5 - 4.5 * s**3 + 2.0 * np.sin(np.pi * s)
    bottom = -66 + 6.5 * s**2
    width = 19.5 * np.sqrt(np.clip(1 - (s * 0.98) ** 4, 0, 1))
    turn = np.linspace(0.5 * np.pi, -0.5 * np.pi, 9)
    rows = []
    for k in range(sections):
        r = 1.0 if k < sections - 1 else 0.45
        c, sn = np.cos(turn), np.sin(turn)
        c[[0, -1]] = 0.0
        y = 0.5 * (top[k] + bottom[k]) + 0.5 * (top[k] - bottom[k]) * sn * r
        y = y - 1.1 * np.exp(-((turn - 0.5 * np.pi) ** 2) / 0.05)  # the groove along the middle
        rows.append(half.add(np.stack([width[k] * r * c, y, np.full(9, z[k])], 1), "tongue"))
        # Seen from above with the tip down; the underside unrolls outwards.
        half.set_uv("tongue", rows[-1], np.stack([np.linspace(0, 1, 9), np.full(9, -s[k])], 1))
        if k:
            half.strip("tongue", rows[-2], rows[-1], closed=False)
    tip = half.add(np.array([[0.0, -57.8, 85.0]]), "tongue")
    half.set_uv("tongue", tip, np.array([[0.0, -1.12]]))
    half.fan("tongue", tip, rows[-1], closed=False)
