"""Measure renderings against footage, over the whole image and over the head.

What was held out is told apart: views of trained frames, frames of trained subjects and
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

from express50.errors import TrainError
from express50.files.atomic import write_bytes, write_json
from grmm.checkpoint import Gallery
from grmm.config import MetricsConfig
from grmm.data import HeadViews, Item, Key
from grmm.judge import Judge
from grmm.metrics import psnr_db, rmse, ssim_score
from grmm.model import GRMM
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


def training_render(model: GRMM, views: HeadViews) -> Render:
    """How a training subject and expression is rendered: with its rows of the code tables."""

    def render(item: Item) -> Rendering:
        subject = model.subjects.index(item.key.subject)
        expression = model.expressions.index(item.key.expression)
        return model(subject, expression, item.state, item.view, views.background)

    return render


def kind_of(key: Key, subjects: Sequence[str], gallery: Gallery) -> str:
    """What a sample is to a checkpoint: seen in training (or fitting), or held out in which way."""
    if key.subject not in subjects:
        return HELD_IDENTITY
    if (key.subject, key.expression) not in gallery.frames:
        return HELD_EXPRESSION
    return SEEN if key.camera in gallery.cameras else HELD_VIEW


def compare(image: Tensor, item: Item, judge: Judge) -> dict[str, float]:
    """The numbers of one picture (3, H, W) in [0, 1] beside its footage.

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
    judge: Judge | None = None,
    kind: Callable[[Key], str] = lambda key: "",
    keep: Callable[[int, Tensor], None] | None = None,
) -> list[Row]:
    """One row of numbers per sample; see `compare`.

    ``depth_mm`` is the median absolute error where both depths are known (NaN: nowhere). ``keep``
    gets every index with its picture (3, H, W).
    """
    judge = Judge(MetricsConfig()) if judge is None else judge
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


def row_of(key: Key, kind: str, numbers: dict[str, float]) -> Row:
    """Ids and numbers of one sample."""
    return Row(
        subject=key.subject, expression=key.expression, camera=key.camera, kind=kind, **numbers
    )


def mean(rows: Sequence[Row], name: str) -> float | None:
    """Mean of one number over the rows that have it, rounded; None if none has."""
    values = [float(row[name]) for row in rows if not math.isnan(float(row.get(name, math.nan)))]
    return round(sum(values) / len(values), 4) if values else None


def means(rows: Sequence[Row]) -> dict[str, object]:
    """Means of all numbers, and of how many images."""
    numbers: dict[str, object] = {name: mean(rows, name) for name in NUMBERS}
    return numbers | {"images": len(rows)}


def summarise(rows: Sequence[Row], judge: Judge | None = None) -> dict[str, object]:
    """Means over all rows and per kind, subject, expression and camera; reasons for what is n/a."""
    judge = Judge(MetricsConfig()) if judge is None else judge
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
    out: Path, rows: Sequence[Row], judge: Judge | None = None
) -> dict[str, object]:
    """Write evaluation.csv (one row an image) and evaluation.json (means); returns the means."""
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
    """What a terminal shows of a summary: one line a kind, then what cannot be measured."""
    names = ("psnr_db", "psnr_head_db", "ssim", "rmse", "lpips")
    lines = []
    for kind, numbers in (summary["by_kind"] or {"all": summary}).items():
        values = "  ".join(f"{name} {numbers[name]}" for name in names if numbers[name] is not None)
        lines.append(f"{kind} ({numbers['images']} images): {values}")
    return lines + [f"{k}: {summary[k]}" for k in ("lpips", "fid") if "n/a" in str(summary[k])]
