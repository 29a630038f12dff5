"""Make a raw capture out of a photograph, a video of one still camera, or one of a walking camera.

The focal length of one camera is found too. Only perspective distinguishes a near face under a wide
lens from a far one under a long lens. The head model is fitted at a ladder of focal lengths; the
fit's cost shows which of them explain the landmarks as well as the best one does.
"""

from __future__ import annotations

import math
import re
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.capture.raw import IMAGE_SUFFIXES, VIDEO_SUFFIXES, hint_at_undeveloped
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track
from express50.errors import CaptureError, FormatError, StageError, rounded_down
from express50.files.atomic import dump_json, write_bytes
from express50.files.calibration import camera_rows
from express50.files.containers import read_picture
from express50.files.digests import file_sha256
from express50.files.images import (
    ORIENTATION,
    ColourProfile,
    encode_png,
    foreign_profile,
    read_exif,
    upright,
    write_image,
)
from express50.files.text import no_file
from express50.files.video import (
    VideoFootage,
    frame_times,
    iterate_video,
    video_fps,
    video_tags,
)
from express50.geometry.cameras import Camera, pinhole_camera
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.pixels import hdr_to_srgb
from express50.geometry.sampling import edge_width, evenly
from express50.head.load import load_head
from express50.head.model import landmarks_of
from express50.head.preview import render_preview
from express50.landmarks.detector import FOUND_SCORE, SMALLEST, Detection, detect, detect_many
from express50.landmarks.network import face_box, load_network
from pipelines.calibrate.footage import focal_of_film
from pipelines.track.basis import Basis, make_basis
from pipelines.track.config import TrackConfig
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, landmark_sigma, triangulate_views
from pipelines.track.read_inputs import DETECTOR_PASSES, open_landmarks
from pipelines.track.report import draw_column
from pipelines.track.schedule import LANDMARK_STEPS
from pipelines.track.state import Target, initial_pose, start_state

CAMERA = "photo"
PANEL_TILE, PANEL_YAW = 512, 60.0  # pixels; degrees
FACE_SCORE = 0.2
PROBES, FOCAL_FACES = 8, 3
# Images of a video that are searched for small faces, which takes seconds each. Images are alike if
# no cell of `CELLS` along the longer side, half as wide as the least face, differs by `ALIKE` grey
# levels.
THOROUGH, CELLS, ALIKE = 3, 64, 10.0
PHOTO_FPS = 25.0  # a photograph has no rate, but a capture must state one
# Range of possible focal lengths, in longer sides of the picture.
FOCAL_LIMITS = (0.1, 100.0)
TURNED_CRF = 12  # H.264 that looks like the source
# Suffixes read as photographs; a rig's cameras write none of the last two.
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".webp", ".bmp")
LADDER = 2.0 ** np.arange(-2.0, 2.5, 0.5)
# Two thirds of unknown lenses lie within this factor of the guess.
GUESS_FACTOR = 1.5
# Landmarks of one detection err together, so they count as this share of their number.
INDEPENDENT = 0.25
# Focal lengths whose cost is at most this much above the least are as good: two deviations.
AS_GOOD = 2.0
CONSTRAINED_FACTOR = 1.6


@dataclass(frozen=True)
class PhotoSource:
    """A photograph or video."""

    path: Path
    video: bool
    orientation: int = 1  # EXIF's, 1 is upright
    film_mm: float = 0.0  # focal length on 35 mm film of the same diagonal angle; 0 if unknown
    profile: ColourProfile | None = None  # of its colours; None: sRGB
    hdr: str = ""  # a video's curve, if that is one for high dynamic range


def open_picture(path: Path) -> PhotoSource:
    """Read a file's kind from its name, and its EXIF; CaptureError unless image or video."""
    path = Path(path)
    if path.is_dir():
        raise CaptureError(
            f"{path}: is a folder, expected a photograph or a video; the pictures of several "
            "cameras are read by 'express50 ingest'"
        )
    if not path.is_file():
        raise CaptureError(f"{path}: {no_file(path)}; expected a photograph or a video")
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        tags = video_tags(path)
        return PhotoSource(path, video=True, orientation=ORIENTATION[tags.turn], hdr=tags.hdr)
    if suffix not in PHOTO_SUFFIXES:
        raise CaptureError(
            f"{path}: not a photograph or video; expected a file name that ends in "
            f"{' '.join(PHOTO_SUFFIXES + VIDEO_SUFFIXES)}{hint_at_undeveloped([path])}"
        )
    try:
        orientation, film = read_exif(path)
        profile = foreign_profile(path)
    except FormatError as error:
        raise CaptureError(str(error)) from error
    return PhotoSource(path, False, orientation, film, profile)


def upright_frames(picture: PhotoSource) -> Iterator[np.ndarray]:
    """Decode a photograph or a whole video: frames (H, W, 3) uint8 sRGB, turned upright."""
    if not picture.video:
        path = picture.path.resolve()  # it may be a link to another place
        image = read_picture(path.parent, path.name, picture.orientation)
        yield image if picture.profile is None else picture.profile.to_srgb(image)
        return
    for _, image in iterate_video(picture.path):
        image = upright(image, picture.orientation)
        yield hdr_to_srgb(image, picture.hdr) if picture.hdr else image


@dataclass(frozen=True)
class Focal:
    """A focal length, pixels, and its evidence.

    The face is explained as well by any from `low` to `high`, within the ladder.
    """

    pixels: float
    source: str  # `given`, `exif`, `guess`, or `fit` where the face moved the guess
    low: float
    high: float

    def lines(self) -> list[str]:
        """Return the lines that say which focal length is used, and which others fit as well."""
        low, high = self.low, self.high
        words = f"from the face alone, {low:.0f} to {high:.0f} px fit as well"
        found = [f"focal length {self.pixels:.0f} px ({self.source}); {words}"]
        if not low <= self.pixels <= high:
            found.append(
                "warning: the focal length is outside this range; check it, or give --focal-px"
            )
        return found


@dataclass(frozen=True)
class PhotoCapture:
    """What was found while a capture was made."""

    focal: Focal
    search: float  # size of the smallest windows that show its faces, as a share of the longer side


def make_photo_capture(
    picture: PhotoSource,
    folder: Path,
    subject: str,
    config: TrackConfig,
    *,
    focal_px: float | None = None,
    film_mm: float = 50.0,
    windows: int = 8,
) -> PhotoCapture:
    """Write capture.toml, footage, cues and calibration; returns what was found.

    A photograph is one cue of one frame. A video is cut into `windows` cues of equal length, and
    `align` takes a frame from each for the shared shape. An earlier capture of the same file in
    `folder` is overwritten. `film_mm` is assumed where neither `focal_px` nor EXIF is known.

    Raises:
        CaptureError: the picture cannot be read or shows no face, the folder has another picture,
            or no lens has the focal length.
    """
    torch.set_num_threads(1)
    digest = file_sha256(picture.path)
    _check_folder(folder, picture.path, digest)
    # A video is decoded twice, so that not all of its frames are held.
    frames = sum(1 for _ in upright_frames(picture)) if picture.video else 1
    probes = evenly(range(frames), PROBES)
    images = [image for n, image in enumerate(upright_frames(picture)) if n in probes]
    height, width = images[0].shape[:2]
    low, high = (max(width, height) * limit for limit in FOCAL_LIMITS)
    if focal_px:
        start = focal_px, "given"
    else:
        film, source = (picture.film_mm, "exif") if picture.film_mm > 0 else (film_mm, "guess")
        start = focal_of_film(film, width, height), source
    if not low <= start[0] <= high:
        raise CaptureError(
            f"{picture.path}: its focal length is {start[0]:.4g} px ({start[1]}), expected {low:g}"
            f" to {high:g} for a picture {max(width, height)} px long; give it with --focal-px, or"
            " in millimetres on 35 mm film with --film-mm"
        )
    faces = find_faces(picture.path, images, config)
    basis = make_basis(load_head(config.head))
    surest = sorted(faces, key=lambda face: -face.score)[:FOCAL_FACES]
    focal = weigh_focal(basis, surest, (width, height), start)
    fps = video_fps(picture.path) if picture.video else PHOTO_FPS
    meta = (
        f'subject = "{subject}"\nfps = {fps:.6g}\n'
        f'focal_px = {focal.pixels:.3f}\nfocal_source = "{focal.source}"\n'
        f"focal_range_px = [{focal.low:.1f}, {focal.high:.1f}]\n"
        f'picture_sha256 = "{digest}"\n'
    )
    write_bytes(folder / "capture.toml", meta.encode())  # first: it says whose the folder is
    _write_footage(picture, folder / "cameras" / CAMERA)
    camera = single_camera(CAMERA, width, height, focal.pixels)
    write_bytes(folder / "calibration.json", dump_json(camera_rows({CAMERA: camera})))
    edges = np.unique(np.linspace(0, frames, min(windows, frames) + 1).round().astype(int))
    names = [f"clip_{n:02d}" for n in range(len(edges) - 1)] if frames > 1 else ["photo"]
    rows = zip(names, edges[:-1], edges[1:] - 1, strict=True)
    cues = "".join(f"{name},{first},{last}\n" for name, first, last in rows)
    write_bytes(folder / "cues.csv", f"expression_id,start_frame,end_frame\n{cues}".encode())
    # A face is found in windows up to three times as large, so it may shrink to a third.
    sides = [face_box(f.points)[1] / max(width, height) for f in faces if f.score >= FOUND_SCORE]
    large = picture.video and bool(sides)
    search = float(np.clip(min(sides), config.search, SMALLEST)) if large else config.search
    return PhotoCapture(focal, search)


def write_walk_capture(
    video: PhotoSource, folder: Path, subject: str, count: int, focal_px: float | None = None
) -> list[int]:
    """Write the sharpest frame of each of `count` parts of a video, as cameras of one moment.

    The camera walked around a person who holds still, so all frames have one lens. Returns
    the frames' numbers, which name the files.

    Raises:
        CaptureError: the video cannot be read or is too short, or the folder has another picture.
    """
    digest = file_sha256(video.path)
    _check_folder(folder, video.path, digest, walked=True)
    frames = len(frame_times(video.path))
    if frames < count:
        raise CaptureError(
            f"{video.path}: has {frames} frames, expected {count} or more; give a smaller number"
            " with --walk, or a longer video"
        )
    lines = [f'subject = "{subject}"', "same_lens = true", f'picture_sha256 = "{digest}"']
    lines += [f"focal_px = {focal_px:.3f}"] if focal_px else []
    write_bytes(folder / "capture.toml", "\n".join([*lines, ""]).encode())
    for earlier in folder.glob("*.jpg"):
        earlier.unlink()
    # Only those that are kept are converted from HDR, which takes a second per 4K frame.
    chosen, images = list[int](), upright_frames(replace(video, hdr=""))
    edges = np.linspace(0, frames, count + 1).round().astype(int).tolist()
    for first, end in pairwise(edges):
        part = zip(range(first, end), images, strict=False)
        found = min(part, key=lambda one: edge_width(one[1]) or math.inf, default=None)
        if found is not None:  # a video may hold fewer frames than it says
            image = hdr_to_srgb(found[1], video.hdr) if video.hdr else found[1]
            write_image(folder / f"{found[0]:05d}.jpg", image)
            chosen.append(found[0])
    return chosen


def _check_folder(folder: Path, picture: Path, digest: str, walked: bool = False) -> None:
    """Raise CaptureError if a folder holds anything but the capture of this picture."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    table = dict[str, object]()
    with suppress(OSError, ValueError):
        table = tomllib.loads((folder / "capture.toml").read_text())
    known = table.get("picture_sha256")
    if known != digest or table.get("same_lens", False) != walked:
        other = "was made from another picture" if known else "is not a capture of this picture"
        if known == digest:
            other = f"was made with{'out' if walked else ''} --walk"
        raise CaptureError(
            f"{picture}: {folder} {other}; name this one with --subject, or remove that folder"
        )


def find_faces(path: Path, images: list[np.ndarray], config: TrackConfig) -> list[Detection]:
    """Find the faces, at least one, that are surely visible in images of one person.

    Small faces are searched for only if no large one was surely found, in images that differ.
    """
    net, seen, chosen = load_network(), list[Detection](), images
    if len(images) > 1:
        seen = detect_many(net, images, DETECTOR_PASSES, max(SMALLEST, config.search))
        found = max(face.score for face in seen) >= FOUND_SCORE
        chosen = [] if found else different(images)
    seen += [detect(net, image, DETECTOR_PASSES, config.search) for image in chosen]
    faces = [face for face in seen if face.score >= FACE_SCORE]
    if not faces:
        best = rounded_down(max(face.score for face in seen))
        raise CaptureError(
            f"{path}: no face found (best score {best}, expected {FACE_SCORE} or more); use a "
            "picture that shows the whole face from the front or the side, at "
            f"least {config.search / 3:.0%} of the picture wide, or lower track.search"
        )
    return faces


def different(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Choose at most THOROUGH images that are not alike, as different as possible."""
    size = np.array(images[0].shape[1::-1])
    width, height = np.maximum(1, np.round(size * CELLS / size.max()).astype(int)).tolist()
    cells = [cv2.resize(i, (width, height), interpolation=cv2.INTER_AREA) for i in images]
    small = np.stack(cells).astype(np.float32)
    chosen = [len(images) // 2]
    apart = np.full(len(images), np.inf)
    while True:
        apart = np.minimum(apart, np.abs(small - small[chosen[-1]]).max((1, 2, 3)))
        if len(chosen) == THOROUGH or apart.max() < ALIKE:
            return [images[one] for one in sorted(chosen)]
        chosen.append(int(apart.argmax()))


def subject_id(path: Path) -> str:
    """Make a subject id from a file's name."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem).strip("_-") or "photo"


def _write_footage(picture: PhotoSource, folder: Path) -> None:
    """Copy the file, or store its pictures as stages need them: upright, and in sRGB."""
    if folder.resolve() in picture.path.resolve().parents:
        return  # made from its own copy, which the next line would delete
    # An earlier picture with another suffix would make the footage ambiguous.
    shutil.rmtree(folder, ignore_errors=True)
    suffix = picture.path.suffix.lower()
    name = f"video{suffix}" if picture.video else f"frames/000000{suffix}"
    target = folder / name
    target.parent.mkdir(parents=True)
    as_needed = picture.orientation == 1 and picture.profile is None and not picture.hdr
    if as_needed and (picture.video or suffix in IMAGE_SUFFIXES):
        try:
            shutil.copyfile(picture.path, target)
        except OSError as error:
            raise CaptureError(f"{target}: cannot be written ({error.strerror})") from error
        return
    frames = upright_frames(picture)
    first = next(frames)
    if not picture.video:
        write_bytes(target.with_suffix(".png"), encode_png(first))
        return
    height, width = first.shape[:2]
    with VideoFootage(folder, width, height, video_fps(picture.path), TURNED_CRF) as video:
        for image in chain([first], frames):
            video.write(image)


def single_camera(camera_id: str, width: int, height: int, focal: float) -> Camera:
    """Return a pinhole camera with the principal point in the middle.

    It stands at the world's origin and looks along -z; y points up.
    """
    K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    return pinhole_camera(camera_id, K, width, height, FLIP_YZ)


def weigh_focal(
    basis: Basis, detections: list[Detection], size: tuple[int, int], start: tuple[float, str]
) -> Focal:
    """Move a guessed focal length to where the fit is best, if the fit constrains it.

    A known focal length (`given`, `exif`) is kept; the range is measured all the same. The
    detections are of one person in one camera; `start` is a focal length, pixels, and its source.

    Raises:
        StageError: no focal length of the ladder explains the landmarks.
    """
    focals = start[0] * LADDER
    costs = np.array([_cost(basis, detections, size, focal) for focal in focals])
    if not np.isfinite(costs).any():
        raise StageError("no pose of a head explains the landmarks; the face may be hidden")
    evidence = INDEPENDENT * costs / len(detections)
    as_good = focals[evidence <= evidence.min() + AS_GOOD]
    low, high = float(as_good.min()), float(as_good.max())
    if start[1] != "guess" or high / low > CONSTRAINED_FACTOR**2:
        return Focal(*start, low, high)
    x = np.log(LADDER)
    y = evidence + 0.5 * (x / math.log(GUESS_FACTOR)) ** 2
    best, shift = int(np.argmin(y)), 0.0
    if 0 < best < len(x) - 1 and np.isfinite(y[best - 1 : best + 2]).all():
        # The parabola through the lowest sample and its neighbours.
        bend = float(y[best - 1] - 2 * y[best] + y[best + 1])
        shift = 0.5 * (y[best - 1] - y[best + 1]) / max(bend, 1e-12) * (x[1] - x[0])
    return Focal(start[0] * math.exp(x[best] + shift), "fit", low, high)


def _cost(basis: Basis, detections: list[Detection], size: tuple[int, int], focal: float) -> float:
    """Compute the cost of the landmark fit with a focal length; infinite where no fit starts."""
    camera = single_camera("photo", *size, focal)
    template = landmarks_of(basis.model)
    targets, poses = [], []
    for number, seen in enumerate(detections):
        view = LandmarkView(camera, seen.points, seen.sigma, seen.score)
        observation, _ = triangulate_views(f"frame {number}", number, [view])
        try:
            poses.append(initial_pose(observation, template))
        except StageError:
            return math.inf
        targets.append(Target(observation, landmark_sigma(observation), False))
    return fit(basis, targets, start_state(basis, poses), LANDMARK_STEPS)[1]


def write_panel(dataset: Dataset, subject: str, config: TrackConfig, path: Path) -> None:
    """Write the first tracked frame, its overlay and the turned head side by side."""
    track = read_track(dataset.track_file(subject))
    mesh = track.vertices[0].astype(np.float64)
    model = load_head(config.head)
    ((camera_id, camera),) = read_cameras_of(dataset, subject).items()
    image = read_peak_frame(dataset, subject, track.expressions[0], camera_id)
    source = open_landmarks(dataset, subject, config.landmarks, config.search)
    seen = source(image, camera_id, int(track.frames[0]))
    dots = [seen.face.marks(), seen.irises.centres[seen.irises.confidence > 0]]
    column = draw_column(image, camera, model.to(dtype=torch.float64), mesh, dots, PANEL_TILE)
    head = (mesh - track.t[0]) @ track.R[0]
    turned = render_preview(model, head, yaw=PANEL_YAW, size=PANEL_TILE)
    tiles = [column[:PANEL_TILE], column[PANEL_TILE:], turned]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.concatenate(tiles, axis=1), quality=90)
