"""Small questions over the desk: why a flag, which frame, and the help."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from annotations.labels import FLAG_REASONS
from annotations.ui import theme
from annotations.ui.theme import GROUPS

SCROLLING = ("up", "down", "pageup", "pagedown", "home", "end")


class FlagDialog(ModalScreen[str | None]):
    """Asks for the reason of a flag: a digit decides at once, ``5`` opens a line of text."""

    AUTO_FOCUS = ""  # digits must reach the dialog, not the line of text

    def compose(self) -> ComposeResult:
        """List the reasons, and a line for another."""
        with Vertical(classes="dialog") as box:
            box.border_title = "flag: why is there no usable peak?"
            box.border_subtitle = "press a number; Esc: do not flag"
            for number, reason in enumerate(FLAG_REASONS, 1):
                yield Static(_choice(str(number), reason))
            yield Static(_choice(str(len(FLAG_REASONS) + 1), "another reason, in words"))
            words = Input(placeholder="reason, then Enter", max_length=200)
            words.display = False
            yield words

    def on_key(self, event: events.Key) -> None:
        """Choose by digit; leave by Escape."""
        words = self.query_one(Input)
        if event.key == "escape":
            self.dismiss(None)
        elif not words.display and event.key.isdigit():
            number = int(event.key)
            if 1 <= number <= len(FLAG_REASONS):
                self.dismiss(FLAG_REASONS[number - 1])
            elif number == len(FLAG_REASONS) + 1:
                words.display = True
                words.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take a reason in words; an empty one is refused."""
        if event.value.strip():
            self.dismiss(event.value.strip())


class FrameDialog(ModalScreen[int | None]):
    """A frame by its number."""

    def __init__(self, first: int, last: int) -> None:
        super().__init__()
        self._first, self._last = first, last

    def compose(self) -> ComposeResult:
        """Lay out one line for digits."""
        with Vertical(classes="dialog") as box:
            box.border_title = f"go to frame ({self._first} to {self._last})"
            box.border_subtitle = "Esc: stay"
            yield Input(type="integer", max_length=9)

    def on_key(self, event: events.Key) -> None:
        """Leave by Escape."""
        if event.key == "escape":
            self.dismiss(None)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Go to the number; without one stay, and outside the window ask again."""
        number = int(event.value) if event.value.strip("-+").isdigit() else None
        if number is None or self._first <= number <= self._last:
            self.dismiss(number)
        else:
            event.input.clear()


class HelpDialog(ModalScreen[None]):
    """Every key; arrows scroll where the terminal is low, any other key leaves."""

    def compose(self) -> ComposeResult:
        """Key tables, side by side where there is room."""
        with VerticalScroll(classes="dialog help") as box:
            box.border_title = "keys"
            box.border_subtitle = "↑ ↓ more, any other key: back"
            yield Static(help_table(wide=self.app.size.width >= 110))

    def on_key(self, event: events.Key) -> None:
        """Scroll, or leave."""
        if event.key not in SCROLLING:
            event.stop()
            self.dismiss(None)


def help_table(wide: bool) -> Table:
    """Lay all keys out in one column or in two, and explain the signs on the strip."""
    signs = Text.assemble(
        ("1", theme.BEST), (" surest suggestion  ", theme.FAINT),
        ("2", theme.CANDIDATE), (" the next ones", theme.FAINT), "\n",
        ("●", theme.BLUE), (" your mark  ", theme.FAINT),
        ("○", theme.TEXT), (" mark in force  ", theme.FAINT),
        ("[━]", theme.BLUE), (" plateau", theme.FAINT),
    )  # fmt: skip
    groups = []
    for keys in GROUPS.values():
        table = Table.grid(padding=(0, 1))
        table.add_column(width=9, style=f"bold {theme.ACCENT}")
        table.add_column(style=theme.TEXT)
        for key in keys:
            table.add_row(key.shown, key.words)
        groups.append(table)
    outer = Table.grid(padding=(0, 3))
    if wide:
        right = Table.grid()
        for part in (groups[2], Text(), signs):
            right.add_row(part)
        left = Table.grid()
        for part in (groups[0], Text(), groups[1]):
            left.add_row(part)
        outer.add_row(left, right)
        return outer
    for part in (*groups, signs):
        outer.add_row(part)
    return outer


def _choice(key: str, words: str) -> Text:
    return Text.assemble((f" {key} ", f"bold {theme.ACCENT}"), (f" {words}", theme.TEXT))
