"""Decode one camera once: identity of its frames, proxies, and measurements for the checks."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from express50.capture.frames import corrected, dhash
from express50.capture.index import UNKNOWN_HASH, CameraSource
from express50.capture.raw import RawCamera, RawCapture
from express50.errors import CaptureError, FormatError, few
from express50.files.atomic import dump_json
from express50.files.containers import WITHIN, inside, read_picture
from express50.files.digests import file_sha256, text_digest
from express50.files.images import (
    ORIENTATION,
    encode_jpeg,
    foreign_profile,
    has_alpha,
    read_exif,
    upright,
)
from express50.files.text import reason, unreadable
from express50.files.video import FPS_SLACK, VideoTags, iterate_sparsely, iterate_video, video_fps
from express50.geometry.pixels import shrink
from pipelines.ingest.quality import CameraMeasurements, FrameMeasures

BEYOND = 0.01  # share of the first picture outside of a range that no flag states
UNEVEN = 0.1  # share of the steps that differ; a lost frame now and then is counted as a gap


def scan_camera(
    raw: RawCapture,
    camera: RawCamera,
    folder: Path,
    proxy: tuple[int, int],
    every: int,
    focus_every: int,
) -> tuple[CameraSource, CameraMeasurements]:
    """Decode one camera and write its proxies; return its frames' identity and measurements.

    ``proxy`` is the longer side and the JPEG quality of proxies. For ``every`` see
    `iterate_camera`; the sharpness of a decoded frame is measured if that of the ``focus_every``
    frames before it was not.

    Raises:
        CaptureError: the footage is truncated, damaged or changes its size.
    """
    pts: list[int] = []
    hashes: list[str] = []
    clips: list[int] = []
    tags: list[VideoTags] = []
    measures = FrameMeasures(focus_every)
    size: tuple[int, ...] | None = None
    with ProxyWriter(folder / f"{camera.id}.tar") as proxies:
        for frame, (clip, stamp, image) in enumerate(iterate_camera(camera, every, tags.append)):
            clips += [0] * (clip + 1 - len(clips))
            clips[clip] += 1
            pts.append(stamp)
            if image is None:
                hashes.append(UNKNOWN_HASH)
                proxies.table.append(None)
                continue
            size = size or image.shape[:2]
            if image.shape[:2] != size:
                raise CaptureError(
                    f"{camera.path}: frame {frame} is {image.shape[1]}x{image.shape[0]}, "
                    f"the first is {size[1]}x{size[0]}; all frames must have the same size"
                )
            hashes.append(dhash(image))
            small = shrink(image, proxy[0])
            proxies.add(encode_jpeg(corrected(small, camera), proxy[1]))
            measures.add(frame, image, small)
    if size is None:
        raise CaptureError(f"{camera.path}: has no frames; record or copy it again")
    (folder / f"{camera.id}.json").write_bytes(dump_json(proxies.table))
    source = CameraSource(
        kind=camera.kind,
        source=camera.path.relative_to(raw.root).as_posix(),
        width=size[1],
        height=size[0],
        frames=len(pts),
        pts=tuple(pts),
        dhash=tuple(hashes),
        sha256=source_sha256(camera),
        names=camera.names,
        clips=tuple(clips) if camera.kind == "videos" or camera.counts else (),
        correction=camera.correction,
        orientation=camera.orientation,
    )
    return source, measures.finish(next(iter(tags), None))


def trimmed(
    source: CameraSource, measured: CameraMeasurements, counts: tuple[int, ...], table: Path
) -> tuple[CameraSource, CameraMeasurements]:
    """Return a camera and its measurements with the first ``counts`` frames of each clip.

    The ``table`` of its proxies is rewritten.
    """
    ends = np.cumsum(source.clips)
    rows = zip(ends, source.clips, counts, strict=True)
    keep = np.concatenate([np.arange(end - n, end - n + count) for end, n, count in rows])
    chosen = keep.tolist()
    kept = np.isin(measured.frames, keep)
    names = source.names if source.kind == "videos" else tuple(source.names[i] for i in chosen)
    number = {frame: place for place, frame in enumerate(chosen)}
    rows_of_all = json.loads(table.read_text(encoding="utf-8"))
    table.write_bytes(dump_json([rows_of_all[i] for i in chosen]))
    return replace(
        source,
        frames=len(chosen),
        pts=tuple(source.pts[i] for i in chosen),
        dhash=tuple(source.dhash[i] for i in chosen),
        names=names,
        clips=counts,
    ), replace(
        measured,
        frames=np.array([number[frame] for frame in measured.frames[kept].tolist()]),
        moves=measured.moves[kept],
        cells=measured.cells[kept],
        widths=tuple((number[frame], width) for frame, width in measured.widths if frame in number),
    )


def iterate_camera(
    camera: RawCamera, every: int, tell: Callable[[VideoTags], None]
) -> Iterator[tuple[int, int, np.ndarray | None]]:
    """Yield clip, time stamp and recorded image (H, W, 3) uint8 sRGB of every frame.

    Of ``every`` frames only one is decoded, if that is above 1; the image of the others is None.
    `tell` is called with the tags of every video.
    """

    def read(path: Path) -> Iterator[tuple[int, np.ndarray | None]]:
        return iterate_video(path, tell) if every == 1 else iterate_sparsely(path, every, tell)

    if camera.kind == "video":
        yield from ((0, stamp, image) for stamp, image in read(camera.path))
    elif camera.kind == "videos":
        for clip, name in enumerate(camera.names):
            for stamp, image in read(inside(camera.path, name)):
                turned = None if image is None else upright(image, camera.orientation)
                yield clip, stamp, turned
    else:
        ends = np.cumsum(camera.counts or (len(camera.names),))
        for number, name in enumerate(camera.names):
            clip = int(np.searchsorted(ends, number, side="right"))
            stamp = camera.stamps[number] if camera.stamps else number
            image = None
            if number % every == 0:
                image = read_picture(camera.path, name, camera.orientation)
            yield clip, stamp, image


def time_gaps(pts: tuple[int, ...], clips: tuple[int, ...] = ()) -> int:
    """Count the steps longer than 1.5 times the median, where the recorder lost a frame.

    Steps from one clip to the next do not count.
    """
    steps = _steps(pts, clips)
    return int((steps > 1.5 * np.median(steps)).sum()) if steps.size else 0


def _steps(pts: tuple[int, ...], clips: tuple[int, ...]) -> np.ndarray:
    steps = np.diff(np.array(pts, dtype=np.int64))
    within = np.ones(len(steps), dtype=bool)
    within[np.cumsum(clips[:-1], dtype=np.int64) - 1] = False
    return steps[within]


def video_rates(raw: RawCapture, cameras: Mapping[str, CameraSource]) -> dict[str, float]:
    """Return the frame rates that the cameras' first videos state."""
    rates = {}
    for name, source in cameras.items():
        camera = raw.cameras[name]
        if source.kind != "frames":
            path = inside(camera.path, camera.names[0]) if camera.names else camera.path
            with suppress(CaptureError):  # a container without a rate
                rates[name] = video_fps(path)
    return rates


def odd_footage(
    raw: RawCapture, cameras: Mapping[str, CameraSource],
    measured: Mapping[str, CameraMeasurements], rates: Mapping[str, float],
) -> dict[str, str]:  # fmt: skip
    """Return warnings about rate, time stamps, channels, orientation and profiles, by camera."""
    found, pictures = {}, [raw.root / name for name in raw.plates.values()]
    for name, source in cameras.items():
        oddities, camera, orientation = [], raw.cameras[name], 1
        if source.kind == "frames":
            path = camera.path / camera.names[0]
            if path.is_file():  # no file: a member of a container
                pictures.append(path)
                orientation, _ = read_exif(path)
                if has_alpha(path):
                    oddities.append("alpha channel left out: a later stage makes mattes")
        elif tags := measured[name].tags:
            orientation, fps = ORIENTATION[tags.turn], rates.get(name, raw.fps)
            if abs(fps - raw.fps) > FPS_SLACK * raw.fps:
                oddities.append(
                    f"video at {fps:.4g} fps, the capture says {raw.fps:.4g}; correct fps there"
                )
            oddities += _odd_video(source, tags)
        if orientation != 1 and camera.orientation == 1:
            oddities.append(
                "to be turned or mirrored by players, but used as stored; calibration, board and"
                " plates must be as stored too"
            )
        if oddities:
            found[f"camera {name}"] = "; ".join(oddities)
    profiles = {}
    for path in pictures:
        with suppress(FormatError):  # a damaged plate
            if profile := foreign_profile(path):
                profiles[path.relative_to(raw.root).as_posix()] = profile.name
    if profiles:  # labels hold hashes of frames, so a conversion would make them wrong
        found["colours"] = (
            f"{few(sorted(profiles), 1)}: ICC profile {min(profiles.values())!r}, but taken as"
            " sRGB; convert all footage and plates to sRGB"
        )
    return found


def _odd_video(source: CameraSource, tags: VideoTags) -> list[str]:
    oddities, steps = [], _steps(source.pts, source.clips)
    if steps.size:
        usual = np.median(steps)
        # A step is an integer number of ticks, so a difference of one tick may be rounding.
        share = float((np.abs(steps - usual) > np.maximum(1, 0.2 * usual)).mean())
        if share > UNEVEN:
            oddities.append(
                f"variable frame rate ({share:.0%} of the steps); record at a constant rate"
            )
    return oddities + odd_tags(tags)


def odd_tags(tags: VideoTags) -> list[str]:
    """Say what is unusual about a video's pictures, with what to do."""
    oddities = []
    if tags.hdr:
        oddities.append(
            f"HDR ({tags.hdr}), but read as sRGB, so the colours are wrong; record without HDR,"
            " or convert to BT.709"
        )
    if tags.interlaced:
        oddities.append("interlaced: a picture mixes two moments; record progressive frames")
    if tags.beyond > BEYOND:
        oddities.append(
            f"no stated range: read as 16 to 235, but {tags.beyond:.0%} of the first picture"
            " lies outside; if it was recorded as 0 to 255, mark it so, for example with 'ffmpeg -i"
            " IN -c copy -bsf:v h264_metadata=video_full_range_flag=1 OUT.mp4'"
        )
    if tags.aspect != 1:
        oddities.append(
            f"pixels {tags.aspect:.3g} times as wide as high, but used as stored; the calibration"
            " must be as stored too"
        )
    return oddities


def source_sha256(camera: RawCamera) -> str:
    """Return the digest of the video, or of the names and digests of all files with frames.

    Raises:
        CaptureError: a file cannot be read. Not all frames are decoded before.
    """
    if camera.kind == "video":
        return file_sha256(camera.path)
    files = dict.fromkeys(name.partition(WITHIN)[0] for name in camera.names)
    rows = []
    for name in files:
        path = inside(camera.path, name)
        try:
            rows.append(f"{name} {file_sha256(path)}")
        except OSError as error:
            why = unreadable(path) or f"cannot be read ({reason(error)}); copy it again"
            raise CaptureError(f"{path}: {why}") from None
    if len(files) < len(camera.names):  # containers: the names say which members
        rows += camera.names
    return text_digest("\n".join(rows))


class ProxyWriter:
    """Writes JPEGs into a USTAR tar and keeps (offset, size) of each."""

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
        self.table: list[tuple[int, int] | None] = []  # by frame; None without a proxy

    def __enter__(self) -> ProxyWriter:
        return self

    def __exit__(self, *unused: object) -> None:
        self._tar.close()

    def add(self, data: bytes) -> None:
        """Append one JPEG; time and owner are 0, so that equal frames give equal bytes."""
        info = tarfile.TarInfo(f"{len(self.table):06d}.jpg")
        info.size = len(data)
        # The header is one block; the data follow it.
        self.table.append((self._tar.offset + tarfile.BLOCKSIZE, len(data)))
        self._tar.addfile(info, io.BytesIO(data))


def remove_proxies(folder: Path, camera_id: str) -> None:
    """Delete a camera's proxies."""
    for suffix in (".tar", ".json"):
        (folder / f"{camera_id}{suffix}").unlink(missing_ok=True)
