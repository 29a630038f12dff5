"""``express50 import`` publishes what other tools made as the output of the stage it replaces."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame, read_recorded_cameras
from express50.console import FAILED, OK, add_command, answer, count, log
from express50.contract.layout import Dataset, existing_dataset, included_subjects
from express50.contract.stage import Note, Result, stages
from express50.dataset.depth_files import encode_depth, write_depth
from express50.errors import ConfigError, Express50Error, StageError, few
from express50.files.images import read_alpha, write_image
from express50.geometry.cameras import Camera
from express50.head import absolute_head
from express50.head.load import load_head
from express50.head.model import landmarks
from express50.runner.imported import publish_import, remove_imports
from express50.runner.ledger import Ledger
from express50.runner.progress import showing
from express50.runner.publish import clean_leftovers, stage_lock
from pipelines.imports.footage_check import (
    check_face_depth,
    check_in_view,
    check_landmarks,
    check_masks_show_face,
    check_outlines,
    observe_peak,
)
from pipelines.imports.pictures import (
    UNITS,
    PeakFrame,
    check_depths,
    check_masks,
    check_pattern,
    fill,
    peak_frames,
    read_foreign_depth,
    read_mask,
    write_fused,
)
from pipelines.imports.tracks import TrackSource, read_foreign_track
from pipelines.track.sequence import write_npz

Write = Callable[[Path], Result]
KINDS = {
    "track": "tracks of VHAP or GaussianAvatars",
    "matte": "masks or opacities",
    "depth": "depth maps: 16-bit PNG, EXR or .npy",
}
PATTERN = (
    "path of the files, with {subject}, {expression}, {camera}, {frame} (decode index) or"
    " {clip_frame} (counted from the cue's start), such as"
    " 'maps/{subject}/{camera}/{frame:06d}.png'"
)

TRACKS = (
    "folder or file of the tracks; may hold {subject} and {expression}, such as"
    " 'vhap/{subject}_{expression}'"
)


def add_commands(subparsers: Any) -> None:
    """Add ``import track``, ``matte``, ``depth`` and ``remove``."""
    actions = subparsers.add_parser(
        "import", help="import tracks, mattes or depth that other tools made"
    ).add_subparsers(dest="action", metavar="ACTION", required=True)
    for action, what in KINDS.items():
        add = add_command(actions, action, run_import, f"import {what}").add_argument
        add("pattern", metavar="PATH", help=TRACKS if action == "track" else PATTERN)
        add(
            "--subject", action="append", metavar="ID",
            help="subject to import; may be repeated (default: all)",
        )  # fmt: skip
        add("--trust", action="store_true", help="only warn if the import contradicts the footage")
        if action == "track":
            add(
                "--head", required=True, metavar="MODEL",
                help="the FLAME .pkl that the subject was tracked with",
            )  # fmt: skip
            add(
                "--axes", choices=("opengl", "opencv"), default="opengl",
                help="camera axes of the matrices in transforms.json (default: opengl)",
            )  # fmt: skip
            add(
                "--cameras", type=Path, metavar="FILE",
                help="cameras that tracked_flame_params_N.npz was made with (default: the"
                " dataset's)",
            )  # fmt: skip
            continue
        add(
            "--distorted", action="store_true",
            help="undistort the pictures, because they were made from the footage as recorded",
        )  # fmt: skip
        if action == "depth":
            add(
                "--unit", required=True, type=_metres, dest="metres", metavar="UNIT",
                help="unit of the values: m, cm, mm, or metres per step, such as 0.0001",
            )  # fmt: skip
            add("--ray", action="store_true", help="values are lengths of rays, not camera z")
    add = add_command(
        actions, "remove", run_remove, "remove imported items, so that the stage makes them itself"
    ).add_argument
    add("stage", choices=tuple(KINDS), metavar="STAGE", help=", ".join(KINDS))
    add(
        "--items", default="*", metavar="GLOB",
        help="only items that match, such as 'S001*' (default: all)",
    )  # fmt: skip


def run_remove(args: argparse.Namespace) -> int:
    """Set imported items aside and name them."""
    dataset = existing_dataset(args.dataset)
    with stage_lock(dataset, args.stage):
        gone = remove_imports(dataset, args.stage, lambda i: fnmatch.fnmatchcase(i, args.items))
    line = f"{args.stage}: {len(gone)} imported items removed"
    line += f"; express50 {args.stage} remakes them" if gone else f"; none matches {args.items!r}"
    return answer(args, {"stage": args.stage, "removed": gone}, line)


def run_import(args: argparse.Namespace) -> int:
    """Import every item of the chosen subjects; what is wrong is named, the others continue."""
    dataset, stage = existing_dataset(args.dataset.resolve()), stages()[args.action]
    subjects, rows = _subjects(dataset, args), list[dict[str, Any]]()
    plan = dict[str, Write]()
    with stage_lock(dataset, stage.name), Ledger(dataset.ledger) as ledger:
        clean_leftovers(dataset, stage.name)
        for subject in subjects:
            try:
                peaks = peak_frames(dataset, subject)
                plan |= _PLANS[args.action](dataset, subject, peaks, args)
            except Express50Error as error:
                reason = f"{type(error).__name__}: {error}"
                rows.append({"item": subject, "reason": reason, "warnings": [], "checks": {}})
        if plan:
            log(f"import {stage.name}: checking {count(len(plan), 'item')} against the footage")
        with showing(stage.name, len(plan), enabled=True) as show:
            for item, write in plan.items():
                receipt = publish_import(dataset, stage, item, write, ledger)
                show(receipt)
                found = receipt.metrics
                rows.append({
                    "item": item, "reason": receipt.reason,
                    "warnings": found.get("warnings", []), "checks": found.get("imported", {}),
                })  # fmt: skip
    failed = [row for row in rows if row["reason"]]
    lines = [f"import {stage.name}: {count(len(rows), 'item')} = {len(rows) - len(failed)} done"
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
        raise ConfigError(f"--subject {unknown[0]}: expected one or more of {', '.join(known)}")
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
    dataset: Dataset, subject: str, peaks: list[PeakFrame], args: argparse.Namespace
) -> dict[str, Write]:
    head = absolute_head(args.head)
    source = TrackSource(pattern=args.pattern, head=head, axes=args.axes, cameras=args.cameras)

    def write(out: Path) -> Result:
        arrays, notes = read_foreign_track(dataset, subject, peaks, source)
        cameras, vertices = read_cameras_of(dataset, subject), arrays["vertices"]
        for mesh in vertices:
            check_in_view(cameras, mesh, subject)
        model = load_head(str(arrays["head"]))
        marks = landmarks(model, torch.from_numpy(vertices)).double().numpy()
        errors: dict[str, float | None] = {}
        for peak, points in zip(peaks, marks, strict=True):
            found = observe_peak(dataset, subject, peak, notes)
            with trusting(args.trust, notes):
                where = f"{subject}/{peak.expression}"
                errors[peak.expression] = check_landmarks(found, points, where)
        checks = {"landmarks_off_of_face": errors, "expressions": len(peaks)}
        write_npz(out / "track.npz", arrays)
        return Result({"imported": checks}, (), notes)

    return {subject: write}


@dataclass(frozen=True)
class PeakPictures:
    """Holds the pictures of one peak frame: cameras as recorded and as seen, a file of each."""

    dataset: Dataset
    subject: str
    peak: PeakFrame
    recorded: dict[str, Camera]
    cameras: dict[str, Camera]
    files: dict[str, Path]
    args: argparse.Namespace

    @property
    def item(self) -> str:
        """Return the name of the item."""
        return f"{self.subject}/{self.peak.expression}"

    def footage(self) -> dict[str, np.ndarray]:
        """Read what the cameras recorded, undistorted."""
        expression = self.peak.expression
        return {n: read_peak_frame(self.dataset, self.subject, expression, n) for n in self.cameras}


def _plan_pictures(
    write: Callable[[PeakPictures, Path], Result],
    dataset: Dataset,
    subject: str,
    peaks: list[PeakFrame],
    args: argparse.Namespace,
) -> dict[str, Write]:
    """Plan one item per expression; StageError, and no item, if files are missing."""
    recorded, cameras = read_recorded_cameras(dataset, subject), read_cameras_of(dataset, subject)
    every = []
    for peak in peaks:
        files = {name: fill(args.pattern, subject, peak, name) for name in cameras}
        every.append(PeakPictures(dataset, subject, peak, recorded, cameras, files, args))
    missing = [path for one in every for path in one.files.values() if not path.is_file()]
    if missing:
        raise StageError(
            f"{subject}: {len(missing)} of {len(cameras) * len(peaks)} files are missing:"
            f" {few([*map(str, missing)])}; every camera of every peak frame needs one"
        )
    return {one.item: partial(write, one) for one in every}


def _write_masks(given: PeakPictures, out: Path) -> Result:
    masks = {
        name: read_mask(path, given.recorded[name], given.cameras[name], given.args.distorted)
        for name, path in given.files.items()
    }
    check_masks(given.cameras, masks, given.item)
    notes, checks = list[Note](), dict[str, object](cameras=len(masks))
    found = observe_peak(given.dataset, given.subject, given.peak, notes)
    with trusting(given.args.trust, notes):
        check_masks_show_face(found, masks, given.item)
        checks["edge_contrast"] = check_outlines(given.footage(), masks, given.item)
    for name, alpha in masks.items():
        write_image(out / f"{name}.png", alpha)
    return Result({"imported": checks}, (), notes)


def _write_depths(given: PeakPictures, out: Path) -> Result:
    cameras, depths, args = given.cameras, {}, given.args
    for name, path in given.files.items():
        depth = read_foreign_depth(
            path, given.recorded[name], cameras[name], args.metres, args.ray, args.distorted
        )
        matte = given.dataset.matte_file(given.subject, given.peak.expression, name)
        # Depth of the set would become part of the head.
        depths[name] = depth * (read_alpha(matte) > 127) if matte.is_file() else depth
    known = {name: depth for name, depth in depths.items() if depth.any()}
    if not known:
        raise StageError(f"{given.item}: its depth maps have no known depth inside the mattes")
    notes, checks = list[Note](), dict[str, object]()
    if empty := [name for name in depths if name not in known]:
        notes.append(Note(few(empty), "depth is unknown everywhere inside the matte"))
    found = observe_peak(given.dataset, given.subject, given.peak, notes)
    with trusting(args.trust, notes):
        checks["off_the_face_m"] = check_face_depth(found, cameras, depths, given.item)
        checks["views_agree"] = check_depths(cameras, depths, given.item)
    for name, depth in depths.items():
        valid = depth > 0
        write_depth(out, name, encode_depth(depth, valid))
        write_image(out / f"{name}_confidence.png", np.where(valid, 255, 0).astype(np.uint8))
    vertices = write_fused(out / "surface.ply", cameras, known, given.footage())
    return Result({"imported": checks | {"surface_vertices": vertices}}, (), notes)


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
