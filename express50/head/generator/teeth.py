"""Upper and lower teeth with gums on parabolic arches, and the tongue."""

from __future__ import annotations

import numpy as np

from express50.head.generator.mesh import HalfMesh

Array = np.ndarray

# Widths (mm) of the crowns from the mid plane outwards: incisors, canine, premolars, molar.
_UPPER_CROWNS = (8.4, 6.6, 7.6, 6.8, 6.6, 9.6)
_LOWER_CROWNS = (5.4, 5.9, 6.8, 6.9, 7.0, 10.4)


def _arch(upper: bool) -> tuple[Array, Array, Array]:
    """Columns along half an arch: position (N,2) as (x, z), outward normal (N,2), tooth phase."""
    widths = _UPPER_CROWNS if upper else _LOWER_CROWNS
    edges = np.concatenate([[0], np.cumsum(widths)])
    along, phase = [0.0], [0.0]
    for k in range(len(widths)):
        for f in (0.16, 0.5, 0.84, 1.0):
            along.append(edges[k] + f * widths[k])
            phase.append(f % 1.0)
    x = np.linspace(0, 30, 400)
    front = 91.0 if upper else 86.8
    reach = 25.0 if upper else 23.5
    z = front - 31.0 * (x / reach) ** 2.3
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    xs, zs = np.interp(along, length, x), np.interp(along, length, z)
    tangent = np.stack(
        [
            np.interp(np.array(along) + 1, length, x) - xs,
            np.interp(np.array(along) + 1, length, z) - zs,
        ],
        1,
    )
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    normal[0] = (0.0, 1.0)
    return np.stack([xs, zs], 1), normal, np.array(phase)


def add_teeth(half: HalfMesh, upper: bool) -> None:
    """One dental arch, half: outer gum, crown, biting edge, inner crown, inner gum."""
    place, normal, phase = _arch(upper)
    groove = np.where(phase == 0.0, 1.0, 0.0)
    groove[0] = 1.0
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
    half.tags[f"{name}_incisor"] = rows[4][:2]


def add_tongue(half: HalfMesh) -> None:
    """Tongue, half: cross sections from the root forward to the tip."""
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
        half.tags[f"tongue_row{k}"] = rows[-1]
        # Seen from above with the tip down; the underside unrolls outwards.
        half.set_uv("tongue", rows[-1], np.stack([np.linspace(0, 1, 9), np.full(9, -s[k])], 1))
        if k:
            half.strip("tongue", rows[-2], rows[-1], closed=False)
    tip = half.add(np.array([[0.0, -57.8, 85.0]]), "tongue")
    half.set_uv("tongue", tip, np.array([[0.0, -1.12]]))
    half.fan("tongue", int(tip[0]), rows[-1], closed=False)
    half.tags["tongue_tip"] = tip
