"""A head model's name means the same in every folder, and all files that it is read from count."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from express50.contract.layout import Dataset
from express50.dataset.tracks import track_inputs
from express50.errors import HeadModelError
from express50.head import absolute_head, head_files
from express50.head.load import load_head, load_topology
from pipelines.register.scan_files import register_scan
from pipelines.track import STAGE
from pipelines.track.config import TrackConfig
from tests.express50.dataset.tracked import track_arrays, write_track
from tests.express50.head.flame_files import write_flame

KINDS = {"head", "head embedding", "head masks", "head template"}


def test_a_relative_path_is_stored_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert TrackConfig(head="models/../flame.pkl").head == str(tmp_path / "flame.pkl")
    assert absolute_head("~/flame.pkl") == str(tmp_path / "home" / "flame.pkl")
    assert TrackConfig().head == "procedural"


def test_a_link_stays_where_its_companions_are(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "flame.pkl").touch()
    (tmp_path / "flame.pkl").symlink_to(tmp_path / "store" / "flame.pkl")
    assert absolute_head(str(tmp_path / "flame.pkl")) == str(tmp_path / "flame.pkl")


def test_flame_is_read_from_four_files(tmp_path: Path) -> None:
    flame = write_flame(tmp_path)
    assert set(head_files(str(flame))) == KINDS
    (tmp_path / "FLAME_masks.pkl").unlink()
    assert set(head_files(str(flame))) == KINDS - {"head masks"}
    assert head_files("procedural") == {}


def test_stages_count_the_files_beside_a_flame_pickle(tmp_path: Path) -> None:
    dataset, flame = Dataset(tmp_path / "data"), write_flame(tmp_path)
    write_track(dataset.track_file("S001"), track_arrays(flame))
    assert set(track_inputs(dataset, "S001")) == KINDS | {"track"}
    flame.rename(tmp_path / "away.pkl")
    with pytest.raises(HeadModelError, match=r"head model .*flame\.pkl is missing; put it back"):
        track_inputs(dataset, "S001")
    (tmp_path / "away.pkl").rename(flame)
    dataset.peaks_file("S001").parent.mkdir(parents=True)
    dataset.peaks_file("S001").write_text("{}")
    assert STAGE.inputs(dataset, "S001", TrackConfig(head=str(flame))).keys() >= KINDS


def test_a_model_that_another_machine_has_elsewhere_is_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    there.mkdir()
    named, dataset = str(write_flame(there)), Dataset(tmp_path / "data")
    write_track(dataset.track_file("S001"), track_arrays(Path(named)))
    there.rename(here)
    with pytest.raises(HeadModelError, match=r"EXPRESS50_HEADS to the folder that holds fl"):
        load_head(named)
    monkeypatch.setenv("EXPRESS50_HEADS", os.pathsep.join(["", str(tmp_path), str(here)]))
    assert load_head(named).name == load_head(str(here / "flame.pkl")).name
    assert capsys.readouterr().err.count(f"{named} is not there, using {here / 'flame.pkl'}") == 1
    assert load_topology(named).faces.size
    inputs = track_inputs(dataset, "S001")
    assert inputs.keys() == KINDS | {"track"} and inputs["head"] == here / "flame.pkl"


def test_a_scan_is_registered_again_if_flames_masks_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flame, scan, seen = write_flame(tmp_path), tmp_path / "scan.obj", []
    scan.touch()
    monkeypatch.setattr("pipelines.register.scan_files.value_digest", seen.append)
    monkeypatch.setattr("pipelines.register.scan_files.read_scan", lambda _: 1 / 0)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            register_scan(scan, str(flame), tmp_path / "out")
        with (tmp_path / "FLAME_masks.pkl").open("ab") as file:
            file.write(os.urandom(1))
    assert seen[0] != seen[1]
