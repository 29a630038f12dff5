"""What ingest saw of sync, light and focus: figures for machines, warnings for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from pipelines.ingest.config import IngestConfig
from pipelines.ingest.focus import judge_focus
from pipelines.ingest.light import judge_light, light_drift
from pipelines.ingest.scan import Seen
from pipelines.ingest.sync import look_at_sync, step_words, stuck_frames


def look(
    seen: Mapping[str, Seen],
    digests: Mapping[str, str],
    clips: Sequence[int],
    config: IngestConfig,
) -> tuple[dict, dict[str, str]]:
    """Figures of every camera, and what is wrong by camera.

    Args:
        seen: what was seen of each camera.
        digests: of each camera's files.
        clips: frames of each recording.
        config: from where on it warns.
    """
    count = min(sum(clips), *(len(s.moves) for s in seen.values()))
    moves = {name: s.moves[:count] for name, s in seen.items()}
    steps, untold = (
        ({}, {}) if not config.sync_frames else look_at_sync(moves, clips, config.sync_frames)
    )
    stuck = stuck_frames(moves)
    copied = copies(digests)
    drifts = {name: light_drift(s.cells.astype("float32")) for name, s in seen.items()}
    widths, blurred = judge_focus({n: s.widths for n, s in seen.items()}, config.blur_ratio)
    warnings: dict[str, list[str]] = {}
    for name in sorted(seen):
        drift = drifts[name]
        words = [
            copied.get(name, ""),
            step_words(steps[name]) if name in steps else "",
            _stuck_words(stuck[name]) if name in stuck else "",
            judge_light(drift, config.exposure_drift_ev, config.colour_drift_ev) if drift else "",
            blurred.get(name, ""),
        ]
        warnings[f"camera {name}"] = [one for one in words if one]
    figures = {
        "sync": {
            "out_of_step": {k: [asdict(s) for s in v] for k, v in steps.items()},
            "repeats": stuck,
            "untold": untold,
        },
        "light": {k: asdict(d) if d else None for k, d in drifts.items()},
        "focus_px": widths,
    }
    return figures, {what: "; ".join(words) for what, words in warnings.items() if words}


def copies(digests: Mapping[str, str]) -> dict[str, str]:
    """Cameras whose files are those of a camera before them, with words for people."""
    first: dict[str, str] = {}
    for name in sorted(digests):
        first.setdefault(digests[name], name)
    return {
        name: f"has the very files of camera {first[digest]}; one of the two is a copy, remove it"
        for name, digest in digests.items()
        if first[digest] != name
    }


def _stuck_words(frames: Sequence[int]) -> str:
    shown = ", ".join(map(str, frames[:6])) + (", ..." if len(frames) > 6 else "")
    return f"repeats the frame before in {len(frames)} frames ({shown}) while others move"
