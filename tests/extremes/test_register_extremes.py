"""Register at the extremes: far worlds, slivers, holes, single triangles, any similar motion."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_head
from pipelines.register.lay import GivenSurface, lay, mesh_normals

REACH, DETAIL = 0.010, 0.016


@pytest.fixture(scope="module")
def head():
    """The template, and a surface 2 mm outside it."""
    model = load_head("procedural")
    mesh = model.template.double().numpy()
    return model, mesh, mesh + 0.002 * mesh_normals(mesh, model.faces)


@pytest.fixture(scope="module")
def here(head):
    model, mesh, outside = head
    return lay(model, mesh, GivenSurface(outside, model.faces.numpy(), np.ones(len(mesh))), DETAIL)


def finite(laid) -> bool:
    return all(np.isfinite(x).all() for x in (laid.vertices, laid.residual, laid.sigma))


def test_the_result_turns_and_shifts_with_the_world(head, here):
    model, mesh, outside = head
    faces, trust = model.faces.numpy(), np.ones(len(mesh))
    R, t = axis_angle_to_matrix(np.array([-0.9, -3.1, 0.6])), np.array([1000.0, 0.5, -1000.0])
    there = lay(model, mesh @ R.T + t, GivenSurface(outside @ R.T + t, faces, trust), DETAIL)
    assert finite(there)
    off = np.linalg.norm(there.vertices - (here.vertices @ R.T + t), axis=1)
    assert np.percentile(off, 95) < 2e-5


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.array([[0, 0, 0.1], [0.01, 0, 0.1], [0, 0.01, 0.1]]), np.array([[0, 1, 2]])),
        (np.array([[0, 0, 0.1], [0, 0, 0.1], [0, 0, 0.1]]), np.array([[0, 1, 2]])),
        (np.array([[0, 0, 0.1], [1e-9, 0, 0.1], [0, 3.0, 0.1]]), np.array([[0, 1, 2], [0, 2, 1]])),
        (1e3 * np.array([[0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1]]), np.array([[0, 1, 2]])),
    ],
    ids=["one triangle", "a point", "needle, two-sided", "kilometres"],
)
def test_transparent_surfaces_move_little(head, vertices, faces):
    model, mesh, _ = head
    laid = lay(model, mesh, GivenSurface(vertices, faces, np.ones(3)), DETAIL)
    assert finite(laid)
    assert np.abs(laid.vertices - mesh).max() < REACH


def test_holes_and_non_manifold_faces_do_no_harm(head):
    model, mesh, outside = head
    faces, rng = model.faces.numpy(), np.random.default_rng(0)
    kept = faces[rng.uniform(size=len(faces)) < 0.5]
    twice = np.concatenate([kept, kept[:500], kept[:500, [0, 0, 1]]])
    laid = lay(model, mesh, GivenSurface(outside, twice, np.ones(len(mesh))), DETAIL)
    nose = model.regions["nose"].numpy()
    rise = ((laid.vertices - mesh) * mesh_normals(mesh, model.faces)).sum(1)
    assert finite(laid)
    assert np.median(rise[nose]) == pytest.approx(0.002, abs=0.0006)


def test_an_upside_down_surface_is_not_this_head(head):
    model, mesh, outside = head
    surface = GivenSurface(outside * [1, -1, -1], model.faces.numpy(), np.ones(len(mesh)))
    laid = lay(model, mesh, surface, DETAIL)
    assert finite(laid)
    assert np.abs(laid.vertices - mesh).max() < 3 * REACH
