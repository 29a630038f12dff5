"""The head model's posing against forward kinematics written by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.errors import HeadModelError
from express50.head.model import check_head, landmarks, pose, vertex_normals
from tests.express50.head.tiny_head import pose_by_hand, rodrigues, tiny_head


def random_arguments(seed: int, scale: float = 1.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "shape": rng.normal(size=5), "expression": rng.normal(size=4),
        "angles": rng.normal(size=(5, 3)) * scale, "translation": rng.normal(size=3),
        "offsets": rng.normal(size=(40, 3)) * 0.01,
    }  # fmt: skip


def pose_of(model, arguments: dict[str, np.ndarray]) -> torch.Tensor:
    a = {name: torch.from_numpy(value)[None] for name, value in arguments.items()}
    angles = a["angles"]
    return pose(
        model, a["shape"], a["expression"], neck=angles[:, 1], jaw=angles[:, 2],
        eyes=angles[:, 3:].reshape(1, 6), root=angles[:, 0], translation=a["translation"],
        offsets=a["offsets"],
    )[0]  # fmt: skip


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), scale=st.sampled_from([0.0, 1e-6, 0.3, 1.5, 4.0]))
def test_pose_matches_forward_kinematics_by_hand(seed: int, scale: float) -> None:
    model, arguments = tiny_head(), random_arguments(seed, scale)
    by_hand = pose_by_hand(model, **arguments)
    np.testing.assert_allclose(pose_of(model, arguments).numpy(), by_hand, atol=1e-9)


def test_missing_arguments_are_zero_and_batches_are_independent() -> None:
    model = tiny_head()
    shape = torch.randn(3, 5, dtype=torch.float64)
    expression = torch.zeros(3, 4, dtype=torch.float64)
    together = pose(model, shape, expression)
    for index in range(3):
        alone = pose(
            model, shape[index : index + 1], expression[:1], neck=torch.zeros(1, 3).double()
        )
        torch.testing.assert_close(together[index], alone[0], rtol=0, atol=1e-14)


def test_root_rotates_about_the_root_joint() -> None:
    """As in SMPL and FLAME: rotating the root turns the mesh about J[0], not about the origin."""
    model = tiny_head()
    zero = torch.zeros(1, 5, dtype=torch.float64), torch.zeros(1, 4, dtype=torch.float64)
    turn = torch.tensor([[0.4, -0.7, 1.1]], dtype=torch.float64)
    rest, turned = pose(model, *zero)[0].numpy(), pose(model, *zero, root=turn)[0].numpy()
    joint = (model.joint_regressor @ model.template)[0].numpy()
    R = rodrigues(turn[0].numpy())
    np.testing.assert_allclose(turned, (rest - joint) @ R.T + joint, atol=1e-12)


def test_jaw_rotation_moves_only_what_hangs_on_the_jaw() -> None:
    model = tiny_head()
    weights = torch.zeros_like(model.skinning)
    weights[:, 1] = 1.0
    weights[7] = torch.tensor([0, 0, 1.0, 0, 0])
    model = dataclasses.replace(
        model, skinning=weights, pose_dirs=torch.zeros_like(model.pose_dirs)
    )
    zero = torch.zeros(1, 5, dtype=torch.float64), torch.zeros(1, 4, dtype=torch.float64)
    jaw = torch.tensor([[0.3, 0.0, 0.0]], dtype=torch.float64)
    moved = (pose(model, *zero, jaw=jaw) - pose(model, *zero))[0].norm(dim=1) > 1e-12
    assert moved.nonzero().flatten().tolist() == [7]


def test_gradients_match_finite_differences() -> None:
    model = tiny_head(vertices=12)
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    def function(shape, expression, neck, jaw, eyes, root, offsets):
        posed = pose(model, shape, expression, neck, jaw, eyes, root, None, offsets)
        return landmarks(model, posed)[:, ::9], vertex_normals(posed, model.faces)

    inputs = (
        draw(2, 5),
        draw(2, 4),
        draw(2, 3),
        draw(2, 3),
        draw(2, 6),
        draw(2, 3),
        draw(1, 12, 3),
    )
    assert torch.autograd.gradcheck(function, inputs)


@pytest.mark.parametrize(
    "change", [{"shape": (1, 6)}, {"expression": (1, 5)}, {"neck": (1, 4)}, {"eyes": (1, 3)}]
)
def test_wrong_shapes_are_named(change: dict[str, tuple[int, int]]) -> None:
    arguments = {"shape": torch.zeros(1, 5).double(), "expression": torch.zeros(1, 4).double()}
    name, shape = next(iter(change.items()))
    with pytest.raises(ValueError, match=name):
        pose(tiny_head(), **{**arguments, name: torch.zeros(shape).double()})


def test_landmarks_are_convex_combinations_of_their_corners() -> None:
    model = tiny_head()
    marks = landmarks(model, model.template[None])[0]
    corners = model.template[model.faces[model.landmark_faces]]
    expected = torch.einsum("pc,pcd->pd", model.landmark_bary, corners)
    torch.testing.assert_close(marks, expected)


def test_normals_of_a_sphere_point_outwards() -> None:
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = torch.from_numpy(np.asarray(sphere.vertices))[None]
    normals = vertex_normals(vertices, torch.from_numpy(np.asarray(sphere.faces)))
    assert (normals * vertices).sum(-1).min() > 0.999


def test_moving_the_model_keeps_integers_and_masks() -> None:
    model = tiny_head().to("cpu", torch.float32)
    assert model.dtype == torch.float32
    assert model.faces.dtype == torch.int64
    assert model.regions["lips"].dtype == torch.bool


def test_construction_and_values_are_checked() -> None:
    model = tiny_head()
    with pytest.raises(HeadModelError, match="skinning has shape"):
        dataclasses.replace(model, skinning=model.skinning[:-1])
    bad = model.template.clone()
    bad[3, 1] = float("nan")
    with pytest.raises(HeadModelError, match="template holds NaN"):
        check_head(dataclasses.replace(model, template=bad))
    with pytest.raises(HeadModelError, match="sum to 1"):
        check_head(dataclasses.replace(model, skinning=2 * model.skinning))
    with pytest.raises(HeadModelError, match="faces holds indices"):
        check_head(dataclasses.replace(model, faces=model.faces + 1))
