"""One camera's key: its plate with the noise around it, at the scale the config asks for."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from express50.files.images import resize_area
from pipelines.alpha.config import AlphaConfig
from pipelines.alpha.key import alpha_of
from pipelines.alpha.plate import PlateModel, exposed, exposure_gain, fit_plate


class Keyer:
    """A plate and its noise; gives the alpha of frames of that camera."""

    def __init__(
        self,
        plate: np.ndarray,
        frames: list[np.ndarray],
        valid: np.ndarray,
        config: AlphaConfig,
    ) -> None:
        """Measure the noise of `frames` (H, W, 3) uint8 around `plate`, inside `valid` (H, W)."""
        self.config = config
        self.full_size = (plate.shape[1], plate.shape[0])
        self.size = tuple(max(8, round(n * config.scale)) for n in self.full_size)
        self.plate = self._shrink(plate)
        self.valid = valid
        self._valid_small = self._shrink(valid.astype(np.uint8) * 255) == 255
        small = [self._shrink(f) for f in frames]
        self.model: PlateModel = fit_plate(self.plate, small, self._valid_small, config.noise_floor)

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
