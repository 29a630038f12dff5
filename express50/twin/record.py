"""Recording: plan the work, film it in processes, publish captures and their truth."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

from express50.capture.expressions import select
from express50.errors import CaptureError
from express50.files.atomic import write_bytes
from express50.runner.threads import cap_threads
from express50.twin.config import TwinConfig

_counter: Any = None  # shared count of pictures, set in every worker


def record(
    config: TwinConfig,
    out: Path,
    workers: int = 2,
    report: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Record subjects that are not there yet; the rest is kept.

    Writes ``out/captures/<subject>`` (raw capture layout) and ``out/truth/<subject>``. A subject
    appears whole or not at all.

    Args:
        config: what to record.
        out: the folder.
        workers: processes.
        report: called now and then with pictures done and pictures in all.

    Returns:
        Ids of the subjects recorded now.

    Raises:
        CaptureError: ``out`` holds a recording with other settings.
    """
    select(config.expressions)
    _check_settings(config, out)
    missing = [s for s in config.subject_ids() if not (out / "captures" / s).is_dir()]
    if not missing:
        return []
    staging = out / ".recording"
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    tasks = _plan(config, missing, workers)
    frames = len(select(config.expressions)) * config.frames_per_expression
    total = config.cameras * (len(missing) * frames + config.board_frames)
    _run(config, staging, tasks, workers, lambda done: report(done, total) if report else None)
    for subject in missing:
        _publish(config, subject, staging, out)
    shutil.rmtree(staging)
    return missing


Task = tuple[str, list[int]]  # subject id, or "" for the board, and indices of cameras


def _plan(config: TwinConfig, subjects: list[str], workers: int) -> list[Task]:
    """Split by subject, and by camera where there are more workers than subjects.

    Cameras of one task share each frame's geometry, so tasks are kept as large as they can be.
    """
    parts = min(config.cameras, max(1, -(-workers // len(subjects))))
    groups = [list(range(k, config.cameras, parts)) for k in range(parts)]
    tasks = [(subject, group) for subject in subjects for group in groups]
    if config.board_frames:
        tasks += [("", list(range(k, config.cameras, workers))) for k in range(workers)]
    return [task for task in tasks if task[1]]


def _run(
    config: TwinConfig,
    staging: Path,
    tasks: list[Task],
    workers: int,
    report: Callable[[int], None],
) -> None:
    """Film all tasks; the first failure stops the rest."""
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
    # Imported here: the planning process needs neither torch nor Open3D.
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
    """Add the files besides footage, then move a subject's truth and capture into place."""
    from express50.twin.board import BoardSpec

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
        # One rig, one board sequence: hard links spare the disk copies for every subject.
        shutil.copytree(staging / "board", capture / "board", copy_function=os.link)
        (capture / "board" / "board.toml").write_text(BoardSpec().toml())
    if config.give_calibration:
        shutil.copyfile(truth / "cameras.json", capture / "calibration.json")
    for source, target in ((truth, out / "truth"), (capture, out / "captures")):
        target.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(target / subject, ignore_errors=True)
        source.rename(target / subject)


def _check_settings(config: TwinConfig, out: Path) -> None:
    """Remember the settings of a recording, so that it is never continued with others."""
    path = out / "twin.json"
    settings = {k: v for k, v in asdict(config).items() if k not in ("subjects", "first_subject")}
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    begun = any((out / "captures").glob("*"))  # otherwise nothing was recorded with these settings
    if begun and path.is_file() and path.read_text() != text:
        former = json.loads(path.read_text())
        changed = sorted(
            k for k in settings if json.dumps(former.get(k)) != json.dumps(settings[k])
        )
        raise CaptureError(
            f"{out}: holds a recording with other settings ({', '.join(changed)} differ);"
            " record into another folder or delete this one"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())


def print_progress(stream=sys.stderr, every: float = 10.0) -> Callable[[int, int], None]:  # noqa: ANN001
    """Make a reporter for :func:`record`: one line that rewrites itself, or plain lines."""
    start = last = time.monotonic()
    live = stream.isatty()

    def report(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if not live and now - last < every and done < total:
            return
        last = now
        rate = done / max(now - start, 1e-3)
        left = f"{(total - done) / rate:.0f} s left" if done else "starting"
        stream.write(f"{chr(13) if live else ''}twin {done}/{total} pictures {rate:.1f}/s {left}"
                     + ("   " if live and done < total else "\n"))  # fmt: skip
        stream.flush()

    return report
