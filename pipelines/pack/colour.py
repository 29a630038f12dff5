"""The colours of a sample: those of the subject alone, and equal between the rig's cameras.

A soft pixel of the footage holds light of the plate: shown before another background it carries a
rim of the studio. Where the plate is known, the likeliest colour of the subject is that of Chuang
et al. 2001 with alpha and plate given; where it is not, the subject's colours nearby stand in.
"""

from __future__ import annotations

import numpy as np

from express50.files.images import linear_to_srgb
from pipelines.matte.opacity import local_colours, to_light
from pipelines.matte.plates import exposed, exposure_gain
from pipelines.pack.crop import Crop, cut_image

REACH_SHARE = 0.008  # of the image's longer side: how far away colours may be taken from
SPREAD = 0.25  # share by which a strand may be brighter or darker than its neighbours
NOISE = 0.01  # deviation of linear light: a sensor's, compression's, and what alpha's error makes
SOLID = 0.98


def cut_own_colours(
    frame: np.ndarray, matte: np.ndarray, plate: np.ndarray | None, crop: Crop, size: int
) -> np.ndarray:
    """Cut a frame to (size, size, 3) with the subject's own colour in soft pixels.

    Args:
        frame: (H, W, 3) uint8 sRGB.
        matte: (H, W) uint8 of everything that stands before the plate, torso included.
        plate: (H, W, 3) uint8 clean plate, or None.
        crop: the square to cut.
        size: side of the result, pixels.
    """
    behind = None
    if plate is not None:
        behind = exposed(cut_image(plate, crop, size), exposure_gain(frame, plate))
    return own_colours(cut_image(frame, crop, size), cut_image(matte, crop, size), behind)


def own_colours(image: np.ndarray, alpha: np.ndarray, plate: np.ndarray | None) -> np.ndarray:
    """Replace the colours of an image (H, W, 3) uint8 sRGB where 0 < alpha < 1.

    Args:
        image: the frame, (H, W, 3) uint8 sRGB.
        alpha: (H, W) uint8.
        plate: what stands behind, in the frame's exposure, (H, W, 3) in 8-bit steps; or None.

    Raises:
        ValueError: sizes differ.
    """
    if alpha.shape != image.shape[:2] or (plate is not None and plate.shape != image.shape):
        raise ValueError(
            f"image {image.shape}, alpha {alpha.shape} and plate "
            f"{None if plate is None else plate.shape} differ in size"
        )
    opacity = alpha.astype(np.float32) / 255
    soft = (alpha > 0) & (alpha < 255)
    solid = (opacity >= SOLID).astype(np.float32)
    if not soft.any() or not solid.any():
        return image
    light = to_light(image, linear=True)
    reach = max(1.0, REACH_SHARE * max(image.shape[:2]))
    mean, covariance = local_colours(light, solid, soft, reach, SPREAD)
    share = opacity[soft].astype(np.float64)[:, None]
    if plate is None:
        # Mostly subject: what is seen is as good a guess as what is nearby.
        colour = mean + share**4 * (light[soft] - mean)
    else:
        behind = to_light(plate, linear=True)[soft]
        rest = light[soft] - (1 - share) * behind - share * mean
        square = share[..., None] ** 2
        gain = np.linalg.solve(square * covariance + NOISE**2 * np.eye(3), rest[..., None])
        colour = mean + share * (covariance @ gain)[..., 0]
    out = image.copy()
    out[soft] = np.rint(255 * linear_to_srgb(np.clip(colour, 0, 1)))
    return out
