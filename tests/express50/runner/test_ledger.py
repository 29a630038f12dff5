"""The ledger: receipts come back as written; digests follow the content."""

import os
import sqlite3
from unittest.mock import Mock

import pytest

from express50.errors import DiskFullError, FormatError, StageError
from express50.files.digests import file_sha256, path_digest, stat_digest
from express50.runner.ledger import Ledger, Receipt


@pytest.fixture
def ledger(tmp_path):
    with Ledger(tmp_path / "ledger.sqlite") as opened:
        yield opened


def receipt(item="S001", **values):
    return Receipt(
        **{"stage": "track", "item": item, "fingerprint": "f", "status": "done"} | values
    )


def test_receipts_come_back_as_written(ledger):
    written = receipt(metrics={"a": [1, 2.5], "b": "ü"}, seconds=1.5, peak_memory=7, attempts=2)
    ledger.write(written)
    ledger.write(receipt("S000", status="failed", reason="dark"))
    ledger.write(Receipt(stage="depth", item="S001", fingerprint="g", status="done"))
    assert list(ledger.read("track")) == ["S000", "S001"]
    assert ledger.read("track")["S001"] == written


def test_newer_receipt_takes_the_place_of_the_older(ledger):
    ledger.write(receipt(fingerprint="1"))
    ledger.write(receipt(fingerprint="2"))
    assert [r.fingerprint for r in ledger.read("track").values()] == ["2"]
    ledger.forget("track", ["S001"])
    assert ledger.read("track") == {}


def test_two_processes_may_write(tmp_path):
    with Ledger(tmp_path / "l.sqlite") as one, Ledger(tmp_path / "l.sqlite") as two:
        one.write(receipt("a"))
        two.write(receipt("b"))
        assert set(one.read("track")) == {"a", "b"}


def test_digest_is_cached_until_size_time_or_inode_changes(ledger, tmp_path, monkeypatch):
    path = tmp_path / "x"
    path.write_bytes(b"one")
    first = ledger.sha256(path)
    assert first == file_sha256(path)
    ledger.keep_digests()
    monkeypatch.setattr(
        "express50.runner.ledger.file_sha256", lambda path: pytest.fail("read again")
    )
    assert ledger.sha256(path) == first
    monkeypatch.undo()
    path.write_bytes(b"two")
    os.utime(path, ns=(1, 1))
    assert ledger.sha256(path) == file_sha256(path) != first


def test_the_umask_decides_who_else_may_write(tmp_path):
    before = os.umask(0o002)  # as in datasets that a group shares
    try:
        with Ledger(tmp_path / "ledger.sqlite") as ledger:
            ledger.forget("toy", [])
            modes = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    finally:
        os.umask(before)
    assert modes == {0o664}


def test_a_ledger_of_somebody_else_is_named_as_one(ledger):
    ledger._database.execute("PRAGMA query_only=ON")  # what SQLite says of a file of mode 644, too
    with pytest.raises(FormatError, match="not writable; check its owner and permissions"):
        ledger.forget("toy", ["a"])


def test_a_file_that_is_not_a_ledger_is_an_error(tmp_path):
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(b"x" * 5000)
    with pytest.raises(FormatError, match="not a ledger"):
        Ledger(path)


def test_folder_digest_sees_names_and_contents_but_not_hidden_files(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/x").write_text("1")
    first = path_digest(tmp_path)
    (tmp_path / ".hidden").write_text("2")
    assert path_digest(tmp_path) == first
    (tmp_path / "a/x").rename(tmp_path / "a/y")
    renamed = path_digest(tmp_path)
    (tmp_path / "a/y").write_text("2")
    assert len({first, renamed, path_digest(tmp_path)}) == 3


@pytest.mark.parametrize("linked", [False, True])
def test_stat_digest_follows_size_and_time(tmp_path, linked):
    """A camera's folder may be a link to another disk, and links may form a circle."""
    capture, folder = tmp_path / "capture", tmp_path / "disk" if linked else tmp_path / "capture"
    capture.mkdir()
    folder.mkdir(exist_ok=True)
    (folder / "x").write_text("1")
    os.utime(folder / "x", ns=(5, 5))
    if linked:
        (capture / "cam00").symlink_to(folder)
        (folder / "again").symlink_to(folder)
    first = stat_digest(capture)
    assert stat_digest(capture) == first
    os.utime(folder / "x", ns=(5, 6))
    assert stat_digest(capture) != first


def test_missing_input_names_the_remedy(tmp_path):
    with pytest.raises(StageError, match="run the stage that writes it first"):
        path_digest(tmp_path / "absent")


def test_receipts_are_gone_for_good_before_their_outputs_change(ledger):
    """A kill cannot show it, only a power cut: the disk is waited for, and only there."""
    said = []
    ledger._database.set_trace_callback(said.append)
    ledger.forget("track", ["S001"])
    ledger.write(receipt())
    words = [text.split(";")[0] for text in said]
    full, normal = words.index("PRAGMA synchronous=FULL"), words.index("PRAGMA synchronous=NORMAL")
    gone = [k for k, text in enumerate(words[:normal]) if text.startswith("DELETE")]
    assert full < gone[0] < gone[-1] < words.index("COMMIT") < normal
    assert [words[k].split()[2] for k in gone] == ["receipts", "made", "settings"]


def test_a_full_disk_is_named_as_one(ledger):
    pages = ledger._database.execute("PRAGMA page_count").fetchone()[0]
    ledger._database.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(DiskFullError, match="ledger.sqlite: the disk is full .database or disk"):
        ledger.write(receipt(metrics={"long": "x" * 100_000}))


def test_a_disk_error_is_a_full_disk_if_nothing_is_free(ledger, monkeypatch):
    """SQLite says so when its memory map cannot grow."""
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR_SHMSIZE
    monkeypatch.setattr(ledger, "_replace", Mock(side_effect=error))
    for free, kind in ((0, DiskFullError), (10**9, FormatError)):
        usage = Mock(total=10**12, free=free)
        monkeypatch.setattr("shutil.disk_usage", lambda path, usage=usage: usage)
        with pytest.raises(kind, match="disk I/O error"):
            ledger.write(receipt())
