"""Hair, skin or torso by colour, where geometry alone does not know.

Each view teaches itself: the pixels that geometry is sure of give a histogram of the colours of
hair, of skin and of the torso; every other pixel takes the class of which its colour and its place
say most (log-likelihood plus log-prior). Views from behind, where hair may cover all skin, learn
half of the skin's colours from views of the face. So a collar before the neck is torso, and hair
over a shoulder or over the forehead is hair, as far as their colours differ.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from express50.contract.segmentation_labels import LABELS, label_mask
from pipelines.regions.labels import SCALP
from pipelines.regions.view import HAIR, TORSO, Geometry

SKIN, NECK, EARS = (np.uint8(LABELS.index(name)) for name in ("skin", "neck", "ears"))
SOLID = 0.95  # alpha over which a pixel's colour is the subject's alone
LEAST = 30  # pixels that make a histogram
MOST = 10_000  # pixels that a share of all counts as
FEATURES = 0.003  # share of the mesh that eyes and lips fill where a view sees the face
ENOUGH = 300  # pixels of the face, with which the neck, which hair may cover, teaches nothing
CELLS, STEPS = (32, 64, 64), (8, 4, 4)  # of Lab in 8 bits
SMOOTH = 1.5  # cells
RARE = 1e-6  # share of a cell that no pixel taught
# Share of any cell of a class that taught nothing, as if its colours were spread over 8000 cells:
# what is neither hair nor skin then is torso, though none was sure.
UNTAUGHT = 1.2e-4
CLIP = 5.0  # most, in nats, that a colour may say against a class
BLUR_PX = 0.7  # a pixel's neighbours have a say
# Metres: as sure of torso this far below the neck's end, of hair and skin this far over it.
SURE_BELOW, SURE_HAIR, SURE_NECK = 0.01, 0.10, 0.04
FADE = 0.02  # metres of height about the neck's end that count a nat for head or torso
MOST_FADE = 8.0  # nats
NEVER = -20.0
# Log-priors of hair and skin on the mesh; torso is possible on the neck alone.
_ON_MESH = {int(SKIN): (-2.0, 0.0), SCALP: (0.0, -1.0), int(EARS): (-1.0, 0.0),
            int(NECK): (-0.5, 0.0)}  # fmt: skip
TORSO_ON_NECK, HAIR_ON_RIM, SKIN_BEYOND = -1.0, -1.0, -6.0


def face_colours(rgb: np.ndarray, alpha: np.ndarray, mesh: np.ndarray) -> np.ndarray | None:
    """Counts (CELLS) of the skin's colours in a view of the face; None in others.

    Args:
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) in [0, 1].
        mesh: (H, W) labels of the mesh alone.
    """
    skin = (mesh == SKIN) & (alpha > SOLID)
    return _counts(_cells(rgb), skin) if _sees_face(mesh) and skin.sum() >= ENOUGH else None


def _sees_face(mesh: np.ndarray) -> bool:
    features = label_mask(mesh, "eyes", "lips").sum()
    return bool(features > FEATURES * np.count_nonzero(mesh))


def by_colour(
    rgb: np.ndarray,
    alpha: np.ndarray,
    geometry: Geometry,
    bare: bool,
    skin_colours: np.ndarray | None = None,
) -> np.ndarray:
    """Labels (H, W) uint8 of geometry, those of hair, skin, ears, neck and torso by colour too.

    Args:
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) in [0, 1].
        geometry: where the pixels are.
        bare: whether the scalp is skin.
        skin_colours: sum of what `face_colours` gave for other views.
    """
    labels, cells = geometry.labels(), _cells(rgb)
    taught = _sure(labels, alpha > SOLID, geometry)
    beyond = SKIN_BEYOND
    if bare:
        # No scalp teaches hair, and what juts out beyond the mesh is skin as likely.
        labels = np.where(labels == SCALP, SKIN, labels)
        taught[0], beyond = np.zeros_like(taught[0]), 0.0
    counts = [_counts(cells, mask) for mask in taught]
    if skin_colours is not None and not bare and not _sees_face(geometry.mesh):
        # As much of each: the back of a neck may stand in a shadow that no face stands in.
        own, others = (c / np.float32(max(c.sum(), 1.0)) for c in (counts[1], skin_colours))
        counts[1] = MOST * (own + others)
    best = (_likelihoods(cells, counts) + _priors(labels, geometry, beyond)).argmax(0)
    around = (geometry.mesh > 0) | geometry.rim | bare
    kept = np.isin(geometry.near, (SKIN, NECK, EARS)) & around
    skin = np.where(kept, geometry.near, SKIN)
    unsure = (geometry.mesh == 0) | np.isin(geometry.mesh, list(_ON_MESH))
    return np.where(unsure, np.choose(best, [HAIR, skin, TORSO]), labels).astype(np.uint8)


def _sure(labels: np.ndarray, solid: np.ndarray, geometry: Geometry) -> list[np.ndarray]:
    """Pixels (H, W) that teach the colours of hair, skin, torso."""
    high, low = geometry.height > SURE_HAIR, geometry.height < -SURE_BELOW
    hair = (labels == SCALP) | ((labels == HAIR) & high)
    skin = solid & (geometry.mesh > 0) & (labels == SKIN)
    if skin.sum() < ENOUGH:
        skin = skin | (solid & (labels == NECK) & (geometry.height > SURE_NECK))
    return [solid & hair, skin, solid & (labels == TORSO) & low]


Cells = tuple[np.ndarray, ...]


def _cells(rgb: np.ndarray) -> Cells:
    """Cell of Lab, three indices (H, W) each, of pixels (H, W, 3)."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB) // np.array(STEPS, np.uint8)
    return tuple(lab.transpose(2, 0, 1).astype(np.int64))


def _counts(cells: Cells, mask: np.ndarray) -> np.ndarray:
    """Pixels of a mask (H, W) in each of the CELLS."""
    counts = np.zeros(CELLS, np.float32)
    np.add.at(counts, tuple(axis[mask] for axis in cells), 1)
    return counts


def _likelihoods(cells: Cells, taught: list[np.ndarray]) -> np.ndarray:
    """Log-likelihood (3, H, W) of each pixel's colour; any will do for what nothing taught."""
    says = np.full((3, *cells[0].shape), np.log(UNTAUGHT), np.float32)
    for row, counts in zip(says, taught, strict=True):
        if counts.sum() >= LEAST:
            shares = gaussian_filter(counts, SMOOTH) / counts.sum()
            row[:] = np.log(np.maximum(shares, 0) + RARE)[cells]
    says = np.maximum(says, says.max(0) - CLIP)
    return np.stack([cv2.GaussianBlur(row, (0, 0), BLUR_PX) for row in says])


def _priors(labels: np.ndarray, geometry: Geometry, beyond: float) -> np.ndarray:
    """Log-prior (3, H, W) of hair, skin and torso by place; `beyond` the rim, of skin."""
    fade = np.clip(geometry.height / FADE, -MOST_FADE, MOST_FADE)
    above, below = np.maximum(fade, 0), np.minimum(fade, 0)
    on_mesh = geometry.mesh > 0
    skin_rim = geometry.rim & (geometry.near != SCALP)
    hair = below + np.where(skin_rim, HAIR_ON_RIM, 0)
    skin = below + np.where(skin_rim, 0, beyond)
    torso = np.where(on_mesh, NEVER, -above)
    for label, (on_hair, on_skin) in _ON_MESH.items():
        here = on_mesh & (labels == label)
        hair, skin = np.where(here, on_hair, hair), np.where(here, on_skin, skin)
    torso = np.where(on_mesh & (labels == NECK), TORSO_ON_NECK - above, torso)
    return np.stack([hair, skin, torso])
