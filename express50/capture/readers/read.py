"""Read a capture of any known layout.

A layout is a row of a plain table: its name, what it looks like, a test, the subject's id, and a
reader that turns it into a `RawCapture`. Nothing is copied or unpacked. A folder with capture.toml
may name where the footage lies (``source``), which layout it is (``layout``) and which parts to
take. So read-only datasets need no file of ours beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from express50.capture.raw import (
    ANY_FPS,
    VIDEO_SUFFIXES,
    RawCapture,
    check_identity,
    hint_at_undeveloped,
    is_data_folder,
    read_capture,
    read_capture_toml,
    read_meta,
)
from express50.capture.readers import codec_avatars, folders, pictures, renderme, videos
from express50.capture.readers.selection import Selection, folder_id, parse_selection
from express50.contract.layout import Dataset, footage_source
from express50.errors import CaptureError, Express50Error, check_known, few
from express50.files.text import check_readable
from express50.rigs.world_frame import check_meeting, judge

OURS = "express50"


@dataclass(frozen=True)
class Layout:
    """One layout of captures."""

    name: str
    looks: str  # what it looks like in words, for errors
    fits: Callable[[Path], bool]  # whether a file or folder is one
    read: Callable[[Path, Selection], RawCapture]  # the selected parts of the capture
    subject_of: Callable[[Path], str] = folder_id  # the subject's id
    named: bool = False  # whether it needs no test where capture.toml names it


def _has(*names: str) -> Callable[[Path], bool]:
    """Return a test for a folder that holds files and folders of these names."""
    return lambda path: all((path / name).exists() for name in names)


# The order matters: a layout that could be mistaken for another comes after it.
LAYOUTS = (
    Layout(
        "renderme360", "<actor>_<performance>_raw.smc",
        renderme.fits, renderme.read, renderme.subject_of,
    ),
    Layout(
        "nersemble", "calibration/camera_params.json and sequences/",
        _has("calibration/camera_params.json", "sequences"), videos.read_participant,
    ),
    Layout(
        "ava256", "decoder/camera_calibration.json",
        _has("decoder/camera_calibration.json"),
        codec_avatars.read_ava256, codec_avatars.subject_of,
    ),
    Layout(
        "multiface", "KRT and images/",
        _has("KRT", "images"), codec_avatars.read_multiface, codec_avatars.subject_of,
    ),
    Layout(
        "ravdess", "01-01-03-02-01-01-05.mp4",
        videos.fits_ravdess, videos.read_actor, videos.actor_of,
    ),
    Layout(
        "transforms", "transforms.json",
        pictures.fits_transforms, pictures.read_transforms_folder,
    ),
    Layout("colmap", "images/ and sparse/0/", pictures.fits_colmap, pictures.read_colmap_folder),
    Layout(
        "photos", "a folder of images, or images/ in it", pictures.fits_photos, pictures.read_photos
    ),
    Layout(
        "videos", f"a folder of videos ({' '.join(VIDEO_SUFFIXES)}), one per camera",
        folders.fits_videos, folders.read_videos,
    ),
    Layout("video", "a video file", videos.fits_video, videos.read_video, videos.video_id),
    Layout(
        "camera_folders", "a folder per camera, such as cam_01/, of videos, pictures or folders",
        folders.fits_camera_folders, folders.read_camera_folders, named=True,
    ),
    Layout(
        "expression_folders", "a folder per expression, of cam_01.mp4, cam_01.png or cam_01/ ...",
        folders.fits_expression_folders, folders.read_expression_folders, named=True,
    ),
    Layout(
        "frame_folders", "a folder per frame, of pictures such as cam_01.png",
        folders.fits_frame_folders, folders.read_frame_folders, named=True,
    ),
)  # fmt: skip


def detect(path: Path, name: object = None) -> Layout:
    """Find the layout of a file or folder: the named one, else the first that fits.

    Raises:
        CaptureError: it does not exist, no layout has the name, or none fits.
    """
    if not path.exists():
        raise CaptureError(f"{path}: no such folder or file; expected a capture")
    if name is not None:
        names = [OURS, *(layout.name for layout in LAYOUTS)]
        check_known(str(path), "layout", [str(name)], names, CaptureError)
    part = "{}: part of the capture {}; give that folder instead"
    for whole in path.parents[1:3]:
        # A camera's folder would pass for a rig of one camera, and its pictures for one of many.
        if (whole / "capture.toml").is_file() and path.is_relative_to(whole / "cameras"):
            raise CaptureError(part.format(path, whole))
    is_part = (path.parent / "capture.toml").is_file()
    for layout in LAYOUTS:
        if name in (None, layout.name) and ((name and layout.named) or layout.fits(path)):
            return layout
    inside = path.iterdir() if path.is_dir() else ()
    check_readable(*(inner for inner in inside if inner.is_symlink() or is_data_folder(inner)))
    given = part.format(path, path.parent) if is_part else None
    raise CaptureError(_why_none_fits(path, name, given))


def _why_none_fits(path: Path, name: object, part: str | None) -> str:
    """Return what a folder or file seems to be, and what to do.

    `part` says of which capture it is a part, if it is.
    """
    for depth in ("*", "*/*"):
        if below := sorted(path.glob(f"{depth}/capture.toml")):
            captures = below[0].parent.parent / "*"
            return f"{path}: a folder of captures, expected a capture; give {captures}"
    if (path / "capture.toml").is_file() and (path / "cameras").is_dir():
        return (
            f"{path}: a capture in our own layout, expected one of another layout as 'source'; give"
            " that folder itself, and leave out what you do not need in its cameras/ and cues.csv"
        )
    if part is not None:
        return part
    held = sorted(p.name for p in path.iterdir()) if path.is_dir() else ["a file"]
    if name is None and folders.holds_folders(path):
        layouts = ", ".join(layout.name for layout in LAYOUTS if layout.named)
        return (
            f"{path}: its folders ({few(held)}) hold footage, but their names do not tell whether"
            " they are people, cameras, expressions or frames; give each folder by itself if it is"
            f" a person, or else write 'layout' into a capture.toml beside them (one of {layouts})"
        )
    # The first folder below, up to two deep, that is a rig by itself.
    rigs = [layout for layout in LAYOUTS if layout.name not in ("photos", "video")]
    inner = (p for depth in ("*", "*/*") for p in sorted(filter(is_data_folder, path.glob(depth))))
    if found := next(((p, rig) for p in inner for rig in rigs if rig.fits(p)), None):
        return (
            f"{path}: no known layout, but {found[0]} has one ({found[1].looks}); give that folder,"
            " and others like it"
        )
    looks = "; ".join(f"{x.name}: {x.looks}" for x in LAYOUTS if name in (None, x.name))
    return (
        f"{path}: no known layout; got {', '.join(held[:5]) or 'an empty folder'}, expected one "
        f"of: {looks}; {OURS}: capture.toml and cameras/"
        + hint_at_undeveloped([path, *path.glob("*"), *path.glob("*/*")])
    )


def is_capture(path: Path) -> bool:
    """Return whether a folder is, or is meant as, a capture of some layout."""
    return (path / "capture.toml").is_file() or any(layout.fits(path) for layout in LAYOUTS)


def is_ours(path: Path) -> bool:
    """Return whether a path is a capture in our own layout, or is meant as one."""
    meta = read_capture_toml(path)
    if "source" in meta:
        return False
    cameras = path / "cameras"
    if "layout" in meta or (cameras.is_dir() and folders.footage_folder(path) != cameras):
        return meta.get("layout", OURS) == OURS
    # A capture.toml alone marks it as ours; the error then names the missing file.
    return bool(meta) and not any(layout.fits(path) for layout in LAYOUTS)


def subject_of(path: Path) -> str:
    """Find the subject of a capture of any layout without reading its footage.

    Raises:
        CaptureError: it is not a capture, or its subject cannot be an id.
    """
    if is_ours(path):
        return read_meta(path)["subject"]
    meta, source = read_capture_toml(path), footage_source(path)
    layout = detect(source, meta.get("layout"))
    subject = meta.get("subject") or layout.subject_of(source)
    check_identity(
        path / "capture.toml" if path.is_dir() else path, subject, meta.get("fps", ANY_FPS)
    )
    return subject


def read_any(path: Path) -> RawCapture:
    """Read a capture of any layout.

    Raises:
        CaptureError: it is not a capture, or nothing of it can be used.
        CalibrationError: its cameras are malformed or do not fit together.
    """
    if is_ours(path):
        return read_capture(path)
    meta, source = read_capture_toml(path), footage_source(path)
    layout = detect(source, meta.get("layout"))
    raw = layout.read(source, parse_selection(meta, path / "capture.toml"))
    subject, fps = meta.get("subject") or raw.subject, meta.get("fps", raw.fps)
    check_identity(path / "capture.toml", subject, fps)
    # The footage's place belongs to this machine, not to the dataset.
    given = {key: value for key, value in meta.items() if key != "source"}
    described = {"subject": subject, "fps": float(fps), "layout": layout.name}
    doubled = sorted({clip for clip in raw.clips if raw.clips.count(clip) > 1})
    if doubled:
        raise CaptureError(
            f"{path}: several sequences have the expression id {', '.join(doubled)}; give each its"
            " own id in [expressions] of capture.toml"
        )
    calibration = {k: c for k, c in (raw.calibration or {}).items() if k in raw.cameras}
    warnings = dict(raw.warnings)
    if calibration:
        check_meeting(calibration, str(path))
        if odd := judge(calibration).warnings:
            warnings["cameras"] = "; ".join(odd)
    return replace(
        raw,
        subject=subject,
        fps=float(fps),
        meta=raw.meta | given | described,
        layout=layout.name,
        calibration=calibration or None,
        warnings=warnings,
    )


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
