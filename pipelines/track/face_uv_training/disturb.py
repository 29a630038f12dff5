"""Readings of face UV maps, and augmentations that make the network robust."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.conventions import corner_to_cell
from express50.geometry.sampling import bilinear
from pipelines.track.face_uv_map import HEIGHT, LIPS_APART, WIDTH

Rng = np.random.Generator
# Steps in which the inverse of a displacement is found.
TURNS = 6
# Landmarks that deep creases run along: where lips meet, twice; the upper lids with their lashes.
CREASES = (
    ((60, 61, 62, 63, 64), (60, 67, 66, 65, 64)),
    ((36, 37, 38, 39),),
    ((42, 43, 44, 45),),
)
# Fractional bits of OpenCV's drawing coordinates.
FINE = 4
# Share of the texels about a place whose displacement must be known.
LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Case:
    """One reading of a uv_map.

    Attributes:
        colors: (HEIGHT, WIDTH, 3) uint8, root of light.
        flow: (HEIGHT, WIDTH, 2) float16 texels: a texel shows what belongs so far to its right and
            below it.
        valid: (HEIGHT, WIDTH) bool, texels whose flow is known.
    """

    colors: np.ndarray
    flow: np.ndarray
    valid: np.ndarray


def covered(colors: np.ndarray, rng: Rng) -> np.ndarray:
    """Strands of hair and other things before the face, in some of the maps."""
    if rng.random() < 0.5:
        return colors
    out = np.ascontiguousarray(colors, dtype=np.float32)
    for _ in range(rng.integers(1, 5)):
        layer = out.copy()
        start = rng.uniform([0.0, -10.0], [WIDTH, 0.6 * HEIGHT])
        end = start + rng.normal(size=2) * [25.0, 40.0]
        ink = tuple(float(v) for v in rng.uniform(0.0, 0.8) * rng.uniform(0.6, 1.0, 3))
        points = np.rint([start, (start + end) / 2 + rng.normal(size=2) * 8, end]).astype(np.int32)
        cv2.polylines(layer, [points], False, ink, int(rng.integers(1, 9)))
        out += rng.uniform(0.3, 1.0) * (layer - out)
    return out


def photographed(colors: np.ndarray, rng: Rng) -> np.ndarray:
    """Blur and noise of cameras, exposure and contrast of a room."""
    colors = cv2.GaussianBlur(np.float32(colors), (0, 0), rng.uniform(0.25, 1.4))
    colors = colors * rng.uniform(0.6, 1.3) + rng.normal(size=3) * 0.02
    return colors + rng.normal(size=colors.shape) * rng.uniform(0.0, 0.02)


def warped(case: Case, rng: Rng) -> Case:
    """The same reading of a mesh that is off by some more, smooth in the map; maybe mirrored.

    A texel that shows what its neighbour showed belongs where the neighbour's did. Displacements
    are larger than a tracker's: a network that may expect small ones reports too small ones.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    coarse = rng.normal(size=(2, *rng.integers(2, 9, 2))) * rng.uniform(0.0, 3.5)
    fields = [cv2.resize(one, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for one in coarse]
    turn = rng.normal(size=(2, 2)) * 0.04
    broad = np.stack([x - WIDTH / 2, y - HEIGHT / 2], axis=2) @ turn + rng.normal(size=2) * 2.5
    shift = (rng.random() ** 0.5 * (np.stack(fields, axis=2) + broad)).astype(np.float32)
    at = x + shift[..., 0], y + shift[..., 1]
    colors = cv2.remap(case.colors, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    flow = cv2.remap(case.flow.astype(np.float32), *at, cv2.INTER_LINEAR) + shift
    valid = cv2.remap(case.valid.astype(np.float32), *at, cv2.INTER_LINEAR) > 0.99
    out = Case(colors, flow, valid)
    return mirrored(out) if rng.random() < 0.5 else out


def mirrored(case: Case) -> Case:
    """The same reading with the sides of the face exchanged."""
    flow = np.ascontiguousarray(case.flow[:, ::-1]) * np.array([-1.0, 1.0], np.float32)
    colors, valid = (np.ascontiguousarray(image[:, ::-1]) for image in (case.colors, case.valid))
    return Case(colors, flow, valid)


def where_seen(case: Case, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where a map shows the content of texels (N, 2), corner origin, and whether it does (N,).

    Displacements are known where something is seen and asked for where it belongs.
    """
    valid = case.valid.astype(np.float32)
    share = cv2.GaussianBlur(valid, (0, 0), 1.5)
    flow = cv2.GaussianBlur(case.flow.astype(np.float32) * valid[..., None], (0, 0), 1.5)
    flow = flow / np.maximum(share, 1e-3)[..., None]
    own = (texels + LIPS_APART).astype(np.float32)
    at = own
    for _ in range(TURNS):
        at = own - bilinear(flow, at)
    return at - LIPS_APART, bilinear(share, at) > LEAST_SHARE


def creased(colors: np.ndarray, at: np.ndarray, known: np.ndarray, rng: Rng) -> np.ndarray:
    """Dark lines where lips meet and along the upper lids, in most of the maps.

    Painted shadows are as coarse as the head model's vertices, and on a face these lines show best
    where its parts end.

    Args:
        colors: (HEIGHT, WIDTH, 3) uint8.
        at: (68, 2) texels of the landmarks, corner origin.
        known: (68,) bool, which of them the map shows.
        rng: of this map.
    """
    dark = np.zeros((HEIGHT, WIDTH), np.float32)
    for lines in CREASES:
        if rng.random() < 0.25 or not known[np.concatenate(lines)].all():
            continue
        one = np.zeros((HEIGHT, WIDTH), np.uint8)
        for line in lines:
            points = np.rint(corner_to_cell(at[list(line)]) * 2**FINE).astype(np.int32)
            width = int(rng.integers(1, 3))
            cv2.polylines(one, [points], False, 255, width, cv2.LINE_AA, FINE)
        soft = cv2.GaussianBlur(one.astype(np.float32) / 255.0, (0, 0), rng.uniform(0.3, 1.2))
        dark = np.maximum(dark, rng.uniform(0.1, 0.9) * soft)
    return np.rint(colors * (1.0 - dark[..., None])).astype(np.uint8)
