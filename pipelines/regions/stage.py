"""The regions stage: one expression of one subject, labels and a head matte for every camera."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import frame_inputs, read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.depth_files import depth_file
from express50.dataset.tracks import track_file
from express50.errors import CaptureError, FormatError, StageError
from express50.files.images import contact_sheet, fit_into, resize_area, write_image
from express50.geometry.cameras import Camera, resized
from pipelines.regions.colour import SKIN, by_colour, face_colours
from pipelines.regions.config import RegionsConfig
from pipelines.regions.labels import SCALP, HeadLabels
from pipelines.regions.mesh import TrackedHead, see
from pipelines.regions.qc import (
    label_shares,
    legend,
    mesh_fit,
    picture_row,
    subject_box,
    view_warning,
)
from pipelines.regions.read import read_depth_of, read_head, read_pair
from pipelines.regions.scalp import Scalp, decide, scalp_votes
from pipelines.regions.view import HAIR, head_alpha, place

TILE = (260, 260)
FACE = ("skin", "lips", "eyes")
VOTERS, VOTING_SIDE = 4, 512  # cameras, and their pixels, that tell skin and bare scalps


@dataclass(frozen=True)
class Seen:
    """One camera's labels (h, w) at the working size, and where the mesh is (h, w)."""

    labels: np.ndarray
    mesh: np.ndarray


def inputs(dataset: Dataset, item: str, config: RegionsConfig) -> dict[str, Path | str]:
    """Cameras, frames, track, mattes and depth maps of the expression, and the weights."""
    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.item_dir("calibrate", subject) / "cameras.json",
        **frame_inputs(dataset, subject, expression),
        "track": track_file(dataset, subject),
    }
    for camera in read_cameras_of(dataset, subject):
        matte = dataset.matte_file(subject, expression, camera)
        depth = depth_file(dataset.item_dir("depth", item), camera)
        found |= {f"matte {camera}": matte} if matte.is_file() else {}
        found |= {f"depth {camera}": depth} if config.depth and depth else {}
    if config.segmentation:
        found["segmentation"] = _weights(config)
    return found


def run(dataset: Dataset, item: str, config: RegionsConfig, out: Path) -> dict:
    """Write labels and the head's matte for each camera, and a picture; returns shares of parts."""
    cv2.setNumThreads(1)  # the runner counts one core an item
    subject, expression = item.split("/")
    head = read_head(dataset, subject, expression)
    scalp, skin, read = _person(dataset, item, head, config)
    figures, rows = {}, {}
    dropped = []
    for name, camera in read_cameras_of(dataset, subject).items():
        try:
            known = read.pop(name, None)
            rgb, alpha = known or read_pair(dataset, item, camera)
            depth = read_depth_of(dataset, item, camera, config)
        except (CaptureError, FormatError, StageError) as error:
            dropped.append({"what": name, "why": str(error)})
            continue
        small = look(head, camera, rgb, alpha, depth, scalp.is_skin, config, skin)
        figures[name], rows[name] = _finish(out, name, rgb, alpha, small, config)
    if not figures:
        why = "; ".join(f"{row['what']}: {row['why']}" for row in dropped[:3])
        raise StageError(f"{item}: no camera has a matte to label ({why}); run 'express50 matte'")
    shares = {name: row["labels"] for name, row in figures.items()}
    _write_picture(out, rows, shares, config.qc_views)
    return _metrics(head.labels, figures, scalp, config, dropped)


def look(
    head: TrackedHead,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray | None,
    bare: bool,
    config: RegionsConfig,
    skin_colours: np.ndarray | None = None,
) -> Seen:
    """Label one camera at the working size.

    Args:
        head: the tracked head.
        camera: pinhole.
        rgb: (H, W, 3) uint8.
        alpha: (H, W) float32 in [0, 1].
        depth: (H, W) metres, 0 where unknown; or None.
        bare: whether the scalp is skin.
        config: the stage's.
        skin_colours: of views of the face (``colour.face_colours``).
    """
    camera, rgb, alpha, depth = _shrunk(camera, rgb, alpha, depth, config.image_side)
    geometry = place(head, camera, alpha, depth, 1e-3 * config.rim_mm)
    labels = geometry.labels()
    if config.colour:
        labels = by_colour(rgb, alpha, geometry, bare, skin_colours)
    labels = np.where(labels == SCALP, SKIN if bare else HAIR, labels)
    return Seen(np.where(alpha > 0, labels, np.uint8(0)), geometry.mesh > 0)


def _shrunk(
    camera: Camera, rgb: np.ndarray, alpha: np.ndarray, depth: np.ndarray | None, side: int
) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray | None]:
    """Camera, frame, matte and depth map with at most `side` pixels along the longer side."""
    scale = side / max(camera.width, camera.height)
    if scale >= 1:
        return camera, rgb, alpha, depth
    width, height = (max(1, round(n * scale)) for n in (camera.width, camera.height))
    if depth is not None:
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    rgb, alpha = resize_area(rgb, width, height), resize_area(alpha, width, height)
    return resized(camera, width, height), rgb, alpha, depth


Frames = dict[str, tuple[np.ndarray, np.ndarray]]


def _person(
    dataset: Dataset, item: str, head: TrackedHead, config: RegionsConfig
) -> tuple[Scalp, np.ndarray | None, Frames]:
    """Whether the scalp is skin, the skin's colours, by a few cameras; and what these showed."""
    cameras = list(read_cameras_of(dataset, item.split("/")[0]).values())
    votes, colours, read = [], [], Frames()
    for k in np.unique(np.linspace(0, len(cameras) - 1, VOTERS).round().astype(int)):
        with contextlib.suppress(CaptureError, FormatError, StageError):  # the run names them
            rgb, alpha = read[cameras[k].id] = read_pair(dataset, item, cameras[k])
            camera, rgb, alpha, _ = _shrunk(cameras[k], rgb, alpha, None, VOTING_SIDE)
            mesh = see(head, camera)[0]
            votes.append(scalp_votes(rgb, mesh, alpha))
            colours += [c for c in (face_colours(rgb, alpha, mesh),) if c is not None]
    scalp = decide(votes)
    if config.scalp != "auto":
        scalp = replace(scalp, is_skin=config.scalp == "skin")
    return scalp, sum(colours[1:], colours[0]) if colours else None, read


def _weights(config: RegionsConfig) -> Path:
    path = Path(config.segmentation).expanduser()
    from pipelines.networks import check_file  # torch takes seconds to import

    check_file(path, "regions.segmentation")
    return path


def _finish(
    out: Path, name: str, rgb: np.ndarray, alpha: np.ndarray, small: Seen, config: RegionsConfig
) -> tuple[dict, list[np.ndarray]]:
    """Write one camera's labels and head matte at full size; figures and a row of pictures."""
    labels = small.labels
    size = alpha.shape[1], alpha.shape[0]
    large = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT)
    mesh = cv2.resize(small.mesh.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    if config.segmentation:
        # Only here, as torch takes seconds to import.
        from pipelines.networks import load_network
        from pipelines.regions.sapiens import SAPIENS, refined, segment

        labels = large = refined(segment(load_network(_weights(config), SAPIENS), rgb), large)
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
    pictures = picture_row(rgb, large, head, subject_box(large))
    return figures, [fit_into(picture, *TILE) for picture in pictures]


def _write_picture(
    out: Path, rows: dict[str, list[np.ndarray]], shares: dict[str, dict], count: int
) -> None:
    """Contact sheet of cameras from front to back: frame, labels, head alone; and a legend."""
    names = sorted(rows, key=lambda name: -sum(shares[name][part] for part in FACE))
    chosen = np.unique(np.linspace(0, len(names) - 1, count).round().astype(int))
    pairs = [[names[k] for k in chosen[start : start + 2]] for start in range(0, len(chosen), 2)]
    sheet = contact_sheet(
        [[picture for name in pair for picture in rows[name]] for pair in pairs],
        [", ".join(pair) for pair in pairs],
        tile=TILE,
    )
    (out / "qc").mkdir()
    sheet = np.concatenate([legend(sheet.shape[1]), sheet])
    write_image(out / "qc" / "regions.jpg", sheet, quality=90)


def _metrics(
    labels: HeadLabels,
    figures: dict[str, dict],
    scalp: Scalp,
    config: RegionsConfig,
    dropped: list[dict],
) -> dict:
    """Figures of the item; means are over the cameras that have the head in their image."""
    odd = {name: view_warning(row, config.agreement) for name, row in figures.items()}
    warned = [{"what": name, "why": why} for name, why in odd.items() if why]
    if "torso" in labels.missing and not config.segmentation:
        why = "the head model has no boundary, so that nothing tells torso from head: it is kept"
        warned.append({"what": "torso", "why": why})
    there = [row for row in figures.values() if row["mesh_in_frame"]]
    share = float(np.mean([row["mesh_in_matte"] for row in there])) if there else 0.0
    return {
        "method": "network and mesh" if config.segmentation else "mesh",
        "missing": list(labels.missing),
        "scalp": {
            "label": "skin" if scalp.is_skin else "hair",
            "skin_coloured": scalp.skin_coloured,
        },
        "mesh_in_matte": round(share, 4),
        "cameras": figures,
        "warnings": warned,
        "dropped": dropped,
    }


def needs_gpu(config: RegionsConfig) -> bool:
    """Whether the network must run on CUDA."""
    return bool(config.segmentation) and config.device == "cuda"
