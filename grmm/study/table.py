"""The paper's table of a user study, with confidence intervals.

Judgments of one participant are alike, and so are those of one example, so shares get a bootstrap
interval that draws whole participants with replacement (the cluster bootstrap; Field and Welsh
2007). With one participant there is nothing to draw, and no interval.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grmm.study.design import method_of

DRAWS = 2000
LEVEL = 0.95
COLUMNS = ("first++", "first+", "second++", "second+", "tie")


def judgments(study: dict, answers: Sequence[dict]) -> list[tuple[int, str, str]]:
    """(participant, question, column) of every answer, with sides turned back into methods."""
    first = study["methods"][0]
    found = []
    for answer in answers:
        text = answer["answer"]
        if text == "=":
            column = "tie"
        else:
            method = method_of(study, answer["participant"], answer["example"], text[0])
            column = ("first" if method == first else "second") + text[1:]
        found.append((answer["participant"], answer["question"], column))
    return found


def summarise(study: dict, answers: Sequence[dict], seed: int = 0) -> dict:
    """Percentages a question and overall, each with its interval, and how many answered."""
    found = judgments(study, answers)
    rows = {
        question: _row([f for f in found if f[1] == question], seed)
        for question in study["questions"]
    }
    rows["overall"] = _row(found, seed)
    people = sorted({participant for participant, _, _ in found})
    return {
        "methods": study["methods"],
        "rows": rows,
        "judgments": len(found),
        "participants": len(people),
        "judgments_expected": (
            study["participants"] * len(study["examples"]) * len(study["questions"])
        ),
        "interval": f"{LEVEL:.0%}, bootstrap over participants, {DRAWS} draws",
    }


def _row(found: Sequence[tuple[int, str, str]], seed: int) -> dict:
    """Percent of every column and of each method's two together, with intervals."""
    people = sorted({participant for participant, _, _ in found})
    counts = np.zeros((len(people), len(COLUMNS)))
    for participant, _, column in found:
        counts[people.index(participant), COLUMNS.index(column)] += 1
    sums = {"first": (0, 1), "second": (2, 3)}
    row: dict[str, object] = {"judgments": len(found)}
    rng = np.random.default_rng(seed)
    drawn = None
    if len(people) > 1:
        drawn = counts[rng.integers(len(people), size=(DRAWS, len(people)))].sum(1)
    for name, places in {**{c: (i,) for i, c in enumerate(COLUMNS)}, **sums}.items():
        row[name] = _share(counts.sum(0)[None], places, None)
        row[f"{name}_interval"] = _share(drawn, places, LEVEL)
    return row


def _share(counts: np.ndarray | None, places: tuple[int, ...], level: float | None) -> object:
    """Percent of some columns; of many draws the interval that holds ``level`` of them."""
    if counts is None or not counts.sum():
        return None
    shares = 100 * counts[:, places].sum(1) / counts.sum(1)
    if level is None:
        return round(float(shares[0]), 2)
    tail = 50 * (1 - level)
    low, high = np.percentile(shares, [tail, 100 - tail])
    return [round(float(low), 2), round(float(high), 2)]


def markdown(summary: dict) -> str:
    """The table as the paper prints it, shares in percent, intervals below the preferences."""
    first, second = summary["methods"]
    lines = [
        ["Type", f"{first} ++", f"{first} +", f"{second} ++", f"{second} +", "Tie", first, second],
        ["---"] * 8,
    ]
    for name, row in summary["rows"].items():
        cells = [_percent(row[column]) for column in COLUMNS]
        sums = [_percent(row[m], row[f"{m}_interval"]) for m in ("first", "second")]
        lines.append([name.capitalize(), *cells, *sums])
    table = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return table + (
        f"\n{summary['judgments']} of {summary['judgments_expected']} judgments by "
        f"{summary['participants']} participants; in brackets: {summary['interval']}.\n"
    )


def _percent(value: float | None, interval: Sequence[float] | None = None) -> str:
    if value is None:
        return "n/a"
    text = f"{value:.1f}%"
    return text if interval is None else f"{text} ({interval[0]:.1f} to {interval[1]:.1f})"
