"""Record synthetic captures with known truth (``express50 twin record``).

Worker processes film the subjects; each is then published complete or not at all.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from express50.capture.expressions import select
from express50.console import add_command, answer, count, log, number
from express50.contract.config import field_documents
from express50.contract.layout import check_results_folder
from express50.errors import CaptureError, ConfigError, few
from express50.files.atomic import alone_in, dump_json, link_file, write_json
from express50.runner.worker import cap_threads
from express50.twin import TwinConfig

_EXAMPLE = """express50 twin record build/twin --subjects 4 --cameras 8 \\
      --width 320 --height 320 --expressions neutral,smile,jaw_open
writes build/twin/captures/S001... (for 'express50 ingest') and build/twin/truth/S001..."""
_NUMBERS = [setting.name for setting in fields(TwinConfig) if setting.type in ("int", "float")]
# Shorter side: with 160 px no camera sees a corner of the board, with 192 one in four sees enough.
BOARD_PX = 224

SETTINGS = "twin.json"  # file beside the captures

Task = tuple[str, list[int]]
_counter: Any = None  # shared count of pictures, set in every worker


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``twin`` with its sub-command ``record``."""
    area = subparsers.add_parser("twin", help="record a synthetic capture with known truth")
    actions = area.add_subparsers(dest="action", metavar="ACTION", required=True)
    parser = add_command(
        actions, "record", record_command, "record subjects of the digital twin",
        dataset=False, example=_EXAMPLE,
    )  # fmt: skip
    words, default = field_documents(TwinConfig), TwinConfig()
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for captures/ and truth/")
    for name in _NUMBERS:
        value = getattr(default, name)
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=type(value), default=value, metavar="N",
            help=f"{words[name]} (default: {value:g})",
        )  # fmt: skip
    parser.add_argument("--head", default=default.head, metavar="MODEL",
                        help=f"{words['head']} (default: {default.head})")  # fmt: skip
    parser.add_argument("--expressions", metavar="ID,ID...", help=words["expressions"])
    parser.add_argument("--wear", metavar="KIND,KIND...", default="", help=words["wear"])
    parser.add_argument("--frames", choices=("png", "jpg"), nargs="?", const="png",
                        help="write single images instead of H.264 videos")  # fmt: skip
    parser.add_argument("--give-calibration", action="store_true", help=words["give_calibration"])
    parser.add_argument("--no-plates", action="store_true", help="record no plates")
    parser.add_argument("--no-hair", action="store_true", help="record bald subjects")
    parser.add_argument("--workers", type=number(1), metavar="N",
                        default=min(8, os.cpu_count() or 1),
                        help="processes; their number does not change the result (default: one per"
                        " core, at most 8)")  # fmt: skip


def record_command(args: argparse.Namespace) -> int:
    """Record the subjects, and print which were recorded."""
    ids, worn = (
        tuple(part.strip() for part in text.split(",") if part.strip())
        for text in (args.expressions or "", args.wear)
    )
    config = TwinConfig(
        **{name: getattr(args, name) for name in _NUMBERS},
        head=args.head,
        expressions=ids or None,
        wear=worn,
        footage=args.frames or "video",
        give_calibration=args.give_calibration,
        plates=not args.no_plates,
        hair=not args.no_hair,
    )
    short = min(config.width, config.height)
    if config.board_frames and not config.give_calibration and short < BOARD_PX:
        log(
            f"warning: in pictures of {short} px the board is too small to calibrate cameras from;"
            f" use {BOARD_PX} px or more, or --give-calibration"
        )
    check_out(args.out)
    with alone_in(args.out):
        recorded = record(config, args.out, args.workers, print_progress())
    captures, kept = args.out / "captures", args.subjects - len(recorded)
    rest = f"; {kept} recorded before" if kept else ""
    line = f"{count(len(recorded), 'subject')} recorded in {captures}{rest}"
    return answer(args, {"captures": str(captures), "recorded": recorded}, line)


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that holds anything but an earlier recording.

    Raises:
        ConfigError: it holds other files.
        OSError: the system refuses.
    """
    if (out / SETTINGS).is_file():
        return
    check_results_folder(out)
    if held := sorted(p.name for p in out.glob("*") if not p.name.startswith(".")):
        raise ConfigError(
            f"{out}: holds {few(held)}, expected an earlier recording or nothing; name another"
            " folder"
        )


def record(
    config: TwinConfig,
    out: Path,
    workers: int = 2,
    report: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Record the subjects that do not exist yet, and return their ids; others are kept.

    Writes ``out/captures/<subject>`` (raw capture layout) and ``out/truth/<subject>``. `report` is
    called regularly with the number of pictures done and of all pictures.

    Raises:
        CaptureError: ``out`` holds a recording with other settings.
    """
    script = select(config.expressions)
    path = out / SETTINGS
    settings = {k: v for k, v in asdict(config).items() if k not in ("subjects", "first_subject")}
    now = json.loads(dump_json(settings))
    # Else nothing was recorded with the stored settings. Captures may have been moved elsewhere.
    begun = any(path for name in ("captures", "truth") for path in (out / name).glob("*"))
    former = json.loads(path.read_bytes()) if begun and path.is_file() else now
    changed = sorted(k for k in now | former if former.get(k) != now.get(k))
    if changed:
        raise CaptureError(
            f"{out}: holds a recording with other settings ({', '.join(changed)} differ);"
            " record into another folder or delete this one"
        )
    write_json(path, now)
    ids = [f"S{config.first_subject + n:03d}" for n in range(config.subjects)]
    missing = [s for s in ids if not (out / "captures" / s).is_dir()]
    if not missing:
        return []
    staging = out / ".recording"
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    # A task is a subject, or "" for the board, and some cameras. A subject's cameras share each
    # frame's geometry, so they are split only if there are more workers than subjects.
    parts = min(config.cameras, max(1, -(-workers // len(missing))))
    groups = [list(range(k, config.cameras, parts)) for k in range(parts)]
    tasks = [(subject, group) for subject in missing for group in groups]
    if config.board_frames:
        shares = [list(range(k, config.cameras, workers)) for k in range(workers)]
        tasks += [("", share) for share in shares if share]
    frames = len(script) * config.frames_per_expression
    total = config.cameras * (len(missing) * frames + config.board_frames)
    _run(config, staging, tasks, workers, lambda done: report(done, total) if report else None)
    for subject in missing:
        _publish(config, subject, staging, out)
    shutil.rmtree(staging)
    return missing


def _run(
    config: TwinConfig,
    staging: Path,
    tasks: list[Task],
    workers: int,
    report: Callable[[int], None],
) -> None:
    """Film all tasks; the first failure stops the others."""
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    if workers == 1:
        _start_worker(counter)
        for task in tasks:
            _film(config, task, staging)
            report(counter.value)
        return
    with ProcessPoolExecutor(
        workers, mp_context=context, initializer=_start_worker, initargs=(counter,)
    ) as pool:
        futures: set[Future] = {pool.submit(_film, config, task, staging) for task in tasks}
        try:
            while futures:
                done, futures = wait(futures, timeout=1.0, return_when="FIRST_COMPLETED")
                for future in done:
                    future.result()
                report(counter.value)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _start_worker(counter) -> None:  # noqa: ANN001 - a ctypes wrapper without a public type
    global _counter
    _counter = counter
    cap_threads(1)


def _tick() -> None:
    with _counter.get_lock():
        _counter.value += 1


def _film(config: TwinConfig, task: Task, staging: Path) -> None:
    # Imported here, because the main process needs neither torch nor Open3D.
    import torch

    from express50.twin.studio import film_board, film_subject

    torch.set_num_threads(1)
    subject, cameras = task
    if subject:
        folders = staging / "captures" / subject, staging / "truth" / subject
        film_subject(config, subject, cameras, *folders, _tick)
    else:
        film_board(config, cameras, staging / "board", _tick)


def _publish(config: TwinConfig, subject: str, staging: Path, out: Path) -> None:
    """Add a subject's other files to its footage, then move truth and capture into place."""
    from express50.twin.rig import BOARD_TOML

    capture, truth = staging / "captures" / subject, staging / "truth" / subject
    about = json.loads((truth / "subject.json").read_text())
    age, gender = about["look"]["age"], about["look"]["gender"]
    (capture / "capture.toml").write_text(
        f'subject = "{subject}"\nfps = {config.fps:g}\nsession = "twin-seed-{config.seed}"\n'
        'units = "metre"\ncolor_space = "sRGB"\ncamera_model = "digital twin"\n'
        f'consent = "synthetic-{subject}"\nlicence = "CC0-1.0"\nsynthetic = true\n'
        f'age = {age}\ngender = "{gender}"\n'
        f'rig = "{config.cameras} cameras over about 300 degrees, ray cast"\n'
    )
    rows = [f"{name},{first},{last}\n" for name, first, last in about["cues"]]
    (capture / "cues.csv").write_text("expression_id,start_frame,end_frame\n" + "".join(rows))
    if config.board_frames:
        # All subjects have the same board pictures, so links save space.
        shutil.copytree(staging / "board", capture / "board", copy_function=link_file)
        (capture / "board" / "board.toml").write_text(BOARD_TOML)
    if config.give_calibration:
        shutil.copyfile(truth / "cameras.json", capture / "calibration.json")
    for source, target in ((truth, out / "truth"), (capture, out / "captures")):
        target.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(target / subject, ignore_errors=True)
        source.rename(target / subject)


def print_progress() -> Callable[[int, int], None]:
    """Return a reporter for `record` that prints to standard error, on a terminal in one line."""
    start = last = time.monotonic()
    live, printed = sys.stderr.isatty(), -1

    def report(done: int, total: int) -> None:
        nonlocal last, printed
        now = time.monotonic()
        if done == printed or (not live and now - last < 10.0 and done < total):
            return
        last, printed = now, done
        rate = done / max(now - start, 1e-3)
        left = f"{(total - done) / rate:.0f} s left" if done else "starting"
        line = f"twin {done}/{total} pictures {rate:.1f}/s {left}"
        end = "   \r" if live and done < total else "\n"
        print(line, end=end, file=sys.stderr, flush=True)

    return report
