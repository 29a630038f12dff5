"""One command over captures with every kind of damage: each is named, the good ones get done."""

import json

import pytest

from express50.__main__ import main
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from tests.synth import make_capture


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    root = tmp_path_factory.mktemp("raw")
    for name in ("good", "truncated", "missing", "calibration", "empty"):
        make_capture(root / name, subject=name, frames=8, video=True)
    video = root / "truncated/cameras/cam01/video.mp4"
    video.write_bytes(video.read_bytes()[:-100])
    (root / "missing/cameras/cam02/video.mp4").unlink()
    (root / "missing/cameras/cam02").rmdir()
    path = root / "calibration/calibration.json"
    table = json.loads(path.read_text())
    table["cam00"]["world_to_camera"] = table["cam00"]["world_to_camera"][:3]
    path.write_text(json.dumps(table))
    for video in root.glob("empty/cameras/*/video.mp4"):
        video.write_bytes(b"")
    return root


def test_every_fault_is_named_and_the_rest_is_done(tmp_path, captures, capsys):
    data = tmp_path / "data"
    folders = [str(path) for path in sorted(captures.iterdir())]
    assert main(["ingest", str(data), *folders, "--workers", "2", "--json"]) == 1
    account = json.loads(capsys.readouterr().out)
    assert (account["read"], account["done"], account["failed"]) == (5, 3, 2)
    rows = {row["item"]: row for row in account["items"]}
    assert "expected (4, 4)" in rows["calibration"]["reason"]
    assert "no usable camera" in rows["empty"]["reason"]
    assert rows["good"]["dropped"] == []
    assert "truncated" in rows["truncated"]["dropped"][0]["why"]
    assert "calibrated, but" in rows["missing"]["dropped"][0]["why"]
    dataset = Dataset(data)
    assert dataset.subjects() == ["good", "missing", "truncated"]
    assert list(read_index(dataset, "truncated").cameras) == ["cam00", "cam02"]


def test_fixed_captures_complete_the_dataset(tmp_path, capsys):
    make_capture(tmp_path / "S001")
    cues = tmp_path / "S001/cues.csv"
    good = cues.read_text()
    cues.write_text("expression_id\n")
    command = ["ingest", str(tmp_path / "data"), str(tmp_path / "S001")]
    assert main(command) == 1
    cues.write_text(good)
    assert main(command) == 0
    assert main(["status", str(tmp_path / "data")]) == 0
    assert "failed S001: CaptureError" in capsys.readouterr().out


def test_unknown_key_stops_before_anything_is_written(tmp_path, captures, capsys):
    data = tmp_path / "data"
    assert main(["ingest", str(data), str(captures / "good"), "--set", "ingest.proxi=1"]) == 2
    assert "unknown key ingest.proxi (did you mean 'proxy_" in capsys.readouterr().err
    assert not data.exists()
