"""Read the pixels of a dataset: peak frames, clean plates, proxies and recorded footage.

Stages after ``frames`` read the peak frames and plates that it wrote (``read_peak_frame``,
``read_plate_image``). ``FrameReader`` and ``FootageReader`` decode the footage itself.

Pictures are what the ``frames`` stage makes of recorded frames: undistorted, and reduced if its
settings say so. ``make_picture`` and ``read_cameras_of`` are where pictures and cameras meet.
"""

from __future__ import annotations

from pathlib import Path
from threading import Lock

import cv2
import numpy as np
import tifffile

from express50.capture.colour_correction import correct_srgb
from express50.capture.index import (
    UNKNOWN_HASH,
    CameraSource,
    Index,
    nearest_decoded,
    read_index,
    same_hash,
)
from express50.capture.raw import RawCamera
from express50.contract.layout import Dataset
from express50.errors import CaptureError, FormatError, StageError, advised, check_known
from express50.files.calibration import read_cameras
from express50.files.containers import inside, read_picture, read_srgb
from express50.files.digests import cached_by_file
from express50.files.images import decode_image, read_alpha, read_image, upright
from express50.files.text import read_json, read_json_table, refusing
from express50.files.video import VideoReader
from express50.geometry.cameras import Camera, pinhole, resized
from express50.geometry.pixels import reduce_light, shrink
from express50.geometry.sampling import undistort_image

STRIP = 64  # rows that `write_frame` compresses together
BLOCK = 24  # neighbouring frames whose proxies are made together
BLOCKS = 12  # kept in memory, 10 MB each at 480 pixels
_Footage = tuple[Dataset, str, str, Path]  # dataset, subject, camera, and where the footage lies
_READING = Lock()  # one thread at a time reads footage for `read_proxy`


def dhash(image: np.ndarray) -> str:
    """Compute the 64-bit difference hash of an image (H, W, 3) uint8 as 16 hexadecimal digits.

    The image is averaged to 8 rows of 9 grey cells; each bit says whether a cell is darker than
    its right neighbour. Source: N. Krawetz, "Kind of like that", 2013.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    if height % 8 == 0 and width >= 9:
        # OpenCV takes 23 ms at 4K, and its means are up to 0.005 off before it rounds them. These
        # take 1 ms and say which bits such an error cannot change.
        bands = [cv2.reduce(b, 0, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[0] for b in np.split(grey, 8)]
        up_to = np.pad(np.cumsum(bands, axis=1, dtype=np.int64), ((0, 0), (1, 0)))
        ends = np.linspace(0, width, 10)
        sums = np.diff([np.interp(ends, np.arange(width + 1), row) for row in up_to])
        means = sums / (height / 8 * width / 9)
        least, most = np.rint(means - 0.01), np.rint(means + 0.01)
        sure = most[:, :-1] < least[:, 1:]
        if (sure == (least[:, :-1] < most[:, 1:])).all():
            return np.packbits(sure).tobytes().hex()
    cells = cv2.resize(grey, (9, 8), interpolation=cv2.INTER_AREA)
    return np.packbits(cells[:, :-1] < cells[:, 1:]).tobytes().hex()


class FrameReader:
    """Reads full-resolution frames of one camera; reading forward is quick."""

    def __init__(self, index: Index, camera_id: str) -> None:
        check_known(index.subject, "camera", [camera_id], index.cameras, CaptureError)
        self.camera_id = camera_id
        self.source = index.cameras[camera_id]
        self.path = index.capture / self.source.source
        if not index.capture.exists():
            raise CaptureError(
                f"{index.capture}: no such folder or file; if the capture has moved, run"
                " 'express50 ingest' with its new path"
            )
        self._clip = 0
        self._video: VideoReader | None = None

    def read(self, frame: int, exact: bool = False) -> np.ndarray:
        """Read an image (H, W, 3) uint8 sRGB by decode index, colours corrected, not undistorted.

        `exact` colours of a video take longer to make (`VideoReader.read_exactly`).

        Raises:
            CaptureError: there is no such frame, or the footage changed since it was ingested.
        """
        if not 0 <= frame < self.source.frames:
            raise CaptureError(
                f"{self.path}: frame {frame} does not exist, expected 0 to {self.source.frames - 1}"
            )
        orientation, expected = self.source.orientation, self.source.dhash[frame]
        video: VideoReader | None = None
        if self.source.kind == "frames":
            name = self.source.names[frame]
            file, image = f"{self.path}/{name}", read_picture(self.path, name, orientation)
        else:
            video, number = self._video_of(frame)
            file = str(video.path)
            image = upright(video.read(number), orientation)
        found = dhash(image)
        if not same_hash(found, expected) and video is not None:
            # After a seek a decoder may hide a missing reference frame; from the start it cannot.
            video.restart()
            found = dhash(image := upright(video.read(number), orientation))
        if not same_hash(found, expected):
            raise CaptureError(
                f"{file}: frame {frame} has hash {found}, but the index has {expected}; "
                "the footage, or how this version reads it, changed since it was ingested: run"
                " 'express50 ingest' again"
            )
        if exact and video is not None:
            image = upright(video.read_exactly(number), orientation)
        return corrected(image, self.source)

    def key_frame(self, frame: int) -> int:
        """Return the last frame up to this one that is read without decoding others."""
        if self.source.kind == "frames":
            return frame
        video, number = self._video_of(frame)
        return frame - number + video.key_frame(number)

    def _video_of(self, frame: int) -> tuple[VideoReader, int]:
        """Find the video that holds a frame, and the frame's number in it; one stays open."""
        starts = np.concatenate([[0], np.cumsum(self.source.clips or (self.source.frames,))])
        clip = int(np.searchsorted(starts, frame, side="right")) - 1
        first, last = int(starts[clip]), int(starts[clip + 1])
        if self._video is None or clip != self._clip:
            self.close()
            names = self.source.names
            path = inside(self.path, names[clip]) if names else self.path
            self._video = VideoReader(path, self.source.pts[first:last])
            self._clip = clip
        return self._video, frame - first

    def close(self) -> None:
        """Close the video, if there is one."""
        if self._video is not None:
            self._video.close()
            self._video = None


def corrected(image: np.ndarray, source: CameraSource | RawCamera) -> np.ndarray:
    """Apply the camera's own colour correction, if it has one, to an image (H, W, 3)."""
    return correct_srgb(image, source.correction) if source.correction else image


class FootageReader:
    """Reads pictures of all cameras of a subject; videos stay open, so reading forward is quick."""

    def __init__(self, dataset: Dataset, subject: str) -> None:
        """Read index and cameras, open no video; StageError before ingest and calibrate."""
        self._index = read_index(dataset, subject)
        self._cameras = read_recorded_cameras(dataset, subject)
        self._sizes = picture_sizes(dataset, subject)
        self._readers: dict[str, FrameReader] = {}

    def read(self, camera_id: str, frame: int) -> np.ndarray:
        """Make the picture (H, W, 3) uint8 sRGB of a frame, given by its decode index.

        Raises:
            CaptureError: the camera or the frame does not exist, or the footage has changed.
            StageError: the camera is not calibrated.
        """
        if camera_id not in self._readers:
            self._readers[camera_id] = FrameReader(self._index, camera_id)
        image = self._readers[camera_id].read(frame)
        subject = self._index.subject
        check_known(subject, "calibrated camera", [camera_id], self._cameras, StageError)
        camera = self._cameras[camera_id]
        return make_picture(image, camera, self._sizes.get(camera_id, _size_of(camera)))

    def __enter__(self) -> FootageReader:
        return self

    def __exit__(self, *unused: object) -> None:
        for reader in self._readers.values():
            reader.close()


def read_recorded_plate(index: Index, camera_id: str) -> np.ndarray:
    """Read a clean plate (H, W, 3) uint8 sRGB as recorded: colours corrected, not undistorted.

    Raises:
        CaptureError: it cannot be read, or its size differs from the footage's.
    """
    path = index.capture / index.plates[camera_id]
    image = read_srgb(path)
    source = index.cameras[camera_id]
    if image.shape[:2] != (source.height, source.width):
        raise CaptureError(
            f"{path}: the plate is {image.shape[1]}x{image.shape[0]}, the footage of {camera_id} "
            f"is {source.width}x{source.height}; record the plate with the same camera settings"
        )
    return corrected(image, source)


def write_frame(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8 losslessly as TIFF; equal images give equal bytes.

    Frames are read about nine times: this format is decoded six times as fast as JPEG XL, for up to
    a quarter more bytes (docs/LOG.md).
    """
    tifffile.imwrite(
        path, np.ascontiguousarray(image), photometric="rgb", predictor=True, rowsperstrip=STRIP,
        compression="deflate", compressionargs={"level": 1}, maxworkers=1, metadata=None,
        software=False,
    )  # fmt: skip


def read_peak_frame(dataset: Dataset, subject: str, expression: str, camera_id: str) -> np.ndarray:
    """Read a peak frame (H, W, 3) uint8 sRGB, as the pinhole camera of ``read_cameras_of`` sees it.

    Raises:
        CaptureError: the frames stage has not written it, its size differs from the subject's other
            pictures, or it cannot be read.
    """
    path = dataset.frame_file(subject, expression, camera_id)
    if not path.is_file():
        raise CaptureError(
            f"{path}: no frame of {camera_id}; run {advised('express50 frames', dataset.root)}, or"
            f" see {advised('express50 status', dataset.root)} for the reason"
        )
    return read_written(path, picture_sizes(dataset, subject).get(camera_id))


def read_matted_frame(dataset: Dataset, item: str, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Read a camera's peak frame (H, W, 3) uint8 of `subject/expression`, and its matte (H, W).

    Raises:
        StageError: the frame has no matte.
        FormatError: the matte is not an 8-bit grey image of the camera's size.
        CaptureError: the frame cannot be read.
    """
    subject, expression = item.split("/")
    path = dataset.matte_file(subject, expression, camera.id)
    if not path.is_file():
        raise StageError("it has no matte")
    alpha = read_matte(path, camera, "matte")
    return read_peak_frame(dataset, subject, expression, camera.id), alpha


def read_matte(path: Path, camera: Camera, stage: str) -> np.ndarray:
    """Read a matte (H, W) uint8 that a stage made; FormatError if it is not of a camera's size."""
    alpha = read_alpha(path)
    if alpha.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path}: {alpha.shape[1]}x{alpha.shape[0]}, expected the camera's"
            f" {camera.width}x{camera.height}; run 'express50 {stage}' again"
        )
    return alpha


def read_plate_image(dataset: Dataset, subject: str, camera_id: str) -> np.ndarray | None:
    """Read a clean plate (H, W, 3) uint8 sRGB, undistorted and corrected; None if there is none.

    Raises:
        CaptureError: it cannot be read.
    """
    path = dataset.plate_file(subject, camera_id)
    size = picture_sizes(dataset, subject).get(camera_id)
    return read_written(path, size) if path.is_file() else None


def read_written(path: Path, size: tuple[int, int] | None, channels: int = 3) -> np.ndarray:
    """Read a picture (H, W, channels) uint8 that the frames stage wrote, of a size if one is given.

    Raises:
        CaptureError: it is damaged, or another picture.
    """
    fix = "delete its folder and run 'express50 frames' again"
    try:
        image = read_image(path)
    except FormatError as error:
        raise CaptureError(f"{path}: truncated or damaged; {fix}") from error
    if image.dtype != np.uint8 or image.shape[2:] != (channels,):
        kind = f"8 bits and {channels} channels"
        raise CaptureError(f"{path}: {image.dtype} {image.shape}, expected {kind}; {fix}")
    found = (image.shape[1], image.shape[0])
    if size not in (None, found):
        raise CaptureError(
            f"{path}: {found[0]}x{found[1]}, expected {size[0]}x{size[1]} like the subject's other"
            " pictures; frames.image_side changed since: run 'express50 frames' again"
        )
    return image


def frame_inputs(dataset: Dataset, subject: str, expression: str) -> dict[str, Path]:
    """List the written frames of one expression as inputs of a stage, by name."""
    cameras = read_cameras_of(dataset, subject)
    files = {c: dataset.frame_file(subject, expression, c) for c in cameras}
    return {f"frame {expression} {c}": path for c, path in files.items() if path.is_file()}


def read_cameras_of(dataset: Dataset, subject: str, undistorted: bool = True) -> dict[str, Camera]:
    """Read the cameras of a subject's pictures, sorted by id.

    They are the calibrated cameras, scaled to the size to which the frames stage reduced the
    pictures; before it has run, to the recorded size. Pictures are undistorted, so the cameras are
    pinholes unless ``undistorted`` is false.

    Raises:
        StageError: the subject is not calibrated.
    """
    sizes = picture_sizes(dataset, subject)
    cameras = {
        name: resized(camera, *sizes.get(name, _size_of(camera)))
        for name, camera in read_recorded_cameras(dataset, subject).items()
    }
    return {name: pinhole(c) if undistorted else c for name, c in cameras.items()}


def read_recorded_cameras(dataset: Dataset, subject: str) -> dict[str, Camera]:
    """Read a subject's calibrated cameras as recorded, sorted by id; StageError without any."""
    path = dataset.cameras_file(subject)
    try:
        return dict(sorted(_read_cameras(path).items()))
    except FileNotFoundError as error:
        raise StageError(
            f"{path}: subject {subject!r} is not calibrated; "
            f"run {advised('express50 calibrate', dataset.root)}"
        ) from error


def make_picture(image: np.ndarray, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """Make the picture of a recorded image (H, W, 3) uint8: undistort it, then reduce it.

    `camera` has the recorded size, `size` is the width and height of the picture. Areas are
    averaged in linear light, as a sensor with larger pixels would do.
    """
    undistorted = undistort_image(image, camera)
    return undistorted if size == _size_of(camera) else reduce_light(undistorted, *size)


def reduced(
    camera: Camera, rgb: np.ndarray, alpha: np.ndarray, side: int
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Average a picture (H, W, 3) and its matte (H, W) down to at most ``side`` pixels.

    The camera follows.
    """
    small = shrink(rgb, side)
    if small is rgb:
        return camera, rgb, alpha
    return resized(camera, small.shape[1], small.shape[0]), small, shrink(alpha, side)


def picture_sizes(dataset: Dataset, subject: str) -> dict[str, tuple[int, int]]:
    """Read width and height of a subject's pictures by camera; empty before the frames stage.

    Raises:
        FormatError: the file is not {camera: [width, height]} with positive integers.
    """
    path = dataset.picture_sizes_file(subject)
    return _sizes_cached(path) if path.is_file() else {}


@cached_by_file(64)
def _sizes_cached(path: Path) -> dict[str, tuple[int, int]]:
    fix = "delete its folder and run 'express50 frames' again"
    with refusing(FormatError, f"{path}: not the sizes of pictures", fix):
        sizes = {k: (w, h) for k, (w, h) in read_json_table(path, FormatError, fix).items()}
        for name, size in sizes.items():
            if not all(type(n) is int and n > 0 for n in size):
                raise ValueError(f"{name} is {size}, expected width and height, pixels")
    return sizes


def _size_of(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


_read_cameras = cached_by_file(64)(read_cameras)


def read_gains(dataset: Dataset, subject: str) -> dict[str, np.ndarray]:
    """Read each camera's linear light (3,) relative to the rig's mean; empty if not known.

    Raises:
        FormatError: the file is not {camera: [red, green, blue]} with positive numbers.
    """
    path = dataset.gains_file(subject)
    if not path.is_file():
        return {}
    with refusing(FormatError, f"{path}: not a table of gains", "calibrate again"):
        rows = read_json_table(path, FormatError, "calibrate again")
        gains = {name: np.array(row, float) for name, row in rows.items()}
        for name, gain in gains.items():
            if gain.shape != (3,) or not np.isfinite(gain).all() or (gain <= 0).any():
                raise ValueError(f"{name} is {gain.tolist()}, expected three numbers above 0")
    return gains


def read_proxy(dataset: Dataset, subject: str, camera_id: str, frame: int) -> np.ndarray:
    """Read the small JPEG copy (h, w, 3) uint8 sRGB of a frame, which takes milliseconds.

    The copy of a frame that ingest did not decode is made from the footage, together with those of
    the frames around it. At 4K this takes a tenth of a second per frame.

    Raises:
        StageError: the subject is not ingested.
        CaptureError: the camera or the frame does not exist, or the footage has changed.
    """
    folder = dataset.proxies_dir(subject)
    index = read_index(dataset, subject)
    if camera_id not in index.cameras or not 0 <= frame < index.cameras[camera_id].frames:
        raise CaptureError(f"{folder}: no frame {frame} of camera {camera_id!r}")
    source = index.cameras[camera_id]
    if source.dhash[frame] != UNKNOWN_HASH:
        return decode_proxy(folder, camera_id, frame)
    several = 1 if source.kind == "frames" else BLOCK
    block, number = divmod(frame, several)
    path, key = dataset.index_file(subject), (dataset, subject, camera_id, index.capture)
    with _READING:
        return _block_of_proxies(path, key, block * several, several)[number].copy()


@cached_by_file(BLOCKS)
def _block_of_proxies(path: Path, key: _Footage, first: int, count: int) -> list[np.ndarray]:
    """Make the proxies of neighbouring frames: videos are decoded forward only."""
    dataset, subject, camera_id, _ = key
    reader = _reader(path, key)
    made = nearest_decoded(reader.source, first)
    side = max(decode_proxy(dataset.proxies_dir(subject), camera_id, made).shape)
    frames = range(first, min(first + count, reader.source.frames))
    return [shrink(reader.read(frame), side) for frame in frames]


@cached_by_file(8)
def _reader(_index: Path, key: _Footage) -> FrameReader:
    """Return a reader that stays open as long as index and footage are the same."""
    dataset, subject, camera_id, _ = key
    return FrameReader(read_index(dataset, subject), camera_id)


def decode_proxy(folder: Path, camera_id: str, frame: int) -> np.ndarray:
    """Read a proxy (h, w, 3) uint8 sRGB from a folder of indexed tars."""
    tar, table = folder / f"{camera_id}.tar", folder / f"{camera_id}.json"
    try:
        offset, size = _proxy_table(table)[frame] or (-1, -1)
        if min(offset, size) < 0 or offset + size > tar.stat().st_size:
            raise ValueError(f"frame {frame} lies outside {tar.name}")
        with tar.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
    except FileNotFoundError as error:
        raise FormatError(f"{folder}: proxies are missing; run 'express50 ingest' again") from error
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise FormatError(f"{table}: not a table of proxies ({error}); ingest again") from None
    return decode_image(data, f"{tar}: frame {frame}")


@cached_by_file(256)
def _proxy_table(path: Path) -> list[tuple[int, int] | None]:
    rows = read_json(path, FormatError, "ingest again")
    return [row and (int(row[0]), int(row[1])) for row in rows]
