"""Read and write the frame index that ingest makes, and the labelled peaks among its frames."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from express50.contract.layout import Dataset, footage_root
from express50.errors import CaptureError, FormatError, StageError, advised
from express50.files.digests import cached_by_file, file_version
from express50.files.text import NAME, read_json_table, refusing

SCHEMA = "express50.index/1"
# `Index.calibration` of a capture in another layout: ingest writes its cameras beside the index.
TRANSLATED = "ingest:calibration.json"
UNKNOWN_HASH = "-"  # of a frame that ingest did not decode


@dataclass(frozen=True)
class Cue:
    """Frames in which a scripted expression was performed; start and end are inclusive."""

    expression_id: str
    start_frame: int
    end_frame: int


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """Footage of one camera; sequences are indexed by 0-based decode index."""

    kind: str  # ``video``, ``videos`` (one file per clip) or ``frames``
    source: str  # video file, or the folder that holds ``names``, relative to the capture
    width: int  # width of the footage, pixels
    height: int  # height of the footage, pixels
    frames: int  # number of frames that decode
    pts: tuple[int, ...]  # presentation time stamps; the frame's number for image files
    dhash: tuple[str, ...]  # 64-bit difference hashes, 16 hexadecimal digits, or UNKNOWN_HASH
    sha256: str  # digest of the video file, or of the image files' names and digests
    # images or videos in order, relative to the source; empty for a single video. An image may lie
    # in a container (`express50.files.containers`).
    names: tuple[str, ...] = ()
    clips: tuple[int, ...] = ()  # number of frames of each clip; empty if there is only one clip
    # rows of a polynomial colour correction that `frames` applies, or none
    correction: tuple[tuple[float, ...], ...] = ()
    # how images are rotated when they are read (`files.images`); width and height are those after
    # rotation
    orientation: int = 1


def nearest_decoded(camera: CameraSource, frame: int) -> int:
    """Return the frame nearest to this one among those that ingest decoded."""
    if camera.dhash[frame] != UNKNOWN_HASH:
        return frame
    decoded = (n for n, value in enumerate(camera.dhash) if value != UNKNOWN_HASH)
    return min(decoded, key=lambda n: abs(n - frame))


@dataclass(frozen=True, kw_only=True)
class Index:
    """Everything the stages need to know about one subject's capture."""

    subject: str
    capture: Path  # folder of the footage; from the dataset's table, not from the index file
    fps: float  # frames per second
    cameras: dict[str, CameraSource]  # usable cameras by id
    plates: dict[str, str]  # clean background plates by camera id, relative to the capture
    board: dict | None  # ``{"config": board.toml's content, "cameras": {id: [files]}}`` or None
    calibration: str | None  # file relative to the capture, or None; see `calibration_file`
    cues: tuple[Cue, ...]  # scripted expressions, in file order
    # content of capture.toml without what describes the person (`demographics`)
    meta: dict = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Return the number of frames that every camera has."""
        return min(camera.frames for camera in self.cameras.values())


def calibration_file(dataset: Dataset, index: Index) -> Path | None:
    """Find the given calibration: the capture's own, or ingest's translation; else None."""
    if index.calibration is None:
        return None
    if index.calibration == TRANSLATED:
        return dataset.item_dir("ingest", index.subject) / "calibration.json"
    return index.capture / index.calibration


def read_index(dataset: Dataset, subject: str) -> Index:
    """Read a subject's index (cached until it or the table of captures changes).

    Raises:
        StageError: the subject is not ingested, or its capture is no longer registered.
        FormatError: the file does not follow its schema.
    """
    path = dataset.index_file(subject)
    table = dataset.captures_file  # says where the footage lies
    try:
        return _read_cached(path, dataset, subject, table.is_file() and file_version(table))
    except FileNotFoundError as error:
        known = ", ".join(dataset.subjects()) or "none"
        raise StageError(
            f"{path}: subject {subject!r} is not ingested (subjects: {known}); "
            f"run {advised('express50 ingest', dataset.root, 'CAPTURE')}"
        ) from error


@cached_by_file(64)
def _read_cached(path: Path, dataset: Dataset, subject: str, captures_version: Hashable) -> Index:
    captures = dataset.captures()
    if subject not in captures:
        raise StageError(
            f"{dataset.captures_file}: subject {subject!r} has no capture; "
            f"run {advised('express50 ingest', dataset.root, 'CAPTURE')}"
        )
    fix = f"delete its folder and run {advised('express50 ingest', dataset.root)}"
    with refusing(FormatError, f"{path}: not an index", fix):
        root = footage_root(captures[subject])
        return index_from_json(read_json_table(path, FormatError), root)


def index_to_json(index: Index) -> dict[str, Any]:
    """Convert an index to JSON, without paths of this machine."""
    # Defaults are left out: most captures have one clip, no correction and upright images.
    plain = {"clips": (), "correction": (), "orientation": 1}
    cameras = {}
    for name, camera in index.cameras.items():
        row = dict(vars(camera))
        # Strings keep the file small and quick to read: a subject may have 10^5 frames.
        row["pts"] = " ".join(map(str, camera.pts))
        row["dhash"] = " ".join(camera.dhash)
        row["names"] = list(camera.names)
        cameras[name] = {k: v for k, v in row.items() if k not in plain or v != plain[k]}
    return {
        "schema": SCHEMA,
        "subject": index.subject,
        "fps": index.fps,
        "cameras": cameras,
        "plates": index.plates,
        "board": index.board,
        "calibration": index.calibration,
        "cues": [[cue.expression_id, cue.start_frame, cue.end_frame] for cue in index.cues],
        "meta": index.meta,
    }


def index_from_json(content: Mapping[str, Any], capture: Path) -> Index:
    """Convert JSON to an index; ValueError if the schema or a sequence's length is wrong."""
    if content.get("schema") != SCHEMA:
        raise ValueError(f"schema is {content.get('schema')!r}, expected {SCHEMA!r}")
    for name in (*content["cameras"], *(row[0] for row in content["cues"])):
        if not NAME.fullmatch(name):  # they become file names
            raise ValueError(f"id {name!r}, expected letters, digits and _ . + -")
    for name in content["plates"].values():
        _check_inside(name)
    return Index(
        subject=content["subject"],
        capture=Path(capture),
        fps=float(content["fps"]),
        cameras={k: _camera_from_json(k, content["cameras"][k]) for k in content["cameras"]},
        plates=dict(content["plates"]),
        board=content["board"],
        calibration=content["calibration"],
        cues=tuple(Cue(str(e), int(a), int(b)) for e, a, b in content["cues"]),
        meta=dict(content["meta"]),
    )


def _check_inside(name: str) -> None:
    """Refuse a name that leads out of the capture; image names are checked when read."""
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise ValueError(f"{name!r} leads out of the capture")


def _camera_from_json(name: str, row: Mapping[str, Any]) -> CameraSource:
    values = dict(row)
    values["pts"] = tuple(map(int, row["pts"].split()))
    values["dhash"] = tuple(row["dhash"].split())
    values["names"] = tuple(row["names"])
    values["clips"] = tuple(map(int, row.get("clips", ())))
    values["correction"] = tuple(tuple(map(float, line)) for line in row.get("correction", ()))
    camera = CameraSource(**values)
    if type(camera.orientation) is not int or not 1 <= camera.orientation <= 8:
        raise ValueError(f"camera {name}: orientation {camera.orientation!r}, expected 1 to 8")
    _check_inside(camera.source)
    lengths = {len(camera.pts), len(camera.dhash)}
    if lengths != {camera.frames}:
        raise ValueError(f"camera {name}: {sorted(lengths)} entries for {camera.frames} frames")
    if camera.clips and sum(camera.clips) != camera.frames:
        raise ValueError(
            f"camera {name}: clips have {sum(camera.clips)} frames, expected {camera.frames}"
        )
    return camera


@dataclass(frozen=True)
class Peak:
    """The labelled frame of one expression, with what the label recorded of it."""

    frame: int  # decode index
    camera: str  # camera in which the label was made
    pts: int  # time stamp of the frame in that camera
    dhash: str  # difference hash of the frame in that camera


def read_peaks(dataset: Dataset, subject: str) -> dict[str, int]:
    """Read each expression's peak frame (decode index); raise what ``read_peak_rows`` raises."""
    return {name: peak.frame for name, peak in read_peak_rows(dataset, subject).items()}


def read_peak_rows(dataset: Dataset, subject: str) -> dict[str, Peak]:
    """Read the peak of each expression.

    Raises:
        StageError: the subject is not aligned.
        FormatError: the file is not a table of peaks.
    """
    path, align = dataset.peaks_file(subject), advised("express50 align", dataset.root)
    if not path.is_file():
        raise StageError(f"{path}: subject {subject!r} is not aligned; run {align}")
    fix = f"run {align} again"
    with refusing(FormatError, f"{path}: not a table of peaks", fix):
        rows = read_json_table(path, FormatError, fix)
        if strange := [name for name in rows if not NAME.fullmatch(name)]:
            raise ValueError(f"expression {strange[0]!r} is not an id")  # it names a folder
        return {
            name: Peak(int(row["frame"]), str(row["camera"]), row["pts"], row["dhash"])
            for name, row in rows.items()
        }


def same_hash(one: str, other: str | None) -> bool:
    """Return whether two frames may be the same by their hashes; an unknown one fits any."""
    return one == other or UNKNOWN_HASH in (one, other)


def check_peak(index: Index, expression: str, peak: Peak) -> None:
    """Raise CaptureError unless a label's frame has the time stamp and hash of the index."""
    source = index.cameras.get(peak.camera)
    there = source is not None and 0 <= peak.frame < source.frames
    found = (source.pts[peak.frame], source.dhash[peak.frame]) if source and there else None
    if not found or found[0] != peak.pts or not same_hash(found[1], peak.dhash):
        raise CaptureError(
            f"{index.subject}/{expression}: frame {peak.frame} of {peak.camera} has time and hash "
            f"{found}, but the label has {(peak.pts, peak.dhash)}; the footage or the "
            "label has changed: run 'express50 align' again; if that does not help, see 'express50 "
            "annotate validate'"
        )


def peak_items(dataset: Dataset) -> list[str]:
    """List ``subject/expression`` for every labelled peak of the aligned subjects."""
    found = []
    for subject in dataset.subjects():
        if dataset.peaks_file(subject).is_file():
            found += [f"{subject}/{name}" for name in sorted(read_peaks(dataset, subject))]
    return found


def tracked_items(dataset: Dataset) -> list[str]:
    """List the peaks, without those that the track stage left out; its metrics.json says why."""
    left_out = set()
    for subject in dataset.subjects():
        path = dataset.track_file(subject).with_name("metrics.json")
        with suppress(FormatError, KeyError, TypeError):  # absent, or a file that somebody changed
            notes = read_json_table(path, FormatError)["dropped"]
            left_out |= {f"{subject}/{note['what']}" for note in notes}
    return [item for item in peak_items(dataset) if item not in left_out]
