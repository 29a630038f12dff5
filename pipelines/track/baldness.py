"""Detect a bald head: only its outline in the mattes is the skull's and may pull from afar.

Under hair the skull can be anywhere within centimetres.
"""

from __future__ import annotations

import numpy as np
import torch

from express50.geometry.cameras import Camera
from express50.geometry.pinhole import inside_frame
from express50.head.model import HeadModel, vertex_normals
from pipelines.track.crops import look_up
from pipelines.track.surface import Visibility

FEATURES = (
    "lips", "left_eye_region", "right_eye_region", "left_eyeball", "right_eyeball",
    "mouth_interior", "teeth", "tongue",
)  # fmt: skip
# Natural logarithms of root light: shading changes brightness much, colour little.
LEAST_SPREAD = np.array([0.2, 0.03, 0.03])
WITHIN, BARE_SHARE = 3.0, 0.6


def is_bald(model: HeadModel, images: list[tuple[np.ndarray, Camera]], mesh: np.ndarray) -> bool:
    """Say whether most of the scalp has the colour of the face.

    Args:
        model: the head model.
        images: pictures (H, W, 3) float32, root of linear light, with pinhole cameras.
        mesh: (V, 3) world, roughly fitted.
    """
    share = bare_share(model, images, mesh)
    return share is not None and share > BARE_SHARE


def bare_share(
    model: HeadModel, images: list[tuple[np.ndarray, Camera]], mesh: np.ndarray
) -> float | None:
    """Return the share of the visible scalp that has the face's colour; None if unseen."""
    scalp, face = (model.regions[name].numpy() for name in ("scalp", "face"))
    for name in FEATURES:
        if name in model.regions:
            face = face & ~model.regions[name].numpy()
    colour = _colours(model, images, mesh)
    seen = np.isfinite(colour).all(1)
    if (face & seen).sum() < 20 or (scalp & seen).sum() < 20:
        return None
    middle = np.median(colour[face & seen], axis=0)
    spread = 1.4826 * np.median(np.abs(colour[face & seen] - middle), axis=0)
    off = np.abs(colour[scalp & seen] - middle) / np.maximum(spread, LEAST_SPREAD)
    return float((off < WITHIN).all(1).mean())


def _colours(
    model: HeadModel, images: list[tuple[np.ndarray, Camera]], mesh: np.ndarray
) -> np.ndarray:
    """Return log brightness and two log colour ratios (V, 3), median of the views; NaN unseen."""
    normals = vertex_normals(torch.from_numpy(mesh)[None], model.faces)[0].numpy()
    visibility = Visibility(mesh, model.faces.numpy())
    rows = []
    for image, camera in images:
        value = np.log(np.maximum(look_up(camera, image, mesh), 0.01))
        seen = visibility.weights(camera, mesh, normals) > 0
        value[~(seen & inside_frame(camera, mesh)[1])] = np.nan
        rows.append(value)
    if not rows:
        return np.full(mesh.shape, np.nan)
    known = np.isfinite(np.stack(rows)).any((0, 2))
    middle = np.full(mesh.shape, np.nan)
    middle[known] = np.nanmedian(np.stack(rows)[:, known], axis=0)
    r, g, b = middle.T
    return np.stack([(r + g + b) / 3.0, r - g, g - b], axis=1)
