"""Label one expression of one subject: parts and a matte of the head in every camera."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_matted_frame, reduced
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import COLOURS, LABELS
from express50.contract.stage import Note, Result
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import existing_track, read_track
from express50.errors import UNREADABLE, FormatError, StageError, advised
from express50.files.images import write_image
from express50.geometry.cameras import Camera, cut_about, project
from express50.geometry.pixels import box_about, contact_sheet, fit_into
from express50.geometry.sampling import evenly
from express50.head.load import load_topology
from pipelines.regions.colour import (
    EARS,
    SKIN,
    Scalp,
    agreed_mask,
    face_colours,
    judge_scalp,
    label_by_colour,
    mask_colour,
    scalp_votes,
    worn_mask,
)
from pipelines.regions.geometry import (
    FACE,
    HAIR,
    SCALP,
    TrackedHead,
    find_hands,
    head_alpha,
    head_geometry,
    head_labels,
    make_head,
    render_head,
)
from pipelines.regions.things import Picture, find_glasses, shown_in_front

STUDIED_SIDE = 512  # pixels of the pictures that are studied for a person's colours and glasses
STUDIED_CAMERAS = 4  # of the face, in which skin colours and bare scalps are looked for
GLASSES_CAMERAS = 10  # in which glasses are looked for
AGREEMENT = 0.85  # a camera with less of the tracked mesh inside its matte gets a warning
SHOWN = 4  # cameras in the contact sheet
MARGIN = 32  # pixels about the subject: the discs that find hands and glasses are smaller
TILE = (260, 260)

Frames = dict[str, tuple[np.ndarray, np.ndarray]]
"""Frames (H, W, 3) uint8 and mattes (H, W) float32 by camera."""


@dataclass(frozen=True)
class ViewLabels:
    """One camera's labels (h, w) at the working size, and the mesh's silhouette (h, w) bool."""

    labels: np.ndarray
    mesh: np.ndarray


def run(
    dataset: Dataset,
    item: str,
    out: Path,
    *,
    side: int,
    use_depth: bool,
    scalp_is: str,
    weights: str,
) -> Result:
    """Write labels and the head's matte for each camera, and a contact sheet."""
    cv2.setNumThreads(1)  # the runner counts one core per item
    subject, expression = item.split("/")
    head, glasses = read_head(dataset, subject, expression)
    scalp, skin, mask, frames = judge_colours(dataset, item, head)
    if glasses is None:
        glasses = find_glasses(head, face_pictures(dataset, item, head))
    if scalp_is != "auto":
        scalp = replace(scalp, is_skin=scalp_is == "skin")
    figures, rows = {}, {}
    dropped = []
    for name, camera in read_cameras_of(dataset, subject).items():
        try:
            known = frames.pop(name, None)
            rgb, alpha = known or read_frame_and_matte(dataset, item, camera)
            depth = read_depth_of(dataset, item, camera) if use_depth else None
        except UNREADABLE as error:
            dropped.append(Note(name, str(error)))
            continue
        worn = glasses, mask
        view = label_view(head, camera, rgb, alpha, depth, scalp.is_skin, side, skin, *worn)
        figures[name], rows[name] = _write_view(out, name, rgb, alpha, view, weights)
    if not figures:
        why = "; ".join(map(str, dropped[:3]))
        run_matte = advised("express50 matte", dataset.root)
        raise StageError(f"{item}: no camera has a matte to label ({why}); run {run_matte}")
    write_picture(out, rows, figures)
    doubts = {name: view_warning(row) for name, row in figures.items()}
    warnings = [Note(name, why) for name, why in doubts.items() if why]
    if "torso" in head.labels.missing and not weights:
        why = "the head model does not mark the neck's end, so the torso cannot be cut off"
        warnings.append(Note("torso", why))
    there = [row["mesh_in_matte"] for row in figures.values() if row["mesh_in_frame"]]
    metrics = {
        "method": "network and mesh" if weights else "mesh",
        "missing": list(head.labels.missing),
        "scalp": {
            "label": "skin" if scalp.is_skin else "hair",
            "skin_coloured": scalp.skin_coloured,
        },
        "mesh_in_matte": round(float(np.mean(there)) if there else 0.0, 4),
        "cameras": figures,
    }
    return Result(metrics, dropped, warnings)


def read_head(
    dataset: Dataset, subject: str, expression: str
) -> tuple[TrackedHead, np.ndarray | None]:
    """Read the tracked mesh of one expression, and its glasses (n, 3); None where unknown.

    Raises:
        StageError: the subject or the expression is not tracked.
        FormatError: the track does not fit its head model, or is not finite.
    """
    path = existing_track(dataset, subject)
    track = read_track(path)
    row, labels = track.row(expression), head_labels(load_topology(track.head))
    vertices = track.mesh(expression, len(labels.vertices), path)
    return make_head(vertices, track.R[row], labels), track.glasses_in(expression)


def read_frame_and_matte(
    dataset: Dataset, item: str, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Read the undistorted frame (H, W, 3) uint8 and alpha (H, W) float32 of one camera.

    Raises as `read_matted_frame`.
    """
    rgb, alpha = read_matted_frame(dataset, item, camera)
    return rgb, cv2.LUT(alpha, np.arange(256, dtype=np.float32) / 255)


def read_depth_of(dataset: Dataset, item: str, camera: Camera) -> np.ndarray | None:
    """Read depth (H, W) metres, 0 where unknown, if there is a map.

    Raises:
        FormatError: it is not a depth map of the camera's size.
    """
    path = depth_file(dataset.item_dir("depth", item), camera.id)
    if path is None:
        return None
    depth, _ = read_depth(path)
    if depth.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path}: {depth.shape}, expected the camera's {camera.width}x{camera.height}; run"
            f" {advised('express50 depth', dataset.root)} again"
        )
    return depth


def judge_colours(
    dataset: Dataset, item: str, head: TrackedHead
) -> tuple[Scalp, np.ndarray | None, np.ndarray | None, Frames]:
    """Judge scalp, skin and mask in a few cameras; return their frames too.

    The skin's colours are counted. A mask's colour (3,) is that of `mask_colour`; None without one.
    """
    cameras = read_cameras_of(dataset, item.split("/")[0]).values()
    seeing = [camera for camera in cameras if head.faces_camera(camera)]
    studied, frames = [], Frames()
    for camera in evenly(seeing, STUDIED_CAMERAS):
        with contextlib.suppress(*UNREADABLE):  # the stage names them
            rgb, alpha = frames[camera.id] = read_frame_and_matte(dataset, item, camera)
            camera, rgb, alpha = reduced(camera, rgb, alpha, STUDIED_SIDE)
            studied.append((rgb, alpha, render_head(head, camera)[0], head.metre_px(camera)))
    votes = [scalp_votes(rgb, mesh, alpha) for rgb, alpha, mesh, _ in studied]
    said = [mask_colour(rgb, alpha, mesh) for rgb, alpha, mesh, _ in studied]
    mask = agreed_mask(said, judge_scalp(votes).is_skin)
    if mask is not None:
        studied = [
            (rgb, np.where(worn_mask(rgb, alpha, mesh, mask, px), np.float32(0), alpha), mesh, px)
            for rgb, alpha, mesh, px in studied
        ]
        votes = [scalp_votes(rgb, mesh, alpha) for rgb, alpha, mesh, _ in studied]
    counted = (face_colours(rgb, alpha, mesh) for rgb, alpha, mesh, _ in studied)
    colours = [counts for counts in counted if counts is not None]
    skin = sum(colours[1:], colours[0]) if colours else None
    return judge_scalp(votes), skin, mask, frames


def face_pictures(dataset: Dataset, item: str, head: TrackedHead) -> list[Picture]:
    """Read reduced pictures of up to GLASSES_CAMERAS cameras that see the face, evenly chosen."""
    cameras, found = read_cameras_of(dataset, item.split("/")[0]).values(), []
    seeing = [camera for camera in cameras if head.faces_camera(camera)]
    for camera in evenly(seeing, GLASSES_CAMERAS):
        with contextlib.suppress(*UNREADABLE):  # the stage names them
            pair = read_frame_and_matte(dataset, item, camera)
            found.append(reduced(camera, *pair, STUDIED_SIDE))
    return found


def label_view(
    head: TrackedHead,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray | None,
    bare: bool,
    side: int,
    skin_colours: np.ndarray | None = None,
    glasses: np.ndarray | None = None,
    mask: np.ndarray | None = None,
) -> ViewLabels:
    """Label a frame (H, W, 3) uint8 with alpha (H, W), reduced to at most `side` pixels.

    `depth` (H, W) is in metres, 0 where unknown; `bare` says that the scalp is skin;
    `skin_colours` are those of `face_colours`, `glasses` the places (n, 3) of `find_glasses`,
    `mask` the colour (3,) of `mask_colour`.
    """
    camera, rgb, alpha = reduced(camera, rgb, alpha, side)
    if depth is not None and depth.shape != alpha.shape:
        depth = cv2.resize(depth, alpha.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    whole = ViewLabels(np.zeros(alpha.shape, np.uint8), np.zeros(alpha.shape, bool))
    pixels, ahead = project(camera, head.vertices)
    if (ahead > 0).all():  # only the matte and the head, with a margin, are looked at
        x, y, width, height = cv2.boundingRect((alpha > 0).astype(np.uint8))
        matte = np.array([(x, y), (x + width, y + height)])
        ends = np.concatenate([pixels, matte]) if width else pixels
        camera, window = cut_about(camera, ends, MARGIN)
    else:
        window = np.s_[:, :]
    rgb, alpha = rgb[window], alpha[window]
    depth = None if depth is None else depth[window]
    geometry = head_geometry(head, camera, alpha, depth)
    metre_px = head.metre_px(camera)
    masked = np.zeros(alpha.shape, bool)
    if mask is not None:  # it teaches no colours
        masked = worn_mask(rgb, alpha, geometry.mesh, mask, metre_px)
    taught = np.where(masked, np.float32(0), alpha)
    labels = label_by_colour(rgb, taught, geometry, bare, skin_colours, metre_px)
    labels = np.where(labels == SCALP, SKIN if bare else HAIR, labels)
    if glasses is not None and len(glasses):
        # Hair covers the temples of glasses, so nothing on scalp and ears is labelled.
        bearing = (geometry.mesh == SCALP) | (geometry.mesh == EARS)
        worn = shown_in_front(glasses, camera, geometry.depth) & ~bearing
        labels = np.where(worn, np.uint8(LABELS.index("apparel")), labels)
    if depth is not None:
        hand = find_hands(geometry, labels, metre_px)
        labels = np.where(hand, np.uint8(LABELS.index("hand")), labels)
    labels = np.where(masked, np.uint8(LABELS.index("apparel")), labels)
    whole.labels[window] = np.where(alpha > 0, labels, np.uint8(0))
    whole.mesh[window] = geometry.mesh > 0
    return whole


def _write_view(
    out: Path, name: str, rgb: np.ndarray, alpha: np.ndarray, view: ViewLabels, weights: str
) -> tuple[dict, list[np.ndarray]]:
    """Write one camera's labels and head matte at full size; return figures and pictures."""

    def enlarged(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, alpha.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)

    labels, large = view.labels, enlarged(view.labels)
    mesh = enlarged(view.mesh.astype(np.uint8)) > 0
    if weights:
        # torch takes seconds to import
        from pipelines.networks import SAPIENS, load_network, refined, segment

        labels = large = refined(segment(load_network(weights, SAPIENS), rgb), large)
    else:
        large = np.where(alpha > 0.5, large, np.uint8(0))
    head = head_alpha(alpha, labels)
    write_image(out / f"{name}.png", large)
    write_image(out / f"{name}_head.png", np.rint(head * 255).astype(np.uint8))
    figures = {
        "labels": label_shares(large),
        "head": round(float(head.mean()), 6),
        "mesh_in_frame": bool(mesh.any()),
        **mesh_fit(mesh, alpha, head),
    }
    return figures, picture_row(rgb, large, head)


def label_shares(labels: np.ndarray) -> dict[str, float]:
    """Measure the share of the image that each label covers."""
    count = len(LABELS)
    shares = cv2.calcHist([labels], [0], None, [count], [0, count]).ravel() / labels.size
    return {name: round(float(share), 6) for name, share in zip(LABELS, shares, strict=True)}


def mesh_fit(mesh: np.ndarray, alpha: np.ndarray, head: np.ndarray) -> dict[str, float]:
    """Compare a mesh's silhouette (H, W) bool with a matte (H, W) and the head's matte (H, W)."""
    body, top = alpha > 0.5, head > 0.5
    either = int((mesh | top).sum())
    return {
        "mesh_in_matte": round(float(body[mesh].mean()) if mesh.any() else 0.0, 4),
        "mesh_iou_head": round(int((mesh & top).sum()) / either if either else 0.0, 4),
    }


def view_warning(figures: dict) -> str | None:
    """Explain what is doubtful about a camera's figures; None if nothing is.

    ``figures`` holds ``mesh_in_frame``, ``mesh_in_matte``, ``head`` and ``labels``.
    """
    if not figures["mesh_in_frame"]:
        return "no head found: the tracked mesh is not in this camera's image"
    if figures["labels"]["background"] == 1:
        return "the matte is empty"
    if figures["head"] == 0:
        return "the head's matte is empty: the matte holds nothing but torso"
    if figures["mesh_in_matte"] < AGREEMENT:
        return (
            f"mesh and matte disagree: {figures['mesh_in_matte']:.0%} of the tracked mesh lies in"
            f" the matte, under {AGREEMENT:.0%}; one of the two failed"
        )
    return None


def picture_row(image: np.ndarray, labels: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """Draw tiles of the frame, of labels over it and of the head on a plain ground.

    They show the window of the subject only.
    """
    box = subject_box(labels)
    step = max(1, min(labels[box].shape) // max(TILE))  # of pixels: tiles show no more
    image, labels, alpha = (whole[box][::step, ::step] for whole in (image, labels, alpha))
    painted = 0.35 * image + 0.65 * COLOURS[labels]
    painted = np.where((labels > 0)[..., None], painted, 0.4 * image).astype(np.uint8)
    # A colour that neither skin nor hair has, so that leftovers of plate and torso show.
    ground = np.array([40, 200, 90], np.float32)
    cut = alpha[..., None] * image + (1 - alpha[..., None]) * ground
    return [fit_into(picture, *TILE) for picture in (image, painted, cut.astype(np.uint8))]


def subject_box(labels: np.ndarray) -> tuple[slice, slice]:
    """Find the window of the labelled pixels with a margin, or the whole image without any."""
    if not labels.any():
        return np.s_[:, :]
    rows, columns = box_about(labels)
    size = max(rows.stop - rows.start, columns.stop - columns.start)
    return box_about(labels, size // 20 + 1)


def write_picture(out: Path, rows: dict[str, list[np.ndarray]], figures: dict[str, dict]) -> None:
    """Write a contact sheet of cameras from front to back, with a legend.

    ``rows`` holds the pictures of each camera, ``figures`` its ``labels``' shares.
    """

    def face(name: str) -> float:
        return sum(figures[name]["labels"][part] for part in FACE)

    names = evenly(sorted(rows, key=lambda name: -face(name)), SHOWN)
    pairs = [names[start : start + 2] for start in range(0, len(names), 2)]
    sheet = contact_sheet(
        [[picture for name in pair for picture in rows[name]] for pair in pairs],
        [[text for name in pair for text in (name, "", "")] for pair in pairs],
        tile=TILE,
    )
    legend = np.full((24, sheet.shape[1], 3), 24, np.uint8)
    step = sheet.shape[1] / (len(LABELS) - 1)
    for number, name in enumerate(LABELS[1:]):
        x = round(number * step)
        legend[6:18, x + 3 : x + 13] = COLOURS[number + 1]
        cv2.putText(
            legend, name, (x + 16, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (255,) * 3, 1, cv2.LINE_AA
        )
    (out / "qc").mkdir()
    write_image(out / "qc" / "regions.jpg", np.concatenate([legend, sheet]), quality=90)
