"""Label parts of the body by the user's segmentation network.

Sapiens (Khirodkar et al. 2024), body-part segmentation as TorchScript: RGB at 1024 x 768 minus a
mean and divided by a deviation in 8-bit steps in, scores of 28 classes out (its
``lite/demo/vis_seg.py`` and ``docs/SEG_README.md``). Face and neck are one class there.
"""

from __future__ import annotations

import cv2
import numpy as np

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.files.images import resize_area
from pipelines.networks import Network, Role

SAPIENS = Role(setting="regions.segmentation", inputs=("image",))
HEIGHT, WIDTH = 1024, 768
MEAN = np.array([123.5, 116.5, 103.5], np.float32)
DEVIATION = np.array([58.5, 57.0, 57.5], np.float32)
CLASSES = 28
_IDS = {"background": (0,), "apparel": (1,), "skin": (2,), "hair": (3,), "lips": (23, 24)}
_IDS |= {"teeth": (25, 26), "tongue": (27,), "hand": (5, 14), "torso": tuple(range(4, 23))}
LABEL_OF_CLASS = np.array(
    [LABELS.index(next(name for name in _IDS if k in _IDS[name])) for k in range(CLASSES)], np.uint8
)


def segment(network: Network, frame: np.ndarray) -> np.ndarray:
    """Label a frame (H, W, 3) uint8: indices (H, W) uint8 into LABELS.

    Raises:
        StageError: the network failed, or did not give 28 finite scores per pixel.
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
    # Class by class: 28 scores per pixel of a 4K frame would take a gigabyte.
    for part, score in zip(LABEL_OF_CLASS, scores, strict=True):
        large = resize_area(score, frame.shape[1], frame.shape[0])
        wins = large > best
        best[wins] = large[wins]
        labels[wins] = part
    return labels


def refined(labels: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Refine the network's labels (H, W): its skin takes the finer labels (H, W) of the mesh.

    The network has no eyes, ears and neck, and an inner mouth only where it shows teeth or tongue.
    """
    skin = labels == LABELS.index("skin")
    finer = label_mask(mesh, "ears", "eyes", "teeth", "tongue", "mouth", "neck")
    return np.where(skin & finer, mesh, labels)
