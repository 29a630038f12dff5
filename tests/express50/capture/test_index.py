"""The frame index: round trip, checks, and errors that say which command to run."""

import json
import shutil
from pathlib import Path

import pytest

from express50.capture.index import Cue, index_from_json, index_to_json, read_index
from express50.contract.layout import Dataset
from express50.errors import FormatError, StageError


def test_index_describes_the_capture(ingested, capture):
    index = read_index(ingested, "S001")
    assert (index.subject, index.fps, index.capture) == ("S001", 24.0, capture)
    assert list(index.cameras) == ["cam00", "cam01", "cam02"]
    camera = index.cameras["cam01"]
    assert (camera.kind, camera.source) == ("frames", "cameras/cam01/frames")
    assert (camera.width, camera.height, camera.frames) == (64, 64, 6)
    assert camera.pts == tuple(range(6))
    assert len(set(camera.dhash)) > 1
    assert index.cues == (Cue("neutral", 0, 2), Cue("smile", 3, 5))
    assert index.plates["cam02"] == "plates/cam02.png"
    assert index.calibration == "calibration.json"
    assert index.frames == 6


def test_index_round_trip_and_no_machine_path(ingested, capture):
    index = read_index(ingested, "S001")
    content = json.loads(json.dumps(index_to_json(index)))
    assert index_from_json(content, capture) == index
    assert str(capture) not in ingested.index_file("S001").read_text()


def test_index_is_read_again_when_the_file_changes(ingested):
    path = ingested.index_file("S001")
    assert read_index(ingested, "S001") is read_index(ingested, "S001")
    path.write_text(path.read_text().replace('"fps": 24.0', '"fps": 25.0'))
    assert read_index(ingested, "S001").fps == 25.0


def test_footage_that_was_moved_is_found_in_the_same_process(ingested, capture, tmp_path):
    assert read_index(ingested, "S001").capture == capture
    moved = Path(shutil.copytree(capture, tmp_path / "moved"))
    ingested.captures_file.write_text(json.dumps({"S001": str(moved)}))
    assert read_index(ingested, "S001").capture == moved


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(schema="express50.index/9"), "schema is 'express50.index/9'"),
        (lambda c: c["cameras"]["cam00"].update(pts="1 2"), "camera cam00: .* for 6 frames"),
        (lambda c: c.pop("cues"), "has no 'cues'"),
        (lambda c: c["cameras"]["cam00"].update(colour=1), "colour"),
    ],
)
def test_malformed_index_is_a_format_error(ingested, change, message):
    path = ingested.index_file("S001")
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=message):
        read_index(ingested, "S001")


def test_unknown_subject_names_the_known_and_the_command(ingested, tmp_path):
    with pytest.raises(StageError, match="'S009' is not ingested .subjects: S001.; run 'express50"):
        read_index(ingested, "S009")
    with pytest.raises(StageError, match="subjects: none"):
        read_index(Dataset(tmp_path / "absent"), "S001")
