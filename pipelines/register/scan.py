"""Register a given scan: fit a head model to it, and lay the mesh onto it.

Neither a pose nor landmarks nor a texture is needed (`scan_look`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from express50.errors import StageError
from express50.files.images import linear_to_srgb
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks
from pipelines.register.lay import (
    GivenSurface,
    LaidMesh,
    SurfaceSearch,
    folded,
    lay,
    mesh_normals,
    skin_trust,
    trusted_vertices,
)
from pipelines.register.scan_landmarks import GIVEN_M, check_face
from pipelines.register.scan_look import look
from pipelines.register.scan_mesh import Scan
from pipelines.track.basis import OFF, Basis, make_basis
from pipelines.track.fit import fit
from pipelines.track.observe import JAW_LINE_WEIGHT
from pipelines.track.stage import fit_landmarks
from pipelines.track.state import State, Target, all_vertices
from pipelines.track.terms import MeshPlaces, NormalTerm, PointTerm, landmark_anchors

REACHES = (0.015, 0.010, 0.006, 0.004)  # of the search, per round of the fit of parameters; metres
ROUND_STEPS, SIGMA_M = 4, 0.0012
DETAIL_M = 0.008  # wavelength of the finest detail that is followed: scans have few errors


@dataclass(frozen=True)
class FittedScan:
    """Parameters of a head model for a scan, and the mesh laid onto it."""

    basis: Basis
    targets: list[Target]
    state: State
    start: np.ndarray
    laid: LaidMesh


def fit_scan(scan: Scan, head: str, given: np.ndarray | None = None) -> FittedScan:
    """Fit a head model to a scan, with the help of given landmarks (68, 3), NaN where unknown.

    Raises:
        StageError: no face is found, or landmarks are not of this scan.
        HeadModelError: the head model cannot be loaded.
    """
    torch.set_num_threads(1)
    basis = make_basis(load_head(head))
    template = landmarks(basis.model, basis.model.template[None])[0].numpy()
    given = np.full((68, 3), np.nan) if given is None else given
    observation = look(scan, template, given)
    check_face(observation.points, template, "the face that is seen")
    terms = given_terms(basis.model, given)
    # It may be any face: none is neutral.
    targets, state, lost = fit_landmarks(basis, [observation], "", terms)
    if lost:
        raise StageError(f"the scan's landmarks fit no head: {lost[0].why}")
    model, trust = basis.model, np.ones(len(scan.vertices))
    surface = GivenSurface(scan.vertices, scan.faces, trust)
    search = SurfaceSearch(surface)
    for reach in REACHES:
        mesh = all_vertices(model, state)[0]
        term = surface_term(model, search, mesh, reach)
        seen = replace(targets[0], terms=(*targets[0].terms, term))
        state, _ = fit(basis, [seen], state, ROUND_STEPS, (OFF,))
    start = all_vertices(model, state)[0]
    if scan.textured:
        shades = np.rint(255 * linear_to_srgb(scan.colors)).astype(np.uint8)
        trust = skin_trust(model, start, scan.vertices, shades, trust)
    laid = lay(model, start, replace(surface, trust=trust), DETAIL_M)
    return FittedScan(basis, targets, state, start, laid)


def given_terms(model: HeadModel, given: np.ndarray) -> tuple[PointTerm, ...]:
    """Make the terms that pull landmarks to given ones (68, 3), NaN where there are none."""
    known, anchors = np.flatnonzero(np.isfinite(given[:, 0])), landmark_anchors(model)
    rows = (known[known > 16], GIVEN_M), (known[known < 17], GIVEN_M / JAW_LINE_WEIGHT)
    return tuple(PointTerm(anchors.some(ids), given[ids], sigma) for ids, sigma in rows if len(ids))


def surface_term(
    model: HeadModel, search: SurfaceSearch, mesh: np.ndarray, reach: float
) -> NormalTerm:
    """Make the term that pulls a mesh's (V, 3) vertices to the scan, as far as it is found."""
    normals = mesh_normals(mesh, model.faces)
    height, trust = search.heights(mesh, normals, reach)
    trust = trust * trusted_vertices(model) * ~folded(mesh, normals, model.faces.numpy())
    ids = np.flatnonzero(trust > 0)
    goals = mesh[ids] + height[ids, None] * normals[ids]
    sigma = SIGMA_M / np.sqrt(trust[ids])
    return NormalTerm(MeshPlaces.of_vertices(ids), goals, normals[ids], sigma, 0.5 * reach)
