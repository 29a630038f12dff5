"""Show one view of a task: pictures, and below them the cue window on a line.

Both widgets draw lines of the terminal themselves, past Textual's cache of styled lines. That cache
rewrites the style of every segment, which costs more than all the rest; a picture has thousands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from rich.align import Align
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from annotations.labels import Label
from annotations.ui import theme
from annotations.ui.frames import Face, FaceFinder, FrameCache, FrameCrop, zoom_box
from annotations.ui.images import Painter, PaneShape
from annotations.ui.task import CueView, TaskScene
from express50.capture.index import Index
from express50.errors import AnnotationError

AHEAD = 64  # frames about the cursor that are decoded before they are asked for
GUTTER = 10  # cells left of the curves, for their names
WIDEST = 7  # cells of a frame where the window is short
_BARS = " ▁▂▃▄▅▆▇█"

Cell = tuple[str, Style]
Line = list[Cell]


@dataclass(frozen=True)
class FrameLook:
    """One frame and how closely to look at it; ``aspect`` is the footage's height over width."""

    subject: str
    camera: str
    frame: int
    face: Face | None
    zoom: str
    aspect: float


def shot_of(look: FrameLook, shape: PaneShape) -> FrameCrop:
    """Crop the picture of a look that fills a pane."""
    aspect = shape.cell_aspect * shape.rows / shape.columns
    box = zoom_box(look.face, look.zoom, aspect, look.aspect)
    width, height = shape.across * shape.columns, shape.down * shape.rows
    return FrameCrop(look.subject, look.camera, look.frame, box, width, height)


class PicturePane(Widget):
    """Shows a look, or words in its place."""

    def __init__(self, cache: FrameCache, name: str, painter: Painter) -> None:
        super().__init__(id=name)
        self._cache = cache
        self._blocks = Painter()
        self._painter = painter
        self.look: FrameLook | None = None  # None if words replace it
        self._words = ""

    def show(self, look: FrameLook | None, words: str) -> None:
        """Show a look, or words if there is none; draw nothing if both are unchanged."""
        if (look, words) != (self.look, self._words):
            self.look, self._words = look, words
            self.refresh()

    @property
    def shape(self) -> PaneShape:
        """Return the size of the picture, in cells and pixels."""
        return self._painter.shape(self.size)

    def trouble(self) -> str:
        """Return why the picture cannot be read; an empty text if it can, or if none is shown."""
        if self.look is None or not (self.size.width and self.size.height):
            return ""
        try:
            self._cache.get(shot_of(self.look, self.shape))
        except AnnotationError as error:
            return str(error)
        return ""

    def render_lines(self, crop: Region) -> list[Strip]:
        """Return the lines of the picture."""
        if self.look is None:
            lines = self._written(self._words)
        else:
            # Below a dialog characters are shown: Textual tints them, pixels would lie on top.
            painter = self._painter if self.screen.is_active else self._blocks
            shot = shot_of(self.look, painter.shape(self.size))
            try:
                lines = painter.strips(shot, self.size, self._read)
            except AnnotationError as error:
                lines = self._written(str(error))
        return [line.crop(crop.x, crop.right) for line in lines[crop.y : crop.bottom]]

    def _read(self, crop: FrameCrop) -> np.ndarray:
        picture = self._cache.get(crop)
        # A face in 256 colours is blotches, whereas the 24 greys among them show it well.
        if not self.app.no_color and self.app.console.color_system != "256":
            return picture
        grey = picture @ np.array([0.299, 0.587, 0.114])  # luma, ITU-R BT.601
        return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)

    def _written(self, words: str) -> list[Strip]:
        """Write words in the middle of the pane."""
        width, height = self.size
        text = Text(words, style=theme.DIM, justify="center")
        middle = Align.center(text, theme.PLAIN, vertical="middle", width=max(1, width - 4))
        options = self.app.console.options.update(width=width, height=height)
        lines = [Strip(line, width) for line in self.app.console.render_lines(middle, options)]
        if not self.app.no_color:
            return lines
        return [line.apply_filter(theme.UNCOLOURED, self.background_colors[1]) for line in lines]


class Aim(NamedTuple):
    """The view of the pictures."""

    camera: int  # counted from the best
    zoom: str
    faces: FaceFinder | None
    two: bool = False  # asks for a second camera
    second: str = ""  # id of the second camera that was chosen last


def camera_name(scene: TaskScene, number: int) -> str:
    """Return a camera by its number, wrapping around."""
    return scene.cameras[number % len(scene.cameras)] if scene.cameras else ""


def other_cameras(scene: TaskScene, aim: Aim) -> list[str]:
    """List the cameras that can be shown beside the first one, the chosen one first."""
    others = [name for name in scene.cameras if name != camera_name(scene, aim.camera)]
    start = others.index(aim.second) if aim.second in others else 0
    return others[start:] + others[:start]


def second_look(scene: TaskScene, view: CueView, aim: Aim) -> FrameLook | None:
    """Look at the frame under the cursor in the second camera; None if there is only one."""
    others = other_cameras(scene, aim)
    return subject_look(scene, view, aim, others[0]) if others else None


def subject_look(
    scene: TaskScene, view: CueView, aim: Aim, camera: str | None = None
) -> FrameLook | None:
    """Look at the frame under the cursor, in the aim's camera or another; None without footage."""
    if scene.index is None:
        return None
    # One framing for the whole window, so that only the face moves when one steps.
    anchor = view.candidates[0] if view.candidates else (view.first + view.last) // 2
    look = _look(aim, scene.index, camera or camera_name(scene, aim.camera), anchor)
    return replace(look, frame=view.cursor)


def reference_look(scene: TaskScene, aim: Aim) -> FrameLook | None:
    """Look at the reference's canonical frame, in the same camera where the reference has it."""
    canonical, index = scene.reference, scene.reference_index
    if canonical is None or index is None:
        return None
    camera = camera_name(scene, aim.camera)
    if camera not in index.cameras or canonical.frame >= index.cameras[camera].frames:
        camera = canonical.camera
    return _look(aim, index, camera, canonical.frame)


def _look(aim: Aim, index: Index, camera: str, frame: int) -> FrameLook:
    face = None if aim.faces is None else aim.faces.find(index.subject, camera, frame)
    source = index.cameras[camera]
    return FrameLook(index.subject, camera, frame, face, aim.zoom, source.height / source.width)


def frames_ahead(view: CueView, count: int = AHEAD) -> list[int]:
    """List frames that the next keys may ask for: ten on either side, and suggestions."""
    near = [view.cursor, *view.candidates, view.cursor + 10, view.cursor - 10]
    for away in range(1, count):
        near += [view.cursor + away, view.cursor - away]
    inside = (frame for frame in near if view.first <= frame <= view.last)
    return list(dict.fromkeys(inside))[:count]


def shots_ahead(
    scene: TaskScene, view: CueView, aim: Aim, shapes: Sequence[PaneShape], count: int = AHEAD
) -> list[FrameCrop]:
    """Return pictures to decode for a task, most urgent first; finds the faces on the way.

    ``shapes`` are of the frame's pane and, while it is shown, of the second camera's.
    """
    looks = [subject_look(scene, view, aim)]
    if len(shapes) > 1:
        looks.append(second_look(scene, view, aim))
    shown = [(look, shape) for look, shape in zip(looks, shapes, strict=True) if look is not None]
    frames = frames_ahead(view, count)
    shots = [shot_of(replace(look, frame=n), shape) for n in frames for look, shape in shown]
    there = reference_look(scene, aim)
    if there is not None:
        shots.insert(len(shown), shot_of(there, shapes[0]))
    return shots


@dataclass(frozen=True, kw_only=True)
class StripContent:
    """Content of the strip; the curves start at the window's first frame."""

    view: CueView
    activity: tuple[float, ...] = ()
    match: tuple[float, ...] = ()
    mine: Label | None = None
    in_force: Label | None = None


def strip_content(scene: TaskScene, view: CueView, hidden: bool) -> StripContent:
    """Collect the timeline's content, without suggestions while those are hidden."""
    if hidden or scene.suggestion is None:
        return StripContent(view=view, mine=scene.mine, in_force=None if hidden else scene.in_force)
    found = scene.suggestion
    places = np.arange(view.first, view.last + 1) - found.start
    # One value per frame of the window: the curves' ends are continued.
    curves = {
        name: tuple(np.take(np.asarray(values, float), places, mode="clip").tolist())
        for name, values in (("activity", found.activity), ("match", found.match))
        if values
    }
    return StripContent(view=view, mine=scene.mine, in_force=scene.in_force, **curves)


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
        """Return the lines of the strip."""
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
