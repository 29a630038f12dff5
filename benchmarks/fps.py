"""Measure GRMM's frame rate: ``python -m benchmarks.fps [--device cpu --n-g 128 --size 256]``.

Decode, rasterise and refine, features and depth on, at the paper's size (N_g 512, 1024 x 1024) with
random weights, which cost what trained ones do. It is measured in two ways: everything is computed
again for every picture, as the paper counts its 75 frames per second; or mesh, transforms and
opacity, which a moving camera does not change, are kept, and the head's window alone is drawn. The
last line is one JSON object; without a CUDA device, and none other asked for, its figures are
``n/a``.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from benchmarks.common import make_parser
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from grmm.config import resolve
from grmm.head_crop import draw_window
from grmm.model import GRMM, HeadState, PinholeView
from grmm.render import orbit

PAPER_FPS, TARGET_FPS = 75, 200  # the paper's, and ours on one H200
NOISE = 0.01  # of the weights
DISTANCE_M, FILL = 1.0, 0.7  # camera to head; the head's height over the picture's


def scene(device: torch.device, n_g: int, size: int) -> tuple[GRMM, HeadState, PinholeView]:
    """Return a model of random weights, the template's head and a camera in front."""
    torch.manual_seed(0)
    head = load_head("procedural").to(device)
    settings = resolve("paper").model
    if n_g != settings.n_g:  # as many doublings as fit
        steps = int(math.log2(n_g // 8))
        settings = replace(settings, n_g=n_g, ladder=settings.ladder[-(steps - 1) :])
    model = GRMM(settings, head, ("S000",), ("neutral",)).to(device).eval()
    with torch.no_grad():
        for parameter in model.parameters():  # many start at zero
            parameter += NOISE * torch.randn_like(parameter)
    zeros = head.template.new_zeros
    state = HeadState(
        vertices=head.template,
        shape=zeros(head.shape_dirs.shape[2]),
        expression=zeros(len(head.expression_names)),
        neck=zeros(3),
        jaw=zeros(3),
    )
    height = float(head.template[:, 1].max() - head.template[:, 1].min())
    focal = FILL * size * DISTANCE_M / height
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    centre = model.head_centre.cpu().double().numpy()
    pose = look_at(centre + [0.0, 0.0, DISTANCE_M], centre)
    camera = torch.from_numpy(pose)
    return (
        model,
        state,
        PinholeView(K=K.to(device), cam_from_head=camera.to(device), width=size, height=size),
    )


@torch.no_grad()
def frames_per_second(draw: Callable[[], object], seconds: float = 4.0) -> float:
    """Measure pictures per second by the clock, after five that are not counted."""
    for _ in range(5):
        draw()
    count, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds:
        draw()
        count += 1
    return round(count / (time.perf_counter() - began), 2)


def measure(device: torch.device, n_g: int, size: int, seconds: float) -> dict[str, object]:
    """Measure the frame rates of both ways."""
    model, state, front = scene(device, n_g, size)
    z_id, z_exp = model.z_id[0].detach(), model.z_exp[0].detach()
    centre = model.head_centre.cpu()
    views = itertools.cycle([orbit(front, 3.0 * turn, centre) for turn in range(-10, 11)])
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None

    def anew() -> None:
        model.render(z_id, z_exp, state, next(views))
        wait()

    with torch.no_grad():
        kept = model.geometry(z_id, z_exp, state)

    def cached() -> None:
        view = next(views)
        draw_window(model, kept, model.appearance(z_id, state, view), view)
        wait()

    rates: dict[str, object] = {
        "fps": frames_per_second(anew, seconds),
        "fps_with_savings": frames_per_second(cached, seconds),
    }
    return rates | {"gaussians": len(model.texels)}


def main() -> None:
    """Parse, measure, print."""
    parser = make_parser("fps", __doc__)
    parser.add_argument("--device", help="cuda where there is one")
    parser.add_argument("--n-g", type=int, default=512)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each way")
    args = parser.parse_args()
    name = args.device or ("cuda" if torch.cuda.is_available() else "")
    report: dict[str, object] = {"benchmark": "fps", "n_g": args.n_g, "size": args.size}
    report |= {"paper_fps": PAPER_FPS, "target_fps": TARGET_FPS}
    if not name:
        reason = "no CUDA device; --device cpu --n-g 128 --size 256 tries the code"
        report |= {"device": "n/a", "fps": "n/a", "fps_with_savings": "n/a", "reason": reason}
    else:
        device = torch.device(name)
        report["device"] = torch.cuda.get_device_name() if device.type == "cuda" else name
        report |= measure(device, args.n_g, args.size, args.seconds)
    print(json.dumps(report))


if __name__ == "__main__":
    main()
