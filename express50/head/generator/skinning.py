"""Joints, their regressor and the skinning weights of the procedural head."""

from __future__ import annotations

import numpy as np

from express50.geometry.smoothstep import smoothstep
from express50.head.generator.field import EYE_CENTER
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray

ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)


def joint_positions(mesh: WholeMesh) -> Array:
    """Return rest joints (5,3) mm: collar, upper neck, jaw hinge, eyeball centres."""
    return np.array([(0, -165, -22), (0, -72, -16), (0, -8, 10),
                     EYE_CENTER, EYE_CENTER * [-1, 1, 1]], float)  # fmt: skip


def joint_regressor(mesh: WholeMesh, joints: Array) -> Array:
    """Weights (5,V), rows sum to 1: least-norm affine weights over the vertices near each joint."""
    regressor = np.zeros((5, len(mesh.vertices)))
    skin = np.isin(np.arange(len(mesh.vertices)), mesh.tag("grid"))
    for j, joint in enumerate(joints):
        if j >= LEFT_EYE:
            near = mesh.tag("eyeball", "left" if j == LEFT_EYE else "right")
        else:
            distance = np.linalg.norm(mesh.vertices - joint, axis=1) + np.where(skin, 0, 1e6)
            near = np.argsort(distance, kind="stable")[:160]
        system = np.concatenate([mesh.vertices[near].T, np.ones((1, len(near)))])
        regressor[j, near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return regressor


def vertex_average(mesh: WholeMesh, values: Array, faces: Array) -> Array:
    """Return mean of the neighbours' values (V,...) over the edges of `faces`."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, 1), axis=0)
    total, degree = np.zeros_like(values), np.zeros(len(values))
    np.add.at(total, edges[:, 0], values[edges[:, 1]])
    np.add.at(total, edges[:, 1], values[edges[:, 0]])
    np.add.at(degree, edges.ravel(), 1.0)
    shape = (-1,) + (1,) * (values.ndim - 1)
    return np.where(degree.reshape(shape) > 0, total / degree.clip(1).reshape(shape), values)


def jaw_weight(mesh: WholeMesh) -> Array:
    """Return share (V,) of the jaw joint: lower lip, chin, jaw line, lower teeth, tongue."""
    p = mesh.vertices
    angle = np.degrees(np.arctan2(p[:, 1] + 8, np.maximum(p[:, 2] - 10, 1.0)))
    around = smoothstep(angle, -18.5, -31.5)
    around *= smoothstep(p[:, 2], -14.0, 42.0) * smoothstep(p[:, 1], -138.0, -92.0)
    around[mesh.tag("ear")] = 0.0
    weight, fixed = around.copy(), np.zeros(len(p), bool)
    skin = mesh.faces[mesh.face_chart == "skin"]
    for k, f in enumerate((0.0, 0.1, 0.22, 0.38, 0.58, 0.8)):
        for which in ("left", "right"):
            ring = mesh.tag(f"lip{k}", which)
            weight[ring] = (1 - f) * _CLOSURE + f * around[ring]
            fixed[ring] = k <= 2
    for tag in ("ear_foot", "lid5"):
        weight[mesh.tag(tag)], fixed[mesh.tag(tag)] = 0.0, True
    for _ in range(10):
        weight = np.where(fixed, weight, 0.5 * (weight + vertex_average(mesh, weight, skin)))
    return _inner_jaw_weight(mesh, weight)


# Along a lip loop from the middle of the upper lip to that of the lower: corners share evenly.
_CLOSURE = smoothstep(np.arange(33.0), 7.0, 25.0)


def _inner_jaw_weight(mesh: WholeMesh, weight: Array) -> Array:
    for k in range(7):
        deep = smoothstep(np.array(float(k)), 3.0, 8.0)
        for which in ("left", "right"):
            weight[mesh.tag(f"cavity{k}", which)] = _CLOSURE * (1 - 0.6 * deep)
    for tag, value in (
        ("upper_teeth", 0.0),
        ("upper_gums", 0.0),
        ("lower_teeth", 1.0),
        ("lower_gums", 1.0),
    ):
        weight[mesh.tag(tag)] = value
    weight[mesh.tag("throat")] = 0.2
    tongue = mesh.tag("tongue")
    weight[tongue] = 0.55 + 0.45 * smoothstep(mesh.vertices[tongue, 2], 42.0, 62.0)
    return weight


def skinning_weights(mesh: WholeMesh, regions: dict[str, Array]) -> Array:
    """Return weights (V,5), rows sum to 1: collar by the root, head by the neck, jaw and eyes."""
    p = mesh.vertices
    jaw = jaw_weight(mesh)
    height = p[:, 1] - 0.35 * (p[:, 2] + 20)  # the neck's own axis leans forward
    head = np.maximum(smoothstep(height, -150.0, -62.0), jaw)
    inside = regions["mouth_interior"] | regions["teeth"] | regions["tongue"]
    head[inside] = 1.0
    weights = np.zeros((len(p), 5))
    weights[:, JAW] = jaw
    weights[:, NECK] = head - jaw
    weights[:, ROOT] = 1.0 - head
    for joint, side in ((LEFT_EYE, "left"), (RIGHT_EYE, "right")):
        ball = regions[f"{side}_eyeball"]
        weights[ball] = 0.0
        weights[ball, joint] = 1.0
    return weights


def pose_correctives(mesh: WholeMesh, regions: dict[str, Array]) -> Array:
    """Return correctives (36,V*3) in mm per unit of R - I, for the jaw's opening alone.

    Opening by a sets R[2,1] of the jaw to sin a. The lips then close in from the corners and the
    upper lip gives way a little, which skinning cannot do.
    """
    hard = regions["teeth"] | regions["gums"] | regions["tongue"]
    p, sign = mesh.vertices, np.sign(mesh.vertices[:, 0])

    def near(at: tuple[float, float, float], radius: tuple[float, float, float]) -> Array:
        folded = np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], 1)
        return np.where(hard, 0.0, np.exp(-(((folded - at) / np.array(radius)) ** 2).sum(1)))

    corner, upper = near((26, -49, 86), (15, 13, 24)), near((0, -42, 101), (22, 12, 20))
    cheek = near((42, -42, 62), (18, 24, 26))
    motion = np.zeros_like(p)
    motion[:, 0] = -sign * (12.0 * corner + 6.0 * cheek)
    motion[:, 1] = 5.0 * upper * (1 - jaw_weight(mesh))
    motion[:, 2] = 4.0 * corner
    result = np.zeros((36, p.size))
    result[9 * (JAW - 1) + 7] = motion.ravel()
    return result
