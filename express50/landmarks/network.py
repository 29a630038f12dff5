"""Define the landmark network: a small encoder-decoder with one heat map per point.

Points are expectations over softmax heat maps (integral regression, Sun et al. 2018), so they are
continuous and have gradients everywhere. A small perceptron that sees all of them at once then
corrects what does not look like a face, for example where an occluder misled a heat map. For each
point it also estimates the error (the scale of a two-dimensional Laplace distribution) and whether
it is visible.

Small networks look at eyes and mouth again, at about twice the resolution, because the first one
hardly distinguishes half shut lids from open ones, or bared teeth from shut lips.

Landmarks are fixed places of a head. The outline, 17 points on the visible edge of the face, is
what published marks have instead of the jaw line. It is found in the same way, and corrected by a
perceptron that sees it and the landmarks.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from express50.errors import FormatError
from express50.files.arrays import read_arrays
from express50.files.text import refusing
from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.landmarks import WEIGHTS

CROP = 128
POINTS, OUTLINE = 68, 17
STRETCH = 1.15  # of the heat maps beyond the crop: points may lie a little outside it
CROP_MARGIN = 1.55  # side of a crop over the longer side of its landmarks' box
# Partner of each iBUG-68 point in the mirror image, then of the 68 + 17 with the outline.
MIRROR = np.array(
    [*range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31,
     45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40,
     54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
)  # fmt: skip
MIRROR_WITH_OUTLINE = np.concatenate([MIRROR, np.arange(POINTS, POINTS + OUTLINE)[::-1]])
LEFT_EYE, MOUTH = np.arange(42, 48), np.arange(48, 68)
INNER_LIPS = ((61, 62, 63), (67, 66, 65))  # those that meet, the upper ones first
COUNTERS = "num_batches_tracked"  # suffix of batch normalisation's buffers that are not stored


def as_input(crops: np.ndarray) -> torch.Tensor:
    """Make a network's input (B, 3, H, W), 0 to 1, of crops (B, H, W, 3) uint8.

    It is in channels-last memory format, as the crops are.
    """
    return torch.from_numpy(crops).permute(0, 3, 1, 2).float() / 255.0


def face_box(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre (2,) and side of the square that is cropped around landmarks (68, 2)."""
    low, high = points.min(0), points.max(0)
    return 0.5 * (low + high), CROP_MARGIN * float((high - low).max())


class Output(NamedTuple):
    """The network's answer for B crops."""

    points: torch.Tensor  # (B, 68, 2) crop pixels
    log_scale: torch.Tensor  # (B, 68) natural logarithm of the Laplace scale in crop pixels
    seen: torch.Tensor  # (B, 68) logit of whether the point is visible
    logit: torch.Tensor  # (B,) logit of whether a face looks towards the camera
    heat: torch.Tensor  # (B, 68, H / 4, W / 4) heat maps before the softmax
    outline: torch.Tensor  # (B, 17, 2) crop pixels; landmarks 0 to 16 if the network lacks it
    outline_log_scale: torch.Tensor  # as for the landmarks
    outline_heat: torch.Tensor  # as for the landmarks


class Residual(nn.Module):
    """Two 3x3 convolutions with a skip connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width, 3), _conv(width, width, 3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, C, H, W) to the same shape."""
        return functional.relu(x + self.second(functional.relu(self.first(x))))


class ShapeHead(nn.Module):
    """Corrects all points of a face together; estimates error scales and visibility."""

    def __init__(self, features: int) -> None:
        super().__init__()
        width = 192
        self.look = nn.Linear(features, 64)
        self.first, self.second = nn.Linear(3 * POINTS + 64, width), nn.Linear(width, 4 * POINTS)
        self.spread = nn.Parameter(torch.zeros(POINTS))
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(
        self, points: torch.Tensor, variance: torch.Tensor, features: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return points (B, P, 2), log scales (B, P) and visibility logits (B, P)."""
        spread = variance.clamp_min(1e-2).log()
        place = (points - points.mean(1, keepdim=True)) / (0.25 * CROP)
        look = functional.relu(self.look(features))
        hidden = functional.relu(self.first(torch.cat([place.flatten(1), 0.3 * spread, look], 1)))
        out = self.second(hidden).view(-1, 4, POINTS)
        log_scale = 1.0 + out[:, 2] + self.spread * spread
        return points + 8.0 * out[:, :2].transpose(1, 2), log_scale.clamp(-2.0, 4.0), out[:, 3]


class OutlinePart(nn.Module):
    """Finds the outline from the trunk's maps; see `Output`."""

    def __init__(self, maps: int, features: int) -> None:
        super().__init__()
        width = 160
        self.heat = nn.Conv2d(maps, OUTLINE, 3, 1, 1)
        self.look = nn.Linear(features, 64)
        self.first = nn.Linear(3 * OUTLINE + 2 * POINTS + 64, width)
        self.second = nn.Linear(width, 3 * OUTLINE)
        self.spread = nn.Parameter(torch.zeros(OUTLINE))
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(
        self, maps: torch.Tensor, marks: torch.Tensor, features: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return points (B, 17, 2), log scales (B, 17) and heat maps (B, 17, H, W)."""
        heat = self.heat(maps)
        points, variance = expectation(heat)
        spread = variance.clamp_min(1e-2).log()
        centre = marks.mean(1, keepdim=True)
        places = [((one - centre) / (0.25 * CROP)).flatten(1) for one in (points, marks)]
        look = functional.relu(self.look(features))
        hidden = functional.relu(self.first(torch.cat([*places, 0.3 * spread, look], 1)))
        out = self.second(hidden).view(-1, 3, OUTLINE)
        log_scale = (1.0 + out[:, 2] + self.spread * spread).clamp(-2.0, 4.0)
        return points + 8.0 * out[:, :2].transpose(1, 2), log_scale, heat


class CloseNet(nn.Module):
    """Finds points in close-ups (B, 3, crop, crop) in [0, 1]."""

    def __init__(self, count: int, crop: int, zoom: float) -> None:
        super().__init__()
        self.crop = crop  # side of the close-ups, a multiple of 8
        self.zoom = zoom  # size of their pixels, in pixels of the face's crop
        self.stem, self.block24 = _conv(3, 16, 5, 2), Residual(16)
        self.down12, self.block12 = _conv(16, 32, 3, 2), Residual(32)
        self.down6, self.block6 = _conv(32, 48, 3, 2), Residual(48)
        self.first, self.second = nn.Linear(48 * (crop // 8) ** 2, 64), nn.Linear(64, 3 * count)

    def forward(self, crops: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return points (B, N, 2) in crop pixels and log scales (B, N), as for the landmarks."""
        x = functional.relu(self.stem(_normalised(crops)))
        x = functional.relu(self.down12(self.block24(x)))
        x = self.block6(functional.relu(self.down6(self.block12(x))))
        out = self.second(functional.relu(self.first(x.flatten(1)))).unflatten(1, (3, -1))
        points = 0.5 * self.crop + 8.0 * out[:, :2].transpose(1, 2)
        return points, (0.5 + out[:, 2]).clamp(-3.0, 4.0)


def eye_net() -> CloseNet:
    """Return a network for the subject's left eye, or the mirrored right one."""
    return CloseNet(len(LEFT_EYE), 48, 0.6)


def mouth_net() -> CloseNet:
    """Return a network for the mouth."""
    return CloseNet(len(MOUTH), 64, 0.65)


class LandmarkNet(nn.Module):
    """Maps crops (B, 3, 128, 128) in [0, 1] to landmarks; see `Output`.

    Crops of half the size (64, 64) work too, with points in pixels of 128. Training begins with
    them, in a quarter of the time.

    Only a network for pictures of `whole` heads finds the outline, and has `eyes` and `mouth`.
    """

    def __init__(self, whole: bool = False) -> None:
        super().__init__()
        self.outline = OutlinePart(48, 128) if whole else None
        self.eyes = eye_net() if whole else None
        self.mouth = mouth_net() if whole else None
        self.stem1, self.stem2 = _conv(3, 16, 5, 2), _conv(16, 32, 3, 2)
        self.block32 = Residual(32)
        self.down16, self.block16 = _conv(32, 64, 3, 2), Residual(64)
        self.down8, self.block8 = _conv(64, 96, 3, 2), Residual(96)
        self.down4, self.block4 = _conv(96, 128, 3, 2), Residual(128)
        self.side4, self.side8, self.side16 = _conv(128, 96, 1), _conv(96, 64, 1), _conv(64, 32, 1)
        self.mix8 = Residual(96)
        self.mix16, self.mix32 = _conv(64, 64, 3), _conv(32, 48, 3)
        self.heat = nn.Conv2d(48, POINTS, 1)
        self.shape = ShapeHead(128)
        self.face = nn.Linear(128, 1)

    def forward(self, crops: torch.Tensor) -> Output:
        """Run the network; exposure and contrast are normalised."""
        # Positions need single precision, whatever precision training uses for convolutions.
        maps, features = (part.float() for part in self.trunk(crops))
        with torch.autocast("cpu", enabled=False):
            heat = self.heat(maps)
            points, log_scale, seen = self.shape(*expectation(heat), features)
            edge = points[:, :OUTLINE], log_scale[:, :OUTLINE], heat[:, :OUTLINE]
            if self.outline is not None:
                edge = self.outline(maps, points, features)
            return Output(points, log_scale, seen, self.face(features)[:, 0], heat, *edge)

    def trunk(self, crops: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return maps (B, 48, H / 4, W / 4) and features (B, 128)."""
        x = functional.relu(self.stem1(_normalised(crops)))
        x32 = self.block32(functional.relu(self.stem2(x)))
        x16 = self.block16(functional.relu(self.down16(x32)))
        x8 = self.block8(functional.relu(self.down8(x16)))
        x4 = self.block4(functional.relu(self.down4(x8)))
        y = self.mix8(functional.relu(x8 + _twice(self.side4(x4))))
        y = functional.relu(self.mix16(functional.relu(x16 + _twice(self.side8(y)))))
        y = functional.relu(self.mix32(functional.relu(x32 + _twice(self.side16(y)))))
        return y, x4.mean((2, 3))


def _normalised(crops: torch.Tensor) -> torch.Tensor:
    mean = crops.mean((1, 2, 3), keepdim=True)
    return (crops - mean) / (crops.std((1, 2, 3), keepdim=True) + 0.02)


def _conv(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs)
    )


def _twice(x: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def expectation(heat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean position (B, P, 2) in crop pixels and variance (B, P) of softmax heat maps."""
    batch, points, height, width = heat.shape
    share = functional.softmax(heat.reshape(batch, points, -1), -1).reshape(heat.shape)
    axis = torch.from_numpy(cell_centres(width) / width).to(heat)
    axis = ((axis - 0.5) * STRETCH + 0.5) * CROP
    along_x, along_y = share.sum(2), share.sum(3)
    mean = torch.stack([(along_x * axis).sum(-1), (along_y * axis).sum(-1)], -1)
    square = (along_x * axis**2).sum(-1) + (along_y * axis**2).sum(-1)
    return mean, (square - mean.square().sum(-1)).clamp_min(0.0)


def heat_loss(heat: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return the cross entropy (B, P) of heat maps and points (B, P, 2) spread over four cells.

    Its gradient is strong from the first step on, unlike that of the expectation.
    """
    size = heat.shape[-1]
    cells = corner_to_cell(((points / CROP - 0.5) / STRETCH + 0.5) * size)
    cells = cells.clamp(0.0, size - 1.001)
    low = cells.floor()
    share = cells - low
    column, row = low.long().unbind(-1)
    log_share = functional.log_softmax(heat.flatten(2), -1)
    loss = torch.zeros_like(share[..., 0])
    for dx in (0, 1):
        for dy in (0, 1):
            weight = (share[..., 0] if dx else 1 - share[..., 0]) * (
                share[..., 1] if dy else 1 - share[..., 1]
            )
            index = (row + dy) * size + column + dx
            loss = loss - weight * log_share.gather(2, index[..., None])[..., 0]
    return loss


def save_network(net: LandmarkNet, path: Path) -> None:
    """Write the weights as float16, without batch normalisation's counters."""
    state = {
        key: (value.half() if value.is_floating_point() else value).detach().cpu().numpy()
        for key, value in net.state_dict().items()
        if not key.endswith(COUNTERS)
    }
    with path.open("wb") as file:
        np.savez_compressed(file, **state)


@lru_cache(maxsize=2)  # landmarks in pictures, and on the face UV map
def load_network(path: Path = WEIGHTS) -> LandmarkNet:
    """Read weights written by `save_network`, for evaluation only. Callers share the network.

    Batch normalisations are folded into the convolutions before them.
    """
    net = trainable_network(path).eval()
    fold(net)
    return net.to(memory_format=torch.channels_last)


def trainable_network(path: Path = WEIGHTS) -> LandmarkNet:
    """Read weights of `save_network` to train on; FormatError if the file is missing or damaged."""
    names = [key for key in LandmarkNet().state_dict() if not key.endswith(COUNTERS)]
    arrays = read_arrays(path, FormatError, "landmark weights", names)
    net = LandmarkNet("outline.spread" in arrays)
    names = [key for key in net.state_dict() if not key.endswith(COUNTERS)]
    with refusing(FormatError, f"{path}: not landmark weights"):
        state = {key: torch.from_numpy(arrays[key].astype(np.float32)) for key in names}
        net.load_state_dict(state, strict=False)
    return net.to(memory_format=torch.channels_last)


def fold(module: nn.Module) -> None:
    """Fold batch normalisations into convolutions, in place; results stay the same."""
    for name, child in module.named_children():
        if isinstance(child, nn.Sequential) and isinstance(child[1], nn.BatchNorm2d):
            setattr(module, name, fuse_conv_bn_eval(child[0], child[1]))
        else:
            fold(child)
