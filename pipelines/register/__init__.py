"""The register stage lays each expression's tracked mesh onto the reconstructed surface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from express50.capture.index import peak_items
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RegisterConfig:
    """How finely the mesh follows the surface."""

    detail_mm: float = 16.0
    """Wavelength of the finest detail that the mesh follows, millimetres: depth's own errors are
    finer. Less for given scans and for footage much finer than 512 pixels per head."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 1 <= self.detail_mm <= 100:
            raise ConfigError(f"register.detail_mm is {self.detail_mm}, expected 1 to 100")


def inputs(dataset: Dataset, item: str, config: RegisterConfig) -> dict[str, Path | str]:
    """List the track and the expression's surface."""
    from express50.dataset.tracks import existing_track

    subject, expression = item.split("/")
    return {
        "track": existing_track(dataset, subject),
        "surface": dataset.surface_file(subject, expression),
    }


def run(dataset: Dataset, item: str, config: RegisterConfig, out: Path) -> Result:
    """Register one expression."""
    from pipelines.register.stage import run as work

    return work(dataset, item, config.detail_mm / 1e3, out)


STAGE = Stage(
    name="register",
    version=1,
    config=RegisterConfig,
    presets={"draft": {}, "standard": {}, "reference": {}},
    items=peak_items,
    inputs=inputs,
    run=run,
    help="lay the tracked mesh onto the reconstructed surface",
    purpose="Each vertex moves along its normal to the surface; hair and what no view shows are"
    " left out. Every vertex gets a residual and a standard deviation.",
    growth=Growth(items=("subjects", "expressions")),
)
