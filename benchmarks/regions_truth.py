"""True labels and true mattes of the head alone, from the twin's geometry."""

from __future__ import annotations

import numpy as np

from express50.cameras import Camera, resized
from express50.parts import LABELS
from express50.twin.body import Material
from express50.twin.truth import Truth
from pipelines.regions.labels import SCALP, head_labels

RAYS = 4  # a side of a pixel, for the share of it that the head fills
_PLAIN = {
    Material.EYE: "eyes", Material.TEETH: "teeth", Material.MOUTH: "mouth",
    Material.TONGUE: "tongue", Material.HAIR: "hair", Material.CLOTH: "torso",
}  # fmt: skip


def true_labels(truth: Truth, subject: str, frame: int, camera: Camera) -> np.ndarray:
    """Labels (H, W) uint8 of what each pixel's centre shows; skin between hairs counts as hair."""
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


def true_head_alpha(truth: Truth, subject: str, frame: int, camera: Camera) -> np.ndarray:
    """Share (H, W) of each pixel that shows the subject, but not the shirt."""
    fine = resized(camera, camera.width * RAYS, camera.height * RAYS)
    material, _ = truth.surface(subject, frame, fine)
    head = ((material >= 0) & (material != Material.CLOTH)).astype(np.float32)
    return head.reshape(camera.height, RAYS, camera.width, RAYS).mean((1, 3))
