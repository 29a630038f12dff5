"""The lines of words around the pictures, as text that fits a width."""

from __future__ import annotations

from functools import lru_cache

from rich.cells import cell_len
from rich.text import Text

from annotations.labels import Label
from annotations.ui import theme
from annotations.ui.picture import FrameLook
from annotations.ui.session import Session
from annotations.ui.task import CueView, TaskScene
from annotations.ui.theme import HINTS

LEAST_CELLS = 6  # fewer say nothing


def fit(left: Text, right: Text, width: int) -> Text:
    """Set two texts at the ends of a line; the right one is cut where it does not fit."""
    left, right = left.copy(), right.copy()
    left.truncate(width, overflow="ellipsis")
    room = width - left.cell_len - 1
    right = Text() if room < LEAST_CELLS else right
    right.truncate(room, overflow="ellipsis")
    left.append(" " * max(0, width - left.cell_len - right.cell_len))
    left.append_text(right)
    left.truncate(width)
    return left


def status_line(session: Session, scene: TaskScene, width: int) -> Text:
    """Show expression and subject; progress, doubt and the label's cost so far."""
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
    right.append(" done")
    if not session.hidden(scene.task):
        right.append("  doubt ")
        doubt = scene.task.doubt
        colour = theme.RED if doubt >= 0.5 else theme.ACCENT if doubt >= 0.2 else theme.GREEN
        right.append(f"{doubt:.2f}", colour)
    right.append(f"  {spent.seconds:.0f} s  {spent.keys} key{'' if spent.keys == 1 else 's'} ")
    return fit(left, right, width)


def words_line(scene: TaskScene, width: int) -> Text:
    """Show what the subject was asked to do."""
    text = Text(f" {scene.description}", style=theme.TEXT)
    text.truncate(width, overflow="ellipsis")
    return text


def frame_title(scene: TaskScene, view: CueView | None, look: FrameLook | None, width: int) -> Text:
    """Write the title of the left picture: position, and tags of this very frame."""
    if look is None or view is None:
        return Text(f" {scene.task.subject}", style=theme.FAINT)
    left = Text.assemble(
        (f" frame {view.cursor}", f"bold {theme.TEXT}"),
        (f"  {view.cursor - view.first + 1} of {view.last - view.first + 1}", theme.FAINT),
    )
    for words, colour in frame_tags(scene, view):
        left.append(f"  {words}", colour)
    return fit(left, Text(f"{look.camera} {look.zoom} ", style=theme.FAINT), width)


def frame_tags(scene: TaskScene, view: CueView) -> list[tuple[str, str]]:
    """List short words, with their colours, about the frame under the cursor."""
    tags = []
    if view.cursor in view.candidates:
        number = view.candidates.index(view.cursor) + 1
        tags.append(("suggested" if number == 1 else f"suggestion {number}", theme.GREEN))
    if scene.mine is not None:
        if scene.mine.action == "flag":
            tags.append((f"⚑ {scene.mine.reason}", theme.RED))
        elif scene.mine.frame == view.cursor:
            tags.append(("● your mark", theme.BLUE))
    return tags


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


def blink_title(width: int, reference: bool) -> Text:
    """Write the title of the left picture while it blinks."""
    shown = "the reference" if reference else "the frame"
    text = Text(f" blink: {shown}  (any key stops)", style=f"bold {theme.ACCENT}")
    text.truncate(width)
    return text


LAST = ("?", "q")


@lru_cache(maxsize=8)
def hint_line(width: int) -> Text:
    """List as many keys as fit, the most used first; help and quit always come last."""
    text = Text(" ")
    room = width - cell_len("? help  q quit")
    for keys, words in HINTS:
        piece = cell_len(keys) + cell_len(words) + 3
        if keys not in LAST and text.cell_len + piece <= room:
            _hint(text, keys, words)
    for keys, words in HINTS:
        if keys in LAST:
            _hint(text, keys, words)
    text.truncate(width)
    return text


def _hint(text: Text, keys: str, words: str) -> None:
    text.append(keys, f"bold {theme.ACCENT}")
    text.append(f" {words}  ", theme.FAINT)


def message_line(words: str, colour: str, width: int) -> Text:
    """Write a message in place of the hints."""
    text = Text(f" {words}", style=colour)
    text.truncate(width, overflow="ellipsis")
    return text


def saved_words(label: Label) -> str:
    """Say that a decision is on disk."""
    what = f"frame {label.frame}" if label.action == "mark" else f"flagged {label.reason}"
    cost = f"{label.keys} key{'' if label.keys == 1 else 's'}, {label.seconds:.1f} s"
    return f"saved: {label.subject} {label.expression} {what} ({cost}); u takes it back"
