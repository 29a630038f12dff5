"""Measure renderings against footage: PSNR and SSIM, over the whole image and over the head."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from express50.publish import write_bytes, write_json
from grmm.data import HeadViews, Item
from grmm.metrics import UNAVAILABLE, psnr_db, ssim_score
from grmm.model import GRMM, Rendering

Render = Callable[[Item], Rendering]
Row = dict[str, str | float]
NUMBERS = (
    "psnr_db", "psnr_head_db", "psnr_with_torso_db", "ssim", "ssim_head", "psnr_unrefined_db",
    "depth_mm",
)  # fmt: skip


def training_render(model: GRMM, views: HeadViews) -> Render:
    """How a training subject and expression is rendered: with its rows of the code tables."""

    def render(item: Item) -> Rendering:
        subject = model.subjects.index(item.key.subject)
        expression = model.expressions.index(item.key.expression)
        return model(subject, expression, item.state, item.view, views.background)

    return render


@torch.no_grad()
def evaluate(views: HeadViews, indices: Sequence[int], render: Render) -> list[Row]:
    """One row of numbers per sample.

    ``psnr_db`` and ``ssim`` count every pixel but torso (DataConfig.torso); ``*_head`` pixels of
    the footage's matte only, so that an easy background cannot flatter; ``depth_mm`` is the median
    absolute error where both depths are known (NaN: nowhere).
    """
    rows = []
    for index in indices:
        item = views.item(index)
        out = render(item)
        both = item.depth_valid & (out.alpha > 0.5)
        error = (out.depth - item.depth)[both].abs()
        rows.append(
            Row(
                subject=item.key.subject,
                expression=item.key.expression,
                camera=item.key.camera,
                psnr_db=psnr_db(out.image, item.target, item.counts),
                psnr_head_db=psnr_db(out.image, item.target, item.mask),
                psnr_with_torso_db=psnr_db(out.image, item.target),
                ssim=ssim_score(item.comparable(out.image), item.target),
                ssim_head=ssim_score(item.comparable(out.image), item.target, item.mask),
                psnr_unrefined_db=psnr_db(out.rgb, item.target, item.counts),
                depth_mm=1e3 * float(error.median()) if len(error) else math.nan,
            )
        )
    return rows


def mean(rows: Sequence[Row], name: str) -> float | None:
    """Mean of one number over the rows that have it, rounded; None if none has."""
    values = [float(row[name]) for row in rows if not math.isnan(float(row[name]))]
    return round(sum(values) / len(values), 4) if values else None


def summarise(rows: Sequence[Row]) -> dict[str, object]:
    """Means over all rows and per subject, expression and camera, with what cannot be measured."""
    summary: dict[str, object] = {name: mean(rows, name) for name in NUMBERS}
    summary["images"] = len(rows)
    for group in ("subject", "expression", "camera"):
        summary[f"by_{group}"] = {
            value: {
                name: mean([row for row in rows if row[group] == value], name) for name in NUMBERS
            }
            for value in sorted({str(row[group]) for row in rows})
        }
    return summary | UNAVAILABLE


def write_evaluation(out: Path, rows: Sequence[Row]) -> dict[str, object]:
    """Write evaluation.csv (one row an image) and evaluation.json (means); returns the means."""
    buffer = io.StringIO()
    writer = csv.DictWriter(
        buffer, fieldnames=["subject", "expression", "camera", *NUMBERS], lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows(
        {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()} for row in rows
    )
    write_bytes(out / "evaluation.csv", buffer.getvalue().encode())
    summary = summarise(rows)
    write_json(out / "evaluation.json", summary)
    return summary
