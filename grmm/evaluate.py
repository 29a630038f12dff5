"""Measure renderings against footage, over the whole image and over the head.

Held-out samples are of different kinds: views of trained frames, frames of trained subjects and
expressions (a held-out expression), and subjects that training never saw (fitted first).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.functional.regression import mean_squared_error

from express50.errors import TrainError
from express50.files.atomic import write_bytes, write_json
from grmm.checkpoint import Gallery
from grmm.config import MetricsConfig
from grmm.data import HeadViews, Item, SampleKey
from grmm.model import GRMM
from grmm.perceptual_metrics import PerceptualMetrics
from grmm.scene import Rendering

Render = Callable[[Item], Rendering]
Row = dict[str, str | float]
IMAGE_NUMBERS = (
    "psnr_db", "psnr_head_db", "psnr_with_torso_db", "ssim", "ssim_head", "rmse", "rmse_head",
    "lpips",
)  # fmt: skip
NUMBERS = (*IMAGE_NUMBERS, "psnr_unrefined_db", "depth_mm")
SEEN, HELD_VIEW, HELD_EXPRESSION, HELD_IDENTITY = (
    "seen view", "held-out view", "held-out expression", "held-out identity",
)  # fmt: skip
IDS = ("subject", "expression", "camera", "kind")
PSNR_LIMIT_DB = 100.0  # equal images: a number that averages, where infinity would not
SSIM_SIGMA, SSIM_WINDOW = 1.5, 11  # Wang et al. 2004


def psnr_db(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return peak signal-to-noise ratio of (3, H, W) images in [0, 1], decibels, at most 100.

    ``mask`` (H, W) bool limits it to some pixels; NaN if it selects none.
    """
    squared = (image.clamp(0, 1).double() - target.double()).square()
    if mask is not None:
        squared = squared[:, mask]
        if squared.numel() == 0:
            return math.nan
    return float((-10 * torch.log10(squared.mean())).clamp(max=PSNR_LIMIT_DB))


def rmse(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Compute the RMSE of (3, H, W) images in [0, 1]; NaN if the mask selects nothing."""
    a, b = image.clamp(0, 1).double(), target.double()
    if mask is not None:
        a, b = a[:, mask], b[:, mask]
    if a.numel() == 0:
        return math.nan
    return float(mean_squared_error(a.reshape(-1), b.reshape(-1), squared=False))


def ssim_score(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean SSIM of (3, H, W) images; with a mask over windows centred on its pixels.

    Windows that reach over the border are left out. NaN where no window fits or is selected.
    """
    reach = SSIM_WINDOW // 2
    if min(image.shape[1:]) < SSIM_WINDOW:
        return math.nan
    _, values = structural_similarity_index_measure(
        image.clamp(0, 1).float()[None],
        target.float()[None],
        sigma=SSIM_SIGMA,
        kernel_size=SSIM_WINDOW,
        data_range=1.0,
        return_full_image=True,
    )
    inner = values[0, :, reach:-reach, reach:-reach]
    if mask is not None:
        inner = inner[:, mask[reach:-reach, reach:-reach]]
    return float(inner.mean()) if inner.numel() else math.nan


def training_render(model: GRMM, views: HeadViews) -> Render:
    """Make a function that renders training subjects by their rows of the code tables."""

    def render(item: Item) -> Rendering:
        subject = model.subjects.index(item.key.subject)
        expression = model.expressions.index(item.key.expression)
        return model(subject, expression, item.state, item.view, views.background)

    return render


def kind_of(key: SampleKey, subjects: Sequence[str], gallery: Gallery) -> str:
    """Say whether a checkpoint has seen a sample, or in which way it was held out."""
    if key.subject not in subjects:
        return HELD_IDENTITY
    if (key.subject, key.expression) not in gallery.frames:
        return HELD_EXPRESSION
    return SEEN if key.camera in gallery.cameras else HELD_VIEW


def compare(image: Tensor, item: Item, judge: PerceptualMetrics) -> dict[str, float]:
    """Compare one picture (3, H, W) in [0, 1] with its footage.

    ``psnr_db``, ``ssim``, ``rmse``, ``lpips`` count every pixel but torso (DataConfig.torso);
    ``*_head`` pixels of the footage's matte only, so that an easy background cannot flatter.

    Raises:
        TrainError: the picture is not finite; a mean would pass over it in silence.
    """
    if not bool(torch.isfinite(image).all()):
        raise TrainError(
            f"{item.key}: the rendering holds NaN or Inf; expected colours. The checkpoint is "
            "damaged or was trained at too high a rate"
        )
    shown = item.comparable(image)
    return {
        "psnr_db": psnr_db(image, item.target, item.counts),
        "psnr_head_db": psnr_db(image, item.target, item.mask),
        "psnr_with_torso_db": psnr_db(image, item.target),
        "ssim": ssim_score(shown, item.target),
        "ssim_head": ssim_score(shown, item.target, item.mask),
        "rmse": rmse(image, item.target, item.counts),
        "rmse_head": rmse(image, item.target, item.mask),
        "lpips": judge.lpips_of(shown, item.target),
    }


@torch.no_grad()
def evaluate(
    views: HeadViews,
    indices: Sequence[int],
    render: Render,
    judge: PerceptualMetrics | None = None,
    kind: Callable[[SampleKey], str] = lambda key: "",
    keep: Callable[[int, Tensor], None] | None = None,
) -> list[Row]:
    """Measure samples: one row of numbers each; see `compare`.

    ``depth_mm`` is the median absolute error where both depths are known (NaN: nowhere). ``keep``
    gets every index with its picture (3, H, W).
    """
    judge = PerceptualMetrics(MetricsConfig()) if judge is None else judge
    rows = []
    for index in indices:
        item = views.item(index)
        out = render(item)
        both = item.depth_valid & (out.alpha > 0.5)
        error = (out.depth - item.depth)[both].abs()
        numbers = compare(out.image, item, judge) | {
            "psnr_unrefined_db": psnr_db(out.rgb, item.target, item.counts),
            "depth_mm": 1e3 * float(error.median()) if len(error) else math.nan,
        }
        rows.append(row_of(item.key, kind(item.key), numbers))
        judge.remember(kind(item.key), item.comparable(out.image), item.target)
        if keep is not None:
            keep(index, out.image)
    return rows


def row_of(key: SampleKey, kind: str, numbers: dict[str, float]) -> Row:
    """Return the ids and numbers of one sample."""
    return Row(
        subject=key.subject, expression=key.expression, camera=key.camera, kind=kind, **numbers
    )


def mean(rows: Sequence[Row], name: str) -> float | None:
    """Return the mean of one number over the rows that have it, rounded; None if none has."""
    values = [float(row[name]) for row in rows if not math.isnan(float(row.get(name, math.nan)))]
    return round(sum(values) / len(values), 4) if values else None


def means(rows: Sequence[Row]) -> dict[str, object]:
    """Return the means of all numbers, and of how many images."""
    numbers: dict[str, object] = {name: mean(rows, name) for name in NUMBERS}
    return numbers | {"images": len(rows)}


def summarise(rows: Sequence[Row], judge: PerceptualMetrics | None = None) -> dict[str, object]:
    """Average all rows, and per kind, subject, expression and camera; say why metrics are n/a."""
    judge = PerceptualMetrics(MetricsConfig()) if judge is None else judge
    summary: dict[str, object] = means(rows) | {"fid": judge.fid()} | judge.missing()
    for group in IDS:
        values = sorted({str(row[group]) for row in rows if row[group]})
        summary[f"by_{group}"] = {
            value: means([row for row in rows if row[group] == value])
            | ({"fid": judge.fid(value)} if group == "kind" and judge.inception else {})
            for value in values
        }
    return summary


def write_evaluation(
    out: Path, rows: Sequence[Row], judge: PerceptualMetrics | None = None
) -> dict[str, object]:
    """Write evaluation.csv (one row per image) and evaluation.json (means); returns the means."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=[*IDS, *NUMBERS], lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()} for row in rows
    )
    write_bytes(out / "evaluation.csv", buffer.getvalue().encode())
    summary = summarise(rows, judge)
    write_json(out / "evaluation.json", summary)
    return summary


def summary_lines(summary: dict) -> list[str]:
    """Format a summary for a terminal: one line per kind, then the metrics that are n/a."""
    names = ("psnr_db", "psnr_head_db", "ssim", "rmse", "lpips")
    lines = []
    for kind, numbers in (summary["by_kind"] or {"all": summary}).items():
        values = "  ".join(f"{name} {numbers[name]}" for name in names if numbers[name] is not None)
        lines.append(f"{kind} ({numbers['images']} images): {values}")
    return lines + [f"{k}: {summary[k]}" for k in ("lpips", "fid") if "n/a" in str(summary[k])]
