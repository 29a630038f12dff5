"""The register stage lays each expression's tracked mesh onto the reconstructed surface."""

from __future__ import annotations

from pathlib import Path

from express50.capture.index import tracked_items
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, NoSettings, Result, Stage


def inputs(dataset: Dataset, item: str, config: NoSettings) -> dict[str, Path | str]:
    """Name the cameras, the track and the expression's surface."""
    from express50.dataset.tracks import track_inputs

    subject, expression = item.split("/")
    return {
        "cameras": dataset.cameras_file(subject),
        **track_inputs(dataset, subject),
        "surface": dataset.surface_file(subject, expression),
    }


def run(dataset: Dataset, item: str, config: NoSettings, out: Path) -> Result:
    """Register one expression."""
    from pipelines.register.stage import run as work

    return work(dataset, item, out)


STAGE = Stage(
    name="register",
    version=10,
    config=NoSettings,
    items=tracked_items,
    inputs=inputs,
    run=run,
    help="lay the tracked mesh onto the reconstructed surface",
    purpose="Each vertex moves along its normal to the surface, except under hair, at lips, eyes"
    " and nostrils, and where no view shows skin. Every vertex gets a residual, a standard"
    " deviation and an error bound.",
    growth=Growth(items=("subjects", "expressions")),
)
