"""Read a capture of any known layout.

A layout is a row of a plain table: its name, what it looks like, a test, the subject's id, and a
reader that turns it into a `RawCapture`. Nothing is copied or unpacked. A folder with capture.toml
may name where the footage lies (``source``), which layout it is (``layout``) and which parts to
take, so that read-only datasets need no file of ours beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from express50.capture.raw import (
    RawCapture,
    check_identity,
    read_capture,
    read_capture_toml,
    read_meta,
)
from express50.capture.readers import (
    ava256,
    generic,
    multiface,
    nersemble,
    ravdess,
    renderme,
)
from express50.capture.readers.selection import EXPRESSION, Selection, parse_selection
from express50.contract.layout import Dataset, footage_source
from express50.errors import CalibrationError, CaptureError, Express50Error
from express50.rigs.rig_check import judge

OURS = "express50"
FPS = 24.0  # stands in where only the subject is asked for


@dataclass(frozen=True)
class Layout:
    """One layout of captures.

    Attributes:
        name: of the layout.
        looks: its look in words, for errors.
        fits: returns whether a file or folder is one.
        subject_of: the subject's id.
        read: reads the selected parts of the capture.
    """

    name: str
    looks: str
    fits: Callable[[Path], bool]
    subject_of: Callable[[Path], str]
    read: Callable[[Path, Selection], RawCapture]


# In order: a layout that another could be mistaken for stands behind it.
LAYOUTS = (
    Layout(
        "renderme360", "<actor>_<performance>_raw.smc",
        renderme.fits, renderme.subject_of, renderme.read,
    ),
    Layout(
        "nersemble", "calibration/camera_params.json and sequences/",
        nersemble.fits, nersemble.subject_of, nersemble.read,
    ),
    Layout(
        "ava256", "decoder/camera_calibration.json", ava256.fits, ava256.subject_of, ava256.read
    ),
    Layout("multiface", "KRT and images/", multiface.fits, multiface.subject_of, multiface.read),
    Layout("ravdess", "01-01-03-02-01-01-05.mp4", ravdess.fits, ravdess.subject_of, ravdess.read),
    Layout(
        "transforms", "transforms.json",
        generic.fits_transforms, generic.folder_name, generic.read_transforms_folder,
    ),
    Layout(
        "colmap", "images/ and sparse/0/", generic.fits_colmap, generic.folder_name,
        generic.read_colmap_folder,
    ),
    Layout(
        "photos", "a folder of images",
        generic.fits_photos, generic.subject_of, generic.read_photos,
    ),
    Layout("video", "a video file", generic.fits_video, generic.subject_of, generic.read_video),
)  # fmt: skip


def detect(path: Path, name: object = None) -> Layout:
    """Find the layout of a file or folder: the named one, else the first that fits.

    Raises:
        CaptureError: it does not exist, no layout has the name, or none fits.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such folder or file; expected a capture")
    names = [layout.name for layout in LAYOUTS]
    if name is not None and name not in names:
        raise CaptureError(f"{path}: layout {name!r}, expected one of {OURS}, {', '.join(names)}")
    for layout in LAYOUTS:
        if name in (None, layout.name) and layout.fits(path):
            return layout
    looks = "; ".join(f"{x.name}: {x.looks}" for x in LAYOUTS if name in (None, x.name))
    ours = "" if name else f"; {OURS}: capture.toml and cameras/"
    if path.is_file():
        got = f"no known layout of a file {path.suffix or 'without an ending'}"
    else:
        names = sorted(p.name for p in path.iterdir() if not p.name.startswith("."))
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        got = f"no known layout: it holds {shown or 'nothing'}"
    raise CaptureError(f"{path}: {got}, expected one of: {looks}{ours}")


def is_ours(path: Path) -> bool:
    """Return whether a path is a capture in our own layout, or is meant as one."""
    meta = _meta(path)
    if meta is None:
        return (path / "cameras").is_dir()  # the error then names the missing file
    if "source" in meta:
        return False
    layout = meta.get("layout", OURS if (path / "cameras").is_dir() else None)
    # A capture.toml alone marks it as ours; the error then names the missing file.
    return layout == OURS or (layout is None and not any(x.fits(path) for x in LAYOUTS))


def _meta(path: Path) -> dict | None:
    """Read a capture.toml; None where there is none."""
    file = path / "capture.toml"
    return read_capture_toml(file) if file.is_file() else None


def subject_of(path: Path) -> str:
    """Find the subject of a capture of any layout without reading its footage.

    Raises:
        CaptureError: it is not a capture, or its subject cannot be an id.
    """
    if is_ours(path):
        return read_meta(path)["subject"]
    meta, source = _meta(path) or {}, footage_source(path)
    layout = detect(source, meta.get("layout"))
    subject = meta.get("subject") or layout.subject_of(source)
    check_identity(path / "capture.toml" if path.is_dir() else path, subject, meta.get("fps", FPS))
    return subject


def read_any(path: Path) -> RawCapture:
    """Read a capture of any layout.

    Raises:
        CaptureError: it is not a capture, or nothing of it can be used.
        CalibrationError: its cameras are malformed or do not fit together.
    """
    path = Path(path)
    if is_ours(path):
        return read_capture(path)
    meta, source = _meta(path) or {}, footage_source(path)
    layout = detect(source, meta.get("layout"))
    selection = parse_selection(meta, path / "capture.toml")
    raw = layout.read(source, selection)
    subject, fps = meta.get("subject") or raw.subject, meta.get("fps", raw.fps)
    check_identity(path / "capture.toml", subject, fps)
    # Where the footage lies is this machine's matter, not the dataset's.
    given = {key: value for key, value in meta.items() if key != "source"}
    described = raw.meta | given | {"subject": subject, "fps": float(fps), "layout": raw.layout}
    raw = replace(raw, subject=subject, fps=float(fps), meta=described)
    doubled = sorted({clip for clip in raw.clips if raw.clips.count(clip) > 1})
    if doubled or not all(EXPRESSION.fullmatch(clip) for clip in raw.clips):
        raise CaptureError(
            f"{path}: {', '.join(doubled) or raw.clips} cannot be the expressions of its "
            "sequences; give each its own id in [expressions] of capture.toml"
        )
    if not raw.calibration:
        return raw
    verdict = judge(raw.calibration)
    if verdict.problem:
        raise CalibrationError(
            f"{path}: {verdict.problem}; {verdict.remedy or 'check the calibration'}"
        )
    odd = {"cameras": "; ".join(verdict.warnings)} if verdict.warnings else {}
    return replace(raw, warnings=raw.warnings | odd)


def watched(path: Path) -> list[Path]:
    """List files and folders whose change makes an ingest stale."""
    source = footage_source(path)
    found = [path] if source == path else [path, source]
    return found + (renderme.companions(source) if renderme.fits(source) else [])


def read_people(dataset: Dataset, subjects: Iterable[str]) -> list[dict]:
    """Read gender and age of subjects, in order, from their captures.

    They are read for counts and kept nowhere; an entry is empty where the capture is gone or says
    nothing.
    """
    captures = dataset.captures()
    people = []
    for subject in subjects:
        try:
            capture = captures[subject]
            meta = read_meta(capture) if is_ours(capture) else read_any(capture).meta
        except (KeyError, Express50Error, OSError):
            meta = {}
        people.append({key: meta[key] for key in ("gender", "age") if key in meta})
    return people
