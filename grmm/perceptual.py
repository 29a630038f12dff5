"""The perceptual term: distance of VGG16 features, from weights that the user supplies."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from express50.errors import TrainError
from express50.files.checkpoints import read_weights

# Simonyan and Zisserman 2014, configuration D, up to relu4_3; "M" halves the map.
LAYERS: tuple[int | str, ...] = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512)
COMPARED = (3, 8, 15, 22)  # relu1_2, relu2_2, relu3_3, relu4_3 by torchvision's numbering
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, as torchvision trained it
SMALLEST_PX = 16  # four levels, three halvings


class VGGDistance(nn.Module):
    """Squared distance of channel-normalised VGG16 features, averaged over four layers.

    The paper names the backbone only; layers and normalisation are those of LPIPS (Zhang et al.
    2018) without its learned channel weights. Weights never train.
    """

    def __init__(self, weights: dict[str, Tensor]) -> None:
        """Build from torchvision's ``vgg16`` state dict (its ``features.*`` entries are used)."""
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for entry in LAYERS:
            if isinstance(entry, int):
                layers += [nn.Conv2d(channels, entry, 3, padding=1), nn.ReLU()]
                channels = entry
            else:
                layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers)
        wanted = self.features.state_dict()
        missing = [
            name
            for name, tensor in wanted.items()
            if getattr(weights.get(f"features.{name}"), "shape", None) != tensor.shape
        ]
        if missing:
            raise TrainError(
                f"the VGG16 weights lack features.{missing[0]}; expected the state dict of "
                "torchvision's vgg16. Leave loss.vgg16 empty to train without it"
            )
        self.features.load_state_dict({name: weights[f"features.{name}"] for name in wanted})
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None])
        self.register_buffer("std", torch.tensor(STD)[:, None, None])

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """Distance of two (3, H, W) images in [0, 1], at least 16 px a side."""
        if min(image.shape[1:]) < SMALLEST_PX:
            raise ValueError(f"image is {tuple(image.shape[1:])}, expected at least 16 x 16 pixels")
        x = (torch.stack([image, target]) - self.mean) / self.std
        total = x.new_zeros(())
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in COMPARED:
                unit = nn.functional.normalize(x, dim=1, eps=1e-6)
                total = total + (unit[0] - unit[1]).square().sum(0).mean() / len(COMPARED)
        return total


def load_vgg(path: Path) -> VGGDistance:
    """Read torchvision's vgg16 state dict (weights only, nothing in it is executed).

    Raises:
        TrainError: no such file, or not that state dict.
    """
    mend = "leave it empty to do without"
    weights = read_weights(path, TrainError, f"loss.vgg16 {path}", "a torch state dict", mend)
    if not isinstance(weights, dict):
        raise TrainError(f"loss.vgg16 {path}: holds a {type(weights).__name__}, expected a dict")
    return VGGDistance(weights)


def random_crop(
    images: tuple[Tensor, Tensor], side: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The same random crop of two (3, H, W) images; ``side`` 0 or too large keeps them whole."""
    height, width = images[0].shape[1:]
    if side <= 0 or side >= min(height, width):
        return images
    row = int(torch.randint(height - side + 1, (), generator=generator))
    column = int(torch.randint(width - side + 1, (), generator=generator))
    a, b = (image[:, row : row + side, column : column + side] for image in images)
    return a, b
