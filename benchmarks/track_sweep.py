"""Measure what each setting of tracking is worth: error and seconds, into docs/TRADEOFFS.md.

``python -m benchmarks.track_sweep --dataset DIR --truth DIR --captures DIR`` with what
`benchmarks.track` takes, or without: the twin then records a subject. From `standard` one thing is
changed at a time, one subject, three expressions. Seconds are processor seconds of the stage. The
last line printed is one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from benchmarks.common import add_twin_options, check_twin_options, make_parser, replace_section
from benchmarks.track import narrowed, prepare, track, twin_config
from benchmarks.track_truth import summary
from benchmarks.track_views import held_out_views
from benchmarks.truth import Truth
from express50.capture.frames import read_cameras_of
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.files.text import markdown_table
from pipelines.track import STAGE

SECTION = "Settings of tracking"
EXPRESSIONS = ("neutral", "jaw_open", "smile")
VIEWS = (2, 4, 8)
KNOBS: tuple[tuple[str, dict[str, object]], ...] = (
    ("standard", {}),
    ("landmarks alone", {"outline_rounds": 0, "patch_rounds": 0, "uv_rounds": 0}),
    ("cameras 4", {"cameras": 4}),
    ("photo_side 256", {"photo_side": 256}),
    ("samples 1000", {"samples": 1000}),
    ("samples 8000", {"samples": 8000}),
    ("no outlines", {"outline_rounds": 0}),
    ("patch_rounds 2", {"patch_rounds": 2}),
    ("patch_rounds 6", {"patch_rounds": 6, "uv_rounds": 6}),
    ("no patches", {"patch_rounds": 0}),
    ("no UV landmarks", {"uv_rounds": 0}),
    ("no offsets", {"offset_modes": 0}),
)


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep and write its table."""
    parser = make_parser("track_sweep", __doc__)
    add_twin_options(parser)
    parser.add_argument("--captures", type=Path, help="its captures, with the held-out cameras")
    parser.add_argument("--knobs", nargs="+", choices=[name for name, _ in KNOBS], metavar="KNOB")
    parser.add_argument("--doc", type=Path, help="file to write the table into")
    options = parser.parse_args(arguments)
    check_twin_options(parser, options)
    with tempfile.TemporaryDirectory() as scratch:
        if options.dataset is None:
            dataset, truth, captures = prepare(twin_config(1, 18, 512), Path(scratch) / "twin")
        else:
            dataset, truth = Dataset(options.dataset), Truth(options.truth)
            captures = options.captures
        rows = sweep(dataset, truth, captures, options.knobs, Path(scratch))
        cameras = len(read_cameras_of(dataset, dataset.subjects()[0]))
    if options.doc:
        replace_section(options.doc, SECTION, as_markdown(rows, cameras))
    print(json.dumps({"rows": rows}))
    return 0


def sweep(
    dataset: Dataset, truth: Truth, captures: Path | None, knobs: list[str] | None, scratch: Path
) -> list[dict]:
    """Return a row for each knob, and for fewer cameras in the rig."""
    subject = dataset.subjects()[0]
    part = narrowed(dataset, subject, scratch / "part", cues=EXPRESSIONS)
    views = held_out_views(part, truth, subject, captures)
    rows = []
    for name, values in KNOBS:
        if knobs is None or name in knobs:
            rows.append(row_of(name, part, truth, subject, values, views))
    for count in VIEWS if knobs is None else ():
        few = narrowed(part, subject, scratch / f"views_{count}", views=count)
        rows.append(row_of(f"{count} cameras in the rig", few, truth, subject, {}, {}))
    return rows


def row_of(
    name: str, dataset: Dataset, truth: Truth, subject: str, values: dict, views: dict
) -> dict:
    """Return errors and seconds of `standard` with some values changed."""
    errors, found = track(dataset, truth, subject, build_config(STAGE, values), views)
    figures = summary(errors)
    row = {
        "setting": name,
        "face_mm": figures["vertex_rmse_mm"]["face"],
        "head_mm": figures["vertex_rmse_mm"]["head"],
        "jaw_deg": figures["jaw_error_deg"],
        "silhouette_iou": figures["silhouette_iou"],
        "seconds_per_frame": round(found["seconds"] / len(errors), 2),
    }
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


def as_markdown(rows: list[dict], cameras: int) -> list[str]:
    """Return the section's lines."""
    text = (
        f"Made by `python -m benchmarks.track_sweep`: one twin subject, {len(EXPRESSIONS)}"
        f" expressions, {cameras} cameras. One setting at a time differs from `standard`. Errors"
        " are root mean squares against ground truth, seconds are processor seconds per frame. All"
        " rows are of one head; differences under 0.1 mm are noise."
    )
    head = ["setting", "face mm", "head mm", "jaw degrees", "outline IoU", "seconds"]
    lines = [
        [
            r["setting"], f"{r['face_mm']:.2f}", f"{r['head_mm']:.2f}", f"{r['jaw_deg']:.2f}",
            "n/a" if r["silhouette_iou"] is None else f"{r['silhouette_iou']:.4f}",
            f"{r['seconds_per_frame']:.1f}",
        ]
        for r in rows
    ]  # fmt: skip
    return [text, "", *markdown_table(head, lines)]


if __name__ == "__main__":
    sys.exit(main())
