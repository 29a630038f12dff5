"""The recipes of docs/RECIPES.md run as they are printed."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from express50.capture.readers.selection import Selection
from express50.contract.stage import Stage
from express50.head.load import load_head
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
    capture = made["read"](rig, Selection())
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
