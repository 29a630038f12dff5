"""Make a raw capture of one camera out of a photograph or a video."""

from __future__ import annotations

import math
import re
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from express50.capture.raw import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from express50.errors import CaptureError, FormatError
from express50.files.atomic import dump_json, write_bytes
from express50.files.calibration import camera_rows
from express50.files.containers import read_srgb8
from express50.files.digests import file_sha256
from express50.files.images import ORIENTATION, encode_png, read_exif, upright
from express50.files.video import iterate_video, video_fps, video_turn
from express50.files.video_writer import VideoFootage
from express50.head.load import load_head
from express50.landmarks.detector import Detection, detect
from express50.landmarks.network import load_network
from pipelines.photo.focal import Focal, single_camera, weigh_focal
from pipelines.track.basis import make_basis
from pipelines.track.config import TrackConfig
from pipelines.track.read_inputs import DETECTOR_PASSES

CAMERA = "photo"
FACE_SCORE = 0.2
PROBES, FOCAL_FACES = 8, 3
PHOTO_FPS = 25.0  # a photograph has no rate, but a capture must state one
# Range of possible focal lengths, in longer sides of the picture.
FOCAL_LIMITS = (0.1, 100.0)
TURNED_CRF = 12  # H.264 that looks like the source
# Read as photographs; a rig's cameras write none of the last two.
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".webp", ".bmp")
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class PhotoSource:
    """A photograph or video and the facts in its name and EXIF.

    Attributes:
        path: the file.
        video: whether it is a video.
        orientation: EXIF's, 1 to 8, or what a video's container says in its terms; 1 where its
            pixels lie upright.
        film_mm: focal length on 35 mm film with the same diagonal angle of view; 0 where EXIF
            has none.
    """

    path: Path
    video: bool
    orientation: int = 1
    film_mm: float = 0.0


def open_picture(path: Path) -> PhotoSource:
    """Read a file's kind from its name, and its EXIF.

    Raises:
        CaptureError: no such file, or neither an image nor a video.
    """
    path = Path(path)
    if path.is_dir():
        raise CaptureError(
            f"{path}: is a folder, expected a photograph or a video; the pictures of several "
            "cameras are read by 'express50 ingest'"
        )
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; expected a photograph or a video")
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        turns = video_turn(path)
        return PhotoSource(path, video=True, orientation=ORIENTATION[turns])
    if suffix not in PHOTO_SUFFIXES:
        raise CaptureError(
            f"{path}: is not a photograph or video by its name; expected one of "
            f"{' '.join(PHOTO_SUFFIXES + VIDEO_SUFFIXES)}"
        )
    try:
        orientation, film = read_exif(path)
    except FormatError as error:
        raise CaptureError(str(error)) from error
    return PhotoSource(path, video=False, orientation=orientation, film_mm=film)


def read_upright(picture: PhotoSource) -> np.ndarray:
    """Read a photograph (H, W, 3) uint8 sRGB, turned upright.

    Raises:
        CaptureError: it is damaged.
    """
    return upright(read_srgb8(picture.path), picture.orientation)


def upright_frames(picture: PhotoSource) -> Iterator[np.ndarray]:
    """Decode a whole video (H, W, 3) uint8 sRGB, turned upright."""
    for _, image in iterate_video(picture.path):
        yield upright(image, picture.orientation)


def spread_frames(picture: PhotoSource, count: int) -> tuple[list[np.ndarray], int]:
    """Read up to `count` frames spread over a picture; returns them and the number of all.

    A video is decoded twice, so that not all of its frames are held.
    """
    if not picture.video:
        return [read_upright(picture)], 1
    frames = sum(1 for _ in upright_frames(picture))
    wanted = set(np.unique(np.linspace(0, frames - 1, count).round().astype(int)).tolist())
    return [image for n, image in enumerate(upright_frames(picture)) if n in wanted], frames


def guess_focal(picture: PhotoSource, width: int, height: int, film_mm: float) -> tuple[float, str]:
    """Guess the focal length in pixels; the source is `exif`, else `guess` by `film_mm`."""
    diagonal = math.hypot(width, height)
    if picture.film_mm > 0:
        return picture.film_mm / FILM_DIAGONAL_MM * diagonal, "exif"
    return film_mm / FILM_DIAGONAL_MM * diagonal, "guess"


def make_photo_capture(
    picture: PhotoSource,
    folder: Path,
    subject: str,
    config: TrackConfig,
    *,
    focal_px: float | None = None,
    film_mm: float = 50.0,
    windows: int = PROBES,
) -> Focal:
    """Write capture.toml, footage, cues and calibration; returns the focal length used.

    A photograph is one cue of one frame; a video is cut into `windows` cues of equal length, from
    each of which `align` takes a frame for the shared shape.

    Args:
        picture: from `open_picture`.
        folder: of the capture; an earlier capture of the same file is overwritten.
        subject: subject id.
        config: settings of the fit that compares focal lengths.
        focal_px: focal length, pixels, where it is known.
        film_mm: focal length on 35 mm film to assume where it is unknown.
        windows: cues of a video.

    Raises:
        CaptureError: the picture cannot be read or shows no face, the folder has another picture,
            or the focal length is that of no lens.
    """
    torch.set_num_threads(1)
    _check_same(picture.path, folder)
    images, frames = spread_frames(picture, PROBES)
    height, width = images[0].shape[:2]
    _check_focal(focal_px, max(width, height))
    fps = video_fps(picture.path) if picture.video else PHOTO_FPS
    faces = find_faces(picture.path, images, config)
    start = (focal_px, "given") if focal_px else guess_focal(picture, width, height, film_mm)
    basis = make_basis(load_head(config.head))
    surest = sorted(faces, key=lambda face: -face.score)[:FOCAL_FACES]
    focal = weigh_focal(basis, surest, (width, height), start)
    _write_footage(picture, folder / "cameras" / CAMERA)
    camera = single_camera(CAMERA, width, height, focal.pixels)
    write_bytes(folder / "calibration.json", dump_json(camera_rows({CAMERA: camera})))
    write_bytes(folder / "cues.csv", _cues(frames, windows).encode())
    meta = _meta(subject, fps, focal, file_sha256(picture.path))
    write_bytes(folder / "capture.toml", meta.encode())
    return focal


def _check_same(path: Path, folder: Path) -> None:
    """Refuse to overwrite the capture of another picture."""
    try:
        known = tomllib.loads((folder / "capture.toml").read_text()).get("picture_sha256")
    except (OSError, ValueError):  # nothing is there, or nothing that could be lost
        return
    if known is not None and known != file_sha256(path):
        raise CaptureError(
            f"{path}: {folder} was made of another picture; name this one with --subject, or "
            "remove that folder"
        )


def _check_focal(focal_px: float | None, side: int) -> None:
    """Refuse an impossible focal length."""
    low, high = (side * limit for limit in FOCAL_LIMITS)
    if focal_px is not None and not low <= focal_px <= high:
        raise CaptureError(
            f"--focal-px {focal_px:g}: expected {low:g} to {high:g} for a picture {side} px long; "
            "millimetres on 35 mm film go to --film-mm"
        )


def find_faces(path: Path, images: list[np.ndarray], config: TrackConfig) -> list[Detection]:
    """Find the faces that are surely visible in images of one person, at least one.

    Raises:
        CaptureError: there is none.
    """
    net = load_network()
    seen = [detect(net, image, DETECTOR_PASSES, config.search) for image in images]
    faces = [face for face in seen if face.score >= FACE_SCORE]
    if not faces:
        best = max(face.score for face in seen)
        raise CaptureError(
            f"{path}: no face found (best score {best:.2f}, expected {FACE_SCORE} or more); give a "
            "picture in which the face is seen from the front or the side, whole, and at "
            f"least {config.search / 3:.0%} of the picture wide, or lower track.search"
        )
    return faces


def subject_id(path: Path) -> str:
    """Make a subject id from a file's name."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem).strip("_-")
    return name or "photo"


def _write_footage(picture: PhotoSource, folder: Path) -> None:
    """Copy the file; a turned one, or one of a kind that no stage reads, is stored upright."""
    # A former picture of another kind or suffix would make the footage ambiguous.
    shutil.rmtree(folder, ignore_errors=True)
    suffix = picture.path.suffix.lower()
    name = f"video{suffix}" if picture.video else f"frames/000000{suffix}"
    target = folder / name
    target.parent.mkdir(parents=True)
    if not picture.video and (picture.orientation != 1 or suffix not in IMAGE_SUFFIXES):
        write_bytes(target.with_suffix(".png"), encode_png(read_upright(picture)))
        return
    if picture.orientation != 1:
        _turn_video(picture, folder)
        return
    try:
        shutil.copyfile(picture.path, target)
    except OSError as error:
        raise CaptureError(f"{target}: cannot be written ({error.strerror})") from error


def _turn_video(picture: PhotoSource, folder: Path) -> None:
    """Encode a video again, upright."""
    frames = upright_frames(picture)
    first = next(frames)
    height, width = first.shape[:2]
    with VideoFootage(folder, width, height, video_fps(picture.path), TURNED_CRF) as video:
        for image in chain([first], frames):
            video.write(image)


def _cues(frames: int, windows: int) -> str:
    """Format cues.csv: `photo`, or `clip_00` and so on."""
    rows = ["expression_id,start_frame,end_frame"]
    if frames == 1:
        return "\n".join([*rows, "photo,0,0"]) + "\n"
    edges = np.unique(np.linspace(0, frames, min(windows, frames) + 1).round().astype(int))
    pairs = zip(edges[:-1], edges[1:], strict=True)
    rows += [f"clip_{n:02d},{a},{b - 1}" for n, (a, b) in enumerate(pairs)]
    return "\n".join(rows) + "\n"


def _meta(subject: str, fps: float, focal: Focal, sha256: str) -> str:
    """Format capture.toml."""
    return (
        f'subject = "{subject}"\nfps = {fps:.6g}\n'
        f'focal_px = {focal.pixels:.3f}\nfocal_source = "{focal.source}"\n'
        f"focal_range_px = [{focal.low:.1f}, {focal.high:.1f}]\n"
        f'picture_sha256 = "{sha256}"\n'
    )
