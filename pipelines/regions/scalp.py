"""Whether the scalp bears hair, by the colours of a few views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.contract.segmentation_labels import LABELS
from pipelines.regions.labels import SCALP

SOLID = 0.99  # alpha over which a pixel's colour is the subject's alone
LEAST = 30  # pixels of skin and of scalp that a view needs to have a say
MOST = 4000  # pixels of each that it gives
FLOOR = 2.0  # steps of Lab under which a spread of colours is noise
ALIKE = 4.0  # spreads of the face's own colours from their middle
BARE = 0.7  # share of the scalp in the face's colours that makes it bare


@dataclass(frozen=True)
class Votes:
    """Pixels of scalp that a view compared with its face, and how many are of its colours."""

    compared: int
    alike: int


@dataclass(frozen=True)
class Scalp:
    """Whether the scalp is skin, and the share of it in the face's colours; None: not known."""

    is_skin: bool
    skin_coloured: float | None


def scalp_votes(rgb: np.ndarray, labels: np.ndarray, alpha: np.ndarray) -> Votes:
    """Compare the scalp of one view with its face: no camera's gain or light is another's.

    Args:
        rgb: (H, W, 3) uint8 sRGB.
        labels: (H, W) of the mesh, SCALP among them.
        alpha: (H, W) in [0, 1].
    """
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    skin, scalp = (
        _spread(lab[(labels == label) & (alpha > SOLID)].astype(np.float32))
        for label in (LABELS.index("skin"), SCALP)
    )
    if min(len(skin), len(scalp)) < LEAST:
        return Votes(0, 0)
    middle = np.median(skin, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(skin - middle), axis=0), FLOOR)
    away = np.sqrt((((scalp - middle) / spread) ** 2).sum(1))
    return Votes(len(scalp), int((away < ALIKE).sum()))


def _spread(rows: np.ndarray) -> np.ndarray:
    """At most MOST rows of (n, 3), evenly chosen."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, MOST).astype(int))] if len(rows) else rows


def decide(votes: Sequence[Votes]) -> Scalp:
    """Bare where most of the compared scalp is of the face's colours."""
    compared = sum(vote.compared for vote in votes)
    if not compared:
        return Scalp(False, None)
    share = round(sum(vote.alike for vote in votes) / compared, 4)
    return Scalp(share > BARE, share)
