"""What labels look like and what is odd about them: figures, warnings, contact sheet."""

from __future__ import annotations

import cv2
import numpy as np

from express50.contract.segmentation_labels import COLOURS, LABELS


def label_shares(labels: np.ndarray) -> dict[str, float]:
    """Share of the image that each label covers."""
    counts = np.bincount(labels.ravel(), minlength=len(LABELS)) / labels.size
    return {name: round(float(share), 6) for name, share in zip(LABELS, counts, strict=True)}


def mesh_fit(mesh: np.ndarray, alpha: np.ndarray, head: np.ndarray) -> dict[str, float]:
    """How a mesh's silhouette (H, W) bool fits a matte (H, W) and its head's (H, W), in [0, 1]."""
    body, top = alpha > 0.5, head > 0.5
    either = int((mesh | top).sum())
    return {
        "mesh_in_matte": round(float(body[mesh].mean()) if mesh.any() else 0.0, 4),
        "mesh_iou_head": round(int((mesh & top).sum()) / either if either else 0.0, 4),
    }


def view_warning(figures: dict, least: float) -> str | None:
    """What is odd about a camera's figures, if anything.

    Args:
        figures: ``mesh_in_frame``, ``mesh_in_matte``, ``head`` and ``labels`` of one camera.
        least: share of the mesh that must lie in the matte.
    """
    if not figures["mesh_in_frame"]:
        return "no head found: the tracked mesh is not in this camera's image"
    if figures["labels"]["background"] == 1:
        return "the matte is empty"
    if figures["head"] == 0:
        return "the head's matte is empty: all that the matte holds is torso"
    if figures["mesh_in_matte"] < least:
        return (
            f"mesh and matte disagree: {figures['mesh_in_matte']:.0%} of the tracked mesh lies in"
            f" the matte, under {least:.0%}; one of the two failed"
        )
    return None


def picture_row(
    image: np.ndarray, labels: np.ndarray, alpha: np.ndarray, box: tuple[slice, slice]
) -> list[np.ndarray]:
    """Frame, labels over the frame, head on a plain ground; the window of the subject alone."""
    image, labels, alpha = image[box], labels[box], alpha[box]
    painted = 0.35 * image + 0.65 * COLOURS[labels]
    painted = np.where((labels > 0)[..., None], painted, 0.4 * image).astype(np.uint8)
    # A colour that neither skin nor hair has shows plate and torso that were let through.
    ground = np.array([40, 200, 90], np.float32)
    cut = alpha[..., None] * image + (1 - alpha[..., None]) * ground
    return [image, painted, cut.astype(np.uint8)]


def subject_box(labels: np.ndarray) -> tuple[slice, slice]:
    """The square-ish window of what is labelled, with a little room; all where nothing is."""
    points = cv2.findNonZero((labels > 0).astype(np.uint8))
    if points is None:
        return np.s_[:, :]
    x, y, width, height = cv2.boundingRect(points)
    room = max(width, height) // 20 + 1
    return (
        slice(max(0, y - room), y + height + room),
        slice(max(0, x - room), x + width + room),
    )


def legend(width: int) -> np.ndarray:
    """A strip (24, width, 3) uint8 of every label's colour and name."""
    strip = np.full((24, width, 3), 24, np.uint8)
    step = width / (len(LABELS) - 1)
    for place, name in enumerate(LABELS[1:]):
        x = round(place * step)
        strip[6:18, x + 3 : x + 13] = COLOURS[place + 1].astype(np.uint8)
        cv2.putText(
            strip, name, (x + 16, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (255,) * 3, 1, cv2.LINE_AA
        )
    return strip
