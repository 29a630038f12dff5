"""Make a raw capture of one camera out of a photograph or a video."""

from __future__ import annotations

import re
import shutil
import tomllib
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from express50.capture.raw import IMAGE_SUFFIXES
from express50.errors import CaptureError
from express50.files.atomic import dump_json, write_bytes
from express50.files.calibration import camera_rows
from express50.files.digests import file_sha256
from express50.files.images import encode_png
from express50.files.video import video_fps
from express50.files.video_writer import VideoFootage
from express50.head.load import load_head
from express50.landmarks.detector import Detection, detect
from express50.landmarks.network import load_network
from pipelines.photo.focal import Focal, single_camera, weigh_focal
from pipelines.photo.picture import (
    Picture,
    guess_focal,
    read_upright,
    spread_frames,
    upright_frames,
)
from pipelines.track.basis import make_basis
from pipelines.track.config import TrackConfig
from pipelines.track.read_inputs import DETECTOR_PASSES

CAMERA = "photo"
FACE_SCORE = 0.2
PROBES, FOCAL_FACES = 8, 3
PHOTO_FPS = 25.0  # a photograph has no rate, a capture must say one
# Focal lengths, in longer sides of the picture, beyond which none is a lens before a face.
FOCAL_LIMITS = (0.1, 100.0)
TURNED_CRF = 12  # H.264 that no eye tells from the source


def make_photo_capture(
    picture: Picture,
    folder: Path,
    subject: str,
    config: TrackConfig,
    *,
    focal_px: float | None = None,
    film_mm: float = 50.0,
    windows: int = PROBES,
) -> Focal:
    """Write capture.toml, footage, cues and calibration; returns the focal length that was taken.

    A photograph is one cue of one frame; a video is cut into `windows` cues of equal length, from
    each of which `align` takes a frame for the shared shape.

    Args:
        picture: from `open_picture`.
        folder: of the capture; what was made of the same file is written over.
        subject: subject id.
        config: of the fit that weighs focal lengths.
        focal_px: focal length, pixels, where it is known.
        film_mm: focal length on 35 mm film to assume where nothing is told.
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
    """Refuse to write over what was made of another picture."""
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
    """Refuse a focal length that no lens has."""
    low, high = (side * limit for limit in FOCAL_LIMITS)
    if focal_px is not None and not low <= focal_px <= high:
        raise CaptureError(
            f"--focal-px {focal_px:g}: expected {low:g} to {high:g} for a picture {side} px long; "
            "millimetres on 35 mm film go to --film-mm"
        )


def find_faces(path: Path, images: list[np.ndarray], config: TrackConfig) -> list[Detection]:
    """The faces that are surely seen in images of one person, at least one.

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
    """A subject id out of a file's name."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem).strip("_-")
    return name or "photo"


def _write_footage(picture: Picture, folder: Path) -> None:
    """Copy the file; what lies on its side, or is of a kind no stage reads, is stored anew."""
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


def _turn_video(picture: Picture, folder: Path) -> None:
    """Encode a video again, upright."""
    frames = upright_frames(picture)
    first = next(frames)
    height, width = first.shape[:2]
    with VideoFootage(folder, width, height, video_fps(picture.path), TURNED_CRF) as video:
        for image in chain([first], frames):
            video.write(image)


def _cues(frames: int, windows: int) -> str:
    """Content of cues.csv: `photo`, or `clip_00` and so on."""
    rows = ["expression_id,start_frame,end_frame"]
    if frames == 1:
        return "\n".join([*rows, "photo,0,0"]) + "\n"
    edges = np.unique(np.linspace(0, frames, min(windows, frames) + 1).round().astype(int))
    pairs = zip(edges[:-1], edges[1:], strict=True)
    rows += [f"clip_{n:02d},{a},{b - 1}" for n, (a, b) in enumerate(pairs)]
    return "\n".join(rows) + "\n"


def _meta(subject: str, fps: float, focal: Focal, sha256: str) -> str:
    """Content of capture.toml."""
    return (
        f'subject = "{subject}"\nfps = {fps:.6g}\n'
        f'focal_px = {focal.pixels:.3f}\nfocal_source = "{focal.source}"\n'
        f"focal_range_px = [{focal.low:.1f}, {focal.high:.1f}]\n"
        f'picture_sha256 = "{sha256}"\n'
    )
