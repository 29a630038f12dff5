"""The built-in head at rest: topology, UV, landmarks, regions, skinning."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from express50.head.generator.head import procedural_mesh, stored_people, write_builtin
from express50.head.load import BUILTIN
from express50.head.model import REGIONS, landmarks_of
from tests.express50.head.test_mouth import covered


@pytest.fixture(scope="module")
def points(head):
    return landmarks_of(head)


def edges_of(faces):
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(edges, 1), axis=0, return_counts=True)


def test_has_the_size_of_an_adult_head(head):
    vertices = head.template.numpy()
    skin = ~(head.regions["neck"] | head.regions["left_ear"] | head.regions["right_ear"]).numpy()
    size = np.ptp(vertices[skin], axis=0)
    assert 0.145 < size[0] < 0.172
    assert 0.222 < size[1] < 0.240
    assert 0.195 < size[2] < 0.220, size  # with the nose
    eyes = [vertices[head.regions[f"{s}_eyeball"].numpy()].mean(0) for s in ("left", "right")]
    assert np.linalg.norm(eyes[0] - eyes[1]) == pytest.approx(0.064, abs=5e-4)


def test_has_the_promised_number_of_parts(head):
    assert 5000 <= len(head.template) <= 8000
    assert len(head.shape_names) >= 60 and len(head.expression_names) >= 60
    assert len(set(head.shape_names)) == len(head.shape_names)
    assert len(set(head.expression_names)) == len(head.expression_names)


def test_every_edge_is_manifold_and_only_collar_and_lids_are_open(head):
    mesh = procedural_mesh()
    edges, counts = edges_of(head.faces.numpy())
    assert counts.max() == 2
    open_vertices = set(np.unique(edges[counts == 1]))
    gums = mesh.tag("upper_gums"), mesh.tag("lower_gums")
    teeth = mesh.tag("upper_teeth"), mesh.tag("lower_teeth"), mesh.tag("tongue")
    allowed = np.concatenate([mesh.tag("collar"), mesh.tag("lid_hidden"), *gums, *teeth])
    assert open_vertices <= set(allowed)
    assert set(mesh.tag("collar")) <= open_vertices


def test_winding_is_outward_and_consistent(head):
    faces = head.faces.numpy()
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    vertices = head.template.double().numpy()
    for ball in ("left_eyeball", "right_eyeball"):
        part = faces[head.regions[ball].numpy()[faces].all(1)]
        a, b, c = (vertices[part[:, k]] for k in range(3))
        volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6  # closed: any origin will do
        assert volume == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=0.05)
    # Behind the ears the skin may fold.
    ears = vertices[(head.regions["left_ear"] | head.regions["right_ear"]).numpy()]
    clear = cKDTree(ears).query(vertices)[0] > 0.02
    scalp = faces[(head.regions["scalp"].numpy() & clear)[faces].all(1)]
    a, b, c = (vertices[scalp[:, k]] for k in range(3))
    outward = ((a + b + c) / 3 - [0, 0.04, 0]) * np.cross(b - a, c - a)
    assert (outward.sum(1) > 0).all()


def test_is_mirror_symmetric(head):
    mesh = procedural_mesh()
    vertices = head.template.numpy()
    np.testing.assert_allclose(vertices[mesh.mirror] * [-1, 1, 1], vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.mirror[mesh.mirror], np.arange(len(vertices)))


def test_the_stored_arrays_are_those_that_the_generator_makes(head, tmp_path):
    write_builtin(tmp_path / "made.npz", stored_people())
    with np.load(tmp_path / "made.npz") as file, np.load(BUILTIN) as stored:
        made = dict(file)
        assert set(made) == set(stored)
        # A landmark between two triangles may lie in either: its place counts.
        spots = [
            np.einsum(
                "ni,nij->nj", a["landmark_bary"], a["template"][a["faces"][a["landmark_faces"]]]
            )
            for a in (made, stored)
        ]
        np.testing.assert_allclose(*spots, atol=2e-6)
        for name in made.keys() - {"landmark_bary", "landmark_faces"}:
            if made[name].dtype.kind == "f":  # other processors round differently
                np.testing.assert_allclose(made[name], stored[name], atol=2e-6)
            else:
                np.testing.assert_array_equal(made[name], stored[name])


def test_uv_charts_do_not_overlap(head):
    counts = covered(head.uv.double().numpy(), head.uv_faces.numpy(), 2048)
    assert counts.max() == 1
    assert (counts == 1).mean() > 0.6


def test_uv_gives_every_part_some_area(head):
    uv, faces = head.uv.double().numpy()[head.uv_faces.numpy()], head.faces.numpy()
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
    assert area.min() > 0
    wanted = {"left_eyeball": 0.015, "tongue": 0.01, "teeth": 0.01, "mouth_interior": 0.015,
              "left_ear": 0.02, "face": 0.2}  # fmt: skip
    for region, least in wanted.items():
        of_region = head.regions[region].numpy()[faces].all(1)
        assert area[of_region].sum() > least, region


def test_landmarks_are_on_the_right_sides(points):
    right = [*range(8), *range(17, 22), 31, 32, *range(36, 42), 48, 49, 50, 58, 59, 60, 61, 67]
    left = [*range(9, 17), *range(22, 27), 34, 35, *range(42, 48), 52, 53, 54, 55, 56, 63, 64, 65]
    middle = [8, 27, 28, 29, 30, 33, 51, 57, 62, 66]
    assert (points[right, 0] < -0.001).all()
    assert (points[left, 0] > 0.001).all()
    np.testing.assert_allclose(points[middle, 0], 0, atol=1.5e-3)


def test_landmarks_go_down_the_face(points):
    groups = [range(17, 27), range(36, 48), range(31, 36), [51], [62], [57], [8]]
    heights = [points[list(g), 1] for g in groups]
    assert all(a.min() > b.max() for a, b in zip(heights, heights[1:], strict=False))
    assert (np.diff(points[27:31, 1]) < 0).all()
    assert (np.diff(points[:9, 1]) < 0).all() and (np.diff(points[8:17, 1]) > 0).all()
    assert points[30, 2] == points[:, 2].max()


def test_lids_and_lips_run_as_ibug_says(points):
    for first in (36, 42):
        eye = points[first : first + 6]
        assert eye[0, 0] < eye[1, 0] < eye[2, 0] < eye[3, 0]
        assert eye[1, 1] > eye[5, 1] and eye[2, 1] > eye[4, 1]
    assert (np.diff(points[48:55, 0]) > 0).all() and (np.diff(points[54:60, 0]) < 0).all()
    assert (np.diff(points[60:65, 0]) > 0).all() and (np.diff(points[64:68, 0]) < 0).all()


def test_regions_are_complete_and_disjoint(head):
    masks = {name: mask.numpy() for name, mask in head.regions.items()}
    assert set(REGIONS) <= set(masks)
    assert all(mask.any() for mask in masks.values())
    whole = ("face", "neck", "scalp", "left_ear", "right_ear", "left_eyeball", "right_eyeball",
             "teeth", "tongue", "mouth_interior")  # fmt: skip
    assert (sum(masks[name].astype(int) for name in whole) == 1).all()
    assert (masks["upper_teeth"] ^ masks["lower_teeth"])[masks["teeth"]].all()
    for inner in ("forehead", "nose", "lips", "left_eye_region", "right_eye_region"):
        assert masks["face"][masks[inner]].all(), inner
    assert not (masks["lips"] & masks["nose"]).any()


def test_skinning_rows_sum_to_one_and_change_smoothly(head):
    weights = head.skinning.double().numpy()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    assert weights.min() >= 0
    edges, _ = edges_of(head.faces.numpy())
    ends = head.template.double().numpy()[edges]
    millimetres = 1e3 * np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    jump = np.abs(weights[edges[:, 0]] - weights[edges[:, 1]]).sum(1)
    plain = (head.regions["neck"] | head.regions["scalp"]).numpy()[edges].all(1)
    assert (jump / millimetres)[plain].max() < 0.07
    assert jump.max() < 1.0


def test_joints_are_regressed_where_they_belong(head):
    joints = (head.joint_regressor @ head.template).numpy()
    np.testing.assert_allclose(joints[3], [0.032, 0.02, 0.07], atol=1e-4)
    np.testing.assert_allclose(joints[:3, 0], 0, atol=1e-5)
    assert joints[0, 1] < joints[1, 1] < joints[2, 1]


def test_contour_candidates_lie_on_their_own_side(head):
    assert head.contour is not None and len(head.contour) == 17
    x = head.template[:, 0].numpy()
    assert all((x[line.numpy()] <= 1e-6).all() for line in head.contour[:8])
    assert all((x[line.numpy()] >= -1e-6).all() for line in head.contour[9:])
