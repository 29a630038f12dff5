"""Predict the pictures of held-out cameras from a tracked mesh, beside the true ones.

A pixel of a held-out camera whose first surface is the tracked face is a point in space. Its colour
is the median, over the tracking cameras that see the point on the tracked mesh (not hidden by the
mesh, not at a slant), of the root of linear light at the point's projection, of the same moment. If
the mesh is off, cameras look at different skin, and the picture blurs. It is compared in sRGB with
the held-out camera's frame where it shows the true face's skin first (no hair in front). The same
for every preset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.truth import Truth
from express50.capture.frames import FootageReader, read_cameras_of
from express50.capture.raw import read_capture
from express50.contract.layout import Dataset
from express50.files.containers import read_picture
from express50.geometry.cameras import Camera, pinhole, unproject
from express50.geometry.pixels import LIGHT_OF_LEVEL, linear_to_srgb
from express50.geometry.raycast import visible_faces
from express50.geometry.sampling import undistort_image
from express50.geometry.transforms import unit
from express50.head.model import HeadModel
from pipelines.track.surface import Visibility, look_up

MIN_COSINE = 0.4  # cosine below which a camera's view of a point is not taken
LEAST_VIEWS = 2
LEAST_PIXELS = 200  # of the face, for a PSNR


@dataclass(frozen=True)
class HeldOut:
    """The true view of a held-out camera at a frame."""

    camera: Camera  # true pinhole camera
    mask: np.ndarray  # (H, W) bool, the true head mesh
    face: np.ndarray  # (H, W) bool, the face region's skin, seen first
    # (H, W, 3) uint8 sRGB, undistorted; None without the capture's footage
    image: np.ndarray | None


def held_out_views(
    dataset: Dataset, truth: Truth, subject: str, captures: Path | None
) -> dict[int, list[HeldOut]]:
    """Return views of all true cameras that the dataset lacks, by frame of a true peak."""
    known = read_cameras_of(dataset, subject)
    hidden = {k: v for k, v in truth.cameras(subject).items() if k not in known}
    footage = read_capture(captures / subject).cameras if captures else {}
    model = truth.head_model(subject)
    found: dict[int, list[HeldOut]] = {}
    for frame in truth.peaks(subject).values():
        vertices = truth.vertices(subject, frame)
        for name, camera in hidden.items():
            plain = pinhole(camera)
            raw = footage.get(name)
            image = None
            if raw is not None and raw.kind == "frames":
                image = undistort_image(read_picture(raw.path, raw.names[frame]), camera)
            mask, face = mask_of(model, vertices, plain), see_face(model, vertices, plain)[0]
            face = face & truth.skin(subject, frame, plain)
            found.setdefault(frame, []).append(HeldOut(plain, mask, face, image))
    return found


def face_of(model: HeadModel) -> np.ndarray:
    """Return vertices (V,) bool of the face."""
    return model.regions["face"].numpy()


def mask_of(model: HeadModel, vertices: np.ndarray, camera: Camera) -> np.ndarray:
    """Return pixels (H, W) bool that the mesh covers, by ray casting."""
    return visible_faces(vertices, model.faces.numpy(), camera)[0] >= 0


def see_face(
    model: HeadModel, vertices: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (H, W) bool whose first surface is the face region, face ids and depth."""
    faces = model.faces.numpy()
    face_id, depth = visible_faces(vertices, faces, camera)
    inside = face_of(model)[faces].all(1)
    return (face_id >= 0) & inside[face_id], face_id, depth


def psnr_db(
    dataset: Dataset,
    subject: str,
    frame: int,
    model: HeadModel,
    vertices: np.ndarray,
    cameras: Mapping[str, Camera],
    view: HeldOut,
) -> float | None:
    """Return the PSNR, dB, of the module docstring's picture; None without enough face.

    Args:
        dataset: whose frames colour the mesh.
        subject: its id.
        frame: decode index.
        model: of the mesh.
        vertices: (V, 3) tracked mesh, true world.
        cameras: tracking cameras, true world.
        view: what the held-out camera shows.
    """
    if view.image is None:
        return None
    face, face_id, depth = see_face(model, vertices, view.camera)
    rows, columns = np.nonzero(face & view.face)
    if len(rows) < LEAST_PIXELS:
        return None
    pixels = np.stack([columns, rows], axis=1) + 0.5
    places = unproject(view.camera, pixels, depth[rows, columns])
    a, b, c = np.moveaxis(vertices[model.faces.numpy()[face_id[rows, columns]]], 1, 0)
    normals = unit(np.cross(b - a, c - a))
    colours = median_colours(dataset, subject, frame, model, vertices, cameras, places, normals)
    known = np.isfinite(colours).all(1)
    if known.sum() < LEAST_PIXELS:
        return None
    shown = view.image[rows, columns][known] / 255.0
    error = linear_to_srgb(colours[known] ** 2) - shown
    return float(-10.0 * np.log10(np.mean(error**2)))


def median_colours(
    dataset: Dataset,
    subject: str,
    frame: int,
    model: HeadModel,
    vertices: np.ndarray,
    cameras: Mapping[str, Camera],
    places: np.ndarray,
    normals: np.ndarray,
) -> np.ndarray:
    """Return the median root of light (N, 3) of places on a mesh; NaN where few cameras see it."""
    visibility = Visibility(vertices, model.faces.numpy())
    seen = np.full((len(cameras), len(places), 3), np.nan)
    with FootageReader(dataset, subject) as footage:
        for row, (name, camera) in enumerate(cameras.items()):
            clear = visibility.weights(camera, places, normals) > MIN_COSINE
            if clear.any():
                image = np.sqrt(LIGHT_OF_LEVEL[footage.read(name, frame)])
                seen[row, clear] = look_up(camera, image, places[clear])
    enough = np.isfinite(seen[..., 0]).sum(0) >= LEAST_VIEWS
    colours = np.full(places.shape, np.nan)
    colours[enough] = np.nanmedian(seen[:, enough], axis=0)
    return colours
