"""Head posing at the extremes: turns of 0, pi and beyond, tiny and huge numbers, half precision."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from express50.head.model import pose, vertex_normals
from tests.express50.head.tiny_head import pose_by_hand, tiny_head

ANGLES = [0.0, 1e-12, 1e-4, math.pi - 1e-9, math.pi, math.pi + 1e-6, 2 * math.pi, 20.0, 1e4]


def zeros(batch: int = 1, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(batch, 5, dtype=dtype), torch.zeros(batch, 4, dtype=dtype)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("part", ["root", "neck", "jaw"])
def test_any_turn_matches_the_hand_written_one_and_has_a_gradient(part: str, angle: float) -> None:
    model = tiny_head()
    turn = torch.tensor([[0.0, angle * 0.6, angle * 0.8]], dtype=torch.float64, requires_grad=True)
    posed = pose(model, *zeros(), **{part: turn})
    posed.square().sum().backward()
    assert torch.isfinite(turn.grad).all()
    angles = np.zeros((5, 3))
    angles[{"root": 0, "neck": 1, "jaw": 2}[part]] = turn.detach().numpy()[0]
    if angle <= 20:
        by_hand = pose_by_hand(model, np.zeros(5), np.zeros(4), angles, np.zeros(3), 0.0)
        np.testing.assert_allclose(posed.detach().numpy()[0], by_hand, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_precisions_agree_with_double(dtype: torch.dtype) -> None:
    model = tiny_head()
    arguments = {"jaw": torch.tensor([[0.3, 0.1, 0.0]]), "neck": torch.tensor([[0.0, 3.1, 0.2]])}
    exact = pose(model, *zeros(), **{k: v.double() for k, v in arguments.items()})
    cast = {k: v.to(dtype) for k, v in arguments.items()}
    got = pose(model.to(dtype=dtype), *zeros(dtype=dtype), **cast)
    assert got.dtype == dtype
    tolerance = {torch.float16: 5e-3, torch.float32: 1e-6, torch.float64: 1e-14}[dtype]
    torch.testing.assert_close(got.double(), exact, atol=tolerance, rtol=0)


def test_a_kilometre_away_keeps_a_tenth_of_a_millimetre_in_double() -> None:
    model = tiny_head()
    far = torch.tensor([[1000.0, -1000.0, 500.0]], dtype=torch.float64)
    near = pose(model, *zeros())
    torch.testing.assert_close(
        pose(model, *zeros(), translation=far) - far, near, atol=1e-12, rtol=0
    )


def test_an_empty_batch_and_no_coefficients() -> None:
    model = tiny_head()
    none = torch.zeros(0, 5, dtype=torch.float64), torch.zeros(0, 4, dtype=torch.float64)
    assert pose(model, *none).shape == (0, 40, 3)
    bare = pose(model, torch.zeros(1, 0).double(), torch.zeros(1, 0).double())
    torch.testing.assert_close(bare, pose(model, *zeros()))


@pytest.mark.parametrize("scale", [1e-30, 1e-8, 1.0, 1e8])
def test_normals_of_tiny_and_huge_faces_are_unit(scale: float) -> None:
    faces = torch.tensor([[0, 1, 2]])
    vertices = scale * torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    torch.testing.assert_close(
        vertex_normals(vertices, faces)[0, 0], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_degenerate_faces_give_zero_normals_and_finite_gradients(dtype: torch.dtype) -> None:
    faces = torch.tensor([[0, 1, 2], [0, 0, 0]])
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]], dtype=dtype)
    line.requires_grad_()
    normals = vertex_normals(line, faces)
    assert (normals == 0).all()
    normals.sum().backward()
    assert torch.isfinite(line.grad).all()
