"""Load what a sample is made of, crop it to the head, and encode it."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from express50.capture.frames import (
    read_cameras_of,
    read_gains,
    read_matted_frame,
    read_plate_image,
    read_recorded_cameras,
)
from express50.capture.index import read_index, read_peaks
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import label_mask
from express50.contract.stage import Note
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import (
    Registration,
    Track,
    existing_track,
    read_track,
    registration_of,
)
from express50.errors import FormatError, StageError
from express50.files.digests import file_sha256
from express50.files.images import (
    DEPTH_LIMIT_M,
    DEPTH_UNIT_M,
    depth_to_uint16,
    read_alpha,
    read_image,
    scale_light,
)
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera
from express50.shards.codecs import encode_pictures
from express50.shards.writer import PackedSample, sample_key
from pipelines.pack.crop import (
    crop_pinhole,
    cut_depth,
    cut_image,
    cut_labels,
    cut_own_colours,
    head_crop,
)

FACE = ("skin", "lips", "eyes", "teeth", "tongue", "mouth")
PARAMETERS = ("expression", "neck", "jaw", "eyes", "R", "t")


@dataclass(frozen=True)
class PackedSubject:
    """The part of a subject's data that its samples share.

    Attributes:
        name: subject id.
        cameras: pinhole cameras of the pictures by id.
        recorded: width and height of the footage by camera.
        gains: linear light (3,) by camera, if measured.
        peaks: decode index by expression.
        labels: label without the annotator's name, by expression.
        track: the tracked head.
        registered: registrations of this track by expression, if any.
        notes: why a registration is left out.
        meta: the fields of meta.json that all samples share.
    """

    name: str
    cameras: dict[str, Camera]
    recorded: dict[str, list[int]]
    gains: dict[str, np.ndarray]
    peaks: dict[str, int]
    labels: dict[str, dict]
    track: Track
    registered: dict[str, Registration]
    notes: list[Note]
    meta: dict


def read_subject(dataset: Dataset, name: str) -> PackedSubject:
    """Read everything that a subject's samples share.

    Raises:
        StageError: it is not calibrated, aligned or tracked.
        FormatError: one of these files is malformed.
    """
    index = read_index(dataset, name)
    peaks = read_peaks(dataset, name)
    peak_rows = read_json_table(dataset.peaks_file(name), FormatError)
    track = read_track(existing_track(dataset, name))
    registered, notes, digest = {}, [], file_sha256(dataset.track_file(name))
    for expression in track.expressions:
        path = dataset.registration_file(name, expression)
        try:
            registration = registration_of(path, track, digest)
        except FormatError as error:
            notes.append(Note(f"{name}/{expression}", f"packed without its registration: {error}"))
            continue
        if registration is not None:
            registered[expression] = registration
    return PackedSubject(
        name=name,
        cameras=read_cameras_of(dataset, name),
        recorded={c.id: [c.width, c.height] for c in read_recorded_cameras(dataset, name).values()},
        gains=read_gains(dataset, name),
        peaks=peaks,
        labels={expression: nameless(row) for expression, row in peak_rows.items()},
        track=track,
        registered=registered,
        notes=notes,
        meta={
            "subject": name,
            "head": track.head,
            "fps": index.fps,
            "consent": index.meta.get("consent_id", index.meta.get("consent")),
            "licence": index.meta.get("licence", index.meta.get("license")),
            "session": index.meta.get("session"),
        },
    )


def nameless(label: dict) -> dict:
    """Replace the annotator's name in a label by ``person``, unless a rule made the label."""
    who = str(label.get("annotator", "unknown"))
    kept = who in ("auto", "unknown") or who.startswith("rule:")
    return label | {"annotator": who if kept else "person"}


@dataclass(frozen=True)
class LoadedSample:
    """The full-size images (H, W) of one view.

    Attributes:
        rgb: (H, W, 3) uint8 sRGB frame.
        plate: (H, W, 3) uint8 sRGB clean plate, or None.
        matte: uint8 opacity of the subject, torso included.
        alpha: uint8 opacity to pack.
        depth: metres.
        valid: bool, the depth is known.
        parts: uint8 labels, or None.
        torso: `removed` from alpha, or `kept`.
    """

    rgb: np.ndarray
    plate: np.ndarray | None
    matte: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    parts: np.ndarray | None
    torso: str


def load_sample(
    dataset: Dataset, subject: PackedSubject, expression: str, camera: Camera, remove_torso: bool,
    min_confidence: float,
) -> LoadedSample:  # fmt: skip
    """Load one view from the outputs of the earlier stages.

    Depth counts as known where its confidence is at least `min_confidence`.

    Raises:
        StageError: it is not tracked, an image is missing, or their sizes differ.
        FormatError, CaptureError: an image cannot be read.
    """
    if expression not in subject.track.expressions:
        raise StageError("it is not tracked")
    item = f"{subject.name}/{expression}"
    folder = dataset.item_dir("depth", item)
    rgb, alpha = read_matted_frame(dataset, item, camera)
    matte = alpha
    if (depth_path := depth_file(folder, camera.id)) is None:
        raise StageError("it has no depth")
    depth, valid = read_depth(depth_path)
    parts = head = None
    regions = dataset.item_dir("regions", item)
    paths = regions / f"{camera.id}.png", regions / f"{camera.id}_head.png"
    if all(path.is_file() for path in paths):
        # The head has no alpha of its own where the regions stage could not separate the torso.
        facts = read_json_table(regions / "metrics.json", FormatError)
        torso_unknown = "torso" in facts["missing"] and facts["method"] == "mesh"
        parts, head = read_alpha(paths[0]), None if torso_unknown else read_alpha(paths[1])
    sizes = [image.shape[:2] for image in (rgb, matte, depth, parts, head) if image is not None]
    if set(sizes) != {(camera.height, camera.width)}:
        raise StageError(
            f"frame, matte, depth and regions differ in size: {', '.join(map(str, sizes))}"
        )
    torso = "kept"
    if head is not None and parts is not None and remove_torso:
        # Depth stays where labels tell whose it is: elsewhere a torso's would bend the head.
        alpha, torso = head, "removed"
        valid = valid & ((head > 127) | label_mask(parts, "torso"))
    if min_confidence > 0:
        sure = read_image(folder / f"{camera.id}_confidence.png")
        valid = valid & (sure >= round(255 * min_confidence))
    plate = read_plate_image(dataset, subject.name, camera.id)
    return LoadedSample(rgb, plate, matte, alpha, depth, valid, parts, torso)


def occluded(parts: np.ndarray) -> dict[str, float]:
    """Measure the share of the face that hands and apparel hide in labels (H, W), by their name."""
    counts = {name: int(label_mask(parts, name).sum()) for name in ("hand", "apparel")}
    face = int(label_mask(parts, *FACE).sum()) + sum(counts.values())
    return {name: round(count / face, 4) for name, count in counts.items() if count}


def encode_sample(
    loaded: LoadedSample, subject: PackedSubject, expression: str, camera: Camera, size: int,
    profile: str,
) -> tuple[PackedSample, dict]:  # fmt: skip
    """Cut one view to the square around its tracked head, and encode its files.

    Returns the files, and the content of meta.json.

    Raises:
        StageError: the sample shows no head to crop, or its depth is too large for shards.
    """
    track = subject.track
    row = track.row(expression)
    crop = head_crop(camera, track.vertices[row].astype(np.float64), loaded.alpha)
    depth, valid = cut_depth(loaded.depth, loaded.valid, crop, size)
    if (farthest := depth[valid].max(initial=0)) >= DEPTH_LIMIT_M:
        raise StageError(
            f"its depth reaches {farthest:.2f} m; shards hold less than {DEPTH_LIMIT_M:.2f} m"
        )
    rgb = cut_own_colours(loaded.rgb, loaded.matte, loaded.plate, crop, size)
    parts = None if loaded.parts is None else cut_labels(loaded.parts, crop, size)
    sample_key(subject.name, expression, camera.id)  # raises if an id cannot be a file name
    gain = subject.gains.get(camera.id, np.ones(3))
    members = encode_pictures(
        rgb if (gain == 1).all() else scale_light(rgb, 1.0 / gain),
        cut_image(loaded.alpha, crop, size),
        depth_to_uint16(depth, valid),
        parts,
        profile,
    )
    meta = subject.meta | {
        "K": crop_pinhole(camera, crop, size).K.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "camera": camera.id,
        "colour_gain": gain.tolist(),
        "crop": vars(crop),
        "depth_scale_m": DEPTH_UNIT_M,
        "expression": expression,
        "frame": subject.peaks[expression],
        "height": size,
        "label": subject.labels[expression],
        "occluded": None if parts is None else occluded(parts),
        "parts": parts is not None,
        "source_size": [camera.width, camera.height],
        "torso": loaded.torso,
        "track": {key: getattr(track, key)[row].tolist() for key in PARAMETERS}
        | {
            "offsets": bool(track.offsets.any()),
            "registered": expression in subject.registered,
            "shape": track.shape.tolist(),
        },
        "width": size,
    }
    if (recorded := subject.recorded[camera.id]) != meta["source_size"]:
        meta["recorded_size"] = recorded
    text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    members["meta.json"] = text.encode()
    return PackedSample(subject.name, expression, camera.id, members), meta
