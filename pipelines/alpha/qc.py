"""What mattes look like and what is odd about them: figures, warnings, contact sheet."""

from __future__ import annotations

import cv2
import numpy as np

# A coverage this factor off the camera's median, or off the peak before, is reported as a jump.
JUMP = 1.35
EMPTY = 0.003
# Share of the image's top or of a side that the subject may cover before it counts as cut off.
MOST_CONTACT = 0.02


def border_contact(alpha: np.ndarray) -> dict[str, float]:
    """Share of each side of the image that the subject covers: where it is cut off."""
    sides = {"top": alpha[0], "right": alpha[:, -1], "bottom": alpha[-1], "left": alpha[:, 0]}
    return {side: round(float((line > 0.5).mean()), 4) for side, line in sides.items()}


def warnings(
    peaks: dict[str, int], coverage: dict[str, float], border: dict[str, dict[str, float]]
) -> list[dict[str, str]]:
    """Expressions with an empty matte, a sudden change of area, or a head that is cut off.

    Args:
        peaks: frame of each expression.
        coverage: share of the image that each covers.
        border: what `border_contact` gave for each.
    """
    middle = float(np.median(list(coverage.values())))
    odd: dict[str, str] = {}
    for expression, share in coverage.items():
        if share < EMPTY:
            odd[expression] = f"covers {share:.2%} of the image: empty"
        elif not middle / JUMP <= share <= middle * JUMP:
            odd[expression] = (
                f"covers {share:.1%} of the image, the camera's median is {middle:.1%}"
            )
    order = sorted(peaks, key=lambda expression: peaks[expression])
    for before, after in zip(order, order[1:], strict=False):
        small, large = sorted((coverage[before], coverage[after]))
        if not {before, after} & set(odd) and large > JUMP * small:
            odd[after] = (
                f"covers {coverage[after]:.1%} of the image, {coverage[before]:.1%} at the peak"
                f" before, {before}"
            )
    found = [{"what": expression, "why": why} for expression, why in odd.items()]
    for expression, sides in border.items():
        cut = [s for s in ("top", "right", "left") if sides[s] > MOST_CONTACT]
        if cut:
            share = max(sides[s] for s in cut)
            why = f"the subject leaves the image at the {' and '.join(cut)} (over {share:.0%})"
            found.append({"what": expression, "why": why})
    return found


def picture_row(image: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """Frame with the matte's outline, subject on a plain ground, alpha."""
    outline = image.copy()
    edges, _ = cv2.findContours(
        (alpha > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(outline, edges, -1, (255, 0, 0), max(1, max(alpha.shape) // 400))
    # A colour that neither skin nor hair has shows plate that was let through.
    ground = np.array([40, 200, 90], np.float32)
    cut = alpha[..., None] * image + (1 - alpha[..., None]) * ground
    grey = np.repeat((alpha * 255)[..., None], 3, axis=2)
    return [outline, cut.astype(np.uint8), grey.astype(np.uint8)]
