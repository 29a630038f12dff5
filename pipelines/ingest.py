"""Ingest: decode every camera once, and write the frame index, the proxies and a contact sheet.

Every later stage names frames by decode index; the index holds each frame's time stamp and hash,
so that a label can be checked against the footage it was made on. Proxies are small JPEGs in an
indexed tar, because a random seek in 4K H.264 costs half a second.
"""

from __future__ import annotations

import io
import tarfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.capture import (
    RawCamera,
    RawCapture,
    check_calibrated_sizes,
    read_capture,
    read_meta,
)
from express50.digests import file_sha256, stat_digest, text_digest
from express50.errors import CaptureError, StageError
from express50.frames import decode_proxy, dhash, read_srgb8
from express50.images import contact_sheet, encode_jpeg, resize_area, write_image
from express50.index import CameraSource, Cue, Index, index_to_json
from express50.layout import Dataset
from express50.publish import dump_json, write_json
from express50.stage import Stage
from express50.video import iterate_video
from express50.withdraw import withdrawn

QC_CAMERAS, QC_COLUMNS = 24, 6


@dataclass(frozen=True, kw_only=True)
class IngestConfig:
    """What ingest may trade."""

    proxy_long_side: int = 480
    """Longer side of a proxy, pixels (16 to 4096); smaller footage is not enlarged."""
    proxy_quality: int = 85
    """JPEG quality of proxies, 1 to 100."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 16 <= self.proxy_long_side <= 4096:
            raise ValueError(f"proxy_long_side is {self.proxy_long_side}, expected 16 to 4096")
        if not 1 <= self.proxy_quality <= 100:
            raise ValueError(f"proxy_quality is {self.proxy_quality}, expected 1 to 100")


def register(dataset: Dataset, captures: list[Path]) -> list[str]:
    """Add raw captures to the dataset's table; returns their subjects in the given order.

    Raises:
        CaptureError: a folder is no capture, two captures claim one subject, or the subject was
            withdrawn.
    """
    table = {subject: str(path) for subject, path in dataset.captures().items()}
    added: dict[str, str] = {}
    for path in captures:
        root = Path(path).resolve()
        subject = read_meta(root)["subject"]
        if text_digest(subject) in withdrawn(dataset):
            raise CaptureError(
                f"{root}: subject {subject} was withdrawn from {dataset.root}; delete the capture"
            )
        if added.get(subject, str(root)) != str(root):
            raise CaptureError(
                f"{root / 'capture.toml'}: subject {subject} is also that of {added[subject]}; "
                "give each capture its own subject id"
            )
        added[subject] = str(root)
    if not added.items() <= table.items():
        write_json(dataset.captures_file, table | added)
    return list(added)


def items(dataset: Dataset) -> list[str]:
    """Registered subjects."""
    return list(dataset.captures())


def inputs(dataset: Dataset, item: str, config: IngestConfig) -> dict[str, Path | str]:
    """The capture by names, sizes and times: hashing terabytes to skip them would cost hours."""
    return {"capture": stat_digest(_capture_of(dataset, item))}


def _capture_of(dataset: Dataset, item: str) -> Path:
    captures = dataset.captures()
    if item not in captures:
        raise StageError(
            f"{dataset.captures_file}: no capture of {item!r}; "
            f"run 'express50 ingest {dataset.root} CAPTURE'"
        )
    if not captures[item].is_dir():
        raise CaptureError(
            f"{captures[item]}: no such folder; run 'express50 ingest {dataset.root} CAPTURE' "
            f"with the present place of {item}'s capture"
        )
    return captures[item]


def run(dataset: Dataset, item: str, config: IngestConfig, out: Path) -> dict:
    """Index one capture; a camera that cannot be used is dropped with its reason."""
    raw = read_capture(_capture_of(dataset, item))
    if raw.subject != item:
        raise CaptureError(
            f"{raw.root / 'capture.toml'}: subject is {raw.subject!r}, registered as {item!r}; "
            "ingest the capture again"
        )
    dropped = dict(raw.dropped)
    cameras = {}
    (out / "proxies").mkdir()
    for name, camera in raw.cameras.items():
        try:
            cameras[name] = scan_camera(raw, camera, out / "proxies", config)
        except CaptureError as error:
            dropped[name] = str(error)
            _remove_proxies(out, name)
    check_calibrated_sizes(raw, {k: (c.width, c.height) for k, c in cameras.items()})
    usual = usual_count(cameras)
    cues, outside = split_cues(raw.cues, usual)
    for name, reason in short_cameras(cameras, cues).items():
        dropped[name] = reason
        del cameras[name]
        _remove_proxies(out, name)
    if not cameras:
        reasons = "; ".join(f"{name}: {why}" for name, why in sorted(dropped.items()))
        raise CaptureError(f"{raw.root}: no usable camera: {reasons or 'cameras/ is empty'}")
    index = make_index(raw, cameras, cues)
    (out / "index.json").write_bytes(dump_json(index_to_json(index)))
    write_contact_sheet(index, out)
    return metrics(index, usual, dropped, outside)


def usual_count(cameras: dict[str, CameraSource]) -> int:
    """Frame count that most cameras share; the larger of equally common ones."""
    counts = Counter(camera.frames for camera in cameras.values())
    return max(counts, key=lambda count: (counts[count], count), default=0)


def split_cues(cues: tuple[Cue, ...], frames: int) -> tuple[tuple[Cue, ...], dict[str, str]]:
    """Cues inside the footage, and the reasons against the others."""
    outside = {
        cue.expression_id: f"cue runs from frame {cue.start_frame} to {cue.end_frame}, the "
        f"footage has frames 0 to {frames - 1}; correct cues.csv"
        for cue in cues
        if cue.end_frame >= frames
    }
    return tuple(cue for cue in cues if cue.expression_id not in outside), outside


def short_cameras(cameras: dict[str, CameraSource], cues: tuple[Cue, ...]) -> dict[str, str]:
    """Cameras that end before the last cue, with the reason."""
    needed = 1 + max((cue.end_frame for cue in cues), default=-1)
    return {
        name: f"has {camera.frames} frames, the cues need {needed}; it stopped early, and which "
        "frames it lost is not known"
        for name, camera in cameras.items()
        if camera.frames < needed
    }


def make_index(raw: RawCapture, cameras: dict[str, CameraSource], cues: tuple[Cue, ...]) -> Index:
    """Index of the usable cameras."""
    board = raw.board and {
        "config": raw.board["config"],
        "cameras": {k: v for k, v in raw.board["cameras"].items() if k in cameras},
    }
    return Index(
        subject=raw.subject,
        capture=raw.root,
        fps=raw.fps,
        cameras=cameras,
        plates={k: v for k, v in raw.plates.items() if k in cameras},
        board=board,
        calibration=None if raw.calibration is None else "calibration.json",
        cues=cues,
        meta=raw.meta,
    )


def metrics(index: Index, usual: int, dropped: dict[str, str], outside: dict[str, str]) -> dict:
    """Counts, cameras whose frame count is not the usual one, and everything left out."""
    counts = {name: camera.frames for name, camera in index.cameras.items()}
    lost = [(f"camera {k}", why) for k, why in sorted(dropped.items())]
    lost += [(f"expression {k}", why) for k, why in sorted(outside.items())]
    return {
        "cameras": len(counts),
        "frames": sum(counts.values()),
        "expressions": len(index.cues),
        "frame_count": usual,
        "frame_count_differs": {k: n for k, n in counts.items() if n != usual},
        "time_gaps": {k: n for k, c in index.cameras.items() if (n := time_gaps(c.pts))},
        "plates": len(index.plates),
        "dropped": [{"what": what, "why": why} for what, why in lost],
    }


def time_gaps(pts: tuple[int, ...]) -> int:
    """Steps between frames longer than 1.5 usual ones: each tells of a frame the recorder lost."""
    steps = np.diff(np.array(pts, dtype=np.int64))
    return int((steps > 1.5 * np.median(steps)).sum()) if steps.size else 0


def scan_camera(
    raw: RawCapture, camera: RawCamera, folder: Path, config: IngestConfig
) -> CameraSource:
    """Decode one camera, write its proxies, and return its frames' identity.

    Raises:
        CaptureError: the footage is truncated, damaged or changes its size.
    """
    pts: list[int] = []
    hashes: list[str] = []
    size: tuple[int, ...] | None = None
    with ProxyWriter(folder / f"{camera.id}.tar") as proxies:
        for stamp, image in iterate_camera(camera):
            size = size or image.shape[:2]
            if image.shape[:2] != size:
                raise CaptureError(
                    f"{camera.path}: frame {len(pts)} is {image.shape[1]}x{image.shape[0]}, "
                    f"the first is {size[1]}x{size[0]}; all must be of one size"
                )
            pts.append(stamp)
            hashes.append(dhash(image))
            small = shrink(image, config.proxy_long_side)
            proxies.add(encode_jpeg(small, config.proxy_quality))
    if size is None:
        raise CaptureError(f"{camera.path}: holds no frame; record or copy it again")
    (folder / f"{camera.id}.json").write_bytes(dump_json(proxies.table))
    return CameraSource(
        kind=camera.kind,
        source=camera.path.relative_to(raw.root).as_posix(),
        width=size[1],
        height=size[0],
        frames=len(pts),
        pts=tuple(pts),
        dhash=tuple(hashes),
        sha256=source_sha256(camera),
        names=camera.names,
    )


def iterate_camera(camera: RawCamera) -> Iterator[tuple[int, np.ndarray]]:
    """Time stamp and image (H, W, 3) uint8 sRGB of every frame."""
    if camera.kind == "video":
        yield from iterate_video(camera.path)
        return
    for number, name in enumerate(camera.names):
        yield number, read_srgb8(camera.path / name)


def source_sha256(camera: RawCamera) -> str:
    """Digest of the video file, or of the names and digests of the image files."""
    if camera.kind == "video":
        return file_sha256(camera.path)
    return text_digest("\n".join(f"{n} {file_sha256(camera.path / n)}" for n in camera.names))


def shrink(image: np.ndarray, long_side: int) -> np.ndarray:
    """Image (H, W, 3) with its longer side at most ``long_side``."""
    height, width = image.shape[:2]
    scale = long_side / max(height, width)
    if scale >= 1:
        return image
    return resize_area(image, max(1, round(width * scale)), max(1, round(height * scale)))


class ProxyWriter:
    """Writes JPEGs into a USTAR tar and keeps (offset, size) of each."""

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
        self.table: list[tuple[int, int]] = []

    def __enter__(self) -> ProxyWriter:
        return self

    def __exit__(self, *unused: object) -> None:
        self._tar.close()

    def add(self, data: bytes) -> None:
        """Append one JPEG; time and owner are 0, so that the same frames give the same bytes."""
        info = tarfile.TarInfo(f"{len(self.table):06d}.jpg")
        info.size = len(data)
        # The header is one block; the data follow it.
        self.table.append((self._tar.offset + tarfile.BLOCKSIZE, len(data)))
        self._tar.addfile(info, io.BytesIO(data))


def _remove_proxies(out: Path, camera_id: str) -> None:
    for suffix in (".tar", ".json"):
        (out / "proxies" / f"{camera_id}{suffix}").unlink(missing_ok=True)


def write_contact_sheet(index: Index, out: Path) -> None:
    """One row a camera, frames spread over the footage: shows swapped, dark or stuck cameras."""
    names = list(index.cameras)[:QC_CAMERAS]
    picks = np.unique(np.linspace(0, index.frames - 1, QC_COLUMNS).astype(int))
    rows = [[decode_proxy(out / "proxies", name, int(frame)) for frame in picks] for name in names]
    (out / "qc").mkdir()
    write_image(out / "qc" / "cameras.jpg", contact_sheet(rows, names), quality=88)


STAGE = Stage(
    name="ingest",
    version=1,
    config=IngestConfig,
    presets={
        "draft": {"proxy_long_side": 320, "proxy_quality": 80},
        "standard": {},
        "reference": {"proxy_long_side": 960, "proxy_quality": 92},
    },
    items=items,
    inputs=inputs,
    run=run,
)
