from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.transforms_torch import axis_angle_to_matrix, matrix_to_quat
from express50.head.load import load_head
from grmm.data import HeadViews
from grmm.head_crop import crop_view, draw_window, gaussian_window, head_window, neck_cut
from grmm.model import GRMM
from grmm.render import orbit
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture(scope="module")
def source():
    return EllipsoidSource(size=64)


@pytest.fixture(scope="module")
def scene():
    """A model away from its start, its Gaussians and colours, and a camera twice as wide."""
    torch.manual_seed(0)
    views = HeadViews(EllipsoidSource(size=96), ellipsoid_head())
    config = tiny_config()
    model = GRMM(config.model, views.head, ("S000",), ("e0",))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.02 * torch.randn(parameter.shape)
        item = views.item(0)
        gaussians = model.geometry(*model.codes(0, 0), item.state)
        colours = model.appearance(model.z_id[0], item.state, item.view)
    shift = torch.tensor([[0, 0, 48.0], [0, 0, 48.0], [0, 0, 0]], dtype=torch.float64)
    return (
        model,
        gaussians,
        colours,
        replace(item.view, K=item.view.K + shift, width=192, height=192),
    )


@settings(deadline=None, max_examples=25, derandomize=True)
@given(
    yaw=st.floats(-180, 180),
    dx=st.floats(-150, 150),
    dy=st.floats(-150, 150),
    zoom=st.floats(0.1, 3),
)
def test_window_draws_what_the_whole_image_shows(scene, yaw, dx, dy, zoom):
    """The saving: colours before refinement, depth and alpha are the same numbers everywhere."""
    model, gaussians, colours, view = scene
    K = view.K.clone()
    K[:2, :2] *= zoom
    K[0, 2], K[1, 2] = K[0, 2] + dx, K[1, 2] + dy
    view = orbit(replace(view, K=K), yaw, model.head_centre)
    with torch.no_grad():
        whole = model.draw(gaussians, colours, view, 0.25)
        window = draw_window(model, gaussians, colours, view, 0.25)
    assert window.image.shape == (3, 192, 192)
    for a, b in ((window.rgb, whole.rgb), (window.alpha, whole.alpha)):
        # Rounding takes a few pixels to the other side of alpha = 1/255, where blending begins.
        off = (a - b).abs()
        assert float(off.max()) < 5e-3 and float((off > 1e-5).float().mean()) < 1e-3


def test_window_is_smaller_and_refines_alike_inside(scene):
    model, gaussians, colours, view = scene
    rows, columns = gaussian_window(gaussians, view)
    assert rows.stop - rows.start < 192 and columns.stop - columns.start < 192
    with torch.no_grad():
        out = draw_window(model, gaussians, colours, view, 0.25)
        part = model.draw(gaussians, colours, crop_view(view, rows, columns), 0.25)
    assert torch.equal(out.image[:, rows, columns], part.image)
    outside = torch.ones(192, 192, dtype=torch.bool)
    outside[rows, columns] = False
    assert bool((out.image[:, outside] == 0.25).all()) and float(out.depth[outside].max()) == 0


def test_nothing_in_view_is_background(scene):
    model, gaussians, colours, view = scene
    behind = view.cam_from_head.clone()
    behind[2, 3] = -5.0
    with torch.no_grad():
        out = draw_window(
            model, gaussians, colours, replace(view, cam_from_head=behind), 0.25, refine=False
        )
    assert bool((out.rgb == 0.25).all()) and float(out.alpha.max()) == 0


def test_window_shows_the_same_picture():
    """The saving: render and compare a window only. The same numbers come out inside it."""
    views = HeadViews(EllipsoidSource(size=256), ellipsoid_head())
    config = tiny_config(model={"refine_widths": ()})
    model = GRMM(config.model, views.head, ("S000",), ("e0",))
    whole, part = views.item(0), views.item(0, crop=True)
    assert part.view.width < whole.view.width
    rows, columns = head_window(whole.state.vertices, whole.view, views.sample(0).alpha)
    with torch.no_grad():
        a = model(0, 0, whole.state, whole.view).rgb
        b = model(0, 0, part.state, part.view).rgb
    torch.testing.assert_close(a[:, rows, columns], b, atol=1e-5, rtol=0)
    assert torch.equal(whole.target[:, rows, columns], part.target)
    outside = torch.ones(256, 256, dtype=torch.bool)
    outside[rows, columns] = False
    assert float(whole.target[:, outside].max()) == 0 and float(a[:, outside].max()) < 1 / 255


def test_window_of_a_head_outside_the_image_is_the_image(views):
    item = views.item(0)
    away = replace(item.view, K=item.view.K + torch.tensor([[0, 0, 900.0], [0, 0, 900], [0, 0, 0]]))
    rows, columns = head_window(item.state.vertices, away, np.zeros((64, 64), np.uint8), 8)
    assert (rows, columns) == (slice(0, 64), slice(0, 64))


def test_window_of_a_head_behind_the_camera_holds_the_matte(views):
    item = views.item(0)
    behind = item.view.cam_from_head.clone()
    behind[2, 3] = -5.0
    alpha = np.zeros((64, 64), np.uint8)
    alpha[40:44, 10:30] = 255
    view = replace(item.view, cam_from_head=behind)
    rows, columns = head_window(item.state.vertices, view, alpha, 2)
    assert (rows, columns) == (slice(26, 58), slice(4, 36))


def test_crop_moves_the_principal_point(views):
    view = crop_view(views.item(0).view, slice(3, 20), slice(5, 40))
    whole = views.item(0).view
    assert (view.width, view.height) == (35, 17)
    assert float(whole.K[0, 2] - view.K[0, 2]) == 5 and float(whole.K[1, 2] - view.K[1, 2]) == 3


def test_gaussians_end_at_a_straight_cut_of_the_neck_whatever_the_pose():
    head = load_head("procedural")
    end = head.template[head.regions["boundary"]].mean(0)
    heights = torch.tensor([-0.02, 0.015, 0.0205, 0.027, 0.06])
    means = end + heights[:, None] * torch.tensor([0.0, 1.0, -0.0462])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(5, 4)
    scales = torch.tensor([[0.002, 0.005, 0.001]]).expand(5, 3)
    share = neck_cut(head, head.template, means, quats, scales)
    assert share[:3].tolist() == [0, 0, 0] and float(share[4]) == 1
    assert 0.6 < float(share[3]) < 0.8  # 7 of the 10 mm that two deviations reach down
    turn = axis_angle_to_matrix(torch.tensor([[0.4, -0.8, 0.3]]))
    moved = (points @ turn[0].T + 0.2 for points in (head.template, means))
    again = neck_cut(head, *moved, matrix_to_quat(turn).expand(5, 4), scales)
    torch.testing.assert_close(again, share, atol=1e-3, rtol=0)
    bare = replace(head, regions={})
    assert bool((neck_cut(bare, head.template, means, quats, scales) == 1).all())
