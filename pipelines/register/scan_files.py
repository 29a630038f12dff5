"""Register scan files (``express50 register --scan FILE OUT``): a folder per scan, and an index."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import open3d as o3d

from express50.console import FAILED, OK, say, say_json
from express50.contract.layout import check_results_folder
from express50.dataset.export import write_head_obj
from express50.dataset.tracks import read_track
from express50.errors import ConfigError, Express50Error, FormatError
from express50.files.atomic import dump_json, folder_in_one_step, write_csv
from express50.files.digests import file_sha256, value_digest
from express50.files.text import ID, read_json_table, read_text
from express50.geometry.raycast import mesh_scene
from express50.head import absolute_head, head_files
from express50.head.load import load_head
from express50.head.model import landmarks_of
from pipelines.register.scan import PITCHES, YAWS, FittedScan, fit_scan
from pipelines.register.scan_input import (
    KINDS,
    UNITS,
    Scan,
    landmarks_beside,
    read_landmarks,
    read_scan,
)
from pipelines.register.stage import LEAST_SEEN, write_registration
from pipelines.track.stage import write_track

VERSION = 5  # raise it when a change gives other files for the same scan
INDEX = "index.csv"
COLUMNS = (
    "name", "scan", "parameters", "mesh", "parameters_mm_median", "parameters_mm_p95",
    "registered_mm_median", "registered_mm_p95", "unit", "metres_per_unit", "landmarks",
    "warnings", "error",
)  # fmt: skip
REFUSED = (
    "its name becomes a folder's; expected letters, digits, _ and -, and every name once; rename"
    " the file"
)
PICTURES, FAR_MM = len(YAWS) * len(PITCHES), 10.0
# Options that only runs on datasets use, with their defaults.
DATASET_OPTIONS: dict[str, object] = {
    "set": [], "config": None, "preset": None, "items": None, "workers": 2, "scheduler": None,
    "slurm": None, "print_job": False, "threads": 1, "strict": False,
}  # fmt: skip


def run_scans(args: argparse.Namespace) -> int:
    """Register the scans of a command line; one that fails does not stop the others."""
    for name, default in DATASET_OPTIONS.items():
        if getattr(args, name) != default:
            raise ConfigError(
                f"--{name.replace('_', '-')} is for datasets and has no effect with --scan; omit it"
            )
    load_head(args.head)  # refuse a wrong name before any work
    check_results_folder(args.dataset)
    out, accounts = args.dataset, []
    files, former = list_scans(args.scan), read_index(out / INDEX)
    taken: set[str] = set()
    try:
        for path in files:
            # A refused scan is listed by its file name, which is never the name of a folder.
            refused = not ID.fullmatch(path.stem) or path.stem in taken
            name = path.name if refused else path.stem
            taken.add(name)
            account: dict = {"name": name, "scan": str(path), "folder": str(out / name)}
            try:
                if refused:
                    raise ConfigError(REFUSED)
                account |= register_scan(path, args.head, out / name)
                line = "current" if account["skipped"] else summary_line(account)
            except Express50Error as error:
                account["error"] = line = str(error)
            accounts.append(account)
            if not args.json:
                say(f"{name}: {line}")
    finally:  # an interrupted run lists what it has made
        write_index(out / INDEX, former, accounts)
    failed = sum("error" in account for account in accounts)
    if args.json:
        say_json(accounts)
    else:
        done = len(accounts) - failed
        say(f"scans: {done} registered, {failed} failed; {out / INDEX} lists them")
    return FAILED if failed else OK


def read_index(path: Path) -> dict[str, dict[str, str]]:
    """Read an index's rows by scan name, none without the file; FormatError if it is not one."""
    if not path.exists():
        return {}
    table = csv.DictReader(read_text(path, FormatError).splitlines())
    if tuple(table.fieldnames or ()) != COLUMNS:
        raise FormatError(f"{path}: is not an index of scans; move it away or name another folder")
    return {row["name"]: row for row in table}


def write_index(path: Path, former: dict[str, dict[str, str]], accounts: list[dict]) -> None:
    """Write a row per scan, made or failed; former rows stay as long as their files exist."""
    rows: dict[str, dict] = {
        name: row
        for name, row in former.items()
        if Path(row["scan"] if row["error"] else path.parent / row["mesh"]).is_file()
    }
    for account in accounts:
        name, row = account["name"], {key: account.get(key) for key in COLUMNS}
        if "error" not in account:
            files = {"parameters": f"{name}/track.npz", "mesh": f"{name}/head.obj"}
            row |= files | {"warnings": "; ".join(account["warnings"])}
        rows[name] = row
    write_csv(path, COLUMNS, [rows[name] for name in sorted(rows)])


def list_scans(paths: list[Path]) -> list[Path]:
    """List scan files, and those in folders; ConfigError if one is missing."""
    files: list[Path] = []
    for path in paths:
        folder = path.is_dir()
        files += (
            sorted(f for f in path.iterdir() if f.suffix.lower() in KINDS) if folder else [path]
        )
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None or not files:
        raise ConfigError(
            f"--scan {missing or paths[0]}: no scan there; expected a file, one of"
            f" {', '.join(KINDS)}, or a folder of them"
        )
    return files


def register_scan(path: Path, head: str, folder: Path) -> dict:
    """Register a scan into a folder, unless the result is there already; return the metrics.

    Raises:
        Express50Error: scan or landmarks cannot be read, or the scan shows no face.
    """
    points = landmarks_beside(path)
    files = [path, *(head_files(head).values() or [Path(head)]), points]
    digests = [file_sha256(file) if file and file.is_file() else str(file) for file in files]
    identity = value_digest([VERSION, *digests])
    if folder.exists():
        file = folder / "metrics.json"
        fix = "move the folder away"
        former = read_json_table(file, FormatError, fix) if file.is_file() else {}
        if "identity" not in former:  # such as a fit of `grmm`, which has a metrics.json too
            raise FormatError(f"{folder}: is not a registration of a scan; name another folder")
        if former["identity"] == identity:
            return former | {"skipped": True}
    scan, given = read_scan(path), np.full((68, 3), np.nan)
    if points is not None:
        given = UNITS[scan.unit] * read_landmarks(points)
    fitted = fit_scan(scan, head, given)
    with folder_in_one_step(folder.with_name(f".{folder.name}.part"), folder) as out:
        file = out / "track.npz"
        vertices = fitted.start[None]
        write_track(file, absolute_head(head), fitted.basis, fitted.targets, fitted.state, vertices)
        metrics = write_registration(out, file, read_track(file), 0, fitted.laid, "parameters")
        write_head_obj(out / "head.obj", fitted.laid.vertices / UNITS[scan.unit], load_head(head))
        metrics |= distances(scan, fitted) | {"unit": scan.unit, "textured": scan.textured}
        metrics |= {"metres_per_unit": UNITS[scan.unit], "identity": identity}
        metrics |= figures_of_landmarks(fitted, given)
        metrics["warnings"] = warnings_of(metrics)
        (out / "metrics.json").write_bytes(dump_json(metrics))
    return metrics | {"skipped": False}


def figures_of_landmarks(fitted: FittedScan, given: np.ndarray) -> dict:
    """Count the views of the face and the given landmarks (68, 3); measure how far these are off.

    Distances are to the landmarks of the fitted parameters, without those of the jaw line.
    """
    marks = landmarks_of(fitted.basis.model, fitted.start)
    known = np.isfinite(given[:, 0])
    away = 1e3 * np.linalg.norm(marks - given, axis=1)[17:][known[17:]]
    return {
        "views": len(fitted.targets[0].observation.views),
        "landmarks": int(known.sum()),
        "landmarks_mm_median": round(float(np.median(away)), 4) if len(away) else None,
        "landmarks_mm_largest": round(float(away.max()), 4) if len(away) else None,
    }


def warnings_of(metrics: dict) -> list[str]:
    """Return the warnings about a registered scan."""
    seen, views, away = (metrics[k] for k in ("seen_share", "views", "landmarks_mm_largest"))
    found = {
        f"the scan was found at only {seen:.0%} of the face's vertices": seen < LEAST_SEEN,
        f"only {views} of {PICTURES} pictures of the scan show a face": views < PICTURES / 2,
        f"a given landmark is {away} mm from the fitted one": away is not None and away > FAR_MM,
    }
    return [warning for warning, holds in found.items() if holds]


def distances(scan: Scan, fitted: FittedScan) -> dict[str, float | None]:
    """Measure how far the seen vertices are from the scan, before and after laying the mesh."""
    middle, seen = scan.vertices.mean(0), fitted.laid.seen
    scene = mesh_scene(scan.vertices - middle, scan.faces)
    found: dict[str, float | None] = {}
    for name, mesh in {"parameters": fitted.start, "registered": fitted.laid.vertices}.items():
        away = scene.compute_distance(
            o3d.core.Tensor((mesh[seen] - middle).astype(np.float32))
        ).numpy()
        for key, share in (("median", 50), ("p95", 95)):
            value = round(1e3 * float(np.percentile(away, share)), 4) if seen.any() else None
            found[f"{name}_mm_{key}"] = value
    return found


def summary_line(account: dict) -> str:
    """Describe a registered scan in one line."""
    return (
        f"{account['unit']}, {'coloured' if account['textured'] else 'no colours'},"
        f" {account['landmarks']} landmarks given;"
        f" {account['seen_share']:.0%} of the face found, parameters"
        f" {account['parameters_mm_median']} mm and mesh {account['registered_mm_median']} mm from"
        f" the scan (medians){''.join('; warning: ' + warning for warning in account['warnings'])}"
    )
