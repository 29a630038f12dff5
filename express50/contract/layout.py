"""Name the paths of a dataset folder that several parts use, and the subjects it excludes."""

from __future__ import annotations

import contextlib
import errno
import math
import os
from dataclasses import dataclass
from pathlib import Path

from express50.errors import AnnotationError, CaptureError, ConfigError, FormatError, advised
from express50.files.atomic import check_folder_writable
from express50.files.text import NAME, parse_json, read_bytes, read_json_table, read_toml


def footage_root(capture: Path) -> Path:
    """Return the folder that a registered capture's footage is relative to.

    It is the capture's folder, a file's folder, or what ``source`` in capture.toml names: a capture
    may consist of capture.toml alone, which points to a read-only dataset.

    Raises:
        CaptureError: capture.toml is not TOML, or its source does not exist.
    """
    source = footage_source(Path(capture))
    return source.parent if source.is_file() else source


def footage_source(capture: Path) -> Path:
    """Return the path that ``source`` in capture.toml names; without it, the capture itself.

    Raises:
        CaptureError: capture.toml is not TOML, or its source does not exist.
    """
    path = capture / "capture.toml"
    if not path.is_file():
        return capture
    source = read_toml(path, CaptureError).get("source")
    if source is None:
        return capture
    if not isinstance(source, str) or not (capture / source).exists():
        raise CaptureError(
            f"{path}: source is {source!r}, expected an existing file or folder; correct it"
        )
    return (capture / source).resolve()


PLATES = "_plates"  # stands for an expression in the frames stage; no expression begins so


@dataclass(frozen=True)
class Dataset:
    """A dataset folder: a folder per stage, in it a folder per item; ledger, labels and report."""

    root: Path

    def __post_init__(self) -> None:
        """Accept a string path."""
        object.__setattr__(self, "root", Path(self.root))

    def stage_dir(self, stage: str) -> Path:
        """Return the folder that holds the items of a stage."""
        return self.root / stage

    def item_dir(self, stage: str, item: str) -> Path:
        """Return the published folder of one item; ``item`` may be nested (``S001/cam03``)."""
        return self.root / stage / item

    def subjects(self) -> list[str]:
        """Return the ingested subjects, sorted; PermissionError if one may not be read."""
        # A pattern would pass over such a folder, and the subject would seem to be gone.
        found = self.stage_dir("ingest")
        folders = found.iterdir() if found.is_dir() else ()
        return sorted(path.name for path in folders if (path / "index.json").is_file())

    @property
    def captures_file(self) -> Path:
        """Return the path of the JSON table subject -> folder of its raw capture."""
        return self.root / "captures.json"

    def captures(self) -> dict[str, Path]:
        """Return the registered raw captures by subject, sorted; empty before the first ingest.

        Raises:
            FormatError: the table is not a JSON object of strings.
        """
        if not self.captures_file.is_file():
            return {}
        ingest = advised("express50 ingest", self.root, "CAPTURE...")
        fix = f"delete it and run {ingest} with every capture"
        table = read_json_table(self.captures_file, FormatError, fix)
        for subject, path in table.items():
            if not NAME.fullmatch(subject) or not isinstance(path, str):  # it names folders
                raise FormatError(
                    f"{self.captures_file}: {subject!r}: {path!r}, expected an id and a path; {fix}"
                )
        return {subject: Path(table[subject]) for subject in sorted(table)}

    def index_file(self, subject: str) -> Path:
        """Return the path of the frame index of a subject's footage."""
        return self.item_dir("ingest", subject) / "index.json"

    def proxies_dir(self, subject: str) -> Path:
        """Return the folder of the small copies of a subject's footage."""
        return self.item_dir("ingest", subject) / "proxies"

    def cameras_file(self, subject: str) -> Path:
        """Return the path of a subject's calibrated cameras."""
        return self.item_dir("calibrate", subject) / "cameras.json"

    def gains_file(self, subject: str) -> Path:
        """Return the path of the cameras' colour gains, which exist if a board was recorded."""
        return self.item_dir("calibrate", subject) / "gains.json"

    def peaks_file(self, subject: str) -> Path:
        """Return the path of a subject's table of peak frames."""
        return self.item_dir("align", subject) / "peaks.json"

    def observations_file(self, subject: str) -> Path:
        """Return the path of the landmarks and faces that the observe stage saw of a subject."""
        return self.item_dir("observe", subject) / "observations.npz"

    def suggestions_file(self, subject: str) -> Path:
        """Return the path of the peak frames that the align stage suggests."""
        return self.item_dir("align", subject) / "suggestions.json"

    def track_file(self, subject: str) -> Path:
        """Return the path of a subject's tracked head at its peaks."""
        return self.item_dir("track", subject) / "track.npz"

    def surface_file(self, subject: str, expression: str) -> Path:
        """Return the path of an expression's reconstructed surface."""
        return self.item_dir("depth", f"{subject}/{expression}") / "surface.ply"

    def registration_file(self, subject: str, expression: str) -> Path:
        """Return the path of an expression's mesh on the reconstructed surface."""
        return self.item_dir("register", f"{subject}/{expression}") / "registration.npz"

    def frame_file(self, subject: str, expression: str, camera: str) -> Path:
        """Return the path of a camera's undistorted, colour-corrected frame at a peak."""
        return self.item_dir("frames", f"{subject}/{expression}") / f"{camera}.tif"

    def plate_file(self, subject: str, camera: str) -> Path:
        """Return the path of a camera's undistorted, colour-corrected clean plate."""
        return self.frame_file(subject, PLATES, camera)

    def wall_file(self, subject: str, camera: str) -> Path:
        """Return the path of the wall that a camera without a plate saw at several moments."""
        return self.item_dir("frames", f"{subject}/{PLATES}") / f"{camera}.wall.png"

    def picture_sizes_file(self, subject: str) -> Path:
        """Return the path of the sizes of a subject's peak frames and plates, by camera."""
        return self.item_dir("frames", f"{subject}/{PLATES}") / "pictures.json"

    def matte_file(self, subject: str, expression: str, camera: str) -> Path:
        """Return the path of the subject's 8-bit opacity in one peak frame."""
        return self.item_dir("matte", f"{subject}/{expression}") / f"{camera}.png"

    def labels_file(self, subject: str) -> Path:
        """Return the path of a subject's label events, which are only appended to."""
        return self.root / "labels" / f"{subject}.jsonl"

    @property
    def ledger(self) -> Path:
        """Return the path of the receipts of every stage (SQLite)."""
        return self.root / "ledger.sqlite"

    def config_file(self, stage: str) -> Path:
        """Return the path of the resolved configuration that a stage last ran with."""
        return self.root / "config" / f"{stage}.toml"

    @property
    def report_dir(self) -> Path:
        """Return the folder of the report."""
        return self.root / "report"

    @property
    def staging_dir(self) -> Path:
        """Return the folder of unfinished outputs; nothing below it is ever read."""
        return self.root / ".staging"

    @property
    def pilot_dir(self) -> Path:
        """Return the folder of the trials of `run --budget` and `tune`, each a small dataset."""
        return self.staging_dir / "pilot"

    def windows_dir(self, subject: str) -> Path:
        """Return the folder of a subject's finished clip parts, deleted once the clips are done."""
        return self.root / ".windows" / subject

    @property
    def stale_dir(self) -> Path:
        """Return the folder of outputs whose item failed in a newer run, or is no longer listed."""
        return self.root / ".stale"

    @property
    def replaced_dir(self) -> Path:
        """Return the folder of outputs that newer ones replaced, kept in case they are needed."""
        return self.root / ".replaced"

    @property
    def slurm_dir(self) -> Path:
        """Return the folder of the output of SLURM jobs, one file per job."""
        return self.root / "logs" / "slurm"

    def log_file(self, stage: str, item: str) -> Path:
        """Return the path of the traceback of an unexpected failure of one item."""
        return self.root / "logs" / stage / f"{item.replace('/', '+')}.txt"


def existing_dataset(path: Path) -> Dataset:
    """Open the dataset of a folder that has a ledger; ConfigError if it has none."""
    dataset = Dataset(path)
    if not dataset.ledger.is_file():
        if dataset.captures_file.is_file():  # a budgeted run was stopped while it measured
            raise ConfigError(
                f"{path}: nothing but trials has been made yet; run the command that was stopped"
                f" again, or {advised('express50 run', path)}"
            )
        check_folder(dataset)
        raise ConfigError(
            f"{path}: not a dataset (no ledger.sqlite);"
            f" run {advised('express50 ingest', path, 'CAPTURE')}"
        )
    return dataset


def check_folder(dataset: Dataset) -> None:
    """Raise ConfigError if the dataset's folder does not exist, or is a file."""
    root = dataset.root
    if root.is_file():
        raise ConfigError(f"{root}: is a file, expected the folder of a dataset")
    if not root.is_dir():
        ingest = advised("express50 ingest", root, "CAPTURE")
        raise ConfigError(f"{root}: no such dataset; run {ingest}")


def check_results_folder(folder: Path) -> None:
    """Refuse, before any work, a folder that cannot be written to or whose files stages write.

    Raises:
        ConfigError: it is a dataset, a stage's folder, a folder of shards, a capture, or a file.
        OSError: the system refuses.
    """
    _refuse_datasets_own(folder)
    if (folder / "capture.toml").is_file():  # results in it would make its ingest outdated
        raise ConfigError(f"{folder}: is a capture; name another folder")
    if (folder / "index.json").is_file() and (folder / "manifest.json").is_file():
        raise ConfigError(f"{folder}: holds shards; name another folder")
    check_folder_writable(folder)


def check_results_file(path: Path) -> None:
    """Refuse, before any work, a file that cannot be written, or in a folder that stages write.

    Raises:
        ConfigError: it lies in a stage's folder, among labels or settings, or below a file.
        OSError: it is a folder, or the system refuses.
    """
    _refuse_datasets_own(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    check_folder_writable(path.parent)


def check_page_file(path: Path) -> None:
    """Refuse a file that cannot be written as `check_results_file` does, or is not an HTML page.

    Raises:
        ConfigError: its name does not end in .html, so it may hold something else.
    """
    check_results_file(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{path}: expected the name of a page, which ends in .html")


def _refuse_datasets_own(path: Path) -> None:
    place = path.resolve()
    for dataset in map(Dataset, (place, *place.parents)):
        part = next(iter(place.relative_to(dataset.root).parts), "")
        own = part in ("", "config", "labels") or dataset.config_file(part).is_file()
        if own and dataset.ledger.is_file():
            raise ConfigError(
                f"{path}: belongs to the dataset {dataset.root}, whose files stages and annotators"
                f" write; name a place outside, or below {dataset.root / 'grmm'}"
            )


def exclusion_reason(dataset: Dataset, subject: str) -> str | None:
    """Return why a subject is excluded (``express50 annotate exclude``), or None if it is not.

    The latest event counts: an import may have put an older one below it.
    """
    path = dataset.labels_file(subject)
    reason, latest = None, -math.inf
    data = read_bytes(path, AnnotationError) if path.is_file() else b""
    for line in data.decode("utf-8", errors="replace").split("\n"):
        with contextlib.suppress(AnnotationError, AttributeError, TypeError):  # a torn line
            row = parse_json(line, str(path), AnnotationError)
            when = row.get("time", 0)
            if row.get("action") in ("exclude", "include") and when >= latest:
                latest = when
                reason = row.get("reason") if row["action"] == "exclude" else None
    return reason


def included_subjects(dataset: Dataset) -> list[str]:
    """List ingested subjects that are not excluded, sorted."""
    return [s for s in dataset.subjects() if exclusion_reason(dataset, s) is None]
