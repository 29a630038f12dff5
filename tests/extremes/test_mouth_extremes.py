"""A mouth on heads that only look like FLAME, and on identities far from the mean."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from express50.errors import HeadModelError
from express50.head.flame import load_flame, read_flame
from express50.head.model import HeadModel, pose, vertex_normals
from express50.head.mouth import add_mouth
from tests.express50.head.flame_head import write_flame_size


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return write_flame_size(tmp_path_factory.mktemp("flame_size"))


@pytest.fixture(scope="module")
def bare(path) -> HeadModel:
    return read_flame(path)


@pytest.mark.parametrize("scale", [1e3, 1e-3, 0.0])
def test_heads_in_other_units_are_named(bare, scale) -> None:
    with pytest.raises(HeadModelError, match="rings are .* mm apart, expected 2 to 30") as caught:
        add_mouth(replace(bare, template=bare.template * scale))
    assert "\n" not in str(caught.value)


def test_vertices_in_another_order_are_named(bare) -> None:
    """5023 vertices of something else: the ids mean nothing there."""
    order = torch.from_numpy(np.random.default_rng(0).permutation(5023))
    with pytest.raises(HeadModelError, match="rings are .* mm apart|no open loop"):
        add_mouth(replace(bare, template=bare.template[order]))
    cut = replace(bare, faces=bare.faces[4000:], uv_faces=bare.uv_faces[4000:])
    with pytest.raises(HeadModelError, match="no open loop of 32 vertices"):
        add_mouth(cut)


@pytest.mark.parametrize("deviations", [-6.0, 6.0])
def test_far_identities_and_wide_jaws_stay_finite(path, deviations) -> None:
    model = load_flame(path)
    shape = torch.full((1, model.shape_dirs.shape[2]), deviations)
    expression = torch.full((1, model.expression_dirs.shape[2]), deviations)
    jaw = torch.tensor([[np.pi, 0.0, 0.0]], dtype=torch.float32)
    vertices = pose(model, shape, expression, jaw=jaw)
    assert torch.isfinite(vertices).all()
    assert torch.isfinite(vertex_normals(vertices, model.faces)).all()
