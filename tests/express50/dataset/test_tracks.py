"""Tracks are read whole and checked; nothing in a hostile file is executed or taken on trust."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

import express50.files.arrays as array_files
from express50.contract.layout import Dataset
from express50.dataset.tracks import existing_track, read_sequence, read_track
from express50.errors import FormatError, StageError
from tests.express50.dataset.tracked import track_arrays, write_track


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    return track_arrays("procedural")


def test_reads_back_what_was_written(arrays, tmp_path) -> None:
    track = read_track(write_track(tmp_path / "track.npz", arrays))
    assert track.head == "procedural" and track.expressions == ("neutral", "smile")
    for name in ("shape", "expression", "neck", "jaw", "eyes", "R", "t", "vertices", "offsets"):
        np.testing.assert_array_equal(getattr(track, name), arrays[name])
    assert track.vertices.dtype == track.offsets.dtype == np.float32
    assert track.row("smile") == 1
    with pytest.raises(StageError, match="wink: it is not tracked"):
        track.row("wink")
    assert track.glasses_in("smile") is None


def test_reads_each_expressions_glasses(arrays, tmp_path) -> None:
    places = np.arange(9, dtype=np.float32).reshape(3, 3)
    worn = {"glasses": places, "glasses_row": np.array([1, 0, 1])}
    track = read_track(write_track(tmp_path / "track.npz", arrays | worn))
    np.testing.assert_array_equal(track.glasses_in("smile"), places[[0, 2]])
    np.testing.assert_array_equal(track.glasses_in("neutral"), places[[1]])
    none = {"glasses": places[:0], "glasses_row": np.zeros(0, int)}
    track = read_track(write_track(tmp_path / "bare.npz", arrays | none))
    assert track.glasses_in("smile").shape == (0, 3)


def bad(arrays: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """A message each, and the arrays that must cause it."""

    def poisoned(name: str, value: float) -> dict[str, np.ndarray]:
        array = arrays[name].copy()
        array.flat[-1] = value
        return {name: array}

    return {
        "schema 'express50.track/9'": {"schema": np.array("express50.track/9")},
        "vertices has 1 values that are not finite": poisoned("vertices", np.nan),
        "offsets has 1 values that are not finite": poisoned("offsets", np.inf),
        "t has 1 values that are not finite": poisoned("t", -np.inf),
        "offsets has shape .*expected": {"offsets": arrays["offsets"][:-1]},
        r"neck has shape \(1, 3\), expected \(2, 3\)": {"neck": arrays["neck"][:1]},
        r"eyes has shape \(2, 3\), expected \(2, 6\)": {"eyes": arrays["neck"]},
        "vertices has shape": {"vertices": arrays["vertices"][0]},
        "shape is <U1": {"shape": np.array(["a"])},
        "frames is float64": {"frames": np.zeros(2)},
        "appears twice": {"expressions": np.array(["smile", "smile"])},
        "expected letters, digits": {"expressions": np.array(["smile", "../../smile"])},
        "expressions are int64": {"expressions": np.arange(2)},
        "R is not a rotation": {"R": 2 * arrays["R"]},
        "differs from identity by": {"R": -arrays["R"]},
        "glasses has shape": {"glasses": np.zeros((2, 3)), "glasses_row": np.zeros(3, int)},
        "glasses has 3 values": {
            "glasses": np.full((1, 3), np.nan),
            "glasses_row": np.zeros(1, int),
        },
        "glasses_row must name one of 2": {
            "glasses": np.zeros((1, 3)),
            "glasses_row": np.array([2]),
        },
        "has no 'glasses_row'": {"glasses": np.zeros((1, 3))},
        "Python objects": {"head": np.array({"a": print}, dtype=object)},
    }


MESSAGES = sorted(bad({k: np.zeros((2, 2, 3)) for k in
                       ("vertices", "offsets", "t", "neck", "R")}))  # fmt: skip


@pytest.mark.parametrize("message", MESSAGES)
def test_what_does_not_fit_is_named_in_one_line(arrays, tmp_path, message) -> None:
    path = write_track(tmp_path / "track.npz", arrays | bad(arrays)[message])
    with pytest.raises(FormatError, match=message) as caught:
        read_track(path)
    assert "\n" not in str(caught.value) and "track' again" in str(caught.value)


@pytest.mark.parametrize("name", ["schema", "head", "expressions", "R", "vertices", "offsets"])
def test_a_missing_array_is_named(arrays, tmp_path, name) -> None:
    path = write_track(tmp_path / "track.npz", {k: v for k, v in arrays.items() if k != name})
    with pytest.raises(FormatError, match=f"has no '{name}'"):
        read_track(path)


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, 0.99])
def test_truncated_files_are_refused(arrays, tmp_path, kept) -> None:
    path = write_track(tmp_path / "track.npz", arrays)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data)) if isinstance(kept, float) else kept])
    with pytest.raises(FormatError, match="not a track"):
        read_track(path)


def _archive(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_foreign_and_hostile_files_are_refused(arrays, tmp_path, monkeypatch) -> None:
    path = tmp_path / "track.npz"
    with path.open("wb") as file:  # np.save would add an ending to a path
        np.save(file, np.zeros(3))
    with pytest.raises(FormatError, match="not a track"):
        read_track(path)
    _archive(path, {"schema.npy": b"text", "notes.txt": b"hello"})
    with pytest.raises(FormatError, match="not a track"):
        read_track(path)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776, 64), }"
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    claim = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    _archive(path, {"vertices.npy": claim})
    with pytest.raises(FormatError, match="not a track"):
        read_track(path)
    monkeypatch.setattr(array_files, "SIZE_LIMIT", 1 << 20)
    _archive(path, {"vertices.npy": bytes(1 << 21)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(FormatError, match="bytes unpacked, expected at most"):
        read_track(path)


def test_an_absent_track_says_what_to_run(tmp_path) -> None:
    with pytest.raises(StageError, match="run 'express50 track'"):
        read_track(tmp_path / "track.npz")
    with pytest.raises(StageError, match="subject 'S001' is not tracked; run 'express50 track /"):
        existing_track(Dataset(tmp_path), "S001")


def test_a_folder_is_not_reported_as_missing(tmp_path) -> None:
    with pytest.raises(StageError, match="is a folder, expected the file of a sequence in it"):
        read_sequence(tmp_path)
