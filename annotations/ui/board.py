"""The screen's parts and how they are drawn: status, pictures, strip, messages. No key is known."""

from __future__ import annotations

from collections.abc import Callable

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.screen import Screen
from textual.widgets import Static

from annotations.ui import panels, theme
from annotations.ui.faces import ZOOMS, FaceFinder
from annotations.ui.frames import FrameCache
from annotations.ui.looks import Aim, reference_look, shots_ahead, strip_content, subject_look
from annotations.ui.picture import Picture
from annotations.ui.player import Player
from annotations.ui.scene import Scene
from annotations.ui.session import Session
from annotations.ui.strip import CurveStrip
from annotations.ui.view import View

SAY_SECONDS = 5.0
# Rows of the strip by the terminal's height: pictures come first.
_STRIP_ROWS = ((18, 3), (30, 5), (45, 7))
_TALLEST_STRIP = 9


class Board(Screen[None]):
    """Shows a scene, a view of it and what was said; whoever changes them calls ``draw``."""

    def __init__(
        self,
        session: Session,
        cache: FrameCache,
        faces: FaceFinder | None,
        make_picture: Callable[[FrameCache, str], Picture],
    ) -> None:
        super().__init__()
        self._make_picture = make_picture
        self.session = session
        self.cache = cache
        self.faces = faces
        self.scene: Scene | None = None
        self.view: View | None = None
        self.aim = Aim(0, ZOOMS[0], faces)
        self.player = Player(self)
        self._said: tuple[str, str] | None = None
        self._saying = 0

    def compose(self) -> ComposeResult:
        """Status, words, two pictures, strip, and a line for messages and hints."""
        yield Static(id="status")
        yield Static(id="words")
        with Horizontal(id="panes"):
            for name, side in (("frame", "left"), ("reference", "right")):
                with Vertical(classes="pane", id=side):
                    yield Static(id=f"{name}-title", classes="title")
                    yield self._make_picture(self.cache, name)
        yield CurveStrip()
        yield Static(id="message")

    def on_mount(self) -> None:
        """Let the clock run."""
        self.set_interval(1.0, self._draw_status)

    def on_resize(self) -> None:
        """Give the strip what the height allows, then draw all anew."""
        height = self.app.size.height
        rows = next((rows for below, rows in _STRIP_ROWS if height < below), _TALLEST_STRIP)
        self.query_one(CurveStrip).styles.height = rows
        self.query_one("#words").display = height >= 14
        self.call_after_refresh(self.draw)

    def draw(self) -> None:
        """Bring every part up to date; parts that show the same already do nothing."""
        if self.scene is None:
            self._draw_message()
            return
        self._draw_status()
        self._draw_reference(self.scene)
        self._draw_frame(self.scene)
        hidden = self.session.hidden(self.scene.task)
        content = None if self.view is None else strip_content(self.scene, self.view, hidden)
        self.query_one(CurveStrip).show(content)
        self._draw_message()
        if self.view is not None:
            shape = self.query_one("#frame", Picture).shape
            self.cache.want(shots_ahead(self.scene, self.view, self.aim, shape))

    def _draw_status(self) -> None:
        if self.scene is not None:
            width = self.app.size.width
            self._write("#status", panels.status_line(self.session, self.scene, width))
            self._write("#words", panels.words_line(self.scene, width))

    def _draw_reference(self, scene: Scene) -> None:
        picture, look = self.query_one("#reference", Picture), reference_look(scene, self.aim)
        picture.show(look, "the reference has no frame of this expression yet")
        title = panels.reference_title(scene, look, picture.size.width)
        self._write("#reference-title", title)

    def _draw_frame(self, scene: Scene) -> None:
        picture = self.query_one("#frame", Picture)
        look = None if self.view is None else subject_look(scene, self.view, self.aim)
        there = reference_look(scene, self.aim) if self.player.swapped else None
        picture.show(there or look, scene.problem or "")
        width = picture.size.width
        if self.player.blinks:
            title = panels.blink_title(width, there is not None)
        else:
            title = panels.frame_title(scene, self.view, look, width)
        self._write("#frame-title", title)

    def _draw_message(self) -> None:
        width = self.app.size.width
        if self._said is None:
            self._write("#message", panels.hint_line(width))
        else:
            self._write("#message", panels.message_line(*self._said, width))

    def _write(self, where: str, text: Text) -> None:
        line = self.query_one(where, Static)
        if line.content != text:
            line.update(text)

    def say(self, words: str, colour: str = theme.GREEN, *, stay: bool = False) -> None:
        """Show a message in place of the hints, for some seconds or until another is said."""
        self._said = (words, colour)
        self._saying += 1
        if not stay:
            said = self._saying
            self.set_timer(SAY_SECONDS, lambda: self._hush(said))
        self._draw_message()

    def _hush(self, said: int) -> None:
        if said == self._saying:
            self._said = None
            self._draw_message()
