"""Time and accuracy of the rasteriser: ``python -m benchmarks.rasterize [--quick]``.

Scenes are ellipsoids of flat splats in the size and density of a head. Times are process CPU
milliseconds on one thread, the least of several runs, so that other work on the machine disturbs
them little; ``forward_backward`` includes the projection and the gradients of every input. The
torch reference runs in the same process on the scenes that it can manage. The last line is one
JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import time

import torch
from torch import Tensor

from express50 import native
from grmm.rasterize import RenderOutput, rasterize

SCENES = (  # Gaussians, image size, channels, also with the reference
    (1_000, 128, 38, True),
    (10_000, 256, 3, True),
    (10_000, 256, 38, True),
    (16_384, 256, 38, False),
    (65_536, 512, 3, False),
    (65_536, 512, 38, False),
    (262_144, 1024, 3, False),
    (262_144, 1024, 38, False),
)
QUICK = 4


def head(n: int, size: int, channels: int) -> dict[str, Tensor]:
    """N splats on an ellipsoid of 24 cm, 1 m in front of the camera, float64."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    normal = normal / normal.norm(dim=1, keepdim=True)
    spacing = math.sqrt(4 * math.pi * 0.1**2 / n)
    jitter = torch.exp(0.3 * torch.randn(n, 3, generator=generator, dtype=torch.float64))
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    f = size * 0.85 / 0.24
    return {
        "means": normal * torch.tensor([0.08, 0.12, 0.1], dtype=torch.float64),
        "quats": torch.cat([1 + normal[:, 2:], torch.linalg.cross(z, normal)], 1),
        "scales": 0.7 * spacing * jitter * torch.tensor([1, 1, 0.3], dtype=torch.float64),
        "opacities": 0.35 + 0.6 * torch.rand(n, generator=generator, dtype=torch.float64),
        "colors": torch.rand(n, channels, generator=generator, dtype=torch.float64),
        "K": torch.tensor([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]], dtype=torch.float64),
        "cam_from_world": pose,
    }


def run(
    scene: dict[str, Tensor], size: int, backend: str, dtype: torch.dtype
) -> tuple[RenderOutput, list[Tensor], float, float]:
    """Output, gradients, and CPU seconds of forward and backward."""
    leaves = {k: v.to(dtype).requires_grad_() for k, v in scene.items()}
    start = time.process_time()
    out = rasterize(**leaves, width=size, height=size, backend=backend)
    middle = time.process_time()
    images = [out.colors, out.depth, out.alpha]
    cotangents = [torch.ones_like(x) for x in images]
    ready = time.process_time()
    grads = torch.autograd.grad(images, list(leaves.values()), cotangents)
    return out, list(grads), middle - start, time.process_time() - ready


def times(scene: dict[str, Tensor], size: int, backend: str, repeats: int) -> dict[str, float]:
    """Least CPU milliseconds of forward, and of forward and backward together."""
    runs = [run(scene, size, backend, torch.float32)[2:] for _ in range(repeats)]
    forward = min(f for f, _ in runs)
    backward = min(b for _, b in runs)
    return {
        "forward_ms": round(1e3 * forward, 2),
        "forward_backward_ms": round(1e3 * (forward + backward), 2),
    }


def errors(scene: dict[str, Tensor], size: int) -> dict[str, float]:
    """Largest relative errors of the native kernel against the float64 reference."""
    expected, expected_grads, _, _ = run(scene, size, "reference", torch.float64)
    result = {}
    for name, dtype in (("float64", torch.float64), ("float32", torch.float32)):
        got, grads, _, _ = run(scene, size, "cpu", dtype)
        images = [(getattr(expected, k), getattr(got, k)) for k in ("colors", "depth", "alpha")]
        pairs = list(zip(expected_grads[:5], grads[:5], strict=True))
        result[f"{name}_image"] = max(_relative(a, b) for a, b in images)
        result[f"{name}_gradient"] = max(_relative(a, b) for a, b in pairs)
        # Without the few pixels that fall on the other side of alpha = 1/255.
        result[f"{name}_image_p999"] = max(_relative(a, b, 0.999) for a, b in images)
    return result


def _relative(expected: Tensor, got: Tensor, quantile: float = 1.0) -> float:
    """Largest difference, or a quantile of them, over the largest expected value."""
    difference = (expected - got).detach().abs().flatten().sort().values
    place = int(quantile * (difference.numel() - 1))
    return float(difference[place] / expected.detach().abs().max())


def main() -> int:
    """Measure, print a table, then one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small scenes only")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each scene")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for n, size, channels, compare in SCENES[: QUICK if args.quick else None]:
        scene = head(n, size, channels)
        row: dict[str, object] = {"gaussians": n, "size": size, "channels": channels}
        row["cpu"] = times(scene, size, "cpu", args.repeats)
        if compare:
            row["reference"] = times(scene, size, "reference", 1)
            row["errors"] = errors(scene, size)
        rows.append(row)
        print(json.dumps(row), flush=True)
    best = next(v for v in ("avx512", "avx2", "baseline") if v in str(native.load()._name))
    report = {"threads": 1, "machine": platform.machine(), "variant": best, "scenes": rows}
    print(json.dumps({"benchmark": "rasterize", **report}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
