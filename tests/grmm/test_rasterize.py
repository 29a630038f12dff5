"""The rasteriser: hand-worked values, native against reference against finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50 import native
from grmm.rasterize import BACKENDS, cpu, rasterize, resolve_backend
from tests.grmm.gaussian_scenes import GRADIENTS, Scene, random_scene, relative_error, render

CPU_BACKENDS = ["reference", "cpu"]
F64 = torch.float64


def built_variants() -> list[str]:
    """Variants of the native library that this processor can run."""
    from express50.native.build import VARIANTS, library_file

    level = native.load("baseline").native_level()
    return [v for v in list(VARIANTS)[: level + 1] if library_file(v).exists()]


def pinhole(f: float, cx: float, cy: float) -> torch.Tensor:
    return torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=F64)


def on_axis(*depths: float, opacities: list[float], scale: float = 0.1) -> dict[str, torch.Tensor]:
    """Round Gaussians on the optical axis, coloured 1, 2, 3, ..."""
    n = len(depths)
    means = torch.zeros(n, 3, dtype=F64)
    means[:, 2] = torch.tensor(depths)
    return {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]], dtype=F64).repeat(n, 1),
        "scales": torch.full((n, 3), scale, dtype=F64),
        "opacities": torch.tensor(opacities, dtype=F64),
        "colors": torch.arange(1.0, n + 1, dtype=F64)[:, None],
        "K": pinhole(100.0, 8.5, 8.5),
        "cam_from_world": torch.eye(4, dtype=F64),
    }


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_single_gaussian_worked_by_hand(backend):
    scene = on_axis(2.0, opacities=[0.5])
    out = rasterize(
        **scene, width=17, height=17, background=torch.tensor([3.0], dtype=F64), backend=backend
    )
    variance = (100.0 * 0.1 / 2.0) ** 2 + 0.3  # (f s / z)^2 + dilation
    alpha = 0.5 * math.exp(-0.5 * 3.0**2 / variance)  # 3 px right of the mean
    assert out.alpha[8, 8].item() == pytest.approx(0.5, abs=1e-14)
    assert out.alpha[8, 11].item() == pytest.approx(alpha, abs=1e-14)
    assert out.colors[8, 11, 0].item() == pytest.approx(alpha * 1 + (1 - alpha) * 3, abs=1e-13)
    # Seen along its axis the plane of the Gaussian has ray length 2 everywhere.
    assert out.depth[8, 8].item() == pytest.approx(2.0, abs=1e-14)
    assert out.depth[8, 11].item() == pytest.approx(2.0 / math.hypot(1, 0.03), abs=1e-13)


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_nearer_gaussians_blend_first_and_ties_go_by_index(backend):
    scene = on_axis(3.0, 2.0, 2.0, opacities=[0.5, 0.5, 0.5])
    out = rasterize(**scene, width=17, height=17, backend=backend)
    # colours 2, 3 (same depth, by index), then 1
    assert out.colors[8, 8, 0].item() == pytest.approx(0.5 * 2 + 0.25 * 3 + 0.125 * 1, abs=1e-14)


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_pixel_stops_before_the_gaussian_that_would_close_it(backend):
    # T = 0.01 (alpha is capped at 0.99), then 0.005; the third would leave 5e-5 <= 1e-4
    scene = on_axis(1.0, 2.0, 3.0, 4.0, opacities=[1.0, 0.5, 0.99, 0.01])
    out = rasterize(**scene, width=17, height=17, backend=backend)
    assert out.alpha[8, 8].item() == pytest.approx(0.995, abs=1e-14)
    assert out.colors[8, 8, 0].item() == pytest.approx(0.99 * 1 + 0.005 * 2, abs=1e-13)


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_contributions_under_one_level_are_skipped(backend):
    scene = on_axis(1.0, 2.0, opacities=[1 / 255 - 1e-9, 1 / 255 + 1e-9])
    out = rasterize(**scene, width=17, height=17, backend=backend)
    assert out.colors[8, 8, 0].item() == pytest.approx(2 / 255, abs=1e-7)
    assert out.alpha[8, 12].item() == 0.0 and out.depth[8, 12].item() == 0.0


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("n", "channels"), [(50, 3), (300, 38), (200, 60), (150, 8), (100, 0)])
def test_native_equals_reference_in_float64(n, channels, antialiased):
    scene = random_scene(n, channels, seed=n, antialiased=antialiased)
    expected, got = render(scene, "reference"), render(scene, "cpu")
    errors = {name: relative_error(expected[name], got[name]) for name in expected}
    assert max(errors.values()) < 1e-12, errors


@pytest.mark.parametrize("variant", built_variants())
@pytest.mark.parametrize("channels", [3, 38])
def test_native_float32_is_close_to_the_float64_reference(variant, channels, monkeypatch):
    library = native.load(variant)
    monkeypatch.setattr(cpu.native, "load", lambda: library)
    scene = random_scene(300, channels, seed=1)
    expected, got = render(scene, "reference"), render(scene, "cpu", torch.float32)
    for name in expected:
        difference = (expected[name] - got[name]).abs() / expected[name].abs().max()
        # A few pixels may fall on the other side of alpha = 1/255, which moves them by one level.
        assert (difference < 1e-5).double().mean() > 0.98, name
        assert difference.max() < 0.02, name


@pytest.mark.parametrize("variant", built_variants())
def test_every_variant_gives_the_same_float64_scene(variant, monkeypatch):
    library = native.load(variant)
    monkeypatch.setattr(cpu.native, "load", lambda: library)
    scene = random_scene(120, 11, seed=5)
    expected, got = render(scene, "reference"), render(scene, "cpu")
    assert max(relative_error(expected[name], got[name]) for name in expected) < 1e-12


@settings(deadline=None, max_examples=25)
@given(
    n=st.integers(0, 25),
    channels=st.integers(0, 12),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    seed=st.integers(0, 10_000),
    antialiased=st.booleans(),
)
def test_native_equals_reference_on_random_scenes(n, channels, width, height, seed, antialiased):
    scene = random_scene(n, channels, width, height, seed, antialiased)
    expected, got = render(scene, "reference"), render(scene, "cpu")
    for name in expected:
        assert torch.allclose(expected[name], got[name], rtol=1e-9, atol=1e-10), name


@pytest.mark.parametrize("backend", CPU_BACKENDS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_match_finite_differences(backend, antialiased):
    scene = random_scene(7, 2, width=8, height=6, seed=3)
    scene.tensors["scales"] *= 10.0
    scene.tensors["opacities"] = 0.5 + 0.4 * scene.tensors["opacities"]
    tensors = {k: v.clone().requires_grad_() for k, v in scene.tensors.items() if k != "K"}
    fx, fy, cx, cy = 9.0, 10.0, 3.0, 3.5
    intrinsics = torch.tensor([fx, fy, cx, cy], dtype=F64, requires_grad=True)
    place = torch.zeros(4, 3, 3, dtype=F64)
    place[range(4), [0, 1, 0, 1], [0, 1, 2, 2]] = 1.0
    corner = torch.zeros(3, 3, dtype=F64)
    corner[2, 2] = 1.0

    def images(intrinsics, *values):
        K = torch.einsum("k,kij->ij", intrinsics, place) + corner
        out = rasterize(
            **dict(zip(tensors, values, strict=True)),
            K=K,
            width=8,
            height=6,
            antialiased=antialiased,
            median_depth=True,
            normals=True,
            backend=backend,
        )
        return out.colors, out.depth, out.alpha, out.median_depth, out.normals

    assert images(intrinsics, *tensors.values())[2].max() > 0.3
    assert (images(intrinsics, *tensors.values())[3] > 0).any()
    assert torch.autograd.gradcheck(
        images, (intrinsics, *tensors.values()), eps=1e-6, atol=1e-6, rtol=1e-4
    )


def test_every_gaussian_that_shows_gets_a_gradient():
    scene = random_scene(60, 3, seed=11)
    grads = render(scene, "cpu", torch.float32)
    shown = grads["colors"].abs().sum(1) > 1e-3
    assert shown.sum() > 30
    for name in ("means", "quats", "scales", "opacities"):
        assert (grads[name].reshape(60, -1)[shown].abs().sum(1) > 0).all(), name


@pytest.mark.parametrize("channels", [3, 38])
def test_same_bits_for_any_number_of_threads(channels):
    scene = random_scene(700, channels, width=90, height=70, seed=2)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            leaves = {k: v.float().requires_grad_() for k, v in scene.tensors.items()}
            out = rasterize(**leaves, width=90, height=70, backend="cpu")
            # ones: torch itself may not sum a random cotangent the same way on more threads
            cotangents = [torch.ones_like(x) for x in (out.colors, out.alpha)]
            grads = torch.autograd.grad([out.colors, out.alpha], list(leaves.values()), cotangents)
            results.append([out.colors, out.depth, out.alpha, *grads[:-1]])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_strided_arguments_are_read_as_their_values():
    scene = random_scene(40, 5).tensors
    expected = rasterize(**scene, width=61, height=47, backend="cpu").colors
    names = ("means", "quats", "scales", "colors")
    wide = torch.cat([scene[k] for k in names], 1)
    strided = dict(zip(names, wide.split([3, 4, 3, 5], 1), strict=True))
    strided["opacities"] = torch.stack([scene["opacities"]] * 2, 1)[:, 0]
    got = rasterize(**(scene | strided), width=61, height=47, backend="cpu").colors
    assert torch.equal(got, expected)


def plane(normal: torch.Tensor, n: int = 60) -> dict[str, torch.Tensor]:
    """Flat Gaussians that tile the plane through (0, 0, 0.8) with this unit normal."""
    helper = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    side = torch.linalg.cross(helper, normal)
    side = side / side.norm()
    up = torch.linalg.cross(normal, side)
    grid = torch.linspace(-0.25, 0.25, n, dtype=F64)
    a, b = torch.meshgrid(grid, grid, indexing="xy")
    means = a.reshape(-1, 1) * side + b.reshape(-1, 1) * up
    means = means + torch.tensor([0, 0, 0.8], dtype=F64)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    quat = torch.cat([(1 + normal @ z)[None], torch.linalg.cross(z, normal)])
    return {
        "means": means,
        "quats": quat.expand(n * n, 4),
        "scales": torch.tensor([0.008, 0.008, 1e-6], dtype=F64).expand(n * n, 3),
        "opacities": torch.full((n * n,), 0.9, dtype=F64),
        "colors": means[:, 2:],
        "K": pinhole(300.0, 40.0, 24.0),
        "cam_from_world": torch.eye(4, dtype=F64),
    }


@pytest.mark.parametrize("backend", CPU_BACKENDS)
@pytest.mark.parametrize("angle", [0.0, 0.6, -1.0])
def test_depth_of_a_plane(backend, angle):
    normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=F64)
    scene = plane(normal)
    out = rasterize(**scene, width=64, height=48, backend=backend)
    v, u = torch.meshgrid(
        torch.arange(48, dtype=F64) + 0.5, torch.arange(64, dtype=F64) + 0.5, indexing="ij"
    )
    rays = torch.stack([(u - 40) / 300, (v - 24) / 300, torch.ones_like(u)], -1)
    truth = 0.8 * normal[2] / (rays @ normal)
    assert out.alpha.min() > 0.9
    error = (out.depth - truth).abs()
    if angle == 0:
        # Over a splat of 8 mm the ray length bends away from its plane by about s^2 / z = 0.08 mm.
        assert error.max() < 2e-4
    else:
        # Nearer neighbours win; blending the z of the means is biased by slope times splat size.
        assert error.mean() < 0.15 * (out.colors[..., 0] / out.alpha - truth).abs().mean()
        assert error.max() < 2e-3


@pytest.mark.parametrize("backend", CPU_BACKENDS)
@pytest.mark.parametrize("angle", [0.0, 0.6, -1.0])
def test_normals_of_a_plane_face_the_camera(backend, angle):
    normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=F64)
    out = rasterize(**plane(normal), width=64, height=48, normals=True, backend=backend)
    got = torch.nn.functional.normalize(out.normals, dim=-1)
    # The dilated covariance bends them a little towards the ray.
    assert (got @ -normal).min() > math.cos(math.radians(5))
    assert torch.allclose(out.normals.norm(dim=-1), out.alpha, rtol=1e-3)


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_median_depth_is_that_of_the_gaussian_at_one_half(backend):
    def median(*opacities):
        scene = on_axis(*range(1, len(opacities) + 1), opacities=list(opacities))
        out = rasterize(**scene, width=17, height=17, median_depth=True, backend=backend)
        return out.median_depth[8, 8].item()

    assert median(0.4, 0.4, 0.4) == pytest.approx(2.0, abs=1e-13)  # T = 0.6, then 0.36
    assert median(0.5, 0.9) == pytest.approx(1.0, abs=1e-13)  # exactly one half counts
    assert median(0.2, 0.3) == 0.0  # T = 0.56


def test_median_depth_and_normals_come_only_when_asked():
    scene = random_scene(20, 4).tensors
    plain = rasterize(**scene, width=61, height=47)
    assert plain.median_depth is None and plain.normals is None
    both = rasterize(**scene, width=61, height=47, median_depth=True, normals=True)
    assert torch.equal(plain.colors, both.colors) and torch.equal(plain.depth, both.depth)


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_background_is_behind_colours_only(backend):
    scene = random_scene(30, 4).tensors
    black = {k: v for k, v in scene.items() if k != "background"}
    a = rasterize(**black, width=61, height=47, backend=backend)
    b = rasterize(**scene, width=61, height=47, backend=backend)
    assert torch.equal(a.depth, b.depth) and torch.equal(a.alpha, b.alpha)
    expected = a.colors + (1 - a.alpha)[..., None] * scene["background"]
    assert torch.allclose(b.colors, expected, atol=1e-14)


def test_a_crop_shows_the_same_pixels():
    scene = random_scene(80, 3).tensors
    scene["means"] = scene["means"] * 0.6
    scene["scales"] = scene["scales"] * 0.05  # nothing reaches in from beyond the clamped margin
    whole = rasterize(**scene, width=61, height=47, backend="cpu")
    scene["K"] = scene["K"] - torch.tensor([[0, 0, 13], [0, 0, 9], [0, 0, 0]])
    crop = rasterize(**scene, width=21, height=19, backend="cpu")
    assert torch.allclose(whole.colors[9:28, 13:34], crop.colors, atol=1e-12)
    assert torch.allclose(whole.depth[9:28, 13:34], crop.depth, atol=1e-12)


def test_unused_outputs_cost_no_gradient():
    leaves = {k: v.requires_grad_() for k, v in random_scene(20, 3).tensors.items()}
    out = rasterize(**leaves, width=61, height=47, backend="cpu")
    only_depth = torch.autograd.grad(out.depth.sum(), [leaves["means"], leaves["colors"]])
    assert only_depth[0].abs().sum() > 0
    assert only_depth[1].abs().sum() == 0


def test_second_derivatives_are_refused_rather_than_wrong():
    leaves = {k: v.requires_grad_() for k, v in random_scene(5, 3).tensors.items()}
    out = rasterize(**leaves, width=61, height=47, backend="cpu")
    (grad,) = torch.autograd.grad(out.colors.square().sum(), leaves["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


@pytest.mark.parametrize("name", [*GRADIENTS])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e31])
def test_values_that_are_not_finite_are_refused_by_name(name, value):
    scene = random_scene(5, 3).tensors
    scene[name] = scene[name].clone()
    scene[name].reshape(-1)[0] = value
    with pytest.raises(ValueError, match=f"^{name} "):
        rasterize(**scene, width=8, height=8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quats": torch.zeros(5, 3, dtype=F64)}, r"quats has shape \(5, 3\), expected \(5, 4\)"),
        ({"scales": torch.zeros(5, 3)}, "scales is torch.float32"),
        ({"background": torch.zeros(2, dtype=F64)}, r"background has shape \(2,\)"),
        ({"K": torch.eye(3, dtype=F64) * -1}, "expected .*fx, fy > 0"),
        ({"K": pinhole(1, 0, 0).triu(1) + torch.eye(3) + 1e-3}, "K is"),
        ({"width": 0}, "image size is 0 x 8"),
        ({"backend": "cuda"}, "expected one of auto, reference, cpu, gsplat"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = random_scene(5, 3).tensors | {"width": 8, "height": 8} | change
    with pytest.raises(ValueError, match=message):
        rasterize(**arguments)


def test_auto_takes_the_native_kernel_on_the_cpu():
    assert resolve_backend("auto", "cpu") == "cpu"
    assert resolve_backend("auto", "cuda:1") == "gsplat"
    assert set(BACKENDS) == {"auto", "reference", "cpu", "gsplat"}


def test_zero_quaternion_means_no_rotation():
    scene = random_scene(9, 3, seed=4).tensors
    scene["quats"] = torch.zeros(9, 4, dtype=F64)
    got = render(Scene(scene, 61, 47), "cpu")
    scene["quats"] = torch.tensor([[2.0, 0, 0, 0]], dtype=F64).repeat(9, 1)
    expected = render(Scene(scene, 61, 47), "cpu")
    assert torch.equal(got["image"], expected["image"])
    assert (got["quats"] == 0).all()
