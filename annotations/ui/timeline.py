"""Draw the cue window on a line: curves, suggestions, marks and the cursor."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

from rich.segment import Segment
from rich.style import Style
from textual import events
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from annotations.labels import Label
from annotations.ui import theme
from annotations.ui.task import CueView

GUTTER = 10  # cells left of the curves, for their names
WIDEST = 7  # cells of a frame where the window is short
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True, kw_only=True)
class StripContent:
    """Content of the strip; the curves start at the window's first frame."""

    view: CueView
    activity: tuple[float, ...] = ()
    match: tuple[float, ...] = ()
    mine: Label | None = None
    in_force: Label | None = None


Cell = tuple[str, Style]
Line = list[Cell]


def frame_cells(frames: int, width: int) -> tuple[int, int]:
    """Return the cells per frame and the frames per cell of a window in ``width`` cells."""
    if frames <= width:
        return min(WIDEST, width // frames), 1
    return 1, -(-frames // width)


def column_of(view: CueView, frame: int, width: int) -> int:
    """Return the first cell of a frame."""
    wide, per = frame_cells(view.last - view.first + 1, width)
    return (frame - view.first) // per * wide


def sign_column(view: CueView, frame: int, width: int) -> int:
    """Return the middle cell of a frame, where symbols are drawn."""
    wide, _ = frame_cells(view.last - view.first + 1, width)
    return min(column_of(view, frame, width) + wide // 2, width - 1)


def frame_at(view: CueView, column: int, width: int) -> int:
    """Return the frame under a cell, the nearest one beyond the curve's ends."""
    wide, per = frame_cells(view.last - view.first + 1, width)
    return min(max(view.first + column // wide * per, view.first), view.last)


def curve_lines(
    values: tuple[float, ...], view: CueView, width: int, height: int, style: Style
) -> list[Line]:
    """Draw a curve as bars between its least value, the floor, and its largest, the ceiling."""
    wide, per = frame_cells(view.last - view.first + 1, width)
    low, high = min(values, default=0.0), max(values, default=0.0)
    span = max(high - low, 1e-9)
    bars = [max(values[n : n + per]) for n in range(0, len(values), per)]
    # The lowest value still shows a sliver, so that a frame differs from no frame.
    levels = [max(1, round((v - low) / span * height * 8)) for v in bars]
    lines = []
    for row in range(height):
        floor = (height - 1 - row) * 8
        glyphs = (_BARS[min(8, max(0, level - floor))] * wide for level in levels)
        lines.append([(glyph, style) for glyph in "".join(glyphs)[:width]])
    return lines


def rank_line(view: CueView, width: int) -> Line:
    """Write the suggestions by rank: a digit under each, the surest one bright."""
    line = _blank(width)
    for number, frame in reversed(list(enumerate(view.candidates[:5], 1))):
        style = theme.BEST if number == 1 else theme.CANDIDATE
        line[sign_column(view, frame, width)] = (str(number), style)
    return line


def mark_line(content: StripContent, width: int) -> Line:
    """Draw the plateau, the mark in force (○) and on top the annotator's own (●)."""
    view = content.view
    line = _blank(width)
    first, last = view.plateau_first, view.plateau_last
    wide, _ = frame_cells(view.last - view.first + 1, width)
    if first is not None and last is not None:
        for column in range(column_of(view, first, width), column_of(view, last, width)):
            line[column] = ("━", theme.PLATEAU)
    if first is not None:
        line[column_of(view, first, width)] = ("[", theme.PLATEAU)
    if last is not None:
        line[min(column_of(view, last, width) + wide - 1, width - 1)] = ("]", theme.PLATEAU)
    marks = ((content.in_force, "○", theme.PLAIN), (content.mine, "●", theme.MINE))
    for label, glyph, style in marks:
        frame = None if label is None else label.frame
        if frame is not None and view.first <= frame <= view.last:
            line[sign_column(view, frame, width)] = (glyph, style)
    return line


def _blank(width: int) -> Line:
    return [(" ", theme.PLAIN)] * width


class CurveStrip(Widget):
    """Draws a ``StripContent``; a click moves the cursor there."""

    class Picked(Message):
        """A frame was clicked."""

        def __init__(self, frame: int) -> None:
            super().__init__()
            self.frame = frame

    def __init__(self) -> None:
        super().__init__(id="strip")
        self._content: StripContent | None = None

    def show(self, content: StripContent | None) -> None:
        """Show other content; nothing is drawn when it is the same."""
        if content != self._content:
            self._content = content
            self.refresh()

    def on_click(self, event: events.Click) -> None:
        """Post the frame that was clicked."""
        if self._content is not None and event.x >= GUTTER:
            frame = frame_at(self._content.view, event.x - GUTTER, self.size.width - GUTTER)
            self.post_message(self.Picked(frame))

    def render_lines(self, crop: Region) -> list[Strip]:
        """Return the lines of the strip, past Textual's cache of styled lines, which is slower."""
        lines = draw_strip(self._content, *self.size)
        lines += [Strip.blank(self.size.width, theme.PLAIN)] * self.size.height
        if self.app.no_color:
            ground = self.background_colors[1]
            lines = [line.apply_filter(theme.UNCOLOURED, ground) for line in lines]
        return [line.crop(crop.x, crop.right) for line in lines[crop.y : crop.bottom]]


def draw_strip(content: StripContent | None, width: int, height: int) -> list[Strip]:
    """Draw a strip of that size; curves take the lines that the two lines of marks leave."""
    room = width - GUTTER
    if content is None or room < 1 or height < 1:
        return [Strip.blank(width, theme.PLAIN)] * height
    named: list[tuple[str, Line]] = []
    rows = max(0, height - 2)
    curves = [("activity", content.activity, theme.ACTIVITY), ("match", content.match, theme.MATCH)]
    curves = [curve for curve in curves if curve[1]]
    curves = curves[max(0, len(curves) - rows) :]
    # The match decides: it gets the odd row, or the only one.
    for n, (name, values, style) in enumerate(curves):
        lines = curve_lines(values, content.view, room, (rows + n) // len(curves), style)
        named += [(name if n == 0 else "", line) for n, line in enumerate(lines)]
    named.append(("suggested", rank_line(content.view, room)))
    named.append(("marks", mark_line(content, room)))
    wide, _ = frame_cells(content.view.last - content.view.first + 1, room)
    start = column_of(content.view, content.view.cursor, room)
    cursor = range(start, min(start + wide, room))
    strips = []
    for name, line in named[-height:]:
        cells = (line + _blank(room))[:room]
        for column in cursor:
            glyph, style = cells[column]
            cells[column] = glyph, theme.CURSOR_BAR if glyph in _BARS[1:] else style + theme.CURSOR
        segments = [Segment(f"{name:<{GUTTER}}"[:GUTTER], theme.DIM)]
        for style, run in groupby(cells, key=lambda cell: cell[1]):
            segments.append(Segment("".join(glyph for glyph, _ in run), style))
        strips.append(Strip(segments, GUTTER + room))
    return strips
