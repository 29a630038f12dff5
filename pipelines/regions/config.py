"""Settings of the regions stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RegionsConfig:
    """What labels are made from."""

    segmentation: str = ""
    """File of Sapiens' body-part weights, TorchScript; its labels go before the mesh's."""
