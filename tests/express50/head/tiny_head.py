"""A small random head model and its twin written by hand in NumPy, for tests."""

from __future__ import annotations

import numpy as np
import torch

from express50.head.model import PARENTS, REGIONS, HeadModel


def tiny_head(
    vertices: int = 40, shapes: int = 5, expressions: int = 4, seed: int = 0
) -> HeadModel:
    """Random but valid: a strip of triangles with smooth weights; float64."""
    rng = np.random.default_rng(seed)
    faces = np.stack([np.arange(vertices - 2) + k for k in range(3)], axis=1)
    skinning = rng.dirichlet(np.ones(5), size=vertices)
    regressor = rng.dirichlet(np.ones(vertices) * 0.2, size=5)
    bary = rng.dirichlet(np.ones(3), size=68)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float64))

    return HeadModel(
        name="tiny",
        template=tensor(rng.normal(size=(vertices, 3)) * 0.1),
        shape_dirs=tensor(rng.normal(size=(vertices, 3, shapes)) * 0.01),
        expression_dirs=tensor(rng.normal(size=(vertices, 3, expressions)) * 0.01),
        pose_dirs=tensor(rng.normal(size=(36, vertices * 3)) * 0.002),
        joint_regressor=tensor(regressor),
        skinning=tensor(skinning),
        faces=torch.from_numpy(faces),
        uv=tensor(rng.random((vertices, 2))),
        uv_faces=torch.from_numpy(faces.copy()),
        landmark_faces=torch.from_numpy(rng.integers(0, len(faces), 68)),
        landmark_bary=tensor(bary),
        shape_names=tuple(f"s{i}" for i in range(shapes)),
        expression_names=tuple(f"e{i}" for i in range(expressions)),
        regions={name: torch.zeros(vertices, dtype=torch.bool) for name in REGIONS},
    )


def rodrigues(axis_angle: np.ndarray) -> np.ndarray:
    """Rotation by the exponential's power series, so that no formula is shared with the code."""
    x, y, z = axis_angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=np.float64)
    # Squaring keeps the series short: exp(K) = exp(K / 256)^256.
    term, total = np.eye(3), np.eye(3)
    for n in range(1, 12):
        term = term @ (K / 256) / n
        total = total + term
    return np.linalg.matrix_power(total, 256)


def pose_by_hand(
    model: HeadModel,
    shape: np.ndarray,
    expression: np.ndarray,
    angles: np.ndarray,
    translation: np.ndarray,
    offsets: np.ndarray,
) -> np.ndarray:
    """FLAME's forward kinematics, a vertex and a joint at a time; angles (5, 3)."""
    array = {k: v.numpy() for k, v in vars(model).items() if isinstance(v, torch.Tensor)}
    rest = array["template"] + array["shape_dirs"] @ shape + array["expression_dirs"] @ expression
    rest = rest + offsets
    joints = array["joint_regressor"] @ rest
    rotations = [rodrigues(angle) for angle in angles]
    feature = np.concatenate([(rotation - np.eye(3)).ravel() for rotation in rotations[1:]])
    rest = rest + (feature @ array["pose_dirs"]).reshape(-1, 3)
    transforms: list[np.ndarray] = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        transforms.append(local if parent < 0 else transforms[parent] @ local)
    posed = np.empty_like(rest)
    for vertex in range(len(rest)):
        blended = np.zeros((4, 4))
        for joint, transform in enumerate(transforms):
            away = np.eye(4)
            away[:3, 3] = -joints[joint]
            blended += array["skinning"][vertex, joint] * (transform @ away)
        posed[vertex] = (blended @ np.append(rest[vertex], 1.0))[:3]
    return posed + translation
