"""Text from outside: bounds, and what errors name; bombs of every format are in tests/fuzz."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from express50.errors import CaptureError, Express50Error, FormatError
from express50.files.arrays import read_arrays, read_npy, read_object_array, read_pickle
from express50.files.containers import open_hdf5, open_zip
from express50.files.digests import file_sha256
from express50.files.images import foreign_profile, read_image
from express50.files.text import (
    is_given,
    parse_json,
    read_json,
    read_json_table,
    read_text,
    read_toml,
)
from express50.files.video import check_whole, video_fps
from express50.head.ict import read_obj
from express50.head.load import load_head


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1,\n"b": NaN}', "line 2 holds NaN, which is NaN or infinite"),
        ('{"a": 1,\n\n"b": -1e999}', "line 3 holds -1e999, which"),
        ('{"a": 1, "a": 2}', "the key 'a' appears twice"),
        ("[" * 100_000, "nested too deeply"),
        ("9" * 5000, "not JSON"),
        ("", "not JSON"),
    ],
)
def test_what_json_may_not_hold_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        read_json(tmp_path / "a.json", FormatError, "fix it so")
    assert str(caught.value).startswith(f"{tmp_path / 'a.json'}: ")
    assert str(caught.value).endswith("; fix it so")


def test_plain_json_is_what_json_says() -> None:
    value = {"a": [1, -2.5, 1e300, None, True, "x\u0000"], "b": {"a": {}}, "": []}
    assert parse_json(json.dumps(value), "here", FormatError) == value
    assert parse_json(json.dumps(value).encode(), "here", FormatError) == value


def test_a_table_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(CaptureError, match="expected a JSON table, got list"):
        read_json_table(tmp_path / "a.json", CaptureError)


def test_numbers_of_toml_are_finite(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("a.b = [" + "0.5, " * 300 + "]\nc = '" + "a." * 300 + "'\n")
    assert len(read_toml(file, CaptureError)["a"]["b"]) == 300
    file.write_text("\nx = inf")
    with pytest.raises(CaptureError, match="line 2"):
        read_toml(file, CaptureError)


@pytest.mark.parametrize(
    "read",
    [
        is_given,
        lambda path: read_text(path, FormatError),
        lambda path: read_arrays(path, FormatError, "arrays"),
        lambda path: read_npy(path, FormatError, "an array"),
        read_pickle,
        read_object_array,
        read_image,
        foreign_profile,
        open_zip,
        open_hdf5,
        check_whole,
        video_fps,
        read_obj,
        file_sha256,
        lambda path: load_head(path.rename(path.with_suffix(".npz"))),
    ],
)
def test_a_pipe_is_refused_without_being_waited_for(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    os.mkfifo(tmp_path / "pipe")

    def give_up(*_: object) -> None:
        raise TimeoutError("waits for the pipe")

    former = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(60)
    try:
        with pytest.raises((Express50Error, OSError), match="is a pipe or device, not a file"):
            read(tmp_path / "pipe")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def test_size_and_kind_of_a_file_are_looked_at(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_bytes(b"\xef\xbb\xbfa\r\nb\rc")
    assert read_text(file, FormatError) == "a\nb\nc"
    with pytest.raises(FormatError, match="9 bytes, expected at most 8"):
        read_text(file, FormatError, limit=8)
    with pytest.raises(FormatError, match="is a folder, not a file"):
        read_text(tmp_path, FormatError)
    with pytest.raises(FormatError, match="No such file"):
        read_text(tmp_path / "b", FormatError)


def test_an_error_is_one_line_without_control_characters_and_keeps_its_ends() -> None:
    assert str(FormatError("a\nb\r\n\x1b[2Jc\x07")) == "a b  [2Jc"
    long = str(FormatError("where " + "x" * 100_000 + " fix it"))
    assert len(long) < 1300 and long.startswith("where x") and long.endswith("x fix it")
