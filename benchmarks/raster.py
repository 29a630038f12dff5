"""Time and accuracy of the Gaussian rasteriser: ``python -m benchmarks.raster [--quick]``.

For every N, image size and channel count it prints the CPU seconds of one thread, the least of
several runs so that other work on the machine disturbs them little: forward, and forward and
backward with the projection and the gradients of every input. The same is measured once for
autograd over explicit Gaussian-pixel pairs in torch, not counting the time to find the pairs; it is
``n/a`` with the reason where they would take more than half of the free memory. Errors are the
kernel's, in float32 and in float64, against the float64 reference. ``prototype_s`` holds figures to
stay within 1.25x of; an AVX-512 Xeon at 2.1 GHz took them, without the projection. The last line is
one JSON object.
"""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Callable
from functools import partial

import psutil
import torch
from torch import Tensor

from benchmarks.common import make_parser
from express50 import native
from express50.geometry.conventions import corner_to_cell
from grmm.rasterize import RenderOutput, rasterize
from grmm.rasterize.projection import (
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    Pinhole,
    Splats,
    pair_alphas,
    pair_offsets,
    project,
)

COUNTS = (16_384, 65_536, 262_144)
SIZES = (256, 512, 1024)
CHANNELS = (3, 38)
MAIN = (65_536, 512, 38)  # the case of speedup_forward_backward
PROTOTYPE = {(65_536, 512, 38): 0.12, (262_144, 1024, 38): 0.53}  # seconds, forward and backward
Run = Callable[[dict[str, Tensor]], tuple[Tensor, ...]]


def measure(scene: dict[str, Tensor], run: Run) -> tuple[float, float]:
    """Return CPU seconds of forward, and of forward and backward, of one run on a float32 scene."""
    leaves = {name: tensor.float().requires_grad_() for name, tensor in scene.items()}
    start = time.process_time()
    images = run(leaves)
    forward = time.process_time() - start
    cotangents = [torch.ones_like(image) for image in images]
    start = time.process_time()
    torch.autograd.grad(images, list(leaves.values()), cotangents)
    return forward, forward + time.process_time() - start


def native_images(leaves: dict[str, Tensor], size: int) -> tuple[Tensor, ...]:
    """Return colours, depth and alpha of the native kernel."""
    out = rasterize(**leaves, width=size, height=size, backend="cpu")
    return out.colors, out.depth, out.alpha


def rival(
    scene: dict[str, Tensor], pairs: tuple[Tensor, Tensor], size: int, ours: float
) -> dict[str, object]:
    """Return autograd's seconds over explicit pairs and how often ours fit in, or why not."""
    channels = scene["colors"].shape[1]
    # Gathered colours, their products and both gradients; then some 40 numbers for each pair.
    needed, free = len(pairs[0]) * (4 * 4 * channels + 300), psutil.virtual_memory().available
    if needed > free / 2:
        reason = f"needs about {needed / 2**30:.0f} GiB, half the free memory is {free / 2**31:.0f}"
        return {"torch_pairs": "n/a", "torch_pairs_reason": reason}
    forward, both = measure(scene, partial(render_pairs, pairs=pairs, size=size))
    return {
        "torch_pairs_forward_s": round(forward, 4),
        "torch_pairs_forward_backward_s": round(both, 4),
        "speedup_forward_backward": round(both / ours, 1),
    }


def case(
    n: int, size: int, channels: int, pairs: tuple[Tensor, Tensor], repeats: int
) -> dict[str, object]:
    """Measure one row of the table."""
    scene, run = head(n, size, channels), partial(native_images, size=size)
    runs = [measure(scene, run) for _ in range(repeats + 1)][1:]
    forward, both = min(f for f, _ in runs), min(b for _, b in runs)
    hits = len(pairs[0])
    row: dict[str, object] = {"gaussians": n, "size": size, "channels": channels, "hits": hits}
    row |= {"forward_s": round(forward, 4), "forward_backward_s": round(both, 4)}
    row["hit_channels_per_second"] = round(hits * channels / both)
    return row | rival(scene, pairs, size, both)


def render(scene: dict[str, Tensor], size: int, backend: str, dtype: torch.dtype) -> RenderOutput:
    """Render the scene in ``dtype`` with the camera in float64."""
    tensors = {k: v if v.shape in ((3, 3), (4, 4)) else v.to(dtype) for k, v in scene.items()}
    return rasterize(**tensors, width=size, height=size, backend=backend)


def errors(n: int, size: int, channels: int) -> dict[str, float]:
    """Measure the largest errors of colours in [0, 1] against the float64 reference."""
    # Rounded first: rounding the scene to float32 is not an error of the kernel.
    scene = {name: tensor.float().double() for name, tensor in head(n, size, channels).items()}
    expected = render(scene, size, "reference", torch.float64).colors
    single = (render(scene, size, "cpu", torch.float32).colors - expected).abs()
    double = (render(scene, size, "cpu", torch.float64).colors - expected).abs()
    return {
        # Rounding takes a few pixels to the other side of a threshold: alpha 1/255, or T 1e-4.
        "max_abs_error": float(single.max()),
        "pixels_over_1e-5": int((single > 1e-5).any(2).sum()),
        "max_abs_error_float64": float(double.max()),
    }


def threads_bit_identical(n: int, size: int, channels: int) -> bool:
    """Check that images and gradients are the same bits on 1, 2 and 5 threads."""
    scene, results = head(n, size, channels), []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        leaves = {name: tensor.float().requires_grad_() for name, tensor in scene.items()}
        out = rasterize(**leaves, width=size, height=size, backend="cpu")
        images = [out.colors, out.depth, out.alpha]
        grads = torch.autograd.grad(
            images, list(leaves.values()), [torch.ones_like(x) for x in images]
        )
        results.append([*images, *grads])
    torch.set_num_threads(1)
    return all(
        torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True)
    )


def main() -> int:
    """Measure, print one line per case, then one JSON object."""
    parser = make_parser("raster", __doc__)
    parser.add_argument("--quick", action="store_true", help="N 16384 at 256 px only")
    parser.add_argument("--repeats", type=int, default=7, help="runs of each case")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for n in COUNTS[: 1 if args.quick else None]:
        for size in SIZES[: 1 if args.quick else None]:
            pairs = blended_pairs(head(n, size, 0), size)
            for channels in CHANNELS:
                row = case(n, size, channels, pairs, args.repeats)
                if (n, size, channels) in PROTOTYPE:
                    row["prototype_s"] = PROTOTYPE[n, size, channels]
                rows.append(row)
                print(json.dumps(row), flush=True)
    main_case = MAIN if not args.quick else (COUNTS[0], SIZES[0], CHANNELS[1])
    row = next(r for r in rows if (r["gaussians"], r["size"], r["channels"]) == main_case)
    report: dict[str, object] = {"benchmark": "raster", "threads": 1}
    report |= {"machine": platform.machine(), "variant": native.load()._name.split("_")[-1][:-3]}
    for key in ("speedup_forward_backward", "hit_channels_per_second", "forward_backward_s"):
        report[key] = row.get(key, "n/a")
    report |= errors(COUNTS[0], SIZES[0], CHANNELS[1])
    report["threads_bit_identical"] = threads_bit_identical(*main_case)
    print(json.dumps(report | {"cases": rows}))
    return 0


def head(n: int, size: int, channels: int) -> dict[str, Tensor]:
    """Return N flat splats on an ellipsoid as large as a head, 1 m in front of the camera, float64.

    They lie row by row on an equal-area map, as GRMM's lie on its UV map, and cover a third of the
    picture with 14 to 16 blended splats per pixel on average.
    """
    side = math.isqrt(n)
    if side * side != n:
        raise ValueError(f"n is {n}, expected a square: one Gaussian per texel")
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    row, column = torch.arange(n) // side, torch.arange(n) % side
    height = 1 - 2 * (row + uniform(n)) / side
    angle = 2 * math.pi * (column + uniform(n)) / side
    ring = (1 - height.square()).sqrt()
    normal = torch.stack([ring * angle.sin(), height, ring * angle.cos()], 1)
    spacing = math.sqrt(4 * math.pi * 0.1**2 / n)
    jitter = torch.exp(0.3 * torch.randn(n, 3, generator=generator, dtype=torch.float64))
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    f = size * 0.79 / 0.24
    return {
        "means": normal * torch.tensor([0.08, 0.12, 0.1], dtype=torch.float64),
        "quats": torch.cat([1 + normal[:, 2:], torch.linalg.cross(z, normal)], 1),
        "scales": 0.7 * spacing * jitter * torch.tensor([1, 1, 0.3], dtype=torch.float64),
        "opacities": 0.35 + 0.6 * uniform(n),
        "colors": uniform(n, channels),
        "K": torch.tensor([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]], dtype=torch.float64),
        "cam_from_world": pose,
    }


def records(scene: dict[str, Tensor], size: int) -> tuple[Splats, Pinhole]:
    """Return the scene as the rasteriser's records."""
    camera = {name: scene[name] for name in ("K", "cam_from_world")}
    splats = {name: tensor for name, tensor in scene.items() if name not in camera}
    return Splats(**splats), Pinhole(**camera, width=size, height=size)


@torch.no_grad()
def blended_pairs(scene: dict[str, Tensor], size: int) -> tuple[Tensor, Tensor]:
    """Return Gaussian and pixel numbers (M,) of every blend, by pixel, nearest first."""
    splats = project(*records(scene, size))
    visible = splats.visible.nonzero()[:, 0]
    order = visible[torch.sort(splats.depths[visible], stable=True).indices]
    mean, extent = splats.means2d[order].double(), splats.extents[order]
    low = corner_to_cell(mean - extent).ceil().clamp(min=0).long()
    high = corner_to_cell(mean + extent).floor().clamp(max=size - 1).long() + 1
    wide, tall = (high - low).clamp(min=0).unbind(1)
    ids = torch.repeat_interleave(torch.arange(len(order)), wide * tall)
    place = torch.arange(len(ids)) - (torch.cumsum(wide * tall, 0) - wide * tall)[ids]
    pixels = (low[ids, 1] + place // wide[ids]) * size + low[ids, 0] + place % wide[ids]
    gaussians = order[ids]
    shown = pair_alphas(splats, gaussians, pixels, size) >= ALPHA_MIN
    gaussians, pixels = gaussians[shown], pixels[shown]
    pixels, by_pixel = torch.sort(pixels, stable=True)
    gaussians = gaussians[by_pixel]
    alphas = pair_alphas(splats, gaussians, pixels, size)
    kept = (1 - alphas) * before(alphas, pixels) > TRANSMITTANCE_MIN
    return gaussians[kept], pixels[kept]


def before(alphas: Tensor, pixels: Tensor) -> Tensor:
    """Return the transmittance (M,) in front of each pair, from its pixel's earlier pairs."""
    # One running sum of logarithms over all pixels; float64 keeps its end as exact as its start.
    logs = torch.log1p(-alphas.double())
    running = torch.cumsum(logs, 0) - logs
    starts = torch.searchsorted(pixels, pixels)
    return torch.exp(running - running[starts]).to(alphas.dtype)


def render_pairs(
    scene: dict[str, Tensor], pairs: tuple[Tensor, Tensor], size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (P, C), sums of weight * ray length (P,) and alpha (P,), by autograd."""
    gaussians, pixels = pairs
    splats = project(*records(scene, size))
    alphas = pair_alphas(splats, gaussians, pixels, size)
    weights = alphas * before(alphas, pixels)
    delta = pair_offsets(splats, gaussians, pixels, size)
    length = splats.planes[gaussians, 0] + (splats.planes[gaussians, 1:] * delta).sum(1)
    colors = scene["colors"]
    image = colors.new_zeros(size * size, colors.shape[1])
    image = image.index_add(0, pixels, weights[:, None] * colors[gaussians])
    flat = weights.new_zeros(size * size)
    return image, flat.index_add(0, pixels, weights * length), flat.index_add(0, pixels, weights)


if __name__ == "__main__":
    raise SystemExit(main())
