"""The statistics that the built-in head's directions are."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.head import draw_people, measure
from express50.head.generator.head import procedural_mesh
from express50.head.generator.ict_registration import FLIP
from express50.head.generator.people import KEPT_VARIANCE, principal_directions
from express50.head.load import load_builtin


def test_directions_have_the_covariance_of_people_and_their_mirror_images():
    rng = np.random.default_rng(0)
    mirror = np.array([1, 0, 2, 4, 3])
    moves = rng.normal(size=(5, 3, 4)) * np.array([3.0, 2.0, 1.0, 0.5])
    other = moves[mirror] * FLIP[:, None]
    both = np.concatenate([moves, other], axis=2).reshape(15, -1) / np.sqrt(2)
    found = principal_directions(moves, mirror)
    flat = found.reshape(15, -1)
    kept = (flat**2).sum() / (both**2).sum()
    assert KEPT_VARIANCE <= kept <= 1.0 + 1e-9
    missing = both @ both.T - flat @ flat.T
    assert np.linalg.eigvalsh(missing).min() > -1e-9  # it is a part of the covariance
    signs = (found[mirror] * FLIP[:, None] * found).sum((0, 1)) / (flat**2).sum(0)
    np.testing.assert_allclose(np.abs(signs), 1.0, atol=1e-9)


def test_directions_of_the_stored_head_are_orthogonal_and_ordered():
    head = load_builtin()
    flat = head.shape_dirs.double().numpy().reshape(-1, len(head.shape_names))
    size = np.linalg.norm(flat, axis=0)
    assert (np.diff(size) < 1e-4 * size[0]).all()
    gram = (flat / size).T @ (flat / size)
    assert np.abs(gram - np.eye(len(size))).max() < 0.05
    mirror = torch.from_numpy(procedural_mesh().mirror)
    turned = head.shape_dirs[mirror] * torch.tensor([-1.0, 1.0, 1.0])[:, None]
    signs = (turned * head.shape_dirs).sum((0, 1)) / head.shape_dirs.square().sum((0, 1))
    assert float((signs.abs() - 1.0).abs().max()) < 0.01


def test_sampled_people_have_the_measures_of_adults():
    for name, row in measure(load_builtin(), seed=3).items():
        low, high = 0.85 * min(row["men"], row["women"]), 1.2 * max(row["men"], row["women"])
        assert low < row["mean"] < high, name
        assert 0.02 < row["deviation"] / row["mean"] < 0.15, name


def test_lips_of_sampled_people_are_closed():
    head, mesh = load_builtin(), procedural_mesh()
    lips = mesh.tag("lip0", "left")
    for person in draw_people(head, 5, seed=1):
        gap = np.linalg.norm(person[lips] - person[lips[::-1]], axis=1)
        assert gap.max() < 5e-4
