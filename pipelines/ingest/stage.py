"""Ingest: decode every camera once, and write the frame index, the proxies and a contact sheet.

Every later stage names frames by decode index; the index holds each frame's time stamp and hash,
so that a label can be checked against the footage it was made on. Proxies are small JPEGs in an
indexed tar, because a random seek in 4K H.264 costs half a second. The same pass looks whether
cameras are in step, in focus and steady in light; what is wrong is a warning, its figures are in
checks.json.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from express50.capture.demographics import public_meta
from express50.capture.frames import decode_proxy
from express50.capture.index import TRANSLATED, CameraSource, Cue, Index, index_to_json
from express50.capture.raw import RawCapture, check_calibrated_sizes
from express50.capture.readers.read import OURS, read_any, subject_of, watched
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.dataset.withdraw import withdrawn
from express50.errors import CaptureError, FormatError, StageError
from express50.files.atomic import dump_json, write_json
from express50.files.calibration import write_cameras
from express50.files.digests import stat_digest, text_digest
from express50.files.images import contact_sheet, write_image
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera
from express50.rigs.camera_builder import at_size
from pipelines.ingest.checks import look
from pipelines.ingest.config import IngestConfig
from pipelines.ingest.scan import Seen, remove_proxies, scan_camera, time_gaps, trimmed

QC_CAMERAS, QC_COLUMNS = 24, 6
FILE_ENDINGS = ("head", "confidence", "normals")  # of files beside <camera>.png in later stages


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
        subject = subject_of(root)
        if text_digest(subject) in withdrawn(dataset):
            raise CaptureError(
                f"{root}: subject {subject} was withdrawn from {dataset.root}; delete the capture"
            )
        if added.get(subject, str(root)) != str(root):
            raise CaptureError(
                f"{root}: subject {subject} is also that of {added[subject]}; "
                "give each capture its own subject id (subject in capture.toml)"
            )
        added[subject] = str(root)
    if not added.items() <= table.items():
        write_json(dataset.captures_file, table | added)
    return list(added)


def inputs(dataset: Dataset, item: str, config: IngestConfig) -> dict[str, Path | str]:
    """The capture by names, sizes and times: hashing terabytes to skip them would cost hours."""
    first, *others = watched(_capture_of(dataset, item))
    found: dict[str, Path | str] = {"capture": stat_digest(first)}
    return found | {f"capture {n}": stat_digest(p) for n, p in enumerate(others, 1)}


def _capture_of(dataset: Dataset, item: str) -> Path:
    captures = dataset.captures()
    if item not in captures:
        raise StageError(
            f"{dataset.captures_file}: no capture of {item!r}; "
            f"run 'express50 ingest {dataset.root} CAPTURE'"
        )
    if not captures[item].exists():
        raise CaptureError(
            f"{captures[item]}: no such folder; run 'express50 ingest {dataset.root} CAPTURE' "
            f"with the present place of {item}'s capture"
        )
    return captures[item]


def run(dataset: Dataset, item: str, config: IngestConfig, out: Path) -> Result:
    """Index one capture; a camera that cannot be used is dropped with its reason."""
    raw = read_any(_capture_of(dataset, item))
    if raw.subject != item:
        raise CaptureError(
            f"{raw.root / 'capture.toml'}: subject is {raw.subject!r}, registered as {item!r}; "
            "ingest the capture again"
        )
    (out / "proxies").mkdir()
    cameras, seen, dropped = _scan(raw, out / "proxies", config)
    _check_names(raw, cameras)
    calibration = _calibration(raw, cameras)
    raw, outside = _with_cues(raw, cameras, seen, dropped, out / "proxies")
    usual = usual_count(cameras)
    cues, beyond = split_cues(raw.cues, usual)
    for name, reason in short_cameras(cameras, cues).items():
        dropped[name] = reason
        del cameras[name]
        remove_proxies(out / "proxies", name)
    if not cameras:
        reasons = "; ".join(f"{name}: {why}" for name, why in sorted(dropped.items()))
        raise CaptureError(f"{raw.root}: no usable camera: {reasons or 'cameras/ is empty'}")
    if calibration is not None:
        write_cameras(out / "calibration.json", calibration)
    index = make_index(raw, cameras, cues)
    (out / "index.json").write_bytes(dump_json(index_to_json(index)))
    write_contact_sheet(index, out)
    digests = {name: camera.sha256 for name, camera in cameras.items()}
    figures, warnings = look({n: seen[n] for n in cameras}, digests, _clips(index), config)
    write_json(out / "checks.json", figures)
    lost = {f"camera {k}": why for k, why in sorted(dropped.items())}
    lost |= {f"expression {k}": why for k, why in sorted(beyond.items())} | outside | raw.skipped
    return metrics(raw, index, usual, lost, raw.warnings | warnings)


def _check_names(raw: RawCapture, cameras: Mapping[str, CameraSource]) -> None:
    """Refuse cameras whose files would take another camera's place in a later stage."""
    for name in cameras:
        first, _, ending = name.rpartition("_")
        if ending in FILE_ENDINGS and first in cameras:
            raise CaptureError(
                f"{raw.root}: cameras {first} and {name} would write files of one name;"
                f" rename {name}"
            )


def _scan(
    raw: RawCapture, folder: Path, config: IngestConfig
) -> tuple[dict[str, CameraSource], dict[str, Seen], dict[str, str]]:
    """Cameras and what was seen of them, and the reasons against the others."""
    dropped = dict(raw.dropped)
    cameras, seen = {}, {}
    for name, camera in raw.cameras.items():
        try:
            cameras[name], seen[name] = scan_camera(raw, camera, folder, config)
        except CaptureError as error:
            dropped[name] = str(error)
            remove_proxies(folder, name)
    return cameras, seen, dropped


def _calibration(raw: RawCapture, cameras: Mapping[str, CameraSource]) -> dict[str, Camera] | None:
    """A foreign layout's cameras at the footage's size; None where ours, or none, are given."""
    sizes = {name: (c.width, c.height) for name, c in cameras.items()}
    if raw.layout == OURS:
        check_calibrated_sizes(raw, sizes)
        return None
    if raw.calibration is None:
        return None
    found: dict[str, Camera] = {}
    for name in sorted(raw.calibration.keys() & sizes.keys()):
        found |= at_size({name: raw.calibration[name]}, sizes[name])
    return found


def _with_cues(
    raw: RawCapture,
    cameras: dict[str, CameraSource],
    seen: dict[str, Seen],
    dropped: dict[str, str],
    folder: Path,
) -> tuple[RawCapture, dict[str, str]]:
    """The capture with the cues that its clips make, its cameras brought to the same lengths.

    A camera with fewer frames in a clip than most is dropped, as which it lost is not known; more
    than most have are left out.
    """
    if not raw.clips:
        return raw, {}
    table = {name: camera.clips for name, camera in cameras.items()}
    usual = tuple(_usual(counts) for counts in zip(*table.values(), strict=True))
    outside = {}
    for name, counts in table.items():
        short = [k for k, (n, most) in enumerate(zip(counts, usual, strict=True)) if n < most]
        if short:
            k = short[0]
            dropped[name] = (
                f"has {counts[k]} frames of {raw.clips[k]}, most cameras have {usual[k]}; which "
                "frames it lost is not known"
            )
            del cameras[name], seen[name]
            remove_proxies(folder, name)
        elif counts != usual:
            path = folder / f"{name}.json"
            cameras[name], seen[name] = trimmed(cameras[name], seen[name], usual, path)
            longer = [raw.clips[k] for k in range(len(usual)) if counts[k] > usual[k]]
            outside[f"last frames of {', '.join(longer)} in camera {name}"] = (
                "most cameras have fewer"
            )
    ends = np.cumsum(usual).tolist()
    rows = zip(raw.clips, ends, usual, strict=True)
    cues = tuple(Cue(clip, end - count, end - 1) for clip, end, count in rows)
    return replace(raw, cues=cues), outside


def _usual(counts: tuple[int, ...]) -> int:
    """The most common count; the larger of equally common ones."""
    table = Counter(counts)
    return max(table, key=lambda count: (table[count], count))


def _clips(index: Index) -> tuple[int, ...]:
    """Frames of each recording of its own."""
    clips = next(iter(index.cameras.values())).clips
    return clips or (index.frames,)


def usual_count(cameras: dict[str, CameraSource]) -> int:
    """Frame count that most cameras share; the larger of equally common ones."""
    return _usual(tuple(camera.frames for camera in cameras.values())) if cameras else 0


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
        calibration=_given(raw),
        cues=cues,
        meta=public_meta(raw.meta),
    )


def _given(raw: RawCapture) -> str | None:
    """Where the index says that the given cameras are."""
    if not raw.calibration:
        return None
    return "calibration.json" if raw.layout == OURS else TRANSLATED


def metrics(
    raw: RawCapture, index: Index, usual: int, lost: dict[str, str], warnings: dict[str, str]
) -> Result:
    """Counts, cameras whose frame count is not the usual one, and everything left out."""
    counts = {name: camera.frames for name, camera in index.cameras.items()}
    gaps = {k: time_gaps(c.pts, c.clips) for k, c in index.cameras.items()}
    figures = {
        "cameras": len(counts),
        "frames": sum(counts.values()),
        "expressions": len(index.cues),
        "frame_count": usual,
        "frame_count_differs": {k: n for k, n in counts.items() if n != usual},
        "time_gaps": {k: n for k, n in gaps.items() if n},
        "plates": len(index.plates),
    }
    if raw.layout != OURS:
        figures |= {"layout": raw.layout, "found": raw.found}
    return Result(
        figures,
        [Note(what, why) for what, why in lost.items()],
        [Note(what, why) for what, why in warnings.items()],
    )


def account(dataset: Dataset, subjects: list[str]) -> Iterator[str]:
    """Lines for people: what each capture was found to be."""
    for subject in subjects:
        path = dataset.item_dir("ingest", subject) / "metrics.json"
        if not path.is_file():
            continue
        told = read_json_table(path, FormatError, "ingest again")
        counts = sorted({told["frame_count"], *told["frame_count_differs"].values()})
        frames = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        yield (
            f"  {subject} ({told.get('layout', OURS)}): {told['cameras']} cameras, {frames} frames "
            f"each, {told['expressions']} expressions"
        )


def write_contact_sheet(index: Index, out: Path) -> None:
    """One row a camera, frames spread over the footage: shows swapped, dark or stuck cameras."""
    names = list(index.cameras)[:QC_CAMERAS]
    picks = np.unique(np.linspace(0, index.frames - 1, QC_COLUMNS).astype(int))
    rows = [[decode_proxy(out / "proxies", name, int(frame)) for frame in picks] for name in names]
    (out / "qc").mkdir()
    write_image(out / "qc" / "cameras.jpg", contact_sheet(rows, names), quality=88)
