"""Load what a sample is made of, crop it to the head, and encode it.

A soft pixel of the footage holds light of the plate, which would be a rim before another
background. Where the plate is known, `own_colours` solves for the likeliest colour of the subject
(Chuang et al. 2001 with alpha and plate given); elsewhere it takes the subject's colours nearby.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import cv2
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
)
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera, crop_camera, project, resized
from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.geometry.pixels import linear_to_srgb, resize_area, scale_light
from express50.shards.codecs import encode_pictures
from express50.shards.writer import PackedSample, sample_key
from pipelines.matte.plates import (
    LEAST_SHARE,
    exposed,
    exposure_gain,
    local_colours,
    match_plate,
    to_light,
)

FACE = ("skin", "lips", "eyes", "teeth", "tongue", "mouth")
PARAMETERS = ("expression", "neck", "jaw", "eyes", "R", "t")
EDGE = 0.01  # neighbours whose depths differ by more than this share lie on two surfaces
MARGIN = 0.1  # room on each side, as a share of the head's size
HAIR = 0.3  # how far the matte may widen the mesh's box, as a share of its size: hair, no shoulders
REACH_SHARE = 0.008  # of the image's longer side: largest distance from which colours are taken
SPREAD = 0.25  # share by which a strand may be brighter or darker than its neighbours
NOISE = 0.01  # deviation of linear light by sensor, compression and errors of alpha
SOLID = 0.98  # alpha from which a pixel has the subject's colour alone


@dataclass(frozen=True)
class PackedSubject:
    """The part of a subject's data that its samples share."""

    name: str  # subject id
    cameras: dict[str, Camera]  # pinhole cameras of the pictures by id
    recorded: dict[str, list[int]]  # width and height of the footage by camera
    gains: dict[str, np.ndarray]  # linear light (3,) by camera, if measured
    peaks: dict[str, int]  # decode index by expression
    labels: dict[str, dict]  # label without the annotator's name, by expression
    track: Track  # the tracked head
    registered: dict[str, Registration]  # registrations of this track by expression, if any
    notes: list[Note]  # why a registration is left out
    meta: dict  # the fields of meta.json that all samples share


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
    """The full-size images (H, W) of one view."""

    rgb: np.ndarray  # (H, W, 3) uint8 sRGB frame
    plate: np.ndarray | None  # (H, W, 3) uint8 sRGB clean plate, or None
    matte: np.ndarray  # uint8 opacity of the subject, torso included
    alpha: np.ndarray  # uint8 opacity to pack
    depth: np.ndarray  # metres
    valid: np.ndarray  # bool, the depth is known
    parts: np.ndarray | None  # uint8 labels, or None
    torso: str  # `removed` from alpha, or `kept`


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


@dataclass(frozen=True)
class Crop:
    """A square aligned to source pixels; its corner (x0, y0) may lie outside the image."""

    x0: int
    y0: int
    side: int


def head_crop(camera: Camera, vertices: np.ndarray, alpha: np.ndarray) -> Crop:
    """Find the crop around a tracked head: vertices (V, 3), metres, alpha (H, W) uint8, a pinhole.

    Raises:
        StageError: the head is not in the image, or the matte is empty.
    """
    pixels, _ = project(camera, vertices)
    pixels = pixels[np.isfinite(pixels).all(1)]
    if len(pixels) < 0.5 * len(vertices):
        raise StageError("the tracked head lies behind the camera")
    low, high = pixels.min(0), pixels.max(0)
    x, y, width, height = cv2.boundingRect((alpha > 127).astype(np.uint8))
    if not width:
        raise StageError("its matte is empty")
    reach = HAIR * (high - low)
    matte = np.array([[x, y], [x + width, y + height]], np.float64)
    low = np.minimum(low, np.maximum(low - reach, matte[0]))
    high = np.maximum(high, np.minimum(high + reach, matte[1]))
    if (high <= 0).any() or (low >= (camera.width, camera.height)).any():
        raise StageError("the tracked head lies outside the image")
    low, high = np.maximum(low, 0), np.minimum(high, (camera.width, camera.height))
    side = int(np.ceil((high - low).max() * (1 + 2 * MARGIN)))
    corner = np.floor((low + high) / 2 - side / 2).astype(int)
    return Crop(int(corner[0]), int(corner[1]), side)


def crop_pinhole(camera: Camera, crop: Crop, size: int) -> Camera:
    """Give the camera of the cropped and resized image; exact, as pixels have a corner origin."""
    return resized(crop_camera(camera, crop.x0, crop.y0, crop.side, crop.side), size, size)


def cut_image(image: np.ndarray, crop: Crop, size: int) -> np.ndarray:
    """Cut an image (H, W[, C]) uint8 and resize it to (size, size); 0 outside the image."""
    return resize_area(_window(image, crop), size, size)


def cut_labels(labels: np.ndarray, crop: Crop, size: int) -> np.ndarray:
    """Cut labels (H, W) uint8 to (size, size), each that of the nearest pixel; 0 outside."""
    place = np.minimum((cell_centres(size) * (crop.side / size)).astype(int), crop.side - 1)
    return _window(labels, crop)[np.ix_(place, place)]


def _window(image: np.ndarray, crop: Crop) -> np.ndarray:
    window = np.zeros((crop.side, crop.side, *image.shape[2:]), image.dtype)
    y0, x0 = max(crop.y0, 0), max(crop.x0, 0)
    y1 = min(crop.y0 + crop.side, image.shape[0])
    x1 = min(crop.x0 + crop.side, image.shape[1])
    if y1 > y0 and x1 > x0:
        window[y0 - crop.y0 : y1 - crop.y0, x0 - crop.x0 : x1 - crop.x0] = image[y0:y1, x0:x1]
    return window


def cut_depth(
    depth: np.ndarray, valid: np.ndarray, crop: Crop, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cut depth (H, W), metres, and its validity to (size, size); surfaces are never blended.

    Each new pixel takes the bilinear mean of inverse depth at its centre, which is exact on planes,
    if its four neighbours are valid and lie on one surface; else the nearest pixel.
    """
    window, known = _window(depth, crop), _window(valid, crop)
    inverse = np.where(known, 1.0 / np.where(known, window, 1.0), 0.0)
    place = np.clip(corner_to_cell(cell_centres(size) * (crop.side / size)), 0, crop.side - 1)
    low = np.minimum(place.astype(int), max(crop.side - 2, 0))
    high = np.minimum(low + 1, crop.side - 1)
    share = place - low
    near = np.where(share < 0.5, low, high)
    rows, columns = share[:, None], share[None, :]
    corners = [inverse[np.ix_(a, b)] for a in (low, high) for b in (low, high)]
    weights = [a * b for a in (1 - rows, rows) for b in (1 - columns, columns)]
    smallest, largest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    one_surface = (smallest > 0) & (largest <= smallest * (1 + EDGE))
    smooth = sum(w * c for w, c in zip(weights, corners, strict=True))
    chosen = np.where(one_surface, smooth, inverse[np.ix_(near, near)])
    ok = chosen > 0
    return np.where(ok, 1.0 / np.where(ok, chosen, 1.0), 0.0), ok


def cut_own_colours(
    frame: np.ndarray, matte: np.ndarray, plate: np.ndarray | None, crop: Crop, size: int
) -> np.ndarray:
    """Cut a frame to (size, size, 3) with the subject's own colour in soft pixels.

    Frame and clean plate, or None, are (H, W, 3) uint8 sRGB; the matte (H, W) uint8 is of
    everything in front of the plate, torso included. As in `matte`, the plate is matched to the
    frame first, and not used if it shows another set.
    """
    behind = None
    if plate is not None:
        found = match_plate(plate, frame, matte == 0)
        if found.share >= LEAST_SHARE:
            gain = exposure_gain(frame, found.plate)
            behind = exposed(cut_image(found.plate, crop, size), gain)
    return own_colours(cut_image(frame, crop, size), cut_image(matte, crop, size), behind)


def own_colours(image: np.ndarray, alpha: np.ndarray, plate: np.ndarray | None) -> np.ndarray:
    """Replace the colours of an image (H, W, 3) uint8 sRGB where 0 < alpha < 1, of (H, W) uint8.

    The plate is the background in the frame's exposure, (H, W, 3) in 8-bit steps, or None.

    Raises:
        ValueError: sizes differ.
    """
    if alpha.shape != image.shape[:2] or (plate is not None and plate.shape != image.shape):
        raise ValueError(
            f"image {image.shape}, alpha {alpha.shape} and plate "
            f"{None if plate is None else plate.shape} differ in size"
        )
    opacity = alpha.astype(np.float32) / 255
    soft = (alpha > 0) & (alpha < 255)
    solid = (opacity >= SOLID).astype(np.float32)
    if not soft.any() or not solid.any():
        return image
    light = to_light(image)
    reach = max(1.0, REACH_SHARE * max(image.shape[:2]))
    mean, covariance = local_colours(light, solid, soft, reach, SPREAD)
    share = opacity[soft].astype(np.float64)[:, None]
    if plate is None:
        # Mostly subject: the pixel itself is as good a guess as its neighbours.
        colour = mean + share**4 * (light[soft] - mean)
    else:
        behind = to_light(plate)[soft]
        rest = light[soft] - (1 - share) * behind - share * mean
        square = share[..., None] ** 2
        gain = np.linalg.solve(square * covariance + NOISE**2 * np.eye(3), rest[..., None])
        colour = mean + share * (covariance @ gain)[..., 0]
    out = image.copy()
    out[soft] = np.rint(255 * linear_to_srgb(np.clip(colour, 0, 1)))
    return out
