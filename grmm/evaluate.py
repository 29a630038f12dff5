"""Measure renderings against footage, over the whole image and over the head.

Held-out samples are views of trained frames, unseen frames of trained subjects and expressions, or
subjects that training never saw (fitted first). Another method's pictures are compared in the same
way as our renderings: with the same crop, background and pixels.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from express50.console import count, figure_label, format_seconds, format_table, log
from express50.contract.segmentation_labels import label_mask
from express50.errors import CaptureError, ConfigError, DivergedError, FormatError, few
from express50.files.atomic import naming_full_disk, write_csv, write_json
from express50.files.containers import read_srgb
from express50.files.images import write_image
from express50.files.text import is_number, no_folder
from express50.shards.writer import sample_key
from grmm.checkpoint import Checkpoint
from grmm.config import MetricsConfig
from grmm.data import HeadView, HeadViews, SampleKey
from grmm.metrics import PerceptualMetrics, psnr_db, rmse, ssim_score
from grmm.model import GRMM, Rendering
from grmm.train_state import SAY_SECONDS

Render = Callable[[HeadView], Rendering]
Row = dict[str, str | float]
Window = Callable[[int], tuple[slice, slice, tuple[int, int]]]
"""Rows and columns of a sample's picture that its camera saw, and the picture's (H, W)."""
IDS = ("subject", "expression", "camera", "kind")
REGIONS = {
    "mouth": ("lips", "teeth", "tongue", "mouth"), "eyes": ("eyes",), "skin": ("skin", "ears"),
    "hair": ("hair",),
}  # fmt: skip
LEAST_PX = 20  # in a region; the PSNR of fewer pixels is unreliable
PSNRS = ("psnr_db", "psnr_head_db", *(f"psnr_{region}_db" for region in REGIONS))
NUMBERS = (
    *PSNRS, "ssim", "ssim_head", "rmse", "rmse_head",
    "lpips", "psnr_unrefined_db", "depth_mm",
)  # fmt: skip
SEEN, HELD_VIEW, HELD_EXPRESSION, HELD_IDENTITY = (
    "seen view", "held-out view", "held-out expression", "held-out identity",
)  # fmt: skip
COMPONENTS = {"z_exp": "z_exp", "mesh_decoder": "mesh", "refinement": "refinement"}
SUFFIXES = (".png", ".jpg", ".jpeg")
NO_NETWORKS = PerceptualMetrics(MetricsConfig())
NAMED = 5  # most files that an error names


@dataclass(frozen=True)
class Journal:
    """A file of rows measured so far, from which a measurement that was stopped continues."""

    path: Path
    made_from: str  # stands for everything that the rows depend on, except the code


def training_render(model: GRMM, views: HeadViews) -> Render:
    """Make a function that renders training subjects by their rows of the code tables."""

    def render(item: HeadView) -> Rendering:
        return model(*model.rows(*item.key.frame), item.state, item.view, views.background)

    return render


def kind_of(loaded: Checkpoint, key: SampleKey) -> str:
    """Return whether a checkpoint has seen a sample, or how it was held out."""
    if key.subject not in loaded.model.subjects:
        return HELD_IDENTITY
    if (key.expression, key.camera) in (loaded.seen_before or ()):
        return SEEN
    if key.frame not in loaded.gallery.frames:
        return HELD_EXPRESSION
    return SEEN if key.camera in loaded.gallery.cameras else HELD_VIEW


@torch.no_grad()
def evaluate(
    views: HeadViews,
    indices: Sequence[int],
    render: Render,
    judge: PerceptualMetrics = NO_NETWORKS,
    kind: Callable[[SampleKey], str] = lambda key: "",
    keep: Callable[[int, Tensor], None] | None = None,
    journal: Journal | None = None,
) -> list[Row]:
    """Measure samples, one row of numbers each; see `compare`.

    ``depth_mm`` is the median absolute error where both depths are known (NaN: nowhere). ``keep``
    gets every index with its picture (3, H, W). What the ``journal`` holds is not measured again,
    unless the ``judge`` needs all pictures, for FID.
    """
    rows, known = [], {} if judge.inception else journal_rows(journal)
    for index in _with_progress(indices):
        key = views.keys[index]
        if held := known.get((*vars(key).values(), kind(key))):
            rows.append(held)
            continue
        item = views.item(index)
        out = item.hide_behind_torso(render(item))
        both = item.depth_valid & (out.alpha > 0.5)
        error = (out.depth - item.depth)[both].abs()
        row = compare(out.image, item, judge, kind(item.key))
        row["psnr_unrefined_db"] = psnr_db(out.rgb, item.target, ~item.hidden)
        row["depth_mm"] = 1e3 * float(error.median()) if len(error) else math.nan
        rows.append(row)
        if keep is not None:
            keep(index, out.image)
        if journal is not None:
            line = json.dumps({"made_from": journal.made_from, "row": row})
            with naming_full_disk(journal.path), journal.path.open("a", encoding="utf-8") as file:
                file.write(f"\n{line}")  # the break first: it ends a line that was cut short
    return rows


def _with_progress(indices: Collection[int]) -> Iterator[int]:
    """Yield indices of images to measure, and say from time to time how many were."""
    began = said = time.perf_counter()
    for number, index in enumerate(indices):
        now = time.perf_counter()
        if number and now - said >= SAY_SECONDS:
            said = now
            left = format_seconds((now - began) / number * (len(indices) - number))
            log(f"measured {number} of {count(len(indices), 'image')}, {left} left")
        yield index


def journal_rows(journal: Journal | None) -> dict[tuple[str | float, ...], Row]:
    """Read the rows of a journal by their IDS; those made from something else do not count."""
    rows: dict[tuple[str | float, ...], Row] = {}
    if journal is None or not journal.path.exists():
        return rows
    for line in journal.path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            entry = json.loads(line)
            if entry["made_from"] == journal.made_from:
                rows[tuple(entry["row"][name] for name in IDS)] = entry["row"]
        except (ValueError, KeyError, TypeError):  # cut short when the measurement was stopped
            continue
    return rows


def compare(image: Tensor, item: HeadView, judge: PerceptualMetrics, kind: str = "") -> Row:
    """Compare one picture (3, H, W) in [0, 1] with its footage; the judge remembers it for FID.

    ``psnr_db``, ``ssim``, ``rmse``, ``lpips`` count every pixel in which no torso hides the neck;
    ``*_head`` pixels of the footage's matte only, because the background is easy;
    those of REGIONS pixels with such labels (NaN without labels, and under LEAST_PX).

    Raises:
        DivergedError: the picture is not finite; a mean would silently skip it.
    """
    if not bool(torch.isfinite(image).all()):
        raise DivergedError(
            f"{item.key.name}: the rendering holds NaN or Inf; expected colours. The checkpoint is "
            "damaged or was trained at too high a rate"
        )
    shown = item.comparable(image)
    judge.remember(kind, shown, item.target)
    regions: Row = {}
    for region, labels in REGIONS.items():
        mask = np.zeros((1, 1), bool) if item.parts is None else label_mask(item.parts, *labels)
        own = torch.from_numpy(mask).to(image.device)
        known = mask.sum() >= LEAST_PX
        regions[f"psnr_{region}_db"] = psnr_db(image, item.target, own) if known else math.nan
    return {
        **vars(item.key),
        "kind": kind,
        "psnr_db": psnr_db(image, item.target, ~item.hidden),
        "psnr_head_db": psnr_db(image, item.target, item.mask),
        **regions,
        "ssim": ssim_score(shown, item.target),
        "ssim_head": ssim_score(shown, item.target, item.mask),
        "rmse": rmse(image, item.target, ~item.hidden),
        "rmse_head": rmse(image, item.target, item.mask),
        "lpips": judge.lpips_of(shown, item.target),
    }


def component_effects(
    model: GRMM, views: HeadViews, indices: Sequence[int]
) -> dict[str, dict[str, float | None]]:
    """Measure how much each component of the model improves samples, dB; 0: no effect.

    ``z_exp`` is set to 0, the mesh decoder and the refinement are left out; the rest stays as it
    was trained with them.
    """
    whole, effects = evaluate(views, indices, training_render(model, views)), {}
    for name, attribute in COMPONENTS.items():
        part = getattr(model, attribute)
        if part is None or (name == "z_exp" and not model.config.residual_codes):
            continue
        try:
            zero = torch.nn.Parameter(torch.zeros_like(part)) if name == "z_exp" else None
            setattr(model, attribute, zero)
            rows = evaluate(views, indices, training_render(model, views))
        finally:
            setattr(model, attribute, part)
        effects[name] = {number: difference(whole, rows, number) for number in PSNRS}
    return effects


def difference(rows: Sequence[Row], others: Sequence[Row], name: str) -> float | None:
    """Return the mean of one number minus that of other rows; None if either has none."""
    a, b = mean(rows, name), mean(others, name)
    return None if a is None or b is None else round(a - b, 4)


@torch.no_grad()
def score(
    folder: Path,
    window: Window,
    views: HeadViews,
    indices: Sequence[int],
    judge: PerceptualMetrics,
    partial: bool = False,
) -> list[Row]:
    """Score pictures that any method made, one row each.

    They are named ``<subject>_<expression>_<camera>.png`` (or .jpg) and have the size as packed.
    ``partial`` leaves samples without a picture out.

    Raises:
        FormatError: pictures are missing, unreadable or of the wrong size; lists them.
    """
    if not folder.is_dir():
        raise FormatError(f"{folder}: {no_folder(folder)}; expected a folder of pictures")
    paths: dict[int, Path] = {}
    missing = []
    for index in indices:
        if found := find_picture(folder, views.keys[index]):
            paths[index] = found
        else:
            missing.append(sample_key(**vars(views.keys[index])))
    if missing and not (partial and paths):
        part = "score part of them with --partial or choose samples with --subjects, --expressions,"
        raise FormatError(
            f"{folder}: {len(missing)} of {len(indices)} pictures are missing:"
            f" {few(missing, NAMED)}; expected SUBJECT_EXPRESSION_CAMERA.png"
            + ("" if partial else f"; {part} --cameras")
        )
    rows, wrong = [], []
    for index in _with_progress(paths):
        path = paths[index]
        rows_seen, columns_seen, size = window(index)
        try:
            pixels = read_srgb(path)
        except CaptureError as error:
            wrong.append(str(error))
            continue
        if pixels.shape[:2] != size:
            got, expected = (f"{width} x {height}" for height, width in (pixels.shape[:2], size))
            wrong.append(f"{path.name} is {got}, expected {expected}")
            continue
        item = views.item(index)
        seen = torch.from_numpy(pixels[rows_seen, columns_seen].copy())
        image = seen.permute(2, 0, 1).to(item.target) / 255
        rows.append(compare(image, item, judge))
    if wrong:
        raise FormatError(f"{folder}: {len(wrong)} pictures do not fit: {few(wrong, NAMED)}")
    return rows


def find_picture(folder: Path, key: SampleKey) -> Path | None:
    """Return the picture of a sample in a folder of pictures; None if there is none."""
    name = sample_key(**vars(key))
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    return next(filter(Path.is_file, files), None)


def save_pictures(
    folder: Path, window: Window, views: HeadViews, new: Sequence[int]
) -> Callable[[int, Tensor], None]:
    """Make a function that writes renderings of samples as `score` reads them.

    Raises:
        ConfigError: the folder holds a picture of one of the ``new`` samples.
    """
    if old := [found.name for i in new if (found := find_picture(folder, views.keys[i]))]:
        raise ConfigError(
            f"{folder}: holds pictures of these samples ({few(old)}), perhaps another method's;"
            " name another folder, or delete them"
        )
    folder.mkdir(parents=True, exist_ok=True)

    def keep(index: int, image: Tensor) -> None:
        rows, columns, size = window(index)
        whole = np.full((*size, 3), round(255 * views.background), np.uint8)
        shown = (255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()
        whole[rows, columns] = shown
        write_image(folder / f"{sample_key(**vars(views.keys[index]))}.png", whole)

    return keep


def mean(rows: Sequence[Row], name: str) -> float | None:
    """Return the mean of one number over the rows that have it, rounded; None if none has."""
    values = [float(row[name]) for row in rows if not math.isnan(float(row.get(name, math.nan)))]
    return round(sum(values) / len(values), 4) if values else None


def means(rows: Sequence[Row]) -> Mapping[str, object]:
    """Return the means of all numbers, and the number of images."""
    return {name: mean(rows, name) for name in NUMBERS} | {"images": len(rows)}


def summarise(rows: Sequence[Row], judge: PerceptualMetrics = NO_NETWORKS) -> dict[str, object]:
    """Average all rows, and per kind, subject, expression and camera; say why metrics are n/a."""
    summary = {**means(rows), "fid": judge.fid(), **judge.missing()}
    for group in IDS:
        values = sorted({str(row[group]) for row in rows if row[group]})
        summary[f"by_{group}"] = {
            value: {
                **means([row for row in rows if row[group] == value]),
                **({"fid": judge.fid(value)} if group == "kind" and judge.inception else {}),
            }
            for value in values
        }
    return summary


def write_evaluation(
    out: Path, rows: Sequence[Row], judge: PerceptualMetrics = NO_NETWORKS
) -> dict[str, object]:
    """Write evaluation.csv (one row per image) and evaluation.json (means); returns the means."""
    rounded = (
        {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()} for row in rows
    )
    write_csv(out / "evaluation.csv", [*IDS, *NUMBERS], rounded)
    summary = summarise(rows, judge)
    write_json(out / "evaluation.json", summary)
    return summary


def summary_lines(summary: dict) -> list[str]:
    """Format a summary for a terminal: a row per kind, then the metrics that are n/a."""
    names = ["images", "psnr_db", "psnr_head_db", "ssim", "rmse", "lpips"]
    kinds = summary["by_kind"] or {"all": summary}
    names = [name for name in names if any(is_number(row[name]) for row in kinds.values())]
    rows = [
        [kind, *(str(row[name]) if is_number(row[name]) else "n/a" for name in names)]
        for kind, row in kinds.items()
    ]
    missing = [name for name in ("lpips", "fid") if "n/a" in str(summary[name])]
    return [
        *format_table(["views", *map(figure_label, names)], rows),
        *(f"{figure_label(name)}: {summary[name]}" for name in missing),
    ]
