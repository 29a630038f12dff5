"""Read tracks of VHAP and GaussianAvatars, FLAME's parameters by time step, as track.npz.

The source is a folder with ``transforms.json`` and the parameter files that it names, or VHAP's
own ``tracked_flame_params_N.npz``. Comparing the cameras that the tool worked with to the dataset's
aligns the two worlds. FLAME turns a head about its root joint J, we about the origin:
world = R (x - J) + J + T, so that t = T - R J + J.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.contract.stage import Note
from express50.dataset.tracks import SCHEMA
from express50.errors import CalibrationError, ConfigError, FormatError, StageError, few
from express50.files.arrays import read_arrays
from express50.files.text import read_json_table, refusing
from express50.geometry.cameras import Camera
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.transforms import (
    axis_angle_to_matrix,
    invert_transform,
    make_transform,
    matrix_to_axis_angle,
    rigid_fit,
)
from express50.head.load import load_head
from express50.head.model import HeadModel, pose, rest_vertices
from express50.rigs.per_picture import frame_camera
from express50.rigs.read import read_rig
from pipelines.imports.pictures import PeakFrame, fill

WHAT = "FLAME parameters of a tracker"
# Names and widths of the arrays with one row per time step.
POSES = {"translation": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
ROWS = (*POSES, "expr")
OFFSETS = ("static_offset", "dynamic_offset")
NUMBER = re.compile(r"(\d+)$")
SAME = 1e-5  # metres and coefficients: what the steps must share may be rounded
SHARE = 0.01  # of a focal length, an image's side or the rig's size that may differ
TURN_DEG = 1.0
STILL = 1e-7  # metres and parts of 1; a motion closer to the identity is rounding
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


@dataclass(frozen=True, kw_only=True)
class FlameStep:
    """Holds the parameters of one time step, in the dataset's world."""

    where: str  # its file, for messages
    arrays: Mapping[str, np.ndarray]  # by name, one row each
    shared: Mapping[str, np.ndarray]  # ``shape`` and ``static_offset`` of all time steps
    motion: np.ndarray  # (4, 4) rigid, from the other tool's world
    dynamic_mm: float  # largest displacement that this step alone has


@dataclass(frozen=True, kw_only=True)
class TrackSource:
    """Says where a subject's tracks are."""

    pattern: str  # path of a folder or file; with an expression in it, of each expression's own
    head: str  # the head model, as ``load_head`` takes it
    axes: str = "opengl"  # of the camera matrices, ``opengl`` or ``opencv``
    cameras: Path | None = None  # the other tool's rig, where the tracks do not bring it

    @property
    def in_clip(self) -> bool:
        """Return whether each expression has a track of its own, its frames counted from 0."""
        return "{expression}" in self.pattern


def read_foreign_track(
    dataset: Dataset, subject: str, peaks: list[PeakFrame], source: TrackSource
) -> tuple[dict[str, np.ndarray], list[Note]]:
    """Read a subject's arrays of track.npz in its peak frames, and warnings about them.

    Raises:
        ConfigError: the source is of an unknown kind.
        CalibrationError: its cameras are not the dataset's.
        StageError: peak frames are missing, or it is another subject's.
        FormatError: parameters are damaged, or do not fit the head model.
    """
    ours = read_cameras_of(dataset, subject)
    steps: dict[str, FlameStep] = {}
    if source.in_clip:
        for peak in peaks:
            path = fill(source.pattern, subject, peak)
            steps |= _read_steps(path, subject, [peak], ours, source)
    else:
        steps = _read_steps(fill(source.pattern, subject), subject, peaks, ours, source)
    return _make_track(source.head, peaks, steps)


def _read_steps(
    path: Path, subject: str, peaks: list[PeakFrame], ours: Mapping[str, Camera],
    source: TrackSource,
) -> dict[str, FlameStep]:  # fmt: skip
    """Read the time steps of peaks, by expression."""
    table = path / "transforms.json" if path.is_dir() else path
    if table.suffix == ".json" and table.is_file():
        return _steps_of_transforms(table, subject, peaks, ours, source)
    if path.is_dir():
        # VHAP writes one per epoch; the last is the best.
        files = sorted(path.glob("tracked_flame_params*.npz"), key=lambda p: (len(p.name), p.name))
        if not files:
            raise ConfigError(
                f"{path}: holds neither transforms.json nor tracked_flame_params_*.npz"
            )
        path = files[-1]
    if path.suffix != ".npz" or not path.exists():
        found = "is another kind of file" if path.exists() else "no such file"
        raise ConfigError(f"{path}: {found}; expected a folder or {WHAT} (.npz)")
    arrays = read_arrays(path, FormatError, WHAT, ROWS)
    if "focal_length" in arrays and source.cameras is None:
        raise CalibrationError(
            f"{path}: was tracked without calibrated cameras (it has a focal_length); track it with"
            " those of the dataset, or import the folder that its export wrote"
        )
    motion = np.eye(4)
    if source.cameras is not None:
        rig = read_rig(source.cameras, None, None, 1.0)
        motion = aligning_transform(rig, ours, str(path))
    count = len(arrays["translation"])
    names = [str(n) for n in np.ravel(arrays.get("timestep_id", np.arange(count)))]
    chosen = _choose(names[:count], peaks, source.in_clip, str(path))
    return {e: _step(path, arrays, names.index(key), motion) for e, key in chosen.items()}


def _steps_of_transforms(
    file: Path, subject: str, peaks: list[PeakFrame], ours: Mapping[str, Camera],
    source: TrackSource,
) -> dict[str, FlameStep]:  # fmt: skip
    if source.cameras is not None:
        raise ConfigError(f"{file}: has cameras of its own; leave --cameras out")
    folder, table = file.parent, read_json_table(file, FormatError)
    frames = table.get("frames")
    if not frames or not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise FormatError(f"{file}: has no frames; expected the transforms.json of a tracker")
    other = folder / "export.json"
    if other.is_file() and (named := read_json_table(other, FormatError).get("subject")) != subject:
        raise StageError(f"{folder}: is of subject {named}, expected {subject}")
    rows: dict[str, dict] = {}
    cameras: dict[str, Camera] = {}
    for number, row in enumerate(frames):
        where = f"{file}: frame {number}"
        name = str(row.get("camera_id", row.get("camera_index", "")))
        if not name:
            raise FormatError(f"{where}: has no camera_id; expected the id that the dataset uses")
        cameras.setdefault(name, _camera_of(where, name, table | row, source.axes))
        rows.setdefault(str(row.get("timestep_id", row.get("timestep_index", number))), row)
    motion = aligning_transform(cameras, ours, str(file))
    chosen = _choose(list(rows), peaks, source.in_clip, str(file))
    steps = {}
    for expression, key in chosen.items():
        row = rows[key]
        if "flame_param_path" not in row:
            raise FormatError(f"{file}: its frames name no flame_param_path; export parameters")
        frame = row.get("timestep_index_original")
        peak = next(one for one in peaks if one.expression == expression)
        if key == expression and frame != peak.frame:
            raise StageError(
                f"{file}: {expression} is of frame {frame}, its peak is frame {peak.frame} now;"
                " track that frame"
            )
        member = folder / str(row["flame_param_path"])
        if not member.resolve().is_relative_to(folder.resolve()):
            raise FormatError(
                f"{file}: flame_param_path {row['flame_param_path']} points outside the folder"
            )
        steps[expression] = _step(member, read_arrays(member, FormatError, WHAT), 0, motion)
    return steps


def _camera_of(where: str, name: str, row: dict, axes: str) -> Camera:
    with refusing(CalibrationError, f"{where}: its camera cannot be read", "export it again"):
        if axes == "opencv":
            matrix = np.array(row["transform_matrix"], float)
            row = row | {"transform_matrix": (matrix @ FLIP_YZ).tolist()}
        return frame_camera(where, name, row, None)


def _choose(keys: list[str], peaks: list[PeakFrame], in_clip: bool, where: str) -> dict[str, str]:
    """Find each peak's time step by expression, else by frame; StageError if some are missing."""
    numbers: dict[int, str] = {}
    if not any(peak.expression in keys for peak in peaks):  # ids may end in numbers too
        numbers = {int(match[1]): key for key in keys if (match := NUMBER.search(key))}
    found, missing = {}, []
    for peak in peaks:
        number = peak.clip_frame if in_clip else peak.frame
        key = peak.expression if peak.expression in keys else numbers.get(number)
        if key is None:
            missing.append(f"{peak.expression} (frame {number})")
        else:
            found[peak.expression] = key
    if missing:
        raise StageError(
            f"{where}: has no time step of {few(missing, 6)}; it has"
            f" {len(keys)}: {', '.join(keys[:3])}{', ...' if keys[3:] else ''}"
        )
    return found


def _step(path: Path, arrays: Mapping[str, np.ndarray], row: int, motion: np.ndarray) -> FlameStep:
    """Take one row of arrays; FormatError if one is missing, of another shape, or not finite."""
    where = f"{path}: row {row}"
    if missing := [name for name in (*ROWS, "shape") if name not in arrays]:
        raise FormatError(f"{where}: has no {', '.join(missing)}; expected {WHAT}")
    for name in {*ROWS, "shape", *OFFSETS} & set(arrays):
        if arrays[name].dtype.kind not in "fiu":
            raise FormatError(f"{where}: {name} is {arrays[name].dtype}, expected numbers")
    found: dict[str, np.ndarray] = {}
    for name in ROWS:
        array, width = arrays[name], POSES.get(name)
        if array.ndim != 2 or row >= len(array) or width not in (None, array.shape[1]):
            raise FormatError(f"{where}: {name} is {array.shape}, expected (T, {width or 'X'})")
        found[name] = array[row].astype(np.float64)
    shared: dict[str, np.ndarray] = {"shape": np.ravel(arrays["shape"]).astype(np.float64)}
    static, dynamic = (arrays.get(name, np.zeros((0, 3))) for name in OFFSETS)
    if static.size and static.shape[-1] != 3:
        raise FormatError(f"{where}: static_offset is {static.shape}, expected (1, V, 3)")
    shared["static_offset"] = static.reshape(-1, 3).astype(np.float64)
    moving = np.abs(dynamic).max(initial=0)
    for name, array in (*found.items(), *shared.items()):
        if not np.isfinite(array).all():
            raise FormatError(f"{where}: {name} holds NaN or Inf; track the sequence again")
    return FlameStep(
        where=where, arrays=found, shared=shared, motion=motion, dynamic_mm=1e3 * float(moving)
    )


def _make_track(
    head: str, peaks: list[PeakFrame], steps: Mapping[str, FlameStep]
) -> tuple[dict[str, np.ndarray], list[Note]]:
    model = load_head(head).to(dtype=torch.float64)
    first = steps[peaks[0].expression]
    for name, value in first.shared.items():
        for step in steps.values():
            if step.shared[name].shape != value.shape or (
                value.size and np.abs(step.shared[name] - value).max() > SAME
            ):
                raise FormatError(
                    f"{step.where}: its {name} differs from {first.where}'s; a subject has one:"
                    " track its sequences together"
                )
    shape = _fitted(first.shared["shape"], model.shape_dirs.shape[2], "shape", first.where)
    given, count = first.shared["static_offset"], len(model.template)
    if len(given) > count:
        raise FormatError(
            f"{first.where}: static_offset of {len(given)} vertices, the head model has {count};"
            " name the model that it was tracked with (--head)"
        )
    offsets = np.vstack([given, np.zeros((count - len(given), 3))])
    rows = [_posed(steps[peak.expression], model, shape, offsets) for peak in peaks]
    track = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    track |= {
        "schema": np.array(SCHEMA), "head": np.array(head),
        "expressions": np.array([peak.expression for peak in peaks]),
        "frames": np.array([peak.frame for peak in peaks], np.int64),
        "shape": shape, "offsets": offsets.astype(np.float32),
    }  # fmt: skip
    moving = max(step.dynamic_mm for step in steps.values())
    why = f"displacements of single time steps, up to {moving:.2f} mm, are left out"
    return track, [Note("dynamic_offset", why)] if moving > 0 else []


def _fitted(values: np.ndarray, count: int, name: str, where: str) -> np.ndarray:
    """Cut coefficients to a head model's number; more that are not 0 are an error."""
    if np.any(values[count:]):
        raise FormatError(
            f"{where}: {len(values)} {name} coefficients, the head model has {count};"
            " name the model that it was tracked with (--head)"
        )
    return values[:count]


def _posed(
    step: FlameStep, model: HeadModel, shape: np.ndarray, offsets: np.ndarray
) -> dict[str, np.ndarray]:
    """Make one row of a track's arrays, its vertices among them."""
    arrays = step.arrays
    count = model.expression_dirs.shape[2]
    expression = _fitted(arrays["expr"], count, "expression", step.where)
    tensors = {
        name: torch.from_numpy(np.ascontiguousarray(value))[None]
        for name, value in {
            "shape": shape, "expression": expression, "offsets": offsets,
            "neck": arrays["neck_pose"], "jaw": arrays["jaw_pose"], "eyes": arrays["eyes_pose"],
        }.items()
    }  # fmt: skip
    rest = rest_vertices(model, *(tensors[k] for k in ("shape", "expression", "offsets")))[0]
    joint = (model.joint_regressor[0] @ rest).numpy()
    turn = axis_angle_to_matrix(arrays["rotation"])
    R = step.motion[:3, :3] @ turn
    t = step.motion[:3, :3] @ (arrays["translation"] + joint - turn @ joint) + step.motion[:3, 3]
    vertices = pose(model, **tensors)[0].numpy() @ R.T + t
    return {
        "expression": expression, "neck": arrays["neck_pose"], "jaw": arrays["jaw_pose"],
        "eyes": arrays["eyes_pose"], "R": R, "t": t, "vertices": vertices.astype(np.float32),
    }  # fmt: skip


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
        return np.eye(4) if np.abs(motion - np.eye(4)).max() < STILL else motion
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
