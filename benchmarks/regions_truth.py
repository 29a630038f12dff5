"""Render the twin's true labels and mattes of the head alone, and measure errors against them."""

from __future__ import annotations

import numpy as np

from benchmarks.truth import Truth
from express50.contract.segmentation_labels import LABELS
from express50.geometry.cameras import Camera, resized
from express50.twin.surface import Material
from pipelines.regions.geometry import SCALP, head_labels

_PLAIN = {
    Material.EYE: "eyes", Material.TEETH: "teeth", Material.MOUTH: "mouth",
    Material.TONGUE: "tongue", Material.HAIR: "hair", Material.CLOTH: "torso",
    Material.HAND: "hand", Material.APPAREL: "apparel", Material.LENS: "apparel",
}  # fmt: skip


def true_labels(truth: Truth, subject: str, frame: int, camera: Camera) -> np.ndarray:
    """Label what each pixel's centre shows (H, W) uint8; skin between hairs counts as hair."""
    material, vertex = truth.surface(subject, frame, camera)
    found = head_labels(truth.head_model(subject)).vertices
    hairy = truth.hairiness(subject) > 0.5
    found = np.where(
        found == SCALP, np.where(hairy, LABELS.index("hair"), LABELS.index("skin")), found
    )
    labels = np.zeros(material.shape, np.uint8)
    skin = material == Material.SKIN
    labels[skin] = found[vertex[skin]]
    for kind, name in _PLAIN.items():
        labels[material == kind] = LABELS.index(name)
    return labels


def true_head_alpha(
    truth: Truth, subject: str, frame: int, camera: Camera, rays: int = 2
) -> np.ndarray:
    """Measure the share (H, W) of each pixel that shows the subject without the shirt.

    Each pixel takes ``rays`` x ``rays`` rays.
    """
    fine = resized(camera, camera.width * rays, camera.height * rays)
    material, _ = truth.surface(subject, frame, fine)
    others = (Material.CLOTH, Material.HAND, Material.APPAREL)
    head = ((material >= 0) & ~np.isin(material, others)).astype(np.float32)
    return head.reshape(camera.height, rays, camera.width, rays).mean((1, 3))


def view_row(
    true: np.ndarray, true_alpha: np.ndarray, alpha: np.ndarray, labels: np.ndarray | None
) -> dict:
    """Measure a head matte (H, W), and count pixels of each label in both and in either."""
    both = either = np.zeros(len(LABELS), np.int64)
    if labels is not None:
        pairs = [(true == k, labels == k) for k in range(len(LABELS))]
        both = np.array([(a & b).sum() for a, b in pairs])
        either = np.array([(a | b).sum() for a, b in pairs])
    error = np.abs(alpha - true_alpha)
    return {"both": both, "either": either, "sad": error.sum(), "mae": error.mean()}


def iou_figures(rows: list[dict]) -> dict:
    """Compute IoU of each part over all pixels of views (of ``view_row``), and their mean.

    A part that neither truth nor labels have is None and does not count.
    """
    both, either = sum(row["both"] for row in rows), sum(row["either"] for row in rows)
    iou = {
        name: round(float(both[k] / either[k]), 4) if either[k] else None
        for k, name in enumerate(LABELS)
    }
    there = [value for value in iou.values() if value is not None]
    return {"iou_mean": round(float(np.mean(there)), 4), "iou": iou}
