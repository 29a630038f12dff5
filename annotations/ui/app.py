"""The annotator as a Textual app: keys become moves, looks and decisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from textual import events, work
from textual.app import App
from textual.binding import Binding

from annotations.labels import Label
from annotations.ui import panels, theme
from annotations.ui import task as moves
from annotations.ui.dialogs import FlagDialog, FrameDialog, HelpDialog
from annotations.ui.frames import ZOOMS, FaceFinder, FrameCache, FrameCrop
from annotations.ui.images import CellSize, PaneShape, SixelPainter
from annotations.ui.layout import AnnotatorScreen
from annotations.ui.picture import PicturePane, camera_name, shots_ahead
from annotations.ui.session import Session
from annotations.ui.task import CueView, TaskScene, load_scene
from annotations.ui.theme import GROUPS
from annotations.ui.timeline import CurveStrip
from annotations.worklist import LabelTask
from express50.errors import Express50Error

TASKS_AHEAD, FRAMES_AHEAD = 2, 12  # pictures that are made before their task is opened


def open_view_of(scene: TaskScene, hidden: bool) -> CueView | None:
    """Open a task on the annotator's own mark, else on the suggestion, else in the middle."""
    if scene.index is None:
        return None
    mine = scene.mine
    candidates = () if hidden else scene.candidates
    cursor = None if mine is None else mine.frame
    view = moves.open_view(scene.first, scene.last, candidates, cursor)
    if mine is not None:
        view = replace(view, plateau_first=mine.first, plateau_last=mine.last)
    return view


class Desk(AnnotatorScreen):
    """Turns keys into moves (view), looks (aim) and decisions (session)."""

    BINDINGS = [
        Binding(
            keys, f"pick({keys})" if key.action == "pick" else key.action, key.words, show=False
        )
        for group in GROUPS.values()
        for key in group
        for keys in (key.keys.split(",") if key.action == "pick" else [key.keys])
    ]

    def on_mount(self) -> None:
        """Open the first task; look for faces once the network is there."""
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

    def open_task(self) -> None:
        """Show the session's open task."""
        self.player.stop()
        task = self.session.task
        if task is None:
            self.say("nothing to label: no expression fits, or nothing is ingested", theme.RED)
            return
        self.scene = scene = load_scene(self.session.dataset, task, self.session.annotator)
        if scene.suggestion is not None:  # else the camera that was chosen last stays
            self.aim = self.aim._replace(camera=0)
        self.view = open_view_of(scene, self.session.hidden(task))
        self.draw()
        if scene.problem or scene.notes:
            self.say(scene.problem or " · ".join(scene.notes), theme.ACCENT)
        ahead = [self.session.tasks[n] for n in self.session.following(TASKS_AHEAD)]
        self._prepare(ahead, self.query_one("#frame", PicturePane).shape)

    @work(thread=True, exclusive=True, group="ahead")
    def _prepare(self, tasks: list[LabelTask], shape: PaneShape) -> None:
        """Read the next tasks, find their faces and ask for their pictures."""
        shots: list[FrameCrop] = []
        for task in tasks:
            scene = load_scene(self.session.dataset, task, self.session.annotator)
            view = open_view_of(scene, self.session.hidden(task))
            if view is not None:
                shots += shots_ahead(scene, view, self.aim, shape, FRAMES_AHEAD)
        self.cache.want(shots, later=True)

    # Moves and looks

    def _move(self, how: Callable[[CueView], CueView]) -> None:
        self.player.stop()
        if self.view is not None:
            self.view = how(self.view)
        self.draw()

    def action_step(self, by: int) -> None:
        """Step some frames on or back."""
        self._move(lambda view: moves.step(view, by))

    def action_go_to(self, where: str) -> None:
        """Go to an end of the cue window."""
        self._move(lambda view: moves.go_to(view, getattr(view, where)))

    def action_candidate(self, by: int) -> None:
        """Go to the next or previous suggestion."""
        self._move(lambda view: moves.next_candidate(view, by))
        if self.view is not None and not self.view.candidates:
            hidden = self.scene is not None and self.session.hidden(self.scene.task)
            self.say("hidden until you have decided" if hidden else "no suggestion", theme.ACCENT)

    def action_pick(self, number: int) -> None:
        """Go to a suggestion by its rank."""
        self._move(lambda view: moves.pick_candidate(view, number - 1))

    def action_plateau_first(self) -> None:
        """Begin the plateau at the cursor."""
        self._move(moves.set_plateau_first)

    def action_plateau_last(self) -> None:
        """End the plateau at the cursor."""
        self._move(moves.set_plateau_last)

    def on_curve_strip_picked(self, message: CurveStrip.Picked) -> None:
        """Go to the frame that was clicked on the strip."""
        self._move(lambda view: moves.go_to(view, message.frame))

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

    def action_play(self) -> None:
        """Play the window, or stop."""
        self.player.play()
        self.draw()

    def action_blink(self) -> None:
        """Show frame and reference in turns in one place, or stop."""
        self.player.blink()
        self.draw()

    # Decisions

    def action_mark(self) -> None:
        """Mark the frame under the cursor and open the next task."""
        if self.player.plays:  # a moving frame cannot be meant
            self.player.stop()
            self.say("stopped; Enter again marks this frame", theme.ACCENT)
        elif self.scene is not None and self.view is not None:
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
        self.app.push_screen(FlagDialog(), flag)

    def _decide(self, decide: Callable[[], Label]) -> None:
        """Save a decision, say so once it is on disk, and open the next task."""
        try:
            label = decide()
        except (Express50Error, OSError) as error:
            self.say(f"not saved: {error}", theme.RED)
            return
        words = panels.saved_words(label)
        if self.session.advance():
            self.open_task()
            self.say(words)
        else:
            self.open_task()
            self.say(f"all {len(self.session.tasks)} done. q leaves, p looks back. {words}")

    def action_undo(self) -> None:
        """Take the last decision back and show its task."""
        try:
            task = self.session.undo()
        except (Express50Error, OSError) as error:
            self.say(f"not undone: {error}", theme.RED)
            return
        if task is None:
            self.say("nothing of yours to take back here", theme.ACCENT)
            return
        self.open_task()
        self.say(f"taken back: {task.subject} {task.expression}")

    def action_task(self, by: int) -> None:
        """Open a neighbouring task."""
        if self.session.move(by) or not self.session.tasks:
            self.open_task()
        else:
            self.say(f"this is the {'last' if by > 0 else 'first'} task", theme.ACCENT)

    # Dialogs

    def action_ask_frame(self) -> None:
        """Ask for a frame's number, then go there."""

        def go_to(frame: int | None) -> None:
            if frame is not None:
                self._move(lambda view: moves.go_to(view, frame))

        if self.view is not None:
            self.player.stop()
            self.app.push_screen(FrameDialog(self.view.first, self.view.last), go_to)

    def action_help(self) -> None:
        """Show every key."""
        self.player.stop()
        self.app.push_screen(HelpDialog())

    def action_quit(self) -> None:
        """Leave; every decision is on disk already."""
        self.app.exit()


_STYLE = f"""
Screen {{ background: {theme.GROUND}; color: {theme.TEXT}; layout: vertical; }}
#status, #words, #message, .title {{ height: 1; width: 100%; }}
#status, #message {{ background: {theme.PANEL}; }}
.title {{ background: {theme.GROUND}; }}
#panes {{ height: 1fr; }}
.pane {{ width: 1fr; height: 100%; }}
#right {{ margin-left: 1; }}
#frame, #reference {{ width: 100%; height: 1fr; }}
#strip {{ width: 100%; height: 5; }}
ModalScreen {{ align: center middle; background: {theme.GROUND} 60%; }}
.dialog {{
    width: auto; min-width: 40; max-width: 100%; height: auto; max-height: 100%; padding: 0 2;
    background: {theme.PANEL}; border: round {theme.ACCENT}; overflow-y: auto;
    border-title-color: {theme.ACCENT}; border-subtitle-color: {theme.FAINT};
}}
.dialog Static {{ width: auto; height: auto; }}
.help {{ width: 108; }}
.help Static {{ width: 100%; }}
.dialog Input {{ width: 44; height: 3; border: round {theme.FAINT}; background: {theme.PANEL}; }}
"""


class AnnotateApp(App[None]):
    """One session at the desk."""

    CSS = _STYLE
    TITLE = "express50 annotate"
    ENABLE_COMMAND_PALETTE = False

    def __init__(
        self,
        session: Session,
        *,
        faces: FaceFinder | None = None,
        sixel_cell: CellSize | None = None,
    ) -> None:
        """Show pictures as sixels where the pixels of a terminal's cell are given."""
        super().__init__()
        self.session = session
        self.cache = FrameCache(session.dataset)
        self._faces = faces
        self._sixel_cell = sixel_cell

    @property
    def desk(self) -> Desk:
        """The screen below any dialog."""
        return next(screen for screen in self.screen_stack if isinstance(screen, Desk))

    def on_mount(self) -> None:
        """Show the desk."""

        def make_picture(cache: FrameCache, name: str) -> PicturePane:
            painter = None if self._sixel_cell is None else SixelPainter(self._sixel_cell)
            return PicturePane(cache, name, painter)

        self.push_screen(Desk(self.session, self.cache, self._faces, make_picture))

    def on_unmount(self) -> None:
        """Stop decoding."""
        self.cache.close()

    async def on_event(self, event: events.Event) -> None:
        """Count keys before they act, also those typed into dialogs."""
        if isinstance(event, events.Key) and not event.is_forwarded:
            self.session.press()
        await super().on_event(event)
