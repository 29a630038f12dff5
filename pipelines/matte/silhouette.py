"""Guess a person's silhouette with a small network, which was trained on renders alone.

Colours do not say that a shelf beside the neck is not a shoulder; shapes do. The network sees the
picture about a head whose place is known, turned upright, with where an average person would be.
Its outlines are coarse (a pixel is 5 mm), so `cutout.py` looks for the edges by colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from express50.errors import FormatError
from express50.files.arrays import read_arrays
from express50.geometry.conventions import affine_to_opencv
from express50.geometry.transforms import scale_of
from express50.landmarks.network import fold

WEIGHTS = Path(__file__).with_name("silhouette_weights.npz")
CROP = 128  # side of the network's picture, pixels
SPAN_M = 0.64  # and in metres of the head
UP_M, LEAST_UP = 0.1, 0.4  # a step upwards on the head, and the least share of it that shows up
WIDTHS = (24, 36, 56, 80, 112)
CONTRAST = 0.03  # of pictures in [0, 1], that counts as flat


class SilhouetteNet(nn.Module):
    """Maps inputs (B, 7, CROP, CROP) from `network_input` to logits (B, CROP, CROP)."""

    def __init__(self) -> None:
        super().__init__()
        above = (7, *WIDTHS[:-1])
        self.down = nn.ModuleList(_conv(*pair, 2) for pair in zip(above, WIDTHS, strict=True))
        self.same = nn.ModuleList(_conv(width, width, 1) for width in WIDTHS)
        self.whole = nn.Linear(WIDTHS[-1], WIDTHS[-1])
        pairs = zip(WIDTHS[:0:-1], WIDTHS[-2::-1], strict=True)
        self.up = nn.ModuleList(_conv(low + high, high, 1) for low, high in pairs)
        self.last = nn.Conv2d(WIDTHS[0], 1, 3, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Run the network; exposure and contrast are normalised over pixels with footage."""
        rgb, seen = x[:, :3], x[:, 6:]
        count = 3 * seen.sum((1, 2, 3), keepdim=True) + 1
        rgb = (rgb - (rgb * seen).sum((1, 2, 3), keepdim=True) / count) * seen
        contrast = (rgb.square().sum((1, 2, 3), keepdim=True) / count).sqrt()
        y, finer = torch.cat([rgb / (contrast + CONTRAST), x[:, 3:]], 1), []
        for down, same in zip(self.down, self.same, strict=True):
            y = functional.relu(same(functional.relu(down(y))))
            finer.append(y)
        y = y + functional.relu(self.whole(y.mean((2, 3))))[..., None, None]
        for up, other in zip(self.up, finer[-2::-1], strict=True):
            large = functional.interpolate(y, scale_factor=2.0)
            y = functional.relu(up(torch.cat([large, other], 1)))
        y = functional.interpolate(self.last(y), scale_factor=2.0, mode="bilinear")
        return y[:, 0]


def _conv(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs)
    )


def crop_about(chin: np.ndarray, above: np.ndarray, density: float) -> np.ndarray:
    """Return the map (2, 3) from a picture's pixels to those of the network's picture.

    It puts the chin in the middle and what is `above` it upwards, unless the camera looks from
    above or below; both are pixels (2,). `density` is in pixels per metre of the head.
    """
    right, down = above - chin
    angle = 0.0
    if np.hypot(right, down) > LEAST_UP * UP_M * density:
        angle = np.arctan2(right, -down)
    scale = CROP / (SPAN_M * density)
    turn = scale * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.column_stack([turn, CROP / 2 - turn @ chin])


def network_input(
    rgb: np.ndarray, valid: np.ndarray, labels: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """Return what the network sees (7, CROP, CROP) float32 of a picture (H, W, 3) uint8.

    These are its colours, where the GrabCut `labels` (H, W) of an average person are certain,
    likely and possible, and which pixels are `valid` (H, W).
    """
    if scale_of(matrix) < 0.8:
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.45 / scale_of(matrix))
    size, move = (CROP, CROP), affine_to_opencv(matrix)
    image = cv2.warpAffine(rgb, move, size, flags=cv2.INTER_LINEAR).astype(np.float32) / 255
    kind = cv2.warpAffine(labels, move, size, flags=cv2.INTER_NEAREST)
    seen = cv2.warpAffine(valid.astype(np.uint8), move, size, flags=cv2.INTER_NEAREST) > 0
    return joined_input(image, kind, seen)


def joined_input(image: np.ndarray, labels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Join a picture in [0, 1] (C, C, 3), labels and pixels with footage, (C, C) each."""
    certain = labels == cv2.GC_FGD
    maps = [certain, certain | (labels == cv2.GC_PR_FGD), labels != cv2.GC_BGD, seen]
    return np.concatenate([(image * seen[..., None]).transpose(2, 0, 1), maps]).astype(np.float32)


def chances(inputs: Sequence[np.ndarray]) -> np.ndarray:
    """Return for inputs (7, CROP, CROP) how likely each pixel shows the person, (N, CROP, CROP)."""
    with torch.inference_mode():
        found = torch.sigmoid(load_silhouettes()(torch.from_numpy(np.stack(inputs))))
    return found.numpy()


def enlarged(chance: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return chances (H, W) of a picture's pixels; those outside of the network's have -1."""
    return cv2.warpAffine(
        chance, affine_to_opencv(matrix), size[::-1], borderValue=-1.0,
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )  # fmt: skip


def save_silhouettes(net: SilhouetteNet, path: Path) -> None:
    """Write a trained network as float16, with batch normalisations folded into convolutions."""
    fold(net.eval())
    arrays = {key: value.half().numpy() for key, value in net.state_dict().items()}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


@lru_cache(maxsize=1)
def load_silhouettes(path: Path = WEIGHTS) -> SilhouetteNet:
    """Read weights written by `save_silhouettes`; FormatError if they are missing or damaged."""
    net = SilhouetteNet().eval()
    fold(net)
    arrays = read_arrays(path, FormatError, "silhouette weights", list(net.state_dict()))
    net.load_state_dict({key: torch.from_numpy(v.astype(np.float32)) for key, v in arrays.items()})
    return net.to(memory_format=torch.channels_last)
