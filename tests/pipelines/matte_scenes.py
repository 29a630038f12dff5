"""Frames whose alpha is known by construction: a head-like blob with strands over clutter."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.pixels import linear_to_srgb, srgb_to_linear

COLOURS = {  # skin and hair, 8-bit steps
    "dark": ((110, 80, 65), (45, 32, 25)),
    "fair": ((215, 170, 150), (205, 175, 120)),
    "black": ((60, 42, 36), (14, 12, 12)),
}


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A frame and its clean plate (H, W, 3) uint8, and the true alpha (H, W)."""

    frame: np.ndarray
    plate: np.ndarray
    alpha: np.ndarray


def clutter(rng: np.random.Generator, size: int) -> np.ndarray:
    """Coloured blotches and lines, (size, size, 3) float32 in 8-bit steps."""
    coarse = rng.uniform(70, 230, (12, 12, 3)).astype(np.float32)
    plate = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    for _ in range(20):
        x0, y0, x1, y1 = (int(v) for v in rng.integers(0, size, 4))
        colour = rng.uniform(40, 230, 3).tolist()
        cv2.line(plate, (x0, y0), (x1, y1), colour, int(rng.integers(1, 4)), cv2.LINE_AA)
    return np.clip(plate, 0, 255)


def _shapes(rng: np.random.Generator, size: int, strands: int, fine: int) -> list[np.ndarray]:
    """Masks of skin and hair, `fine` times finer than the frame."""
    s = size * fine
    skin, hair = np.zeros((2, s, s), np.uint8)
    cv2.ellipse(skin, (s // 2, int(0.55 * s)), (int(0.2 * s), int(0.27 * s)), 0, 0, 360, 1, -1)
    cv2.rectangle(skin, (int(0.42 * s), int(0.75 * s)), (int(0.58 * s), s), 1, -1)
    cv2.ellipse(hair, (s // 2, int(0.45 * s)), (int(0.22 * s), int(0.2 * s)), 0, 180, 360, 1, -1)
    along = np.linspace(0, 1, 12)
    for _ in range(strands):
        angle = rng.uniform(np.pi, 2 * np.pi)
        start = s * np.array([0.5 + 0.21 * np.cos(angle), 0.45 + 0.19 * np.sin(angle)])
        bend, length = rng.normal() * 0.8, rng.uniform(0.02, 0.09) * s
        turn = angle + rng.normal() * 0.5 + bend * along
        way = start + length * along[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        width = int(rng.integers(1, fine + fine // 2 + 1))
        cv2.polylines(hair, [way.round().astype(np.int32)], False, 1, width)
    return [skin, hair]


def make_scene(
    seed: int,
    look: str = "dark",
    size: int = 256,
    noise: float = 2.0,
    gain: float = 1.0,
    shadow: float = 0.0,
    strands: int = 80,
) -> Scene:
    """Render a scene; alpha is exact area coverage, colours mix in linear light.

    `gain` scales the frame against the plate, `shadow` darkens a broad patch beside the subject.
    """
    rng, fine = np.random.default_rng(seed), 4
    plate = clutter(rng, size)
    skin, hair = _shapes(rng, size, strands, fine)
    grain = rng.normal(size=(30, 30)).astype(np.float32)
    grain = cv2.resize(grain, (size * fine,) * 2, interpolation=cv2.INTER_CUBIC)[..., None]
    colours = [np.array(c, np.float32) for c in COLOURS[look]]
    subject = np.where(hair[..., None] > 0, colours[1], colours[0]) * (1 + 0.08 * grain)
    opaque = ((skin | hair) > 0).astype(np.float32)
    alpha = cv2.resize(opaque, (size, size), interpolation=cv2.INTER_AREA)
    light = srgb_to_linear(np.clip(subject, 0, 255) / 255.0).astype(np.float32)
    front = cv2.resize(light * opaque[..., None], (size, size), interpolation=cv2.INTER_AREA)
    x, y = np.meshgrid(np.arange(size) / size, np.arange(size) / size)
    dark = 1 - shadow * np.exp(-(((x - 0.82) / 0.1) ** 2) - ((y - 0.7) / 0.2) ** 2)
    behind = srgb_to_linear(plate * dark[..., None] / 255.0)
    frame = linear_to_srgb(front + (1 - alpha[..., None]) * behind) * 255.0 * gain

    def recorded(image: np.ndarray) -> np.ndarray:
        grown = image + rng.normal(size=image.shape) * noise * (0.5 + image / 255)
        return np.clip(np.rint(grown), 0, 255).astype(np.uint8)

    return Scene(frame=recorded(frame), plate=recorded(plate), alpha=alpha)
