"""The recipes of docs/RECIPES.md run, and the examples of docs/FORMAT.md are read, as printed."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from express50.capture.demographics import PUBLIC_KEYS
from express50.capture.raw import read_cues, read_meta
from express50.capture.readers.read import Layout
from express50.capture.readers.selection import Selection
from express50.contract.stage import Stage
from express50.files.calibration import read_cameras
from express50.head.load import load_head
from pipelines.calibrate.board import board_from_table
from tests.grmm.packed import write_shards
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head
from tests.synth import noise_video_images, write_video

PAGE = Path(__file__).resolve().parents[1] / "docs" / "RECIPES.md"


def pasted(heading: str) -> list[str]:
    """Return the blocks of code below a heading."""
    section = PAGE.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"```\w+\n(.*?)```", section, re.DOTALL)


def test_head_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head = load_head("procedural")
    arrays = {k: v.numpy() for k, v in vars(head).items() if isinstance(v, torch.Tensor)}
    names = {"shape_names": head.shape_names, "expression_names": head.expression_names}
    regions = {name: mask.numpy() for name, mask in head.regions.items()}
    (block,) = pasted("A head model of your own")
    exec(block, arrays | names | {"regions": regions})
    mine = load_head("mine.npz")
    assert mine.template.equal(head.template) and mine.regions.keys() == head.regions.keys()


def test_reader(tmp_path):
    (block,) = pasted("A reader of your own")
    exec(block, made := {"__name__": "myrig"})
    rig = tmp_path / "S100"
    for camera in ("left", "right"):
        (rig / "smile").mkdir(parents=True, exist_ok=True)
        write_video(rig / "smile" / f"{camera}.mp4", noise_video_images(4))
    assert not made["fits"](rig)
    (rig / "rig.json").write_text("{}")
    assert made["fits"](rig)
    (row,) = re.findall(r"`(Layout\(.*?\))`", PAGE.read_text(encoding="utf-8"))
    layout = eval(row, {"Layout": Layout, "myrig": SimpleNamespace(**made)})
    assert layout.fits(rig) and layout.subject_of(rig) == "S100"
    capture = layout.read(rig, Selection())
    assert capture.subject == "S100" and set(capture.cameras) == {"left", "right"}
    assert capture.clips == ("smile",)


def test_stage(tmp_path, monkeypatch):
    code, package = pasted("A stage of your own")
    (tmp_path / "my_stages.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    (stage,) = importlib.import_module("my_stages").STAGES
    assert isinstance(stage, Stage) and stage.config().limit == 20.0
    points = tomllib.loads(package)["project"]["entry-points"]["express50.stages"]
    assert points == {"mine": "my_stages:STAGES"}


def test_loss(monkeypatch):
    (block,) = pasted("A loss of your own")
    calls = []
    monkeypatch.setattr(
        "grmm.shard_source.open_shards", lambda *_: SimpleNamespace(head="procedural")
    )
    monkeypatch.setattr(
        "grmm.train.train", lambda *given, own_terms: calls.append((given, own_terms))
    )
    exec(block, {})
    ((_source, head, out, config), own_terms) = calls[0]
    assert (head.name, out, config.model.n_g) == ("procedural", Path("OUT"), 256)
    rendering = SimpleNamespace(gaussians=SimpleNamespace(opacities=torch.tensor([0.5])))
    assert own_terms(None, rendering, None)["opaque"] == pytest.approx(5e-4)


def test_model(tmp_path, monkeypatch):
    source = EllipsoidSource(size=32)
    write_shards(tmp_path / "DATASET" / "pack" / "shards", source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("express50.head.load.load_head", lambda _: ellipsoid_head())
    (block,) = pasted("A model of your own")
    exec(block, made := {})
    batch = next(iter(made["loader"]))
    assert batch["rgb"].shape == (8, 3, 32, 32) and 0.1 < batch["rgb"].max() <= 1
    camera, vertices = batch["cam_from_world"], batch["vertices"]
    seen = vertices @ camera[:, :3, :3].transpose(1, 2) + camera[:, None, :3, 3]
    pixels = (seen @ batch["K"].transpose(1, 2)) / seen[..., 2:]
    inside = batch["alpha"].nonzero()  # picture, row, column
    for picture in range(8):
        rows = inside[inside[:, 0] == picture][:, 1:].flip(1) + 0.5
        drawn = pixels[picture, :, :2]
        assert (drawn.amin(0) - rows.amin(0)).abs().max() < 1.5
        assert (drawn.amax(0) - rows.amax(0)).abs().max() < 1.5
        depth = batch["depth"][picture]
        nearest = depth[depth > 0].min()
        assert abs(float(nearest - seen[picture, :, 2].min())) < 0.01


def test_examples_of_a_capture_can_be_read(tmp_path):
    page = PAGE.parent / "FORMAT.md"
    blocks = re.findall(r"```(\w+)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    files = ("capture.toml", "cues.csv", "board.toml", "calibration.json")
    assert [kind for kind, _ in blocks[: len(files)]] == ["toml", "csv", "toml", "json"]
    for name, (_, text) in zip(files, blocks, strict=False):
        (tmp_path / name).write_text(text)
    meta, cues = read_meta(tmp_path), read_cues(tmp_path / "cues.csv")
    assert meta["subject"] == "S001" and meta.keys() <= PUBLIC_KEYS
    assert [cue.expression_id for cue in cues] == ["neutral", "smile"]
    table = tomllib.loads((tmp_path / "board.toml").read_text())
    assert board_from_table(table, "board.toml").squares_x == 7
    assert read_cameras(tmp_path / "calibration.json")["cam00"].width == 1920


def test_names_that_the_guide_imports_exist():
    blocks = re.findall(r"```python\n(.*?)```", (PAGE.parent / "GUIDE.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec("\n".join(line for line in block.splitlines() if line.startswith("from ")), {})
