"""The screen: its parts, how they are drawn, and the timers that play and blink."""

from __future__ import annotations

from collections.abc import Callable

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.screen import Screen
from textual.timer import Timer
from textual.widgets import Static

from annotations.ui import panels, theme
from annotations.ui.frames import ZOOMS, FaceFinder, FrameCache
from annotations.ui.picture import (
    Aim,
    PicturePane,
    reference_look,
    shots_ahead,
    strip_content,
    subject_look,
)
from annotations.ui.session import Session
from annotations.ui.task import CueView, TaskScene, go_to, step
from annotations.ui.timeline import CurveStrip

SAY_SECONDS = 5.0
# Rows of the strip by the terminal's height: pictures come first.
_STRIP_ROWS = ((18, 3), (30, 5), (45, 7))
_TALLEST_STRIP = 9


class AnnotatorScreen(Screen[None]):
    """Shows a scene, a view of it and what was said; whoever changes them calls ``draw``."""

    def __init__(
        self,
        session: Session,
        cache: FrameCache,
        faces: FaceFinder | None,
        make_picture: Callable[[FrameCache, str], PicturePane],
    ) -> None:
        super().__init__()
        self._make_picture = make_picture
        self.session = session
        self.cache = cache
        self.faces = faces
        self.scene: TaskScene | None = None
        self.view: CueView | None = None
        self.aim = Aim(0, ZOOMS[0], faces)
        self.player = Player(self)
        self._said: tuple[str, str] | None = None

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
        picture = self.query_one("#reference", PicturePane)
        look = reference_look(self.scene, self.aim)
        picture.show(look, "the reference has no frame of this expression yet")
        title = panels.reference_title(self.scene, look, picture.size.width)
        self._write("#reference-title", title)
        self._draw_frame(self.scene)
        hidden = self.session.hidden(self.scene.task)
        content = None if self.view is None else strip_content(self.scene, self.view, hidden)
        self.query_one(CurveStrip).show(content)
        self._draw_message()
        if self.view is not None:
            shape = self.query_one("#frame", PicturePane).shape
            self.cache.want(shots_ahead(self.scene, self.view, self.aim, shape))

    def _draw_status(self) -> None:
        if self.scene is not None:
            width = self.app.size.width
            self._write("#status", panels.status_line(self.session, self.scene, width))
            self._write("#words", panels.words_line(self.scene, width))

    def _draw_frame(self, scene: TaskScene) -> None:
        picture = self.query_one("#frame", PicturePane)
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

    def say(self, words: str, colour: str = theme.GREEN) -> None:
        """Show a message in place of the hints, for some seconds or until the next message."""
        self._said = said = (words, colour)

        def hush() -> None:
            if self._said is said:
                self._said = None
                self._draw_message()

        self.set_timer(SAY_SECONDS, hush)
        self._draw_message()


BLINK_SECONDS = 0.45
SLOWEST, FASTEST = 2.0, 30.0  # frames per second that are played


class Player:
    """Holds the timers; at most one of them runs."""

    def __init__(self, board: AnnotatorScreen) -> None:
        self._board = board
        self._playing: Timer | None = None
        self._blinking: Timer | None = None
        self.swapped = False

    @property
    def plays(self) -> bool:
        """True while the window is played."""
        return self._playing is not None

    @property
    def blinks(self) -> bool:
        """True while frame and reference take turns."""
        return self._blinking is not None

    def play(self) -> None:
        """Play from the cursor on, from the start where the cursor stands at the end; or stop."""
        if self.stop():
            return
        board = self._board
        if board.view is None or board.scene is None or board.scene.index is None:
            return
        if board.view.cursor == board.view.last:
            board.view = go_to(board.view, board.view.first)
        rate = min(max(board.scene.index.fps, SLOWEST), FASTEST)
        self._playing = board.set_interval(1.0 / rate, self._next_frame)
        board.draw()

    def blink(self) -> None:
        """Show the reference in the frame's place and back, in turns; or stop."""
        if not self.stop():
            self._blinking = self._board.set_interval(BLINK_SECONDS, self._swap)
            self._swap()

    def stop(self) -> bool:
        """Stop whatever runs; return whether something did."""
        ran = self._playing is not None or self._blinking is not None
        for timer in (self._playing, self._blinking):
            if timer is not None:
                timer.stop()
        self._playing = self._blinking = None
        self.swapped = False
        return ran

    def _next_frame(self) -> None:
        view = self._board.view
        if view is None or view.cursor == view.last:
            self.stop()
        else:
            self._board.view = step(view, 1)
        self._board.draw()

    def _swap(self) -> None:
        self.swapped = not self.swapped
        self._board.draw()
