"""Measure labels, warn of doubtful views and draw the contact sheet."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.contract.segmentation_labels import COLOURS, LABELS
from express50.files.images import contact_sheet, fit_into, write_image

AGREEMENT = 0.85  # a camera with less of the tracked mesh inside its matte is warned of
SHOWN = 4  # cameras in the contact sheet
TILE = (260, 260)


def label_shares(labels: np.ndarray) -> dict[str, float]:
    """Measure the share of the image that each label covers."""
    counts = np.bincount(labels.ravel(), minlength=len(LABELS)) / labels.size
    return {name: round(float(share), 6) for name, share in zip(LABELS, counts, strict=True)}


def mesh_fit(mesh: np.ndarray, alpha: np.ndarray, head: np.ndarray) -> dict[str, float]:
    """Compare a mesh's silhouette (H, W) bool with a matte (H, W) and the head's matte (H, W)."""
    body, top = alpha > 0.5, head > 0.5
    either = int((mesh | top).sum())
    return {
        "mesh_in_matte": round(float(body[mesh].mean()) if mesh.any() else 0.0, 4),
        "mesh_iou_head": round(int((mesh & top).sum()) / either if either else 0.0, 4),
    }


def view_warning(figures: dict) -> str | None:
    """Explain what is doubtful about a camera's figures; None if nothing is.

    ``figures`` holds ``mesh_in_frame``, ``mesh_in_matte``, ``head`` and ``labels``.
    """
    if not figures["mesh_in_frame"]:
        return "no head found: the tracked mesh is not in this camera's image"
    if figures["labels"]["background"] == 1:
        return "the matte is empty"
    if figures["head"] == 0:
        return "the head's matte is empty: the matte holds nothing but torso"
    if figures["mesh_in_matte"] < AGREEMENT:
        return (
            f"mesh and matte disagree: {figures['mesh_in_matte']:.0%} of the tracked mesh lies in"
            f" the matte, under {AGREEMENT:.0%}; one of the two failed"
        )
    return None


def picture_row(image: np.ndarray, labels: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """Draw tiles of the frame, of labels over it and of the head on a plain ground.

    They show the window of the subject only.
    """
    box = subject_box(labels)
    image, labels, alpha = image[box], labels[box], alpha[box]
    painted = 0.35 * image + 0.65 * COLOURS[labels]
    painted = np.where((labels > 0)[..., None], painted, 0.4 * image).astype(np.uint8)
    # A colour that neither skin nor hair has, so that leftovers of plate and torso show.
    ground = np.array([40, 200, 90], np.float32)
    cut = alpha[..., None] * image + (1 - alpha[..., None]) * ground
    return [fit_into(picture, *TILE) for picture in (image, painted, cut.astype(np.uint8))]


def subject_box(labels: np.ndarray) -> tuple[slice, slice]:
    """Find the window of the labelled pixels with a margin, or the whole image without any."""
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
    """Draw a strip (24, width, 3) uint8 of every label's colour and name."""
    strip = np.full((24, width, 3), 24, np.uint8)
    step = width / (len(LABELS) - 1)
    for place, name in enumerate(LABELS[1:]):
        x = round(place * step)
        strip[6:18, x + 3 : x + 13] = COLOURS[place + 1].astype(np.uint8)
        cv2.putText(
            strip, name, (x + 16, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (255,) * 3, 1, cv2.LINE_AA
        )
    return strip


def write_picture(out: Path, rows: dict[str, list[np.ndarray]], figures: dict[str, dict]) -> None:
    """Write a contact sheet of cameras from front to back, with a legend.

    ``rows`` holds the pictures of each camera, ``figures`` its ``labels``' shares.
    """

    def face(name: str) -> float:
        return sum(figures[name]["labels"][part] for part in ("skin", "lips", "eyes"))

    names = sorted(rows, key=lambda name: -face(name))
    chosen = np.unique(np.linspace(0, len(names) - 1, SHOWN).round().astype(int))
    pairs = [[names[k] for k in chosen[start : start + 2]] for start in range(0, len(chosen), 2)]
    sheet = contact_sheet(
        [[picture for name in pair for picture in rows[name]] for pair in pairs],
        [", ".join(pair) for pair in pairs],
        tile=TILE,
    )
    (out / "qc").mkdir()
    sheet = np.concatenate([legend(sheet.shape[1]), sheet])
    write_image(out / "qc" / "regions.jpg", sheet, quality=90)
