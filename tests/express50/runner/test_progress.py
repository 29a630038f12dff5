"""The bar that a stage shows in a terminal."""

import io
import re
import sys
from types import SimpleNamespace

from express50.runner.progress import showing


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
