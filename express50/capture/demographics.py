"""Count the subjects by gender and age, where captures state them.

What a capture says about a person stays in the capture. A dataset copies only `PUBLIC_KEYS` from
its capture.toml; gender and age are read from the capture when they are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from express50.files.text import is_number

AGE_BANDS = ((0, 17), (18, 29), (30, 44), (45, 59), (60, 200))
# Smaller counts could identify people, such as the only woman, or the only person aged 71.
LEAST_PEOPLE = 5
OTHERS = "others or not given"
PUBLIC_KEYS = frozenset(
    {
        "subject", "fps", "session", "units", "color_space", "metres_per_unit", "synthetic",
        "consent_id", "consent", "licence", "license",
        "camera_model", "rig", "same_lens", "focal_px", "focal_source", "focal_range_px",
        "layout", "sequences", "cameras", "expressions", "renderme360",
    }
)  # fmt: skip


def public_meta(meta: Mapping) -> dict:
    """Return the part of a capture.toml that a dataset may keep: nothing about the person."""
    return {key: value for key, value in meta.items() if key in PUBLIC_KEYS}


def shown_counts(counts: Mapping[str, int]) -> dict[str, int]:
    """Keep counts of at least LEAST_PEOPLE; count smaller groups under OTHERS.

    The smallest groups join OTHERS until it is large enough too, since a single small group could
    be inferred from the total. Empty if no group is large enough.
    """
    left = sorted((n, name) for name, n in counts.items() if name != "not given")
    others = counts.get("not given", 0)
    while left and (left[0][0] < LEAST_PEOPLE or 0 < others < LEAST_PEOPLE):
        others += left.pop(0)[0]
    if not left:
        return {}
    shown = {name: n for name, n in counts.items() if (n, name) in left}
    return shown | ({OTHERS: others} if others else {})


def gender_counts(metas: Sequence[Mapping]) -> dict[str, int]:
    """Count the subjects of each gender, in the captures' own words."""
    return dict(sorted(Counter(str(m.get("gender", "not given")) for m in metas).items()))


def age_counts(metas: Sequence[Mapping]) -> dict[str, int]:
    """Count the subjects in each age band."""
    ages = [_age(m) for m in metas]
    counts = {}
    for low, high in AGE_BANDS:
        name = f"{low}-{high}" if high < 200 else f"{low}+"
        counts[name] = sum(age is not None and low <= age < high + 1 for age in ages)
    counts["not given"] = ages.count(None)
    return {name: count for name, count in counts.items() if count}


def mean_age(metas: Sequence[Mapping], least: int = LEAST_PEOPLE) -> tuple[float, int] | None:
    """Compute the mean age in years and the number of people; None for fewer than ``least``."""
    ages = [age for m in metas if (age := _age(m)) is not None]
    return (round(sum(ages) / len(ages), 1), len(ages)) if len(ages) >= least else None


def _age(meta: Mapping) -> float | None:
    age = meta.get("age")
    known = is_number(age) and AGE_BANDS[0][0] <= age < AGE_BANDS[-1][1] + 1
    return age if known else None


def people_lines(people: Sequence[Mapping]) -> list[str]:
    """Count gender and age of the subjects in tables, if enough captures state them."""
    lines = []
    if genders := shown_counts(gender_counts(people)):
        lines += _count_table("gender", genders)
    if mean := mean_age(people):
        lines += [f"Age: {mean[0]:g} years in the mean of {mean[1]} people.", ""]
    if ages := shown_counts(age_counts(people)):
        lines += _count_table("age", ages)
    few = f"No figures: gender and age are shown only for groups of {LEAST_PEOPLE} people or more."
    return lines[:-1] or [few]


def _count_table(name: str, counts: Mapping[str, int]) -> list[str]:
    scale = min(1.0, 40 / max(counts.values()))
    rows = [
        f"| {' '.join(value.replace('|', '/').split())} | {count} | {'█' * round(count * scale)} |"
        for value, count in counts.items()
    ]
    return [f"| {name} | subjects | |", "|---|---|---|", *rows, ""]
