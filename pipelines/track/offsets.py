"""What no shape coefficient can say: a smooth static offset of the skin, off itself and along it.

The prior is a Gaussian field on the surface with a standard deviation and a correlation length in
metres (the Matern field of Lindgren, Rue and Lindstroem 2011, "An explicit link between Gaussian
fields and Gaussian Markov random fields"), so that it does not depend on how finely a mesh is
divided. Its broadest modes, the Laplacian's eigenfunctions, join the shape directions of the head:
both are then fitted at once, and what either explains better goes to it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import eigsh

from express50.head.model import HeadModel, vertex_normals

# Parts that move as one or are not skin: their shape is the model's.
RIGID = (
    "left_eyeball", "right_eyeball", "teeth", "tongue", "gums", "mouth_interior", "boundary",
)  # fmt: skip
# Names of modes: all, those along the normals and those along the skin.
MODE = "offset_"
OFF, ALONG = f"{MODE}off_", f"{MODE}along_"


def movable_vertices(model: HeadModel) -> np.ndarray:
    """Which vertices (V,) bool may leave the model's shapes: skin, not eyes, teeth and mouth."""
    rigid = [model.regions[name].numpy() for name in RIGID if name in model.regions]
    return ~np.any([np.zeros(len(model.template), dtype=bool), *rigid], axis=0)


def with_modes(
    model: HeadModel, count: int, sigma: float, length: float, along: int = 0
) -> HeadModel:
    """The head with more shape directions, each to be weighted by standard deviations.

    Args:
        model: any head.
        count: number of modes along the normals.
        sigma: standard deviation of the offsets, metres.
        length: their correlation length, metres.
        along: number of modes by which the skin slides along itself, each to be had along three
            axes. Places on skin are told from one another less finely than its depth is, so they
            are as broad as the broadest of the others.
    """
    if count == 0 and along == 0:
        return model
    normals = vertex_normals(model.template[None].double(), model.faces)[0]
    heights = torch.from_numpy(offset_modes(model, max(count, along), sigma, length))
    flat = torch.eye(3).double() - normals[:, :, None] * normals[:, None, :]
    lifts = normals[:, :, None] * heights[:, None, :count]
    slides = (flat[..., None] * heights[:, None, None, :along]).flatten(2)
    modes = torch.cat([lifts, slides], dim=2)
    names = tuple(f"{OFF}{index}" for index in range(lifts.shape[2]))
    names += tuple(f"{ALONG}{index}" for index in range(slides.shape[2]))
    return replace(
        model,
        shape_dirs=torch.cat([model.shape_dirs, modes.to(model.dtype)], dim=2),
        shape_names=model.shape_names + names,
    )


def split_shape(model: HeadModel, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A head's own shape coefficients (S,), and the offsets (V, 3) metres that its modes add.

    `model` is as `with_modes` returns it, `shape` (S + modes,) are its coefficients.
    """
    count = sum(not name.startswith(MODE) for name in model.shape_names)
    return shape[:count], model.shape_dirs[..., count:].double().numpy() @ shape[count:]


def offset_modes(model: HeadModel, count: int, sigma: float, length: float) -> np.ndarray:
    """The field's broadest modes (V, count), metres a standard deviation; see `with_modes`.

    Eyes, teeth and the inside of the mouth stay where they are.
    """
    vertices = model.template.double().numpy()
    stiffness, mass = cotangent_laplacian(vertices, model.faces.numpy())
    free = np.flatnonzero(movable_vertices(model) & (mass > 1e-11))
    count = min(count, len(free) - 2)
    core = stiffness[free][:, free].tocsc()
    # A fixed start makes the iteration, and so the modes, the same in every run.
    values, modes = eigsh(
        core, count, sparse.diags(mass[free]).tocsc(), sigma=-1.0, v0=np.ones(len(free))
    )
    kappa = 1.0 / length
    root_tau = 1.0 / (np.sqrt(4.0 * np.pi) * kappa * sigma)
    heights = np.zeros((len(vertices), count))
    heights[free] = modes / (root_tau * (kappa**2 + np.maximum(values, 0.0)))
    return heights


def cotangent_laplacian(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Cotangent stiffness (V, V) and lumped mass (V,) of a mesh (V, 3), (F, 3).

    Source: Pinkall and Polthier 1993. Only edges' positive weights are kept, so that slivers do no
    harm and the matrix is positive semi-definite.
    """
    count = len(vertices)
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    values: list[np.ndarray] = []
    mass = np.full(count, 1e-12)
    for k in range(3):
        i, j, o = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        u, v = vertices[i] - vertices[o], vertices[j] - vertices[o]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        rows.append(i)
        columns.append(j)
        values.append(0.5 * (u * v).sum(1) / np.maximum(area, 1e-14))
        np.add.at(mass, i, area / 6.0)
    shape = (count, count)
    half = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    weights = (half + half.T).maximum(0.0).minimum(20.0)
    return sparse.diags(np.asarray(weights.sum(1)).ravel()) - weights, mass
