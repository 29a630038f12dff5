"""Pictures and videos from a model: novel views, turntables, grids, transfer, interpolation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import av
import numpy as np
import torch
from torch import Tensor

from express50.images import contact_sheet, write_image
from express50.torch_transforms import axis_angle_to_quat, quat_to_axis_angle, slerp
from grmm.checkpoint import Loaded
from grmm.data import HeadViews, Tracked, pose_state
from grmm.evaluate import Render
from grmm.model import View

VIDEO_RATE = 24  # frames a second, as the rig's


def to_uint8(image: Tensor) -> np.ndarray:
    """(3, H, W) in [0, 1] -> (H, W, 3) uint8."""
    return (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()


def depth_picture(depth: Tensor, alpha: Tensor) -> np.ndarray:
    """(H, W) depth as grey (H, W, 3) uint8, near is bright; black where alpha <= 0.5."""
    mask = (alpha > 0.5) & torch.isfinite(depth)
    if not bool(mask.any()):
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = depth[mask].min(), depth[mask].max()
    grey = torch.where(mask, 1 - 0.85 * (depth - low) / (high - low).clamp_min(1e-6), 0.0)
    return to_uint8(grey[None].expand(3, -1, -1))


@torch.no_grad()
def comparison_sheet(path: Path, views: HeadViews, indices: Sequence[int], render: Render) -> None:
    """Write rows of footage | refined | rasterised | depth | error x 4."""
    rows, labels = [], []
    for index in indices:
        item = views.item(index)
        out = render(item)
        pictures = [to_uint8(image) for image in (item.target, out.image, out.rgb)]
        pictures.append(depth_picture(out.depth, out.alpha))
        pictures.append(to_uint8(4 * (item.comparable(out.image) - item.target).abs()))
        rows.append(pictures)
        labels.append(f"{item.key.subject} {item.key.expression} {item.key.camera}")
    tile = (views.item(indices[0]).view.height, views.item(indices[0]).view.width)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, contact_sheet(rows, labels, tile))


def orbit(view: View, degrees: float, centre: Tensor) -> View:
    """The view turned about the vertical axis through ``centre`` (3,) in head space."""
    angle = math.radians(degrees)
    turn = torch.eye(4, dtype=torch.float64, device=view.cam_from_head.device)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    pivot = centre.to(turn)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    camera = view.cam_from_head.double() @ turn
    return View(K=view.K, cam_from_head=camera, width=view.width, height=view.height)


def frontal(loaded: Loaded) -> View:
    """The training camera that looks at the face most nearly along -z."""
    cameras = loaded.gallery.cameras
    best = max(sorted(cameras), key=lambda name: float(cameras[name].direction()[2]))
    return cameras[best]


@torch.no_grad()
def turntable(
    loaded: Loaded, subject: str, expression: str, frames: int = 72, degrees: float = 360.0
) -> Iterable[np.ndarray]:
    """Yield (H, W, 3) frames of an orbit; geometry is decoded once for all of them."""
    model = loaded.model
    state = loaded.state(subject, expression)
    z_id, z_exp = model.codes(model.subjects.index(subject), model.expressions.index(expression))
    gaussians = model.geometry(z_id, z_exp, state)
    first, centre = frontal(loaded), model.head_centre
    for number in range(frames):
        view = orbit(first, degrees * number / frames, centre)
        colours = model.appearance(z_id, state, view)
        yield to_uint8(model.draw(gaussians, colours, view, loaded.config.data.background).image)


@torch.no_grad()
def expression_grid(
    loaded: Loaded, subjects: Sequence[str], expressions: Sequence[str]
) -> list[list[np.ndarray]]:
    """Pictures of every subject (rows) with every expression (columns), frontal.

    A subject without a tracked frame of an expression gets it by transfer.
    """
    frames = loaded.gallery.frames
    return [
        [
            _picture(loaded, subject, expression, frames.get((subject, expression)))
            for expression in expressions
        ]
        for subject in subjects
    ]


def _picture(loaded: Loaded, subject: str, expression: str, tracked: Tracked | None) -> np.ndarray:
    model = loaded.model
    if tracked is None:
        donor = next(s for s, e in loaded.gallery.frames if e == expression)
        own = next(t for (s, _), t in loaded.gallery.frames.items() if s == subject)
        tracked = transfer(own, loaded.gallery.frames[donor, expression])
    state = pose_state(loaded.head, tracked)
    codes = model.codes(model.subjects.index(subject), model.expressions.index(expression))
    return to_uint8(
        model.render(*codes, state, frontal(loaded), loaded.config.data.background).image
    )


def transfer(identity: Tracked, expression: Tracked) -> Tracked:
    """Expression transfer: one frame's head and place, another's expression, jaw, neck and eyes."""
    return Tracked(
        shape=identity.shape,
        expression=expression.expression,
        neck=expression.neck,
        jaw=expression.jaw,
        eyes=expression.eyes,
        R=identity.R,
        t=identity.t,
        offsets=identity.offsets,
    )


def interpolate_tracked(a: Tracked, b: Tracked, t: float) -> Tracked:
    """Blend parameters from a (t = 0) to b (1): linear, but jaw, neck and eyes by SLERP.

    Source: the paper's supplement, locality regularisation; place (R, t) stays a's.
    """
    return Tracked(
        shape=_lerp(a.shape, b.shape, t),
        expression=_lerp(a.expression, b.expression, t),
        neck=slerp_axis_angle(a.neck, b.neck, t),
        jaw=slerp_axis_angle(a.jaw, b.jaw, t),
        eyes=np.concatenate(
            [slerp_axis_angle(a.eyes[i : i + 3], b.eyes[i : i + 3], t) for i in (0, 3)]
        ),
        R=a.R,
        t=a.t,
        offsets=_blend_offsets(a.offsets, b.offsets, t),
    )


def _blend_offsets(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """(1 - t) a + t b (V, 3); (0, 3) stands for zeros."""
    if not len(a) and not len(b):
        return a
    a, b = (x if len(x) else np.zeros_like(max(a, b, key=len)) for x in (a, b))
    return a if a is b else ((1 - t) * a + t * b).astype(np.float32)


def _lerp(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """(1 - t) a + t b; the shorter one is padded with zeros."""
    length = max(len(a), len(b))
    a, b = (np.pad(x, (0, length - len(x))) for x in (a, b))
    return (1 - t) * a + t * b


def slerp_axis_angle(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """Spherical interpolation of two axis-angle vectors (3,), radians, along the shorter arc."""
    quats = [
        axis_angle_to_quat(torch.as_tensor(np.asarray(x), dtype=torch.float64)) for x in (a, b)
    ]
    return quat_to_axis_angle(slerp(quats[0], quats[1], t)).numpy()


@torch.no_grad()
def interpolation(
    loaded: Loaded, start: tuple[str, str], end: tuple[str, str], frames: int = 48
) -> Iterable[np.ndarray]:
    """Yield frames from one (subject, expression) to another: codes and parameters are blended."""
    model, gallery = loaded.model, loaded.gallery.frames
    codes = [
        model.codes(model.subjects.index(subject), model.expressions.index(expression))
        for subject, expression in (start, end)
    ]
    view = frontal(loaded)
    for number in range(frames):
        t = number / max(1, frames - 1)
        state = pose_state(loaded.head, interpolate_tracked(gallery[start], gallery[end], t))
        z_id, z_exp = (torch.lerp(a, b, t) for a, b in zip(*codes, strict=True))
        yield to_uint8(model.render(z_id, z_exp, state, view, loaded.config.data.background).image)


def write_video(path: Path, frames: Iterable[np.ndarray], rate: int = VIDEO_RATE) -> int:
    """Write (H, W, 3) uint8 frames as H.264, odd last row or column cut; returns the count."""
    count = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.part.mp4")
    with av.open(str(aside), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16", "preset": "veryfast"}
        for frame in frames:
            even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
            if count == 0:
                stream.height, stream.width = even.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(picture))
            count += 1
        container.mux(stream.encode())
    aside.replace(path)
    return count
