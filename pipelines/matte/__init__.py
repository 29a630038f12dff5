"""The matte stage finds the opacity of the subject in every camera of a peak."""

from __future__ import annotations

from pathlib import Path

from express50.capture.index import peak_items
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.matte.config import NETWORKS, WITHOUT_PLATE, MatteConfig


def inputs(dataset: Dataset, item: str, config: MatteConfig) -> dict[str, Path | str]:
    """Name the cameras, the frames, the plates that the method uses, and the weights."""
    from express50.capture.frames import frame_inputs, read_cameras_of

    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.cameras_file(subject),
        **frame_inputs(dataset, subject, expression),
    }
    if config.method not in WITHOUT_PLATE:
        plates = {c: dataset.plate_file(subject, c) for c in read_cameras_of(dataset, subject)}
        found |= {f"plate {c}": path for c, path in plates.items() if path.is_file()}
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

    return work(dataset, item, config, out)


def needs_gpu(config: MatteConfig) -> bool:
    """Return whether a network must run on CUDA."""
    return config.method in NETWORKS and config.device == "cuda"


STAGE = Stage(
    name="matte",
    version=22,
    config=MatteConfig,
    items=peak_items,
    inputs=inputs,
    run=run,
    try_files=try_files,
    needs_gpu=needs_gpu,
    help="separate the head from the background in every camera, and let the cameras agree",
    purpose="The opacity of the subject in every peak frame, keyed per camera. In the pictures,"
    " what the other cameras removed is red and what they filled is green.",
    growth=Growth(
        items=("subjects", "expressions"), time=("views", "picture"), disk=("views", "picture")
    ),
)
