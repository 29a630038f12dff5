"""Write the screen's text: lines around the pictures, and the dialogs in front of them."""

from __future__ import annotations

from functools import lru_cache

from rich.cells import cell_len
from rich.console import Group
from rich.table import Table
from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from annotations.labels import FLAG_REASONS, Label, overruling
from annotations.ui import theme
from annotations.ui.panes import FrameLook
from annotations.ui.session import Session
from annotations.ui.task import CueView, TaskScene
from annotations.ui.theme import GROUPS, HINTS
from annotations.validate import describe, in_spite_of

LEAST_CELLS = 6  # fewer say nothing
WIDE = 80  # columns


def fit(left: Text, right: Text, width: int) -> Text:
    """Set two texts at the ends of a line, in the left one; what does not fit is cut."""
    left.truncate(width, overflow="ellipsis")
    room = width - left.cell_len - 1
    right = Text() if room < LEAST_CELLS else right
    right.truncate(room, overflow="ellipsis")
    left.append(" " * max(0, width - left.cell_len - right.cell_len))
    left.append_text(right)
    left.truncate(width)
    return left


def status_line(session: Session, scene: TaskScene, width: int) -> Text:
    """Show expression and subject; progress and the label's cost so far."""
    left = Text.assemble(
        (f" {scene.name} ", f"bold {theme.GROUND} on {theme.ACCENT}"),
        (f"  {scene.task.subject}", f"bold {theme.TEXT}"),
    )
    if scene.is_reference:
        left.append("  the reference", theme.VIOLET)
    if session.blind:
        left.append("  blind", theme.RED)
    spent = session.effort()
    right = Text(style=theme.FAINT)
    right.append(f"{session.done}/{len(session.tasks)}", f"bold {theme.TEXT}")
    right.append(f" done  {spent.seconds:.0f} s  {spent.keys} key{'' if spent.keys == 1 else 's'} ")
    return fit(left, right, width)


def frame_title(scene: TaskScene, view: CueView | None, look: FrameLook | None, width: int) -> Text:
    """Write the title of the left picture: position, and tags of this very frame."""
    if look is None or view is None:
        return Text(f" {scene.task.subject}", style=theme.FAINT)
    tags = Text()
    if scene.suggestion is not None and view.cursor == scene.suggestion.frame in view.candidates:
        sure = scene.suggestion.confidence
        colour = theme.GREEN if sure > 0.8 else theme.ACCENT if sure > 0.5 else theme.RED
        tags.append(f"  suggested, {sure:.0%} sure", colour)
    elif view.cursor in view.candidates:
        tags.append(f"  suggestion {view.candidates.index(view.cursor) + 1}", theme.GREEN)
    if scene.mine is not None and scene.mine.action == "flag":
        tags.append(f"  ⚑ {scene.mine.reason}", theme.RED)
    elif scene.mine is not None and scene.mine.frame == view.cursor:
        tags.append("  ● your mark", theme.BLUE)
    left = Text.assemble((f" frame {view.cursor}", f"bold {theme.TEXT}"))
    place = f"  {view.cursor - view.first + 1} of {view.last - view.first + 1}"
    right = Text(f"{look.camera} {look.zoom} ", style=theme.FAINT)
    if left.cell_len + len(place) + tags.cell_len + right.cell_len < width:
        left.append(place, theme.FAINT)
    return fit(left.append_text(tags), right, width)


def second_title(look: FrameLook | None, width: int) -> Text:
    """Write the title of the middle picture: the second camera's id."""
    if look is None:
        return Text(" second camera", style=theme.FAINT)
    left = Text.assemble((f" {look.camera}", f"bold {theme.TEXT}"))
    return fit(left, Text("the same moment ", style=theme.FAINT), width)


def reference_title(scene: TaskScene, look: FrameLook | None, width: int) -> Text:
    """Write the title of the right picture."""
    if scene.reference is None or look is None:
        return Text(" reference", style=theme.FAINT)
    left = Text.assemble(
        (" reference ", f"bold {theme.VIOLET}"),
        (scene.reference.subject, theme.TEXT),
        (f"  frame {scene.reference.frame}", theme.FAINT),
    )
    by = f"  by {scene.reference.by}"
    if left.cell_len + len(by) + len(look.camera) + 2 <= width:
        left.append(by, theme.FAINT)
    return fit(left, Text(f"{look.camera} ", style=theme.FAINT), width)


@lru_cache(maxsize=8)
def hint_line(width: int, matches: bool) -> Text:
    """List as many keys as fit, the most used first; help and quit, the last, always do.

    In wide terminals the first says what to look for: a frame that matches the reference's.
    """
    goal = "match the reference" if matches else "find the clearest"
    text = Text(" ")
    room = width - cell_len("? help  q quit")
    for keys, words in HINTS:
        if width >= WIDE and keys == HINTS[0][0]:
            words = goal
        piece = cell_len(keys) + cell_len(words) + 3
        if keys in ("?", "q") or text.cell_len + piece <= room:
            text.append(keys, f"bold {theme.ACCENT}")
            text.append(f" {words}  ", theme.FAINT)
    text.truncate(width)
    return text


def saved(label: Label, in_force: Label | None) -> str:
    """Report that a decision is on disk, and whether a settlement outranks it."""
    what = f"frame {label.frame}" if label.action == "mark" else f"flagged {label.reason}"
    cost = f"{label.keys} key{'' if label.keys == 1 else 's'}, {label.seconds:.1f} s"
    said = f"saved: {label.subject} {label.expression} {what} ({cost}); u undoes it"
    settled = overruling([] if in_force is None else [in_force], label)
    return said if settled is None else f"{said}; {in_spite_of(settled)}"


def undone(label: Label) -> str:
    """Report what was taken back."""
    kind = "settlement, " if label.action == "settle" else ""
    return f"undone: {label.subject} {label.expression} {kind}{describe(label)}"


SCROLLING = ("up", "down", "pageup", "pagedown", "home", "end")


def take_early(line: Input, event: events.Key) -> None:
    """Write what was typed before the line had the focus: later, the line keeps it to itself."""
    if line.display and event.character is not None and event.is_printable:
        line.insert_text_at_cursor(event.character)


# Otherwise a line of text takes them: to copy, and for nothing.
LEAVE = [
    Binding("ctrl+c", "app.quit", show=False, priority=True),
    Binding("ctrl+z", "app.suspend_process", show=False, priority=True),
]


class FlagDialog(ModalScreen[str | None]):
    """Asks for the reason of a flag: a digit decides at once, ``5`` opens a line of text."""

    AUTO_FOCUS = ""  # digits must reach the dialog, not the line of text
    BINDINGS = [*LEAVE, Binding("escape", "dismiss", show=False)]

    def compose(self) -> ComposeResult:
        """List the reasons, and a line for another."""
        with Vertical(classes="dialog") as box:
            box.border_title = "flag: why is there no usable peak?"
            box.border_subtitle = "press a number, or Esc to cancel"
            for number, reason in enumerate((*FLAG_REASONS, "another, in your own words"), 1):
                key = (f" {number} ", f"bold {theme.ACCENT}")
                yield Static(Text.assemble(key, (f" {reason}", theme.TEXT)))
            line = Input(placeholder="reason, then Enter", max_length=200)
            line.display = False
            yield line

    def on_key(self, event: events.Key) -> None:
        """Choose by digit."""
        line = self.query_one(Input)
        take_early(line, event)
        number = int(event.key) if event.key.isdigit() and not line.display else 0
        if 1 <= number <= len(FLAG_REASONS):
            self.dismiss(FLAG_REASONS[number - 1])
        elif number == len(FLAG_REASONS) + 1:
            line.display = True
            line.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take a reason in words; an empty one is refused."""
        if event.value.strip():
            self.dismiss(event.value.strip())


class FrameDialog(ModalScreen[int | None]):
    """Asks for a frame by its number."""

    BINDINGS = [*LEAVE, Binding("escape", "dismiss", show=False)]

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
        """Take the first digits."""
        take_early(self.query_one(Input), event)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Go to the number; without one stay, and outside the window ask again."""
        number = int(event.value) if event.value.strip("-+").isdigit() else None
        if number is None or self._first <= number <= self._last:
            self.dismiss(number)
        else:
            event.input.clear()
            event.input.placeholder = f"{number} is outside {self._first} to {self._last}"


class HelpDialog(ModalScreen[None]):
    """Shows every key; arrows scroll if the terminal is low, any other key leaves."""

    BINDINGS = [*LEAVE]

    def compose(self) -> ComposeResult:
        """Lay the keys out, side by side if there is room, and explain the strip's symbols."""
        signs = Text.assemble(
            ("1", theme.BEST), (" surest suggestion  ", theme.FAINT),
            ("2", theme.CANDIDATE), (" the next ones", theme.FAINT), "\n",
            ("●", theme.BLUE), (" your mark  ", theme.FAINT),
            ("○", theme.TEXT), (" mark in force  ", theme.FAINT),
            ("[━]", theme.BLUE), (" plateau", theme.FAINT),
        )  # fmt: skip
        tables = []
        for keys in GROUPS:
            table = Table.grid(padding=(0, 1))
            table.add_column(width=9, style=f"bold {theme.ACCENT}")
            table.add_column(style=theme.TEXT)
            for key in keys:
                table.add_row(key.shown, key.words)
            tables.append(table)
        move, decide, look = tables
        with VerticalScroll(classes="dialog help") as box:
            box.border_title = "keys"
            box.border_subtitle = "↑ ↓ more, any other key: back"
            box.set_class(self.app.size.width >= 110, "wide")
            yield Static(Group(move, "", decide))
            yield Static(Group(look, "", signs))

    def on_key(self, event: events.Key) -> None:
        """Scroll, or leave."""
        if event.key not in SCROLLING:
            event.stop()
            self.dismiss(None)
