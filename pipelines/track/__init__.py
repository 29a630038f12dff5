"""The track stage fits a head model to every peak frame of a subject."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import ConfigError
from express50.head import BUILTIN_NAME, head_files
from pipelines.track.config import PRESETS, UV_WEIGHTS, VERSION, TrackConfig

__all__ = ["STAGE"]


def inputs(dataset: Dataset, item: str, config: TrackConfig) -> dict[str, Path | str]:
    """Name index, cameras, peaks, mattes, network weights and the head model's files."""
    from express50.capture.frames import frame_inputs
    from express50.capture.index import read_peaks

    peaks = read_peaks(dataset, item)
    found: dict[str, Path | str] = {
        "index": dataset.index_file(item),
        "cameras": dataset.cameras_file(item),
        # Who chose a frame and how sure that was, which the file holds too, changes no track.
        "peaks": repr(peaks),
        **_setting_files(config),
    }
    for expression in peaks:
        found |= frame_inputs(dataset, item, expression)
    mattes = dataset.item_dir("matte", item)
    if mattes.is_dir():  # texture and UV map read them even without rounds of outlines and patches
        found["mattes"] = mattes
    if config.uv_rounds:
        found["face_uv"] = UV_WEIGHTS
    return found


def _setting_files(config: TrackConfig) -> dict[str, Path]:
    from express50.landmarks import source_files

    found = {**source_files(config.landmarks), **head_files(config.head)}
    for name, setting in (("head", "head"), ("landmarks", "landmarks"), ("fan", "landmarks")):
        if name in found and not found[name].exists():
            raise ConfigError(
                f"track.{setting} is {getattr(config, setting)}: no such file; give its path, or"
                " leave the setting out"
            )
    return found


def try_files(config: TrackConfig) -> None:
    """Read the head model and the landmarks."""
    from express50.landmarks import EMBEDDED

    _setting_files(config)
    if config.head != BUILTIN_NAME:
        from express50.head.load import load_head

        load_head(config.head)
    if config.landmarks != EMBEDDED:
        from express50.landmarks.sources import try_source  # torch takes seconds to import

        try_source(config.landmarks)


def run(dataset: Dataset, item: str, config: TrackConfig, out: Path) -> Result:
    """Track one subject; see `pipelines.track.stage`."""
    from pipelines.track.stage import run as work

    return work(dataset, item, config, out, inputs(dataset, item, config))


STAGE = Stage(
    name="track",
    version=VERSION,
    config=TrackConfig,
    presets=PRESETS,
    items=Dataset.subjects,  # all expressions of one share the shape
    inputs=inputs,
    run=run,
    try_files=try_files,
    help="fit a head model to every peak frame",
    purpose="A head model is fitted to every peak frame: shape per subject, expression and pose"
    " per frame, and an albedo texture.",
    growth=Growth(
        items=("subjects",),
        time=("expressions", "views", "picture"),
        disk=("expressions",),
        side=TrackConfig.photo_side,
    ),
)
