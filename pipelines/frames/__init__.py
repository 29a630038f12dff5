"""Write each labelled peak frame once, undistorted and colour-corrected, and the clean plates.

An item is an expression of a subject with all cameras. A seek in 4K H.264 costs half a second
whichever way the peaks are grouped, and a changed label redoes one expression only. The plates of a
subject are one more item.
"""

from __future__ import annotations

from pathlib import Path

from express50.capture.index import peak_items, read_index, read_peak_rows
from express50.contract.layout import PLATES, Dataset
from express50.contract.stage import Growth, NoSettings, Result, Stage


def items(dataset: Dataset) -> list[str]:
    """List `subject/expression` of every labelled peak, and `subject/_plates` where there are any.

    Only aligned and calibrated subjects have items.
    """
    peaks = [
        item for item in peak_items(dataset) if dataset.cameras_file(item.split("/")[0]).is_file()
    ]
    subjects = dict.fromkeys(item.split("/")[0] for item in peaks)
    return peaks + [f"{s}/{PLATES}" for s in subjects if read_index(dataset, s).plates]


def inputs(dataset: Dataset, item: str, config: NoSettings) -> dict[str, Path | str]:
    """Name the index, the cameras, and the peak or the plates; the index holds footage hashes."""
    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "index": dataset.index_file(subject),
        "cameras": dataset.cameras_file(subject),
    }
    if expression == PLATES:
        index = read_index(dataset, subject)
        paths = {c: index.capture / name for c, name in index.plates.items()}
        return found | {f"plate {c}": path for c, path in paths.items() if path.is_file()}
    return found | {"peak": repr(read_peak_rows(dataset, subject)[expression])}


def run(dataset: Dataset, item: str, config: NoSettings, out: Path) -> Result:
    """Write one file per camera, and a contact sheet."""
    from pipelines.frames.stage import run as work

    return work(dataset, item, out)


STAGE = Stage(
    name="frames",
    version=2,
    config=NoSettings,
    items=items,
    inputs=inputs,
    run=run,
    help="write the labelled peak frames, undistorted and colour-corrected",
    purpose="Peak frames and clean plates as every later stage reads them: undistorted to the"
    " calibrated pinhole camera, colour-corrected, lossless.",
    growth=Growth(
        items=("subjects", "expressions"),
        time=("views", "pixels"),
        disk=("views", "pixels"),
        more=("subjects",),
    ),  # fmt: skip
)
