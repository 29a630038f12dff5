"""Run the commands of ``grmm``: read the arguments, call the library, print.

Torch takes a second to import and --help must not wait for it, so handlers import it late.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from express50.console import FAILED, OK, answer, count, figure_label, log, say
from express50.contract.config import config_toml, known_assignments
from express50.contract.layout import check_results_file, check_results_folder
from express50.errors import ConfigError, FormatError, check_known, few
from express50.files.atomic import alone_in, check_space, dump_json, write_bytes, write_json
from express50.files.digests import file_sha256
from grmm.config import TABLES, Config, as_tables, choose, from_tables, resolve
from grmm.deviations import paper_diff

if TYPE_CHECKING:
    from grmm.checkpoint import Checkpoint
    from grmm.data import HeadViews
    from grmm.edit import HeadCodes
    from grmm.evaluate import Journal
    from grmm.fit import FitProtocol
    from grmm.metrics import PerceptualMetrics

AUTO = "auto"  # in place of a preset
PAPER_GIB = 20  # GPU memory for the paper's size; a step takes 3.5 on a CPU, plus the networks
VIDEO_FRAMES = 72  # unless given
FORMATS = ("html", "ply", "spz", "splats", "arkit", "glb", "npz")  # of an exported head
HOLDOUTS = ("holdout_cameras", "holdout_expressions")
CHANGEABLE = ("fit", "metrics", "loss")  # tables that may differ from those of training


def train(args: argparse.Namespace) -> int:
    """Train, or resume from the checkpoint in OUT."""
    from express50.head.load import load_head
    from grmm.shard_source import open_shards
    from grmm.train import diverged, train

    check_results_folder(args.out)
    # First, because most wrong commands name a wrong folder.
    source = open_shards([args.shards, *args.also], "train")
    config = train_config(args)
    resume = not args.overwrite and (args.out / "checkpoint.pt").exists()
    first = os.environ.get("RANK", "0") == "0"  # of the processes that torchrun starts
    with alone_in(args.out) if first else nullcontext():
        metrics = train(source, load_head(source.head), args.out, config, resume=resume)
    if not metrics:  # only the first process of torchrun reports
        return OK
    new = ("psnr_heldout_expression_db",) if config.data.holdout_expressions else ()
    names = ("psnr_heldout_view_db", *new, "psnr_train_db", "ssim", "iterations", "gaussians")
    values = {name: metrics.get(name) for name in names}
    lines = [f"{figure_label(k)}: {'n/a' if v is None else v}" for k, v in values.items()]
    code = answer(args, metrics, *lines, f"checkpoint: {args.out / 'checkpoint.pt'}")
    if diverged(metrics):
        log(
            "training images score worse than plain grey: training diverged; lower train.lr and "
            "start over with --overwrite"
        )
        return FAILED
    return code


def train_config(args: argparse.Namespace) -> Config:
    """Return the resolved configuration of ``grmm train``: its own flags override --set."""
    name: str = args.preset
    changes: dict[str, dict[str, Any]] = {}
    if name == AUTO:
        name, changes = _machines_choice(args)
    config = resolve(name, args.config, [*args.set, *_metric_settings(args)], changes)
    if args.seconds is not None:
        config = replace(config, train=replace(config.train, seconds=args.seconds))
    given = {name: _split_names(getattr(args, name)) for name in HOLDOUTS}
    held: dict[str, Any] = {name: ids for name, ids in given.items() if ids}
    return replace(config, data=replace(config.data, **held))


def _machines_choice(args: argparse.Namespace) -> tuple[str, dict[str, dict[str, Any]]]:
    """Choose a preset and changes to it that suit the machine, and print the choice."""
    from grmm.train_state import gpu

    if found := gpu():
        name, memory = found
        preset = "paper-plus" if memory >= PAPER_GIB else "small"
        log(f"auto: {preset}, for {name} with {memory:.0f} GiB")
        return preset, {}
    seconds = args.seconds or resolve("demo", args.config, args.set).train.seconds
    if not seconds:
        raise ConfigError(
            f"no GPU found; on a CPU --preset {AUTO} needs a time budget: --budget 1h"
        )
    choice = choose(seconds)
    which = "longest measured time that fits" if choice.budget_s <= seconds else "shortest measured"
    what = f"demo with {choice.setting}" if choice.changes else choice.setting
    log(
        f"auto: no GPU found; {what}, which reached {choice.psnr_db:.1f} dB in "
        f"{choice.budget_s:.0f} s of one core, the {which}"
    )
    return "demo", choice.changes


def config(args: argparse.Namespace) -> int:
    """Print the settings that `train` would take, as TOML."""
    resolved = train_config(args)
    if args.paper_diff:
        if args.table:
            raise ConfigError(f"--paper-diff is of all tables; leave out {' '.join(args.table)}")
        say(*paper_diff(resolved))
        return OK
    check_known("grmm config", "table", args.table, TABLES)
    for table in args.table or TABLES:
        say(config_toml(table, getattr(resolved, table)))
    return OK


def fit(args: argparse.Namespace) -> int:
    """Fit an unseen person and report on the views that the fit did not use."""
    from grmm.checkpoint import read_content, seen_before
    from grmm.fit import fit
    from grmm.shard_source import ShardSource, select

    check_results_folder(args.out)
    made = args.out / "checkpoint.pt"
    if made.exists() and made.samefile(args.checkpoint):
        raise ConfigError(f"{made} is the checkpoint to fit from; name another folder")
    if made.exists():
        with suppress(FormatError):  # a damaged one may be replaced
            if seen_before(read_content(made)) is None:
                raise ConfigError(f"{made} is of a training, not of a fit; name another folder")
    loaded = _load(args.checkpoint, [*args.set, *_metric_settings(args)], args.seconds)
    if loaded.seen_before is not None:
        log(
            f"{args.checkpoint} is a fit of {loaded.model.subjects[0]}: it knows one person only; "
            "fit people from a checkpoint of 'grmm train'"
        )
    elif args.subject in loaded.model.subjects:
        log(
            f"{args.subject} was trained on, so the figures are not those of an unseen person; only"
            " views that training did not see count as held out"
        )
    views = loaded.views(ShardSource(args.shards, "*"))
    given = select(views.keys, args.subject, args.expression, args.cameras)
    rest = sorted({*select(views.keys, args.subject, args.expression, "*")} - {*given})
    with alone_in(args.out):
        continued = made.exists() and not args.overwrite
        metrics = fit(loaded, views, given, rest, args.out, continued=continued)
    reached = f"{metrics['seconds']} s, {metrics['iterations']} iterations"
    psnr = f"{figure_label('psnr_db')}: {metrics['psnr_db']}"
    line = f"{psnr} ({metrics['psnr_is_of']}), after {reached}"
    return answer(args, metrics, line, f"wrote {args.out}")


def _check_evaluation_folder(out: Path) -> None:
    """Refuse a folder that cannot be written to; say what will be replaced in it."""
    check_results_folder(out)
    if (out / "evaluation.csv").exists():
        log(f"{out}: its evaluation will be replaced; to keep it, stop and name another folder")


def render(args: argparse.Namespace) -> int:
    """Write pictures, sheets and videos of one head."""
    from express50.dataset.tracks import RIG_RATE
    from express50.files.images import write_image
    from grmm import render

    check_results_folder(args.out)
    _require(args, "drive", "drive_cue")
    _require(args, "turntable", "degrees")
    _require(args, "turntable to", "frames")
    _require(args, "samples", "spread", "seed")
    degrees = 360.0 if args.degrees is None else args.degrees
    spread = 1.0 if args.spread is None else args.spread
    length = args.frames or VIDEO_FRAMES
    loaded = _load(args.checkpoint)
    model, head = loaded.model, _edited_head(loaded, args)
    clips = render.read_clips(args.drive, args.drive_cue) if args.drive else None
    view = render.camera_of(loaded, args.camera, args.size)
    view = render.orbit(view, args.yaw, model.head_centre, args.pitch)
    subjects, expressions = model.subjects[:8], model.expressions[: args.columns]
    columns = max(args.samples, len(expressions))
    rows = max(len(subjects), render.CONTROL_ROWS if args.controls else 0)
    if max(columns * view.width, rows * view.height) > render.SHEET_LIMIT:
        raise ConfigError(
            f"a sheet of {columns} x {rows} pictures of {view.width} x {view.height} px is larger"
            f" than {render.SHEET_LIMIT} px; lower --size, --samples or --columns"
        )
    # Whatever may fail comes before the first file; videos are drawn as they are written.
    videos: dict[str, Any] = {}
    rates: dict[str, float] = {}
    if args.turntable:
        videos["turntable"] = render.turntable(loaded, head, view, length, degrees)
    if args.to:
        end = _frame_head(loaded, args.to, args.expression)
        videos["interpolation"] = render.interpolation(loaded, head, end, view, length)
    if clips is not None:
        videos["driven"], rates["driven"] = render.driven(loaded, head, clips, view), clips.rate
    sheets: dict[str, Any] = {}

    def draw(name: str, function: Callable[..., Any], *values: Any) -> None:
        log(f"drawing {name}.jpg, {view.width} x {view.height} px per picture")
        sheets[name] = function(loaded, *values)

    if args.samples:  # first, because it needs several people
        draw("samples", render.sample_sheet, head, view, args.samples, args.seed or 0, spread)
    if args.views:
        draw("views", render.novel_views, head, view)
    if args.controls:
        draw("controls", render.control_sheet, head, view)
    if args.expression_of:
        plain = _frame_head(loaded, args.subject or model.subjects[0])
        donor = _frame_head(loaded, args.expression_of)
        draw("transfer", render.residual_sheet, plain, donor, view)
    draw("grid", render.expression_grid, subjects, expressions, view)
    picture = render.picture(loaded, head, view)
    args.out.mkdir(parents=True, exist_ok=True)
    render.set_aside(args.out, {*videos, *sheets})
    write_image(args.out / "picture.png", picture)
    say(f"wrote {args.out / 'picture.png'}")
    for name, sheet in sheets.items():  # before videos, which take long and may be stopped
        render.write_sheet(args.out / f"{name}.jpg", *sheet)
        say(f"wrote {args.out / name}.jpg")
    for name, frames in videos.items():
        log(f"drawing {name}.mp4, {view.width} x {view.height} px")
        render.write_video(args.out / f"{name}.mp4", frames, rates.get(name, RIG_RATE))
        say(f"wrote {args.out / name}.mp4")
    return OK


def export(args: argparse.Namespace) -> int:
    """Write one head to a file."""
    from grmm.export import write_export
    from grmm.render import camera_of, read_clips

    form = args.format or args.out.suffix[1:].lower()
    if form not in FORMATS:
        expected = ", ".join(f".{name}" for name in FORMATS if name not in ("splats", "arkit"))
        raise ConfigError(f"{args.out}: unknown kind of file, expected one of {expected}")
    ending = ".glb" if form in ("splats", "arkit") else f".{form}"
    if args.out.suffix.lower() != ending:
        raise ConfigError(f"{args.out}: --format {form} needs a name that ends in {ending}")
    if form != "html" and (unused := [n for n in ("drive", "shards") if getattr(args, n)]):
        raise ConfigError(f"--{unused[0]} is only for .html pages, not for {args.out.name}")
    if form == "html" and args.camera:
        raise ConfigError("--camera is not for .html pages: they show the head from all sides")
    _require(args, "drive", "drive_cue")
    check_results_file(args.out)
    loaded = _load(args.checkpoint)
    head, view = _edited_head(loaded, args), camera_of(loaded, args.camera)
    if form == "html":
        from grmm.player import export_player
        from grmm.shard_source import ShardSource

        subject, _ = _frame(loaded, args.subject, None)
        views = loaded.views(ShardSource(args.shards, "*")) if args.shards else None
        clips = read_clips(args.drive, args.drive_cue) if args.drive else None
        log("making the page: a smaller model learns to draw the head")
        say(f"wrote {args.out}: {export_player(args.out, loaded, head, subject, views, clips)}")
        return OK
    say(f"wrote {args.out}: {write_export(args.out, loaded, head, view, form)}")
    return OK


def view(args: argparse.Namespace) -> int:
    """Serve the viewer until Ctrl-C."""
    from grmm.viewer import Viewer

    viewer = Viewer(_load(args.checkpoint), args.host, args.port, args.size, args.still)
    say(f"{viewer.address}  (Ctrl-C stops)")
    viewer.run()
    return OK


def evaluate(args: argparse.Namespace) -> int:
    """Measure a checkpoint on people it has codes for, and on people fitted first."""
    from express50.geometry.sampling import evenly
    from grmm.evaluate import SEEN, evaluate, journal_rows, kind_of, save_pictures, training_render
    from grmm.fit import FITS, evaluate_unseen, unseen_views
    from grmm.metrics import PerceptualMetrics
    from grmm.shard_source import ShardSource

    _check_evaluation_folder(args.out)
    if args.save:
        check_results_folder(args.save)
    _require(args, "fit_cameras", "fit_budget", "fit_expression")
    loaded = _load(args.checkpoint, _metric_settings(args), args.fit_budget)
    if args.fit_cameras and loaded.seen_before is not None:
        raise ConfigError(
            f"{args.checkpoint} is a fit of {loaded.model.subjects[0]}: it does not hold whom"
            " training saw; --fit-cameras needs a checkpoint of 'grmm train'"
        )
    source = ShardSource(args.shards, "*")
    views = loaded.views(source)
    judge = PerceptualMetrics(loaded.config.metrics)
    kind = partial(kind_of, loaded)
    known, unseen = _split(loaded, views, args)
    if args.heldout:
        known = [i for i in known if kind(views.keys[i]) != SEEN]
    known = evenly(known, args.images or len(known))
    if not known and not unseen:
        raise ConfigError(
            f"{args.shards}: training saw every chosen sample; drop --heldout, or train with "
            "--holdout-cameras"
        )
    protocol = _protocol(args)
    for subject, chosen in unseen.items():  # before anybody is fitted for nothing
        trained = loaded.model.expressions
        _, unseen[subject] = unseen_views(trained, views, subject, protocol, chosen)
    fits = args.out / FITS
    with alone_in(args.out):  # the other one would delete the fits of this
        journal = _journal(args, loaded, source.digest, protocol, fits)
        # After a stop, pictures are from this command.
        new = [] if journal_rows(journal) else [*known, *chain.from_iterable(unseen.values())]
        keep = save_pictures(args.save, source.window, views, new) if args.save else None
        fits.mkdir(parents=True, exist_ok=True)
        check_space(fits)  # before anybody is measured for nothing
        render = training_render(loaded.model, views)
        log(f"measuring {count(len(known), 'image')} of people with codes")
        rows = evaluate(views, known, render, judge, kind, keep, journal)
        for subject, chosen in unseen.items():
            found, effort = evaluate_unseen(
                loaded, views, subject, protocol, judge, keep, chosen, fits, journal
            )
            log(f"{subject}: fitted from {', '.join(effort['cameras'])} in {effort['seconds']} s")
            rows += found
        code = _report(args, rows, judge)
        shutil.rmtree(fits, ignore_errors=True)  # only a stopped command needs them
    return code


def _journal(
    args: argparse.Namespace, loaded: Checkpoint, samples: str, protocol: FitProtocol, folder: Path
) -> Journal:
    """Name the file from which a stopped evaluation continues."""
    from grmm.evaluate import Journal

    made_from = {
        "checkpoint": file_sha256(args.checkpoint),
        "samples": samples,
        "config": as_tables(loaded.config),
        "protocol": asdict(protocol),
        "pictures": str(args.save),
    }
    return Journal(folder / "rows.jsonl", hashlib.sha256(dump_json(made_from)).hexdigest())


def _split(
    loaded: Checkpoint, views: HeadViews, args: argparse.Namespace
) -> tuple[list[int], dict[str, list[int]]]:
    """Split samples into those with trained codes and, per person, those to fit first."""
    from grmm.data import with_codes
    from grmm.shard_source import select

    chosen = select(views.keys, args.subjects, args.expressions, args.cameras)
    keys, model = views.keys, loaded.model
    strangers = sorted({keys[i].subject for i in chosen} - {*model.subjects})
    unseen = {name: [i for i in chosen if keys[i].subject == name] for name in strangers}
    known = [i for i in chosen if keys[i].subject not in unseen]
    known = with_codes(keys, known, model.subjects, model.expressions)
    if not known and not unseen:
        names = few(sorted({keys[i].expression for i in chosen}))
        raise ConfigError(
            f"{args.shards}: the checkpoint has no codes of {names};"
            f" choose among the expressions that were trained: {few(model.expressions)}"
        )
    if args.fit_cameras:
        return known, unseen
    if not known:
        raise ConfigError(
            f"{args.shards}: the checkpoint has no codes of {', '.join(unseen)}; "
            "give --fit-cameras, with a checkpoint of 'grmm train', to fit such people first"
        )
    if unseen:
        log(
            f"left out {', '.join(unseen)}, of whom the checkpoint has no codes: "
            "--fit-cameras fits them from a checkpoint of 'grmm train'"
        )
    return known, {}


def score(args: argparse.Namespace) -> int:
    """Measure pictures that another method made."""
    from express50.geometry.sampling import evenly
    from express50.head.load import load_head
    from grmm.config import DataConfig, MetricsConfig
    from grmm.data import HeadViews
    from grmm.evaluate import score
    from grmm.metrics import PerceptualMetrics
    from grmm.shard_source import ShardSource, select

    _check_evaluation_folder(args.out)
    # `evaluate` leaves these pixels out too, of all presets but `paper`.
    data = DataConfig(background=args.background, skip_hidden_neck=True)
    source = ShardSource(args.shards, "*")
    views = HeadViews(source, load_head(source.head), data)
    chosen = select(views.keys, args.subjects, args.expressions, args.cameras)
    chosen = evenly(chosen, args.images or len(chosen))
    judge = PerceptualMetrics(MetricsConfig(alexnet=args.alexnet, inception=args.inception))
    log(f"measuring {count(len(chosen), 'image')}")
    rows = score(args.renders, source.window, views, chosen, judge, args.partial)
    _report(args, rows, judge)
    if len(rows) < len(chosen):
        log(f"scored {len(rows)} of {len(chosen)} samples: the others have no picture")
    return OK


def _report(args: argparse.Namespace, rows: list, judge: PerceptualMetrics) -> int:
    from grmm.evaluate import summary_lines, write_evaluation

    summary = write_evaluation(args.out, rows, judge)
    return answer(args, summary, *summary_lines(summary))


def ablate(args: argparse.Namespace) -> int:
    """Train and measure every row of the ablation that is not measured yet."""
    from grmm.ablate import Ablation, ablate
    from grmm.shard_source import open_shards

    check_results_folder(args.out)
    open_shards([args.shards, *args.also], "train")  # first, as in `train`
    config = train_config(args)
    if args.fit_budget is not None:
        config = replace(config, fit=replace(config.fit, seconds=args.fit_budget))
    run = Ablation(
        roots=[args.shards, *args.also],
        out=args.out,
        config=config,
        protocol=_protocol(args),
        subjects=_split_names(args.fit_subjects),
        seeds=args.seeds,
        test=args.test,
    )
    with alone_in(args.out):
        table = ablate(run, _split_names(args.rows))
    code = answer(args, table, (args.out / "ablation.md").read_text(encoding="utf-8"))
    return FAILED if any("diverged" in row for row in table["rows"].values()) else code


def _protocol(args: argparse.Namespace) -> FitProtocol:
    from grmm.fit import FitProtocol

    return FitProtocol(
        cameras=_split_names(args.fit_cameras),
        expression=args.fit_expression or FitProtocol.expression,
        images=args.images,
    )


def study_make(args: argparse.Namespace) -> int:
    """Write a study of two methods' pictures."""
    from grmm.study import make_study

    check_results_folder(args.out)
    methods = list(zip(args.names, (args.ours, args.theirs), strict=True))
    with alone_in(args.out):
        study = make_study(
            args.out, args.reference, methods, args.examples, args.participants, args.seed or 0
        )
    say(f"wrote {args.out / 'study.json'}: {len(study['examples'])} examples")
    return OK


def study_serve(args: argparse.Namespace) -> int:
    """Serve a study until Ctrl-C."""
    from grmm.study import make_server

    check_results_folder(args.out)
    # Answers would count for another study that was made meanwhile.
    with alone_in(args.out), make_server(args.out, args.host, args.port) as server:
        say(f"{server.address}  (Ctrl-C stops; answers are kept)")
        server.serve_forever()
    return OK


def study_table(args: argparse.Namespace) -> int:
    """Write and print the table of a study's answers."""
    from grmm.study import markdown, read_answers, read_study, summarise

    study = read_study(args.out)
    summary = summarise(study, read_answers(args.out, study))
    write_json(args.out / "table.json", summary)
    write_bytes(args.out / "table.md", markdown(summary).encode())
    return answer(args, summary, markdown(summary))


def _require(args: argparse.Namespace, needed: str, *options: str) -> None:
    """Refuse options that mean nothing without another one, or one of several."""
    for option in options:
        if getattr(args, option) is not None and not any(getattr(args, n) for n in needed.split()):
            first, *others = (f"--{n.replace('_', '-')}" for n in (option, *needed.split()))
            raise ConfigError(f"{first} needs {' or '.join(others)}; give both")


def _metric_settings(args: argparse.Namespace) -> list[str]:
    """Translate --alexnet and --inception to assignments."""
    given = {"alexnet": args.alexnet, "inception": args.inception}
    return [f"metrics.{name}={path}" for name, path in given.items() if path]


def _load(path: Path, assignments: Sequence[str] = (), seconds: float | None = None) -> Checkpoint:
    """Read a checkpoint; ``fit.*``, ``metrics.*`` and ``loss.*`` replace its own settings."""
    from grmm.checkpoint import load_checkpoint
    from grmm.train_state import best_device

    loaded = load_checkpoint(path, best_device())
    tables = as_tables(loaded.config)
    for table, key, value in known_assignments(assignments, CHANGEABLE):
        tables[table][key] = value
    if seconds is not None:
        tables["fit"]["seconds"] = seconds
    return replace(loaded, config=from_tables(tables))


def _edited_head(loaded: Checkpoint, args: argparse.Namespace) -> HeadCodes:
    """Build the head that the arguments describe: a training head, then its edits."""
    from grmm.edit import controlled, trained_head, with_expression

    if args.expression and args.expression_of:
        raise ConfigError("--expression and --expression-of: give only one of them")
    head = trained_head(loaded, *_frame(loaded, args.subject, args.expression))
    if args.expression_of:
        head = with_expression(head, _frame_head(loaded, args.expression_of))
    if args.z_id_of:
        head = replace(head, z_id=_frame_head(loaded, args.z_id_of).z_id)
    if args.z_exp_of:
        donor = trained_head(loaded, loaded.model.subjects[0], args.z_exp_of)
        head = replace(head, z_exp=donor.z_exp)
    controls = {}
    for text in args.control:
        name, _, numbers = text.partition("=")
        try:
            controls[name.strip()] = tuple(float(number) for number in numbers.split(","))
        except ValueError:
            raise ConfigError(
                f"--control {text!r}: expected NAME=NUMBER or NAME=NUMBER,NUMBER,NUMBER"
            ) from None
    return controlled(loaded, head, controls)


def _frame_head(loaded: Checkpoint, text: str, expression: str | None = None) -> HeadCodes:
    """Build the head of ``SUBJECT/EXPRESSION``; ``expression`` replaces a missing second part."""
    from grmm.edit import trained_head

    subject, _, named = text.partition("/")
    model = loaded.model
    if text in model.expressions and text not in model.subjects:
        raise ConfigError(f"{text!r}: expected SUBJECT/EXPRESSION: {model.subjects[0]}/{text}")
    return trained_head(loaded, *_frame(loaded, subject, named or expression))


def _frame(loaded: Checkpoint, subject: str | None, expression: str | None) -> tuple[str, str]:
    """Choose the subject and expression to draw, by default the first subject's neutral."""
    subject = subject or loaded.model.subjects[0]
    if expression is None:
        own = [e for s, e in loaded.gallery.frames if s == subject]
        expression = "neutral" if "neutral" in own else (own or list(loaded.model.expressions))[0]
    return subject, expression


def _split_names(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of names."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
