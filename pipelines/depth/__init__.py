"""The depth stage makes a surface and depth maps per expression."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from express50.capture.index import peak_items, read_index, tracked_items
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """How fine the surface is, and which evidence counts."""

    voxel_mm: float = 1.6
    """Finest voxel of the last level, millimetres, 0.3 to 20."""
    voxel_px: float = 1.4
    """The last level's voxel spans at least this many pixels: finer ones would hold guesses."""
    image_side: int = 1024
    """Longest side, pixels, of the images that silhouettes and photo-consistency use."""
    noise: float = 0.8
    """Texture with a smaller standard deviation (8-bit steps, after blurring) is ignored."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges(
            "depth", self, voxel_mm=(0.3, 20), voxel_px=(0, 8), image_side=(16, 32_768),
            noise=(1e-6, 255),
        )  # fmt: skip


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"voxel_mm": 4.0, "image_side": 512},
    "reference": {"voxel_mm": 1.0, "image_side": 2048},
}


def items(dataset: Dataset) -> list[str]:
    """List the peaks; of one camera, whose depth is the tracked head's, those with a face."""
    tracked = set(tracked_items(dataset))
    return [
        item
        for item in peak_items(dataset)
        if item in tracked or len(read_index(dataset, item.split("/")[0]).cameras) > 1
    ]


def inputs(dataset: Dataset, item: str, config: DepthConfig) -> dict[str, Path | str]:
    """List cameras, frames and mattes of the expression, and the track if there is one."""
    from express50.capture.frames import frame_inputs, read_cameras_of
    from express50.dataset.tracks import track_inputs

    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.cameras_file(subject),
        **frame_inputs(dataset, subject, expression),
    }
    for camera in read_cameras_of(dataset, subject):
        path = dataset.matte_file(subject, expression, camera)
        if path.is_file():
            found[f"matte {camera}"] = path
    if dataset.track_file(subject).is_file():
        found |= track_inputs(dataset, subject)
    return found


def run(dataset: Dataset, item: str, config: DepthConfig, out: Path) -> Result:
    """Reconstruct one expression."""
    from pipelines.depth.stage import run as work

    return work(dataset, item, out, **vars(config))


STAGE = Stage(
    name="depth",
    version=24,
    config=DepthConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="reconstruct the head's surface and depth maps of each expression",
    purpose="A level set starts from the visual hull and the tracked mesh and moves to where the"
    " views agree; every camera gets depth, normals and confidence.",
    growth=Growth(
        items=("subjects", "expressions"),
        time=("views", "picture"),
        disk=("views", "picture"),
        side=DepthConfig.image_side,
    ),
)
