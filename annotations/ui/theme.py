"""Define the colours, layout and keys of the annotator.

The colours hold on dark terminals with 256 colours too. Every key is listed once: the app acts on
the keys, and the help shows them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from rich.segment import Segment
from rich.style import Style
from textual.color import Color
from textual.filter import LineFilter

GROUND = "#101318"
PANEL = "#181c23"
TEXT = "#d6dae2"
FAINT = "#808998"
ACCENT = "#ffb454"
GREEN = "#8fd460"
BLUE = "#5cc0ff"
VIOLET = "#c79bf2"
TEAL = "#3fa7a0"
RED = "#ff7a70"

PLAIN = Style(color=TEXT, bgcolor=GROUND)
DIM = Style(color=FAINT, bgcolor=GROUND)
ACTIVITY = Style(color=TEAL, bgcolor=GROUND)
MATCH = Style(color=VIOLET, bgcolor=GROUND)
BEST = Style(color=GREEN, bgcolor=GROUND, bold=True, reverse=True)
CANDIDATE = Style(color=GREEN, bgcolor=GROUND)
MINE = Style(color=BLUE, bgcolor=GROUND, bold=True)
PLATEAU = Style(color=BLUE, bgcolor=GROUND)
CURSOR = Style(bgcolor="#5e4012")
CURSOR_BAR = Style(color=ACCENT, bgcolor="#5e4012")


class Uncoloured(LineFilter):
    """Removes colours, for NO_COLOR; text highlighted by its background is shown in reverse."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Return segments without colours."""
        del background
        return [Segment(text, s and _uncoloured(s), control) for text, s, control in segments]


UNCOLOURED = Uncoloured()


@lru_cache(1024)
def _uncoloured(style: Style) -> Style:
    ground = style.bgcolor.get_truecolor().hex if style.bgcolor is not None else GROUND
    stands_out = bool(style.reverse) or ground not in (GROUND, PANEL)
    return Style(bold=style.bold, underline=style.underline, reverse=stands_out)


SCREEN_STYLE = f"""
Screen {{ background: {GROUND}; color: {TEXT}; layout: vertical; }}
#status, #words, #message, .title {{
    height: 1; width: 100%; text-wrap: nowrap; text-overflow: ellipsis;
}}
#status, #message {{ background: {PANEL}; }}
.title {{ background: {GROUND}; }}
#panes {{ height: 1fr; }}
.pane {{ width: 1fr; height: 100%; }}
#middle, #right {{ margin-left: 1; }}
#frame, #second, #reference {{ width: 100%; height: 1fr; }}
#strip {{ width: 100%; height: 5; }}
ModalScreen {{ align: center middle; background: {GROUND} 0%; }}
.dialog {{
    width: auto; min-width: 40; max-width: 100%; height: auto; max-height: 100%; padding: 0 2;
    background: {PANEL}; border: round {ACCENT}; overflow-y: auto;
    border-title-color: {ACCENT}; border-subtitle-color: {FAINT};
}}
.dialog Static {{ width: auto; height: auto; }}
.help {{ width: 108; }}
.help Static {{ width: 100%; }}
.help.wide {{ layout: horizontal; }}
.help.wide Static {{ width: 1fr; }}
.dialog Input {{ width: 44; height: 3; border: round {FAINT}; background: {PANEL}; }}
"""


FAR = 10**9  # frames: beyond any window, whose ends stop the cursor


class KeyAction(NamedTuple):
    """The keys of one action."""

    keys: str  # Textual's names
    shown: str  # how they are written for people
    action: str  # ``{key}`` is replaced by the key's name
    words: str  # what it does


MOVE = (
    KeyAction("left,comma,h", "← , h", "move('step', -1)", "one frame back"),
    KeyAction("right,full_stop,l", "→ . l", "move('step', 1)", "one frame forward"),
    KeyAction(
        "shift+left,pageup,H,less_than_sign", "⇧← PgUp H", "move('step', -10)", "ten frames back"
    ),
    KeyAction(
        "shift+right,pagedown,L,greater_than_sign",
        "⇧→ PgDn L",
        "move('step', 10)",
        "ten frames forward",
    ),
    KeyAction("home,0", "Home 0", f"move('step', -{FAR})", "first frame of the cue window"),
    KeyAction("end,dollar_sign", "End $", f"move('step', {FAR})", "last frame of the cue window"),
    KeyAction("tab", "Tab", "candidate(1)", "next suggestion"),
    KeyAction("shift+tab", "⇧Tab", "candidate(-1)", "previous suggestion"),
    KeyAction(
        "1,2,3,4,5", "1 … 5", "move('pick_candidate', {key})", "go to a suggestion, 1 is the surest"
    ),
    KeyAction("g", "g", "ask_frame", "go to a frame by number"),
)
DECIDE = (
    KeyAction("enter", "Enter", "mark", "mark this frame, open the next task"),
    KeyAction("left_square_bracket", "[", "move('set_plateau', 0)", "the plateau begins here"),
    KeyAction("right_square_bracket", "]", "move('set_plateau', 1)", "the plateau ends here"),
    KeyAction("f", "f", "ask_flag", "flag: no usable peak, with a reason"),
    KeyAction("u", "u", "undo", "undo the last decision"),
    KeyAction("n", "n", "task(1)", "next task; this one stays open"),
    KeyAction("p", "p", "task(-1)", "previous task"),
)
LOOK = (
    KeyAction("z", "z", "zoom(1)", "zoom: face, mouth, eyes, head, frame"),
    KeyAction("Z", "Z", "zoom(-1)", "zoom the other way"),
    KeyAction("c", "c", "camera(1)", "next camera, in both pictures"),
    KeyAction("C", "C", "camera(-1)", "previous camera"),
    KeyAction("s", "s", "second", "second camera at this moment, on or off"),
    KeyAction("S", "S", "next_second", "another second camera"),
    KeyAction("b", "b", "blink", "blink: reference and frame in one place"),
    KeyAction("space", "Space", "play", "play the window, or stop"),
    KeyAction("question_mark,f1", "?", "help", "this help"),
    KeyAction("ctrl+z", "Ctrl-Z", "app.suspend_process", "suspend; fg resumes"),
    KeyAction("q,ctrl+c", "q Ctrl-C", "app.quit", "quit; every mark is already saved"),
)
GROUPS = (MOVE, DECIDE, LOOK)
HINTS = (
    ("←→", "frame"), ("Enter", "mark"), ("⇧←→", "ten"), ("Tab", "suggestion"),
    ("[ ]", "plateau"), ("f", "flag"), ("u", "undo"), ("n p", "task"), ("z", "zoom"),
    ("c", "camera"), ("s", "second camera"), ("b", "blink"), ("Space", "play"), ("g", "go to"),
    ("?", "help"), ("q", "quit"),
)  # fmt: skip
