import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.errors import ConfigError, UnknownNameError
from express50.geometry.meshes import split_seams
from express50.head.model import normals_of
from grmm.checkpoint import load_checkpoint
from grmm.edit import (
    between,
    controlled,
    principal_directions,
    sample_expression,
    sample_identity,
    trained_head,
    with_expression,
)
from grmm.export import decoded, write_export
from grmm.render import (
    camera_of,
    control_sheet,
    frontal,
    novel_views,
    orbit,
    picture,
    residual_sheet,
    resized,
    sample_sheet,
    with_room,
)
from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    source = EllipsoidSource(subjects=3, expressions=3, size=32)
    train(source, ellipsoid_head(), out, tiny_config())
    return load_checkpoint(out / "checkpoint.pt")


def test_transfer_takes_all_of_the_expression_and_none_of_the_identity(loaded):
    a, b = trained_head(loaded, "S000", "e0"), trained_head(loaded, "S001", "e2")
    moved = with_expression(a, b)
    assert torch.equal(moved.z_id, a.z_id) and torch.equal(moved.z_exp, b.z_exp)
    assert moved.tracked.shape is a.tracked.shape
    assert moved.tracked.expression is b.tracked.expression


def test_blending_meets_both_ends(loaded):
    a, b = trained_head(loaded, "S000", "e0"), trained_head(loaded, "S001", "e2")
    b = controlled(loaded, b, {"jaw.0": (0.4,), "shape.1": (2.0,)})
    for t, end in ((0.0, a), (1.0, b)):
        got = between(a, b, t)
        torch.testing.assert_close((got.z_id, got.z_exp), (end.z_id, end.z_exp))
        for name in ("shape", "expression", "neck", "jaw", "eyes"):
            expected = getattr(end.tracked, name)
            np.testing.assert_allclose(getattr(got.tracked, name), expected, atol=1e-7)
    third = between(a, b, 0.3)
    assert third.tracked.jaw[0] == pytest.approx(0.12)
    torch.testing.assert_close(third.z_id, 0.7 * a.z_id + 0.3 * b.z_id)


@pytest.mark.parametrize(
    ("name", "values", "field", "expected"),
    [
        ("jaw", (0.3, 0.0, 0.1), "jaw", [0.3, 0, 0.1]),
        ("neck.1", (0.2,), "neck", [0, 0.2, 0]),
        ("eyes", (0.0, 0.4, 0.0), "eyes", [0, 0.4, 0, 0, 0.4, 0]),
        ("expression.e3", (0.7,), "expression", [1, 0, 0, 0.7]),
        ("expression.1", (0.5,), "expression", [1, 0.5, 0, 0]),
        ("shape.2", (-1.0,), "shape", [0, 0, -1]),
    ],
)
def test_a_control_changes_one_parameter(loaded, name, values, field, expected):
    head = trained_head(loaded, "S000", "e1")
    got = controlled(loaded, head, {name: values})
    np.testing.assert_allclose(getattr(got.tracked, field), expected)
    others = set(vars(head.tracked)) - {field}
    assert all(getattr(got.tracked, other) is getattr(head.tracked, other) for other in others)
    assert got.z_id is head.z_id and got.z_exp is head.z_exp


def test_codes_move_alone(loaded):
    head = trained_head(loaded, "S000", "e1")
    got = controlled(loaded, head, {"z_exp": (0.0,), "z_id.1": (2.0,)})
    assert not got.z_exp.any() and got.tracked is head.tracked
    moved = (got.z_id - head.z_id).double()
    torch.testing.assert_close(moved, 2 * principal_directions(loaded.model.z_id)[1].double())


def test_principal_directions_rebuild_the_covariance(loaded):
    codes = loaded.model.z_id.detach().double()
    directions = principal_directions(codes)
    assert directions.shape == (2, codes.shape[1])  # three subjects
    torch.testing.assert_close(directions.T @ directions, torch.cov(codes.T), atol=1e-12, rtol=1e-9)
    assert principal_directions(codes[:1]).shape == (0, codes.shape[1])


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        ({"jwa": (1.0,)}, "did you mean 'jaw'"),
        ({"e3": (1.0,)}, "did you mean 'expression.e3'"),
        ({"jawOpen": (1.0,)}, "did you mean 'jaw.0'"),
        ({"expression.jawOpen": (1.0,)}, "did you mean 'jaw.0'"),
        ({"jaw": (1.0,)}, "got 1 number, expected 3 with commas between, or jaw.0"),
        ({"jaw.0": (1.0, 2.0)}, "jaw.0: got 2 numbers, expected 1$"),
        ({"z_id": (1.0, 2.0)}, "z_id: got 2 numbers, expected 1$"),
        ({"neck.3": (1.0,)}, r"none of the neck parameters \(3\); expected 0 to 2$"),
        ({"expression.nope": (1.0,)}, "0 to 3, or a name such as e0, e1, e2 and 1 more$"),
        ({"expression.E3x": (1.0,)}, "did you mean 'e3'"),
        ({"expression": (1.0,)}, "expected one entry"),
        ({"z_id.2": (1.0,)}, r"directions of 3 training codes \(2\); expected 0 to 1$"),
        ({"jaw.0": (float("nan"),)}, "jaw.0: got nan, expected -1000 to 1000"),
        ({"shape.0": (1e30,)}, r"shape.0: got 1e\+30, expected -1000 to 1000"),
    ],
)
def test_wrong_controls_are_named(loaded, controls, message):
    with pytest.raises(ConfigError, match=message):
        controlled(loaded, trained_head(loaded, "S000", "e0"), controls)
    with pytest.raises(ConfigError, match="S9"):
        trained_head(loaded, "S9", "e0")


@pytest.mark.parametrize(
    ("people", "words"),
    [(1, r"of 1 training code \(0\); one person .* has none$"), (2, r"\(1\); expected 0$")],
)
def test_few_codes_have_few_directions_to_move_along(loaded, people, words):
    few = copy.deepcopy(loaded)
    few.model.z_id = torch.nn.Parameter(few.model.z_id[:people].detach())
    with pytest.raises(ConfigError, match=words):
        controlled(few, trained_head(few, "S000", "e0"), {"z_id.999": (1.0,)})


def test_samples_have_the_mean_and_covariance_of_training(loaded):
    head = trained_head(loaded, "S000", "e0")
    rng = np.random.default_rng(0)
    drawn = torch.stack(
        [sample_identity(loaded, head, rng, 1.0).z_id for _ in range(4000)]
    ).double()
    codes = loaded.model.z_id.detach().double()
    spread = float(torch.cov(codes.T).diagonal().sum())
    assert float((drawn.mean(0) - codes.mean(0)).square().sum()) < 4e-3 * spread
    gap = torch.cov(drawn.T) - torch.cov(codes.T)
    assert float(gap.norm()) < 0.1 * spread


def test_sampled_expressions_stay_within_training_and_keep_the_person(loaded):
    head = trained_head(loaded, "S000", "e0")
    rng = np.random.default_rng(0)
    drawn = [sample_expression(loaded, head, rng, 3.0) for _ in range(20)]
    values = np.array([one.tracked.expression[0] for one in drawn])
    assert values.min() >= 0 and values.max() <= 2 and values.std() > 0.1  # e0, e1, e2
    assert all(one.z_id is head.z_id for one in drawn)


def test_orbit_keeps_its_distance_and_sees_from_above(loaded):
    view, centre = frontal(loaded), loaded.model.head_centre.double()
    up, turned = orbit(view, 0, centre, pitch=30), orbit(view, 90, centre)
    torch.testing.assert_close(orbit(turned, -90, centre).cam_from_head, view.cam_from_head)

    def eye(v):
        return -v.cam_from_head[:3, :3].T @ v.cam_from_head[:3, 3] - centre

    assert float(eye(up)[1]) > float(eye(view)[1]) + 0.1
    torch.testing.assert_close(eye(up).norm(), eye(view).norm())
    torch.testing.assert_close(eye(turned).norm(), eye(view).norm())
    seen = up.cam_from_head[:3, :3] @ centre + up.cam_from_head[:3, 3]
    before = view.cam_from_head[:3, :3] @ centre + view.cam_from_head[:3, 3]
    torch.testing.assert_close(seen, before)


@pytest.mark.parametrize("name", ["cam09", ""])
def test_a_camera_that_the_checkpoint_lacks_is_refused(loaded, name):
    with pytest.raises(UnknownNameError, match="cam00"):
        camera_of(loaded, name)
    assert torch.equal(camera_of(loaded, None).cam_from_head, frontal(loaded).cam_from_head)


def test_a_picture_that_ends_beside_the_ears_is_widened_for_turned_heads(loaded):
    view, centre = frontal(loaded), loaded.model.head_centre.double()
    K = view.K.clone()
    K[0, 2] -= 2 * view.width // 5
    tight = replace(view, K=K, width=view.width // 5)
    wide = with_room(tight, loaded)
    for yaw in (-60, 0, 60):
        (first, last), (cut, _) = (ends(loaded, orbit(v, yaw, centre)) for v in (wide, tight))
        assert first > -1 and last < wide.width + 1 and cut < -1
    again = with_room(wide, loaded)
    assert again.width == wide.width and torch.equal(again.K, wide.K)


def ends(loaded, view):
    """The first and the last column of the head's template in a view."""
    pose, places = view.cam_from_head.double(), loaded.head.template.double()
    seen = (places @ pose[:3, :3].T + pose[:3, 3]) @ view.K.double().T
    columns = seen[:, 0] / seen[:, 2]
    return float(columns.min()), float(columns.max())


def test_pictures_of_another_size_show_the_same(loaded):
    head, view = trained_head(loaded, "S000", "e0"), frontal(loaded)
    large = picture(loaded, head, resized(view, 64)).astype(float)
    small = picture(loaded, head, view).astype(float)
    assert large.shape == (64, 64, 3)
    halved = large.reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(halved - small).mean() < 6


def test_sheets_have_a_row_for_everything(loaded):
    head, view = trained_head(loaded, "S000", "e0"), frontal(loaded)
    rows, labels, _ = control_sheet(loaded, head, view)
    joints = ["jaw: 0 to 0.35 rad", "neck, yaw: -0.35 to 0.35 rad", "eyes, yaw: -0.4 to 0.4 rad"]
    assert labels[:3] == joints and "z_exp.0: -1.5 to 1.5" in labels
    stretched = rows[next(i for i, label in enumerate(labels) if label.startswith("e0: 0 to "))]
    assert not np.array_equal(stretched[0], stretched[-1])
    (pictures,), _, captions = residual_sheet(
        loaded, head, trained_head(loaded, "S001", "e2"), view
    )
    assert len(pictures) == len(captions) == 6
    rows, _, _ = sample_sheet(loaded, head, view, 2, seed=1)
    again, _, _ = sample_sheet(loaded, head, view, 2, seed=1)
    assert [len(row) for row in rows] == [2, 2, 2]
    np.testing.assert_array_equal(rows[2][1], again[2][1])
    rows, labels, captions = novel_views(loaded, head, view)
    assert len(rows) == len(labels) == 3 and len(rows[0]) == len(captions) == 5


def test_glb_holds_the_mesh_with_its_texture(loaded, tmp_path):
    import trimesh

    head, view = trained_head(loaded, "S001", "e1"), frontal(loaded)
    for name in ("a.glb", "b.glb"):
        write_export(tmp_path / name, loaded, head, view, "glb")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    (mesh,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    _, vertices, colours = decoded(loaded, head, view)
    centres = vertices[loaded.head.faces].mean(1)
    np.testing.assert_allclose(mesh.triangles.mean(1), centres, atol=1e-6)
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(texture, colours)
    # Viewers must draw facets where a file has no normals; along a seam, both sides share one.
    head_model = loaded.head
    places, _, _ = split_seams(head_model.faces.numpy(), head_model.uv_faces.numpy())
    smooth = normals_of(vertices, head_model.faces)[places]
    np.testing.assert_allclose(mesh.vertex_normals, smooth, atol=1e-5)


def test_texels_without_a_face_have_the_nearest_ones_colour(tmp_path):
    """Their mean colour showed as a line along the seam of dark hair."""
    config = tiny_config(model={"mouth": False}, train={"iterations": 1})
    train(EllipsoidSource(size=32), ellipsoid_head(), tmp_path, config)
    loaded = load_checkpoint(tmp_path / "checkpoint.pt")
    _, _, texture = decoded(loaded, trained_head(loaded, "S001", "e1"), frontal(loaded))
    side = config.model.n_g
    covered = np.stack(np.divmod(loaded.model.texels.numpy(), side), 1)
    shown = {tuple(place) for place in covered.tolist()}
    bare = [place for place in np.ndindex(side, side) if place not in shown]
    assert 50 < len(bare) < side**2 / 2
    for place in bare:
        away = np.square(covered - place).sum(1)
        near = covered[away == away.min()]
        assert (texture[near[:, 0], near[:, 1]] == texture[place]).all(1).any()


def test_npz_holds_gaussians_mesh_and_codes(loaded, tmp_path):
    head, view = trained_head(loaded, "S001", "e1"), frontal(loaded)
    gaussians, _, _ = decoded(loaded, head, view)
    write_export(tmp_path / "a.npz", loaded, head, view, "npz")
    arrays = np.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["means"], gaussians.means)
    np.testing.assert_array_equal(arrays["z_exp"], head.z_exp.numpy())
    assert arrays["flame_jaw"].shape == (3,) and len(arrays["mesh_vertices"]) == 187
