"""Write tracked heads in the layout that GaussianAvatars and VHAP read.

One time step per expression: ``images/<step>_<camera>.png``, ``fg_masks/``,
``flame_param/<step>.npz``, and ``transforms*.json`` with OpenGL camera-to-world matrices.

FLAME rotates a head about its root joint J, our tracks about the origin: R (x - J) + J + T =
R x + t gives T = t + R J - J. J is regressed from the shaped vertices, which include expression
and static offset.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_gains, read_matte, read_peak_frame
from express50.contract.layout import Dataset
from express50.dataset.export import META, Head, write_head_obj
from express50.dataset.tracks import Track
from express50.errors import UNREADABLE, ConfigError, StageError, check_known
from express50.files.atomic import dump_json
from express50.files.images import encode_png
from express50.geometry.cameras import Camera, pinhole_camera, scale_camera, transform_camera
from express50.geometry.conventions import affine_to_opencv, opengl_from_cam_from_world
from express50.geometry.pixels import resize_area, scale_light
from express50.geometry.transforms import make_transform, matrix_to_axis_angle
from express50.head.model import HeadModel, rest_vertices
from express50.head.mouth import FLAME_VERTICES as BARE_VERTICES
from express50.head.mouth import TOOTH_VERTICES

BACKGROUNDS = {"alpha": None, "white": 255, "black": 0}
FLAME_VERTICES = BARE_VERTICES + TOOTH_VERTICES  # of FLAME as this layout uses it
FLAME_SHAPES, FLAME_EXPRESSIONS = 300, 100  # readers expect that many; missing ones are zero
CANONICAL_JAW = 0.3  # radians
# Beyond this, single precision rounds by more than a micrometre, so the world is shifted by whole
# metres.
FAR_M = 16.0
NEAR_PX = 0.02  # if centring moves pixels by less than this, it is not worth an interpolation


@dataclass(frozen=True, kw_only=True)
class AvatarOptions:
    """Says how a data set is laid out."""

    background: str = "alpha"  # ``alpha`` (keep the alpha channel), or the colour behind the head
    head_only: bool = False  # use the regions stage's alpha of the head without the torso
    downscale: int = 1  # integer factor by which images are smaller than the footage
    even_colour: bool = False  # divide images by the colour gains that calibrate measured
    # expressions held out for testing; None for the last three tenths
    test_expressions: tuple[str, ...] | None = None
    validation_camera: str | None = None  # camera held out of training; None for the last one


def export_avatar(dataset: Dataset, head: Head, options: AvatarOptions, out: Path) -> dict:
    """Write one subject's data set to the empty folder ``out``; return its meta.

    Raises:
        StageError: no view of any expression has a matte.
        ConfigError: an option names a missing camera or expression.
    """
    cameras = read_cameras_of(dataset, head.subject)
    _check_options(head.track, cameras, options)
    centre = head.track.vertices.mean((0, 1), dtype=np.float64)
    far = np.abs(centre).max() > FAR_M
    shift, factor = np.rint(centre) if far else np.zeros(3), options.downscale
    targets = {name: centred(camera, factor) for name, camera in cameras.items()}
    move = make_transform(np.eye(3), -shift)
    shown = {
        name: transform_camera(scale_camera(one, 1 / factor, 1 / factor), move)
        for name, one in targets.items()
    }
    for folder in ("images", "fg_masks"):
        (out / folder).mkdir()
    frames: list[dict] = []
    steps: list[str] = []
    dropped: list[dict[str, str]] = []
    for name, frame in zip(head.track.expressions, head.track.frames.tolist(), strict=True):
        before, step = len(frames), f"{len(steps):05d}"
        paths = {"flame_param_path": f"flame_param/{step}.npz"}
        if not _is_flame(head.model):
            paths["mesh_path"] = f"meshes/{step}.obj"
        for number, (camera_id, camera) in enumerate(cameras.items()):
            file, item = f"{step}_{number:02d}.png", f"{head.subject}/{name}"
            try:
                _write_view(dataset, item, camera, targets[camera_id], options, out, file)
            except UNREADABLE as error:
                dropped.append({"what": f"{name}/{camera_id}", "why": str(error)})
                continue
            ids = {"timestep_index": len(steps), "timestep_index_original": frame,
                   "timestep_id": name, "camera_index": number}  # fmt: skip
            frames.append(ids | paths | _described(shown[camera_id], file))
        if len(frames) > before:
            steps.append(name)
    if not frames:
        reasons = "; ".join(sorted({row["why"] for row in dropped})[:3])
        raise StageError(f"{head.subject}: no view can be exported ({reasons})")
    write_parameters(head, steps, shift, out)
    _write_tables(frames, steps, sorted(cameras), options, out)
    meta = _meta(head, steps, sorted(cameras), shift, options)
    meta["cameras_centred"] = [name for name in targets if targets[name] is not cameras[name]]
    meta |= {"read": len(frames) + len(dropped), "views": len(frames), "dropped": dropped}
    (out / META).write_bytes(dump_json(meta))
    return meta


def _check_options(track: Track, cameras: dict[str, Camera], options: AvatarOptions) -> None:
    if not 1 <= options.downscale <= min(min(c.width, c.height) for c in cameras.values()):
        raise ConfigError(
            f"--downscale {options.downscale}: expected 1 (full size) to the images' shorter side"
        )
    held_out = options.test_expressions or ()
    check_known("--test-expression", "expression", held_out, track.expressions)
    if set(held_out) >= set(track.expressions):
        raise ConfigError("--test-expression: all expressions are held out; leave some to train on")
    if options.validation_camera is not None:
        check_known("--validation-camera", "camera", [options.validation_camera], cameras)


def _write_view(
    dataset: Dataset, item: str, camera: Camera, target: Camera, options: AvatarOptions, out: Path,
    file: str,
) -> None:  # fmt: skip
    """Write an undistorted frame and its matte as the target camera sees them."""
    subject, expression = item.split("/")
    path, stage = dataset.matte_file(subject, expression, camera.id), "matte"
    if options.head_only:
        path, stage = dataset.item_dir("regions", item) / f"{camera.id}_head.png", "regions"
    if not path.is_file():
        raise StageError(f"has no {path.name} from stage {stage}; run 'express50 {stage}'")
    alpha = read_matte(path, camera, stage)
    image = read_peak_frame(dataset, subject, expression, camera.id)
    gain = read_gains(dataset, subject).get(camera.id) if options.even_colour else None
    image = image if gain is None else scale_light(image, 1.0 / gain)
    image, alpha = (seen_by(one, camera, target, options.downscale) for one in (image, alpha))
    level = BACKGROUNDS[options.background]
    if level is None:  # straight alpha: colours are not multiplied by it
        data = encode_png(np.concatenate([image, alpha[..., None]], -1))
    else:
        share = alpha[..., None] / np.float32(255)
        data = encode_png(np.rint(image * share + level * (1 - share)).astype(np.uint8))
    (out / "images" / file).write_bytes(data)
    (out / "fg_masks" / file).write_bytes(encode_png(alpha))


def _described(camera: Camera, file: str) -> dict[str, object]:
    K = camera.K
    return {
        "camera_id": camera.id,
        "cx": K[0, 2], "cy": K[1, 2], "fl_x": K[0, 0], "fl_y": K[1, 1],
        "w": camera.width, "h": camera.height,
        "camera_angle_x": 2 * math.atan(camera.width / (2 * K[0, 0])),
        "camera_angle_y": 2 * math.atan(camera.height / (2 * K[1, 1])),
        "transform_matrix": opengl_from_cam_from_world(camera.cam_from_world).tolist(),
        "file_path": f"images/{file}",
        "fg_mask_path": f"fg_masks/{file}",
    }  # fmt: skip


def _write_tables(
    frames: list[dict], steps: list[str], cameras: list[str], options: AvatarOptions, out: Path
) -> None:
    held = options.test_expressions
    train = math.ceil(0.7 * len(steps))
    test = [k for k, name in enumerate(steps) if (k >= train if held is None else name in held)]
    rest = [k for k in range(len(steps)) if k not in test]
    numbers = list(range(len(cameras)))
    chosen = cameras.index(options.validation_camera) if options.validation_camera else -1
    validation = [numbers[chosen]] if len(cameras) > 1 else []
    training = [k for k in numbers if k not in validation]
    for suffix, steps_of, cameras_of in (
        ("", list(range(len(steps))), numbers),
        ("_train", rest, training),
        ("_val", rest, validation),
        ("_test", test, numbers),
    ):
        rows = [
            row
            for row in frames
            if row["timestep_index"] in steps_of and row["camera_index"] in cameras_of
        ]
        table = {"frames": rows, "timestep_indices": steps_of, "camera_indices": cameras_of}
        (out / f"transforms{suffix}.json").write_bytes(dump_json(table))


def _meta(
    head: Head, steps: list[str], cameras: list[str], shift: np.ndarray, options: AvatarOptions
) -> dict:
    flame = _is_flame(head.model)
    meta = head.meta("gaussian-avatars") | {
        "expressions": steps,
        "cameras": cameras,
        "background": options.background,
        "downscale": options.downscale,
        "even_colour": options.even_colour,
        "masks": "head" if options.head_only else "matte",
        "world_from_export": make_transform(np.eye(3), shift).tolist(),
        "vertices": "rotation about the root joint, then translation, as FLAME has it",
        "coefficients": "FLAME" if flame else "the head model's own",
    }
    if not flame:
        meta["shape_names"] = list(head.model.shape_names)
        meta["expression_names"] = list(head.model.expression_names)
        meta["meshes"] = "meshes/<step>.obj, the tracked vertices; no FLAME model gives them"
    return meta


def centred(camera: Camera, factor: int = 1) -> Camera:
    """Make a pinhole camera at the same position whose image covers the given camera's whole view.

    Its focal lengths are equal, its principal point is the image's centre, and its size is a
    multiple of ``factor``. A camera that already is like this, to NEAR_PX, is returned as it is.
    """
    K = camera.K
    f = K[0, 0]
    away = np.abs(K[:2, 2] - (camera.width / 2, camera.height / 2)).max()
    divided = camera.width % factor == camera.height % factor == 0
    if divided and away + abs(K[1, 1] / f - 1) * camera.height <= NEAR_PX:
        return camera
    width = _whole(2 * max(K[0, 2], camera.width - K[0, 2]), factor)
    height = _whole(2 * max(K[1, 2], camera.height - K[1, 2]) * f / K[1, 1], factor)
    square = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return pinhole_camera(camera.id, square, width, height, camera.cam_from_world)


def _whole(length: float, factor: int) -> int:
    """Return the least multiple of 2 * factor pixels that covers a length, up to rounding."""
    return 2 * factor * math.ceil((length - 1e-6) / (2 * factor))


def seen_by(image: np.ndarray, camera: Camera, target: Camera, factor: int = 1) -> np.ndarray:
    """Warp a pinhole camera's image (H, W[, C]) to what ``target`` sees from the same position.

    Pixels outside the source image are 0; the result is then reduced by ``factor`` by averaging.
    """
    if target is not camera:
        matrix = (target.K @ np.linalg.inv(camera.K))[:2]
        image = cv2.warpAffine(
            image, affine_to_opencv(matrix), (target.width, target.height), flags=cv2.INTER_LINEAR
        )
    if factor == 1:
        return image
    return resize_area(image, target.width // factor, target.height // factor)


def _is_flame(model: HeadModel) -> bool:
    """Return True if FLAME's coefficients give this model's vertices."""
    return re.fullmatch(r"flame-[0-9a-f]{12}(\+mouth)?", model.name) is not None


def write_parameters(head: Head, steps: list[str], shift: np.ndarray, out: Path) -> None:
    """Write a parameter file per time step, the canonical one, and meshes if not FLAME.

    ``steps`` are the expressions in time-step order; ``shift`` (3,), metres, is subtracted from
    world positions.
    """
    track, model, flame = head.track, head.model, _is_flame(head.model)
    exact = model.to(dtype=torch.float64)
    for folder in ("flame_param",) if flame else ("flame_param", "meshes"):
        (out / folder).mkdir()
    shapes = max(model.shape_dirs.shape[2], FLAME_SHAPES if flame else 0)
    count = max(model.expression_dirs.shape[2], FLAME_EXPRESSIONS if flame else 0)
    offsets = track.offsets[: FLAME_VERTICES if flame else None]
    shared: dict[str, Any] = {"shape": _padded(track.shape, shapes), "static_offset": offsets[None]}
    for number, name in enumerate(steps):
        row = track.row(name)
        own = (track.shape, track.expression[row], track.offsets)
        rest = rest_vertices(exact, *(torch.from_numpy(a.astype(np.float64))[None] for a in own))
        # FLAME rotates about the root joint.
        joint, R = (exact.joint_regressor[0] @ rest[0]).numpy(), track.R[row]
        arrays: dict[str, Any] = {
            "translation": track.t[row] - shift + R @ joint - joint,
            "rotation": matrix_to_axis_angle(R),
            "neck_pose": track.neck[row],
            "jaw_pose": track.jaw[row],
            "eyes_pose": track.eyes[row],
            "expr": _padded(track.expression[row], count),
        }
        arrays = {name: array[None].astype(np.float32) for name, array in arrays.items()}
        # NumPy dates all archive members 1980, so equal arrays give equal bytes.
        np.savez(out / "flame_param" / f"{number:05d}.npz", **shared, **arrays)
        if not flame:
            path = out / "meshes" / f"{number:05d}.obj"
            write_head_obj(path, track.vertices[row] - shift, model)
    still = {name: np.zeros_like(array) for name, array in arrays.items()}
    still["jaw_pose"][0, 0] = CANONICAL_JAW
    np.savez(out / "canonical_flame_param.npz", **shared, **still)


def _padded(values: np.ndarray, count: int) -> np.ndarray:
    return np.pad(values, (0, count - len(values))).astype(np.float32)
