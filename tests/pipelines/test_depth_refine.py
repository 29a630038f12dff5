"""Rendering the surface: band, weights, appearance, gradients, and what a refinement gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.errors import ConfigError
from pipelines.depth.band import (
    grown,
    make_band,
    roughness,
    slopes,
    slopes_transposed,
)
from pipelines.depth.blocks import Grid, build
from pipelines.depth.config import DepthConfig
from pipelines.depth.probes import (
    LOBES,
    Appearance,
    camera_gains,
    conjugate_gradients,
    lobes,
    plain_appearance,
    solve_appearance,
    sparse_matrix,
)
from pipelines.depth.rays import make_sight
from pipelines.depth.refine import make_model, pick_device, refine
from pipelines.depth.render import distances, ray_pull, ray_weights
from pipelines.depth.surface import extract_mesh
from pipelines.depth.views import make_view
from tests.pipelines.bump_head import distance, render, ring

CPU = torch.device("cpu")
VOXEL = 0.004
QUICK = DepthConfig(
    render_rounds=3, render_rays=15_000, render_samples=12, render_stiffness=2.0, device="cpu"
)


def head_grid(moved_m=0.0) -> Grid:
    """The analytic head's distances; ``moved_m`` is added to them, a number or a function."""
    low = np.array([-0.12, -0.15, -0.13])

    def moved(points: np.ndarray) -> np.ndarray:
        return distance(points) + (moved_m(points) if callable(moved_m) else moved_m)

    return build(low, low + VOXEL * np.array([59, 74, 67]), VOXEL, moved)


@pytest.fixture(scope="module")
def views():
    shots = [(camera, *render(camera)) for camera in ring(8, 160)]
    return [make_view(camera, rgb, alpha, 1024) for camera, rgb, alpha, _ in shots]


@pytest.fixture(scope="module")
def cells():
    ball = np.argwhere(np.ones((14, 14, 14))) - 3
    radius = np.linalg.norm(ball - [3.5, 3.5, 3.5], axis=1)
    return ball[(radius > 2.5) & (radius < 6.5)]


def test_band_finds_its_vertices_and_no_others(cells):
    band = make_band(cells[::-1], CPU)
    assert band.count == len(cells)
    assert torch.equal(band.find(band.cells), torch.arange(band.count))
    absent = torch.tensor([[3, 3, 3], [100, 0, 0], [-100, 5, 5]])
    assert (band.find(absent) == band.count).all()


def test_interpolation_is_exact_for_linear_values_and_absent_far_away(cells):
    band = make_band(cells, CPU)
    values = (band.cells @ torch.tensor([2, -1, 3])).double() + 0.5
    points = torch.rand(500, 3, dtype=torch.float64, generator=torch.manual_seed(0)) * 13 - 3
    index, weight = band.interpolation(points)
    whole = (weight > 0).all(-1)
    assert whole.sum() > 100
    expected = points @ torch.tensor([2.0, -1.0, 3.0], dtype=torch.float64) + 0.5
    torch.testing.assert_close(distances(index, weight, values)[whole], expected[whole])
    index, weight = band.interpolation(torch.tensor([[50.5, 0.5, 0.5]]))
    assert weight.sum() == 0 and distances(index, weight, values.float())[0] == 4.0


def test_lattice_operators_are_symmetric_and_transposed(cells):
    band = make_band(cells, CPU)
    generator = torch.manual_seed(1)
    a, b = torch.randn(2, band.count, dtype=torch.float64, generator=generator)
    v = torch.randn(band.count, 3, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(roughness(band, a) @ b, a @ roughness(band, b))
    torch.testing.assert_close((slopes(band, a) * v).sum(), a @ slopes_transposed(band, v))
    assert roughness(band, torch.ones(band.count)).abs().max() < 1e-6


def test_grown_reaches_all_neighbours():
    assert len(grown(np.array([[5, 5, 5]]), 2)) == 125


def test_weights_peak_at_the_first_zero_and_hide_the_second():
    t = torch.linspace(-4, 12, 321, dtype=torch.float64)
    values = torch.where(t < 4, -t, t - 8).abs().where(t > 20, torch.where(t < 4, -t, t - 8))
    weights, opacity = ray_weights(values[None], 6.0)
    assert opacity[0] > 0.999 and (weights >= 0).all()
    assert abs(float((weights[0] * t).sum())) < 0.05
    assert weights[0, t > 2].sum() < 1e-4


def test_opacity_of_a_near_miss_falls_with_its_distance():
    t = torch.linspace(-6, 6, 49)
    seen = [float(ray_weights((t.abs() * 0.3 + gap)[None], 4.0)[1]) for gap in (-1, 0, 0.5, 2)]
    assert seen[0] > 0.9 and abs(seen[1] - 0.5) < 0.01 and seen[1] > seen[2] > seen[3]
    assert seen[3] < 0.01


def test_weights_stand_extremes():
    for values in ([1e6, -1e6, 1e6], [-1e6, -1e6, -1e6], [0.0, 0.0, 0.0]):
        weights, opacity = ray_weights(torch.tensor([values], requires_grad=True), 1e4)
        assert torch.isfinite(weights).all() and 0 <= opacity.item() <= 1


def test_renderer_passes_gradcheck(cells):
    """Through weights, opacity and interpolation, in float64."""
    band = make_band(cells, CPU)
    ways = torch.nn.functional.normalize(torch.tensor([[0.2, 0.1, 1.0], [-0.3, 0.2, 1.0]]), dim=1)
    points = torch.tensor([3.4, 3.3, -3.4]) + torch.linspace(0, 4, 7)[:, None] * ways[:, None]
    index, weight = band.interpolation(points.double())
    used, index = torch.unique(index, return_inverse=True)
    radius = (band.cells[used].double() - 3.5).norm(dim=1) - 4.5
    colours = torch.rand(len(used), 3, dtype=torch.float64, generator=torch.manual_seed(0))

    def picture(values, colours):
        share, opacity = ray_weights(distances(index, weight, values), 1.7)
        seen = (colours[index] * weight[..., None]).sum(2)
        return (share[..., None] * seen).sum(1), opacity

    leaves = (radius.requires_grad_(), colours.requires_grad_())
    assert torch.autograd.gradcheck(picture, leaves)


def test_pull_is_the_gradient_and_its_curvature_answers_a_shift():
    generator = torch.manual_seed(2)
    found = torch.linspace(3, -3, 9, dtype=torch.float64).repeat(4, 1)
    found = found + 0.1 * torch.randn(4, 9, dtype=torch.float64, generator=generator)
    colour = torch.rand(4, 9, 3, dtype=torch.float64, generator=generator)
    target = torch.rand(4, 3, dtype=torch.float64, generator=generator)
    one = torch.ones(4, dtype=torch.float64)

    def seen(values):
        share, opacity = ray_weights(values, 2.0)
        return (share[..., None] * colour).sum(1) / opacity[:, None]

    share, opacity = ray_weights(found, 2.0)
    apart = colour - seen(found)[:, None]
    down, turn = ray_pull(found, 2.0, apart, seen(found) - target, 0 * one, one, 0 * one)
    leaf = found.clone().requires_grad_()
    expected = torch.autograd.grad(0.5 * (seen(leaf) - target).square().sum(), leaf)[0]
    torch.testing.assert_close(down, expected)
    shift = (seen(found + 1e-6) - seen(found - 1e-6)) / 2e-6
    torch.testing.assert_close(turn.sum(1), shift.square().sum(1), rtol=1e-5, atol=1e-9)


def test_sparse_matrix_and_its_transpose_agree_with_a_dense_one():
    row, column = torch.tensor([0, 0, 1, 3]), torch.tensor([2, 0, 2, 1])
    value = torch.tensor([1.0, 2.0, 3.0, 4.0])
    made = sparse_matrix(row, column, value, (4, 3))
    dense = torch.zeros(4, 3).index_put_((row, column), value)
    assert torch.equal(made.rows.to_dense(), dense)
    assert torch.equal(made.columns.to_dense(), dense.T)


def test_conjugate_gradients_solve():
    A = torch.tensor([[4.0, 1.0], [1.0, 3.0]])
    right = torch.tensor([1.0, 2.0])
    x = conjugate_gradients(lambda v: A @ v, right, torch.zeros(2), 1 / A.diag(), 10)
    torch.testing.assert_close(A @ x, right)


def test_lobes_follow_the_mirror():
    way, normal = torch.tensor([0.0, 0.6, -0.8]), torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(lobes(way, normal), torch.tensor([0.0, 0.6, 0.8]))


def test_appearance_finds_colours_lobes_and_gains(cells):
    """Sixty pixels a vertex, two cameras of different gain, a highlight to one side."""
    band, probes = make_band(cells, CPU), make_band(np.zeros((1, 3)), CPU)
    generator = torch.manual_seed(3)
    count = 60 * band.count
    ray = torch.arange(count)
    vertex = ray % band.count
    ways = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    columns = torch.cat([vertex[:, None], band.count + torch.arange(3).expand(count, 3)], 1)
    entries = torch.cat([torch.ones(count, 1), ways], 1)
    matrix = sparse_matrix(
        ray[:, None].expand(-1, 4).reshape(-1), columns.reshape(-1), entries.reshape(-1),
        (count, band.count + LOBES),
    )  # fmt: skip
    true = torch.rand(band.count + LOBES, 3, generator=generator)
    true[band.count :] = torch.tensor([[0.1], [0.0], [-0.05]])
    camera = (torch.rand(count, generator=generator) > 0.5).long()
    gain = torch.tensor([1.1, 0.9])[camera][:, None]
    rgb = (matrix.rows @ true) / gain
    look = plain_appearance(band, probes, 2, torch.full((3,), 0.5))
    for _ in range(6):
        look = solve_appearance(
            matrix, band, rgb, camera, torch.ones(count), look, 20, spread=1e-3, shyness=1e-4
        )
    ratio = look.gain[0] / look.gain[1]
    torch.testing.assert_close(ratio, torch.full((3,), 1.1 / 0.9), rtol=0.02, atol=0)
    assert (look.colours - true).abs().median() < 0.02
    lobe = look.colours[band.count :, 0]
    torch.testing.assert_close(lobe, true[band.count :, 0], atol=0.02, rtol=0)


def test_a_camera_that_sees_nothing_keeps_its_gain():
    look = Appearance(torch.zeros(1, 3), torch.full((2, 3), 1.0), torch.zeros(2, 3))
    rgb = torch.rand(400, 3, generator=torch.manual_seed(0))
    found = camera_gains(look, rgb, rgb, torch.zeros(400, dtype=torch.long), torch.ones(400, 1))
    torch.testing.assert_close(found.gain, torch.ones(2, 3))
    assert torch.isfinite(found.offset).all()


def skin_error(grid: Grid) -> np.ndarray:
    """Distances, metres, of the grid's surface from the analytic head's."""
    vertices, _, _ = extract_mesh(grid)
    return np.abs(distance(vertices))


def wave(points: np.ndarray) -> np.ndarray:
    """Metres (N,): hills and hollows, 80 mm from one to the next of a kind."""
    return 0.0015 * np.sin(points @ [60.0, 45, 30]) * np.cos(points @ [-25.0, 40, 20])


def test_rendering_takes_waves_out_of_a_surface(views):
    grid = head_grid(wave)
    better, numbers = refine(views, grid, QUICK)
    assert numbers["render_kept"] and numbers["render_rounds_rejected"] == 0
    assert numbers["render_colour_error"] < numbers["render_colour_error_before"]
    assert numbers["band_voxels"] < 0.5 * np.prod(grid.shape)
    before, after = skin_error(grid), skin_error(better)
    assert np.median(after) < 0.75 * np.median(before)
    again, _ = refine(views, grid, QUICK)
    np.testing.assert_array_equal(again.blocks, better.blocks)


def test_mattes_alone_bring_a_surface_out_to_the_silhouettes(views):
    grey = [replace(view, rgb=np.full_like(view.rgb, 120)) for view in views]
    grid = head_grid(0.002)
    better, numbers = refine(grey, grid, QUICK)
    assert numbers["render_alpha_error"] < 0.9 * numbers["render_alpha_error_before"]
    assert np.median(skin_error(better)) < np.median(skin_error(grid))


def test_photographs_of_noise_do_not_move_a_true_surface_far(views):
    random = np.random.default_rng(0)
    noisy = [replace(v, rgb=random.integers(0, 255, v.rgb.shape).astype(np.uint8)) for v in views]
    better, _ = refine(noisy, head_grid(), QUICK)
    assert np.percentile(skin_error(better), 95) < 0.001


def test_broken_mattes_leave_the_surface_as_it_was(views):
    """Alpha that is not a number is nobody's to believe: nothing of it may reach the grid."""
    broken = [replace(view, alpha=np.full_like(view.alpha, np.nan)) for view in views]
    grid = head_grid()
    same, numbers = refine(broken, grid, replace(QUICK, render_rounds=1))
    assert not numbers["render_kept"] and numbers["render_cost"] is None
    np.testing.assert_array_equal(same.blocks, grid.blocks)


def test_a_round_that_diverges_is_taken_back(views, monkeypatch):
    def diverged(scene, values, base, wrong):
        return torch.full_like(values, torch.nan), torch.ones_like(values)

    monkeypatch.setattr("pipelines.depth.refine.pull", diverged)
    grid = head_grid()
    same, numbers = refine(views, grid, replace(QUICK, render_rounds=1))
    assert numbers["render_rounds_rejected"] == 1 and numbers["render_moved_mm"] == 0
    np.testing.assert_array_equal(same.blocks, grid.blocks)


def test_cuda_where_there_is_none_is_one_clear_error():
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(ConfigError, match="depth.device"):
        pick_device("cuda")


def test_rays_of_a_thousand_metres_away_see_the_same(views):
    grid = head_grid()
    mesh = extract_mesh(grid)
    far = np.array([1000.0, -500.0, 300.0])
    moved = []
    for view in views[:3]:
        pose = view.camera.cam_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ far
        moved.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    seen = []
    for some, origin in ((views[:3], 0 * far), (moved, far)):
        moved_mesh = (mesh[0] + origin, *mesh[1:])
        sight = make_sight(some, grid.origin + origin, VOXEL, moved_mesh, 8, 2000)
        rays = sight.batch(slice(0, 1000), CPU)
        model = make_model(grid, mesh[0], CPU)
        index, weight = model.band.interpolation(rays.points())
        seen.append(distances(index, weight, model.start))
    assert len(seen[0]) == len(seen[1])
    close = (seen[0] - seen[1]).abs() < 0.1
    assert close.float().mean() > 0.95
