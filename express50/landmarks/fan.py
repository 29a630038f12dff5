"""FAN, the face alignment network (Bulat and Tzimiropoulos 2017), with the user's own weights.

Its published weights are TorchScript files (2DFAN4, 3DFAN4) that map crops (B, 3, 256, 256) in
[0, 1] to heat maps (B, 68, 64, 64). They are loaded from the file that the user names; nothing is
downloaded. The embedded network finds the face, FAN its points.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from express50.errors import ConfigError
from express50.files.arrays import DAMAGE
from express50.geometry.conventions import cell_to_corner
from express50.landmarks.detector import Detection, cut_crop, place_crop

CROP, HEAT, POINTS = 256, 64, 68
# A crop spans 200 / 195 times the sum of the sides of the face box that FAN was trained with, whose
# middle lies an eighth of its height above; that box goes from above the brows to the chin.
SPAN, RAISE, BROW = 200.0 / 195.0, 0.12, 0.12
REACH = 3


def load_fan(path: Path) -> torch.jit.ScriptModule:
    """Read TorchScript weights.

    Raises:
        ConfigError: not a TorchScript file, or one that maps crops to something else.
    """
    wanted = f"expected FAN's TorchScript weights, (1, 3, {CROP}, {CROP}) to 68 heat maps"
    try:
        fan = torch.jit.load(str(path), map_location="cpu").eval()
        with torch.inference_mode():
            output = _heat(fan, torch.zeros(1, 3, CROP, CROP))
    except (*DAMAGE, torch.jit.Error) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else "no reason given"
        raise ConfigError(f"landmarks: {path} cannot be used ({first}); {wanted}") from error
    if tuple(output.shape) != (1, POINTS, HEAT, HEAT):
        raise ConfigError(f"landmarks: {path} gives {tuple(output.shape)}; {wanted}")
    return fan


def find_with_fan(fan: torch.jit.ScriptModule, image: np.ndarray, face: Detection) -> Detection:
    """Find a detected face's points with FAN; its score is kept.

    Confidence is the height of a point's heat map; sigma is its spread, a pixel of it at the least.

    Args:
        fan: from `load_fan`.
        image: (H, W, 3) uint8 RGB.
        face: from `detect`.
    """
    window = fan_window(face.points)
    crop = cut_crop(image, window, CROP)
    with torch.inference_mode():
        batch = torch.from_numpy(crop).permute(2, 0, 1)[None].float() / 255.0
        heat = _heat(fan, batch)[0].double().numpy()
    if not np.isfinite(heat).all():
        raise ConfigError("landmarks: FAN's weights give NaN or infinite heat; use others")
    found = [_peak(one) for one in heat]
    cells, spread, height = (np.array(part) for part in zip(*found, strict=True))
    step = CROP / HEAT
    points = (cells * step) @ window[:, :2].T + window[:, 2]
    scale = float(np.sqrt(abs(np.linalg.det(window[:, :2]))))
    confidence = np.clip(height, 0.0, 1.0)
    sigma = np.maximum(spread, 0.5) * step * scale / np.maximum(confidence, 0.05)
    return replace(face, points=points, sigma=sigma, confidence=face.score * confidence)


def fan_window(points: np.ndarray) -> np.ndarray:
    """Affine (2, 3) from crop to image pixels about landmarks (68, 2); the crop is upright."""
    low, high = points.min(0), points.max(0)
    low = low - [0.0, BROW * (high[1] - low[1])]
    centre = 0.5 * (low + high) - [0.0, RAISE * (high[1] - low[1])]
    scale = SPAN * max(float((high - low).sum()), 8.0) / CROP
    return place_crop(centre, scale * np.eye(2), CROP)


def _heat(fan: torch.jit.ScriptModule, batch: torch.Tensor) -> torch.Tensor:
    """Run FAN; a stack of several hourglasses answers with a list, whose last heat maps count."""
    output = fan(batch)
    return output[-1] if isinstance(output, list | tuple) else output


def _peak(heat: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Place (2,) in cells, corner origin, spread in cells and height of a map's peak."""
    row, column = np.unravel_index(int(np.argmax(heat)), heat.shape)
    rows = slice(max(row - REACH, 0), row + REACH + 1)
    columns = slice(max(column - REACH, 0), column + REACH + 1)
    share = np.clip(heat[rows, columns], 0.0, None)
    total = max(float(share.sum()), 1e-12)
    y, x = cell_to_corner(np.mgrid[rows, columns][:, : share.shape[0], : share.shape[1]])
    place = np.array([(share * x).sum(), (share * y).sum()]) / total
    variance = float((share * ((x - place[0]) ** 2 + (y - place[1]) ** 2)).sum()) / total
    return place, (0.5 * variance) ** 0.5, float(heat[row, column])
