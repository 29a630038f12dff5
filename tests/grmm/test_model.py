import numpy as np
import pytest
import torch

from express50.head.load import load_head
from grmm.data import HeadViews
from grmm.model import GRMM, initial_scales, quat_multiply
from grmm.train import objective, step
from grmm.train_state import prepare, set_rates
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


def build(views, **model):
    torch.manual_seed(0)
    config = tiny_config(model=model)
    return config, GRMM(config.model, views.head, ("S000", "S001"), ("e0", "e1"))


def test_the_head_turns_about_its_middle():
    """Not about its mean vertex: most of them are in the face."""
    head = load_head("procedural")
    model = GRMM(tiny_config().model, head, ["S000"], ["neutral"])
    reach = head.template - model.head_centre
    torch.testing.assert_close(reach.amax(0), -reach.amin(0))


def test_shapes(views):
    _, model = build(views)
    item = views.item(0)
    out = model(0, 0, item.state, item.view)
    assert out.image.shape == out.rgb.shape == (3, 32, 32)
    assert out.depth.shape == out.alpha.shape == (32, 32)
    count = len(model.texels)
    assert out.gaussians.means.shape == out.gaussians.scales_mm.shape == (count, 3)
    assert out.gaussians.quats.shape == (count, 4)


def test_at_the_start_all_codes_give_the_tracked_mesh(views):
    _, model = build(views)
    item = views.item(0)
    a = model.geometry(*model.codes(0, 0), item.state)
    b = model.geometry(*model.codes(1, 1), item.state)
    assert torch.equal(a.means, b.means) and torch.equal(a.opacities, b.opacities)
    assert torch.equal(a.displacement, torch.zeros_like(a.displacement))
    expected = (item.state.vertices[model.corners] * model.barycentrics[..., None]).sum(1)
    torch.testing.assert_close(a.means, expected)
    assert torch.allclose(a.opacities, torch.tensor(0.8))
    assert torch.equal(
        model(0, 0, item.state, item.view).image,
        model.draw(a, model.appearance(model.z_id[0], item.state, item.view), item.view).rgb,
    )


def test_head_frame_starts_unrotated_and_isotropic(views):
    _, model = build(views, frame="head")
    gaussians = model.geometry(*model.codes(0, 0), views.item(0).state)
    assert torch.equal(gaussians.quats, torch.tensor([[1.0, 0, 0, 0]]).expand(len(model.texels), 4))
    assert torch.equal(gaussians.scales_mm[:, 0], gaussians.scales_mm[:, 2])


@pytest.mark.parametrize("frame", ["head", "tangent"])
def test_initial_scales_are_the_texel_spacing(frame):
    config = tiny_config(model={"frame": frame, "scale_init": 1.0}).model
    raw = initial_scales(torch.tensor([[2.0, 3.0]]), config)
    scales = torch.nn.functional.softplus(raw)[0].tolist()
    expected = [6**0.5] * 3 if frame == "head" else [2, 3, 0.6]
    assert scales == pytest.approx(expected, rel=1e-4)


def test_every_parameter_learns(views):
    config, model = build(views)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # away from the zeros at which half of the gradients vanish
        for parameter in model.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=generator)
    run = prepare(views, config)
    run.model = model
    item = views.item(4)  # its expression coefficients are not all zero
    rendering = model(0, 1, item.state, item.view)
    sum(objective(run, rendering, item, config).values()).backward()
    untouched = [
        name
        for name, p in model.named_parameters()
        if p.grad is None or not bool(p.grad.abs().sum() > 0)
    ]
    assert untouched == []
    assert torch.equal(model.z_id.grad[1], torch.zeros(8))  # another subject's row


def test_without_refinement_no_feature_is_rasterised(views, monkeypatch):
    _, model = build(views)
    seen = []
    from grmm import model as module

    real = module.rasterize
    monkeypatch.setattr(
        module, "rasterize", lambda *a, **k: seen.append(a[4].shape[1]) or real(*a, **k)
    )
    item = views.item(0)
    with_features = model(0, 0, item.state, item.view)
    gaussians = model.geometry(*model.codes(0, 0), item.state)
    colours = model.appearance(model.z_id[0], item.state, item.view)
    plain = model.draw(gaussians, colours, item.view, refine=False)
    assert seen == [7, 3]
    torch.testing.assert_close(plain.rgb, with_features.rgb, atol=1e-6, rtol=0)


def test_ablations_leave_their_parts_out(views):
    item = views.item(0)
    _, model = build(views, mesh_decoder=False, refine_widths=(), residual_codes=False)
    out = model(0, 0, item.state, item.view)
    assert out.image is out.rgb
    assert model.mesh is None
    torch.nn.init.normal_(model.colour.last.weight)
    colours = model.appearance(model.z_id[0], item.state, item.view)
    assert torch.equal(colours, model.appearance(model.z_id[1], item.state, item.view))


def test_convention_camera_in_head_space(views):
    """K E [R t]: a head point seen through the view is the world point seen by the camera."""
    sample, view = views.sample(1), views.item(1).view
    point = np.array([0.01, 0.02, 0.09])
    place = sample.place
    world = place.tracked.R @ point + place.tracked.t
    expected = place.cam_from_world[:3, :3] @ world + place.cam_from_world[:3, 3]
    got = view.cam_from_head[:3, :3].numpy() @ point + view.cam_from_head[:3, 3].numpy()
    np.testing.assert_allclose(got, expected, atol=1e-12)
    centre = -view.cam_from_head[:3, :3].T @ view.cam_from_head[:3, 3]
    torch.testing.assert_close(view.direction() * centre.norm(), centre)


def test_rendered_depth_and_silhouette_match_the_ray_cast():
    views = HeadViews(EllipsoidSource(size=64), ellipsoid_head(40, 64))
    config = tiny_config(model={"n_g": 64, "ladder": (8, 8, 8)})
    model = GRMM(config.model, views.head, ("S000",), ("e0",))
    item = views.item(0)
    with torch.no_grad():
        out = model(0, 0, item.state, item.view)
    both = item.depth_valid & (out.alpha > 0.5)
    assert float((out.depth - item.depth)[both].abs().median()) < 3e-3  # texels are 5 mm apart
    assert float(((out.alpha > 0.5) == item.mask).float().mean()) > 0.94  # a pixel around


def test_moving_the_subject_far_away_changes_nothing():
    near = HeadViews(EllipsoidSource(size=32), ellipsoid_head())
    far = HeadViews(EllipsoidSource(size=32, offset=(1000.0, 700.0, -1000.0)), ellipsoid_head())
    _, model = build(near)
    with torch.no_grad():
        a, b = (model(0, 0, v.item(1).state, v.item(1).view) for v in (near, far))
    torch.testing.assert_close(a.image, b.image, atol=1e-4, rtol=0)


def test_quaternion_product_composes_rotations():
    from express50.geometry.transforms_torch import quat_to_matrix

    a, b = torch.nn.functional.normalize(torch.randn(2, 5, 4, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(
        quat_to_matrix(quat_multiply(a, b)), quat_to_matrix(a) @ quat_to_matrix(b)
    )


def test_one_step_lowers_the_objective_of_its_view(views):
    config, _ = build(views)
    run = prepare(views, config)
    set_rates(run, config)
    index = run.training[0]
    run.shuffle.indices = [index]
    run.shuffle.restore({"epoch": 0, "position": 0})
    totals = []
    for _ in range(6):
        step(run, run.model, config)
        totals.append(sum(run.terms.values()))
    assert totals[-1] < totals[0]
