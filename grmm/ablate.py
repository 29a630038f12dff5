"""Run the paper's ablations: rows trained and fitted under one budget, and one table.

Finished rows are kept: a row is measured again only when its settings, the shards or the protocol
differ from those it was measured with; a half-trained row goes on from its checkpoint.
"""

from __future__ import annotations

import fnmatch
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from express50.console import log
from express50.contract.config import nearest
from express50.errors import ConfigError, FormatError
from express50.files.atomic import dump_json, write_bytes, write_json
from express50.files.digests import file_sha256
from express50.files.text import markdown_table, read_json_table
from express50.head.load import load_head
from grmm.checkpoint import Loaded, load_checkpoint
from grmm.config import Config, as_tables, from_tables
from grmm.data import HeadViews, spread
from grmm.evaluate import HELD_EXPRESSION, HELD_VIEW, evaluate, kind_of, mean, training_render
from grmm.identity_evaluation import (
    NOVEL_EXPRESSION,
    NOVEL_VIEW,
    FitProtocol,
    evaluate_unseen,
    given_views,
)
from grmm.metrics import PerceptualMetrics
from grmm.shard_source import open_shards
from grmm.train import train
from grmm.train_state import best_device, with_map_size


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One row of the ablation.

    Attributes:
        label: as in the table.
        changes: table -> key -> value over the common configuration.
        paper_db: the paper's PSNR minus that of its full model; None: no figure.
        against: the row that it is compared with.
        trains_as: the row whose checkpoint it uses, where only the fit differs.
        without: the folder of shards left out.
    """

    label: str
    changes: Mapping[str, Mapping[str, object]]
    paper_db: float | None = None
    against: str = "full"
    trains_as: str = ""
    without: Path | None = None


VARIANTS = {
    "full": Variant(label="Full model", changes={}),
    # Modes are not the paper's: they would be driven by shape coefficients in the row after.
    "no_modes": Variant(label="W/o identity modes", changes={"model": {"identity_modes": 0}}),
    "no_residuals": Variant(
        label="W/o residuals, against w/o modes",
        changes={"model": {"residual_codes": False, "identity_modes": 0}},
        paper_db=-1.63,
        against="no_modes",
    ),
    "no_mesh_decoder": Variant(
        label="W/o mesh decoder", changes={"model": {"mesh_decoder": False}}, paper_db=-2.18
    ),
    "no_refinement": Variant(
        label="W/o refinement", changes={"model": {"refine_widths": []}}, paper_db=-0.77
    ),
    "no_mouth_uv": Variant(label="W/o mouth UV", changes={"model": {"mouth": False}}),
    "no_locality": Variant(
        label="W/o locality loss",
        changes={"fit": {"locality": 0.0}},
        paper_db=-0.68,
        trains_as="full",
    ),
}
GROUPS = {"view": HELD_VIEW, "expression": HELD_EXPRESSION, "unseen": NOVEL_VIEW,
          "unseen_expression": NOVEL_EXPRESSION}  # fmt: skip
DIGITS = {"psnr_db": 2, "ssim": 3, "lpips": 3}
SHOWN = ("psnr_db", "psnr_head_db", "ssim", "rmse", "lpips")


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """What all rows share.

    Attributes:
        roots: folders of shards; several are mixed.
        out: gets one folder per row, and the tables.
        config: of the full model; its budget is every row's.
        protocol: how unseen people are fitted.
        subjects: unseen people; empty: all that the training split lacks.
    """

    roots: Sequence[Path]
    out: Path
    config: Config
    protocol: FitProtocol
    subjects: Sequence[str] = ()

    def unseen(self, views: HeadViews) -> list[str]:
        """List the people to fit: no row trains on them."""
        trained = {key.subject for key in open_shards(self.roots, "train").keys}
        return list(self.subjects) or sorted({key.subject for key in views.keys} - trained)


def ablate(run: Ablation, names: Sequence[str] = ()) -> dict[str, Any]:
    """Measure every row that is not measured yet; writes ablation.json and ablation.md.

    ``names`` are the rows to measure; empty: all.

    Raises:
        ConfigError: an unknown row, nothing is held out, or a person lacks the views that it is to
            be fitted from.
    """
    config = with_holdout(run.roots, run.config)
    variants = variants_of(run.roots, names)
    if not config.model.identity_modes:
        variants.pop("no_modes", None)
    source = open_shards(run.roots, "*")
    head = load_head(source.head)
    views = HeadViews(source, head)
    for subject in run.unseen(views):  # before hours of training
        given_views(views, subject, run.protocol)
    # Every row has as many Gaussians as the full model.
    config = with_map_size(config, HeadViews(open_shards(run.roots, "train"), head))
    run = replace(run, config=config)
    rows: dict[str, dict] = {}
    table: dict[str, Any] = {}
    for name, variant in variants.items():
        rows[name] = _row(run, name, variant)
        table = write_tables(run.out, rows, config)
    return table


def with_holdout(roots: Sequence[Path], config: Config) -> Config:
    """Hold out the middle camera by id where the configuration holds out none."""
    if config.data.holdout_cameras:
        return config
    cameras = sorted({key.camera for key in open_shards(roots, "train").keys})
    if len(cameras) < 2:
        raise ConfigError(f"{roots[0]}: one camera; expected two or more, to hold one out")
    chosen = cameras[len(cameras) // 2]
    log(f"ablate: holding out camera {chosen}")
    return replace(config, data=replace(config.data, holdout_cameras=(chosen,)))


def changed(config: Config, variant: Variant, used: Sequence[Path]) -> Config:
    """Return the configuration of a row; it holds out only what its own datasets have."""
    tables = as_tables(config)
    for table, values in variant.changes.items():
        tables[table] |= values
    if variant.without is not None:
        keys = open_shards(used, "train").keys
        cameras = {key.camera for key in keys}
        frames = {f"{key.subject}/{key.expression}" for key in keys}
        data = tables["data"]
        data["holdout_cameras"] = [c for c in data["holdout_cameras"] if c in cameras]
        data["holdout_expressions"] = [
            p for p in data["holdout_expressions"] if fnmatch.filter(frames, p)
        ]
    return from_tables(tables)


def _row(run: Ablation, name: str, variant: Variant) -> dict:
    """Measure one row, or read it from its file if it was measured with the same settings."""
    used = [root for root in run.roots if root != variant.without]
    settings = changed(run.config, variant, used)
    content = {  # everything that the numbers depend on, except the code
        "shards": [file_sha256(root / "index.json") for root in run.roots],
        "used": [run.roots.index(root) for root in used],
        "config": as_tables(settings),
        "protocol": asdict(run.protocol),
        "subjects": list(run.subjects),
    }
    digest = hashlib.sha256(dump_json(content)).hexdigest()
    path = run.out / name / "row.json"
    if path.exists():
        row = read_json_table(path, FormatError, "delete it to measure again")
        if row.get("digest") == digest:
            log(f"ablate: {name} is measured")
            return row
        log(f"ablate: {name} was measured with other settings: again")
    folder = run.out / (variant.trains_as or name)
    if not variant.trains_as:
        _train(used, folder, settings)
    loaded = load_checkpoint(folder / "checkpoint.pt", best_device())
    log(f"ablate: measuring {name}")
    row = measure(run, replace(loaded, config=settings), used)
    row |= {"digest": digest, "label": variant.label, "paper_db": variant.paper_db}
    row["against"] = variant.against
    write_json(path, row)
    return row


def _train(used: Sequence[Path], folder: Path, settings: Config) -> None:
    """Train a row, or go on where it stopped; other settings or samples start afresh."""
    source = open_shards(used, "train")
    tables = {k: v for k, v in as_tables(settings).items() if k not in ("fit", "metrics")}
    wanted = dump_json({"tables": tables, "samples": source.digest})
    mark, checkpoint = folder / "settings.json", folder / "checkpoint.pt"
    if not mark.exists() or mark.read_bytes() != wanted:
        checkpoint.unlink(missing_ok=True)
        write_bytes(mark, wanted)
    log(f"ablate: training {folder.name}")
    train(source, load_head(source.head), folder, settings, resume=checkpoint.exists())


def measure(run: Ablation, loaded: Loaded, used: Sequence[Path]) -> dict:
    """Measure held-out views and expressions of training people, and unseen people."""
    views, kind = loaded.views(open_shards(run.roots, "*")), partial(kind_of, loaded)
    judge, rows, efforts = PerceptualMetrics(loaded.config.metrics), [], []
    # Without a dataset other people are trained, whose views cannot be compared.
    if len(used) == len(run.roots):
        render, expressions = training_render(loaded.model, views), loaded.model.expressions
        drawn = [i for i, key in enumerate(views.keys) if key.expression in expressions]
        for held in (HELD_VIEW, HELD_EXPRESSION):
            own = [i for i in drawn if kind(views.keys[i]) == held]
            chosen = spread(own, run.protocol.images or len(own))
            rows += evaluate(views, chosen, render, judge, kind)
    for subject in run.unseen(views):
        found, effort = evaluate_unseen(loaded, views, subject, run.protocol, judge)
        rows += found
        efforts.append(effort)
    groups = {}
    for group, name in GROUPS.items():
        if own_rows := [row for row in rows if row["kind"] == name]:
            numbers = {n: mean(own_rows, n) for n in SHOWN}
            groups[group] = numbers | {"fid": judge.fid(name), "images": len(own_rows)}
    return {
        "groups": groups,
        "fits": efforts,
        "gaussians": len(loaded.model.texels),
        "parameters": sum(parameter.numel() for parameter in loaded.model.parameters()),
        "iterations": loaded.loop.get("iteration"),
        "seconds": round(float(loaded.loop.get("seconds", 0.0)), 1),
    }


def variants_of(roots: Sequence[Path], names: Sequence[str] = ()) -> dict[str, Variant]:
    """Choose the rows asked for, by default all; with several datasets also one without each.

    Raises:
        ConfigError: no row has such a name.
    """
    rows = dict(VARIANTS)
    if len(roots) > 1:
        for root in roots:
            name = root.parent.parent.name if root.name == "shards" else root.name
            rows[f"without_{name}"] = Variant(label=f"W/o {name}", changes={}, without=root)
    for name in names:
        if name not in rows:
            raise ConfigError(
                f"row {name!r} is unknown{nearest(name, rows)}; expected {', '.join(rows)}"
            )
    # Rows come after those that they are compared with; no_locality uses the full model's weights.
    wanted = {*names, "full", *(rows[name].against for name in names)}
    return {name: row for name, row in rows.items() if not names or name in wanted}


def write_tables(out: Path, rows: Mapping[str, dict], config: Config) -> dict[str, Any]:
    """Write ablation.json and ablation.md of the rows measured so far; returns the former."""
    table: dict[str, Any] = {}
    for name, row in rows.items():
        other = rows.get(row["against"], rows["full"])["groups"]
        gains = {
            group: round(numbers["psnr_db"] - other[group]["psnr_db"], 3)
            for group, numbers in row["groups"].items()
            if group in other and None not in (numbers["psnr_db"], other[group]["psnr_db"])
        }
        table[name] = row | {"difference_db": gains}
    budget = {"seconds": config.train.seconds or None, "iterations": config.train.iterations}
    missing = PerceptualMetrics(config.metrics).missing()
    cameras = list(config.data.holdout_cameras)
    content = {"rows": table, "budget": budget, "holdout_cameras": cameras} | missing
    write_json(out / "ablation.json", content)
    write_bytes(out / "ablation.md", markdown(table, missing).encode())
    return content


def markdown(table: Mapping[str, dict], missing: Mapping[str, str]) -> str:
    """Format the table as the paper does: a row per model; PSNR, SSIM and LPIPS per protocol."""
    groups = [g for g in GROUPS if any(g in row["groups"] for row in table.values())]
    head = ["Method"]
    for group in groups:
        head += [f"{GROUPS[group]}: PSNR", "SSIM", "LPIPS", "dB over full"]
    lines = []
    for row in table.values():
        cells = [row["label"]]
        for group in groups:
            numbers = row["groups"].get(group, {})
            cells += [_cell(numbers.get(name), d) for name, d in DIGITS.items()]
            cells.append(_cell(row["difference_db"].get(group), 2, sign=True))
        lines.append([*cells, _cell(row["paper_db"], 2, sign=True)])
    text = "\n".join(markdown_table([*head, "paper, dB"], lines)) + "\n"
    return text + "".join(f"\n{name.upper()}: {reason}\n" for name, reason in missing.items())


def _cell(value: float | None, digits: int, sign: bool = False) -> str:
    return "n/a" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"
