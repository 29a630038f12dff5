"""``express50 register --scan FILE OUT`` registers scans and writes a folder per scan."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d

from express50.console import FAILED, OK, say, say_json
from express50.dataset.export import write_head_obj
from express50.dataset.tracks import read_track
from express50.errors import ConfigError, Express50Error, FormatError
from express50.files.atomic import dump_json, folder_in_one_step
from express50.files.digests import file_sha256, value_digest
from express50.files.text import ID, read_json_table
from express50.geometry.raycast import mesh_scene
from express50.head.load import load_head
from pipelines.register.scan import KINDS, UNITS, FittedScan, Scan, fit_scan, read_scan
from pipelines.register.stage import write_registration
from pipelines.track.stage import write_track

VERSION = 3  # raise it when the same scan gives other files
OF_DATASETS = ("set", "config", "items", "scheduler", "slurm", "print_job")


def run_scans(args: argparse.Namespace) -> int:
    """Register the scans of a command line; one that fails does not stop the others."""
    ignored = [name for name in OF_DATASETS if getattr(args, name)]
    if ignored:
        raise ConfigError(f"--{ignored[0].replace('_', '-')} goes with a dataset, not with --scan")
    load_head(args.head)  # a wrong name is an error before the work
    out, accounts = args.dataset, []
    for name, path in scans_of(args.scan).items():
        account = {"scan": str(path), "folder": str(out / name)}
        try:
            account |= register_scan(path, args.head, out / name)
            words = "current" if account["skipped"] else line_of(account)
        except Express50Error as error:
            account["error"] = words = str(error)
        accounts.append(account)
        if not args.json:
            say(f"{name}: {words}")
    if args.json:
        say_json(accounts)
    return FAILED if any("error" in account for account in accounts) else OK


def scans_of(paths: list[Path]) -> dict[str, Path]:
    """List scans by the names of their folders; of a folder all scans in it.

    Raises:
        ConfigError: one is missing, two have one name, or one cannot be a folder's name.
    """
    files = [
        file
        for path in paths
        for file in (
            sorted(f for f in path.iterdir() if f.suffix.lower() in KINDS)
            if path.is_dir()
            else [path]
        )
    ]
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None or not files:
        raise ConfigError(
            f"--scan {missing or paths[0]}: no scan there; expected a file, one of"
            f" {', '.join(KINDS)}, or a folder of them"
        )
    found: dict[str, Path] = {}
    for file in files:
        if not ID.fullmatch(file.stem) or file.stem in found:
            raise ConfigError(
                f"--scan {file}: its name becomes a folder's; expected letters, digits, _ and -,"
                " and no name twice: rename it"
            )
        found[file.stem] = file
    return found


def register_scan(path: Path, head: str, folder: Path) -> dict:
    """Register a scan into a folder, unless it holds the result already; returns the metrics.

    Raises:
        Express50Error: the scan cannot be read, or shows no face.
    """
    model = Path(head).expanduser()
    identity = value_digest(
        [VERSION, file_sha256(path), file_sha256(model) if model.is_file() else head]
    )
    if folder.exists():
        if not (folder / "metrics.json").is_file():
            raise FormatError(f"{folder}: is not a registration of a scan; name another folder")
        former = read_json_table(folder / "metrics.json", FormatError, "delete the folder")
        if former.get("identity") == identity:
            return former | {"skipped": True}
    scan = read_scan(path)
    fitted = fit_scan(scan, head)
    with folder_in_one_step(folder.with_name(f".{folder.name}.part"), folder) as out:
        file = out / "track.npz"
        vertices = fitted.start[None]
        write_track(file, head, fitted.basis, fitted.targets, fitted.state, vertices)
        metrics = write_registration(out, file, read_track(file), 0, fitted.laid, "parameters")
        write_head_obj(out / "head.obj", fitted.laid.vertices / UNITS[scan.unit], load_head(head))
        metrics |= distances(scan, fitted) | {"unit": scan.unit, "textured": scan.textured}
        metrics |= {"views": len(fitted.targets[0].observation.views), "identity": identity}
        (out / "metrics.json").write_bytes(dump_json(metrics))
    return metrics | {"skipped": False}


def distances(scan: Scan, fitted: FittedScan) -> dict[str, float | None]:
    """Measure how far the seen vertices lie from the scan, before and after the mesh was laid."""
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


def line_of(account: dict) -> str:
    """Describe a registered scan in a line."""
    return (
        f"{account['unit']}, {'coloured' if account['textured'] else 'no colours'};"
        f" {account['seen_share']:.0%} of the face found, parameters"
        f" {account['parameters_mm_median']} mm and mesh {account['registered_mm_median']} mm from"
        f" the scan (medians); {account['folder']}"
    )
