"""Run the paper's ablations: rows trained and fitted under one budget, and one table.

Finished rows are kept: a row is measured again only when its settings, the shards or the protocol
differ from those it was measured with. A half-trained row continues from its checkpoint, and a
half-measured one from its fits.
"""

from __future__ import annotations

import fnmatch
import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from express50.console import count, format_seconds, log
from express50.errors import ConfigError, DivergedError, FormatError, check_known
from express50.files.atomic import dump_json, write_bytes, write_json
from express50.files.digests import file_sha256
from express50.files.text import markdown_table, read_json_table
from express50.geometry.sampling import evenly
from express50.head.load import load_head
from grmm.checkpoint import Checkpoint, load_checkpoint
from grmm.config import Config, as_tables, from_tables
from grmm.data import HeadViews, Source
from grmm.evaluate import (
    HELD_EXPRESSION,
    HELD_VIEW,
    PSNRS,
    evaluate,
    kind_of,
    mean,
    training_render,
)
from grmm.fit import FITS, NOVEL_EXPRESSION, NOVEL_VIEW, FitProtocol, evaluate_unseen, unseen_views
from grmm.metrics import PerceptualMetrics
from grmm.shard_source import open_shards
from grmm.train import diverged, train
from grmm.train_state import best_device, differences, split_samples, with_map_size


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One row of the ablation."""

    label: str  # its name in the table
    changes: Mapping[str, Mapping[str, object]]  # table -> key -> value, over the common one
    paper_db: float | None = None  # the paper's PSNR minus its full model's, if it has a figure
    against: str = "full"  # the row it is compared with
    trains_as: str = ""  # the row whose checkpoint it uses, if only the fit differs
    without: Path | None = None  # the folder of shards that it leaves out


VARIANTS = {
    "full": Variant(label="Full model", changes={}),
    # Modes are ours, not the paper's: in the next row shape coefficients would drive them.
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
SHOWN = (*PSNRS, "ssim", "rmse", "lpips")
CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """The settings that all rows share."""

    roots: Sequence[Path]  # folders of shards; training mixes several
    out: Path  # the folder for the tables and one folder per row
    config: Config  # the full model's; every row has its budget
    protocol: FitProtocol  # how unseen people are fitted
    subjects: Sequence[str] = ()  # unseen people; empty: everyone who is not in the training split
    seeds: int = 1  # how often each row is trained; intervals need two or more
    # folders of shards whose people are fitted, and nobody is trained on; empty: ``roots``
    test: Sequence[Path] = ()

    def unseen(self) -> tuple[Source, list[str]]:
        """List the people to fit, whom no row trains on, with the source of their views."""
        source = open_shards(self.test or self.roots, "*")
        trained = {key.subject for key in open_shards(self.roots, "train").keys}
        known = {key.subject for key in source.keys}
        check_known("--fit-subjects", "person", self.subjects, sorted(known))
        people = list(self.subjects) or sorted(known if self.test else known - trained)
        if both := sorted(trained.intersection(people)):
            raise ConfigError(
                f"training also sees {', '.join(both)}; expected people that it does not see:"
                " choose others (--fit-subjects) or shards of others (--test)"
            )
        return source, people


def ablate(run: Ablation, names: Sequence[str] = ()) -> dict[str, Any]:
    """Measure every row that is not measured yet; write ablation.json and ablation.md.

    ``names`` are the rows to measure; empty: all. The tables also hold the others that were
    measured in this folder with the same settings.

    Raises:
        ConfigError: an unknown row, nothing is held out, or a person lacks the views that it is to
            be fitted from.
    """
    config = with_holdout(run.roots, run.config)
    variants, every = variants_of(run.roots, names), variants_of(run.roots, ())
    if not config.model.identity_modes:
        variants.pop("no_modes", None)
        every.pop("no_modes")
    source, people = run.unseen()
    head = load_head(source.head)
    views = HeadViews(open_shards(run.roots, "train"), head)
    drawn = {views.keys[i].expression for i in split_samples(views.keys, config)[0]}
    measured = HeadViews(source, head)
    for subject in people:  # before hours of training
        unseen_views(drawn, measured, subject, run.protocol)
    # Every row has as many Gaussians as the full model.
    config = with_map_size(config, views)
    run = replace(run, config=config)
    trainings = run.seeds * sum(not variant.trains_as for variant in variants.values())
    fits = run.seeds * len(variants) * len(people)
    efforts = [
        count(n, what) + (f" of {format_seconds(s)} ({format_seconds(n * s)})" if n and s else "")
        for n, what, s in (
            (trainings, "training", config.train.seconds), (fits, "fit", config.fit.seconds),
        )
    ]  # fmt: skip
    log(f"ablate: {' and '.join(efforts)}, except for rows that are measured already")
    rows: dict[str, list[dict]] = {}
    table: dict[str, Any] = {}
    for seed in range(run.seeds):
        for name, variant in every.items():
            row = _row(run, name, variant, seed, wanted=name in variants)
            if row is not None and len(rows.get(name, ())) == seed:  # pairs are by seed
                rows.setdefault(name, []).append(row)
                table = write_tables(run.out, rows, config)
    return table


def with_holdout(roots: Sequence[Path], config: Config) -> Config:
    """Hold out the middle camera by id where the configuration holds out none."""
    if config.data.holdout_cameras:
        return config
    cameras = sorted({key.camera for key in open_shards(roots, "train").keys})
    if len(cameras) < 2:
        raise ConfigError(f"{roots[0]}: has one camera; expected at least two, to hold one out")
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
        frames = {"/".join(key.frame) for key in keys}
        data = tables["data"]
        data["holdout_cameras"] = [p for p in data["holdout_cameras"] if fnmatch.filter(cameras, p)]
        data["holdout_expressions"] = [
            p for p in data["holdout_expressions"] if fnmatch.filter(frames, p)
        ]
    return from_tables(tables)


def _row(run: Ablation, name: str, variant: Variant, seed: int, wanted: bool) -> dict | None:
    """Read one row from its file if it was measured with the same settings, or measure it.

    None if it is not ``wanted`` and not measured.
    """
    used = [root for root in run.roots if root != variant.without]
    settings = changed(run.config, variant, used)
    settings = replace(settings, train=replace(settings.train, seed=settings.train.seed + seed))
    content = {  # everything that the numbers depend on, except the code
        "shards": [file_sha256(root / "index.json") for root in (*run.roots, *run.test)],
        "used": [run.roots.index(root) for root in used],
        "config": as_tables(settings),
        "protocol": asdict(run.protocol),
        "subjects": list(run.subjects),
    }
    digest = hashlib.sha256(dump_json(content)).hexdigest()
    ending = f".seed{seed}" if seed else ""
    path = run.out / f"{name}{ending}" / "row.json"
    if path.exists():
        row = read_json_table(path, FormatError, "delete it to measure again")
        if row.get("digest") == digest:
            log(f"ablate: {name}{ending} is measured")
            return row
        if wanted:
            log(f"ablate: {name}{ending} was measured with other settings, so it is measured again")
    if not wanted:
        return None
    folder = run.out / f"{variant.trains_as or name}{ending}"
    fits = path.parent / FITS
    try:
        if not variant.trains_as:
            _train(used, folder, settings)
        metrics = folder / "metrics.json"
        if not metrics.exists() or diverged(read_json_table(metrics, FormatError)):
            raise DivergedError(f"{folder}: training left no usable model")
        loaded = load_checkpoint(folder / "checkpoint.pt", best_device())
        log(f"ablate: measuring {name}{ending}")
        row = measure(run, replace(loaded, config=settings), used, fits)
    except DivergedError as error:  # the other rows do not depend on it
        log(f"ablate: {error}")
        log(f"ablate: {name}{ending} diverged; lower train.lr for all rows, and name another OUT")
        row = {"groups": {}, "diverged": True}
    row |= {"digest": digest, "label": variant.label, "paper_db": variant.paper_db}
    row["against"] = variant.against
    write_json(path, row)
    shutil.rmtree(fits, ignore_errors=True)  # only a stopped command needs them
    return row


def _train(used: Sequence[Path], folder: Path, settings: Config) -> None:
    """Train or resume a row; ConfigError if it was trained with other settings or samples."""
    source = open_shards(used, "train")
    tables = {k: v for k, v in as_tables(settings).items() if k not in ("fit", "metrics")}
    wanted = dump_json({"tables": tables, "samples": source.digest})
    mark, checkpoint = folder / "settings.json", folder / "checkpoint.pt"
    if not mark.exists() or mark.read_bytes() != wanted:
        if checkpoint.exists():  # it may have taken hours
            trained = load_checkpoint(checkpoint).config
            changed = differences(trained, settings, tables, ()) or ["the samples of the shards"]
            raise ConfigError(
                f"{folder}: was trained with other settings or samples ({'; '.join(changed)});"
                " name another OUT, or delete this folder to train the row again"
            )
        write_bytes(mark, wanted)
    log(f"ablate: training {folder.name}")
    train(source, load_head(source.head), folder, settings, resume=checkpoint.exists())


def measure(run: Ablation, loaded: Checkpoint, used: Sequence[Path], fits: Path) -> dict:
    """Measure held-out views and expressions of training people, and unseen people.

    ``fits`` is the folder of `fit_unseen`.
    """
    views, kind = loaded.views(open_shards(run.roots, "*")), partial(kind_of, loaded)
    judge, rows, efforts = PerceptualMetrics(loaded.config.metrics), [], []
    # Rows without a dataset train on other people, so their views cannot be compared.
    if len(used) == len(run.roots):
        render, expressions = training_render(loaded.model, views), loaded.model.expressions
        drawn = [i for i, key in enumerate(views.keys) if key.expression in expressions]
        for held in (HELD_VIEW, HELD_EXPRESSION):
            own = [i for i in drawn if kind(views.keys[i]) == held]
            chosen = evenly(own, run.protocol.images or len(own))
            rows += evaluate(views, chosen, render, judge, kind)
    source, people = run.unseen()
    strangers = loaded.views(source)
    for subject in people:
        found, effort = evaluate_unseen(
            loaded, strangers, subject, run.protocol, judge, folder=fits
        )
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


def variants_of(roots: Sequence[Path], names: Sequence[str]) -> dict[str, Variant]:
    """Choose the rows asked for, by default all; with several datasets also one without each.

    Raises:
        ConfigError: no row has such a name.
    """
    rows = dict(VARIANTS)
    if len(roots) > 1:
        for number, root in enumerate(roots, 1):
            place = root.resolve()
            name = place.parent.parent.name if place.name == "shards" else place.name
            if f"without_{name}" in rows:  # folders of one name
                name = f"{name}_{number}"
            rows[f"without_{name}"] = Variant(label=f"W/o {name}", changes={}, without=root)
    check_known("the ablation", "row", names, rows)
    # Rows come after those that they are compared with; no_locality uses the full model's weights.
    wanted = {*names, "full", *(rows[name].against for name in names)}
    return {name: row for name, row in rows.items() if not names or name in wanted}


def write_tables(out: Path, rows: Mapping[str, list[dict]], config: Config) -> dict[str, Any]:
    """Write ablation.json and ablation.md of the rows measured so far; returns the former.

    Numbers are means over the seeds; a row that diverged with any of them has none. Differences are
    taken seed by seed, to the row that a row is compared with; ``interval_db`` is half of their
    mean's 95 % interval (Student's), None of one.
    """
    table: dict[str, Any] = {}
    for name, runs in rows.items():
        others = rows.get(runs[0]["against"], rows["full"])
        row: dict[str, Any] = runs[-1] | {"seeds": len(runs), "difference_db": {}}
        row |= {"groups": {}, "interval_db": {}, "regions_db": {}}
        table[name] = row
        if any("diverged" in run for run in runs):
            row |= {"label": f"{row['label']} (diverged)", "diverged": True}
            continue
        for group, numbers in runs[0]["groups"].items():
            measured = [run["groups"][group] for run in runs]
            row["groups"][group] = {
                key: mean([m for m in measured if m[key] is not None], key) for key in numbers
            }
            pairs = [
                (run["groups"][group], other["groups"].get(group, {}))
                for run, other in zip(runs, others, strict=False)
            ]
            found = {key: gain for key in PSNRS if (gain := compared(pairs, key))}
            whole = found.pop("psnr_db", None)
            if whole is not None:
                row["difference_db"][group], row["interval_db"][group] = whole
            row["regions_db"][group] = found
    budget = {"seconds": config.train.seconds or None, "iterations": config.train.iterations}
    missing = PerceptualMetrics(config.metrics).missing()
    cameras = list(config.data.holdout_cameras)
    content = {"rows": table, "budget": budget, "holdout_cameras": cameras} | missing
    write_json(out / "ablation.json", content)
    write_bytes(out / "ablation.md", markdown(table, missing).encode())
    return content


def compared(pairs: Sequence[tuple[dict, dict]], key: str) -> tuple[float, float | None] | None:
    """Return the mean difference over pairs and half its interval; None if unknown."""
    both = [(a.get(key), b.get(key)) for a, b in pairs]
    gains = [a - b for a, b in both if a is not None and b is not None]
    if not gains:
        return None
    if len(gains) < 2:
        return round(gains[0], 3), None
    spread_db = float(np.std(gains, ddof=1)) / len(gains) ** 0.5
    half = float(student_t.ppf(0.5 + CONFIDENCE / 2, len(gains) - 1)) * spread_db
    return round(float(np.mean(gains)), 3), round(half, 3)


def markdown(table: Mapping[str, dict], missing: Mapping[str, str]) -> str:
    """Format the table as the paper does: a row per model; PSNR, SSIM and LPIPS per protocol."""
    groups = [g for g in GROUPS if any(g in row["groups"] for row in table.values())]
    head = ["Method"]
    for group in groups:
        head += [f"{GROUPS[group]}: PSNR", "SSIM", "LPIPS", "dB over full", "mouth"]
    lines = []
    for row in table.values():
        cells = [row["label"]]
        for group in groups:
            numbers = row["groups"].get(group, {})
            cells += [_cell(numbers.get(name), d) for name, d in DIGITS.items()]
            gain = row["difference_db"].get(group), row["interval_db"].get(group)
            mouth = row["regions_db"].get(group, {}).get("psnr_mouth_db", (None, None))
            cells += [_interval(*gain), _interval(*mouth)]
        lines.append([*cells, _cell(row["paper_db"], 2, sign=True)])
    text = "\n".join(markdown_table([*head, "paper, dB"], lines)) + "\n"
    return text + "".join(f"\n{name.upper()}: {reason}\n" for name, reason in missing.items())


def _interval(value: float | None, half: float | None) -> str:
    return _cell(value, 2, sign=True) + ("" if half is None else f" ± {half:.2f}")


def _cell(value: float | None, digits: int, sign: bool = False) -> str:
    return "n/a" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"
