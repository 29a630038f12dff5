"""The annotator as a Textual app: colours, the desk, and the count of keys."""

from __future__ import annotations

from textual import events
from textual.app import App

from annotations.ui import theme
from annotations.ui.desk import Desk
from annotations.ui.faces import FaceFinder
from annotations.ui.frames import FrameCache
from annotations.ui.painters import make_painter, picture_numbers
from annotations.ui.picture import Picture
from annotations.ui.session import Session
from annotations.ui.terminal import CellSize

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
        pictures: str = "blocks",
        cell: CellSize | None = None,
    ) -> None:
        super().__init__()
        self.session = session
        self.cache = FrameCache(session.dataset)
        self._faces = faces
        self._pictures = pictures
        self._cell = cell
        self._numbers = picture_numbers()

    def _make_picture(self, cache: FrameCache, name: str) -> Picture:
        """The widget that shows pictures as the terminal can."""
        painter = make_painter(self._pictures, self.write_raw, self._numbers, self._cell)
        return Picture(cache, name, painter)

    def write_raw(self, data: str) -> None:
        """Write to the terminal past Textual's drawing, but in order with it."""
        if self._driver is not None:
            self._driver.write(data)

    @property
    def desk(self) -> Desk:
        """The screen below any dialog."""
        return next(screen for screen in self.screen_stack if isinstance(screen, Desk))

    def on_mount(self) -> None:
        """Show the desk."""
        self.push_screen(Desk(self.session, self.cache, self._faces, self._make_picture))

    def on_unmount(self) -> None:
        """Stop decoding."""
        self.cache.close()

    async def on_event(self, event: events.Event) -> None:
        """Count keys before they act, also those typed into dialogs."""
        if isinstance(event, events.Key) and not event.is_forwarded:
            self.session.press()
        await super().on_event(event)
