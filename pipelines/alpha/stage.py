"""The alpha stage: one camera of one subject, an 8-bit alpha for every peak expression."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import (
    read_cameras_of,
    read_peak_frame,
    read_peaks,
    read_plate_image,
)
from express50.contract.layout import Dataset
from express50.errors import CaptureError, NoFaceError, StageError
from express50.files.calibration import read_cameras
from express50.files.images import contact_sheet, read_image, write_image
from express50.geometry.cameras import Camera
from express50.geometry.conventions import undistorted_mask
from pipelines.alpha.config import NETWORKS, WITHOUT_PLATE, AlphaConfig
from pipelines.alpha.keyer import Keyer
from pipelines.alpha.plate import exposed, exposure_gain
from pipelines.alpha.qc import border_contact, picture_row, warnings

QC_ROWS = 8

Alpha = Callable[[np.ndarray], np.ndarray]
"""Frame (H, W, 3) uint8 to opacity (H, W) float32."""


def items(dataset: Dataset) -> list[str]:
    """`subject/camera` for every calibrated camera."""
    found = []
    for subject in dataset.subjects():
        path = dataset.item_dir("calibrate", subject) / "cameras.json"
        if path.is_file():
            found += [f"{subject}/{camera}" for camera in sorted(read_cameras(path))]
    return found


def inputs(dataset: Dataset, item: str, config: AlphaConfig) -> dict[str, Path | str]:
    """The camera's frames and plate, the calibration, the peaks, the weights."""
    subject, camera = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.item_dir("calibrate", subject) / "cameras.json",
        "peaks": dataset.item_dir("align", subject) / "peaks.json",
    }
    for expression in read_peaks(dataset, subject):
        if (path := dataset.frame_file(subject, expression, camera)).is_file():
            found[f"frame {expression}"] = path
    if (plate := dataset.plate_file(subject, camera)).is_file():
        found["plate"] = plate
    if config.weights:
        found["weights"] = _weights(config)
    return found


def _weights(config: AlphaConfig) -> Path:
    path = Path(config.weights).expanduser()
    from pipelines.networks import check_file  # torch takes seconds to import

    check_file(path, "alpha.weights")
    return path


def run(dataset: Dataset, item: str, config: AlphaConfig, out: Path) -> dict:
    """Write `<expression>.png` for each peak and a contact sheet; returns coverage figures."""
    subject, camera_id = item.split("/")
    peaks = read_peaks(dataset, subject)
    if not peaks:
        raise StageError(f"{item}: no peak frames; run 'express50 align {dataset.root}'")
    camera = read_cameras_of(dataset, subject, undistorted=False)[camera_id]
    # Resampling mixes the outermost pixels with what lies beyond the image.
    valid = cv2.erode(undistorted_mask(camera).astype(np.uint8), np.ones((3, 3))) > 0

    def read(expression: str) -> np.ndarray:
        return read_peak_frame(dataset, subject, expression, camera_id)

    plate = None
    if config.method not in WITHOUT_PLATE:
        plate = read_plate_image(dataset, subject, camera_id)
        if plate is None:
            raise StageError(
                f"{item}: no clean plate; photograph the empty set as plates/{camera_id}.png and"
                " run 'express50 ingest' and 'express50 frames' again, or set alpha.method to"
                " grabcut or salient"
            )
    if config.method == "grabcut":
        alpha_of, facts = _by_face(read_cameras_of(dataset, subject)[camera_id])
    else:
        frames = [read(name) for name in _measured(dataset, item, peaks, config)]
        alpha_of, facts = _method(plate, frames, valid, config)
    coverage: dict[str, float] = {}
    border: dict[str, dict[str, float]] = {}
    dropped: dict[str, str] = {}
    for expression in peaks:
        try:
            alpha = np.where(valid, alpha_of(read(expression)), np.float32(0))
        except (CaptureError, NoFaceError) as error:
            dropped[expression] = str(error)
            continue
        write_image(out / f"{expression}.png", np.rint(alpha * 255).astype(np.uint8))
        coverage[expression] = round(float(alpha.mean()), 6)
        border[expression] = border_contact(alpha)
    if not coverage:
        raise StageError(f"{item}: {next(iter(dropped.values()))}")
    peaks = {expression: frame for expression, frame in peaks.items() if expression in coverage}
    odd = warnings(peaks, coverage, border)
    named = {warning["what"] for warning in odd}
    first = sorted(peaks, key=lambda expression: expression not in named)[:QC_ROWS]
    _write_picture(out, {e: read(e) for e in first}, named)
    return {
        "method": config.method,
        **facts,
        "coverage": coverage,
        "border_contact": border,
        "warnings": odd,
        "dropped": [{"what": expression, "why": why} for expression, why in dropped.items()],
    }


def _measured(dataset: Dataset, item: str, peaks: dict[str, int], config: AlphaConfig) -> list[str]:
    """Expressions whose frames the camera's noise is measured on; none for a network."""
    if config.method != "key":
        return []
    subject, camera = item.split("/")
    by_frame = {
        frame: name
        for name, frame in peaks.items()
        if dataset.frame_file(subject, name, camera).is_file()
    }
    frames = [by_frame[frame] for frame in sorted(by_frame)]
    if not frames:
        raise StageError(f"{item}: no peak frame was written; run 'express50 frames'")
    picks = np.linspace(0, len(frames) - 1, config.noise_frames).round().astype(int)
    return [frames[i] for i in np.unique(picks)]


def _by_face(camera: Camera) -> tuple[Alpha, dict[str, object]]:
    """Alpha by colours about the face that a pinhole camera sees, and facts for the metrics."""
    from express50.landmarks.network import load_network  # torch takes seconds to import
    from pipelines.alpha.grabcut import person_alpha

    net = load_network()
    return lambda frame: person_alpha(net, camera, frame), {"plate": "none"}


def _method(
    plate: np.ndarray | None, frames: list[np.ndarray], valid: np.ndarray, config: AlphaConfig
) -> tuple[Alpha, dict[str, object]]:
    """How the config makes alpha, and facts about that for the metrics."""
    if config.method == "key" and plate is not None:
        keyer = Keyer(plate, frames, valid, config)
        noise = round(float(np.median(keyer.model.sigma)), 4)
        return keyer.alpha, {"plate": "given", "noise_8bit": noise}
    # Only here, as torch takes seconds to import.
    from pipelines.alpha.learned import BGMV2, SALIENT, background_alpha, salient_alpha
    from pipelines.networks import load_network

    path = _weights(config)
    if plate is None:
        salient = load_network(path, SALIENT)
        return lambda frame: salient_alpha(salient, frame), {"plate": "none"}
    network, still = load_network(path, BGMV2), plate

    def alpha(frame: np.ndarray) -> np.ndarray:
        shown = exposed(still, exposure_gain(frame, still))
        return background_alpha(network, frame, shown, config.tile)

    return alpha, {"plate": "given"}


def _write_picture(out: Path, images: dict[str, np.ndarray], odd: set[str]) -> None:
    """Contact sheet of what was written for some expressions, the odd ones marked."""
    rows = []
    for expression, image in images.items():
        alpha = read_image(out / f"{expression}.png").astype(np.float32) / 255
        rows.append(picture_row(image, alpha))
    (out / "qc").mkdir()
    labels = [f"{name}: see warnings" if name in odd else name for name in images]
    sheet = contact_sheet(rows, labels, tile=(240, 240))
    write_image(out / "qc" / "alphas.jpg", sheet, quality=88)


def needs_gpu(config: AlphaConfig) -> bool:
    """Whether a network must run on CUDA."""
    return config.method in NETWORKS and config.device == "cuda"
