"""Compare the cameras that another tool worked with to the dataset's, and align the two worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.transforms import (
    invert_transform,
    make_transform,
    matrix_to_axis_angle,
    rigid_fit,
)

SHARE = 0.01  # of a focal length, an image's side or the rig's size that may differ
TURN_DEG = 1.0
SAME = 1e-7  # metres and parts of 1; a motion closer to the identity is rounding

# Common mistakes in pose matrices: the advice, and the change that would make them fit.
_MISREADINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "its matrices have OpenCV's axes; give --axes opencv": lambda pose: FLIP_YZ @ pose,
    "its matrices are world to camera, expected camera to world": (
        lambda pose: FLIP_YZ @ invert_transform(FLIP_YZ @ pose)
    ),
    "its matrices are world to camera with OpenCV's axes, expected camera to world": (
        lambda pose: invert_transform(FLIP_YZ @ pose)
    ),
}


def aligning_transform(
    theirs: Mapping[str, Camera], ours: Mapping[str, Camera], where: str
) -> np.ndarray:
    """Return the rigid motion (4, 4) from another tool's world to the dataset's.

    Raises:
        CalibrationError: no camera is shared, or intrinsics, axes, unit or places differ.
    """
    shared = [name for name in ours if name in theirs]
    if not shared:
        raise CalibrationError(
            f"{where}: its cameras are {', '.join(list(theirs)[:4])}, the dataset's"
            f" {', '.join(list(ours)[:4])}: no ids match; is it from another capture?"
        )
    for name in shared:
        _check_intrinsics(theirs[name], ours[name], f"{where}: camera {name}")
    their_poses = [theirs[name].cam_from_world for name in shared]
    our_poses = [ours[name].cam_from_world for name in shared]
    motion, turn, shift = _fit(their_poses, our_poses)
    size = _size(our_poses)
    if turn.max() <= TURN_DEG and shift.max() <= SHARE * size:
        return np.eye(4) if np.abs(motion - np.eye(4)).max() < SAME else motion
    for advice, change in _MISREADINGS.items():
        _, turned, shifted = _fit([change(pose) for pose in their_poses], our_poses)
        if turned.max() <= TURN_DEG and shifted.max() <= SHARE * max(size, _size(our_poses)):
            raise CalibrationError(f"{where}: {advice}")
    scale = _size(their_poses) / max(size, 1e-9)
    if len(shared) > 1 and size >= 1e-6 and abs(scale - 1) > 2 * SHARE:
        raise CalibrationError(
            f"{where}: its rig is {scale:.4g} times as large as the dataset's: its unit is not the"
            " metre, or it is another rig; export it in metres"
        )
    worst = int((turn / TURN_DEG + shift / (SHARE * max(size, 1e-9))).argmax())
    raise CalibrationError(
        f"{where}: camera {shared[worst]} is {turn[worst]:.1f} degrees and"
        f" {1e3 * shift[worst]:.0f} mm from where the dataset has it; use the same calibration"
    )


def _check_intrinsics(theirs: Camera, ours: Camera, where: str) -> None:
    """Refuse another lens; pictures may be smaller, or padded so that the axis is in the middle."""
    scale = theirs.K[0, 0] / ours.K[0, 0]
    cx, cy = ours.K[0, 2], ours.K[1, 2]
    padded = np.array([2 * max(cx, ours.width - cx), 2 * max(cy, ours.height - cy)])
    size = np.array([theirs.width, theirs.height])
    centre, whole = theirs.K[:2, 2], np.array([ours.width, ours.height])
    plain = [(size, scale * whole), (centre, scale * ours.K[:2, 2])]
    middle = [(size, scale * padded), (centre, scale * padded / 2)]
    square = abs(theirs.K[1, 1] / theirs.K[0, 0] / (ours.K[1, 1] / ours.K[0, 0]) - 1) <= SHARE
    # Canvas sizes are even integers.
    slack = SHARE * size.max() + 4
    fits = any(all(np.abs(a - b).max() <= slack for a, b in pairs) for pairs in (plain, middle))
    if not fits or not (square or np.abs(centre - size / 2).max() < 1e-6):
        raise CalibrationError(
            f"{where}: focal length {theirs.K[0, 0]:.1f} px in {theirs.width}x{theirs.height}"
            f" pictures with the axis at ({centre[0]:.1f}, {centre[1]:.1f}); expected"
            f" {ours.K[0, 0]:.1f} px in {ours.width}x{ours.height} with ({cx:.1f}, {cy:.1f}), or"
            " a scaled version of it: its intrinsics belong to other pictures"
        )


def _size(poses: list[np.ndarray]) -> float:
    """Return the root mean square distance of cameras from their middle; 1 m of a single one."""
    centres = np.stack([invert_transform(pose)[:3, 3] for pose in poses])
    spread = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    return spread if len(poses) > 1 else 1.0


def _fit(
    theirs: list[np.ndarray], ours: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the motion (4, 4) that moves poses onto others; per camera degrees and metres left."""
    # Three points a metre ahead of a camera's centre fix its turn as well as its place.
    arms = np.vstack([np.zeros((1, 3)), np.eye(3)])
    source, target = (
        np.concatenate([(arms - pose[:3, 3]) @ pose[:3, :3] for pose in poses])
        for poses in (theirs, ours)
    )
    R, t = rigid_fit(source, target)
    shift = np.linalg.norm(source @ R.T + t - target, axis=1)[:: len(arms)]
    turns = [b[:3, :3] @ R @ a[:3, :3].T for a, b in zip(theirs, ours, strict=True)]
    degrees = np.degrees([np.linalg.norm(matrix_to_axis_angle(turn)) for turn in turns])
    return make_transform(R, t), degrees, shift
