"""Build lip loops, the mouth cavity behind them, teeth with gums, and the tongue."""

from __future__ import annotations

import numpy as np

from express50.geometry.transforms import unit
from express50.head.generator.eyes import from_front
from express50.head.generator.field import gradient, labels, skin_field
from express50.head.generator.mesh import HalfMesh

Array = np.ndarray

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
