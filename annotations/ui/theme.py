"""Colours and keys of the annotator.

The colours hold on dark terminals with 256 colours too. Every key is listed once: the app binds the
keys, and the help shows them.
"""

from __future__ import annotations

from typing import NamedTuple

from rich.style import Style

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
IN_FORCE = Style(color=TEXT, bgcolor=GROUND)
PLATEAU = Style(color=BLUE, bgcolor=GROUND)
CURSOR = Style(bgcolor="#5e4012")
CURSOR_BAR = Style(color=ACCENT, bgcolor="#5e4012")


class KeyAction(NamedTuple):
    """Keys (Textual's names) of one action, how they are written for people, and what it does."""

    keys: str
    shown: str
    action: str
    words: str


MOVE = (
    KeyAction("left,comma,h", "← , h", "step(-1)", "one frame back"),
    KeyAction("right,full_stop,l", "→ . l", "step(1)", "one frame on"),
    KeyAction("shift+left,pageup,H,less_than_sign", "⇧← PgUp H", "step(-10)", "ten frames back"),
    KeyAction("shift+right,pagedown,L,greater_than_sign", "⇧→ PgDn L", "step(10)", "ten frames on"),
    KeyAction("home,0", "Home 0", "go_to('first')", "first frame of the cue window"),
    KeyAction("end,dollar_sign", "End $", "go_to('last')", "last frame of the cue window"),
    KeyAction("tab", "Tab", "candidate(1)", "next suggestion"),
    KeyAction("shift+tab", "⇧Tab", "candidate(-1)", "previous suggestion"),
    KeyAction("1,2,3,4,5", "1 … 5", "pick", "that suggestion, 1 the surest"),
    KeyAction("g", "g", "ask_frame", "go to a frame by number"),
)
DECIDE = (
    KeyAction("enter", "Enter", "mark", "mark this frame, open the next task"),
    KeyAction("left_square_bracket", "[", "plateau_first", "the plateau begins here"),
    KeyAction("right_square_bracket", "]", "plateau_last", "the plateau ends here"),
    KeyAction("f", "f", "ask_flag", "flag: no usable peak, with a reason"),
    KeyAction("u", "u", "undo", "take the last decision back"),
    KeyAction("n", "n", "task(1)", "next task, this one stays open"),
    KeyAction("p", "p", "task(-1)", "previous task"),
)
LOOK = (
    KeyAction("z", "z", "zoom(1)", "zoom: face, mouth, eyes, head, frame"),
    KeyAction("Z", "Z", "zoom(-1)", "zoom the other way"),
    KeyAction("c", "c", "camera(1)", "next camera, in both pictures"),
    KeyAction("C", "C", "camera(-1)", "previous camera"),
    KeyAction("b", "b", "blink", "blink: reference and frame in one place"),
    KeyAction("space", "Space", "play", "play the window, or stop"),
    KeyAction("question_mark,f1", "?", "help", "this help"),
    KeyAction("q", "q", "quit", "leave; every mark is already saved"),
)
GROUPS = {"Move": MOVE, "Decide": DECIDE, "FrameLook": LOOK}
HINTS = (
    ("←→", "frame"), ("⇧←→", "ten"), ("Tab", "suggestion"), ("Enter", "mark, next"),
    ("[ ]", "plateau"), ("f", "flag"), ("u", "undo"), ("n p", "task"), ("z", "zoom"),
    ("c", "camera"), ("b", "blink"), ("Space", "play"), ("g", "go to"), ("?", "help"),
    ("q", "quit"),
)  # fmt: skip
