"""Draw hair in front of a plate with known alpha: the scenes of ``benchmarks.matte``.

A head with single strands of 0.2 to 1.2 pixels, drawn 8 times finer and averaged in linear light,
blurred as by a lens, then exposed: shot and read noise, another exposure than the plate's, a soft
shadow on the backdrop. Dark, blond and frizzy hair, each before a plain and a cluttered plate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.pixels import linear_to_srgb, srgb_to_linear

FINE = 8  # samples per pixel and axis
SHADES = 24  # of hair
READ, SHOT = 0.0016, 0.006  # deviation of dark pixels and at full light, linear light
LENS = 0.5  # pixels
GAIN = (0.95, 0.94, 0.96)  # of the frame over its plate, linear light
SHADOW = 0.15  # darkest share of linear light
# sRGB of hair, skin and shirt, and how strands run: how many, how long, how curled.
HAIR = {
    "dark": ((52, 38, 30), 700, 0.12, 0.0),
    "blond": ((206, 176, 124), 700, 0.12, 0.0),
    "frizzy": ((86, 58, 40), 900, 0.10, 1.0),
}
SKIN, SHIRT = (205, 160, 138), (70, 84, 110)
PLATES = ("plain", "cluttered")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Frame and clean plate (H, W, 3) uint8, pixels with footage (H, W), true alpha (H, W).

    `front` (H, W, 3) is the subject's part of the frame's light, where that is known.
    """

    name: str
    frame: np.ndarray
    plate: np.ndarray
    valid: np.ndarray
    true: np.ndarray
    front: np.ndarray | None = None


def make_scenes(size: int) -> Iterator[Scene]:
    """Yield every kind of hair before every kind of plate, (size, size) pixels."""
    for i, hair in enumerate(HAIR):
        for j, backdrop in enumerate(PLATES):
            yield make_scene(hair, backdrop, size, np.random.default_rng([i, j]))


def make_scene(hair: str, backdrop: str, size: int, rng: np.random.Generator) -> Scene:
    """Return one scene."""
    labels = _draw(hair, size, rng)
    shades = np.array(HAIR[hair][0]) * rng.uniform(0.75, 1.25, (SHADES, 1))
    palette = np.concatenate([[(0, 0, 0), SKIN, SHIRT], np.clip(shades, 0, 255)])  # by label
    colours = srgb_to_linear(palette / 255.0).astype(np.float32)
    opaque = (labels > 0).astype(np.float32)
    alpha = _lens(cv2.resize(opaque, (size, size), interpolation=cv2.INTER_AREA))
    front = np.stack(
        [
            cv2.resize(colours[labels, c], (size, size), interpolation=cv2.INTER_AREA)
            for c in range(3)
        ],
        axis=-1,
    )
    # Light falls off across the head, as from a lamp at one side.
    light = 1.0 + 0.2 * cv2.resize(rng.uniform(-1, 1, (4, 4)), (size, size), interpolation=2)
    plate = (plain if backdrop == "plain" else cluttered)(rng, size)
    shown = plate * (1 - _shadow(size))[..., None]
    seen = _lens(front * light[..., None])
    frame = seen + (1 - alpha[..., None]) * shown
    return Scene(
        name=f"{hair} {backdrop}",
        frame=exposed(frame * np.array(GAIN), rng),
        plate=exposed(plate, rng),
        valid=np.ones((size, size), bool),
        true=alpha.astype(np.float32),
        front=seen * np.array(GAIN),
    )


def plain(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a grey studio backdrop (size, size, 3), linear light, brighter in the middle."""
    y, x = np.mgrid[0:size, 0:size] / size - 0.5
    bright = 0.45 - 0.25 * (x**2 + y**2)
    return bright[..., None] * (1 + 0.03 * rng.uniform(-1, 1, 3))


def cluttered(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw blotches, boxes, cables and fine texture (size, size, 3), linear light."""
    coarse = rng.uniform(0.08, 0.7, (9, 9, 3)).astype(np.float32)
    image = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    for _ in range(14):
        x, y, w, h = (int(v) for v in rng.uniform(0.04, 0.9, 4) * size)
        corner = (x + w // 4, y + h // 4)
        cv2.rectangle(image, (x, y), corner, rng.uniform(0.03, 0.8, 3).tolist(), -1)
    for _ in range(24):
        ends = rng.integers(0, size, (2, 2)).tolist()
        width = int(rng.integers(1, 4))
        cv2.line(image, ends[0], ends[1], rng.uniform(0.02, 0.8, 3).tolist(), width, cv2.LINE_AA)
    fine = cv2.GaussianBlur(rng.normal(size=(size, size, 3)), (0, 0), 1.5)
    return cv2.GaussianBlur(np.clip(image, 0.02, 0.9) * (1 + 0.4 * fine), (0, 0), 0.7)


def exposed(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the 8-bit sRGB picture of linear light (H, W, 3), with a sensor's noise."""
    return srgb8(noisy(linear, rng))


def noisy(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return linear light (H, W, 3) with a sensor's noise."""
    deviation = np.hypot(READ, SHOT * np.sqrt(np.clip(linear, 0, None)))
    return linear + rng.normal(size=linear.shape) * deviation


def srgb8(linear: np.ndarray) -> np.ndarray:
    """Return linear light as 8-bit sRGB."""
    return np.rint(255 * linear_to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)


def _lens(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), LENS)


def _shadow(size: int) -> np.ndarray:
    """Return the share of light (size, size) that a broad soft shadow beside the head takes."""
    y, x = np.mgrid[0:size, 0:size] / size
    return SHADOW * np.exp(-(((x - 0.85) / 0.12) ** 2) - ((y - 0.6) / 0.25) ** 2)


def _draw(hair: str, size: int, rng: np.random.Generator) -> np.ndarray:
    """Label (size * FINE,) * 2 uint8 of shirt, skin and hair."""
    s = size * FINE
    labels = np.zeros((s, s), np.uint8)
    cv2.ellipse(labels, (s // 2, int(1.08 * s)), (int(0.4 * s), int(0.26 * s)), 0, 0, 360, 2, -1)
    cv2.rectangle(labels, (int(0.43 * s), int(0.65 * s)), (int(0.57 * s), int(0.88 * s)), 1, -1)
    cv2.ellipse(labels, (s // 2, int(0.43 * s)), (int(0.22 * s), int(0.25 * s)), 0, 0, 360, 3, -1)
    strands = HAIR[hair][1]
    _strands(labels, hair, 2 * strands, (0.6, 0.9), rng)
    cv2.ellipse(labels, (s // 2, int(0.52 * s)), (int(0.17 * s), int(0.24 * s)), 0, 0, 360, 1, -1)
    _strands(labels, hair, strands, (0.96, 0.96), rng)
    return labels


def _strands(
    labels: np.ndarray, hair: str, count: int, roots: tuple[float, float], rng: np.random.Generator
) -> None:
    """Draw strands with roots between two shares of the cap's radius."""
    s = len(labels)
    _, _, reach, curl = HAIR[hair]
    along = np.linspace(0, 1, 40)
    for _ in range(count):
        angle, share = rng.uniform(0.85 * np.pi, 2.15 * np.pi), rng.uniform(*roots)
        start = np.array([0.5, 0.43]) + share * np.array(
            [0.22 * np.cos(angle), 0.25 * np.sin(angle)]
        )
        turn = angle + rng.normal() * 0.6 + rng.normal() * along
        turn += (
            curl * rng.uniform(0.5, 1.5) * np.sin(rng.uniform(15, 40) * along + 6 * rng.random())
        )
        step = rng.uniform(0.02, reach) / len(along)
        way = start + step * np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
        width = max(2, round(FINE * rng.uniform(0.2, 1.2)))
        points = [(way * s).round().astype(np.int32)]
        cv2.polylines(labels, points, False, int(rng.integers(3, 3 + SHADES)), width)
