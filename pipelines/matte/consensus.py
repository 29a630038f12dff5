"""Compare the mattes of one frame set, and find what each camera must remove and fill.

A camera removes what the other views rule out (moving shadows, things that only some cameras see).
It fills what the others see as solid but it could not separate from its background. A camera whose
matte disagrees with the others both where it is opaque and where it is clear is reported and
ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from express50.contract.stage import Note
from pipelines.matte.visual_hull import (
    INSIDE,
    MARGIN,
    MatteView,
    evidence_of,
    make_space,
    missed,
    ruled_out,
    subject_of,
    subject_place,
)

# Longest side of the pictures, and cells along each side of space: 192 and 96 take three times as
# long and gain next to nothing (docs/LOG.md, "Mattes").
SIDE, CELLS = 128, 64
FEWEST = 4  # views; of three, two with the same error would overrule a correct one
EMPTY, FULL = 0.003, 0.98  # shares of the image
# A matte is wrong as a whole if over STRAY of it lies off the others' subject and it lacks over
# LACKING of that subject, or if it lacks over MOST_LACKING.
STRAY, LACKING, MOST_LACKING = 0.03, 0.07, 0.3


@dataclass(frozen=True)
class Misfit:
    """Shares of a matte outside the others' hull, and of their solid subject that it lacks."""

    stray: float
    lacking: float

    @property
    def size(self) -> float:
        """Return the size of the error; over 1 the entire matte is wrong."""
        elsewhere = min(self.stray / STRAY, self.lacking / LACKING)
        return max(elsewhere, self.lacking / MOST_LACKING)

    @property
    def reason(self) -> str:
        """Describe the misfit for people."""
        return (
            f"its matte misses {self.lacking:.0%} of the subject that the other cameras see, and"
            f" {self.stray:.0%} of it lies outside; check whether the camera moved. The matte was"
            " not changed"
        )


@dataclass(frozen=True)
class Agreement:
    """The corrections that the views of one frame set make to each other.

    Attributes:
        removed, filled: (h, w) bool for each camera whose matte is corrected.
        warnings: cameras whose mattes were not changed, and why.
        unchanged: why nothing was compared; empty if mattes were compared.
    """

    removed: dict[str, np.ndarray] = field(default_factory=dict)
    filled: dict[str, np.ndarray] = field(default_factory=dict)
    warnings: list[Note] = field(default_factory=list)
    unchanged: str = ""


def compare_mattes(views: Sequence[MatteView], cells: int = CELLS) -> Agreement:
    """Compare the views of one frame set, on `cells` cells along each side of space."""
    doubted = {view.name: why for view in views if (why := _why_useless(view))}
    # Most of the others must be right; otherwise the wrong ones cannot be identified.
    most = len(doubted) + (len(views) - len(doubted)) // 3
    while True:
        used = [view for view in views if view.name not in doubted]
        if len(used) < FEWEST:
            few = f"{len(used)} usable cameras, expected {FEWEST} or more to overrule one"
            return Agreement(warnings=_named(doubted), unchanged=few)
        removed, filled, misfits = _compare(used, cells)
        worst = max(misfits, key=lambda name: misfits[name].size)
        if misfits[worst].size <= 1 or len(doubted) >= most:
            return Agreement(removed, filled, _named(doubted))
        doubted[worst] = misfits[worst].reason


def _named(doubted: dict[str, str]) -> list[Note]:
    return [Note(name, why) for name, why in sorted(doubted.items())]


def _why_useless(view: MatteView) -> str:
    """Return why a view cannot judge the other mattes; empty if it can."""
    if view.projection[2, 3] <= 1:  # depth of the ball's centre, in radii
        return "it stands inside what the others look at, or faces away; its matte was not changed"
    share = float((view.alpha[view.valid] > INSIDE).mean()) if view.valid.any() else 0.0
    if share < EMPTY:
        return f"its matte is empty ({share:.2%} of the image)"
    return f"its matte covers {share:.1%} of the image" if share > FULL else ""


def _compare(
    views: Sequence[MatteView], cells: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Misfit]]:
    """Return what to remove and to fill in each view, and how badly it fits the others."""
    longest = max(max(view.alpha.shape) for view in views)
    space = make_space(views, cells, max(1.5, MARGIN * longest))
    place = subject_place(space)
    found = {view.name: evidence_of(view, space, place) for view in views}
    subject = {view.name: subject_of(view, found[view.name]) for view in views}
    removed: dict[str, np.ndarray] = {}
    filled: dict[str, np.ndarray] = {}
    misfits: dict[str, Misfit] = {}
    for view in views:
        mine = found[view.name]
        bad = ruled_out(view, mine)
        spots, lacking = missed(view, mine, views, subject)
        opaque = view.alpha > INSIDE
        stray = float((opaque & ~mine.likely).sum()) / int(opaque.sum())
        misfits[view.name] = Misfit(stray, lacking)
        if bad.any():
            removed[view.name] = bad
        if spots.any():
            filled[view.name] = spots
    return removed, filled, misfits
