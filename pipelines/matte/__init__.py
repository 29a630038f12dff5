"""The matte stage finds the opacity of the subject in every camera of a peak."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from express50.capture.index import peak_items
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import ConfigError

NETWORKS = ("bgmv2", "salient")


@dataclass(frozen=True, kw_only=True)
class MatteConfig:
    """Set how each camera is matted, and whether the cameras of a peak correct each other."""

    method: Literal["key", "grabcut", "bgmv2", "salient"] = "key"
    """key: compare with the plate; cameras without one are cut out by colours and by what the
    other cameras see. grabcut: cut out all cameras that way. bgmv2, salient: run a network."""
    weights: str = ""
    """File of the network's weights, TorchScript or ONNX; such a file is a program, so use only
    those you trust."""
    device: Literal["auto", "cuda"] = "auto"
    """Run the network on CUDA if available (auto), or only on CUDA."""
    tile: int = 2048
    """Longest side, pixels, of a tile that bgmv2 sees; larger frames are cut into tiles."""
    shadow: float = 0.25
    """Broad darkening of the plate by up to this share is a shadow; 0 turns this off."""
    agree: bool = True
    """Let the cameras correct each other; false keeps every camera's own matte."""

    def __post_init__(self) -> None:
        """Refuse values that matte nothing or everything."""
        check_ranges("matte", self, shadow=(0, 0.99), tile=(512, math.inf))
        if (self.method in NETWORKS) != bool(self.weights):
            raise ConfigError(
                f"matte.method {self.method!r} with matte.weights {self.weights!r}: key and grabcut"
                " take no weights; bgmv2 and salient need the network's weights file"
            )
        if self.tile % 64:
            raise ConfigError(f"matte.tile is {self.tile}, expected a multiple of 64")


def inputs(dataset: Dataset, item: str, config: MatteConfig) -> dict[str, Path | str]:
    """Name the cameras, the frames, the plates and walls that the method uses, and the weights."""
    from express50.capture.frames import frame_inputs, read_cameras_of

    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.cameras_file(subject),
        **frame_inputs(dataset, subject, expression),
    }
    if config.method in ("key", "bgmv2"):
        plates = {c: dataset.plate_file(subject, c) for c in read_cameras_of(dataset, subject)}
        found |= {f"plate {c}": path for c, path in plates.items() if path.is_file()}
    if config.method in ("key", "grabcut"):
        walls = {c: dataset.wall_file(subject, c) for c in read_cameras_of(dataset, subject)}
        found |= {f"wall {c}": path for c, path in walls.items() if path.is_file()}
    if config.weights:
        from pipelines.networks import weights_file  # torch takes seconds to import

        found["weights"] = weights_file(config.weights, "matte.weights")
    return found


def try_files(config: MatteConfig) -> None:
    """Load the network."""
    if config.weights:
        from pipelines.matte.learned import BGMV2, SALIENT
        from pipelines.networks import load_network

        load_network(config.weights, SALIENT if config.method == "salient" else BGMV2)


def run(dataset: Dataset, item: str, config: MatteConfig, out: Path) -> Result:
    """Matte one peak."""
    from pipelines.matte.stage import run as work

    return work(
        dataset, item, out, method=config.method, weights=config.weights, tile=config.tile,
        shadow=config.shadow, agreeing=config.agree,
    )  # fmt: skip


def needs_gpu(config: MatteConfig) -> bool:
    """Return whether a network must run on CUDA."""
    return config.method in NETWORKS and config.device == "cuda"


STAGE = Stage(
    name="matte",
    version=41,
    config=MatteConfig,
    items=peak_items,
    inputs=inputs,
    run=run,
    try_files=try_files,
    needs_gpu=needs_gpu,
    help="separate the head from the background in every camera, and let the cameras agree",
    purpose="The opacity of the subject in every peak frame, found per camera. In the pictures,"
    " what the other cameras removed is red and what they filled is green.",
    growth=Growth(
        items=("subjects", "expressions"), time=("views", "picture"), disk=("views", "picture")
    ),
)
