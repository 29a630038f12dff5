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
    counts = Counter(_band(_age(m)) for m in metas)
    names = [*(_name(band) for band in AGE_BANDS), "not given"]
    return {name: counts[name] for name in names if counts[name]}


def age_summary(metas: Sequence[Mapping]) -> dict[str, float] | None:
    """``people`` whose age is given, and the ``youngest``, ``oldest`` and ``mean`` in years.

    None where no age is given.
    """
    ages = [age for m in metas if (age := _age(m)) is not None]
    if not ages:
        return None
    mean = round(sum(ages) / len(ages), 1)
    return {"people": len(ages), "youngest": min(ages), "oldest": max(ages), "mean": mean}


def _age(meta: Mapping) -> float | None:
    """Years, or None where they are not given or no person's."""
    age = meta.get("age")
    if isinstance(age, bool) or not isinstance(age, int | float):
        return None
    return age if AGE_BANDS[0][0] <= age < AGE_BANDS[-1][1] + 1 else None


def _band(age: float | None) -> str:
    if age is None:
        return "not given"
    return next(_name(b) for b in AGE_BANDS if b[0] <= age < b[1] + 1)


def _name(band: tuple[int, int]) -> str:
    return f"{band[0]}-{band[1]}" if band[1] < 200 else f"{band[0]}+"
