"""Parts of a subject: what a value in a picture of labels means, and which parts are the head."""

from __future__ import annotations

import numpy as np

LABELS = (
    "background", "skin", "ears", "lips", "eyes", "teeth", "tongue", "mouth", "hair", "neck",
    "torso", "apparel",
)  # fmt: skip
"""Names of the labels by value; apparel (glasses, hats) only a network can tell."""
HEAD = LABELS[1:10]
TORSO = LABELS.index("torso")


def label_mask(labels: np.ndarray, *names: str) -> np.ndarray:
    """Pixels (H, W) bool of labels (H, W) that show one of the named LABELS."""
    return np.isin(labels, [LABELS.index(name) for name in names])
