"""Draw small plots as inline SVG."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

import matplotlib as mpl
from markupsafe import Markup

from express50.errors import FormatError
from express50.files.text import parse_json, read_text

mpl.use("Agg")
from matplotlib.figure import Figure  # noqa: E402  the backend is chosen first

_INK = "#2457a6"
_PANELS = 4


def _svg(figure: Figure) -> Markup:
    """Draw inline SVG with a fixed id salt, so that the same data give the same page."""
    with mpl.rc_context({"svg.hashsalt": "express50"}):
        out = io.StringIO()
        figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = out.getvalue()
    return Markup(text[text.index("<svg") :])  # our own drawing, no user text


def timing_bars(seconds: dict[str, float]) -> Markup:
    """Draw horizontal bars of the seconds of each step."""
    figure = Figure(figsize=(9, 0.3 * len(seconds) + 0.6))
    axes = figure.add_subplot()
    names = list(seconds)
    bars = axes.barh(names, [seconds[n] for n in names], color=_INK)
    axes.bar_label(bars, fmt="%.0f s", padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("seconds")
    return _svg(figure)


def metric_bars(figures: dict[str, dict[str, float]], columns: list[str]) -> Markup:
    """Draw one panel per metric: its value over the items."""
    varying = [c for c in columns if len({row.get(c) for row in figures.values()}) > 1][:_PANELS]
    if not varying:
        return Markup("")
    figure = Figure(figsize=(2.9 * len(varying), 1.8))
    figure.subplots(1, len(varying))
    for axes, column in zip(figure.axes, varying, strict=True):
        values = [row[column] for row in figures.values() if column in row]
        axes.bar(range(len(values)), values, color=_INK)
        axes.set_title(column.replace("_", " "), fontsize=9)
        axes.tick_params(labelsize=7)
        axes.set_xticks([])
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return _svg(figure)


def loss_curve(log: Path) -> Markup:
    """Plot the training losses of a JSONL log with ``iteration`` and numbers; empty without one."""
    if not log.is_file():
        return Markup("")
    text = read_text(log, FormatError)
    rows = []
    for line in text.split("\n"):
        with suppress(FormatError):  # half a line of a run that was killed
            row = parse_json(line, str(log), FormatError)
            if isinstance(row, dict) and {"iteration", "loss"} <= row.keys():
                rows.append(row)
    if len(rows) < 2:
        return Markup("")
    figure = Figure(figsize=(9, 2.6))
    axes = figure.add_subplot()
    axes.plot([r["iteration"] for r in rows], [r["loss"] for r in rows], color=_INK, lw=1.2)
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss")
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)
