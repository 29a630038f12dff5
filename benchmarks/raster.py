"""Time and accuracy of the Gaussian rasteriser: ``python -m benchmarks.raster [--quick]``.

For every N, image size and channel count it prints the CPU seconds of one thread, the least of
several runs so that other work on the machine disturbs them little: forward, and forward and
backward with the projection and the gradients of every input. The same is measured once for
autograd over explicit Gaussian-pixel pairs in torch, whose pairs are handed over for nothing; where
they would take more than half of the free memory it is ``n/a`` with the reason. Errors are the
kernel's, in float32 and in float64, against the float64 reference. ``prototype_s`` holds figures to
stay within 1.25x of; an AVX-512 Xeon at 2.1 GHz took them, without the projection. The last line is
one JSON object.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.raster_scene import blended_pairs, head, render_pairs
from express50 import native
from grmm.rasterize import RenderBuffers, RenderOutput, rasterize

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


def native_images(
    leaves: dict[str, Tensor], size: int, buffers: RenderBuffers
) -> tuple[Tensor, ...]:
    """Return colours, depth and alpha of the native kernel."""
    out = rasterize(**leaves, width=size, height=size, backend="cpu", buffers=buffers)
    return out.colors, out.depth, out.alpha


def rival(
    scene: dict[str, Tensor], pairs: tuple[Tensor, Tensor], size: int, ours: float
) -> dict[str, object]:
    """Return autograd's seconds over explicit pairs and how often ours fit in, or why not."""
    channels = scene["colors"].shape[1]
    # Gathered colours, their products and both gradients; then some 40 numbers for each pair.
    needed, free = len(pairs[0]) * (4 * 4 * channels + 300), free_bytes()
    if needed > free / 2:
        reason = f"needs about {needed / 2**30:.0f} GiB, half the free memory is {free / 2**31:.0f}"
        return {"torch_pairs": "n/a", "torch_pairs_reason": reason}
    forward, both = measure(scene, partial(render_pairs, pairs=pairs, size=size))
    return {
        "torch_pairs_forward_s": round(forward, 4),
        "torch_pairs_forward_backward_s": round(both, 4),
        "speedup_forward_backward": round(both / ours, 1),
    }


def free_bytes() -> float:
    """Return the free memory of this machine; without /proc, 8 GiB."""
    table = Path("/proc/meminfo")
    if not table.exists():
        return 8.0 * 2**30
    fields = dict(line.split(":") for line in table.read_text().splitlines())
    return 1024.0 * int(fields["MemAvailable"].split()[0])


def case(
    n: int, size: int, channels: int, pairs: tuple[Tensor, Tensor], repeats: int
) -> dict[str, object]:
    """Measure one row of the table."""
    scene, buffers = head(n, size, channels), RenderBuffers()
    run = partial(native_images, size=size, buffers=buffers)
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
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


if __name__ == "__main__":
    raise SystemExit(main())
