"""What runs by timer: playing the window, and blinking between frame and reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

from textual.timer import Timer

from annotations.ui.view import go_to, step

if TYPE_CHECKING:
    from annotations.ui.board import Board

BLINK_SECONDS = 0.45
SLOWEST, FASTEST = 2.0, 30.0  # frames a second that are played


class Player:
    """Holds the timers; at most one of them runs."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._playing: Timer | None = None
        self._blinking: Timer | None = None
        self.swapped = False

    @property
    def plays(self) -> bool:
        """Whether the window is being played."""
        return self._playing is not None

    @property
    def blinks(self) -> bool:
        """Whether frame and reference take turns."""
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
        """Stop whatever runs; tells whether something did."""
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
