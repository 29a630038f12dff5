"""The built-in head in motion: directions, blink, jaw, lips."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from express50.capture.expressions import load_script
from express50.geometry.cameras import pinhole_camera
from express50.geometry.raycast import visible_faces
from express50.geometry.transforms import look_at
from express50.head.generator.head import procedural_mesh
from express50.head.model import landmarks, pose
from express50.head.preview import expression_vector


def posed(head, controls=None, jaw=0.0):
    coefficients = torch.zeros(1, 1)
    expression = expression_vector(head, controls or {})
    return pose(head, coefficients, expression, jaw=torch.tensor([[jaw, 0.0, 0.0]]))[0]


def edge_strain(head, directions):
    faces = head.faces.numpy()
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]), 1), axis=0)
    ends = head.template.double().numpy()[edges]
    length = np.maximum(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), 1e-3)
    motion = directions.double().numpy()
    change = np.linalg.norm(motion[edges[:, 0]] - motion[edges[:, 1]], axis=1)
    return (change / length[:, None]).max(0)


@pytest.mark.parametrize("kind, least, most", [("shape", 2e-4, 2.0), ("expression", 5e-4, 3.5)])
def test_directions_are_finite_visible_and_smooth(head, kind, least, most):
    directions = getattr(head, f"{kind}_dirs")
    assert bool(torch.isfinite(directions).all())
    assert float(directions.norm(dim=1).amax(0).min()) > least
    assert edge_strain(head, directions).max() < most


def test_one_sided_directions_mirror_each_other(head):
    mirror = torch.from_numpy(procedural_mesh().mirror)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    pairs = [n[:-2] for n in head.expression_names if n.endswith("_L")]
    assert len(pairs) >= 15
    for name in pairs:
        left = head.expression_dirs[..., head.expression_names.index(f"{name}_L")]
        right = head.expression_dirs[..., head.expression_names.index(f"{name}_R")]
        torch.testing.assert_close(left[mirror] * flip, right, atol=1e-6, rtol=0)


def test_knows_every_control_of_the_script(head):
    used = {name for expression in load_script() for name in expression.controls}
    assert used <= set(head.expression_names)


@pytest.mark.parametrize("side", ["left", "right"])
def test_blink_shuts_the_eye_over_the_eyeball(head, side):
    mesh = procedural_mesh()
    shut = posed(head, {"eyeBlink": 1.0}).numpy()
    margin = shut[mesh.tag("lid0", side)]
    gap = np.linalg.norm(margin[1:20] - margin[:20:-1], axis=1)
    assert gap.max() < 1e-3
    center = (head.joint_regressor @ head.template)[3 if side == "left" else 4].numpy()
    for loop in range(6):
        lid = shut[mesh.tag(f"lid{loop}", side)]
        assert np.linalg.norm(lid - center, axis=1).min() > 0.0121


def seen_shares(head, vertices, regions, centre, span, yaw=0.0, pitch=0.0):
    """Shares of 160 x 160 pixels, `span` metres wide at `centre`, that see a face of a region."""
    a, b = np.radians(yaw), np.radians(pitch)
    back = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
    pose = look_at(np.array(centre) + 1.2 * back, np.array(centre))
    focal = 160 * 1.2 / span
    K = np.array([[focal, 0, 80], [0, focal, 80], [0, 0, 1.0]])
    faces = head.faces.numpy()
    face, _ = visible_faces(vertices.numpy(), faces, pinhole_camera("c", K, 160, 160, pose))
    return [(head.regions[name].numpy()[faces].all(1)[face] & (face >= 0)).mean()
            for name in regions]  # fmt: skip


def test_no_eyeball_shows_through_shut_lids(head):
    """Seen from seven sides, no pixel of a blink sees an eyeball."""
    view = {"regions": ("left_eyeball", "right_eyeball"), "centre": (0.0315, 0.02, 0.075),
            "span": 0.05}  # fmt: skip
    shut = posed(head, {"eyeBlink": 1.0})
    for yaw, pitch in ((0, 0), (25, 0), (50, 0), (-25, 0), (0, 20), (0, -20), (40, -15)):
        assert sum(seen_shares(head, shut, yaw=yaw, pitch=pitch, **view)) < 5e-4, (yaw, pitch)
    assert sum(seen_shares(head, posed(head), **view)) > 0.03


@pytest.mark.parametrize("seed", range(4))
def test_lids_stay_outside_the_eyeball_in_everyone(head, seed):
    mesh = procedural_mesh()
    person = torch.randn(1, len(head.shape_names), generator=torch.Generator().manual_seed(seed))
    vertices = pose(head, person, torch.zeros(1, 1))[0]
    center = (head.joint_regressor @ vertices)[3].numpy()
    vertices = vertices.numpy()
    ball = vertices[head.regions["left_eyeball"].numpy()]
    radius = np.linalg.norm(ball - center, axis=1).max()
    for loop in range(4):
        lid = vertices[mesh.tag(f"lid{loop}", "left")]
        assert np.linalg.norm(lid - center, axis=1).min() > radius


def test_jaw_moves_the_lower_teeth_alone(head):
    rest, opened = posed(head).numpy(), posed(head, jaw=0.36).numpy()
    moved = np.linalg.norm(opened - rest, axis=1)
    upper, lower = (head.regions[f"{row}_teeth"].numpy() for row in ("upper", "lower"))
    assert moved[upper].max() < 1e-6
    assert moved[lower].min() > 0.008
    joint = (head.joint_regressor @ head.template).numpy()[2]
    np.testing.assert_allclose(
        np.linalg.norm(opened[lower] - joint, axis=1),
        np.linalg.norm(rest[lower] - joint, axis=1),
        atol=1e-4,
    )
    assert moved[head.regions["tongue"].numpy()].min() > 0.002


def test_lips_meet_at_rest_and_part_with_the_jaw(head):
    for jaw, low, high in ((0.0, 0.0, 1e-3), (0.36, 0.018, 0.05)):
        points = landmarks(head, posed(head, jaw=jaw)[None])[0].numpy()
        assert low <= points[62, 1] - points[66, 1] <= high


def test_smile_lifts_and_widens_the_mouth(head):
    rest = landmarks(head, posed(head)[None])[0].numpy()
    smile = landmarks(head, posed(head, {"mouthSmile": 1.0})[None])[0].numpy()
    assert smile[54, 1] - rest[54, 1] > 0.005 and smile[48, 1] - rest[48, 1] > 0.005
    assert smile[54, 0] - smile[48, 0] > 1.15 * (rest[54, 0] - rest[48, 0])
    pucker = landmarks(head, posed(head, {"mouthPucker": 1.0})[None])[0].numpy()
    assert pucker[54, 0] - pucker[48, 0] < 0.8 * (rest[54, 0] - rest[48, 0])
    assert pucker[51, 2] - rest[51, 2] > 0.004


def test_expressions_leave_teeth_and_eyes_alone(head):
    fixed = head.regions["teeth"] | head.regions["left_eyeball"] | head.regions["right_eyeball"]
    jaw = {"jawForward", "jawLeft", "jawRight"}
    for index, name in enumerate(head.expression_names):
        if name not in jaw:
            assert float(head.expression_dirs[fixed][..., index].abs().max()) == 0.0, name


def test_open_mouth_shows_teeth_tongue_and_cavity(head):
    regions = ("teeth", "tongue", "mouth_interior")
    shares = seen_shares(head, posed(head, jaw=0.36), regions, (0.0, -0.06, 0.08), 0.09)
    assert min(shares) > 0.01
