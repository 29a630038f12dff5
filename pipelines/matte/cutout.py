"""Cut a person out of all pictures of a frame set at once, without plates or weights.

The faces that the cameras see place a head in the world, and so show roughly where skull, hair and
shoulders are in every picture, even from behind. A network that knows the shapes of people
(`silhouette.py`) says more closely where they are. GrabCut (Rother, Kolmogorov and Blake 2004)
finds their outlines by colours; heads of other people close by count as wall. Then the cameras
correct each other: the person is nowhere that others see past them, and, if they are many,
everywhere that all others see them; GrabCut runs again within these limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes, gaussian_filter

from express50.errors import NoFaceError
from express50.geometry.cameras import Camera, resized
from express50.geometry.conventions import corner_to_cell
from express50.geometry.pixels import box_about, shrink
from express50.geometry.transforms import transform_points
from pipelines.matte.visual_hull import (
    FEWEST,
    Ball,
    Evidence,
    MatteView,
    evidence_of,
    make_space,
    subject_place,
)

FACE_SCORE = 0.3  # heads from behind score up to 0.2, profiles from 0.33 on
FACES = 4  # this many place a head well
NEIGHBOUR_SCORE = 0.5  # other people's faces beside the person score 0.74 or more, walls up to 0.41
NEIGHBOUR_M, MOST_NEIGHBOURS = 0.2, 4  # how far beside the person's region they are searched
SIDE = 512  # pixels of the pictures in which faces are searched, and that GrabCut sees
SURE, LIKELY, HAIR = 0.7, 1.3, 1.6  # skull sizes: no wall inside the first, no hair past the last
LEAST_DEPTH = 0.05  # metres in front of the camera
HOLE_M2 = 1.5e-3  # larger gaps show the background
CUTS = 6  # GrabCut's iterations
MANY = 7  # the hull of fewer cameras is so much larger than the person that it holds much wall
SLACK_PX = (3.0, 1.5)  # of `_corrected_labels`, per round
COLOURS, RARE = 32, 1e-5  # colour cells along each axis of Lab; share of a cell that is never seen
UNSEEN = 2 / COLOURS**3  # the person does not have colours of a smaller share
CLEARLY = 4.0  # ratio of shares from which a colour is the person's, not the wall's
# Chances of the network below which colours count less, count on bodies alone, and do not count.
UNLIKELY, SELDOM, HARDLY = 0.1, 0.05, 0.01
SHIRT, PLAIN = 0.98, 4.0  # chance of a shirt of the wall's colour; its most spread, 8-bit Lab
CELLS = 96  # cells along each side of the cube in which cameras are compared


@dataclass(frozen=True)
class Cut:
    """A person's outline in one camera: mask (h, w) bool, and its pixels per metre of the head.

    `body` (h, w) bool is where the body below the neck may be; None if that is not known.
    """

    mask: np.ndarray
    density: float
    body: np.ndarray | None = None


@dataclass(frozen=True)
class CutView:
    """One camera's reduced picture."""

    camera: Camera  # pinhole, of the reduced picture
    rgb: np.ndarray  # (h, w, 3) uint8
    valid: np.ndarray  # (h, w) bool, pixels with footage
    known: np.ndarray | None = None  # (h, w) bool, the person's mask if known, as from a plate
    wall: np.ndarray | None = None  # (h, w) bool, pixels known to show the wall

    @property
    def name(self) -> str:
        """Return the camera's id."""
        return self.camera.id


@dataclass(frozen=True)
class HeadPlace:
    """The pose of a mean head: world = scale * rotation @ head + shift."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def density(self, camera: Camera) -> float:
        """Return pixels per metre of the head in a camera."""
        depth = camera.cam_from_world[2, :3] @ self.shift + camera.cam_from_world[2, 3]
        return float(camera.K[0, 0] * self.scale / max(depth, LEAST_DEPTH * self.scale))

    def pixels(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        """Project the points (N, 3), head space, in front of a camera to its pixels (M, 2)."""
        world = self.scale * points @ self.rotation.T + self.shift
        seen = transform_points(camera.cam_from_world, world)
        seen = seen[seen[:, 2] > LEAST_DEPTH * self.scale] @ camera.K.T
        return seen[:, :2] / seen[:, 2:]


def make_cut_view(
    camera: Camera, frame: np.ndarray, valid: np.ndarray, alpha: np.ndarray | None = None
) -> CutView:
    """Reduce a frame (H, W, 3) of a pinhole camera; `alpha` (H, W) uint8 is its matte if known."""
    rgb = shrink(frame, SIDE)
    known = None if alpha is None else shrink(alpha, SIDE) > 127
    small = shrink(valid.astype(np.uint8) * 255, SIDE) == 255
    return CutView(resized(camera, rgb.shape[1], rgb.shape[0]), rgb, small, known)


def cut_out(
    views: Sequence[CutView], ball: Ball | None, place: HeadPlace | None = None,
    others: Mapping[str, Sequence[HeadPlace]] | None = None,
) -> dict[str, Cut]:  # fmt: skip
    """Find the person's outline in all cameras of a frame set.

    `ball` is the volume that the cameras look at; None if they share none. `place` is from
    `find_head`, which is called if it is not given. `others` are other people's heads by camera,
    from `find_neighbours`, which is called if they are not given.

    Raises:
        NoFaceError: no camera shows a face.
    """
    place = place or find_head(views)
    bodies = [_body(view, place) for view in views]
    guesses, shirts = guess_person(views, place, bodies)
    for view, guess in zip(views, guesses, strict=True):
        if view.known is None:
            # Heads and necks of others are wall but where the person surely is, in front of
            # them; their hair is wall where the person hardly is.
            sure = guess == cv2.GC_FGD
            close = find_neighbours(view, place) if others is None else others.get(view.name, ())
            for other in close:
                guess[(average_person(view, other) == cv2.GC_FGD) & ~sure] = cv2.GC_BGD
                guess[_head_mask(view, other) & (guess == cv2.GC_PR_BGD)] = cv2.GC_BGD
            if view.wall is not None:
                guess[view.wall] = cv2.GC_BGD
    density = [place.density(view.camera) for view in views]

    def cut(labels: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [
            _cut(view, own, guess, scale) if view.known is None else view.known
            for view, own, guess, scale in zip(views, labels, guesses, density, strict=True)
        ]

    starts = guesses
    if len(views) < MANY:
        starts = [_with_own_colours(*pair) for pair in zip(views, guesses, strict=True)]
    masks = cut(starts)
    shirts = shirts_like_the_wall(views, shirts, guesses, masks)
    if any(map(np.any, shirts)):
        for start, guess, shirt in zip(starts, guesses, shirts, strict=True):
            start[shirt] = guess[shirt] = cv2.GC_FGD
        masks = cut(starts)
    if ball is not None and len(views) >= FEWEST:
        for slack in SLACK_PX:
            masks = cut(_corrected_labels(views, guesses, shirts, masks, ball, slack))
    cuts = map(Cut, masks, density, bodies)
    return {view.name: found for view, found in zip(views, cuts, strict=True)}


def find_head(views: Sequence[CutView]) -> HeadPlace:
    """Place the mean head by the faces that are found; backs of heads are not searched at length.

    Raises:
        NoFaceError: no camera shows a face.
    """
    # Imported here, because fitting plates need no network, and torch takes seconds to import.
    from express50.landmarks.detector import SMALL, detect_many
    from express50.landmarks.network import load_network
    from pipelines.track.observe import LandmarkView, place_head

    pictures = [view.rgb for view in views]
    faces = detect_many(load_network(), pictures, smallest=SMALL, enough=FACES)
    place = place_head([
        LandmarkView(view.camera, face.points, face.sigma, face.score)
        for view, face in zip(views, faces, strict=True)
        if face.score >= FACE_SCORE
    ])  # fmt: skip
    if place is not None:
        return HeadPlace(*place)
    best = max((face.score for face in faces), default=0.0)
    raise NoFaceError(
        f"no face found (score {best:.2f}, expected {FACE_SCORE} or more), and without plates the"
        " person is found by the face; record plates, or set matte.method=salient and"
        " matte.weights"
    )


def find_neighbours(view: CutView, place: HeadPlace) -> list[HeadPlace]:
    """Place the heads of other people that a view shows where the person may be, or close by."""
    from express50.landmarks.detector import detect
    from express50.landmarks.network import load_network
    from pipelines.track.observe import LandmarkView, place_head

    region = region_of(view, place)
    if not region.any():
        return []
    box = box_about(region, round(NEIGHBOUR_M * place.density(view.camera)))
    image, heads = view.rgb.copy(), [place]
    blank = image[box].mean((0, 1))
    while len(heads) <= MOST_NEIGHBOURS:
        image[_head_mask(view, heads[-1])] = blank  # a face is found once
        face = detect(load_network(), np.ascontiguousarray(image[box]))
        points = face.points + [box[1].start, box[0].start]
        found = place_head([LandmarkView(view.camera, points, face.sigma, face.score)])
        if face.score < NEIGHBOUR_SCORE or found is None:
            break
        heads.append(HeadPlace(*found))
    return heads[1:]


def guess_person(
    views: Sequence[CutView], place: HeadPlace, bodies: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Guess where the person is: GrabCut labels (h, w) uint8 of each view to start from.

    `bodies` (h, w) bool are where the body below the neck may be. Also returns where the network is
    sure of it, (h, w) bool.
    """
    from pipelines.matte.silhouette import chances, crop_about, enlarged, network_input

    guesses = [average_person(view, place) for view in views]
    shirts = [np.zeros_like(body) for body in bodies]
    shown: list[tuple[int, np.ndarray]] = []
    for k, view in enumerate(views):
        pixels = place.pixels(chin_and_above(), view.camera)
        if view.known is None and len(pixels) == 2:
            shown.append((k, crop_about(pixels[0], pixels[1], place.density(view.camera))))
    if not shown:
        return guesses, shirts
    seen = [network_input(views[k].rgb, views[k].valid, guesses[k], m) for k, m in shown]
    for (k, matrix), chance in zip(shown, chances(seen), strict=True):
        average, body = guesses[k], bodies[k]
        share = enlarged(chance, matrix, average.shape)
        # Where an average person is, colours decide unless the network is nearly sure.
        least = np.where(average == cv2.GC_PR_FGD, UNLIKELY, 0.5)
        guess = np.where(share > least, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        guess[(average == cv2.GC_BGD) & (share <= 0.5)] = cv2.GC_BGD
        # Shirts may have the wall's colour, so that the network misses them: there it rules pixels
        # out only if it is surer, and with many views none. What it adds is judged later.
        guess[(share < SELDOM) & ~body] = cv2.GC_BGD
        if len(views) < MANY:
            guess[share < HARDLY] = cv2.GC_BGD
            guess[(share > 1 - HARDLY) & ~body] = cv2.GC_FGD
        else:
            guess[(share > 1 - SELDOM) & ~body] = cv2.GC_FGD
            guess[body & (average == cv2.GC_PR_FGD)] = cv2.GC_PR_FGD
        guess[average == cv2.GC_FGD] = cv2.GC_FGD
        guesses[k] = np.where(share < 0, average, guess)
        shirts[k] = body & (share > SHIRT) & views[k].valid
    return guesses, shirts


def _body(view: CutView, place: HeadPlace) -> np.ndarray:
    """Return where the body below the neck may be in a view, (h, w) bool."""
    return average_person(view, place, {1: (trunk_of_a_person(),)}) > 0


def _head_mask(view: CutView, place: HeadPlace) -> np.ndarray:
    """Return where a head and most of its hair are in a view, (h, w) bool."""
    parts = parts_of_a_person()
    head = (parts[cv2.GC_PR_FGD][0], parts[cv2.GC_FGD][-1])
    return average_person(view, place, {cv2.GC_FGD: head}) == cv2.GC_FGD


@cache
def parts_of_a_person() -> dict[int, tuple[np.ndarray, ...]]:
    """Return convex parts (N, 3) of a person, head space, metres, by GrabCut label."""
    from express50.head.load import load_builtin
    from pipelines.calibrate.footage_rig import mean_landmarks

    vertices = load_builtin().template.double().numpy()
    face = mean_landmarks()
    chin, bottom = float(face[8, 1]), float(vertices[:, 1].min())
    skull = vertices[vertices[:, 1] > chin]
    middle = (skull.min(0) + skull.max(0)) / 2
    slices = (vertices[np.abs(vertices[:, 1] - y) < 0.01, 2] for y in (chin - 0.02, bottom + 0.01))
    throat, back = (float(depths.min() + depths.max()) / 2 for depths in slices)
    neck = _slab((0.03, 0.04), (chin, bottom - 0.05), (throat, back), 0.03)
    torso = _slab((0.07, 0.2, 0.24), (bottom, bottom - 0.08, bottom - 0.7), (back,) * 3, 0.1)
    hair = _slab((0.16, 0.18), (middle[1], bottom - 0.1), (back,) * 2, 0.12)
    wide = _slab((0.18, 0.3, 0.34), (chin, bottom - 0.05, bottom - 0.9), (back,) * 3, 0.25)
    sure, likely, reach = (middle + k * (skull - middle) for k in (SURE, LIKELY, HAIR))
    for part in (likely, reach):  # no hair grows in front of a face
        part[:, 2] = np.minimum(part[:, 2], skull[:, 2].max())
    return {
        cv2.GC_PR_BGD: (reach, hair, wide),
        cv2.GC_PR_FGD: (likely, vertices, torso),
        cv2.GC_FGD: (sure, neck, face.mean(0) + 0.95 * (face - face.mean(0))),
    }


@cache
def chin_and_above() -> np.ndarray:
    """Return a point inside the head at the chin's height, and one above it, (2, 3) metres."""
    from express50.head.load import load_builtin
    from pipelines.calibrate.footage_rig import mean_landmarks
    from pipelines.matte.silhouette import UP_M

    depth = float(load_builtin().template[:, 2].double().mean())
    chin = np.array([0, mean_landmarks()[8, 1], depth])
    return np.array([chin, chin + [0, UP_M, 0]])


@cache
def trunk_of_a_person() -> np.ndarray:
    """Return the corners (N, 3) of a slab about the body below the neck, head space, metres."""
    from express50.head.load import load_builtin

    vertices = load_builtin().template.double().numpy()
    bottom = float(vertices[:, 1].min())
    back = float(np.mean(vertices[vertices[:, 1] < bottom + 0.02, 2]))
    return _slab((0.3, 0.34), (bottom + 0.01, bottom - 0.9), (back, back), 0.25)


def _slab(
    half_widths: tuple[float, ...], heights: tuple[float, ...], depths: tuple[float, ...],
    thick: float,
) -> np.ndarray:  # fmt: skip
    """Return the corners (N, 3) of a slab, with half widths around depths at heights."""
    return np.array([
        (side * width, height, depth + face * thick)
        for width, height, depth in zip(half_widths, heights, depths, strict=True)
        for side in (-1, 1)
        for face in (-1, 1)
    ])  # fmt: skip


def region_of(view: CutView, place: HeadPlace) -> np.ndarray:
    """Return where a person may be (h, w) bool in a view, their hair and shoulders included."""
    return average_person(view, place) != cv2.GC_BGD


def average_person(
    view: CutView, place: HeadPlace, parts: Mapping[int, Sequence[np.ndarray]] | None = None
) -> np.ndarray:
    """Project a person's parts, or some, into a view: GrabCut labels (h, w) uint8 to start from."""
    labels = np.full(view.valid.shape, cv2.GC_BGD, np.uint8)
    for value, hulls in (parts or parts_of_a_person()).items():
        for points in hulls:
            pixels = place.pixels(points, view.camera)
            if len(pixels) > 2:
                far = 4 * max(labels.shape)  # OpenCV stores polygons as 16-bit integers
                cells = corner_to_cell(np.clip(pixels, -far, far))
                hull = cv2.convexHull(cells.astype(np.float32))
                cv2.fillConvexPoly(labels, hull.round().astype(np.int32), value)
    return labels


def _cut(view: CutView, labels: np.ndarray, guess: np.ndarray, density: float) -> np.ndarray:
    """Run GrabCut from labels (h, w); return the person's mask (h, w), with small holes filled.

    Parts that are not connected to where the `guess` (h, w) is certain are left out. `density` is
    in pixels per metre of the head.
    """
    sure = guess == cv2.GC_FGD
    if not sure.any():  # the person is out of view
        return np.zeros(labels.shape, bool)
    if not np.isin(labels, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():
        return view.valid.copy()  # the face fills the picture
    cv2.setRNGSeed(0)  # GrabCut's clusters start at random
    found, _, _ = cv2.grabCut(
        np.ascontiguousarray(view.rgb[..., ::-1]), labels.copy(), None, np.zeros((1, 65)),
        np.zeros((1, 65)), CUTS, cv2.GC_INIT_WITH_MASK,
    )  # fmt: skip
    inside = ((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)) & view.valid
    _, parts = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    person = np.isin(parts, np.unique(parts[sure & inside])) & inside
    holes = binary_fill_holes(person) & ~person
    _, parts, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    return person | (holes & (stats[:, cv2.CC_STAT_AREA] < HOLE_M2 * density**2)[parts])


def _with_own_colours(view: CutView, guess: np.ndarray) -> np.ndarray:
    """Take what has the head's colours, not the wall's, for the person in a guess (h, w).

    GrabCut would learn a ponytail as one more colour of a plain wall. But what runs off a side of
    the picture that the person does not reach is more likely a floor. With many views this is not
    needed: they keep ponytails, and it would keep walls of the shirt's colour.
    """
    cells = _cells_of(cv2.GaussianBlur(view.rgb, (0, 0), 1))
    own, wall = (_shares(cells[(guess == v) & view.valid]) for v in (cv2.GC_FGD, cv2.GC_BGD))
    like = (own > CLEARLY * np.maximum(wall, UNSEEN))[cells] & (guess == cv2.GC_PR_BGD)
    _, parts = cv2.connectedComponents(like.astype(np.uint8), connectivity=4)
    person = (guess == cv2.GC_FGD) | (guess == cv2.GC_PR_FGD)
    for side in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        if not person[side].any():
            like &= ~np.isin(parts, parts[side])
    return np.where(like, np.uint8(cv2.GC_PR_FGD), guess)


def shirts_like_the_wall(
    views: Sequence[CutView], shirts: Sequence[np.ndarray], guesses: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
) -> list[np.ndarray]:  # fmt: skip
    """Return `shirts` (h, w) if what `masks` (h, w) lack of them has one colour in each view.

    Then they have the wall's colour. Else the wall shows through: scans of heads end at the
    shoulders, which the network does not know. What the `guesses` call wall does not count.
    """
    shirts = [one & (guess != cv2.GC_BGD) for one, guess in zip(shirts, guesses, strict=True)]
    lost = [shirt & ~mask for shirt, mask in zip(shirts, masks, strict=True)]
    far = 0.0
    for view, part in zip(views, lost, strict=True):
        if part.any():
            lab = cv2.cvtColor(cv2.GaussianBlur(view.rgb, (0, 0), 1), cv2.COLOR_RGB2LAB)[part]
            far += float(np.abs(lab - np.median(lab, axis=0)).mean(1).sum())
    plain = far < PLAIN * sum(map(np.count_nonzero, lost))
    return shirts if plain else [np.zeros_like(one) for one in shirts]


def _corrected_labels(
    views: Sequence[CutView],
    guesses: Sequence[np.ndarray],
    shirts: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    ball: Ball,
    slack: float,
) -> list[np.ndarray]:
    """Limit each view's GrabCut labels to what the other views' masks leave possible.

    `slack` is the distance from an outline, in pixels, within which it proves nothing.
    """
    mattes = [
        MatteView.of(view.camera, ball, view.rgb, mask.astype(np.float32), view.valid)
        for view, mask in zip(views, masks, strict=True)
    ]
    space = make_space(mattes, CELLS, slack)
    place = subject_place(space)
    seen = [evidence_of(matte, space, place) for matte in mattes]
    sure = [one.solid | (guess == cv2.GC_FGD) for one, guess in zip(seen, guesses, strict=True)]
    foreign = _foreign(mattes, sure)
    rows = zip(mattes, seen, guesses, shirts, foreign, strict=True)
    return [_labels(*row, many=len(views) >= MANY) for row in rows]


def _labels(
    view: MatteView, evidence: Evidence, guess: np.ndarray, shirt: np.ndarray, foreign: np.ndarray,
    many: bool,
) -> np.ndarray:  # fmt: skip
    """Return GrabCut labels (h, w) from a view's mask, the other views' evidence, and the guess.

    GrabCut learns the person's colours where no other view sees the wall and no pixel is `foreign`
    (h, w). Large foreign patches are labelled wall. What all others see as the person is certain
    only if they are `many`; else it is likely where the guess has a person as well. A `shirt` of
    the wall's colour (h, w) is certain, because others may have lost it too.
    """
    solid, certain = evidence.solid, guess == cv2.GC_FGD
    if many:
        sure = cv2.erode(solid.astype(np.uint8), np.ones((5, 5))) > 0
    else:
        sure = certain & view.valid
        solid = solid & ~foreign & (certain | (guess == cv2.GC_PR_FGD))
    inside = ((view.alpha > 0) & evidence.likely & ~foreign) | solid
    labels = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    beyond = (evidence.known & ~evidence.possible) | (guess == cv2.GC_BGD)
    patches = cv2.morphologyEx(foreign.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))) > 0
    beyond |= patches & ~certain
    labels[beyond | ~view.valid] = cv2.GC_BGD
    labels[sure | shirt] = cv2.GC_FGD
    return labels


def _foreign(views: Sequence[MatteView], sure: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return for each view the pixels (h, w) bool of colours that the person does not have.

    The person's colours come from what the other views cut out. For each colour, the view that has
    most of it is left out, because its cut may include some wall. As cameras differ, colours of
    the view's own `sure` pixels (h, w) count too.
    """
    cells = [_cells_of(view.rgb) for view in views]
    person = np.array(
        [_shares(cell[view.alpha > 0]) for cell, view in zip(cells, views, strict=True)]
    )
    found = []
    for k, one in enumerate(sure):
        others = np.delete(person, k, axis=0)
        known = (others.sum(0) - others.max(0)) / (len(others) - 1)
        known = np.maximum(known, _shares(cells[k][one]))
        found.append((known < UNSEEN)[cells[k]])
    return found


def _cells_of(rgb: np.ndarray) -> np.ndarray:
    """Return the number (h, w) of each pixel's cell of Lab colour."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.int64) // (256 // COLOURS)
    cells: np.ndarray = (lab[..., 0] * COLOURS + lab[..., 1]) * COLOURS + lab[..., 2]
    return cells


def _shares(cells: np.ndarray) -> np.ndarray:
    """Return the smoothed share (COLOURS**3,) of each cell of colour among pixels (N,)."""
    counts = np.bincount(cells.ravel(), minlength=COLOURS**3).reshape((COLOURS,) * 3)
    smooth = gaussian_filter(counts.astype(np.float32), 1.0).ravel()
    return smooth / max(len(cells), 1) + RARE
