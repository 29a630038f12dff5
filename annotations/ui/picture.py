"""Show the pictures: which crop of which frame, and the widget that draws it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from rich.segment import Segment
from rich.text import Text
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from annotations.ui import theme
from annotations.ui.frames import Face, FaceFinder, FrameCache, FrameCrop, zoom_box
from annotations.ui.images import Painter, PaneShape
from annotations.ui.task import CueView, TaskScene
from annotations.ui.timeline import StripContent
from express50.capture.index import Index
from express50.errors import AnnotationError


@dataclass(frozen=True)
class FrameLook:
    """One frame and how closely to look at it; ``aspect`` is the footage's height over width."""

    subject: str
    camera: str
    frame: int
    face: Face | None
    zoom: str
    aspect: float

    def at(self, frame: int) -> FrameLook:
        """Look in the same way at another frame."""
        return replace(self, frame=frame)


def shot_of(look: FrameLook, shape: PaneShape) -> FrameCrop:
    """Crop the picture of a look that fills a pane."""
    columns, rows = max(1, shape.columns), max(1, shape.rows)
    box = zoom_box(look.face, look.zoom, shape.cell_aspect * rows / columns, look.aspect)
    width, height = shape.across * columns, shape.down * rows
    return FrameCrop(look.subject, look.camera, look.frame, box, width, height)


class PicturePane(Widget):
    """Shows a look, or words in its place; draws only when what it shows changes."""

    def __init__(self, cache: FrameCache, name: str, painter: Painter) -> None:
        super().__init__(id=name)
        self._cache = cache
        self._blocks = Painter()
        self._painter = painter
        self._look: FrameLook | None = None
        self._words = ""
        self._lines: list[Strip] | None = None
        self._covered = False

    @property
    def look(self) -> FrameLook | None:
        """Return the look that is shown; None where words replace it."""
        return self._look

    def show(self, look: FrameLook | None, words: str = "") -> None:
        """Show a look, or words where there is none."""
        if (look, words) != (self._look, self._words):
            self._look, self._words, self._lines = look, words, None
            self.refresh()

    @property
    def shape(self) -> PaneShape:
        """Return the size of the picture, in cells and pixels."""
        return self._painter.shape(self.size)

    def on_resize(self) -> None:
        """Draw anew."""
        self._lines = None

    def render_lines(self, crop: Region) -> list[Strip]:
        """Return the lines of the picture, past Textual's cache of styled lines.

        That cache rewrites the style of every segment, which costs more than all the rest: a
        picture has thousands, and no border or padding that it would be needed for.
        """
        covered = not self.screen.is_active
        if self._lines is None or covered != self._covered:
            self._covered = covered
            self._lines = self._draw()
        blanks = [Strip.blank(self.size.width, theme.PLAIN)] * self.size.height
        lines = (self._lines + blanks)[crop.y : crop.bottom]
        return [line.crop(crop.x, crop.right) for line in lines]

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
        """Write words in the middle of the pane."""
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


AHEAD = 64  # frames about the cursor that are decoded before they are asked for


class Aim(NamedTuple):
    """The view of both pictures: camera (counted from the best), zoom, finder of faces."""

    camera: int
    zoom: str
    faces: FaceFinder | None


def camera_name(scene: TaskScene, number: int) -> str:
    """Return a camera by its number, round and round."""
    return scene.cameras[number % len(scene.cameras)] if scene.cameras else ""


def subject_look(scene: TaskScene, view: CueView, aim: Aim) -> FrameLook | None:
    """Look at the frame under the cursor; None without footage."""
    if scene.index is None:
        return None
    # One framing for the whole window, so that only the face moves when one steps.
    anchor = view.candidates[0] if view.candidates else (view.first + view.last) // 2
    look = _look(aim, scene.index, camera_name(scene, aim.camera), anchor)
    return look.at(view.cursor)


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
    scene: TaskScene, view: CueView, aim: Aim, shape: PaneShape, count: int = AHEAD
) -> list[FrameCrop]:
    """Return pictures to decode for a task, most urgent first; finds the faces on the way."""
    here, there = subject_look(scene, view, aim), reference_look(scene, aim)
    shots = [shot_of(here.at(n), shape) for n in frames_ahead(view, count)] if here else []
    if there is not None:
        shots.insert(1, shot_of(there, shape))
    return shots


def strip_content(scene: TaskScene, view: CueView, hidden: bool) -> StripContent:
    """Collect the timeline's content, without what could sway the annotator while it is hidden."""
    found = None if hidden else scene.suggestion

    def curve(values: Sequence[float] | None) -> tuple[float, ...]:
        """Fit a curve to the window, one value per frame; its ends are continued."""
        if found is None or not values:
            return ()
        places = np.arange(view.first, view.last + 1) - found.start
        return tuple(np.asarray(values, float)[places.clip(0, len(values) - 1)].tolist())

    return StripContent(
        view=view,
        activity=curve(found.activity if found else None),
        match=curve(found.match if found else None),
        mine=scene.mine,
        in_force=None if hidden else scene.in_force,
    )
