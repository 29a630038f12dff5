"""What the other cameras say of one camera's matte: what they rule out, and what they see solid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.conventions import opencv_pixels_to_corner
from pipelines.matte.config import MatteConfig
from pipelines.matte.hull import (
    CLEAR,
    FAINT,
    INSIDE,
    OUT,
    SOLID,
    Space,
    View,
    cell_spread,
    cells_in,
    splat,
)

MOST = 0.75  # share of the other views that must see a place to call it solid
ERRING = 8  # one of so many views may lack the same spot
THICK = 0.5  # share of the usual length of a ray in the hull that is no corner of it
NEIGHBOURS = 4  # cameras that are asked for the colour of a surface
WIDEST = 0.2  # cosine of the largest angle to them
SEARCH = (-0.3, 0.1, 17)  # radii before and behind the others' hull in which the surface may lie
SMALLEST = 5e-4  # share of the image that a filled spot has at least
LARGEST = 0.4  # share of the subject from which on a matte is wrong rather than holed


@dataclass(frozen=True)
class Evidence:
    """What other views say of a view's pixels, each (h, w).

    Attributes:
        known: whose rays cross the space that is compared.
        possible: whose rays pass a place that the others do not rule out.
        likely: whose rays pass a place that not one of them rules out.
        solid: whose rays pass a place where nearly all others that see it see the subject.
        front: depth of the nearest such place, in radii; infinite where there is none.
    """

    known: np.ndarray
    possible: np.ndarray
    likely: np.ndarray
    solid: np.ndarray
    front: np.ndarray


def evidence_of(view: View, space: Space, place: np.ndarray, votes: int) -> Evidence:
    """Evidence of all views but `view`; `place` (n, n, n) is where the subject may be."""
    shape = view.alpha.shape
    pixels, depth = cells_in(view, space.axis)
    own = space.labels[view.name][pixels]
    against = space.clear - (own == CLEAR)
    possible = place & (against < votes)
    seen = space.seen - (own != OUT)
    sure = (space.solid - (own == SOLID) >= seen - seen // ERRING) & (
        seen >= max(3.0, MOST * (len(space.labels) - 1))
    )
    spread = cell_spread(view, space.axis)
    front = np.full(shape[0] * shape[1] + 1, np.inf, np.float32)
    np.minimum.at(front, pixels[sure], depth[sure])
    disc = np.ones((2 * spread + 1,) * 2, np.uint8)
    front = cv2.erode(front[:-1].reshape(shape), disc)
    # As much as the cells were widened, lest a rim of them is taken for solid.
    solid = cv2.erode(np.isfinite(front).astype(np.uint8), disc) > 0
    solid &= _thick(view, np.bincount(pixels[sure], minlength=front.size + 1)[:-1])
    return Evidence(
        known=splat(shape, pixels, spread),
        possible=splat(shape, pixels[possible], spread),
        likely=splat(shape, pixels[place & (against == 0)], spread),
        solid=solid,
        front=front,
    )


def _thick(view: View, cells: np.ndarray) -> np.ndarray:
    """Pixels (h, w) bool whose rays pass as many of the solid `cells` (h * w,) as most do.

    Between the tangents of few cameras the hull has corners that stand out from the subject; they
    are thin along the rays that pass the subject.
    """
    chord = cv2.blur(cells.reshape(view.alpha.shape).astype(np.float32), (5, 5))
    opaque = (view.alpha > INSIDE) & (chord > 0)
    return chord >= THICK * np.median(chord[opaque]) if opaque.any() else opaque


def ruled_out(view: View, evidence: Evidence, config: MatteConfig) -> np.ndarray:
    """Pixels (h, w) bool of the matte that show nothing which the other views leave possible.

    Whole connected parts, and only those that reach too far from what is possible to be hair.
    """
    loose = (view.alpha > FAINT) & ~evidence.possible
    if not loose.any() or not evidence.possible.any():
        return np.zeros(loose.shape, bool)
    away = cv2.distanceTransform((~evidence.possible).astype(np.uint8), cv2.DIST_L2, 5)
    count, parts = cv2.connectedComponents(loose.astype(np.uint8), connectivity=8)
    reach = np.zeros(count, np.float32)
    np.maximum.at(reach, parts, away)
    area = np.bincount(parts.ravel(), minlength=count)
    known = np.bincount(parts.ravel(), weights=evidence.known.ravel(), minlength=count)
    far = (reach > config.strand * max(loose.shape)) & (known > 0.5 * area)
    far[0] = False
    wrong = far[parts]
    # What hangs together with it is wrong by a single view's word, up to the hull of them all.
    doubtful = (view.alpha > FAINT) & ~evidence.likely
    _, parts = cv2.connectedComponents(doubtful.astype(np.uint8), connectivity=8)
    bad = doubtful & np.isin(parts, np.unique(parts[wrong]))
    # One pixel more, for what is fainter still around it.
    return (cv2.dilate(bad.astype(np.uint8), np.ones((3, 3))) > 0) & ~evidence.likely


def shows_surface(
    view: View, evidence: Evidence, todo: np.ndarray, others: Sequence[View],
    subject: dict[str, np.ndarray], colour: float,
) -> np.ndarray:  # fmt: skip
    """Pixels (h, w) bool of `todo` (h, w) whose colour is that of a surface the others see there.

    Somewhere about the front of the others' hull two neighbours at least must see this colour on
    the `subject` ({name: (h, w) bool}): then this camera cannot tell it from what is behind.
    """
    rows, columns = np.nonzero(todo)
    near = _neighbours(view, others)
    if not len(rows) or len(near) < 2:
        return np.zeros(todo.shape, bool)
    offsets = np.linspace(*SEARCH)
    depth = evidence.front[rows, columns] + offsets[:, None].astype(np.float32)  # (D, N)
    rays = np.vstack(
        [opencv_pixels_to_corner(np.array([columns, rows])), np.ones(len(rows))]
    )  # (3, N)
    points = np.linalg.solve(
        view.projection[:, :3].astype(np.float64),
        (rays[:, None] * depth - view.projection[:, 3, None, None]).reshape(3, -1),
    )
    mine = np.tile(_smooth(view.rgb)[rows, columns], (len(offsets), 1))
    agree = np.zeros(depth.size, np.uint8)
    for other in near:
        x, y, inside = _pixels_of(other, points)
        alike = np.abs(_smooth(other.rgb)[y, x] - mine).max(axis=1) < 255 * colour
        agree += alike & inside & subject[other.name][y, x]
    found = np.zeros(todo.shape, bool)
    found[rows, columns] = (agree >= 2).reshape(depth.shape).any(axis=0)
    return found


def subject_of(view: View, evidence: Evidence) -> np.ndarray:
    """Pixels (h, w) bool that show the subject by the matte, or by the others in a hole of it."""
    opaque = view.alpha > INSIDE
    _, parts = cv2.connectedComponents((~opaque).astype(np.uint8), connectivity=4)
    # The bottom counts as closed: there the body goes on.
    outside = np.unique(np.concatenate([parts[0], parts[:, 0], parts[:, -1]]))
    return opaque | (evidence.solid & ~np.isin(parts, outside))


def _smooth(rgb: np.ndarray) -> np.ndarray:
    return cv2.blur(rgb, (3, 3)).astype(np.float32)


def _neighbours(view: View, others: Sequence[View]) -> list[View]:
    """The cameras that look from nearest by, as seen from the ball's centre."""
    ranked = sorted(
        (o for o in others if o.name != view.name), key=lambda o: _cosine(view, o), reverse=True
    )
    return [other for other in ranked[:NEIGHBOURS] if _cosine(view, other) > WIDEST]


def _cosine(a: View, b: View) -> float:
    """Cosine of the angle between two cameras, as seen from the ball's centre."""
    length = float(np.linalg.norm(a.center) * np.linalg.norm(b.center))
    return float(a.center @ b.center) / length if length > 0 else 0.0


def _pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns, rows and whether in view (N,) of points (3, N) in the ball's coordinates."""
    height, width = view.alpha.shape
    x, y, z = view.projection[:, :3] @ points + view.projection[:, 3, None]
    ahead = z > 1e-6
    x, y = x / np.where(ahead, z, 1), y / np.where(ahead, z, 1)
    inside = ahead & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside


def missed(
    view: View, evidence: Evidence, others: Sequence[View],
    subject: dict[str, np.ndarray], config: MatteConfig,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Pixels (h, w) bool to fill, and the share of what the others see that then still lacks.

    Filled are connected spots that lack alpha where the others see something solid, some of it
    well inside, and whose colour is that of the surface. Spots that the matte does not enclose
    count only as deep in the hull as its corners may stand out.
    """
    lacking = evidence.solid & (view.alpha < INSIDE) & view.valid
    depth = _depth(evidence.solid)
    deep = depth > config.margin * max(lacking.shape)
    todo = lacking & (subject[view.name] | (depth > _corner(view, others) * depth.max()))
    alike = shows_surface(view, evidence, todo, others, subject, config.colour)
    alike = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2))) > 0
    count, spots = cv2.connectedComponents(alike.astype(np.uint8), connectivity=8)
    inside = np.bincount(spots[deep], minlength=count)
    fill = inside > max(1.0, SMALLEST * lacking.size)
    fill[0] = False
    filled = fill[spots]
    if (filled & deep).sum() > LARGEST * deep.sum():
        filled = np.zeros_like(filled)
    left = float((lacking & deep & ~filled).sum()) / max(int(deep.sum()), 1)
    grown = cv2.dilate(filled.astype(np.uint8), np.ones((3, 3))) > 0
    return grown & (evidence.solid | (view.alpha >= INSIDE)), left


def _depth(mask: np.ndarray) -> np.ndarray:
    """Distance (h, w) of a mask's pixels to its edge; the image's border is none."""
    if mask.all():
        return np.full(mask.shape, float(max(mask.shape)), np.float32)
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)


def _corner(view: View, others: Sequence[View]) -> float:
    """How far the hull of the others stands out from a round subject in this view, in its radii.

    The tangents of cameras an angle away to either side meet at 1 / cos(angle) radii.
    """
    cosines = sorted((_cosine(view, o) for o in others if o.name != view.name), reverse=True)
    return 1 / cosines[1] - 1 if len(cosines) > 1 and cosines[1] > WIDEST else 1.0
