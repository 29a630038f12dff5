"""``express50 import`` publishes what other tools made as the output of the stage it replaces."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.console import FAILED, OK, add_command, answer
from express50.contract.layout import Dataset, existing_dataset, included_subjects
from express50.contract.stage import Note, Result, stages
from express50.dataset.depth_files import write_depth
from express50.dataset.tracks import SCHEMA
from express50.errors import ConfigError, StageError
from express50.files.images import read_alpha, write_image
from express50.geometry.cameras import pinhole
from express50.head.load import load_head
from express50.head.model import landmarks
from express50.runner.imported import publish_import, remove_imports
from express50.runner.ledger import Ledger
from express50.runner.publish import clean_leftovers, stage_lock
from pipelines.imports.footage_check import (
    check_face_depth,
    check_in_view,
    check_landmarks,
    check_masks_show_face,
    check_outlines,
    observe_peak,
)
from pipelines.imports.fusion import write_fused
from pipelines.imports.pictures import (
    UNITS,
    check_depths,
    check_masks,
    read_foreign_depth,
    read_mask,
)
from pipelines.imports.places import PeakFrame, check_pattern, fill, peak_frames
from pipelines.imports.tracks import TrackSource, read_foreign_track
from pipelines.track.sequence import write_npz

Write = Callable[[Path], Result]
WORDS = {
    "track": "tracks of VHAP or GaussianAvatars",
    "matte": "masks or opacities",
    "depth": "depth maps: 16-bit PNG, EXR or .npy",
}
NO_FACE = "the footage shows no face that two cameras agree on; it was not compared to one"
PATTERN = (
    "path with {subject}, {expression}, {camera}, {frame} (decode index) or {clip_frame} (counted"
    " from the cue's start) in it, such as 'masks/{subject}/{camera}/{frame:06d}.png'"
)


def add_commands(subparsers: Any) -> None:
    """Add ``import track``, ``matte``, ``depth`` and ``remove``."""
    words = "take in tracks, mattes or depth that other tools made"
    actions = subparsers.add_parser("import", help=words).add_subparsers(
        dest="action", metavar="ACTION", required=True
    )
    for action, what in WORDS.items():
        parser = add_command(actions, action, run_import, f"take in {what}")
        add = parser.add_argument
        add("pattern", metavar="PATH", help=PATTERN)
        add("--subject", action="append", metavar="ID", help="may be repeated [all included]")
        words = "only warn where it does not fit what the footage shows"
        add("--trust", action="store_true", help=words)
        if action == "track":
            add("--head", required=True, metavar="MODEL", help="FLAME's .pkl that was tracked with")
            words = "of the camera matrices in transforms.json [opengl]"
            add("--axes", choices=("opengl", "opencv"), default="opengl", help=words)
            words = "calibration that tracked_flame_params_N.npz was tracked with, if another"
            add("--cameras", type=Path, metavar="FILE", help=words)
            continue
        words = "the pictures are of the footage as recorded: undistort them"
        add("--distorted", action="store_true", help=words)
        if action == "depth":
            words = "of the values: m, cm, mm, or metres per step, such as 0.0001"
            add("--unit", required=True, help=words)
            add("--ray", action="store_true", help="they are lengths of rays, not camera z")
    words = "give imported items up, so that their stage makes them"
    parser = add_command(actions, "remove", run_remove, words)
    parser.add_argument("stage", choices=tuple(WORDS))
    parser.add_argument("--items", default="*", metavar="GLOB", help="such as 'S001*' [all]")


def run_remove(args: argparse.Namespace) -> int:
    """Set imported items aside, and say which."""
    dataset = existing_dataset(args.dataset)
    with stage_lock(dataset, args.stage):
        gone = remove_imports(dataset, args.stage, lambda i: fnmatch.fnmatchcase(i, args.items))
    line = f"{args.stage}: {len(gone)} imported items given up; express50 {args.stage} makes them"
    return answer(args, {"stage": args.stage, "removed": gone}, line)


def run_import(args: argparse.Namespace) -> int:
    """Import every item of the chosen subjects; one that is wrong is named, the others go on."""
    dataset, stage = existing_dataset(args.dataset.resolve()), stages()[args.action]
    subjects, writers = _subjects(dataset, args), _PLANS[args.action]
    metres = _metres(args.unit) if args.action == "depth" else 1.0
    rows = []
    with stage_lock(dataset, stage.name), Ledger(dataset.ledger) as ledger:
        clean_leftovers(dataset, stage.name)
        for subject in subjects:
            peaks = peak_frames(dataset, subject)
            for item, write in writers(dataset, subject, peaks, args, metres).items():
                receipt = publish_import(dataset, stage, item, write, ledger)
                metrics = receipt.metrics.get("imported", {})
                warnings = receipt.metrics.get("warnings", [])
                rows.append({"item": item, "reason": receipt.reason, "warnings": warnings}
                            | {"checks": metrics})  # fmt: skip
    failed = [row for row in rows if row["reason"]]
    lines = [f"import {stage.name}: read {len(rows)} = {len(rows) - len(failed)} done"
             f" + {len(failed)} failed"]  # fmt: skip
    lines += [f"  failed {row['item']}: {row['reason']}" for row in failed]
    lines += [
        f"  warning {r['item']}: {n['what']}: {n['why']}" for r in rows for n in r["warnings"]
    ]
    answer(args, {"stage": stage.name, "items": rows}, *lines)
    return FAILED if failed else OK


def _subjects(dataset: Dataset, args: argparse.Namespace) -> list[str]:
    needed = () if args.action == "track" else ("expression", "camera")
    places, known = check_pattern(args.pattern, needed), included_subjects(dataset)
    chosen = args.subject or known
    if unknown := sorted(set(chosen) - set(known)):
        raise ConfigError(f"--subject {unknown[0]}: expected some of {', '.join(known)}")
    if len(chosen) > 1 and "subject" not in places:
        raise ConfigError(
            f"{args.pattern}: has no {{subject}}, and the dataset has {len(chosen)} subjects;"
            " name one with --subject"
        )
    return list(dict.fromkeys(chosen))


def _metres(unit: str) -> float:
    try:
        metres = UNITS.get(unit) or float(unit)
    except ValueError:
        metres = 0.0
    if not 0 < metres < np.inf:
        raise ConfigError(f"--unit {unit!r}: expected m, cm, mm, or metres per step above 0")
    return metres


def _plan_tracks(
    dataset: Dataset, subject: str, peaks: list[PeakFrame], args: argparse.Namespace, _: float
) -> dict[str, Write]:
    head = args.head if args.head == "procedural" else str(Path(args.head).expanduser().resolve())
    source = TrackSource(pattern=args.pattern, head=head, axes=args.axes, cameras=args.cameras)
    return {subject: partial(_write_track, dataset, subject, peaks, source, args.trust)}


def _write_track(
    dataset: Dataset,
    subject: str,
    peaks: list[PeakFrame],
    source: TrackSource,
    trust: bool,
    out: Path,
) -> Result:
    track, notes = read_foreign_track(dataset, subject, peaks, source)
    model = load_head(track.head)
    marks = landmarks(model, torch.from_numpy(track.vertices.astype(np.float32))).numpy()
    cameras = read_cameras_of(dataset, subject)
    errors: dict[str, float | None] = {}
    for mesh in track.vertices:
        check_in_view(cameras, mesh, subject)
    for peak, points in zip(peaks, marks.astype(np.float64), strict=True):
        found = observe_peak(dataset, subject, peak)
        where = f"{subject}/{peak.expression}"
        with trusting(trust, notes):
            errors[peak.expression] = check_landmarks(found, points, where)
        if found is None:
            notes.append(Note(peak.expression, NO_FACE))
    names = ("shape", "expression", "neck", "jaw", "eyes", "R", "t", "frames", "vertices",
             "offsets")  # fmt: skip
    arrays = {name: getattr(track, name) for name in names}
    texts = {"schema": SCHEMA, "head": track.head, "expressions": track.expressions}
    write_npz(out / "track.npz", arrays | {k: np.array(v) for k, v in texts.items()})
    checks = {"landmarks_off_of_face": errors, "expressions": len(peaks)}
    return Result({"imported": checks}, (), notes)


def _plan_pictures(
    write: Callable[..., Result],
    dataset: Dataset,
    subject: str,
    peaks: list[PeakFrame],
    args: argparse.Namespace,
    metres: float,
) -> dict[str, Write]:
    """Plan one item per expression.

    Raises:
        StageError: files are missing; nothing is imported.
    """
    cameras = read_cameras_of(dataset, subject, undistorted=False)
    plan: dict[str, Write] = {}
    missing: list[Path] = []
    for peak in peaks:
        files = {name: fill(args.pattern, subject, peak, name) for name in cameras}
        missing += [path for path in files.values() if not path.is_file()]
        known = partial(write, dataset, subject, peak, files, args, metres)
        plan[f"{subject}/{peak.expression}"] = known
    if missing:
        more = f" and {len(missing) - 3} more" if missing[3:] else ""
        raise StageError(
            f"{subject}: {len(missing)} of {len(cameras) * len(peaks)} files are missing:"
            f" {', '.join(map(str, missing[:3]))}{more}; every camera of every peak frame needs one"
        )
    return plan


def _write_masks(
    dataset: Dataset,
    subject: str,
    peak: PeakFrame,
    files: dict[str, Path],
    args: argparse.Namespace,
    _: float,
    out: Path,
) -> Result:
    cameras = read_cameras_of(dataset, subject, undistorted=False)
    masks = {n: read_mask(path, cameras[n], args.distorted) for n, path in files.items()}
    flat = {name: pinhole(camera) for name, camera in cameras.items()}
    where = f"{subject}/{peak.expression}"
    check_masks(flat, masks, where)
    found, notes = observe_peak(dataset, subject, peak), list[Note]()
    checks: dict[str, object] = {"cameras": len(masks)}
    pictures = {n: read_peak_frame(dataset, subject, peak.expression, n) for n in masks}
    with trusting(args.trust, notes):
        check_masks_show_face(found, masks, where)
        checks["edge_contrast"] = check_outlines(pictures, masks, where)
    if found is None:
        notes.append(Note(peak.expression, NO_FACE))
    for name, alpha in masks.items():
        write_image(out / f"{name}.png", alpha)
    return Result({"imported": checks}, (), notes)


def _write_depths(
    dataset: Dataset,
    subject: str,
    peak: PeakFrame,
    files: dict[str, Path],
    args: argparse.Namespace,
    metres: float,
    out: Path,
) -> Result:
    cameras = read_cameras_of(dataset, subject, undistorted=False)
    depths = {}
    for name, path in files.items():
        depth = read_foreign_depth(path, cameras[name], metres, args.ray, args.distorted)
        matte = dataset.matte_file(subject, peak.expression, name)
        # Depth of the set would become part of the head.
        depths[name] = depth * (read_alpha(matte) > 127) if matte.is_file() else depth
    flat = {name: pinhole(camera) for name, camera in cameras.items()}
    where = f"{subject}/{peak.expression}"
    found, notes = observe_peak(dataset, subject, peak), list[Note]()
    checks: dict[str, object] = {}
    with trusting(args.trust, notes):
        checks["off_the_face_m"] = check_face_depth(found, flat, depths, where)
        checks["views_agree"] = check_depths(flat, depths, where)
    if found is None:
        notes.append(Note(peak.expression, NO_FACE))
    for name, depth in depths.items():
        known = depth > 0
        write_depth(out, name, depth, known)
        write_image(out / f"{name}_confidence.png", np.where(known, 255, 0).astype(np.uint8))
    pictures = {n: read_peak_frame(dataset, subject, peak.expression, n) for n in depths}
    checks["surface_vertices"] = write_fused(out / "surface.ply", flat, depths, pictures)
    return Result({"imported": checks}, (), notes)


@contextmanager
def trusting(trust: bool, notes: list[Note]) -> Iterator[None]:
    """Turn what the footage contradicts into a warning, where the user trusts the import."""
    try:
        yield
    except StageError as error:
        if not trust:
            raise
        notes.append(Note("trusted", str(error)))


_PLANS: dict[str, Callable[..., dict[str, Write]]] = {
    "track": _plan_tracks,
    "matte": partial(_plan_pictures, _write_masks),
    "depth": partial(_plan_pictures, _write_depths),
}
