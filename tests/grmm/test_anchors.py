import math

import pytest
import torch

from express50.errors import HeadModelError
from grmm.anchors import interpolate, make_anchors, tangent_frames, uv_gradients
from tests.grmm.synthetic import AXES, ellipsoid_head


@pytest.fixture(scope="module")
def head():
    return ellipsoid_head(24, 32)


def test_barycentrics_give_back_the_texel_centres(head):
    anchors = make_anchors(head, 32)
    corners = head.uv[head.uv_faces[anchors.faces]]
    uv = (corners * anchors.barycentrics[..., None]).sum(1)
    row, column = anchors.texels // 32, anchors.texels % 32
    expected = torch.stack([(column + 0.5) / 32, 1 - (row + 0.5) / 32], 1)
    torch.testing.assert_close(uv, expected, atol=1e-6, rtol=0)
    assert (anchors.barycentrics >= 0).all()


def test_only_covered_texels_get_a_gaussian(head):
    squeezed = {"uv": head.uv * torch.tensor([0.5, 1.0])}
    anchors = make_anchors(type(head)(**{**vars(head), **squeezed}), 32)
    assert len(anchors.texels) == 32 * 16
    assert (anchors.texels % 32 < 16).all()


def test_full_map_is_covered_once(head):
    anchors = make_anchors(head, 48)
    assert torch.equal(anchors.texels, torch.arange(48 * 48))


def test_the_lowest_face_wins_where_charts_overlap(head):
    folded = head.uv.clone()
    folded[:, 0] = (2 * folded[:, 0]).where(folded[:, 0] <= 0.5, 2 - 2 * folded[:, 0])
    anchors = make_anchors(type(head)(**{**vars(head), "uv": folded}), 16)
    columns = (anchors.faces % (2 * 32 * 24)) % (32 * 24) % 32
    assert (columns < 16).all()


def test_a_map_without_area_is_refused(head):
    flat = type(head)(**{**vars(head), "uv": torch.zeros_like(head.uv)})
    with pytest.raises(HeadModelError, match="n_g"):
        make_anchors(flat, 16)


def test_frames_are_rotations_with_outward_normals(head):
    frames, reach = tangent_frames(head.template, head.faces, uv_gradients(head))
    identity = torch.eye(3).expand(len(frames), 3, 3)
    torch.testing.assert_close(frames @ frames.transpose(1, 2), identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(len(frames)))
    centres = head.template[head.faces].mean(1)
    proper = reach[:, 0] > 0
    assert ((frames[:, :, 2] * centres).sum(1)[proper] > 0).all()


def test_texel_spacing_covers_the_surface(head):
    frames, reach = tangent_frames(head.template, head.faces, uv_gradients(head))
    anchors = make_anchors(head, 128)
    area = (reach[anchors.faces] / 128).prod(1).sum()
    a, b, c = (float(axis) for axis in AXES)
    p = 1.6075  # Thomsen's approximation of an ellipsoid's surface, good to 1 %
    surface = 4 * math.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p)
    assert float(area) == pytest.approx(surface, rel=0.03)


def test_triangles_without_area_get_the_identity():
    vertices = torch.zeros(3, 3)
    frames, reach = tangent_frames(vertices, torch.tensor([[0, 1, 2]]), torch.eye(2)[None])
    assert torch.equal(frames[0], torch.eye(3))
    assert torch.equal(reach, torch.zeros(1, 2))


def test_interpolation_follows_the_mesh_and_carries_gradients(head):
    anchors = make_anchors(head, 16)
    vertices = head.template.clone().requires_grad_(True)
    corners = head.faces[anchors.faces]
    points = interpolate(vertices, corners, anchors.barycentrics)
    moved = interpolate(vertices + 0.1, corners, anchors.barycentrics)
    torch.testing.assert_close(moved, points + 0.1)
    points.sum().backward()
    assert vertices.grad.sum() == pytest.approx(3 * len(points), rel=1e-5)
