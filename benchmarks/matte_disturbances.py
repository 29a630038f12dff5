"""Add disturbances of a set, or other walls, to frames for ``benchmarks.matte_views``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from benchmarks.matte_scenes import cluttered, exposed, noisy, srgb8
from express50.geometry.cameras import Camera, pinhole, rays
from express50.geometry.pixels import srgb_to_linear

SHADE = 0.5  # share of linear light that the shadow takes; the key forgives a quarter
STAND = (0.06, 0.07, 0.05)  # linear light of the object
PATCH_M = 0.04  # radius of the patch
BUMP = (0.09, 0.04, 3.0)  # shares of the image's side, degrees

Wall = Callable[[np.random.Generator, int], np.ndarray]
"""Linear light (size, size, 3) of a wall, at random."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One camera of a moment: undistorted images and their truth."""

    camera: Camera  # as recorded, with distortion
    # frame, plate: (H, W, 3) uint8
    frame: np.ndarray
    plate: np.ndarray
    valid: np.ndarray  # (H, W) bool, pixels with footage
    true: np.ndarray  # (H, W) alpha
    depth: np.ndarray  # (H, W) metres, 0 where there is nothing


def undisturbed(shots: list[Shot]) -> list[Shot]:
    """Leave the shots as they are."""
    return shots


def shadow(shots: list[Shot]) -> list[Shot]:
    """Lay a deep soft shadow on the backdrop of three cameras in eight, elsewhere in each."""
    rng = np.random.default_rng(1)
    return [
        _behind(shot, np.zeros(3), SHADE * _blob(shot, rng)) if k % 8 in (0, 3, 5) else shot
        for k, shot in enumerate(shots)
    ]


def stand(shots: list[Shot]) -> list[Shot]:
    """Put a stand and a cable behind the subject in every fourth camera."""
    rng = np.random.default_rng(2)
    return [
        _behind(shot, np.array(STAND), _stand(shot, rng)) if k % 4 == 0 else shot
        for k, shot in enumerate(shots)
    ]


def person(shots: list[Shot]) -> list[Shot]:
    """Put another person behind the subject in every third camera, with the face to the camera."""
    front = shots[len(shots) // 2]
    size = front.true.shape[1::-1]
    light, rng = srgb_to_linear(front.frame / 255), np.random.default_rng(4)

    def joined(shot: Shot) -> Shot:
        across = rng.choice([-0.08, 0.48]) + rng.uniform(-0.05, 0.05)
        motion = np.array([[0.6, 0, across * size[0]], [0, 0.6, 0.4 * size[1]]])
        return _behind(
            shot, *(cv2.warpAffine(image, motion, size) for image in (light, front.true))
        )

    return [joined(shot) if k % 3 == 0 else shot for k, shot in enumerate(shots)]


def patch(shots: list[Shot]) -> list[Shot]:
    """Paint a patch of one colour on the skin; two cameras see the same colour behind it."""
    front = shots[len(shots) // 2]
    rows, columns = np.nonzero((front.depth > 0) & (front.true > 0.99))
    height, width = front.true.shape
    # On the cheek or so: somewhat off the middle of what the camera sees.
    pick = np.argmin((rows - 0.58 * height) ** 2 + (columns - 0.5 * width) ** 2)
    at = _points(front)[rows[pick], columns[pick]]
    colour = np.median(front.plate[front.valid], axis=0)
    chosen = {len(shots) // 2, len(shots) // 2 - 3}
    return [_painted(shot, at, colour, k in chosen) for k, shot in enumerate(shots)]


def bumped(shots: list[Shot]) -> list[Shot]:
    """Turn and roll one camera: frame, plate and truth move together."""
    k = len(shots) // 2 - 3
    return [*shots[:k], _moved(shots[k]), *shots[k + 1 :]]


DISTURBANCES: dict[str, Callable[[list[Shot]], list[Shot]]] = {
    "undisturbed": undisturbed,
    "shadow": shadow,
    "object": stand,
    "person": person,
    "patch": patch,
    "bumped": bumped,
}


def walls(shots: list[Shot], first: list[Shot]) -> dict[str, list[Shot]]:
    """Return the shots before other walls, with plates of them; `first` are those of one moment.

    `bland` is a grey wall with light falling off, `skin` and `shirt` have the colours of the person
    at that moment, `cluttered` is as in ``benchmarks.matte_scenes``; every camera sees another part
    of the room.
    """
    front = first[len(first) // 2]
    height, width = front.true.shape
    skin, shirt = (
        np.median(
            srgb_to_linear(front.frame[rows, columns] / 255)[front.true[rows, columns] > 0.99], 0
        )
        for rows, columns in (
            (
                slice(int(0.42 * height), int(0.5 * height)),
                slice(int(0.45 * width), int(0.55 * width)),
            ),
            (slice(int(0.93 * height), height), slice(int(0.4 * width), int(0.6 * width))),
        )
    )
    makers: dict[str, Wall] = {
        "bland": partial(_falling_off, colour=np.full(3, 0.42)),
        "skin": partial(_falling_off, colour=skin),
        "shirt": partial(_falling_off, colour=shirt),
        "cluttered": cluttered,
    }
    return {
        name: [
            before_wall(shot, make, np.random.default_rng([7, k])) for k, shot in enumerate(shots)
        ]
        for name, make in makers.items()
    }


def other_plates(shots: list[Shot]) -> dict[str, list[Shot]]:
    """Return the shots with plates that are not as they should be.

    `shifted` were taken from a little further on, `relit` in other light, `room` elsewhere.
    """
    elsewhere = zip(shots, [*shots[1:], *shots[:1]], strict=True)
    return {
        "shifted": [replace(shot, plate=_shifted(shot.plate)) for shot in shots],
        "relit": [replace(shot, plate=_relit(shot.plate)) for shot in shots],
        "room": [replace(shot, plate=other.plate) for shot, other in elsewhere],
    }


def _shifted(image: np.ndarray) -> np.ndarray:
    motion, size = np.array([[1, 0.004, 2.3], [-0.004, 1, -1.6]]), image.shape[1::-1]
    border = cv2.BORDER_REPLICATE
    return cv2.warpAffine(image, motion, size, flags=cv2.INTER_CUBIC, borderMode=border)


def _relit(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width] / max(height, width) - 0.5
    return srgb8(srgb_to_linear(image / 255) * (1.15 + 0.35 * x - 0.2 * y)[..., None])


def _falling_off(rng: np.random.Generator, size: int, colour: np.ndarray) -> np.ndarray:
    """Return a wall (size, size, 3) of one colour, linear light, brighter to one side."""
    y, x = np.mgrid[0:size, 0:size] / size - 0.5
    slope = rng.uniform(-0.3, 0.3, 2)
    return (1 + slope[0] * x + slope[1] * y)[..., None] * colour * rng.uniform(0.97, 1.03, 3)


def before_wall(shot: Shot, make: Wall, rng: np.random.Generator) -> Shot:
    """Return a shot before another wall; frame and plate have noise of their own."""
    height, width = shot.true.shape
    light = np.clip(make(rng, max(height, width))[:height, :width], 0.01, 0.95)
    shown = srgb_to_linear(shot.frame / 255)
    share = ((1 - shot.true) * shot.valid)[..., None]
    shown = shown + share * (noisy(light, rng) - srgb_to_linear(shot.plate / 255))
    return replace(shot, frame=srgb8(shown), plate=exposed(light, rng))


def _behind(shot: Shot, light: np.ndarray, cover: np.ndarray) -> Shot:
    """Return the shot with `light` (3,) or (H, W, 3) over its backdrop by `cover` (H, W)."""
    plate = srgb_to_linear(shot.plate / 255)
    change = ((1 - shot.true) * cover * shot.valid)[..., None] * (light - plate)
    return replace(shot, frame=srgb8(srgb_to_linear(shot.frame / 255) + change))


def _blob(shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """Draw a round soft shape (H, W) in [0, 1] in the upper half, at the left or right."""
    height, width = shot.true.shape
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    middle = rng.choice([0.15, 0.85]) + rng.uniform(-0.05, 0.05), rng.uniform(0.2, 0.6)
    size = rng.uniform(0.1, 0.16), rng.uniform(0.12, 0.2)
    away = np.hypot((x - middle[0]) / size[0], (y - middle[1]) / size[1])
    return np.clip((1.05 - away) / 0.1, 0, 1)


def _stand(shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """Draw an upright pole with a box on it and a cable across, (H, W) in [0, 1]."""
    height, width = shot.true.shape
    image = np.zeros((height, width), np.uint8)
    x = int(width * (rng.choice([0.1, 0.9]) + rng.uniform(-0.03, 0.03)))
    half, top = width // 18, int(height * rng.uniform(0.2, 0.4))
    cv2.rectangle(image, (x - half, top), (x + half, top + 3 * half), 255, -1)
    cv2.line(image, (x, top), (x, height), 255, max(2, width // 60), cv2.LINE_AA)
    end = (int(width * rng.uniform(0.3, 0.7)), 0)
    cv2.line(image, (x, top), end, 255, max(1, width // 120), cv2.LINE_AA)
    return image / 255


def _points(shot: Shot) -> np.ndarray:
    """Return world points (H, W, 3) of the true surface."""
    origin, directions = rays(pinhole(shot.camera))
    return origin + shot.depth[..., None] * directions


def _painted(shot: Shot, at: np.ndarray, colour: np.ndarray, behind: bool) -> Shot:
    """Paint the surface about a point (3,) in a colour (3,), 8-bit steps, perhaps the plate."""
    near = (np.linalg.norm(_points(shot) - at, axis=-1) < PATCH_M) & (shot.depth > 0)
    if not near.any():
        return shot
    noise = np.random.default_rng(3).normal(size=(2, *shot.true.shape, 3))
    on = cv2.blur(near.astype(np.float32), (3, 3))[..., None]
    frame = shot.frame + on * (colour + noise[0] - shot.frame)
    plate = shot.plate.astype(np.float64)
    if behind:
        wide = cv2.dilate(near.astype(np.uint8), np.ones((5, 5))).astype(bool)[..., None]
        plate = np.where(wide, colour + noise[1], plate)
    shown = [np.rint(np.clip(image, 0, 255)).astype(np.uint8) for image in (frame, plate)]
    return replace(shot, frame=shown[0], plate=shown[1])


def _moved(shot: Shot) -> Shot:
    height, width = shot.true.shape
    side = max(height, width)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), BUMP[2], 1.0)
    matrix[:, 2] += BUMP[0] * side, BUMP[1] * side

    def move(image: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(
            image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )

    return replace(
        shot, frame=move(shot.frame), plate=move(shot.plate), true=move(shot.true),
        depth=move(shot.depth), valid=move(shot.valid.astype(np.uint8)) > 0,
    )  # fmt: skip
