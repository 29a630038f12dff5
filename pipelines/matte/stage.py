"""The matte stage: one camera of one subject, an 8-bit alpha for every peak expression."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from express50.adapters import undistorted_mask
from express50.cameras import read_cameras
from express50.errors import StageError
from express50.frames import read_cameras_of, read_frame, read_peaks, read_plate
from express50.images import contact_sheet, resize_area, write_image
from express50.index import index_path, read_index
from express50.layout import Dataset
from express50.stage import Stage
from pipelines.matte.config import PRESETS, MatteConfig
from pipelines.matte.key import alpha_of
from pipelines.matte.plate import PlateModel, exposed, exposure_gain, fit_plate, plate_from_footage

QC_ROWS = 8
# A coverage this factor off the camera's median over expressions is reported as a jump.
JUMP = 1.35
EMPTY = 0.003


def items(dataset: Dataset) -> list[str]:
    """`subject/camera` for every calibrated camera."""
    found = []
    for subject in dataset.subjects():
        path = dataset.item_dir("calibrate", subject) / "cameras.json"
        if path.is_file():
            found += [f"{subject}/{camera}" for camera in sorted(read_cameras(path))]
    return found


def inputs(dataset: Dataset, item: str, config: MatteConfig) -> dict[str, Path | str]:
    """The camera's index, plate and footage identity, the calibration and the peaks."""
    subject, camera = item.split("/")
    index = read_index(dataset, subject)
    found: dict[str, Path | str] = {
        "index": index_path(dataset, subject),
        "cameras": dataset.item_dir("calibrate", subject) / "cameras.json",
        "peaks": dataset.item_dir("align", subject) / "peaks.json",
    }
    if camera in index.plates:
        found["plate"] = index.capture / index.plates[camera]
    return found


def run(dataset: Dataset, item: str, config: MatteConfig, out: Path) -> dict:
    """Write `<expression>.png` for each peak and a contact sheet; returns coverage figures."""
    subject, camera_id = item.split("/")
    peaks = read_peaks(dataset, subject)
    if not peaks:
        raise StageError(f"{item}: no peak frames; run 'express50 align {dataset.root}'")
    camera = read_cameras_of(dataset, subject, undistorted=False)[camera_id]
    # Resampling mixes the outermost pixels with what lies beyond the image.
    valid = cv2.erode(undistorted_mask(camera).astype(np.uint8), np.ones((3, 3))) > 0

    def read(frame: int) -> np.ndarray:
        return read_frame(dataset, subject, camera_id, frame)

    plate, source = read_plate(dataset, subject, camera_id), "given"
    if plate is None:
        plate, source = _plate_from_footage(dataset, item, config), "footage"
    if plate.shape != read(next(iter(peaks.values()))).shape:
        raise StageError(
            f"{item}: the plate is {plate.shape[1]}x{plate.shape[0]}, the footage "
            f"{camera.width}x{camera.height}; record the plate with the capture's settings"
        )
    measured = sorted(set(peaks.values()))
    measured = [
        measured[i]
        for i in np.unique(
            np.linspace(0, len(measured) - 1, config.noise_frames).round().astype(int)
        )
    ]
    keyer = Keyer(plate, [read(frame) for frame in measured], valid, config)
    coverage: dict[str, float] = {}
    border: dict[str, float] = {}
    rows: list[tuple[str, list[np.ndarray]]] = []
    for expression, frame in peaks.items():
        image = read(frame)
        alpha = keyer.alpha(image)
        write_image(out / f"{expression}.png", np.rint(alpha * 255).astype(np.uint8))
        coverage[expression] = round(float(alpha.mean()), 6)
        border[expression] = round(_border_contact(alpha), 4)
        if len(rows) < QC_ROWS:
            rows.append((expression, _qc_row(image, alpha)))
    (out / "qc").mkdir()
    sheet = contact_sheet([row for _, row in rows], [name for name, _ in rows], tile=(240, 240))
    write_image(out / "qc" / "mattes.jpg", sheet, quality=88)
    return {
        "plate": source,
        "coverage": coverage,
        "border_contact": border,
        "noise_8bit": round(float(np.median(keyer.model.sigma)), 4),
        "warnings": _warnings(coverage),
        "dropped": [],
    }


class Keyer:
    """One camera's plate with its noise, at the scale the config asks for."""

    def __init__(
        self,
        plate: np.ndarray,
        frames: list[np.ndarray],
        valid: np.ndarray,
        config: MatteConfig,
    ) -> None:
        """Measure the noise of `frames` (H, W, 3) uint8 around `plate`, inside `valid` (H, W)."""
        self.config = config
        self.full_size = (plate.shape[1], plate.shape[0])
        self.size = tuple(max(8, round(n * config.scale)) for n in self.full_size)
        self.plate = self._shrink(plate)
        self.valid = valid
        self._valid_small = self._shrink(valid.astype(np.uint8) * 255) == 255
        self.model: PlateModel = fit_plate(
            self.plate, [self._shrink(f) for f in frames], self._valid_small, config.noise_floor
        )

    def _shrink(self, image: np.ndarray) -> np.ndarray:
        return image if self.size == self.full_size else resize_area(image, *self.size)

    def alpha(self, frame: np.ndarray) -> np.ndarray:
        """Opacity (H, W) float32 in [0, 1] of the subject in a frame (H, W, 3) uint8."""
        small = self._shrink(frame)
        plate = exposed(self.plate, exposure_gain(small, self.plate))
        alpha = alpha_of(small, replace(self.model, plate=plate), self._valid_small, self.config)
        if self.size != self.full_size:
            alpha = cv2.resize(alpha, self.full_size, interpolation=cv2.INTER_LINEAR)
        return np.where(self.valid, alpha, np.float32(0))


def _plate_from_footage(dataset: Dataset, item: str, config: MatteConfig) -> np.ndarray:
    """The median of frames spread over the footage, or a StageError when it cannot be believed."""
    subject, camera_id = item.split("/")
    count = read_index(dataset, subject).cameras[camera_id].frames
    picks = np.unique(np.linspace(0, count - 1, config.plate_frames).round().astype(int))
    frames = [read_frame(dataset, subject, camera_id, int(frame)) for frame in picks]
    plate = plate_from_footage(frames) if len(frames) >= 5 else None
    if plate is None:
        raise StageError(
            f"{item}: no clean plate, and in {len(frames)} frames the subject moves too little to "
            f"show what is behind; photograph the empty set as plates/{camera_id}.png and run "
            "'express50 ingest' again"
        )
    return plate


def _border_contact(alpha: np.ndarray) -> float:
    """Share of the image's border that the subject covers: where it is cut off."""
    border = np.concatenate([alpha[0], alpha[-1], alpha[1:-1, 0], alpha[1:-1, -1]])
    return float((border > 0.5).mean())


def _qc_row(image: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """Frame with the matte's outline, subject on a plain ground, and alpha."""
    outline = image.copy()
    edges, _ = cv2.findContours(
        (alpha > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(outline, edges, -1, (255, 0, 0), max(1, max(alpha.shape) // 400))
    # A colour that neither skin nor hair has shows plate that was let through.
    ground = np.array([40, 200, 90], np.float32)
    cut = alpha[..., None] * image + (1 - alpha[..., None]) * ground
    grey = np.repeat((alpha * 255)[..., None], 3, axis=2)
    return [outline, cut.astype(np.uint8), grey.astype(np.uint8)]


def _warnings(coverage: dict[str, float]) -> list[dict[str, str]]:
    """Expressions whose matte is empty or whose area differs much from the camera's median."""
    middle = float(np.median(list(coverage.values())))
    found = []
    for expression, share in coverage.items():
        if share < EMPTY:
            found.append({"what": expression, "why": f"covers {share:.2%} of the image: empty"})
        elif not middle / JUMP <= share <= middle * JUMP:
            why = f"covers {share:.1%} of the image, the camera's median is {middle:.1%}"
            found.append({"what": expression, "why": why})
    return found


STAGE = Stage(
    name="matte",
    version=1,
    config=MatteConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
)
