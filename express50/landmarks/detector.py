"""Find the 68 landmarks of the one head in a frame, without knowing where it is.

A coarse pass looks at the whole frame and, while no face is found, at turned and ever smaller
windows. Crops around the points found so far, with the eyes level, then refine them. The last look
is taken in several crops at once: if these do not agree, there is no face.

Points are projections of 3D landmarks, even if the head hides them, so that views of several
cameras can be triangulated. Hidden points have a low confidence. The outline of the face is given
too, as published marks have it as points 0 to 16.
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
from express50.geometry.transforms import scale_of, transform_points
from express50.landmarks.network import (
    CROP,
    LEFT_EYE,
    MIRROR,
    MOUTH,
    CloseNet,
    LandmarkNet,
    as_input,
    face_box,
)

# A point whose error scale is this share of the face box has half the confidence.
HALF_CONFIDENCE_SHARE = 0.025
VAGUE_SHARE = 0.06  # of the face box: median error scale that halves the score; faces have less
FOUND_SCORE = 0.5  # the search continues until a face has this score
# The network finds faces of 0.5 to 1.4 times the trained size, up to a quarter of the window from
# its middle. So windows shrink by SHRINK, and lie STEP of their side apart.
SHRINK, STEP = 0.55, 0.5
SMALLEST = 0.25
SMALL = 0.08  # where that finds too little: people fill a rig's pictures, but not all others
BATCH = 32  # windows at a time
KEEP_SHARE = 0.8  # a nearer look replaces a place if it has this share of its score
# Sizes of the crops of the last look, relative to the trained one, and whether they are mirrored.
# On faces, even in profile, their median points differ by less than DIFFER_SHARE of the face box;
# on walls, coins and backs of heads they differ by more, so there the score falls.
LAST = ((0.75, False), (1.0, True), (1.0, False), (1.25, True))
DIFFER_SHARE = 0.013
MOUTH_SEEN = 0.75  # least median visibility of a mouth that is looked at closely: not in profile


@dataclass(frozen=True)
class Detection:
    """Landmarks of one image."""

    points: np.ndarray  # (68, 2) pixels, corner origin, iBUG-68 order
    sigma: np.ndarray  # (68,) expected error in pixels (the scale of a Laplace distribution)
    confidence: np.ndarray  # (68,) in 0..1: score times visibility, lowered if sigma is large
    # in 0..1, how likely a face looks towards the camera: the network's probability, lowered if the
    # points are vague or other crops give other points. Low for backs of heads and if no head is
    # visible.
    score: float
    outline: np.ndarray | None = None  # (17, 2) pixels, the edge of the face from ear to ear

    def marks(self) -> np.ndarray:
        """Return points (68, 2) as in published marks, where 0 to 16 lie on the outline."""
        if self.outline is None:
            return self.points
        return np.concatenate([self.outline, self.points[len(self.outline) :]])


class Look(NamedTuple):
    """A crop for the network: the pyramid of an image and a placed crop (2, 3)."""

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
    net: LandmarkNet, image: np.ndarray, refinements: int = 2, smallest: float = SMALLEST
) -> Detection:
    """Detect the landmarks of the most face-like place in an image (H, W, 3) uint8 RGB.

    `refinements` are the looks after the coarse pass; the last is taken in several crops, some of
    them mirrored. `smallest` is the side of the smallest windows searched, as a share of the
    image's longer side. A face is found in windows of up to three times its width. If there is no
    face, each smaller size costs about three times as much as the one before.

    Raises:
        ValueError: another shape or type.
    """
    return detect_many(net, [image], refinements, smallest)[0]


def detect_many(
    net: LandmarkNet, images: Sequence[np.ndarray], refinements: int = 2,
    smallest: float = SMALLEST, enough: int | None = None,
) -> list[Detection]:  # fmt: skip
    """Detect as `detect` does in several images, such as a frame set, in less time.

    Smaller windows are not searched once `enough` images show a face; by default, all must.

    Raises:
        ValueError: an image of another shape or type.
    """
    for image in images:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
            raise ValueError(f"image is {image.dtype} {image.shape}, expected uint8 (H, W, 3)")
    pyramids = [make_pyramid(image) for image in images]
    best: dict[int, _Place] = {}
    left = list(range(len(images)))  # those in which no face was found yet
    searches = [_searches(image.shape[1], image.shape[0], smallest) for image in images]
    for windows in zip(*searches, strict=True):
        looks = [Look(pyramids[one], window) for one in left for window in windows[one]]
        places = iter(_run(net, looks))
        coarse = [
            max(islice(places, len(windows[one])), key=lambda place: place.score) for one in left
        ]
        found = _refined(net, [pyramids[one] for one in left], coarse, refinements)
        for one, place in zip(left, found, strict=True):
            if one not in best or place.score > best[one].score:
                best[one] = place
        left = [one for one in left if best[one].score < FOUND_SCORE]
        if len(images) - len(left) >= (enough or len(images)):
            break
    faces = [best[one] for one in range(len(images))]
    return [_detection(place) for place in _with_close_ups(net, pyramids, faces)]


def detect_at(net: LandmarkNet, image: np.ndarray, window: np.ndarray) -> Detection:
    """Detect as `detect` does, but where a window (2, 3) says that the face is (`window_about`)."""
    pyramid = make_pyramid(image)
    coarse = _run(net, [Look(pyramid, window)])
    found = _refined(net, [pyramid], coarse, 2)
    return _detection(_with_close_ups(net, [pyramid], found)[0])


def _detection(place: _Place) -> Detection:
    relative = place.sigma / (HALF_CONFIDENCE_SHARE * max(face_box(place.points)[1], 1e-6))
    confidence = place.score * place.seen / (1.0 + relative**2)
    return Detection(place.points, place.sigma, confidence, place.score, place.outline)


def _searches(width: int, height: int, smallest: float) -> Iterator[list[np.ndarray]]:
    """Yield windows to look in: the whole frame, then turned and smaller ones, then smaller yet.

    Frames of any size have the same number of rounds. If smaller windows than usual are allowed,
    turned ones of the second size come last, because a photograph may lie on its side; for a
    rig's footage this is known.
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
    """Refine a place per image by nearer crops; its score falls if the last ones do not agree."""
    places = list(places)
    straying = set[int]()
    for _ in range(refinements - 1):
        going = [one for one in range(len(places)) if one not in straying]
        looks = [Look(pyramids[one], window_about(places[one].points)) for one in going]
        for one, refined in zip(going, _run(net, looks), strict=True):
            if refined.score < KEEP_SHARE * places[one].score:
                # The crop may miss a profile; then the wider view was better.
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
    """Average the last looks at a place; the score falls if these do not agree."""
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
    # If they agree, their mean is the better place, even if a profile scores less in close-ups.
    kept = together if differ < 1.0 or good_mean else place
    score = together.score if good_mean else place.score
    return replace(kept, score=float(score / (1.0 + differ**4)))


def place_window(centre: np.ndarray, side: float, angle: float) -> np.ndarray:
    """Place the network's crop: affine (2, 3) from crop pixels to image pixels, corner origin."""
    return place_level_crop(centre, side / CROP * np.array([np.cos(angle), np.sin(angle)]), CROP)


def place_crop(centre: np.ndarray, turn: np.ndarray, size: int) -> np.ndarray:
    """Return the affine (2, 3) from the pixels of a square crop to those of the image around it.

    Its middle is at `centre` (2,), its side is `size` pixels; `turn` (2, 2) leads from steps in the
    crop to steps in the image.
    """
    return np.concatenate([turn, (centre - turn @ [size / 2, size / 2])[:, None]], axis=1)


def place_level_crop(centre: np.ndarray, right: np.ndarray, size: int) -> np.ndarray:
    """Place a crop whose rows run along ``right`` (2,), the step of one of its pixels."""
    turn = np.array([[right[0], -right[1]], [right[1], right[0]]])
    return place_crop(centre, turn, size)


def cut_crop(image: np.ndarray, window: np.ndarray, size: int) -> np.ndarray:
    """Cut a placed crop (size, size, 3) out of an image, whose outermost pixels repeat."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_REPLICATE
    return cv2.warpAffine(
        image, affine_to_opencv(window), (size, size), flags=flags, borderMode=border
    )


def points_in_crop(window: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return crop pixels of image pixels (N, 2), for a placed crop (2, 3)."""
    inverse = np.linalg.inv(np.vstack([window, [0.0, 0.0, 1.0]]))
    return transform_points(inverse, points)


def window_about(points: np.ndarray) -> np.ndarray:
    """Place a crop as in training around landmarks (68, 2), with the eyes level."""
    eyes = points[42:48].mean(0) - points[36:42].mean(0)
    down = points[8] - points[27]
    # In profile the eyes coincide, so the direction from nose to chin counts too.
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
    """Look closely at eyes and mouth; points are replaced by those with a smaller sigma."""
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
    """Look at landmarks of a face again; a look has their ids, and whether it is mirrored."""
    points, sigma = place.points.copy(), place.sigma.copy()
    windows = [close_window(net, place.points, *look) for look in looks]
    crops = np.stack([sample_window(pyramid, window, net.crop) for window in windows])
    with torch.inference_mode():
        answer = net(as_input(crops))
    found, scales = (part.double().numpy() for part in answer)
    for (ids, _), window, at, scale in zip(looks, windows, found, np.exp(scales), strict=True):
        scale = scale * scale_of(window)
        surer = scale < place.sigma[ids]
        points[ids[surer]] = transform_points(window, at)[surer]
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
    step = scale_of(window)
    level = int(np.clip(np.floor(np.log2(max(step, 1e-6)) + 0.5), 0, len(pyramid) - 1))
    height, width = pyramid[0].shape[:2]
    shape = pyramid[level].shape
    scale = np.array([[shape[1] / width], [shape[0] / height]])
    return cut_crop(pyramid[level], window * scale, size)


def _run(net: LandmarkNet, looks: Sequence[Look]) -> list[_Place]:
    """Run the network on looks, `BATCH` at a time; places are in pixels of the looks' images."""
    places = []
    for start in range(0, len(looks), BATCH):
        part = looks[start : start + BATCH]
        crops = np.stack([sample_window(look.pyramid, look.window) for look in part])
        with torch.inference_mode():
            output = net(as_input(crops))
        scales = output.log_scale.double().exp().numpy()
        visible = torch.sigmoid(output.seen).double().numpy()
        scores = torch.sigmoid(output.logit).double().numpy()
        found, edges = output.points.double().numpy(), output.outline.double().numpy()
        rows = zip(part, found, edges, scales, visible, scores, strict=True)
        for look, points, outline, sigma, seen, score in rows:
            points, outline = (transform_points(look.window, one) for one in (points, outline))
            determinant = np.linalg.det(look.window[:, :2])
            sigma = sigma * np.sqrt(abs(determinant))
            if determinant < 0:
                points, sigma, seen = points[MIRROR], sigma[MIRROR], seen[MIRROR]
                outline = outline[::-1]
            vague = np.median(sigma) / (VAGUE_SHARE * max(face_box(points)[1], 1e-6))
            places.append(_Place(points, outline, sigma, seen, float(score / (1.0 + vague**2))))
    return places


def follow(net: LandmarkNet, image: np.ndarray, window: np.ndarray) -> Detection:
    """Find a face near where it is expected, as in a video's next frame, with one look.

    Only the window of the image (H, W, 3) uint8 RGB and some pixels around are read. `window` is an
    affine (2, 3) from crop to image pixels, from `window_about`; the face may be up to a quarter of
    its side off the middle. Without a face, the score is low; `detect` takes several looks, so it
    is surer.
    """
    corners = window @ np.array([[0, CROP, 0, CROP], [0, 0, CROP, CROP], [1, 1, 1, 1]])
    size = np.array([image.shape[1], image.shape[0]])
    # A window outside the image still shows the outermost pixels.
    low = np.clip(np.floor(corners.min(1)) - 1, 0, size - 1).astype(int)
    high = np.clip(np.ceil(corners.max(1)) + 1, low + 1, size).astype(int)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    moved = window - np.column_stack([np.zeros((2, 2)), low])
    pyramid = make_pyramid(part)
    place = _with_close_ups(net, [pyramid], _run(net, [Look(pyramid, moved)]))[0]
    return _detection(replace(place, points=place.points + low, outline=place.outline + low))
