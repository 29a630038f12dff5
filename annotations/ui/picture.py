"""The picture widget: one frame, cropped to the zoom, painted as the terminal can."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rich.segment import Segment
from rich.text import Text
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from annotations.ui import theme
from annotations.ui.faces import Face, zoom_box
from annotations.ui.frames import FrameCache, Shot
from annotations.ui.painters import BlockPainter, Painter, PaneShape
from express50.errors import AnnotationError


@dataclass(frozen=True)
class Look:
    """Which frame to look at, and how closely; ``aspect`` is the footage's height over width."""

    subject: str
    camera: str
    frame: int
    face: Face | None
    zoom: str
    aspect: float

    def at(self, frame: int) -> Look:
        """The same look at another frame."""
        return replace(self, frame=frame)


def shot_of(look: Look, shape: PaneShape) -> Shot:
    """The picture of a look that fills a pane."""
    columns, rows = max(1, shape.columns), max(1, shape.rows)
    box = zoom_box(look.face, look.zoom, shape.cell_aspect * rows / columns, look.aspect)
    width, height = shape.across * columns, shape.down * rows
    return Shot(look.subject, look.camera, look.frame, box, width, height)


class Picture(Widget):
    """Shows a look, or words in its place; draws only when what it shows changes."""

    def __init__(self, cache: FrameCache, name: str, painter: Painter | None = None) -> None:
        super().__init__(id=name)
        self._cache = cache
        self._blocks = painter if isinstance(painter, BlockPainter) else BlockPainter()
        self._painter = painter or self._blocks
        self._look: Look | None = None
        self._words = ""
        self._lines: list[Strip] | None = None
        self._covered = False

    def on_mount(self) -> None:
        """Ask how many colours there are."""
        self._blocks.few = self.app.console.color_system != "truecolor"

    @property
    def look(self) -> Look | None:
        """What is shown; None where words stand in its place."""
        return self._look

    def show(self, look: Look | None, words: str = "") -> None:
        """Show a look, or words where there is none."""
        if (look, words) != (self._look, self._words):
            self._look, self._words, self._lines = look, words, None
            self.refresh()

    @property
    def shape(self) -> PaneShape:
        """The size of the picture, in cells and pixels."""
        return self._painter.shape(self.size)

    def on_resize(self) -> None:
        """Draw anew."""
        self._lines = None

    def render_lines(self, crop: Region) -> list[Strip]:
        """The lines of the picture, past Textual's cache of styled lines.

        That cache rewrites the style of every segment, which costs more than all the rest: a
        picture has thousands, and no border or padding that it would be needed for.
        """
        covered = not self.screen.is_active
        if self._lines is None or covered != self._covered:
            self._covered = covered
            self._lines = self._draw()
        return [self._line(y).crop(crop.x, crop.right) for y in range(crop.y, crop.bottom)]

    def _line(self, y: int) -> Strip:
        if self._lines is not None and y < len(self._lines):
            return self._lines[y]
        return Strip.blank(self.size.width, theme.PLAIN)

    def _draw(self) -> list[Strip]:
        if self._look is None:
            return self._written(self._words)
        # Below a dialog characters stand in: Textual tints them, and pixels would lie on top.
        painter = self._blocks if self._covered else self._painter
        shot = shot_of(self._look, painter.shape(self.size))
        try:
            return painter.strips(shot, self.size, self._cache.get)
        except AnnotationError as error:
            return self._written(str(error))

    def _written(self, words: str) -> list[Strip]:
        """Words in the middle of the pane."""
        width, height = self.size
        text = Text(words, style=theme.DIM, justify="center")
        lines = text.wrap(self.app.console, max(1, width - 4))
        blank = Strip.blank(width, theme.PLAIN)
        above = max(0, (height - len(lines)) // 2)
        written = []
        for line in lines:
            line.align("center", width)
            strip = Strip([Segment(line.plain, theme.DIM)])
            written.append(strip.adjust_cell_length(width, theme.PLAIN))
        return [blank] * above + written
