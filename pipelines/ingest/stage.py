"""Decode every camera once, and write the frame index, the proxies and a contact sheet.

Every later stage names frames by decode index. The index holds each frame's time stamp and hash, so
that a label can be checked against the footage it was made on. Proxies are small JPEGs in an
indexed tar, because a random seek in 4K H.264 costs half a second. The same pass checks sync, focus
and light: faults are warnings, and the figures go to checks.json.

Decoding is most of the work for long clips, and later stages need few frames. With `every` above 1
only some are decoded; the others have a time stamp but no hash, and their proxies are made on
request (`express50.capture.frames.read_proxy`).
"""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from express50.capture.demographics import PUBLIC_KEYS, public_meta
from express50.capture.frames import decode_proxy
from express50.capture.index import (
    TRANSLATED,
    UNKNOWN_HASH,
    CameraSource,
    Cue,
    Index,
    index_to_json,
)
from express50.capture.raw import RawCapture, check_calibrated_sizes, check_focals
from express50.capture.readers.read import OURS, read_any, subject_of, watched
from express50.console import group_lines, log
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.dataset.withdraw import withdrawn
from express50.errors import CaptureError, StageError, advised, few, nearest
from express50.files.atomic import dump_json, write_json
from express50.files.calibration import write_cameras
from express50.files.digests import stat_digest, text_digest
from express50.files.images import write_image
from express50.files.text import KEY_LENGTH
from express50.files.video import FPS_SLACK
from express50.geometry.cameras import Camera
from express50.geometry.pixels import contact_sheet
from express50.rigs.camera_builder import at_size
from pipelines.ingest.quality import CameraMeasurements, check_quality
from pipelines.ingest.scan import (
    odd_footage,
    remove_proxies,
    scan_camera,
    time_gaps,
    trimmed,
    video_rates,
)

QC_CAMERAS, QC_COLUMNS = 24, 6
BLACK_LIGHT = 1e-3  # linear light, 3 of 255 levels
# Keys of capture.toml, with one that 'express50 photo' writes.
KNOWN_KEYS = PUBLIC_KEYS | {"gender", "age", "picture_sha256"}
CHOICES = {"sequences", "cameras", "expressions"}  # of parts, in all layouts but ours
UNITLESS = ("colmap", "transforms")  # layouts that do not state their unit
METRES = ("m", "metre", "metres", "meter", "meters")
FILE_ENDINGS = ("head", "confidence", "normals")  # later stages write <camera>_<ending>.png


def add_captures(dataset: Dataset, captures: list[Path], replace: bool = False) -> list[str]:
    """Add raw captures to the dataset's table; returns their subjects in the given order.

    A subject's other capture that still exists is only replaced if ``replace`` is true.

    Raises:
        CaptureError: a folder is not a capture, two captures claim one subject, the dataset has a
            capture under another subject, or the subject was withdrawn, has another capture
            already, or differs from another only in letter case.
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
                f"{root}: has the same subject ({subject}) as {added[subject]}; "
                "give each capture its own subject id (subject in capture.toml)"
            )
        known = Path(table.get(subject, root))
        if known.exists() and not known.samefile(root) and not replace:
            raise CaptureError(
                f"{root}: subject {subject} of {dataset.root} already has the capture {known}; if"
                f" {root} is another person or session, give it another subject id (subject in"
                f" capture.toml); to replace {known} by it, add --replace"
            )
        if not known.exists():
            log(f"{subject}: {known} is gone, its footage is now read from {root}")
        for other in table.keys() | added.keys():
            if subject not in table and other != subject and other.lower() == subject.lower():
                raise CaptureError(
                    f"{root}: subject {subject} differs from {other} only in letter case, which"
                    " many disks ignore; give it another id (subject in capture.toml)"
                )
        added[subject] = str(root)
    for former, place in (table | added).items():
        for subject, folder in added.items():
            if folder == place and subject != former:
                raise CaptureError(f"{folder}: {_renamed(dataset, former, subject)}")
    if not added.items() <= table.items():
        write_json(dataset.captures_file, table | added)
    return list(added)


def _renamed(dataset: Dataset, former: str, now: str) -> str:
    """Say what to do about a capture that a dataset has under another subject."""
    withdraw = advised("express50 subject withdraw", dataset.root, former)
    return (
        f"subject is {now!r}, but the dataset has this capture as {former!r}; set that id again in"
        f" capture.toml, or take {former} out ({withdraw}) and ingest the capture again; if"
        f" {former}'s capture lies elsewhere now, ingest it from there first"
    )


def inputs(dataset: Dataset, item: str) -> dict[str, Path | str]:
    """Identify the capture by its files' names, sizes and times: hashing terabytes takes hours."""
    first, *others = watched(_capture_of(dataset, item))
    found: dict[str, Path | str] = {"capture": stat_digest(first)}
    return found | {f"capture {n}": stat_digest(p) for n, p in enumerate(others, 1)}


def _capture_of(dataset: Dataset, item: str) -> Path:
    captures = dataset.captures()
    if item not in captures:
        raise StageError(
            f"{dataset.captures_file}: no capture of {item!r}; "
            f"run {advised('express50 ingest', dataset.root, 'CAPTURE')}"
        )
    if not captures[item].exists():
        raise CaptureError(
            f"{captures[item]}: no such folder; run"
            f" {advised('express50 ingest', dataset.root, 'CAPTURE')}"
            f" with the folder where {item}'s capture is now; if that has another name, write"
            f" subject = {item!r} into a capture.toml in it first"
        )
    return captures[item]


def run(
    dataset: Dataset, item: str, out: Path, *, proxy_long_side: int, proxy_quality: int, every: int,
    sync_frames: int, focus_every: int, blur_ratio: float,
) -> Result:  # fmt: skip
    """Index one capture; an unusable camera is dropped with its reason."""
    raw = read_any(_capture_of(dataset, item))
    if raw.subject != item:
        raise CaptureError(f"{raw.root / 'capture.toml'}: {_renamed(dataset, item, raw.subject)}")
    check_focals(raw.root / "capture.toml", raw.meta.get("focal_px", {}))
    check_sample_names(raw)
    (out / "proxies").mkdir()
    proxy = proxy_long_side, proxy_quality
    cameras, measured, dropped = _scan(raw, out / "proxies", proxy, every, focus_every)
    calibration = _calibration(raw, cameras)
    raw, outside = _with_cues(raw, cameras, measured, dropped, out / "proxies")
    usual = usual_count([camera.frames for camera in cameras.values()])
    cues, beyond = split_cues(raw.cues, usual)
    rates = video_rates(raw, cameras)
    unusable = black_cameras(measured) | short_cameras(cameras, cues)
    for name, reason in (unusable | cameras_of_other_rates(raw, cameras, rates)).items():
        dropped[name] = reason
        del cameras[name]
        remove_proxies(out / "proxies", name)
    dropped = shared_reasons(dropped)
    if not cameras:
        reasons = [*group_lines((f"camera {k}", why) for k, why in sorted(dropped.items()))]
        why = few(reasons, between="; ") or "cameras/ is empty"
        raise CaptureError(f"{raw.root}: no usable camera: {why}")
    if calibration is not None:
        write_cameras(out / "calibration.json", calibration)
    index = make_index(raw, cameras, cues)
    (out / "index.json").write_bytes(dump_json(index_to_json(index)))
    write_contact_sheet(index, out)
    digests = {name: camera.sha256 for name, camera in cameras.items()}
    clips = next(iter(cameras.values())).clips or (index.frames,)
    kept = {name: measured[name] for name in cameras}
    figures, warnings = check_quality(kept, digests, clips, every, sync_frames, blur_ratio)
    for name, why in odd_footage(raw, cameras, measured, rates).items():
        warnings[name] = "; ".join([why, *filter(None, [warnings.get(name)])])
    write_json(out / "checks.json", figures)
    lost = {f"camera {k}": why for k, why in sorted(dropped.items())}
    lost |= {f"expression {k}": why for k, why in sorted(beyond.items())} | outside | raw.skipped
    return make_result(
        raw, index, usual, lost, raw.warnings | odd_keys(raw) | odd_cues(raw, cues) | warnings
    )


def _scan(
    raw: RawCapture, folder: Path, proxy: tuple[int, int], every: int, focus_every: int
) -> tuple[dict[str, CameraSource], dict[str, CameraMeasurements], dict[str, str]]:
    """Scan all cameras; return them, their measurements, and why the others are dropped.

    Raises:
        CaptureError: files of one camera would replace those of another in a later stage.
    """
    dropped = dict(raw.dropped)
    cameras, measured = {}, {}
    for name, camera in raw.cameras.items():
        try:
            cameras[name], measured[name] = scan_camera(
                raw, camera, folder, proxy, every, focus_every
            )
        except CaptureError as error:
            dropped[name] = str(error)
            remove_proxies(folder, name)
    for name in cameras:
        first, _, ending = name.rpartition("_")
        if ending in FILE_ENDINGS and first in cameras:
            raise CaptureError(
                f"{raw.root}: files of cameras {first} and {name} would have the same name;"
                f" rename {name}"
            )
    return cameras, measured, dropped


def shared_reasons(dropped: Mapping[str, str]) -> dict[str, str]:
    """Write * for the camera's name in paths, where that makes the reasons of several alike."""
    alike = {k: re.sub(rf"/{re.escape(k)}(?=[/.:])", "/*", why) for k, why in dropped.items()}
    several = {why for why, count in Counter(alike.values()).items() if count > 1}
    return {k: alike[k] if alike[k] in several else why for k, why in dropped.items()}


def _calibration(raw: RawCapture, cameras: Mapping[str, CameraSource]) -> dict[str, Camera] | None:
    """Return a foreign layout's cameras at the footage's size; None for ours, or without any."""
    sizes = {name: (c.width, c.height) for name, c in cameras.items()}
    if raw.layout == OURS:
        check_calibrated_sizes(raw, sizes)
        return None
    if raw.calibration is None:
        return None
    names = sorted(raw.calibration.keys() & sizes.keys())
    return {name: at_size(raw.calibration[name], sizes[name]) for name in names}


def _with_cues(
    raw: RawCapture,
    cameras: dict[str, CameraSource],
    measured: dict[str, CameraMeasurements],
    dropped: dict[str, str],
    folder: Path,
) -> tuple[RawCapture, dict[str, str]]:
    """Return the capture with a cue per clip, all cameras cut to the same lengths, and the cuts.

    A camera with fewer frames in a clip than most is dropped, because the lost frames are unknown.
    """
    if not raw.clips or not cameras:
        return raw, {}
    table = {name: camera.clips for name, camera in cameras.items()}
    usual = tuple(usual_count(counts) for counts in zip(*table.values(), strict=True))
    outside = {}
    for name, counts in table.items():
        short = [k for k, (n, most) in enumerate(zip(counts, usual, strict=True)) if n < most]
        if short:
            k = short[0]
            dropped[name] = (
                f"has {counts[k]} frames of {raw.clips[k]}, most cameras have {usual[k]}; it "
                "is unknown which frames it lost"
            )
            del cameras[name], measured[name]
            remove_proxies(folder, name)
        elif counts != usual:
            path = folder / f"{name}.json"
            cameras[name], measured[name] = trimmed(cameras[name], measured[name], usual, path)
            longer = [raw.clips[k] for k in range(len(usual)) if counts[k] > usual[k]]
            outside[f"last frames of {', '.join(longer)} in camera {name}"] = (
                "most cameras have fewer"
            )
    ends = np.cumsum(usual).tolist()
    rows = zip(raw.clips, ends, usual, strict=True)
    cues = tuple(Cue(clip, end - count, end - 1) for clip, end, count in rows)
    return dataclasses.replace(raw, cues=cues), outside


def usual_count(counts: Sequence[int]) -> int:
    """Return the most common count, the larger of equally common ones; 0 without any."""
    table = Counter(counts)
    return max(table, key=lambda count: (table[count], count), default=0)


def split_cues(cues: tuple[Cue, ...], frames: int) -> tuple[tuple[Cue, ...], dict[str, str]]:
    """Return the cues inside the footage, and why the others are dropped."""
    outside = {
        cue.expression_id: f"cue runs from frame {cue.start_frame} to {cue.end_frame}, the "
        f"footage has frames 0 to {frames - 1}, whatever its files are called; correct cues.csv"
        for cue in cues
        if cue.end_frame >= frames
    }
    return tuple(cue for cue in cues if cue.expression_id not in outside), outside


def check_sample_names(raw: RawCapture) -> None:
    """Raise CaptureError, before hours of decoding, if keys of samples would be too long."""
    expressions = [*(cue.expression_id for cue in raw.cues), *raw.clips]
    longest = [max(names, key=len, default="") for names in (expressions, raw.cameras)]
    ids = dict(zip(("subject", "expression", "camera"), (raw.subject, *longest), strict=True))
    name = "_".join(ids.values())
    if len(name) > KEY_LENGTH:
        lengths = ", ".join(f"{what} {len(text)}" for what, text in ids.items())
        raise CaptureError(
            f"{raw.root}: samples would have names such as {name!r} ({lengths} characters),"
            f" expected at most {KEY_LENGTH} together; shorten an id"
        )


def odd_keys(raw: RawCapture) -> dict[str, str]:
    """Return what is odd about capture.toml: keys that nothing reads, units, unknown cameras."""
    found = []
    misplaced = sorted(CHOICES & raw.meta.keys()) if raw.layout == OURS else []
    if misplaced:
        found.append(
            f"{', '.join(misplaced)}: only read for other layouts; in our own, leave out folders of"
            " cameras/ and rows of cues.csv instead"
        )
    if "metres_per_unit" in raw.meta and raw.layout not in UNITLESS:
        found.append(
            f"metres_per_unit: read for {' and '.join(UNITLESS)} only; scale the calibration with"
            " 'express50 cameras import --scale'"
        )
    valid = sorted(KNOWN_KEYS - (CHOICES if raw.layout == OURS else set()))
    if unknown := sorted(raw.meta.keys() - KNOWN_KEYS):
        words = ", ".join(f"{key!r}{nearest(key, valid)}" for key in unknown)
        found.append(f"unknown {words}; keys are {', '.join(valid)}")
    units = raw.meta.get("units", "m")
    if str(units).lower() not in METRES:
        found.append(f"units is {units!r}, but lengths are taken as metres: convert them")
    colours = raw.meta.get("color_space", "sRGB")
    names = [name.lower() for camera in raw.cameras.values() for name in camera.names[:1]]
    usual = ["srgb"]
    if any(name.endswith((".exr", ".tif", ".tiff")) for name in names):  # may hold floats
        usual.append("linear")
    if str(colours).lower() not in usual:
        found.append(
            f"color_space is {colours!r}, but pictures are taken as sRGB (float pictures as linear"
            " light): convert them"
        )
    focals = raw.meta.get("focal_px")
    if isinstance(focals, dict) and (strange := sorted(focals.keys() - raw.cameras.keys())):
        known = few(list(raw.cameras), 8)
        found.append(f"focal_px names {', '.join(strange)}, but cameras are {known}")
    return {"capture.toml": "; ".join(found)} if found else {}


def odd_cues(raw: RawCapture, cues: tuple[Cue, ...]) -> dict[str, str]:
    """Return which expressions share frames with one before them; say so if there are none."""
    if not cues:
        if not (raw.root / "cues.csv").is_file():
            what = "is missing"
        else:
            what = "names no expression inside the footage" if raw.cues else "names none"
        return {
            "expressions": f"cues.csv {what}, and later stages need one; add rows expression_id,"
            "start_frame,end_frame, then run 'express50 ingest' again"
        }
    found = {}
    for a, b in combinations(cues, 2):
        first, last = max(a.start_frame, b.start_frame), min(a.end_frame, b.end_frame)
        if first <= last:
            found[f"expression {b.expression_id}"] = (
                f"its cue shares frames {first} to {last} with {a.expression_id}; correct cues.csv"
            )
    return found


def short_cameras(cameras: dict[str, CameraSource], cues: tuple[Cue, ...]) -> dict[str, str]:
    """Return the cameras that end before the last cue, with the reason."""
    needed = 1 + max((cue.end_frame for cue in cues), default=-1)
    return {
        name: f"has {camera.frames} frames, the cues need {needed}; it stopped early, and "
        "it is unknown which frames it lost"
        for name, camera in cameras.items()
        if camera.frames < needed
    }


def cameras_of_other_rates(
    raw: RawCapture, cameras: Mapping[str, CameraSource], rates: Mapping[str, float]
) -> dict[str, str]:
    """Return the cameras that were recorded at another rate than most, with the reason.

    Their frames show other moments, and their number differs as the rates do. If only the statement
    is wrong, it does not.
    """
    stated = {name: rates.get(name, raw.fps) for name in cameras}

    def alike(rate: float) -> list[str]:
        return [name for name, other in stated.items() if abs(other - rate) <= FPS_SLACK * rate]

    usual = max(
        stated.values(), key=lambda rate: (len(alike(rate)), -abs(rate - raw.fps)), default=raw.fps
    )
    usually = usual_count([cameras[name].frames for name in alike(usual)])
    return {
        name: f"recorded at {stated[name]:.4g} frames per second, most cameras at {usual:.4g}, so"
        " frame numbers show other moments here; convert the video, for example with"
        f" 'ffmpeg -i IN -vf fps={usual:.4g} OUT.mp4'"
        for name, camera in cameras.items()
        if name not in alike(usual)
        and abs(camera.frames - usually * stated[name] / usual) < abs(camera.frames - usually)
    }


def black_cameras(measured: Mapping[str, CameraMeasurements]) -> dict[str, str]:
    """Return the cameras that show nothing in any frame, with the reason."""
    why = "all of its frames are black; check its lens cap, cable and recorder"
    return {name: why for name, one in measured.items() if one.cells.max(initial=0) < BLACK_LIGHT}


def make_index(raw: RawCapture, cameras: dict[str, CameraSource], cues: tuple[Cue, ...]) -> Index:
    """Make the index of the usable cameras."""
    board = raw.board and {
        "config": raw.board["config"],
        "cameras": {k: v for k, v in raw.board["cameras"].items() if k in cameras},
    }
    calibration = "calibration.json" if raw.layout == OURS else TRANSLATED
    return Index(
        subject=raw.subject,
        capture=raw.root,
        fps=raw.fps,
        cameras=cameras,
        plates={k: v for k, v in raw.plates.items() if k in cameras},
        board=board,
        calibration=calibration if raw.calibration else None,
        cues=cues,
        meta=public_meta(raw.meta),
    )


def make_result(
    raw: RawCapture, index: Index, usual: int, lost: dict[str, str], warnings: dict[str, str]
) -> Result:
    """Return the counts, the cameras with an unusual one, and everything that was left out."""
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


def write_contact_sheet(index: Index, out: Path) -> None:
    """Draw a row per camera, with frames from all of its footage, to show dark or stuck cameras."""
    names = list(index.cameras)[:QC_CAMERAS]
    rows = []
    for name in names:
        hashes = index.cameras[name].dhash[: index.frames]
        decoded = [frame for frame, value in enumerate(hashes) if value != UNKNOWN_HASH]
        picks = np.unique(np.linspace(0, len(decoded) - 1, QC_COLUMNS).astype(int))
        rows.append([decode_proxy(out / "proxies", name, decoded[pick]) for pick in picks])
    (out / "qc").mkdir()
    write_image(out / "qc" / "cameras.jpg", contact_sheet(rows, names), quality=88)
