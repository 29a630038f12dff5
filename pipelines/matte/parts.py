"""Parts of the body by the user's segmentation network, and the head cut off the torso by them.

Sapiens (Khirodkar et al. 2024), body-part segmentation as TorchScript: RGB at 1024 x 768 less a
mean and over a deviation in 8-bit steps, scores of 28 classes out (its ``lite/demo/vis_seg.py``
and ``docs/SEG_README.md``). Face and neck are one class there.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.matte.config import PARTS
from pipelines.matte.learned import resized
from pipelines.matte.networks import Network, Role

SAPIENS = Role(setting="segmentation", inputs=("image",))
HEIGHT, WIDTH = 1024, 768
MEAN = np.array([123.5, 116.5, 103.5], np.float32)
DEVIATION = np.array([58.5, 57.0, 57.5], np.float32)
CLASSES = 28
HEAD = ("face_neck", "hair", "lips", "teeth", "tongue")
_IDS = {"apparel": (1,), "face_neck": (2,), "hair": (3,), "lips": (23, 24), "teeth": (25, 26)}
_IDS |= {"background": (0,), "tongue": (27,), "body": tuple(range(4, 23))}
_PART_OF_CLASS = np.array(
    [next(i for i, part in enumerate(PARTS) if k in _IDS[part]) for k in range(CLASSES)], np.uint8
)


def segment(network: Network, frame: np.ndarray) -> np.ndarray:
    """Labels (H, W) uint8, indices into PARTS, of a frame (H, W, 3) uint8.

    Raises:
        StageError: the network failed, or gave other than 28 finite scores a pixel.
    """
    height, width = network.size or (HEIGHT, WIDTH)
    small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_LINEAR)
    scores = network((small.astype(np.float32) - MEAN) / DEVIATION)
    if scores.ndim != 3 or len(scores) != CLASSES:
        raise network.error(
            f"gave shape {scores.shape}, expected ({CLASSES}, height, width) of Sapiens' body parts"
        )
    best = np.full(frame.shape[:2], -np.inf, np.float32)
    labels = np.zeros(frame.shape[:2], np.uint8)
    # Class by class: 28 scores a pixel of a 4K frame would take a gigabyte.
    for part, score in zip(_PART_OF_CLASS, scores, strict=True):
        large = resized(score, *frame.shape[:2])
        wins = large > best
        best[wins] = large[wins]
        labels[wins] = part
    return labels


def part_mask(labels: np.ndarray, *names: str) -> np.ndarray:
    """Pixels (H, W) bool of labels (H, W) that show one of the named PARTS."""
    return np.isin(labels, [PARTS.index(name) for name in names])


def head_alpha(alpha: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Alpha (H, W) of the head alone by labels (H, W) of the parts.

    What is neither head nor body (strands that the network calls background, glasses, hats,
    collars) goes with the nearer of the two; the cut is a pixel wide. No head gives an empty
    matte, no body leaves all.
    """
    head, body = part_mask(labels, *HEAD), part_mask(labels, "body")
    if not head.any() or not body.any():
        return alpha * np.float32(head.any())
    nearer = _distance(body) - _distance(head)
    return alpha * np.clip(0.5 + nearer / 2, 0, 1).astype(np.float32)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance (H, W) to the nearest pixel of a mask (H, W)."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
