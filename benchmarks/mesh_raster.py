"""Time and gradients of the mesh rasteriser: ``python -m benchmarks.mesh_raster [--quick]``.

The mesh is the procedural head, on one thread; times are medians of the process's CPU milliseconds,
so that other work on the machine disturbs them less. Open3D's full frame (scene, rays, cast) is
timed in the same run, and its faces are compared. Gradients of a weighted antialiased coverage are
divided by its finite differences for three motions, each with the weight under which it changes
coverage most, so that nothing cancels. The photometric step poses all vertices, sees them, lights
their normals by spherical harmonics, interpolates light and texture coordinates, samples a
512 x 512 texture whose gradient is taken too, blends outlines and goes back through all of it. The
last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from express50.geometry.cameras import Camera
from express50.geometry.mesh_raster import Raster, face_neighbors, rasterize
from express50.geometry.mesh_render import (
    Covered,
    antialias,
    barycentrics,
    compose,
    covered,
    interpolate,
    sample_texture,
    sh_light,
)
from express50.geometry.transforms import look_at
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.builtin import load_builtin
from express50.head.model import HeadModel, pose, vertex_normals

MOTIONS = {"roll": 0.02, "shift": 0.004, "scale": 0.02}  # radians, metres, share
BAR_MS = {256: 35.0, 512: 73.0}  # of a prototype of the same step on FLAME's topology


def head_camera(size: int) -> Camera:
    """A camera a metre from the head, which then covers a third of the picture."""
    view = look_at(np.array([0.3, 0.1, 1.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera("c", size, size, "PINHOLE", (2.9 * size, 2.9 * size, size / 2, size / 2), view)


def median_ms(run: Callable[[], object], repeats: int) -> float:
    """Median CPU milliseconds of a call after one that is not counted."""
    run()
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        taken.append(1e3 * (time.process_time() - start))
    return round(statistics.median(taken), 2)


def visibility(model: HeadModel, size: int, repeats: int) -> dict[str, float]:
    """Milliseconds of the z-buffer, with and without outlines, and of Open3D; disagreement."""
    vertices, faces = model.template.double().numpy(), model.faces.numpy()
    lens, neighbors = head_camera(size), face_neighbors(faces)

    def see(**options: object) -> Raster:
        return rasterize(vertices, faces, lens, **({"pairs": False} | options))  # type: ignore[arg-type]

    native, rays = see(), see(backend="open3d")
    seen = native.face_id >= 0
    return {
        "size": size,
        "covered": round(float(seen.mean()), 4),
        "native_ms": median_ms(see, repeats),
        "native_culled_ms": median_ms(lambda: see(cull=True), repeats),
        "native_with_outlines_ms": median_ms(lambda: see(pairs=True, neighbors=neighbors), repeats),
        "open3d_ms": median_ms(lambda: see(backend="open3d"), max(3, repeats // 3)),
        "differing_share": float((native.face_id != rays.face_id).sum() / seen.sum()),
        "differing_outline_pixels": int((seen != (rays.face_id >= 0)).sum()),
    }


def gradient_ratio(model: HeadModel, size: int, motion: str) -> float:
    """Mean gradient of a weighted coverage over its finite difference along a motion."""
    base, faces = model.template.double(), model.faces.numpy()
    lens, neighbors = head_camera(size), face_neighbors(faces)
    K, view = torch.from_numpy(lens.K), torch.from_numpy(lens.cam_from_world)
    axis = torch.linspace(-1, 1, size, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    weight = {"roll": x * y, "shift": x, "scale": torch.ones_like(x)}[motion][..., None]

    def coverage(amount: Tensor) -> Tensor:
        moved = {
            "roll": lambda: base @ axis_angle_to_matrix(amount * view[2, :3]).T,
            "shift": lambda: base + amount * view[0, :3],
            "scale": lambda: base * (1 + amount),
        }[motion]()
        raster = rasterize(moved.detach().numpy(), faces, lens, neighbors=neighbors)
        cover = torch.from_numpy(raster.face_id >= 0).double()[..., None]
        return (weight * antialias(cover, covered(raster), moved, K, view)).sum()

    reach = MOTIONS[motion]
    nodes = torch.linspace(-reach, reach, 17, dtype=torch.float64)
    slopes = []
    for node in nodes:
        amount = node.clone().requires_grad_()
        slopes.append(torch.autograd.grad(coverage(amount), amount)[0])
    change = coverage(nodes[-1]) - coverage(nodes[0])
    return round(float(torch.trapezoid(torch.stack(slopes), nodes) / change), 4)


def photometric_step(model: HeadModel, size: int) -> Callable[[], dict[str, float]]:
    """A closure that runs one step and returns the milliseconds of its parts."""
    generator = torch.Generator().manual_seed(0)
    lens, neighbors = head_camera(size), face_neighbors(model.faces.numpy())
    K, view = (torch.from_numpy(x).float() for x in (lens.K, lens.cam_from_world))
    shape = torch.zeros(1, len(model.shape_names)).requires_grad_()
    expression = torch.zeros(1, len(model.expression_names)).requires_grad_()
    joints = torch.zeros(1, 12).requires_grad_()
    light = torch.zeros(9, 3)
    light[0], light[2] = 3.0, 0.8
    light.requires_grad_()
    texture = torch.rand(512, 512, 3, generator=generator).requires_grad_()
    target = torch.rand(size, size, 3, generator=generator)
    leaves = [shape, expression, joints, light, texture]

    def draw(vertices: Tensor, seen: Covered) -> Tensor:
        weights = barycentrics(seen, vertices, model.faces, K, view)
        shade = sh_light(vertex_normals(vertices[None], model.faces)[0], light)
        shade = interpolate(seen, weights, shade, model.faces)
        uv = interpolate(seen, weights, model.uv, model.uv_faces)
        colors = sample_texture(texture, uv) * shade
        return antialias(compose(seen, colors, target), seen, vertices, K, view)

    def step() -> dict[str, float]:
        clock = [time.process_time()]
        vertices = pose(model, shape, expression, joints[:, :3], joints[:, 3:6], joints[:, 6:])[0]
        clock.append(time.process_time())
        raster = rasterize(
            vertices.detach().numpy(), model.faces.numpy(), lens, neighbors=neighbors
        )
        seen = covered(raster)
        clock.append(time.process_time())
        loss = (draw(vertices, seen) - target).abs().sum() / (3 * len(seen.pixels))
        clock.append(time.process_time())
        torch.autograd.grad(loss, leaves)
        clock.append(time.process_time())
        parts = dict(
            zip(("pose", "visibility", "forward", "backward"), np.diff(clock), strict=True)
        )
        return {name: 1e3 * float(value) for name, value in parts.items()}

    return step


def photometric(model: HeadModel, size: int, repeats: int) -> dict[str, float]:
    """Median milliseconds of the photometric step and its parts, beside the bar."""
    step = photometric_step(model, size)
    step()
    rows = [step() for _ in range(repeats)]
    totals = sorted(sum(row.values()) for row in rows)
    parts = {f"{k}_ms": round(statistics.median(r[k] for r in rows), 2) for k in rows[0]}
    times = {"step_ms": round(statistics.median(totals), 2), "least_ms": round(totals[0], 2)}
    return {"size": size} | times | {"prototype_ms": BAR_MS[size]} | parts


def main() -> int:
    """Measure, print a table, then one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="256 pixels only")
    parser.add_argument("--repeats", type=int, default=15, help="runs of each timing")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = load_builtin()
    report: dict[str, object] = {
        "benchmark": "mesh_raster",
        "threads": 1,
        "vertices": len(model.template),
        "faces": len(model.faces),
    }
    sizes = (256,) if args.quick else (256, 512, 1024)
    report["visibility"] = [visibility(model, size, args.repeats) for size in sizes]
    report["gradient_over_difference"] = {
        str(size): {motion: gradient_ratio(model, size, motion) for motion in MOTIONS}
        for size in sizes[:2]
    }
    report["photometric"] = [photometric(model, size, args.repeats) for size in sizes[:2]]
    for row in (*report["visibility"], *report["photometric"]):  # type: ignore[misc]
        print(json.dumps(row))
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
