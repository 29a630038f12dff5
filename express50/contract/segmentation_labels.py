"""Define the segmentation labels: names, colours, and those that belong to the head."""

from __future__ import annotations

import numpy as np

LABELS = (
    "background", "skin", "ears", "lips", "eyes", "teeth", "tongue", "mouth", "hair", "neck",
    "torso", "apparel", "hand",
)  # fmt: skip
"""Names of the labels by value; new ones are added at the end, so that older shards stay read.

Apparel is glasses with their lenses, face masks, and what a network calls so, such as hats.
"""
HEAD = LABELS[1:10]
TORSO = LABELS.index("torso")
# One colour per label; the background is black.
COLOURS = np.array(
    [[0, 0, 0], [240, 150, 120], [250, 210, 60], [230, 40, 90], [90, 220, 255], [255, 255, 255],
     [170, 60, 200], [70, 0, 30], [70, 110, 255], [170, 200, 90], [50, 140, 90], [255, 120, 0],
     [255, 200, 190]],
    np.uint8,
)  # fmt: skip


def label_mask(labels: np.ndarray, *names: str) -> np.ndarray:
    """Return the pixels (H, W) bool of labels (H, W) that show one of the named LABELS."""
    return np.isin(labels, [LABELS.index(name) for name in names])
