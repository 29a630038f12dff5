"""The depth stage makes a surface and depth maps per expression."""

from __future__ import annotations

from pathlib import Path

from express50.capture.index import peak_items
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.depth.config import PRESETS, DepthConfig


def inputs(dataset: Dataset, item: str, config: DepthConfig) -> dict[str, Path | str]:
    """List cameras, frames and mattes of the expression, and the track if there is one."""
    from express50.capture.frames import frame_inputs, read_cameras_of

    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.cameras_file(subject),
        **frame_inputs(dataset, subject, expression),
    }
    for camera in read_cameras_of(dataset, subject):
        path = dataset.matte_file(subject, expression, camera)
        if path.is_file():
            found[f"matte {camera}"] = path
    track = dataset.track_file(subject)
    if track.is_file():
        found["track"] = track
    return found


def run(dataset: Dataset, item: str, config: DepthConfig, out: Path) -> Result:
    """Reconstruct one expression."""
    from pipelines.depth.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="depth",
    version=10,
    config=DepthConfig,
    presets=PRESETS,
    items=peak_items,
    inputs=inputs,
    run=run,
    help="reconstruct the head's surface and depth maps of each expression",
    purpose="A level set starts from the visual hull and the tracked mesh and moves to where the"
    " views agree; every camera gets depth, normals and confidence.",
    growth=Growth(
        items=("subjects", "expressions"), time=("views", "pixels"), disk=("views", "pixels")
    ),
)
