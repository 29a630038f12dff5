"""FLAME's forward pass as its paper has it, in plain NumPy: a reader that shares no code with us.

Li et al. 2017, section 3: shaped vertices, joints regressed from them, pose correctives, linear
blend skinning down the tree of joints (the root turns about its own joint), then a translation.
"""

from __future__ import annotations

import cv2
import numpy as np

from express50.head.model import HeadModel

PARENTS = (-1, 0, 1, 1, 1)


def flame_vertices(model: HeadModel, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Vertices (V, 3) float64 of a flame_param file's arrays; missing offsets count as zero."""
    parts = {name: array.astype(np.float64) for name, array in arrays.items()}
    directions = np.concatenate([model.shape_dirs.numpy(), model.expression_dirs.numpy()], 2)
    shapes, expressions = model.shape_dirs.shape[2], model.expression_dirs.shape[2]
    betas = np.concatenate([parts["shape"][:shapes], parts["expr"][0, :expressions]])
    rest = model.template.numpy().astype(np.float64) + directions @ betas
    offset = parts["static_offset"][0]
    rest[: len(offset)] += offset
    joints = model.joint_regressor.numpy().astype(np.float64) @ rest
    names = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")
    angles = np.concatenate([parts[name][0] for name in names]).reshape(5, 3)
    turns = [cv2.Rodrigues(angle)[0] for angle in angles]
    feature = np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    posed = rest + (feature @ model.pose_dirs.numpy().astype(np.float64)).reshape(rest.shape)
    chain: list[np.ndarray] = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        chain.append(local if parent < 0 else chain[parent] @ local)
    for joint, matrix in enumerate(chain):
        matrix[:3, 3] -= matrix[:3, :3] @ joints[joint]
    blended = np.einsum("vj,jrc->vrc", model.skinning.numpy().astype(np.float64), np.stack(chain))
    moved = np.einsum("vrc,vc->vr", blended[:, :3, :3], posed) + blended[:, :3, 3]
    return moved + parts["translation"][0]
