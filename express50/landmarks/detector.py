"""Find the 68 landmarks of the one head in a frame, without knowing where it is.

A coarse pass looks at the whole frame (then at turned and ever smaller windows, only where those
before show no face); crops about the points found so far are then refined, levelled by the line of
the eyes. The last look is taken in several crops at once: where these do not agree there is no
face.
Points are the projections of the 3D landmarks, also where the head hides them: views of several
cameras can be triangulated. Points that the head or something before it hides come with a low
confidence. Beside them is the outline of the face, as published marks have the points 0 to 16.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
import torch

from express50.geometry.conventions import affine_to_opencv
from express50.landmarks.network import (
    CROP,
    LEFT_EYE,
    MIRROR,
    MOUTH,
    CloseNet,
    LandmarkNet,
    face_box,
)

# A point whose error scale is this share of the face box has half the confidence.
HALF_CONFIDENCE_SHARE = 0.025
# Points outside a face are vague: at this share the score is halved.
VAGUE_SHARE = 0.06
# Where no face scores as much the search continues.
FOUND_SCORE = 0.5
# The network sees a face whose box is 0.5 to 1.4 of the one it was trained on, up to a quarter of
# the window off its middle: the next windows are smaller by SHRINK, and STEP of their side apart.
SHRINK, STEP = 0.55, 0.5
SMALLEST = 0.25
BATCH = 32  # windows at a time
KEEP_SHARE = 0.8
# The last look is taken in several crops, in shares of the trained one, some mirrored. On a face,
# profiles too, they differ by less than DIFFER_SHARE of the face box (median point), on walls,
# coins and backs of heads by more: there the score falls.
LAST = ((0.75, False), (1.0, True), (1.0, False), (1.25, True))
DIFFER_SHARE = 0.013
# A close-up of the mouth is trusted where most of it is as likely in sight: not in profile.
MOUTH_SEEN = 0.75


@dataclass(frozen=True)
class Detection:
    """Landmarks of one image.

    Attributes:
        points: (68, 2) pixels, corner origin, iBUG-68 order.
        sigma: (68,) expected error in pixels (the scale of a Laplace distribution).
        confidence: (68,) in 0..1: the score, times how surely the point is seen, lowered where
            sigma is large.
        score: in 0..1, how surely a face looks towards the camera: the network's probability,
            lowered where the points are vague or other crops give other points. Low for backs of
            heads and where no head is visible.
        outline: (17, 2) pixels, the edge of the face from ear to ear; None where it is not known.
    """

    points: np.ndarray
    sigma: np.ndarray
    confidence: np.ndarray
    score: float
    outline: np.ndarray | None = None

    def marks(self) -> np.ndarray:
        """Return points (68, 2) as published marks have them: 0 to 16 lie on the outline."""
        if self.outline is None:
            return self.points
        return np.concatenate([self.outline, self.points[len(self.outline) :]])


class Look(NamedTuple):
    """A crop to be seen: the pyramid of an image and a placed crop (2, 3)."""

    pyramid: list[np.ndarray]
    window: np.ndarray


@dataclass(frozen=True)
class _Place:
    """A face in an image; see `Detection`."""

    points: np.ndarray
    outline: np.ndarray
    sigma: np.ndarray
    seen: np.ndarray
    score: float


def detect(
    net: LandmarkNet,
    image: np.ndarray,
    refinements: int = 2,
    smallest: float = SMALLEST,
) -> Detection:
    """Detect the landmarks of the most face-like place in an image.

    Args:
        net: From `load_network`.
        image: (H, W, 3) uint8 RGB; any size.
        refinements: Looks in sequence after the coarse pass; the last is taken in several crops,
            some of them mirrored.
        smallest: Side of the smallest windows searched, of the image's longer side. A face is
            found in windows of up to three times its width; each further size, SHRINK of the one
            before, costs about three times as much where no face is.

    Raises:
        ValueError: another shape or type.
    """
    return detect_many(net, [image], refinements, smallest)[0]


def detect_many(
    net: LandmarkNet,
    images: Sequence[np.ndarray],
    refinements: int = 2,
    smallest: float = SMALLEST,
) -> list[Detection]:
    """Detect as `detect` does in each of several images, of a frame set or clip, for less time.

    Raises:
        ValueError: an image of another shape or type.
    """
    for image in images:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
            raise ValueError(f"image is {image.dtype} {image.shape}, expected uint8 (H, W, 3)")
    pyramids = [make_pyramid(image) for image in images]
    best: list[_Place | None] = [None] * len(images)
    searches = [_searches(image.shape[1], image.shape[0], smallest) for image in images]
    left = dict(enumerate(searches))
    while left:
        windows = {one: next(search, None) for one, search in left.items()}
        left = {one: search for one, search in left.items() if windows[one] is not None}
        looks = [Look(pyramids[one], window) for one in left for window in windows[one] or ()]
        places = iter(_run(net, looks))
        coarse = [
            max(islice(places, len(windows[one] or ())), key=lambda place: place.score)
            for one in left
        ]
        found = _refined(net, [pyramids[one] for one in left], coarse, refinements)
        for one, place in zip(list(left), found, strict=True):
            held = best[one]
            if held is None or place.score > held.score:
                best[one] = held = place
            if held.score >= FOUND_SCORE:
                del left[one]
    found = [place for place in best if place is not None]
    return [_detection(place) for place in _with_close_ups(net, pyramids, found)]


def _detection(place: _Place) -> Detection:
    relative = place.sigma / (HALF_CONFIDENCE_SHARE * max(face_box(place.points)[1], 1e-6))
    confidence = place.score * place.seen / (1.0 + relative**2)
    return Detection(place.points, place.sigma, confidence, place.score, place.outline)


def _searches(width: int, height: int, smallest: float) -> Iterator[list[np.ndarray]]:
    """Yield windows to look in: the whole frame, it turned and smaller ones, smaller ones yet.

    At last, where smaller windows than usual are asked for, those of the first size turned: a
    photograph may lie on its side, the footage of a rig is known to do so or not.
    """
    longer = float(max(width, height))
    turned = [np.pi / 2, np.pi, 1.5 * np.pi]
    yield _windows(width, height, longer, 0.0)
    yield _windows(width, height, SHRINK * longer, 0.0) + [
        window for turn in turned for window in _windows(width, height, longer, turn)
    ]
    side = SHRINK
    while (side := side * SHRINK) >= smallest:
        yield _windows(width, height, side * longer, 0.0)
    if smallest < SMALLEST:
        yield [w for turn in turned for w in _windows(width, height, SHRINK * longer, turn)]


def _windows(width: int, height: int, side: float, turn: float) -> list[np.ndarray]:
    """Return windows of one size and turn (radians) that overlap and cover a frame."""
    rows = []
    for length in (height, width):
        room = max(0.0, length - side)
        count = 1 + int(np.ceil(room / (STEP * side)))
        rows.append(length / 2 + room * (np.linspace(-0.5, 0.5, count) if room else np.zeros(1)))
    return [place_window(np.array([x, y]), side, turn) for y in rows[0] for x in rows[1]]


def _refined(
    net: LandmarkNet, pyramids: list[list[np.ndarray]], places: list[_Place], refinements: int
) -> list[_Place]:
    """Refine a place per image by nearer crops, and judge it by whether the last ones agree."""
    places = list(places)
    straying = set[int]()
    for _ in range(refinements - 1):
        going = [one for one in range(len(places)) if one not in straying]
        looks = [Look(pyramids[one], window_about(places[one].points)) for one in going]
        for one, refined in zip(going, _run(net, looks), strict=True):
            if refined.score < KEEP_SHARE * places[one].score:
                # The crop went astray, as it may on a profile: the wider view knew better.
                straying.add(one)
            else:
                places[one] = refined
    looks = []
    for pyramid, place in zip(pyramids, places, strict=True):
        window = window_about(place.points)
        centre = window @ [CROP / 2, CROP / 2, 1.0]
        for scale, flipped in LAST:
            flip = np.diag([-1.0 if flipped else 1.0, 1.0])
            looks.append(Look(pyramid, place_crop(centre, scale * window[:, :2] @ flip, CROP)))
    found, count = _run(net, looks), len(LAST)
    return [
        _agreed(place, found[count * one : count * (one + 1)]) for one, place in enumerate(places)
    ]


def _agreed(place: _Place, looks: list[_Place]) -> _Place:
    """Join the last looks at a place; the score falls where these do not agree."""
    points = np.stack([look.points for look in looks])
    mean = points.mean(0)
    spread = np.linalg.norm(points - mean, axis=2).mean(0)
    together = _Place(
        mean,
        np.mean([look.outline for look in looks], axis=0),
        np.hypot(np.mean([look.sigma for look in looks], axis=0), spread),
        np.mean([look.seen for look in looks], axis=0),
        float(np.mean([look.score for look in looks])),
    )
    differ = np.median(spread) / (DIFFER_SHARE * max(face_box(mean)[1], 1e-6))
    good_mean = together.score >= KEEP_SHARE * place.score
    # Where they agree their mean is the better place, even if a profile's score is less so near.
    kept = together if differ < 1.0 or good_mean else place
    score = together.score if good_mean else place.score
    return replace(kept, score=float(score / (1.0 + differ**4)))


def place_window(centre: np.ndarray, side: float, angle: float) -> np.ndarray:
    """Place the network's crop: affine (2, 3) from crop pixels to image pixels, corner origin."""
    scale = side / CROP
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return place_crop(centre, turn, CROP)


def place_crop(centre: np.ndarray, turn: np.ndarray, size: int) -> np.ndarray:
    """Place a square crop about a point of an image.

    Args:
        centre: (2,) pixels of the image, corner origin.
        turn: (2, 2) from steps in the crop to steps in the image.
        size: side of the crop, pixels.

    Returns:
        affine (2, 3) from crop pixels to image pixels.
    """
    return np.concatenate([turn, (centre - turn @ [size / 2, size / 2])[:, None]], axis=1)


def place_level_crop(centre: np.ndarray, right: np.ndarray, size: int) -> np.ndarray:
    """Place a crop whose rows run along a direction of the image; ``right`` (2,) is one pixel."""
    turn = np.array([[right[0], -right[1]], [right[1], right[0]]])
    return place_crop(centre, turn, size)


def cut_crop(image: np.ndarray, window: np.ndarray, size: int) -> np.ndarray:
    """Cut a placed crop (size, size, 3) out of an image; its outermost pixels repeat."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_REPLICATE
    return cv2.warpAffine(
        image, affine_to_opencv(window), (size, size), flags=flags, borderMode=border
    )


def points_in_crop(window: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return crop pixels of image pixels (N, 2), for a placed crop (2, 3)."""
    inverse = np.linalg.inv(np.vstack([window, [0.0, 0.0, 1.0]]))
    return points @ inverse[:2, :2].T + inverse[:2, 2]


def window_about(points: np.ndarray) -> np.ndarray:
    """Place the crop that the network was trained on about landmarks (68, 2), the eyes level."""
    eyes = points[42:48].mean(0) - points[36:42].mean(0)
    down = points[8] - points[27]
    # The face's own down direction also holds in profile, where the eyes coincide.
    axis = eyes + np.array([down[1], -down[0]])
    angle = float(np.arctan2(axis[1], axis[0]))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre, side = face_box(points @ turn.T)
    return place_window(centre @ turn, max(side, 8.0), angle)


def close_window(
    net: CloseNet, points: np.ndarray, ids: np.ndarray, flipped: bool = False
) -> np.ndarray:
    """Place the close-up of landmarks `ids` (N,) of (68, 2); a flipped one is mirrored."""
    turn = net.zoom * window_about(points)[:, :2] @ np.diag([-1.0 if flipped else 1.0, 1.0])
    return place_crop(points[ids].mean(0), turn, net.crop)


def _with_close_ups(
    net: LandmarkNet, pyramids: list[list[np.ndarray]], places: list[_Place]
) -> list[_Place]:
    """Look at eyes and mouth again; a point stays where that is less sure of it."""
    found = []
    for pyramid, place in zip(pyramids, places, strict=True):
        if net.eyes is not None:
            eyes = ((LEFT_EYE, False), (MIRROR[LEFT_EYE], True))
            place = _looked_closer(net.eyes, pyramid, place, eyes)
        if net.mouth is not None and np.median(place.seen[MOUTH]) > MOUTH_SEEN:
            place = _looked_closer(net.mouth, pyramid, place, ((MOUTH, False),))
        found.append(place)
    return found


def _looked_closer(
    net: CloseNet,
    pyramid: list[np.ndarray],
    place: _Place,
    looks: tuple[tuple[np.ndarray, bool], ...],
) -> _Place:
    """Look at some landmarks of a face, by their ids and whether the close-up is flipped."""
    points, sigma = place.points.copy(), place.sigma.copy()
    windows = [close_window(net, place.points, *look) for look in looks]
    crops = np.stack([sample_window(pyramid, window, net.crop) for window in windows])
    with torch.inference_mode():
        answer = net(torch.from_numpy(crops).permute(0, 3, 1, 2).float() / 255.0)
    found, scales = (part.double().numpy() for part in answer)
    for (ids, _), window, at, scale in zip(looks, windows, found, np.exp(scales), strict=True):
        scale = scale * np.sqrt(abs(np.linalg.det(window[:, :2])))
        surer = scale < place.sigma[ids]
        points[ids[surer]] = (at @ window[:, :2].T + window[:, 2])[surer]
        sigma[ids[surer]] = scale[surer]
    return replace(place, points=points, sigma=sigma)


def make_pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Return the image and its halvings down to about the crop's size."""
    levels = [image]
    while max(levels[-1].shape[:2]) > 2 * CROP and min(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return levels


def sample_window(pyramid: list[np.ndarray], window: np.ndarray, size: int = CROP) -> np.ndarray:
    """Cut a crop (size, size, 3) uint8 out of the level whose resolution fits the window."""
    step = np.sqrt(abs(np.linalg.det(window[:, :2])))
    level = int(np.clip(np.floor(np.log2(max(step, 1e-6)) + 0.5), 0, len(pyramid) - 1))
    height, width = pyramid[0].shape[:2]
    shape = pyramid[level].shape
    scale = np.array([[shape[1] / width], [shape[0] / height]])
    return cut_crop(pyramid[level], window * scale, size)


def _run(net: LandmarkNet, looks: Sequence[Look]) -> list[_Place]:
    """Run the network on looks, `BATCH` at a time."""
    places = []
    for start in range(0, len(looks), BATCH):
        part = looks[start : start + BATCH]
        crops = np.stack([sample_window(look.pyramid, look.window) for look in part])
        # (N, H, W, 3) seen as (N, 3, H, W) lies in memory as channels-last already.
        with torch.inference_mode():
            output = net(torch.from_numpy(crops).permute(0, 3, 1, 2).float() / 255.0)
        scales = output.log_scale.double().exp().numpy()
        visible = torch.sigmoid(output.seen).double().numpy()
        scores = torch.sigmoid(output.logit).double().numpy()
        found, edges = output.points.double().numpy(), output.outline.double().numpy()
        places += [
            _placed(look.window, *row)
            for look, *row in zip(part, found, edges, scales, visible, scores, strict=True)
        ]
    return places


def _placed(
    window: np.ndarray,
    found: np.ndarray,
    edge: np.ndarray,
    sigma: np.ndarray,
    seen: np.ndarray,
    score: float,
) -> _Place:
    """Return what a crop showed in pixels of its image."""
    points, outline = (part @ window[:, :2].T + window[:, 2] for part in (found, edge))
    determinant = np.linalg.det(window[:, :2])
    sigma = sigma * np.sqrt(abs(determinant))
    if determinant < 0:
        points, sigma, seen = points[MIRROR], sigma[MIRROR], seen[MIRROR]
        outline = outline[::-1]
    vague = np.median(sigma) / (VAGUE_SHARE * max(face_box(points)[1], 1e-6))
    return _Place(points, outline, sigma, seen, float(score / (1.0 + vague**2)))


def follow(net: LandmarkNet, image: np.ndarray, window: np.ndarray) -> Detection:
    """Look once where a face is expected, as in a video's next frame.

    Args:
        net: From `load_network`.
        image: (H, W, 3) uint8 RGB; only what lies about the window is read.
        window: Affine (2, 3) from crop pixels to image pixels, as of `window_about`; the face may
            lie a quarter of its side off the middle.

    Returns:
        The face, of a low score where there is none. `detect` is surer: it takes several looks.
    """
    corners = window @ np.array([[0, CROP, 0, CROP], [0, 0, CROP, CROP], [1, 1, 1, 1]])
    size = np.array([image.shape[1], image.shape[0]])
    # A window beside the image still shows its outermost pixels.
    low = np.clip(np.floor(corners.min(1)) - 1, 0, size - 1).astype(int)
    high = np.clip(np.ceil(corners.max(1)) + 1, low + 1, size).astype(int)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    moved = window - np.column_stack([np.zeros((2, 2)), low])
    pyramid = make_pyramid(part)
    place = _with_close_ups(net, [pyramid], _run(net, [Look(pyramid, moved)]))[0]
    return _detection(replace(place, points=place.points + low, outline=place.outline + low))
