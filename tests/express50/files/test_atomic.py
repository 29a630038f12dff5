"""Places to write to are tried before any work; errors of the disk name what the user gave."""

import errno
import fcntl
import os
import tempfile

import pytest

from express50.console import system_error_line
from express50.errors import ConfigError, DiskFullError, NotReadyError
from express50.files.atomic import (
    alone_in,
    check_folder_writable,
    folder_in_one_step,
    write_bytes,
    write_with,
)


def refuse(number):
    def refused(*args, **kwargs):
        raise OSError(number, os.strerror(number), "/a/temporary/name")

    return refused


def test_what_can_be_written_is_left_as_it_was(tmp_path):
    (tmp_path / "page.html").write_text("old")
    check_folder_writable(tmp_path / "new" / "deep")
    check_folder_writable(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_what_cannot_be_written_is_named_as_it_was_given(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="file: is a file, expected a folder to write to"):
        check_folder_writable(tmp_path / "file" / "deep")
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse(errno.EROFS))
    with pytest.raises(OSError) as caught:  # noqa: PT011  (its line is compared)
        check_folder_writable(tmp_path / "out")
    assert system_error_line(caught.value).startswith(f"{tmp_path / 'out'}: not writable (Read-")


def test_a_read_only_disk_is_named_by_the_file_that_was_given(tmp_path, monkeypatch):
    """Even to delete a file that does not exist fails there, and hid the first error."""

    def read_only(path, *args, **kwargs):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr("pathlib.Path.open", read_only)
    monkeypatch.setattr("pathlib.Path.unlink", read_only)
    with pytest.raises(OSError) as caught:  # noqa: PT011
        write_bytes(tmp_path / "page.html", b"x")
    assert caught.value.filename == str(tmp_path / "page.html")


def test_a_limit_on_the_size_of_files_is_named_even_behind_an_error_of_torch(tmp_path):
    def write(file):
        try:
            refuse(errno.EFBIG)()
        finally:
            raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos")

    with pytest.raises(OSError) as caught:  # noqa: PT011
        write_with(tmp_path / "checkpoint.pt", write)
    line = system_error_line(caught.value)
    assert line.startswith(f"OSError: {tmp_path / 'checkpoint.pt'}: File too large; its disk or")


def test_a_disk_that_fills_up_under_a_folder_is_named(tmp_path):
    out = tmp_path / "out"
    folder = folder_in_one_step(tmp_path / ".out.part", out)
    with pytest.raises(DiskFullError, match="out: the disk is full"), folder:
        refuse(errno.ENOSPC)()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_by_the_place_that_a_folder_is_for(tmp_path):
    out, aside = tmp_path / "out", tmp_path / ".out.part"
    with pytest.raises(DiskFullError) as caught, folder_in_one_step(aside, out):
        write_with(aside / "a.json", refuse(errno.ENOSPC))
    assert str(caught.value).startswith(f"{out / 'a.json'}: the disk is full (No space left on ")
    assert ".out.part" not in str(caught.value)


def test_a_folder_is_held_by_one_command_and_left_as_it_was(tmp_path):
    with alone_in(tmp_path / "out"):
        other = alone_in(tmp_path / "out")
        with pytest.raises(NotReadyError, match="another process writes into this folder"), other:
            pass
        assert (tmp_path / "out").is_dir()
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    for name in (".checkpoint.pt.0123456789abcdef0123456789abcdef", ".checkpoint.pt.spare", "a"):
        (tmp_path / "out" / name).touch()
    with alone_in(tmp_path / "out"):
        pass
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".checkpoint.pt.spare", "a"}


def test_a_file_system_without_locks_holds_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", refuse(errno.ENOSYS))
    with alone_in(tmp_path), alone_in(tmp_path):
        (tmp_path / "a").touch()
