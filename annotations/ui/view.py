"""The annotator's position in one cue window: cursor, candidates and plateau, as pure functions.

Every function takes a view and returns another; none reads a file or knows of a screen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class CueView:
    """Position within one task.

    Attributes:
        first, last: the cue window, both inside.
        cursor: the frame that is shown.
        candidates: suggested frames, best first; empty where none is known or shown.
        candidate: which of them was visited last.
        plateau_first, plateau_last: ends of the plateau where they were set.
    """

    first: int
    last: int
    cursor: int
    candidates: tuple[int, ...] = ()
    candidate: int = 0
    plateau_first: int | None = None
    plateau_last: int | None = None

    def __post_init__(self) -> None:
        """Refuse a cursor outside the window."""
        if not self.first <= self.cursor <= self.last:
            raise ValueError(f"cursor {self.cursor} lies outside {self.first} to {self.last}")


def open_view(
    first: int, last: int, candidates: tuple[int, ...] = (), cursor: int | None = None
) -> CueView:
    """A fresh view: on the given frame, else on the best candidate, else in the window's middle."""
    inside = tuple(dict.fromkeys(c for c in candidates if first <= c <= last))
    if cursor is None or not first <= cursor <= last:
        cursor = inside[0] if inside else (first + last) // 2
    return CueView(first=first, last=last, cursor=cursor, candidates=inside)


def go_to(view: CueView, frame: int) -> CueView:
    """Move to a frame; the window's ends stop the cursor, it never wraps."""
    return replace(view, cursor=min(max(frame, view.first), view.last))


def step(view: CueView, by: int) -> CueView:
    """Move by some frames."""
    return go_to(view, view.cursor + by)


def next_candidate(view: CueView, by: int) -> CueView:
    """Move to the next (1) or previous (-1) candidate, round and round."""
    if not view.candidates:
        return view
    # Away from every candidate the first press returns to the one visited last.
    away = view.cursor not in view.candidates
    here = view.candidate if away else view.candidates.index(view.cursor)
    return pick_candidate(view, here if away and by > 0 else (here + by) % len(view.candidates))


def pick_candidate(view: CueView, number: int) -> CueView:
    """Move to a candidate by its rank, 0 the best; where there is none the view stays."""
    if not 0 <= number < len(view.candidates):
        return view
    return replace(go_to(view, view.candidates[number]), candidate=number)


def set_plateau_first(view: CueView) -> CueView:
    """The plateau begins here; the same key on the same frame takes it back."""
    if view.plateau_first == view.cursor:
        return replace(view, plateau_first=None)
    last = view.plateau_last
    keep = last is None or last >= view.cursor
    return replace(view, plateau_first=view.cursor, plateau_last=last if keep else None)


def set_plateau_last(view: CueView) -> CueView:
    """The plateau ends here; the same key on the same frame takes it back."""
    if view.plateau_last == view.cursor:
        return replace(view, plateau_last=None)
    first = view.plateau_first
    keep = first is None or first <= view.cursor
    return replace(view, plateau_last=view.cursor, plateau_first=first if keep else None)


def plateau_problem(view: CueView) -> str | None:
    """Say why the cursor cannot be marked with this plateau; None when it can."""
    low = view.first if view.plateau_first is None else view.plateau_first
    high = view.last if view.plateau_last is None else view.plateau_last
    if low <= view.cursor <= high:
        return None
    return f"frame {view.cursor} lies outside your plateau {low} to {high}: move into it"
