"""Who the subjects are, counted: gender and age as far as captures say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

AGE_BANDS = ((0, 17), (18, 29), (30, 44), (45, 59), (60, 200))


def gender_counts(metas: Sequence[Mapping]) -> dict[str, int]:
    """How many subjects of each gender, in the captures' own words."""
    return dict(sorted(Counter(str(m.get("gender", "not given")) for m in metas).items()))


def age_counts(metas: Sequence[Mapping]) -> dict[str, int]:
    """How many subjects in each band of years."""
    counts = Counter(_band(m.get("age")) for m in metas)
    names = [*(_name(band) for band in AGE_BANDS), "not given"]
    return {name: counts[name] for name in names if counts[name]}


def _band(age: object) -> str:
    if isinstance(age, bool) or not isinstance(age, int | float):
        return "not given"
    return next((_name(b) for b in AGE_BANDS if b[0] <= age < b[1] + 1), "not given")


def _name(band: tuple[int, int]) -> str:
    return f"{band[0]}-{band[1]}" if band[1] < 200 else f"{band[0]}+"
