"""The screen-space refinement: a small U-Net that adds a residual to the rendered colours."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

SLOPE = 0.2
FIXED_RANGE_M = 0.2  # half range of depth about the head's centre, depth_normalisation "fixed"
EMPTY_RANGE_M = 1e-6  # a thinner depth range than a micrometre carries no shape


class Refinement(nn.Module):
    """I = I_rgb + U-Net([I_rgb, features, normalised depth (, alpha)]).

    The paper names inputs and purpose only; widths, residual, the zero-initialised head and the
    absence of norms follow the survey's point 9. ``unshuffle`` folds r x r pixels into channels
    first: a CPU needs that. Images whose sides are no multiple of the stride are padded.
    """

    def __init__(self, *, inputs: int, widths: Sequence[int], unshuffle: int) -> None:
        """Build for ``inputs`` channels, of which the first three are the colours refined."""
        super().__init__()
        self.unshuffle = unshuffle
        self.stride = unshuffle * 2 ** (len(widths) - 1)
        folded = inputs * unshuffle**2
        self.enter = _block(folded, widths[0])
        self.down = nn.ModuleList(
            _block(a, b, stride=2) for a, b in zip(widths, widths[1:], strict=False)
        )
        self.up = nn.ModuleList(
            _block(a + b, a) for a, b in reversed(list(zip(widths, widths[1:], strict=False)))
        )
        self.head = nn.Conv2d(widths[0], 3 * unshuffle**2, 3, padding=1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                # Without norms torch's default would shrink activations thousandfold on the way.
                nn.init.kaiming_normal_(layer.weight, a=SLOPE)
                nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.head.weight)
        # As the images are: else weights are reordered in every call, a fifth of its time.
        self.to(memory_format=torch.channels_last)

    def forward(self, maps: Tensor) -> Tensor:
        """(inputs, H, W) -> refined colours (3, H, W)."""
        height, width = maps.shape[1:]
        pad = (0, -width % self.stride, 0, -height % self.stride)
        x = nn.functional.pad(maps[None], pad)
        x = nn.functional.pixel_unshuffle(x, self.unshuffle)
        x = x.contiguous(memory_format=torch.channels_last)
        levels = [self.enter(x)]
        for block in self.down:
            levels.append(block(levels[-1]))
        x = levels.pop()
        for block in self.up:
            skip = levels.pop()
            x = nn.functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = block(torch.cat([skip, x], 1))
        residual = nn.functional.pixel_shuffle(self.head(x), self.unshuffle)
        return maps[:3] + residual[0, :, :height, :width].to(maps.dtype)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1),
        nn.LeakyReLU(SLOPE),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.LeakyReLU(SLOPE),
    )


def normalise_depth(
    depth: Tensor, alpha: Tensor, method: str = "minmax", centre: Tensor | None = None
) -> Tensor:
    """Depth (H, W) in metres -> (H, W) in [0, 1], 0 where alpha <= 0.5.

    ``minmax`` stretches the range of the covered pixels of this image (paper; limits detached,
    survey point 10); ``fixed`` maps ``centre`` +- 0.2 m, which neither crops nor views change.
    A constant or empty depth map gives zeros, not 0 / 0.
    """
    mask = (alpha > 0.5) & torch.isfinite(depth)
    if not bool(mask.any()):
        return torch.zeros_like(depth)
    known = torch.where(mask, depth, 0.0)
    if method == "fixed":
        if centre is None:
            raise ValueError("centre is missing: fixed depth normalisation needs the head's depth")
        scaled = (known - centre) / (2 * FIXED_RANGE_M) + 0.5
    else:
        inner = known.detach()[mask]
        low, extent = inner.min(), inner.max() - inner.min()
        scaled = (known - low) / extent.clamp_min(EMPTY_RANGE_M)
    return torch.where(mask, scaled.clamp(0, 1), 0.0)
