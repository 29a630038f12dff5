"""Register one expression: read track and surface, lay the mesh, write it with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.dataset.tracks import (
    LARGEST_SPREAD,
    REGISTRATION_SCHEMA,
    Track,
    existing_track,
    read_track,
    shape_spread,
)
from express50.error_model import error_bounds, single_camera_sigma
from express50.errors import FormatError, StageError, advised, rounded_down
from express50.files.digests import file_sha256
from express50.files.images import write_image
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera
from express50.geometry.meshes import read_surface
from express50.geometry.pixels import contact_sheet
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import HeadModel, joint_angles, joint_transforms
from express50.head.preview import render_preview
from pipelines.register.lay import (
    AGREEING,
    SURFACE_M,
    GivenSurface,
    LaidMesh,
    bare_skin,
    lay,
    mesh_normals,
    skin_trust,
    too_fine,
)
from pipelines.register.untangle import crossings
from pipelines.track.sequence import write_npz

# Finest wavelength that the mesh follows; finer detail of depth is mostly error. At 512 px,
# 12 mm gives the same results.
DETAIL_M = 0.016
LEAST_SEEN = 0.1  # share of the face under which the surface is not this head's
YAWS = (0.0, 60.0)  # of the pictures, degrees


def run(dataset: Dataset, item: str, out: Path) -> Result:
    """Write registration.npz and a picture.

    Raises:
        StageError: the expression has no surface, or is not tracked.
        FormatError: the track does not fit its head model, or the surface is damaged.
    """
    torch.set_num_threads(1)
    subject, expression = item.split("/")
    path, file = existing_track(dataset, subject), dataset.surface_file(subject, expression)
    if not file.is_file():
        raise StageError(
            f"{item}: it has no surface; run {advised('express50 depth', dataset.root)}"
        )
    track, surface = read_track(path), read_surface(file)
    row, model = track.row(expression), load_head(track.head)
    start = track.mesh(expression, len(model.template), path)
    # Depth does not compare views with one camera, nor if it is imported.
    made = dataset.item_dir("depth", item) / "metrics.json"
    compared = made.is_file() and read_json_table(made, FormatError).get("views", 1) > 1
    agreeing = AGREEING if compared else 0.0
    places, sure = surface.vertices, surface.confidence
    skin = bare_skin(model, start, places)
    trust = skin_trust(model, start, places, surface.colors, sure, skin, agreeing)
    trust[too_fine(model, start, places)] = 0.0
    laid = lay(model, start, GivenSurface(places, surface.faces, trust), DETAIL_M)
    # Tracking sees lips, eyes and nostrils well: where it alone placed them, its deviations count.
    fine = too_fine(model, start, start) & ~laid.seen & np.isfinite(track.sigma[row])
    sigma = np.where(fine, np.hypot(track.sigma[row], SURFACE_M), laid.sigma)
    laid = replace(laid, sigma=sigma)
    cameras = list(read_cameras_of(dataset, subject).values())
    shared = sigma_along_normals(laid, cameras, model)
    bounds = error_bounds("register", error_figures(laid, track, row), shared)
    metrics = write_registration(out, path, track, row, laid, bound=1e-3 * bounds.bound)
    agreement = round(float(np.median(sure[skin])), 4) if len(skin) else None
    metrics["skin_agreement"] = agreement
    warnings = []
    if agreement is not None and agreement < agreeing:
        why = (
            f"cameras agree on bare skin by {rounded_down(agreement)}, expected {AGREEING} or more,"
            " so the mesh follows the surface less: check calibration and synchronisation, and"
            " whether the face is dark, noisy or blurred; cameras that stand far apart or see a"
            " small head agree less, too"
        )
        warnings.append(Note("mesh", why))
    elif metrics["seen_share"] < LEAST_SEEN:
        why = f"the surface was found at only {metrics['seen_share']:.0%} of the face's vertices"
        warnings.append(Note("mesh", why))
    expected = bounds.expected
    if shape_spread(track.shape) > LARGEST_SPREAD:  # the error model knows people only
        expected = None
        why = "the tracked head has an impossible shape, so no error is stated; see 'track'"
        warnings.append(Note("head shape", why))
    return Result(metrics, (), warnings, expected)


def sigma_along_normals(laid: LaidMesh, cameras: Sequence[Camera], model: HeadModel) -> np.ndarray:
    """Return the part along the mesh's normals of `single_camera_sigma` (V,), metres."""
    along = single_camera_sigma(cameras, laid.vertices)
    ray = laid.vertices - cameras[0].center
    cosine = (mesh_normals(laid.vertices, model.faces) * ray).sum(1) / np.linalg.norm(ray, axis=1)
    return along * np.abs(cosine)


def error_figures(laid: LaidMesh, track: Track, row: int) -> dict[str, np.ndarray | float]:
    """Return the figures (V,) from which `error_bounds` predicts errors along normals."""
    moved = np.linalg.norm(laid.vertices - track.vertices[row], axis=1)
    return {
        "laid_sigma_mm": 1e3 * laid.sigma,
        "tracked_mm": 1e3 * track.bound[row],
        "unseen": np.where(laid.seen, 1.0, 2.0),
        "residual_mm": 0.05 + 1e3 * np.abs(laid.residual),
        "moved_mm": 0.05 + 1e3 * moved,
    }


def write_registration(
    out: Path, path: Path, track: Track, row: int, laid: LaidMesh, start_name: str = "tracked",
    bound: np.ndarray | None = None,
) -> dict:  # fmt: skip
    """Write registration.npz and a picture for a row of a track; return the metrics.

    `path` is the track's file, `start_name` the picture's title for the track's mesh, `bound` (V,)
    is in metres.
    """
    model, start = load_head(track.head), track.vertices[row].astype(np.float64)
    numbers = {
        "vertices": laid.vertices,
        "offsets": rest_offsets(model, track, row, laid.vertices - start),
        "residual": laid.residual,
        "sigma": laid.sigma,
        **({} if bound is None else {"bound": bound}),
    }
    arrays = {name: array.astype(np.float32) for name, array in numbers.items()}
    arrays |= {"schema": np.array(REGISTRATION_SCHEMA), "track": np.array(file_sha256(path))}
    write_npz(out / "registration.npz", arrays | {"seen": laid.seen})
    write_picture(out, model, track, row, laid, start_name)
    return figures_of(model, start, laid)


def rest_offsets(model: HeadModel, track: Track, row: int, moved: np.ndarray) -> np.ndarray:
    """Return the offsets (V, 3) at rest that move posed vertices by `moved` (V, 3) in the world.

    They are added to the rest shape of the tracked parameters; its joints stay.
    """
    neck, jaw, eyes = (
        torch.from_numpy(part[row])[None] for part in (track.neck, track.jaw, track.eyes)
    )
    like = torch.zeros(1, 1, 3, dtype=torch.float64)
    turns = axis_angle_to_matrix(joint_angles(like, None, neck, jaw, eyes))
    turn, _ = joint_transforms(torch.zeros(1, turns.shape[1], 3, dtype=torch.float64), turns)
    blended = torch.einsum("nj,jrc->nrc", model.skinning.double(), turn[0]).numpy()
    return np.linalg.solve(blended, (moved @ track.R[row])[..., None])[..., 0]


def figures_of(model: HeadModel, start: np.ndarray, laid: LaidMesh) -> dict:
    """Return the metrics of the face, rounded so that the last bits do not matter."""
    face = model.regions["face"].numpy() if "face" in model.regions else np.ones(len(start), bool)
    seen = face & laid.seen
    residual = np.abs(laid.residual[seen])
    moved = np.linalg.norm(laid.vertices - start, axis=1)[face]
    figures = {
        "residual_mm_median": 1e3 * float(np.median(residual)) if seen.any() else None,
        "residual_mm_p95": 1e3 * float(np.percentile(residual, 95)) if seen.any() else None,
        "moved_mm_median": 1e3 * float(np.median(moved)),
        "moved_mm_p95": 1e3 * float(np.percentile(moved, 95)),
        "sigma_mm_median": 1e3 * float(np.median(laid.sigma[face])),
        "seen_share": float(seen.sum() / max(1, face.sum())),
    }
    rounded = {k: None if value is None else round(value, 4) for k, value in figures.items()}
    before, after = (len(crossings(model, mesh)) for mesh in (start, laid.vertices))
    return rounded | {"crossing_triangles": after, "crossing_triangles_tracked": before}


def write_picture(
    out: Path, model: HeadModel, track: Track, row: int, laid: LaidMesh, start_name: str
) -> None:
    """Draw the track's mesh above the registered one, each from two sides."""
    (out / "qc").mkdir(exist_ok=True)
    rows = [
        [
            render_preview(model, (mesh - track.t[row]) @ track.R[row], yaw=yaw, size=240)
            for yaw in YAWS
        ]
        for mesh in (track.vertices[row].astype(np.float64), laid.vertices)
    ]
    sheet = contact_sheet(rows, [start_name, "registered"], tile=(240, 240))
    write_image(out / "qc" / "registration.jpg", sheet, quality=90)
