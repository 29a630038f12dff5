"""Run the annotator as a Textual app: keys move, look and decide."""

from __future__ import annotations

import asyncio
import gc
import signal
from collections.abc import Callable, Sequence
from copy import copy
from typing import ClassVar

from rich.text import Text
from textual import events, work
from textual.app import App, ComposeResult
from textual.containers import Horizontal, Vertical
from textual.drivers.linux_driver import LinuxDriver
from textual.filter import LineFilter
from textual.geometry import Size
from textual.screen import Screen
from textual.timer import Timer
from textual.widgets import Static

from annotations.labels import Label
from annotations.ui import task as moves
from annotations.ui import theme, words
from annotations.ui.frames import ZOOMS, FaceFinder, FrameCache, FrameCrop
from annotations.ui.images import Painter, PaneShape, SixelPainter
from annotations.ui.panes import (
    Aim,
    CurveStrip,
    PicturePane,
    camera_name,
    other_cameras,
    reference_look,
    second_look,
    shots_ahead,
    strip_content,
    subject_look,
)
from annotations.ui.session import Session
from annotations.ui.task import CueView, TaskScene, load_scene, view_of_scene
from annotations.worklist import LabelTask
from express50.errors import Express50Error

TASKS_AHEAD, FRAMES_AHEAD = 2, 12  # pictures that are made before their task is opened
SAY_SECONDS = 5.0
GARBAGE = 50_000  # new objects that start a pass of the garbage collection; Python's own: 700
BLINK_SECONDS = 0.45
SLOWEST, FASTEST = 2.0, 30.0  # frames per second that are played
# Rows of the strip by the terminal's height: pictures come first.
_STRIP_ROWS = ((18, 3), (30, 5), (45, 7))
_TALLEST_STRIP = 9
LEAST_COLUMNS = 90  # of a terminal that shows three pictures: in narrower ones faces are too small


class Desk(Screen[None]):
    """Shows a scene, a view of it and a message; call ``draw`` after changing them."""

    ACTIONS: ClassVar[dict[str, str]] = {
        name: key.action.format(key=name)
        for group in theme.GROUPS
        for key in group
        for name in key.keys.split(",")
    }

    def __init__(
        self, session: Session, cache: FrameCache, faces: FaceFinder | None, sixel_cell: Size | None
    ) -> None:
        super().__init__()
        self.session = session
        self.cache = cache
        self.faces = faces
        self.scene: TaskScene | None = None
        self.view: CueView | None = None
        self.aim = Aim(0, ZOOMS[0], faces)
        self.player = Player(self)
        self._sixel_cell = sixel_cell
        self._said: Text | None = None

    def compose(self) -> ComposeResult:
        """Yield status, words, pictures, strip, and a line for messages and hints."""
        yield Static(id="status")
        yield Static(id="words")
        with Horizontal(id="panes"):
            sides = ("frame", "left"), ("second", "middle"), ("reference", "right")
            for name, side in sides:
                with Vertical(classes="pane", id=side) as pane:
                    pane.display = name != "second"
                    yield Static(id=f"{name}-title", classes="title")
                    cell = self._sixel_cell
                    painter = Painter() if cell is None else SixelPainter(cell)
                    yield PicturePane(self.cache, name, painter)
        yield CurveStrip()
        yield Static(id="message")

    def on_mount(self) -> None:
        """Open the first task; look for faces once the network is there."""
        self.set_interval(1.0, self._draw_status)
        if self.faces is not None:
            self._load_faces(self.faces)

        def begin() -> None:
            self.open_task()
            self.session.begin()

        self.call_after_refresh(begin)

    @work(thread=True, group="faces")
    def _load_faces(self, faces: FaceFinder) -> None:
        faces.load()
        self.app.call_from_thread(self.draw)

    async def on_key(self, event: events.Key) -> None:
        """Act on a key; one that was typed before a dialog was drawn goes to the dialog.

        Textual's bindings would act only after the next keys have been given to this screen.
        """
        self.session.press()  # here, since a key may have waited for the decision before it
        dialog, late = self.app.screen, copy(event)
        event.stop()
        if dialog is not self:
            dialog.call_after_refresh(lambda: (dialog.focused or dialog).post_message(late))
        elif event.key in self.ACTIONS:
            await self.app.run_action(self.ACTIONS[event.key], self)

    def on_resize(self) -> None:
        """Give the strip what the height allows, then draw everything again."""
        height = self.app.size.height
        rows = next((rows for below, rows in _STRIP_ROWS if height < below), _TALLEST_STRIP)
        self.query_one(CurveStrip).styles.height = rows
        self.query_one("#words").display = height >= 14
        self.call_after_refresh(self.draw)

    def draw(self) -> None:
        """Update every part of the screen; unchanged parts do nothing."""
        self._draw_message()
        if self.scene is None:
            return
        self._draw_status()
        scene, view = self.scene, self.view
        # The reference's own frame of this clip is a suggestion or somebody's mark.
        hidden = scene.is_reference and self.session.hidden(scene.task)
        there = None if hidden else reference_look(scene, self.aim)
        picture = self.query_one("#reference", PicturePane)
        nothing = "the reference has no frame of this expression yet"
        picture.show(there, "hidden until you decide" if hidden else nothing)
        title = words.reference_title(scene, there, picture.size.width)
        self._write("#reference-title", title)
        here = None if view is None else subject_look(scene, view, self.aim)
        swapped = there if self.player.swapped else None
        picture = self.query_one("#frame", PicturePane)
        picture.show(swapped or here, scene.problem or "")
        title = words.frame_title(scene, view, here, picture.size.width)
        if self.player.blinks:
            shown = "the frame" if swapped is None else "the reference"
            title = Text(f" blink: {shown}  (any key stops)", style=f"bold {theme.ACCENT}")
        self._write("#frame-title", title)
        self._draw_second(scene, view)
        content = None
        if view is not None:
            content = strip_content(scene, view, self.session.hidden(scene.task))
            self.cache.want(shots_ahead(scene, view, self.aim, self._shapes()))
        self.query_one(CurveStrip).show(content)

    def _draw_second(self, scene: TaskScene, view: CueView | None) -> None:
        """Show the second camera where it is asked for and the terminal is wide enough."""
        pane = self.query_one("#middle")
        shown = self.aim.two and self.app.size.width >= LEAST_COLUMNS
        if pane.display != shown:
            pane.display = shown
            self.call_after_refresh(self.draw)  # the other panes' widths change
        if shown:
            look = None if view is None else second_look(scene, view, self.aim)
            picture = self.query_one("#second", PicturePane)
            picture.show(look, f"{scene.task.subject} has no second camera")
            self._write("#second-title", words.second_title(look, picture.size.width))

    def _shapes(self) -> list[PaneShape]:
        """Return the shapes of the panes that show the subject."""
        shown = ["#frame", "#second"] if self.query_one("#middle").display else ["#frame"]
        return [self.query_one(name, PicturePane).shape for name in shown]

    def _draw_status(self) -> None:
        # Below a dialog every change draws the whole screen again, for a large part of a second.
        if self.scene is not None and self.is_active:
            width = self.app.size.width
            self._write("#status", words.status_line(self.session, self.scene, width))
            self._write("#words", Text(f" {self.scene.description}", style=theme.TEXT))

    def _draw_message(self) -> None:
        scene = self.scene
        matches = scene is not None and scene.reference is not None and not scene.is_reference
        self._write("#message", self._said or words.hint_line(self.app.size.width, matches))

    def _write(self, where: str, text: Text) -> None:
        line = self.query_one(where, Static)
        if line.content != text:
            line.update(text)

    def say(self, message: str, colour: str = theme.GREEN) -> None:
        """Show a message in place of the hints, for some seconds or until the next message."""
        self._said = said = Text(f" {message}", style=colour)

        def hush() -> None:
            if self._said is said:
                self._said = None
                self._draw_message()

        self.set_timer(SAY_SECONDS, hush)
        self._draw_message()

    def open_task(self) -> None:
        """Show the session's open task."""
        self.player.stop()
        task = self.session.task
        if task is None:
            self.say("nothing to label: no task matches, or nothing is ingested", theme.RED)
            return
        self.scene = scene = load_scene(self.session.dataset, task, self.session.annotator)
        if scene.suggestion is not None:  # else the camera that was chosen last stays
            self.aim = self.aim._replace(camera=0)
        self.view = view_of_scene(scene, self.session.hidden(task))
        self.draw()
        if scene.problem or scene.notes:
            self.say(scene.problem or " · ".join(scene.notes), theme.ACCENT)
        ahead = [self.session.tasks[n] for n in self.session.following(TASKS_AHEAD)]
        self._prepare(ahead, self._shapes())

    @work(thread=True, exclusive=True, group="ahead")
    def _prepare(self, tasks: list[LabelTask], shapes: list[PaneShape]) -> None:
        """Read the next tasks, find their faces and ask for their pictures."""
        shots: list[FrameCrop] = []
        for task in tasks:
            scene = load_scene(self.session.dataset, task, self.session.annotator)
            view = view_of_scene(scene, self.session.hidden(task))
            if view is not None:
                shots += shots_ahead(scene, view, self.aim, shapes, FRAMES_AHEAD)
        self.cache.want(shots, later=True)

    # Moves and looks

    def move(self, how: Callable[..., CueView], *numbers: int) -> None:
        """Stop what plays, and move by a function of the view."""
        self.player.stop()
        if self.view is not None:
            self.view = how(self.view, *numbers)
        self.draw()

    def action_move(self, how: str, *numbers: int) -> None:
        """Move by a function of `annotations.ui.task`, by its name."""
        self.move(getattr(moves, how), *numbers)

    def action_candidate(self, by: int) -> None:
        """Go to the next or previous suggestion."""
        self.move(moves.next_candidate, by)
        if self.view is not None and not self.view.candidates:
            hidden = self.scene is not None and self.session.hidden(self.scene.task)
            self.say("hidden until you decide" if hidden else "no suggestion", theme.ACCENT)

    def on_curve_strip_picked(self, message: CurveStrip.Picked) -> None:
        """Go to the frame that was clicked on the strip."""
        self.move(moves.go_to, message.frame)

    def action_zoom(self, by: int) -> None:
        """Change to the next zoom."""
        number = (ZOOMS.index(self.aim.zoom) + by) % len(ZOOMS)
        self.aim = self.aim._replace(zoom=ZOOMS[number])
        self.draw()

    def action_camera(self, by: int) -> None:
        """Change to the next camera."""
        if self.scene is not None and self.scene.cameras:
            number = (self.aim.camera + by) % len(self.scene.cameras)
            self.aim = self.aim._replace(camera=number)
            self.draw()

    def action_second(self) -> None:
        """Show a second camera beside the frame, or stop."""
        self._aim_second(not self.aim.two, self.aim.second)

    def action_next_second(self) -> None:
        """Choose another second camera."""
        if self.scene is not None:
            others = other_cameras(self.scene, self.aim) or [self.aim.second]
            self._aim_second(True, others[self.aim.two % len(others)])

    def _aim_second(self, two: bool, camera: str) -> None:
        self.aim = self.aim._replace(two=two, second=camera)
        width = self.app.size.width
        if two and width < LEAST_COLUMNS:
            self.say(
                f"a second camera needs {LEAST_COLUMNS} columns, this terminal has {width}",
                theme.ACCENT,
            )
        self.draw()

    def action_play(self) -> None:
        """Play the window, or stop."""
        self.player.play()
        self.draw()

    def action_blink(self) -> None:
        """Alternate frame and reference in one place, or stop."""
        self.player.blink()
        self.draw()

    # Decisions

    def action_mark(self) -> None:
        """Mark the frame under the cursor and open the next task."""
        if self.player.plays:  # nobody can choose a frame while it plays
            self.player.stop()
            self.say("stopped; Enter again marks this frame", theme.ACCENT)
        elif self.scene is not None and self.view is not None:
            if unseen := self.query_one("#frame", PicturePane).trouble():
                self.say(f"not marked: {unseen}", theme.RED)
                return
            scene, view, camera = self.scene, self.view, camera_name(self.scene, self.aim.camera)
            self._decide(lambda: self.session.mark(scene, view, camera))
        elif self.scene is not None:
            self.say(self.scene.problem or "nothing to mark", theme.RED)

    def action_ask_flag(self) -> None:
        """Ask for the reason, then flag the expression."""

        def flag(reason: str | None) -> None:
            if reason is not None and self.scene is not None:
                scene = self.scene
                self._decide(lambda: self.session.flag(scene, reason))

        self.player.stop()
        self.app.push_screen(words.FlagDialog(), flag)

    def _decide(self, decide: Callable[[], Label]) -> None:
        """Save a decision, say so once it is on disk, and open the next task."""
        try:
            label = decide()
        except (Express50Error, OSError) as error:
            self.say(f"not saved: {error}", theme.RED)
            return
        before = None if self.scene is None else self.scene.in_force
        more = self.session.advance()
        self.open_task()
        done = "" if more else f"all {len(self.session.tasks)} done. q quits, p goes back. "
        self.say(done + words.saved(label, before))

    def action_undo(self) -> None:
        """Undo the last decision and show its task."""
        try:
            label = self.session.undo()
        except (Express50Error, OSError) as error:
            self.say(f"not undone: {error}", theme.RED)
            return
        if label is None:
            self.say("you have nothing to undo here", theme.ACCENT)
            return
        self.open_task()
        self.say(words.undone(label))

    def action_task(self, by: int) -> None:
        """Open the next or previous task."""
        if self.session.move(by) or not self.session.tasks:
            self.open_task()
        else:
            self.say(f"this is the {'last' if by > 0 else 'first'} task", theme.ACCENT)

    # Dialogs

    def action_ask_frame(self) -> None:
        """Ask for a frame's number, then go there."""

        def go_to(frame: int | None) -> None:
            if frame is not None:
                self.move(moves.go_to, frame)

        if self.view is not None:
            self.player.stop()
            self.app.push_screen(words.FrameDialog(self.view.first, self.view.last), go_to)

    def action_help(self) -> None:
        """Show every key."""
        self.player.stop()
        self.app.push_screen(words.HelpDialog())


class Player:
    """Plays the window or blinks the pictures of a desk, one at a time."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._timer: Timer | None = None
        self.plays = False
        self.blinks = False  # frame and reference take turns
        self.swapped = False  # the reference is shown in place of the frame

    def play(self) -> None:
        """Play from the cursor, or from the start if the cursor is at the end; or stop."""
        desk = self._desk
        if self.stop() or desk.view is None or desk.scene is None or desk.scene.index is None:
            return
        if desk.view.cursor == desk.view.last:
            desk.view = moves.go_to(desk.view, desk.view.first)
        rate = min(max(desk.scene.index.fps, SLOWEST), FASTEST)

        def next_frame() -> None:
            if desk.view is None or desk.view.cursor == desk.view.last:
                self.stop()
            else:
                desk.view = moves.step(desk.view, 1)
            desk.draw()

        self._timer = desk.set_interval(1.0 / rate, next_frame)
        self.plays = True

    def blink(self) -> None:
        """Alternate frame and reference in the frame's place, or stop."""
        if self.stop():
            return

        def swap() -> None:
            self.swapped = not self.swapped
            self._desk.draw()

        self._timer = self._desk.set_interval(BLINK_SECONDS, swap)
        self.blinks = self.swapped = True

    def stop(self) -> bool:
        """Stop whatever runs; return whether something did."""
        ran = self._timer is not None
        if self._timer is not None:
            self._timer.stop()
        self._timer = None
        self.plays = self.blinks = self.swapped = False
        return ran


class KeyDriver(LinuxDriver):
    """Passes over bytes that are not UTF-8, as some mice send, where Textual ends with an error."""

    def run_input_thread(self) -> None:
        """Read keys until the app ends."""
        while True:
            try:
                return super().run_input_thread()
            except UnicodeDecodeError:
                continue


class AnnotateApp(App[None]):
    """One session at the desk."""

    CSS = theme.SCREEN_STYLE
    TITLE = "express50 annotate"
    ENABLE_COMMAND_PALETTE = False

    def __init__(
        self, session: Session, *, faces: FaceFinder | None = None, sixel_cell: Size | None = None
    ) -> None:
        """Show pictures as sixels where the pixels of a terminal's cell are given."""
        super().__init__(driver_class=KeyDriver)
        self.session = session
        self.cache = FrameCache(session.dataset)
        self.desk = Desk(session, self.cache, faces, sixel_cell)

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Return the filters of drawn lines; Textual's own filter for NO_COLOR keeps greys."""
        return [theme.UNCOLOURED] if self.no_color else super().get_line_filters()

    def on_mount(self) -> None:
        """Show the desk; on SIGHUP, as when the connection closes, and SIGQUIT, end as by ``q``."""
        for number in (signal.SIGHUP, signal.SIGQUIT):
            if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores the first
                asyncio.get_running_loop().add_signal_handler(number, self.exit)
        # A full pass takes up to a second, since pictures are many objects; they make no cycles.
        gc.set_threshold(GARBAGE)
        self.push_screen(self.desk)

    def on_unmount(self) -> None:
        """Stop decoding."""
        self.cache.close()

    async def on_event(self, event: events.Event) -> None:
        """Count keys that are typed into dialogs."""
        typed = isinstance(event, events.Key) and not event.is_forwarded
        if typed and self.screen is not self.desk:
            self.session.press()
        await super().on_event(event)
