"""Budgeted runs in which `frames` may reduce the pictures that later stages read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.capture.index import peak_items
from express50.contract.layout import Dataset
from express50.contract.stage import ExpectedError, Growth, Result, Stage
from express50.dial.budget import parse_budget
from express50.dial.choice import choice_lines, front
from express50.dial.figures import dial_dir, read_measured
from express50.dial.measuring import tune, workload
from express50.dial.pilot import Chain
from express50.dial.results import ResultKind
from express50.dial.run import run_within
from express50.files.calibration import write_cameras
from express50.runner.executor import Pool
from pipelines import ingest
from pipelines.frames import STAGE as FRAMES
from tests.express50.dial import toy_chain
from tests.express50.dial.toy_chain import NoConfig, captures_of
from tests.synth import make_rig

SIDES = {"draft": 24, "standard": 0}  # of 48 pixels
PER_PIXEL = 6e-5  # processor seconds, of each of two cameras


def _calibrate(dataset: Dataset, item: str, config: NoConfig, out: Path) -> Result:
    write_cameras(out / "cameras.json", make_rig(cameras=2, size=48))
    return Result()


CALIBRATE = Stage(
    name="calibrate", version=1, config=NoConfig, items=Dataset.subjects, run=_calibrate,
    inputs=lambda dataset, item, config: {"index": dataset.index_file(item)},
    growth=Growth(items=("subjects",), time=()),
)  # fmt: skip


def _look(dataset: Dataset, item: str, config: NoConfig, out: Path) -> Result:
    """Work for a time proportional to the pixels; the error is that of a pixel."""
    subject, expression = item.split("/")
    for name, camera in read_cameras_of(dataset, subject).items():
        picture = read_peak_frame(dataset, subject, expression, name)
        assert picture.shape == (camera.height, camera.width, 3)
        toy_chain.pause(PER_PIXEL * camera.width * camera.height)
    error = 48 / camera.width
    np.save(out / "error.npy", np.array(error))
    return Result(expected_error=ExpectedError(error, 0.8 * error, 1.25 * error, "mm"))


def _seen(dataset: Dataset, item: str, config: NoConfig) -> dict[str, Path | str]:
    subject, expression = item.split("/")
    frame = dataset.frame_file(subject, expression, "cam00")
    return {"frame": frame, "sizes": dataset.picture_sizes_file(subject)}


LOOK = Stage(
    name="look", version=1, config=NoConfig, items=peak_items, inputs=_seen, run=_look,
    growth=Growth(items=("subjects", "expressions"), time=("views", "picture")),
)  # fmt: skip


def _file(dataset: Dataset, subject: str, expression: str, camera: str) -> Path:
    return dataset.item_dir("look", f"{subject}/{expression}") / "error.npy"


def _apart(a: Dataset, b: Dataset, subject: str, names: list[str]) -> list[float]:
    files = [[_file(dataset, subject, name, "") for dataset in (a, b)] for name in names]
    errors = [[float(np.load(file)) for file in pair] for pair in files if pair[0].is_file()]
    return [abs(one**2 - two**2) ** 0.5 for one, two in errors]


def chain_of(root: Path, captures: list[Path]) -> Chain:
    dataset = Dataset(root.resolve())
    work = (ingest.STAGE, toy_chain.ALIGN, CALIBRATE, FRAMES, LOOK)
    ingest.add_captures(dataset, captures)
    ladders = {stage.name: {"standard": stage.config()} for stage in work}
    ladders["frames"] = {n: FRAMES.config(image_side=side) for n, side in SIDES.items()}
    kinds = (ResultKind("look", "mm", (_file,), _apart),)
    return Chain(work, dataset, ladders, Pool(0), lambda line: None, kinds)


def test_a_tight_budget_reduces_pictures_and_a_larger_one_makes_them_whole_again(
    tmp_path, monkeypatch
):
    toy_chain.count_pauses(monkeypatch)
    # With plates, since `frames` would otherwise learn the walls, which takes a minute.
    captures, root = captures_of(tmp_path, subjects=2, plates=True), tmp_path / "d"
    presets = tune(chain_of(root, captures))[0]["presets"]
    reduced, whole = (presets[name]["core_seconds"] for name in SIDES)
    saved = whole - reduced
    assert saved == pytest.approx(8 * 2 * PER_PIXEL * (48**2 - 24**2))

    def widths(budget: str) -> set[int]:
        chain = chain_of(root, captures)
        summaries, state = run_within(chain, parse_budget(budget), None, lambda *_: None)
        assert all(summary.ok for summary in summaries) and state.finished
        value, low, high = state.stated["look"]
        assert value == pytest.approx(state.promised["look"]["value"], rel=0.05)
        return {c.width for s in ("S0", "S1") for c in read_cameras_of(chain.dataset, s).values()}

    assert widths(f"{(0.5 * saved + reduced) / 3600:.7f}ch") == {24}
    assert widths("1ch") == {48}


@pytest.mark.parametrize(("side", "trials"), [(24, 3), (96, 2)])
def test_pictures_that_are_small_enough_are_not_tried_whole(tmp_path, side, trials):
    chain = chain_of(tmp_path / "d", captures_of(tmp_path, subjects=1, plates=True))
    chain.ladders["frames"]["draft"] = FRAMES.config(image_side=side)
    tune(chain)
    found = read_measured(dial_dir(chain.dataset) / "measured.json")
    assert len(found.trials) == trials
    load = workload(chain, found, False, {})
    lines = "\n".join(choice_lines(load, front(load)[0], "budget 1h", 0.0))
    assert ("standard: the same, as no recorded picture is larger" in lines) == (side == 96)
    assert "not tried" not in lines
