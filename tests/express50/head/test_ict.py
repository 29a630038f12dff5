"""ICT-FaceKit's importer, on a made-up checkout of its topology and on its own arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from express50.errors import HeadModelError
from express50.head.ict import LANDMARKS, RANGES, VERTEX_COUNT, load_ict, read_obj
from express50.head.load import load_head
from express50.head.model import REGIONS, landmarks, pose


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with ICT's vertex numbering on points that form no face: quads in a strip."""
    folder = tmp_path_factory.mktemp("ict") / "FaceXModel"
    folder.mkdir()
    rng = np.random.default_rng(0)
    points = rng.uniform([-8, -16, -6], [8, 12, 12], (VERTEX_COUNT, 3))
    for side, centre in (("left", 3.2), ("right", -3.2)):
        first, end = RANGES[f"{side}_eyeball"]
        ball = rng.normal(size=(end - first, 3))
        points[first:end] = ball / np.linalg.norm(ball, axis=1)[:, None] + [centre, 3.6, 8.4]
    opened = points.copy()
    low = slice(*RANGES["lower_teeth"])
    # A jaw that turns by 0.2 rad about a hinge at y = -1, z = 1 (centimetres).
    c, s = np.cos(0.2), np.sin(0.2)
    opened[low, 1:] = (points[low, 1:] - [-1, 1]) @ np.array([[c, -s], [s, c]]).T + [-1, 1]
    faces = ["usemtl M_Face"]
    faces += [f"f {i}/1 {i + 1}/2 {i + 3}/3 {i + 2}/2" for i in range(1, VERTEX_COUNT - 3, 2)]
    head = ["vt 0.1 0.2", "vt 0.5 0.9", "vt 2.5 0.5"]
    meshes = {
        "generic_neutral_mesh": points, "jawOpen": opened, "mouthSmile_L": points + 0.1,
        "identity000": points + [1.0, 0, 0], "identity001": points + [0, 2.0, 0],
    }  # fmt: skip
    for name, mesh in meshes.items():
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh]
        (folder / f"{name}.obj").write_text("\n".join(lines + head + faces) + "\n")
    return folder.parent


def test_checkout_in_metres_with_named_directions(checkout: Path) -> None:
    model = load_ict(checkout)
    assert model.expression_names == ("jawOpen", "mouthSmile_L")
    assert model.shape_names == ("identity000", "identity001")
    np.testing.assert_allclose(model.shape_dirs[:, 0, 0].numpy(), 0.01, atol=1e-6)
    np.testing.assert_allclose(model.shape_dirs[:, 1, 1].numpy(), 0.02, atol=1e-6)
    assert model.uv.min() >= 0
    assert model.uv.max() <= 1
    assert set(REGIONS) <= set(model.regions)


def test_jaw_hinge_is_recovered_from_jaw_open(checkout: Path) -> None:
    model = load_ict(checkout)
    joints = model.joint_regressor @ model.template
    np.testing.assert_allclose(joints[2].numpy(), [0.0, -0.01, 0.01], atol=1e-4)
    np.testing.assert_allclose(joints[3, :2].numpy(), [0.032, 0.036], atol=2e-3)


def test_jaw_joint_repeats_what_jaw_open_does_to_the_teeth(checkout: Path) -> None:
    model = load_ict(checkout)
    teeth = model.regions["lower_teeth"] & (model.template[:, 1] < -0.045)
    shape, expression = torch.zeros(1, 2), torch.zeros(1, 2)
    by_shape = pose(model, shape, torch.tensor([[1.0, 0.0]]))[0, teeth]
    by_joint = pose(model, shape, expression, jaw=torch.tensor([[0.2, 0.0, 0.0]]))[0, teeth]
    assert (by_shape - by_joint).norm(dim=1).max() < 2e-4


def test_landmarks_lie_on_the_named_vertices(checkout: Path) -> None:
    model = load_ict(checkout)
    marks = landmarks(model, model.template[None])[0]
    torch.testing.assert_close(marks, model.template[list(LANDMARKS)])


def test_errors_name_the_file(checkout: Path, tmp_path: Path) -> None:
    with pytest.raises(HeadModelError, match="generic_neutral_mesh"):
        load_ict(tmp_path)
    (tmp_path / "bad.obj").write_text("v 1 2 three\nf 1 1 1\n")
    with pytest.raises(HeadModelError, match="bad.obj"):
        read_obj(tmp_path / "bad.obj")
    np.savez(tmp_path / "bad.npz", v_template=np.zeros((3, 3)))
    with pytest.raises(HeadModelError, match="has no shapedirs"):
        load_ict(tmp_path / "bad.npz")


def test_a_pickled_npz_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", **{key: np.array([{}], dtype=object) for key in (
        "v_template", "shapedirs", "exprdirs", "expression_names", "faces", "uv", "uv_faces",
        "face_material", "materials",
    )})  # fmt: skip
    with pytest.raises(HeadModelError, match="Python objects"):
        load_ict(tmp_path / "bad.npz")


def test_the_real_arrays_make_a_sensible_rig(shared) -> None:
    """On ICT-FaceKit itself: sizes of regions, joints inside the head, a jaw that opens."""
    model = load_head(str(shared("ict/ict.npz")))
    joints = (model.joint_regressor @ model.template).numpy()
    assert joints[2, 1] > model.template[LANDMARKS[8], 1] + 0.03
    np.testing.assert_allclose(joints[3], joints[4] * [-1, 1, 1], atol=1e-4)
    for name in REGIONS:
        assert model.regions[name].any(), name
    assert not (model.regions["upper_teeth"] & (model.skinning[:, 2] > 0.05)).any()
    opened = pose(model, torch.zeros(1, 1), torch.zeros(1, 1), jaw=torch.tensor([[0.3, 0.0, 0.0]]))
    marks, rest = landmarks(model, opened)[0], landmarks(model, model.template[None])[0]
    # The chin drops, the brows stay, the lips part.
    assert marks[8, 1] < rest[8, 1] - 0.015
    assert (marks[17:27] - rest[17:27]).norm(dim=1).max() < 1e-3
    assert marks[62, 1] - marks[66, 1] > 0.01
