"""A stand-in of FLAME's own size: 5023 vertices, 9976 faces, lips where FLAME's rings say.

Made by formula. The head is a grid of rings from the open loop at the back of the lips, over the
lips and round an ellipsoid, to the open neck; two spheres are the eyeballs. Lips and loop have the
measures of FLAME's: the loop lies 18 mm behind the lips, 4.6 mm above and 14 mm below their seam.
"""

from __future__ import annotations

import pickle
from functools import cache
from pathlib import Path

import numpy as np

from express50.head.mouth import CORNERS, LOWER_RING, UPPER_RING
from tests.express50.head.flame_files import foreign_classes

RINGS, SPLITS, HEAD_VERTICES = 121, 29, 3931
OUTER = 5  # the ring on the lips that FLAME's two rings make up, 7.7 mm apart on average
# Rows from the loop outwards: y and z, metres from the middle of the lips, above, below, corners.
UPPER = np.array([(4.6, -18), (2.9, -13), (1.2, -9), (0.3, -6.5), (1.6, -2.5), (4.2, -1.0),
                  (7.0, -0.0), (11.0, -1.5)]) * 1e-3  # fmt: skip
LOWER = np.array([(-14.0, -20), (-8.5, -15), (-3.6, -11.0), (-0.4, -7.5), (-1.6, -4.5),
                  (-5.0, -2.5), (-9.5, -4.5), (-13.0, -6.5)]) * 1e-3  # fmt: skip
CORNER = np.array([(24.0, -25), (24.2, -22.0), (24.4, -19), (24.6, -17), (24.9, -15.5),
                   (25.2, -15), (25.6, -14.8), (28.5, -14.0)]) * 1e-3  # fmt: skip
MOUTH = np.array([0.0, -0.045, 0.076])
CENTRE, AXES = np.array([0.0, 0.0, -0.012]), np.array([0.078, 0.125, 0.098])


def _ellipsoid(angle: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Points of the skull; reach 0 is the mouth, 1 the neck (a Moebius map of the sphere)."""
    way = (MOUTH - CENTRE) / AXES
    way /= np.linalg.norm(way)
    side = np.array([1.0, 0.0, 0.0])
    up = np.cross(way, side)
    w = np.tan(0.5 * np.pi * 0.86 * reach) * np.exp(1j * angle)
    neck = 0.62 * np.exp(-0.5j * np.pi)
    w = w / (1 + 0.78 * w * 0.38 / neck)
    square = np.abs(w) ** 2
    x, y, z = 2 * w.real / (1 + square), 2 * w.imag / (1 + square), (1 - square) / (1 + square)
    unit = x[..., None] * side + y[..., None] * up + z[..., None] * way
    return CENTRE + AXES * unit


def _ring_points(ring: int, angle: np.ndarray, rings: int) -> np.ndarray:
    """Points (N, 3) of one ring at angles from the subject's left corner, over the upper lip."""
    row = min(ring, len(UPPER) - 1)
    rise = np.abs(np.sin(angle))
    centre = np.where((np.sin(angle) >= 0)[:, None], UPPER[row], LOWER[row])
    lips = np.stack(
        [
            CORNER[row, 0] * np.cos(angle),
            centre[:, 0] * rise**0.8,
            CORNER[row, 1] + (centre[:, 1] - CORNER[row, 1]) * rise**0.7,
        ],
        -1,
    ) + MOUTH  # fmt: skip
    if ring < len(UPPER):
        return lips
    share = (ring - len(UPPER) + 1) / (rings - len(UPPER))
    skull = _ellipsoid(angle, np.full_like(angle, 0.16 + 0.84 * share**0.9))
    blend = np.clip(share / 0.12, 0, 1)
    blend = blend * blend * (3 - 2 * blend)
    return (1 - blend) * lips + blend * skull


def _head() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (3931, 3), faces (7800, 3) and polar UV (3931, 2) in order of the grid."""
    counts = [32] * RINGS + [30]
    points, uv, starts = [], [], np.concatenate([[0], np.cumsum(counts)])
    for ring, count in enumerate(counts):
        angle = 2 * np.pi * np.arange(count) / count
        points.append(_ring_points(ring, angle, len(counts)))
        radius = 0.06 + 0.36 * ring / RINGS
        uv.append(0.5 + radius * np.stack([np.cos(angle), np.sin(angle)], -1))
    faces: list[tuple[int, int, int]] = []
    for ring in range(RINGS - 1):
        for k in range(32):
            a, b = starts[ring] + k, starts[ring] + (k + 1) % 32
            c, d = starts[ring + 1] + (k + 1) % 32, starts[ring + 1] + k
            faces += [(a, d, c), (a, c, b)]
    i = j = 0  # the last band joins 32 vertices to 30
    while i < 32 or j < 30:
        a, d = starts[RINGS - 1] + i % 32, starts[RINGS] + j % 30
        if j == 30 or (i < 32 and (i + 1) / 32 <= (j + 1) / 30):
            faces.append((a, d, starts[RINGS - 1] + (i + 1) % 32))
            i += 1
        else:
            faces.append((a, d, starts[RINGS] + (j + 1) % 30))
            j += 1
    vertices, flat = np.concatenate(points), np.concatenate(uv)
    for k in range(SPLITS):  # a vertex in the middle of a face each, at the back of the head
        a, b, c = faces[64 * (60 + k)]
        faces[64 * (60 + k)] = (a, b, len(vertices))
        faces += [(b, c, len(vertices)), (c, a, len(vertices))]
        vertices = np.concatenate([vertices, vertices[[a, b, c]].mean(0)[None]])
        flat = np.concatenate([flat, flat[[a, b, c]].mean(0)[None]])
    return vertices, np.array(faces), flat


def _eyeball(x: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A sphere of 546 vertices and 1088 faces, with UV (T, 2) and their faces."""
    polar = np.pi * np.arange(1, 17) / 17
    turn = 2 * np.pi * np.arange(34) / 34
    ring = np.stack(np.broadcast_arrays(np.sin(polar)[:, None] * np.cos(turn),
                                        np.sin(polar)[:, None] * np.sin(turn),
                                        np.cos(polar)[:, None]), -1).reshape(-1, 3)  # fmt: skip
    points = 0.012 * np.concatenate([[[0, 0, 1.0]], ring, [[0, 0, -1.0]]]) + [x, 0.012, 0.058]
    faces, corners = [], []
    for k in range(34):
        n = (k + 1) % 34
        faces.append((0, 1 + k, 1 + n))
        corners.append((k, 35 + k, 36 + k))
        for r in range(15):
            a, b, c, d = (1 + 34 * r + k, 1 + 34 * r + n, 35 + 34 * r + n, 35 + 34 * r + k)
            faces += [(a, d, c), (a, c, b)]
            s = 35 * (r + 1) + k
            corners += [(s, s + 35, s + 36), (s, s + 36, s + 1)]
        faces.append((511 + k, 545, 511 + n))
        corners.append((35 * 16 + k, 35 * 17 + k, 35 * 16 + k + 1))
    v, u = np.meshgrid(np.linspace(1, 0, 18), np.linspace(0, 1, 35), indexing="ij")
    return points, np.array(faces), np.stack([u, v], -1).reshape(-1, 2), np.array(corners)


@cache
def flame_size_head() -> dict[str, np.ndarray]:
    """Vertices, faces, uv and uv_faces with FLAME's vertex ids."""
    points, faces, uv = _head()
    fixed = {32 * OUTER + 1 + k: vertex for k, vertex in enumerate(UPPER_RING)}
    fixed |= {32 * OUTER + 31 - k: vertex for k, vertex in enumerate(LOWER_RING)}
    fixed |= {0: CORNERS[0], 16: CORNERS[1]}
    left = iter(sorted(set(range(HEAD_VERTICES)) - set(fixed.values())))
    order = np.array([fixed[k] if k in fixed else next(left) for k in range(HEAD_VERTICES)])
    vertices = np.empty_like(points)
    vertices[order] = points
    # UV, one a vertex here, stay in the grid's order, their faces too.
    away = uv - 0.5
    place = np.empty((HEAD_VERTICES, 2))
    place[order, 0] = (np.linalg.norm(away, axis=1) - 0.06) / 0.36 * RINGS
    place[order, 1] = np.arctan2(away[:, 1], away[:, 0])
    all_vertices, all_faces, all_uv, corners = [vertices], [order[faces]], [uv], [faces]
    for side, x in enumerate((0.031, -0.031)):
        ball, triangles, ball_uv, ball_corners = _eyeball(x)
        all_faces.append(triangles + sum(map(len, all_vertices)))
        corners.append(ball_corners + sum(map(len, all_uv)))
        all_vertices.append(ball)
        all_uv.append([0.01 + 0.86 * side, 0.01] + 0.12 * ball_uv)
    return {
        "vertices": np.concatenate(all_vertices),
        "ring": np.concatenate([place[:, 0], np.full(2 * 546, RINGS)]),
        "turn": np.concatenate([place[:, 1], np.zeros(2 * 546)]),
        "faces": np.concatenate(all_faces),
        "uv": np.concatenate(all_uv),
        "uv_faces": np.concatenate(corners),
    }


def _smooth(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def flame_size_dict(components: int = 16) -> dict[str, np.ndarray]:
    """Arrays of a model file with that many shape and expression components."""
    head, rng = flame_size_head(), np.random.default_rng(0)
    vertices, count = head["vertices"], len(head["vertices"])
    wave = rng.normal(size=(components, 3)) * 25
    phase = rng.uniform(0, 6.28, components)
    directions = (
        1e-3 * np.sin(vertices @ wave.T + phase)[:, None] * rng.normal(size=(3, components))
    )
    eye = np.arange(count) >= HEAD_VERTICES
    # The jaw bears the lower half of every ring round the mouth, less and less away from it.
    jaw = _smooth(-4 * np.sin(head["turn"])) * (1 - _smooth((head["ring"] - 25) / 40))
    neck = _smooth((-0.05 - vertices[:, 1]) / 0.05) * (1 - jaw)
    weights = np.stack([neck * 0.5, 1 - jaw - neck * 0.5, jaw, 0 * jaw, 0 * jaw], -1)
    weights[eye] = 0
    weights[HEAD_VERTICES : HEAD_VERTICES + 546, 3] = 1
    weights[HEAD_VERTICES + 546 :, 4] = 1
    joints = np.array([[0, -0.12, -0.01], [0, -0.06, 0], [0, -0.02, 0.015],
                       [0.031, 0.012, 0.058], [-0.031, 0.012, 0.058]])  # fmt: skip
    regressor = np.zeros((5, count))
    for number, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1))[:24]
        system = np.concatenate([vertices[near].T, np.ones((1, 24))])
        regressor[number, near] = np.linalg.lstsq(system, [*joint, 1], rcond=None)[0]
    return {
        "v_template": vertices,
        "f": head["faces"].astype(np.uint32),
        "shapedirs": directions,
        "posedirs": 1e-4 * rng.normal(size=(count, 3, 36)),
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], dtype=np.uint32),
    }


def write_flame_size(folder: Path, components: int = 16) -> Path:
    """Write model, embedding, masks and template OBJ; returns the model's path."""
    head, content = flame_size_head(), dict(flame_size_dict(components))
    with foreign_classes() as (ch, _):
        shaped = ch()
        shaped.__dict__.update(x=content["shapedirs"])
        (folder / "flame.pkl").write_bytes(pickle.dumps(content | {"shapedirs": shaped}, 2))
    rng, vertices = np.random.default_rng(1), head["vertices"]
    static = {
        "lmk_face_idx": rng.integers(0, 7000, 68),
        "lmk_b_coords": rng.dirichlet(np.ones(3), 68),
    }
    (folder / "flame_static_embedding_68.pkl").write_bytes(pickle.dumps(static, 2))
    x, y, z = vertices.T
    skin = np.arange(len(vertices)) < HEAD_VERTICES
    near_lips = skin & (np.abs(y - MOUTH[1]) < 0.012) & (z > 0.04) & (np.abs(x) < 0.027)
    masks = {"lips": near_lips, "face": skin & (z > 0.02) & (y < 0.06), "scalp": skin & (y > 0.06),
             "neck": skin & (y < -0.08), "boundary": skin & (y < -0.1)}  # fmt: skip
    ids = {name: np.flatnonzero(mask) for name, mask in masks.items()}
    ids["left_eyeball"] = np.arange(HEAD_VERTICES, HEAD_VERTICES + 546)
    ids["right_eyeball"] = np.arange(HEAD_VERTICES + 546, len(vertices))
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(ids, 2))
    lines = [f"v {a} {b} {c}" for a, b, c in vertices]
    lines += [f"vt {u} {v}" for u, v in head["uv"]]
    pairs = np.stack([head["faces"], head["uv_faces"]], -1).reshape(-1, 6) + 1
    lines += [f"f {a}/{b} {c}/{d} {e}/{f}" for a, b, c, d, e, f in pairs.tolist()]
    (folder / "head_template_mesh.obj").write_text("\n".join(lines) + "\n")
    return folder / "flame.pkl"
