"""The regions stage labels each pixel of a peak frame, and mattes the head alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from express50.capture.index import tracked_items
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage


@dataclass(frozen=True, kw_only=True)
class RegionsConfig:
    """The sources of the labels, and their size."""

    segmentation: str = ""
    """File of Sapiens' body-part weights, TorchScript; its labels replace those of the mesh."""
    device: Literal["auto", "cuda"] = "auto"
    """Run the network on CUDA if there is a GPU, or refuse to run without one."""
    image_side: int = 1536
    """Longest side, pixels, at which views are labelled; larger frames get enlarged labels."""
    depth: bool = True
    """Use depth maps, if there are any, to separate pixels above and below the neck's end."""
    scalp: Literal["auto", "hair", "skin"] = "auto"
    """Label of the mesh's scalp; auto: skin where its colours are those of the face."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges("regions", self, image_side=(16, math.inf))


def inputs(dataset: Dataset, item: str, config: RegionsConfig) -> dict[str, Path | str]:
    """List cameras, frames, track, mattes and depth maps of the expression, and the weights."""
    from express50.capture.frames import frame_inputs, read_cameras_of
    from express50.dataset.depth_files import depth_file
    from express50.dataset.tracks import track_inputs

    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.cameras_file(subject),
        **frame_inputs(dataset, subject, expression),
        **track_inputs(dataset, subject),
    }
    for camera in read_cameras_of(dataset, subject):
        matte = dataset.matte_file(subject, expression, camera)
        depth = depth_file(dataset.item_dir("depth", item), camera)
        found |= {f"matte {camera}": matte} if matte.is_file() else {}
        found |= {f"depth {camera}": depth} if config.depth and depth else {}
    if config.segmentation:
        from pipelines.networks import weights_file  # torch takes seconds to import

        found["segmentation"] = weights_file(config.segmentation, "regions.segmentation")
    return found


def needs_gpu(config: RegionsConfig) -> bool:
    """Ask for a GPU if the network must run on one."""
    return bool(config.segmentation) and config.device == "cuda"


def try_files(config: RegionsConfig) -> None:
    """Load the network."""
    if config.segmentation:
        from pipelines.networks import SAPIENS, load_network

        load_network(config.segmentation, SAPIENS)


def run(dataset: Dataset, item: str, config: RegionsConfig, out: Path) -> Result:
    """Label one expression."""
    from pipelines.regions.stage import run as work

    return work(
        dataset, item, out, side=config.image_side, use_depth=config.depth, scalp_is=config.scalp,
        weights=config.segmentation,
    )  # fmt: skip


STAGE = Stage(
    name="regions",
    version=22,
    config=RegionsConfig,
    items=tracked_items,
    inputs=inputs,
    run=run,
    try_files=try_files,
    needs_gpu=needs_gpu,
    help="label skin, hair, neck and torso in each view, and cut the torso from the matte",
    purpose="The tracked mesh, each view's colours and depth label skin, ears, lips, eyes, mouth,"
    " hair, neck, torso, glasses and hands; a second matte holds the head alone.",
    growth=Growth(
        items=("subjects", "expressions"),
        time=("views", "picture"),
        disk=("views", "picture"),
        side=RegionsConfig.image_side,
    ),
)
