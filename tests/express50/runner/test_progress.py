"""The bar that a stage shows in a terminal."""

import io
import re
import sys
import threading
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from express50.errors import DiskFullError
from express50.runner.ledger import Ledger
from express50.runner.progress import RunLog, showing


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_the_bar_shows_elapsed_time_before_the_first_item_is_done(monkeypatch):
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "100")
    done = SimpleNamespace(stage="track", item="S001", status="done", attempts=1, seconds=3.0,
                           reason="")  # fmt: skip
    with showing("track", 2, enabled=True) as show:
        shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue())
        assert "0/2 0:00:00 elapsed, -:--:-- left" in shown
        show(done)
    assert "1/2" in terminal.getvalue()


@pytest.mark.parametrize("method", ["__init__", "write_run"])
def test_a_full_disk_does_not_end_the_log_of_runs_with_a_traceback(tmp_path, monkeypatch, method):
    def full(*arguments):
        raise DiskFullError("ledger.sqlite: the disk is full")

    ends = Mock()
    monkeypatch.setattr(threading, "excepthook", ends)
    monkeypatch.setattr(Ledger, method, full)
    with RunLog(tmp_path / "ledger.sqlite", "toy", 1):
        pass
    ends.assert_not_called()
