"""Colours of the annotator; chosen to hold on dark terminals with 256 colours too."""

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
