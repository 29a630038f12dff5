"""Tracked heads in the layout that GaussianAvatars and VHAP read.

One time step per expression: ``images/<step>_<camera>.png``, ``fg_masks/``,
``flame_param/<step>.npz``, and ``transforms*.json`` with OpenGL camera-to-world matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_gains, read_peak_frame
from express50.contract.layout import Dataset
from express50.dataset.export.parameters import export_shift, is_flame, write_parameters
from express50.dataset.export.select import META, SCHEMA, Head
from express50.dataset.tracks import Track
from express50.errors import CaptureError, ConfigError, FormatError, StageError
from express50.files.atomic import dump_json
from express50.files.images import encode_png, read_alpha, resize_area, scale_light
from express50.geometry.cameras import Camera, pinhole_camera, scale_camera, transform_camera
from express50.geometry.conventions import affine_to_opencv, opengl_from_cam_from_world

BACKGROUNDS = {"alpha": None, "white": 255, "black": 0}


@dataclass(frozen=True, kw_only=True)
class AvatarOptions:
    """Says how a data set is laid out.

    Attributes:
        background: ``alpha`` (pictures keep it), or the colour behind the head.
        head_only: alpha of the head without the torso, from the regions stage.
        downscale: whole number of times that pictures are smaller than the footage.
        even_colour: divide each camera's colour gain, as calibrate measured it, out of its light.
        test_expressions: those held back for testing; None: the last three tenths.
        validation_camera: held back in training; None: the last.
    """

    background: str = "alpha"
    head_only: bool = False
    downscale: int = 1
    even_colour: bool = False
    test_expressions: tuple[str, ...] | None = None
    validation_camera: str | None = None


def export_avatar(dataset: Dataset, head: Head, options: AvatarOptions, out: Path) -> dict:
    """Write one subject's data set into the empty folder ``out``; returns its meta.

    Raises:
        StageError: no view of any expression has a matte.
        ConfigError: an option names a missing camera or expression.
    """
    cameras = read_cameras_of(dataset, head.subject)
    _check_options(head.track, cameras, options)
    shift = export_shift(head.track)
    frames: list[dict] = []
    steps: list[str] = []
    dropped: list[dict[str, str]] = []
    for name in head.track.expressions:
        rows, lost = _write_views(dataset, head, name, cameras, len(steps), options, out)
        dropped += lost
        if rows:
            frames += rows
            steps.append(name)
    if not frames:
        reasons = "; ".join(sorted({row["why"] for row in dropped})[:3])
        raise StageError(f"{head.subject}: no view can be exported ({reasons})")
    flame = is_flame(head.model)
    write_parameters(head, steps, shift, out)
    factor = options.downscale
    targets = {name: centred(camera, factor) for name, camera in cameras.items()}
    shown = {name: scale_camera(one, 1 / factor, 1 / factor) for name, one in targets.items()}
    described = [_described(row, shown, shift, flame) for row in frames]
    _write_tables(described, steps, sorted(cameras), options, out)
    meta = _meta(head, steps, sorted(cameras), shift, options)
    meta["cameras_centred"] = [name for name in targets if targets[name] is not cameras[name]]
    meta |= {"read": len(frames) + len(dropped), "views": len(frames), "dropped": dropped}
    (out / META).write_bytes(dump_json(meta))
    return meta


def _check_options(track: Track, cameras: dict[str, Camera], options: AvatarOptions) -> None:
    if not 1 <= options.downscale <= min(min(c.width, c.height) for c in cameras.values()):
        raise ConfigError(
            f"downscale {options.downscale}: expected 1 (full size) up to the images' height"
        )
    unknown = sorted(set(options.test_expressions or ()) - set(track.expressions))
    if unknown:
        raise ConfigError(
            f"test expressions {', '.join(unknown)}: expected some of"
            f" {', '.join(track.expressions)}"
        )
    if set(options.test_expressions or ()) >= set(track.expressions):
        raise ConfigError("test expressions: all of them are, which leaves none to train on")
    if options.validation_camera not in (None, *cameras):
        raise ConfigError(
            f"validation camera {options.validation_camera!r}: expected one of {', '.join(cameras)}"
        )


def _write_views(
    dataset: Dataset,
    head: Head,
    expression: str,
    cameras: dict[str, Camera],
    step: int,
    options: AvatarOptions,
    out: Path,
) -> tuple[list[dict], list[dict[str, str]]]:
    """Write the pictures and masks of one time step; return table rows and what was dropped."""
    rows, dropped = [], []
    frame = int(head.track.frames[head.track.row(expression)])
    for number, (name, camera) in enumerate(cameras.items()):
        try:
            image, alpha = _read_view(
                dataset, f"{head.subject}/{expression}", camera, frame, options
            )
        except (CaptureError, FormatError, StageError) as error:
            dropped.append({"what": f"{expression}/{name}", "why": str(error)})
            continue
        factor = options.downscale
        target = centred(camera, factor)
        image, alpha = (seen_by(one, camera, target, factor) for one in (image, alpha))
        level = BACKGROUNDS[options.background]
        shown = rgba_png(image, alpha) if level is None else encode_png(
            flattened(image, alpha, level)
        )  # fmt: skip
        file = f"{step:05d}_{number:02d}.png"
        for folder, data in (("images", shown), ("fg_masks", encode_png(alpha))):
            (out / folder).mkdir(exist_ok=True)
            (out / folder / file).write_bytes(data)
        rows.append({"step": step, "number": number, "camera": name, "file": file, "frame": frame,
                     "expression": expression})  # fmt: skip
    return rows, dropped


def _read_view(
    dataset: Dataset, item: str, camera: Camera, frame: int, options: AvatarOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Read an undistorted frame (H, W, 3) uint8 and its alpha (H, W) uint8."""
    subject, expression = item.split("/")
    path, stage = dataset.matte_file(subject, expression, camera.id), "matte"
    if options.head_only:
        path, stage = dataset.item_dir("regions", item) / f"{camera.id}_head.png", "regions"
    if not path.is_file():
        raise StageError(f"it has no {path.name} of stage {stage}; run 'express50 {stage}'")
    alpha = read_alpha(path)
    if alpha.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path}: {alpha.shape[1]}x{alpha.shape[0]}, expected the camera's"
            f" {camera.width}x{camera.height}; run 'express50 {stage}' again"
        )
    image = read_peak_frame(dataset, subject, expression, camera.id)
    if options.even_colour:
        gain = read_gains(dataset, subject).get(camera.id)
        image = image if gain is None else scale_light(image, 1.0 / gain)
    return image, alpha


def _described(
    row: dict, cameras: dict[str, Camera], shift: np.ndarray, flame: bool
) -> dict[str, object]:
    """Make one frame of transforms.json."""
    move = np.eye(4)
    move[:3, 3] = -shift
    camera = transform_camera(cameras[row["camera"]], move)
    K = camera.K
    step = f"{row['step']:05d}"
    return {
        "timestep_index": row["step"],
        "timestep_index_original": row["frame"],
        "timestep_id": row["expression"],
        "camera_index": row["number"],
        "camera_id": row["camera"],
        "cx": K[0, 2], "cy": K[1, 2], "fl_x": K[0, 0], "fl_y": K[1, 1],
        "w": camera.width, "h": camera.height,
        "camera_angle_x": 2 * math.atan(camera.width / (2 * K[0, 0])),
        "camera_angle_y": 2 * math.atan(camera.height / (2 * K[1, 1])),
        "transform_matrix": opengl_from_cam_from_world(camera.cam_from_world).tolist(),
        "file_path": f"images/{row['file']}",
        "fg_mask_path": f"fg_masks/{row['file']}",
        "flame_param_path": f"flame_param/{step}.npz",
    } | ({} if flame else {"mesh_path": f"meshes/{step}.obj"})  # fmt: skip


def _write_tables(
    frames: list[dict], steps: list[str], cameras: list[str], options: AvatarOptions, out: Path
) -> None:
    """Write transforms.json and its division into training, validation and test."""
    held = options.test_expressions
    train = math.ceil(0.7 * len(steps))
    test = [k for k, name in enumerate(steps) if (k >= train if held is None else name in held)]
    rest = [k for k in range(len(steps)) if k not in test]
    numbers = list(range(len(cameras)))
    chosen = cameras.index(options.validation_camera) if options.validation_camera else -1
    validation = [numbers[chosen]] if len(cameras) > 1 else []
    training = [k for k in numbers if k not in validation]
    for suffix, steps_of, cameras_of in (
        ("", range(len(steps)), numbers),
        ("_train", rest, training),
        ("_val", rest, validation),
        ("_test", test, numbers),
    ):
        rows = [
            row
            for row in frames
            if row["timestep_index"] in steps_of and row["camera_index"] in cameras_of
        ]
        table = {
            "frames": rows,
            "timestep_indices": list(steps_of),
            "camera_indices": list(cameras_of),
        }
        (out / f"transforms{suffix}.json").write_bytes(dump_json(table))


def _meta(
    head: Head,
    steps: list[str],
    cameras: list[str],
    shift: np.ndarray,
    options: AvatarOptions,
) -> dict:
    world_from_export = np.eye(4)
    world_from_export[:3, 3] = shift
    meta = {
        "schema": SCHEMA,
        "format": "gaussian-avatars",
        "subject": head.subject,
        "head": head.model.name,
        "expressions": steps,
        "cameras": cameras,
        "background": options.background,
        "downscale": options.downscale,
        "even_colour": options.even_colour,
        "masks": "head" if options.head_only else "matte",
        "units": "metres",
        "world_from_export": world_from_export.tolist(),
        "vertices": "rotation about the root joint, then translation, as FLAME has it",
        "coefficients": "FLAME" if is_flame(head.model) else "the head model's own",
    }
    if not is_flame(head.model):
        meta["shape_names"] = list(head.model.shape_names)
        meta["expression_names"] = list(head.model.expression_names)
        meta["meshes"] = "meshes/<step>.obj, the tracked vertices; no FLAME model gives them"
    return meta


NEAR_PX = 0.02  # what centring would move pixels by at most: not worth an interpolation


def centred(camera: Camera, factor: int = 1) -> Camera:
    """A pinhole camera at the same place whose image holds the given one's whole view.

    Its focal lengths are equal, its principal point is the middle, and ``factor`` divides its size.
    The camera itself, where that is true of it already, to NEAR_PX.
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
    """Even number of pixels, a multiple of the factor, that holds a length, rounding aside."""
    return 2 * factor * math.ceil((length - 1e-6) / (2 * factor))


def seen_by(image: np.ndarray, camera: Camera, target: Camera, factor: int = 1) -> np.ndarray:
    """Image (H, W[, C]) of a pinhole camera as ``target``, at the same place, has it; 0 outside.

    It is made ``factor`` times smaller by averaging.
    """
    if target is not camera:
        matrix = (target.K @ np.linalg.inv(camera.K))[:2]
        image = cv2.warpAffine(
            image, affine_to_opencv(matrix), (target.width, target.height), flags=cv2.INTER_LINEAR
        )
    if factor == 1:
        return image
    return resize_area(image, target.width // factor, target.height // factor)


def rgba_png(image: np.ndarray, alpha: np.ndarray) -> bytes:
    """PNG bytes of an image (H, W, 3) uint8 with opacity (H, W) uint8, colours not multiplied."""
    pixels = np.ascontiguousarray(np.concatenate([image[..., ::-1], alpha[..., None]], -1))
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def flattened(image: np.ndarray, alpha: np.ndarray, level: int) -> np.ndarray:
    """Image (H, W, 3) uint8 over a grey background of one level, by alpha (H, W) uint8."""
    share = alpha[..., None] / np.float32(255)
    return np.rint(image * share + level * (1 - share)).astype(np.uint8)
