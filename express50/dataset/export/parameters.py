"""Head-model parameters in FLAME's convention, as GaussianAvatars and VHAP read them.

FLAME turns a head about its root joint J, we about the origin: R (x - J) + J + T = R x + t gives
T = t + R J - J, where J is regressed from the shaped vertices, expression and static offset
included.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch

from express50.dataset.export.meshes import write_head_obj
from express50.dataset.export.select import Head
from express50.dataset.tracks import Track
from express50.geometry.transforms import matrix_to_axis_angle
from express50.head.model import HeadModel, rest_vertices

FLAME_VERTICES = 5143  # of the layout's FLAME: 5023, and 120 of its teeth
FLAME_SHAPES, FLAME_EXPRESSIONS = 300, 100  # its readers expect that many, or zeros
CANONICAL_JAW = 0.3  # radians
FAR_M = 16.0  # from there on, single precision rounds by more than a micrometre


def is_flame(model: HeadModel) -> bool:
    """True if FLAME's coefficients give this model's vertices."""
    return model.name.startswith("flame-")


def export_shift(track: Track) -> np.ndarray:
    """Whole metres (3,) by which the world is moved; 0 but where heads are far from the origin."""
    centre = track.vertices.mean((0, 1), dtype=np.float64)
    return np.rint(centre) if np.abs(centre).max() > FAR_M else np.zeros(3)


def flame_motion(
    model: HeadModel, track: Track, row: int, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3,), axis-angle, and translation (3,) by FLAME's convention, about the root joint.

    ``shift`` (3,) is taken off the world.
    """
    exact = model.to(dtype=torch.float64)
    rest = rest_vertices(
        exact,
        torch.from_numpy(track.shape)[None],
        torch.from_numpy(track.expression[row])[None],
        torch.from_numpy(track.offsets.astype(np.float64))[None],
    )[0]
    joint = (exact.joint_regressor[0] @ rest).numpy()
    R = track.R[row]
    return matrix_to_axis_angle(R), track.t[row] - shift + R @ joint - joint


def write_parameters(head: Head, steps: list[str], shift: np.ndarray, out: Path) -> None:
    """Write a file of parameters per time step, the canonical one, and meshes if not FLAME."""
    (out / "flame_param").mkdir()
    flame, shapes = is_flame(head.model), head.model.shape_dirs.shape[2]
    offsets = head.track.offsets[: FLAME_VERTICES if flame else None]
    shape = _padded(head.track.shape, max(shapes, FLAME_SHAPES if flame else 0))
    shared = {"shape": shape, "static_offset": offsets[None]}
    for number, name in enumerate(steps):
        arrays = shared | _step_parameters(head, head.track.row(name), shift)
        (out / "flame_param" / f"{number:05d}.npz").write_bytes(npz_bytes(arrays))
        if not flame:
            (out / "meshes").mkdir(exist_ok=True)
            vertices = head.track.vertices[head.track.row(name)] - shift
            write_head_obj(out / "meshes" / f"{number:05d}.obj", vertices, head.model)
    still = {name: np.zeros_like(array) for name, array in arrays.items() if name not in shared}
    still["jaw_pose"][0, 0] = CANONICAL_JAW
    (out / "canonical_flame_param.npz").write_bytes(npz_bytes(shared | still))


def _step_parameters(head: Head, row: int, shift: np.ndarray) -> dict[str, np.ndarray]:
    track = head.track
    rotation, translation = flame_motion(head.model, track, row, shift)
    flame = is_flame(head.model)
    count = max(head.model.expression_dirs.shape[2], FLAME_EXPRESSIONS if flame else 0)
    arrays = {
        "translation": translation,
        "rotation": rotation,
        "neck_pose": track.neck[row],
        "jaw_pose": track.jaw[row],
        "eyes_pose": track.eyes[row],
        "expr": _padded(track.expression[row], count),
    }
    return {name: array[None].astype(np.float32) for name, array in arrays.items()}


def _padded(values: np.ndarray, count: int) -> np.ndarray:
    return np.pad(values, (0, count - len(values))).astype(np.float32)


def npz_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """Bytes of an .npz file; NumPy dates its members 1980, so that they depend on nothing else."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # numpy types its options only
    return buffer.getvalue()
