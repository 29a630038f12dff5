"""Every key of the annotator, once: the app binds them, the help and the README list them."""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """Keys (Textual's names) of one action, how they are written for people, and what it does."""

    keys: str
    shown: str
    action: str
    words: str


MOVE = (
    Key("left,comma,h", "← , h", "step(-1)", "one frame back"),
    Key("right,full_stop,l", "→ . l", "step(1)", "one frame on"),
    Key("shift+left,pageup,H,less_than_sign", "⇧← PgUp H", "step(-10)", "ten frames back"),
    Key("shift+right,pagedown,L,greater_than_sign", "⇧→ PgDn L", "step(10)", "ten frames on"),
    Key("home,0", "Home 0", "go_to('first')", "first frame of the cue window"),
    Key("end,dollar_sign", "End $", "go_to('last')", "last frame of the cue window"),
    Key("tab", "Tab", "candidate(1)", "next suggestion"),
    Key("shift+tab", "⇧Tab", "candidate(-1)", "previous suggestion"),
    Key("1,2,3,4,5", "1 … 5", "pick", "that suggestion, 1 the surest"),
    Key("g", "g", "ask_frame", "go to a frame by number"),
)
DECIDE = (
    Key("enter", "Enter", "mark", "mark this frame, open the next task"),
    Key("left_square_bracket", "[", "plateau_first", "the plateau begins here"),
    Key("right_square_bracket", "]", "plateau_last", "the plateau ends here"),
    Key("f", "f", "ask_flag", "flag: no usable peak, with a reason"),
    Key("u", "u", "undo", "take the last decision back"),
    Key("n", "n", "task(1)", "next task, this one stays open"),
    Key("p", "p", "task(-1)", "previous task"),
)
LOOK = (
    Key("z", "z", "zoom(1)", "zoom: face, mouth, eyes, head, frame"),
    Key("Z", "Z", "zoom(-1)", "zoom the other way"),
    Key("c", "c", "camera(1)", "next camera, in both pictures"),
    Key("C", "C", "camera(-1)", "previous camera"),
    Key("b", "b", "blink", "blink: reference and frame in one place"),
    Key("space", "Space", "play", "play the window, or stop"),
    Key("question_mark,f1", "?", "help", "this help"),
    Key("q", "q", "quit", "leave; every mark is already saved"),
)
GROUPS = {"Move": MOVE, "Decide": DECIDE, "Look": LOOK}
HINTS = (
    ("←→", "frame"), ("⇧←→", "ten"), ("Tab", "suggestion"), ("Enter", "mark, next"),
    ("[ ]", "plateau"), ("f", "flag"), ("u", "undo"), ("n p", "task"), ("z", "zoom"),
    ("c", "camera"), ("b", "blink"), ("Space", "play"), ("g", "go to"), ("?", "help"),
    ("q", "quit"),
)  # fmt: skip
