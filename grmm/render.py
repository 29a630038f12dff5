"""Render pictures and videos from a model: novel views, turntables, grids, interpolation."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch
from torch import Tensor

from express50.console import log
from express50.dataset import tracks
from express50.errors import ConfigError, check_known
from express50.files.images import write_image
from express50.files.video import BT601, LIMITED
from express50.geometry.pixels import contact_sheet
from grmm.checkpoint import Checkpoint
from grmm.data import HeadViews, stacked
from grmm.edit import (
    HeadCodes,
    between,
    controlled,
    principal_directions,
    sample_expression,
    sample_identity,
    trained_head,
    with_expression,
)
from grmm.evaluate import Render
from grmm.head_crop import draw_window, without_neck_end
from grmm.model import PinholeView
from grmm.networks import normalise_depth

YAWS, PITCHES = (-60, -30, 0, 30, 60), (20, 0, -20)  # degrees of the sheet of novel views
Sheet = tuple[list[list[np.ndarray]], list[str], list[str]]
"""Rows of pictures, a label per row, a caption per column."""
COLUMNS = "footage, refined, drawn, depth, error times four"  # of comparison sheets
FILES = (
    "turntable.mp4", "interpolation.mp4", "driven.mp4", "samples.jpg", "views.jpg", "controls.jpg",
    "transfer.jpg",
)  # fmt: skip
"""What `grmm render` draws if asked to."""
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
TURNS = {"neck, yaw": ("neck.1", 0.35), "eyes, yaw": ("eyes", 0.4)}  # radians of a step of 1
CONTROL_ROWS = 9  # most rows of `control_sheet`
SHEET_LIMIT = 65_000  # pixels; a JPEG has at most 65,500 per side
JAW_OPEN = 0.35  # radians
DEVIATIONS = 1.5  # standard deviations a step of 1 moves a code


def to_uint8(image: Tensor) -> np.ndarray:
    """Convert (3, H, W) in [0, 1] to (H, W, 3) uint8."""
    return (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()


@torch.no_grad()
def comparison_sheet(path: Path, views: HeadViews, indices: Sequence[int], render: Render) -> None:
    """Write rows of pictures in the order of COLUMNS."""
    rows, labels = [], []
    for index in indices:
        item = views.item(index)
        out = item.hide_behind_torso(render(item))
        pictures = [to_uint8(image) for image in (item.target, out.image, out.rgb)]
        alpha = item.fill_behind_torso(out.alpha, out.depth, 0.0)
        near_is_bright = 1 - 0.85 * normalise_depth(out.depth, alpha)
        grey = torch.where(alpha > 0.5, near_is_bright, 0.0)
        pictures.append(to_uint8(grey[None].expand(3, -1, -1)))
        pictures.append(to_uint8(4 * (out.image - item.target).abs()))
        rows.append(pictures)
        labels.append(f"{item.key.subject} {item.key.expression} {item.key.camera}")
    write_sheet(path, rows, labels, COLUMNS.split(", "))


def orbit(view: PinholeView, degrees: float, centre: Tensor, pitch: float = 0.0) -> PinholeView:
    """Turn a view about ``centre`` (3,) in head space.

    ``degrees`` about the vertical axis, after ``pitch`` degrees about the camera's own horizontal
    axis (positive: seen from above).
    """
    pivot = centre.to(view.cam_from_head.device, torch.float64)
    turn = _rotation(math.radians(degrees), 0, pivot)
    camera = view.cam_from_head.double() @ turn
    if pitch:
        seen = camera[:3, :3] @ pivot + camera[:3, 3]
        camera = _rotation(math.radians(-pitch), 1, seen) @ camera
    return replace(view, cam_from_head=camera)


def _rotation(angle: float, axis: int, pivot: Tensor) -> Tensor:
    """Return (4, 4) rotation by radians from axis z to ``axis``, about a point (3,)."""
    turn = torch.eye(4, dtype=torch.float64, device=pivot.device)
    turn[axis, axis] = turn[2, 2] = math.cos(angle)
    turn[axis, 2], turn[2, axis] = math.sin(angle), -math.sin(angle)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return turn


def resized(view: PinholeView, longest_px: int) -> PinholeView:
    """Resize a camera so that its longer side is ``longest_px``."""
    scale = longest_px / max(view.width, view.height)
    width, height = (max(1, round(scale * side)) for side in (view.width, view.height))
    K = view.K.clone()
    K[0] *= width / view.width
    K[1] *= height / view.height
    return replace(view, K=K, width=width, height=height)


def frontal(loaded: Checkpoint) -> PinholeView:
    """Choose the training camera that looks at the face most nearly along -z."""
    cameras = loaded.gallery.cameras
    best = max(sorted(cameras), key=lambda name: float(cameras[name].direction()[2]))
    return cameras[best]


def camera_of(loaded: Checkpoint, name: str | None, size: int = 0) -> PinholeView:
    """Look up a camera of the checkpoint by id; ``size`` 0: its own.

    By default it is the frontal one, widened so that the head stays in the picture as it turns.

    Raises:
        ConfigError: the checkpoint has no such camera.
    """
    cameras = loaded.gallery.cameras
    check_known("the checkpoint", "camera", [] if name is None else [name], cameras)
    view = with_room(frontal(loaded), loaded) if name is None else cameras[name]
    return resized(view, size) if size else view


def with_room(view: PinholeView, loaded: Checkpoint) -> PinholeView:
    """Widen a picture until it shows the head model's template turned to any side.

    Photographs often end beside the ears, where a turned head has its nose.
    """
    centre = loaded.model.head_centre.double()
    reach = (loaded.head.template.to(centre) - centre)[:, [0, 2]].norm(dim=1).max()
    x, _, ahead = view.cam_from_head[:3, :3].double() @ centre + view.cam_from_head[:3, 3].double()
    middle = float(view.K[0, 2] + view.K[0, 0] * x / ahead)
    half = float(view.K[0, 0] * reach / ahead)
    left, right = (max(0, math.ceil(half - room)) for room in (middle, view.width - middle))
    K = view.K.clone()
    K[0, 2] += left
    return replace(view, K=K, width=left + view.width + right)


def picture(loaded: Checkpoint, head: HeadCodes, view: PinholeView) -> np.ndarray:
    """Draw one head from one view, (H, W, 3) uint8."""
    return next(iter(draw_views(loaded, head, [view])))


@torch.no_grad()
def draw_views(
    loaded: Checkpoint, head: HeadCodes, views: Iterable[PinholeView]
) -> Iterable[np.ndarray]:
    """Yield a head from each view, its neck cut; its geometry is decoded once for all of them."""
    model, state = loaded.model, head.state(loaded)
    gaussians = model.geometry(head.z_id, head.z_exp, state)
    gaussians = without_neck_end(loaded.head, state.vertices, gaussians)
    for view in views:
        colours = model.appearance(head.z_id, state, view)
        background = loaded.config.data.background
        yield to_uint8(draw_window(model, gaussians, colours, view, background).image)


def turntable(
    loaded: Checkpoint, head: HeadCodes, view: PinholeView, frames: int, degrees: float = 360.0
) -> Iterable[np.ndarray]:
    """Yield (H, W, 3) frames of an orbit that starts at ``view``."""
    centre = loaded.model.head_centre
    views = (orbit(view, degrees * number / frames, centre) for number in range(frames))
    return draw_views(loaded, head, views)


def novel_views(loaded: Checkpoint, head: HeadCodes, view: PinholeView) -> Sheet:
    """Draw rows of PITCHES and columns of YAWS, degrees, around ``view``."""
    centre = loaded.model.head_centre
    views = (orbit(view, yaw, centre, pitch) for pitch in PITCHES for yaw in YAWS)
    pictures = list(draw_views(loaded, head, views))
    rows = [pictures[i : i + len(YAWS)] for i in range(0, len(pictures), len(YAWS))]
    return rows, [f"pitch {p:+d}" for p in PITCHES], [f"yaw {yaw:+d}" for yaw in YAWS]


def expression_grid(
    loaded: Checkpoint, subjects: Sequence[str], expressions: Sequence[str], view: PinholeView
) -> Sheet:
    """Draw every subject (rows) with every expression (columns).

    A subject without a tracked frame of an expression gets it by transfer.
    """
    rows = [
        [picture(loaded, trained_head(loaded, subject, e), view) for e in expressions]
        for subject in subjects
    ]
    return rows, list(subjects), list(expressions)


def interpolation(
    loaded: Checkpoint, start: HeadCodes, end: HeadCodes, view: PinholeView, frames: int
) -> Iterable[np.ndarray]:
    """Yield frames from one head to another."""
    for number in range(frames):
        yield picture(loaded, between(start, end, number / max(1, frames - 1)), view)


def control_sheet(loaded: Checkpoint, head: HeadCodes, view: PinholeView) -> Sheet:
    """Draw rows that change one thing each (the paper's figure of disentangled control).

    Jaw, neck, eyes; the strongest expression coefficients of training; the first principal
    directions of both codes, where there are any.
    """
    changes: dict[str, list[dict[str, tuple[float, ...]]]] = {
        f"jaw: 0 to {JAW_OPEN} rad": [
            {"jaw": (JAW_OPEN * (step + 1) / 2, 0.0, 0.0)} for step in STEPS
        ]
    }
    for label, (name, reach) in TURNS.items():
        values = [reach * step for step in STEPS]
        changes[f"{label}: {values[0]} to {reach} rad"] = [
            {name: (0.0, v, 0.0) if name == "eyes" else (v,)} for v in values
        ]
    for number, size in strongest_coefficients(loaded, 2).items():
        label, name = loaded.head.expression_names[number], f"expression.{number}"
        values = [size * (step + 1) / 2 for step in STEPS]
        changes[f"{label}: 0 to {size:.2g}"] = [{name: (v,)} for v in values]
    for code in ("z_id", "z_exp"):
        for number in range(min(2, len(principal_directions(getattr(loaded.model, code))))):
            name = f"{code}.{number}"
            reach = DEVIATIONS
            changes[f"{name}: {-reach} to {reach}"] = [{name: (reach * step,)} for step in STEPS]
    rows = [
        [picture(loaded, controlled(loaded, head, change), view) for change in row]
        for row in changes.values()
    ]
    return rows, list(changes), []


def strongest_coefficients(loaded: Checkpoint, count: int) -> dict[int, float]:
    """Find the expression coefficients that vary most in training, and how large each gets."""
    rows = stacked([frame.expression for frame in loaded.gallery.frames.values()])
    order = np.argsort(-np.std(rows, axis=0), kind="stable")[:count]
    return {int(number): float(np.abs(rows[:, number]).max()) for number in order}


def residual_sheet(
    loaded: Checkpoint, identity: HeadCodes, expression: HeadCodes, view: PinholeView
) -> Sheet:
    """Take a transfer apart: head-model parameters and residual code, alone and together.

    Columns: neither, parameters alone, code alone, both, and both with z_exp = 0, which shows
    what the expression code carries (the paper's supplement, figure on the extended UV map).
    """
    both = with_expression(identity, expression)
    heads = [
        identity,
        replace(identity, tracked=both.tracked),
        replace(identity, z_exp=expression.z_exp),
        both,
        controlled(loaded, both, {"z_exp": (0.0,)}),
        expression,
    ]
    captions = ["identity", "parameters moved", "z_exp moved", "both", "both, z_exp = 0", "donor"]
    return [[picture(loaded, head, view) for head in heads]], [], captions


def sample_sheet(
    loaded: Checkpoint,
    head: HeadCodes,
    view: PinholeView,
    count: int,
    seed: int,
    spread: float = 1.0,
) -> Sheet:
    """Draw three rows of samples: new people, new expressions, both."""
    rng = np.random.default_rng(seed)
    neutral = head
    if "neutral" in loaded.model.expressions:
        neutral = trained_head(loaded, loaded.model.subjects[0], "neutral")
    people = [sample_identity(loaded, neutral, rng, spread) for _ in range(count)]
    faces = [sample_expression(loaded, head, rng, spread) for _ in range(count)]
    rows = {
        "new people": people,
        "new expressions": faces,
        "both": [sample_expression(loaded, person, rng, spread) for person in people],
    }
    pictures = [[picture(loaded, one, view) for one in row] for row in rows.values()]
    return pictures, list(rows), []


def driven(
    loaded: Checkpoint, head: HeadCodes, clips: tracks.Sequence, view: PinholeView
) -> Iterable[np.ndarray]:
    """Return pictures of the head with expression, jaw, neck and eyes of tracked clips' frames.

    They are drawn one by one; its own shape and residual codes stay.

    Raises:
        ConfigError: the clips were tracked with another head model.
    """
    check_clips(loaded, clips)

    def frame(row: int) -> np.ndarray:
        moved = {name: getattr(clips, name)[row] for name in ("expression", "neck", "jaw", "eyes")}
        return picture(loaded, replace(head, tracked=replace(head.tracked, **moved)), view)

    return map(frame, range(len(clips.frames)))


def check_clips(loaded: Checkpoint, clips: tracks.Sequence) -> None:
    """Refuse, with a ConfigError, clips that were tracked with another head model."""
    known = loaded.head.expression_dirs.shape[2]
    if Path(clips.head).name != Path(loaded.head_spec).name or clips.expression.shape[1] > known:
        raise ConfigError(
            f"the clips were tracked with head model {clips.head!r} of {clips.expression.shape[1]}"
            f" expressions, the checkpoint has {loaded.head_spec!r} of {known}; track them with it"
        )


def read_clips(path: Path, cue: str | None = None) -> tracks.Sequence:
    """Read tracked clips, all of them or the one of a cue; ConfigError if no clip has this cue."""
    clips = tracks.read_sequence(path)
    if cue is None:
        return clips
    check_known(str(path), "clip of cue", [cue], dict.fromkeys(clips.cues))
    rows = [i for i, name in enumerate(clips.cues) if name == cue]
    parts = {name: getattr(clips, name)[rows] for name in tracks.OF_FRAMES}
    return replace(clips, cues=(cue,) * len(rows), **parts)


def set_aside(folder: Path, drawn: Collection[str]) -> None:
    """Move FILES of earlier calls, perhaps of another head, away; ``drawn`` are stems that stay."""
    paths = (folder / name for name in FILES)
    if old := [path for path in paths if path.stem not in drawn and path.is_file()]:
        earlier = folder / "earlier"
        earlier.mkdir(exist_ok=True)
        for path in old:
            path.replace(earlier / path.name)
        names = ", ".join(path.name for path in old)
        log(f"moved to {earlier}, because an earlier call drew it: {names}")


def write_sheet(
    path: Path, rows: Sequence[Sequence[np.ndarray]], labels: Sequence[str], captions: Sequence[str]
) -> None:
    """Write rows of pictures of one size as one picture, with labels and captions of columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, contact_sheet(rows, labels, rows[0][0].shape[:2], captions))


def write_video(path: Path, frames: Iterable[np.ndarray], rate: float = tracks.RIG_RATE) -> None:
    """Write (H, W, 3) uint8 frames as H.264; an odd last row or column is repeated.

    ``rate`` is in frames per second.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.part.mp4")
    try:
        with av.open(str(aside), "w") as container:
            stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1001))
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "16", "preset": "veryfast"}
            # What FFmpeg makes of RGB. Unsaid, players take BT.709 from 720 lines on.
            stream.codec_context.colorspace, stream.codec_context.color_range = BT601, LIMITED
            for number, frame in enumerate(frames):
                odd = [(0, side % 2) for side in frame.shape[:2]]
                even = np.pad(frame, [*odd, (0, 0)], mode="edge")
                if number == 0:
                    stream.height, stream.width = even.shape[:2]
                picture = av.VideoFrame.from_ndarray(even, format="rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
