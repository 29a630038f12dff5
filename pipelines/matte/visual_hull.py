"""Compare the mattes of one frame set in the space that its cameras share.

Space is a cube of cells around the point that the cameras look at, in the rig's own units, so that
neither metres nor the world's origin matter. Most cameras see a ball in it completely; there every
camera's silhouette counts (visual hull, Laurentini 1994, but by votes: a place is empty if several
cameras see clear background). Outside the ball few cameras see anything: only places where the
subject continues out of the ball, such as the shoulders, are possible there.

A camera removes what the other views rule out (moving shadows, things that only some cameras see).
They cannot rule out the part of a shadow that the subject hides from them, but it darkens the plate
as the removed part does, and goes with it. A camera fills what the others see as solid but it could
not separate from its background. A camera whose matte disagrees with the others both where it is
opaque and where it is clear is reported and ignored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy import ndimage

from express50.contract.stage import Note
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_centres, opencv_pixels_to_corner
from express50.geometry.pixels import is_grey
from express50.rigs.world_frame import meeting_point
from pipelines.matte.plates import GREY, darkening

CUBE = 1.6  # half side of the cube, in radii of the ball
BODY = 0.5  # radii that the subject may extend beyond where it leaves the ball
FAINT = 0.03  # alpha below this is clear background
STRAND = 0.03  # share of the longer side that hair may extend beyond the other cameras' hull
INSIDE = 0.5  # alpha from which a pixel shows the subject
OUT, CLEAR, RIM, SOLID = range(4)  # what a view says of a cell

# The comparison of mattes.
# Longest side of the pictures, and cells along each side of space: 192 and 96 take three times as
# long and gain next to nothing (docs/LOG.md, "What was removed").
SIDE, CELLS = 128, 64
FEWEST = 4  # views; of three, two with the same error would overrule a correct one
EMPTY, FULL = 0.003, 0.98  # shares of the image that a useful matte covers
# The entire matte is wrong if over STRAY of it lies off the others' subject and it lacks over
# LACKING of that subject, or if it lacks over MOST_LACKING.
STRAY, LACKING, MOST_LACKING = 0.03, 0.07, 0.3
TURN = 0.1  # share of the longer side by which a camera that has turned may shift its picture


@dataclass(frozen=True)
class Ball:
    """Centre (3,) and radius, world units, of the ball in which views are compared."""

    center: np.ndarray
    radius: float


@dataclass(frozen=True)
class MatteView:
    """One camera's reduced picture and matte."""

    name: str  # camera id
    projection: np.ndarray  # (3, 4) float32 from the unit ball's coordinates to (x, y, 1) z, pixels
    center: np.ndarray  # (3,) camera centre in the ball's coordinates
    rgb: np.ndarray  # (h, w, 3) uint8
    alpha: np.ndarray  # (h, w) float32 in [0, 1]
    valid: np.ndarray  # (h, w) bool, pixels with footage
    plate: np.ndarray | None = None  # (h, w, 3) uint8, if the camera has one

    @classmethod
    def of(
        cls, camera: Camera, ball: Ball, rgb: np.ndarray, alpha: np.ndarray, valid: np.ndarray,
        plate: np.ndarray | None = None,
    ) -> MatteView:  # fmt: skip
        """Place a pinhole camera's picture in the ball's coordinates."""
        R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        # Over the radius, so that depths are in its units too and float32 suffices.
        offset = (R @ ball.center + t) / ball.radius
        projection = np.column_stack([camera.K @ R, camera.K @ offset]).astype(np.float32)
        center = (camera.center - ball.center) / ball.radius
        return cls(camera.id, projection, center, rgb, alpha, valid, plate)


@dataclass(frozen=True)
class Space:
    """What all views say of each cell of space."""

    axis: np.ndarray  # (n,) float32 coordinates of the cells, the same along x, y and z
    seen: np.ndarray  # (n, n, n) uint16 count of the views that see the cell
    clear: np.ndarray  # (n, n, n) uint16 count of those that see clear background there
    solid: np.ndarray  # (n, n, n) uint16 count of those that see the subject there
    # each view's pixel labels (h * w + 1,) uint8, the last for cells out of view
    labels: dict[str, np.ndarray]


def ball_of(cameras: Mapping[str, Camera]) -> Ball | None:
    """Return the largest ball around the point the cameras look at that most see completely.

    None if the optical axes are parallel or most cameras do not look at their intersection.
    """
    center = meeting_point(cameras)
    if center is None:
        return None
    extents = []
    for camera in cameras.values():
        depth = camera.cam_from_world[2, :3] @ center + camera.cam_from_world[2, 3]
        extents.append(depth * min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]))
    radius = float(np.median(extents)) / 2
    return Ball(center, radius) if radius > 0 else None


def label_pixels(view: MatteView, margin: float) -> np.ndarray:
    """Label a view's pixels (h * w + 1,) uint8; clear ones are `margin` pixels off its subject."""
    opaque = view.alpha > FAINT
    labels = np.full(opaque.shape, CLEAR, np.uint8)
    if opaque.any():
        distance = cv2.distanceTransform((~opaque).astype(np.uint8), cv2.DIST_L2, 5)
        labels[distance <= margin] = RIM
    labels[view.alpha > INSIDE] = SOLID
    # The subject continues beyond the image's border: nothing is clear next to missing footage.
    beyond = cv2.dilate((~view.valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    labels[beyond & (labels == CLEAR)] = OUT
    labels[~view.valid] = OUT
    return np.append(labels.ravel(), np.uint8(OUT))


def cells_in(view: MatteView, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each cell's pixel, h * w if out of view, and its depth; (n, n, n) each."""
    height, width = view.alpha.shape
    P = view.projection
    x, y, z = (
        P[i, 0] * axis[:, None, None] + P[i, 1] * axis[:, None] + (P[i, 2] * axis + P[i, 3])
        for i in range(3)
    )
    ahead = z > 1e-6
    scale = 1 / np.where(ahead, z, np.float32(1))
    x, y = x * scale, y * scale
    inside = ahead & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = np.where(inside, x, 0).astype(np.int32), np.where(inside, y, 0).astype(np.int32)
    return np.where(inside, y * width + x, height * width), z


def make_space(views: Sequence[MatteView], cells: int, margin: float) -> Space:
    """Count what the views say of every cell; `margin` is that of `label_pixels`."""
    axis = (CUBE * (cell_centres(cells) / cells * 2 - 1)).astype(np.float32)
    seen, clear, solid = (np.zeros((cells,) * 3, np.uint16) for _ in range(3))
    labels = {}
    for view in views:
        labels[view.name] = label_pixels(view, margin)
        said = labels[view.name][cells_in(view, axis)[0]]
        seen += said != OUT
        clear += said == CLEAR
        solid += said == SOLID
    return Space(axis, seen, clear, solid, labels)


def subject_place(space: Space) -> np.ndarray:
    """Mark the cells (n, n, n) where the subject may be: the ball, and around where it leaves."""
    a = space.axis
    square = a[:, None, None] ** 2 + a[:, None] ** 2 + a**2
    ball = square <= 1
    parts, count = ndimage.label((space.clear < VOTES) & (space.solid >= 2) & ball)
    if not count:
        return ball
    weight = np.bincount(parts.ravel(), weights=space.solid.ravel())
    subject = parts == 1 + int(np.argmax(weight[1:]))
    step = a[1] - a[0]
    leaves = subject & (square > (1 - 2 * step) ** 2)
    if not leaves.any():
        return ball
    return ball | (ndimage.distance_transform_edt(~leaves) * step <= BODY)


def splat(shape: tuple[int, int], pixels: np.ndarray, spread: int) -> np.ndarray:
    """Return the pixels (h, w) bool within `spread` of those that cells fall on (N,)."""
    hit = np.zeros(shape[0] * shape[1] + 1, np.uint8)
    hit[pixels] = 1
    side = 2 * spread + 1
    return cv2.dilate(hit[:-1].reshape(shape), np.ones((side, side), np.uint8)) > 0


VOTES = 2  # other cameras that must see clear background for a place to be empty
MARGIN = 0.01  # share of the longer side: distance from a silhouette that proves nothing
COLOUR = 0.1  # share of full scale by which one surface may differ between neighbouring cameras
LUMA = np.array([[0.299], [0.587], [0.114]], np.float32)
SEEING_SHARE = 0.75  # share of the other views that must see a place for it to be solid
VIEWS_PER_MISS = 8  # one in this many views may miss the same spot
THICK = 0.5  # share of a ray's median length in the hull under which it only grazes a corner
NEIGHBOURS = 4  # cameras in which a surface's colour is looked up
WIDEST = 0.2  # cosine of the largest angle to them
SEARCH = (-0.3, 0.1, 17)  # radii in front of and behind the others' hull where a surface may be
# Shadows, natural logarithms of light over the plate's: the least depth, and how far one varies.
DEEP, SAME_SHADE = 0.3, 0.25
# Share of the image, and share of coloured pixels, from which a removed part is not a shadow.
LEAST_THING, COLOURED = 0.005, 0.2
SMALLEST = 5e-4  # share of the image: filled spots are at least this large
LARGEST = 0.4  # share of the subject: if more lacks, the matte is wrong rather than holed


@dataclass(frozen=True)
class Evidence:
    """The evidence of other views about a view's pixels, each (h, w)."""

    known: np.ndarray  # pixels whose rays cross the space
    possible: np.ndarray  # those whose rays pass a place that the others do not rule out
    likely: np.ndarray  # those whose rays pass a place that none of the others rules out
    # those whose rays pass a place where nearly all others that see it see the subject
    solid: np.ndarray
    front: np.ndarray  # depth of the nearest such place, in radii; infinite without one


def evidence_of(view: MatteView, space: Space, place: np.ndarray) -> Evidence:
    """Return the evidence of all views but `view`; `place` is that of `subject_place`."""
    shape = view.alpha.shape
    pixels, depth = cells_in(view, space.axis)
    own = space.labels[view.name][pixels]
    against = space.clear - (own == CLEAR)
    possible = place & (against < VOTES)
    seen = space.seen - (own != OUT)
    sure = (space.solid - (own == SOLID) >= seen - seen // VIEWS_PER_MISS) & (
        seen >= max(3.0, SEEING_SHARE * (len(space.labels) - 1))
    )
    # Neighbouring cells fall within this many pixels, so splats of this size leave no gaps.
    step = float(np.linalg.norm(view.projection[0, :3])) * float(space.axis[1] - space.axis[0])
    spread = max(1, int(np.ceil(step / float(view.projection[2, 3]) / 2)))
    front = np.full(shape[0] * shape[1] + 1, np.inf, np.float32)
    np.minimum.at(front, pixels[sure], depth[sure])
    disc = np.ones((2 * spread + 1,) * 2, np.uint8)
    front = cv2.erode(front[:-1].reshape(shape), disc)
    # By as much as the splats widened it, so that the rim does not count as solid.
    solid = cv2.erode(np.isfinite(front).astype(np.uint8), disc) > 0
    # Where the hull's corners stand out from the subject, rays pass only a few solid cells.
    cells = np.bincount(pixels[sure], minlength=front.size + 1)[:-1]
    chord = cv2.blur(cells.reshape(shape).astype(np.float32), (5, 5))
    opaque = (view.alpha > INSIDE) & (chord > 0)
    solid &= chord >= THICK * np.median(chord[opaque]) if opaque.any() else opaque
    return Evidence(
        known=splat(shape, pixels, spread),
        possible=splat(shape, pixels[possible], spread),
        likely=splat(shape, pixels[place & (against == 0)], spread),
        solid=solid,
        front=front,
    )


def ruled_out(view: MatteView, evidence: Evidence) -> np.ndarray:
    """Return the pixels (h, w) bool of a matte that the other views rule out.

    They are whole connected parts that extend further from the possible pixels than hair does.
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
    far = (reach > STRAND * max(loose.shape)) & (known > 0.5 * area)
    far[0] = False
    wrong = far[parts]
    # For pixels connected to these, the evidence of one view is enough.
    doubtful = (view.alpha > FAINT) & ~evidence.likely
    _, parts = cv2.connectedComponents(doubtful.astype(np.uint8), connectivity=8)
    bad = doubtful & np.isin(parts, np.unique(parts[wrong]))
    # One pixel more, for the faint pixels around.
    return (cv2.dilate(bad.astype(np.uint8), np.ones((3, 3))) > 0) & ~evidence.likely


def is_thing(view: MatteView, removed: np.ndarray) -> bool:
    """Return whether a removed part (h, w) of a matte has colours, as no shadow has."""
    sure = removed & (view.alpha > INSIDE)
    if view.plate is None or sure.mean() < LEAST_THING:
        return False
    coloured = np.ptp(darkening(view.rgb, view.plate)[sure], axis=1) > GREY
    return bool(coloured.mean() > COLOURED)


def rest_of_shadow(view: MatteView, removed: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) bool of a shadow that the other views rule out in part only.

    They darken the plate as the `removed` part (h, w) does, all channels alike, and are connected
    to it. The others' `solid` (h, w) stays.
    """
    sure = removed & (view.alpha > INSIDE)
    if view.plate is None or not sure.any():
        return np.zeros(sure.shape, bool)
    darker = darkening(view.rgb, view.plate)
    usual = np.median(darker[sure], axis=0)
    if np.ptp(usual) > GREY or usual.mean() > -DEEP:
        return np.zeros(sure.shape, bool)
    alike = (np.abs(darker - usual) < SAME_SHADE).all(-1) & (view.alpha > FAINT) & ~solid
    _, parts = cv2.connectedComponents((alike | removed).astype(np.uint8), connectivity=4)
    return alike & np.isin(parts, np.unique(parts[removed]))


def shows_surface(
    view: MatteView, evidence: Evidence, todo: np.ndarray, others: Sequence[MatteView],
    subject: dict[str, np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Return the pixels (h, w) bool of `todo` (h, w) coloured like a surface that others see there.

    Somewhere near the front of the others' hull, at least two neighbours must see the pixel's
    colour on their `subject` ({name: (h, w) bool}). Then this camera sees the subject too, in front
    of a background of the same colour.
    """
    rows, columns = np.nonzero(todo)
    near = sorted((o for o in others if o.name != view.name), key=lambda o: -_cosine(view, o))
    near = [other for other in near[:NEIGHBOURS] if _cosine(view, other) > WIDEST]
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
        off = _smooth(other.rgb)[y, x] - mine
        if is_grey(view.rgb) or is_grey(other.rgb):
            off = off @ LUMA
        alike = np.abs(off).max(axis=1) < 255 * COLOUR
        agree += alike & inside & subject[other.name][y, x]
    found = np.zeros(todo.shape, bool)
    found[rows, columns] = (agree >= 2).reshape(depth.shape).any(axis=0)
    return found


def subject_of(view: MatteView, evidence: Evidence) -> np.ndarray:
    """Return the subject's pixels (h, w) bool: by the matte, and in its holes by the others."""
    opaque = view.alpha > INSIDE
    _, parts = cv2.connectedComponents((~opaque).astype(np.uint8), connectivity=4)
    # The bottom counts as closed, because the body continues there.
    outside = np.unique(np.concatenate([parts[0], parts[:, 0], parts[:, -1]]))
    return opaque | (evidence.solid & ~np.isin(parts, outside))


def _smooth(rgb: np.ndarray) -> np.ndarray:
    return cv2.blur(rgb, (3, 3)).astype(np.float32)


def _cosine(a: MatteView, b: MatteView) -> float:
    """Return the cosine of the angle between two cameras, as seen from the ball's centre."""
    length = float(np.linalg.norm(a.center) * np.linalg.norm(b.center))
    return float(a.center @ b.center) / length if length > 0 else 0.0


def _pixels_of(view: MatteView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns, rows and whether in view (N,) of points (3, N), ball coordinates."""
    height, width = view.alpha.shape
    x, y, z = view.projection[:, :3] @ points + view.projection[:, 3, None]
    ahead = z > 1e-6
    x, y = x / np.where(ahead, z, 1), y / np.where(ahead, z, 1)
    inside = ahead & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside


def missed(
    view: MatteView, evidence: Evidence, others: Sequence[MatteView],
    subject: dict[str, np.ndarray],
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Return the pixels (h, w) bool to fill, and the share of the others' solid left unfilled.

    Filled are connected spots without alpha where the others see the subject, partly well inside
    it, and whose colour is the surface's. Spots that the matte does not enclose must lie deeper in
    the hull than its corners stand out.
    """
    solid = evidence.solid
    lacking = solid & (view.alpha < INSIDE) & view.valid
    # The image's borders are not edges of the solid.
    depth = np.full(solid.shape, float(max(solid.shape)), np.float32)
    if not solid.all():
        depth = cv2.distanceTransform(solid.astype(np.uint8), cv2.DIST_L2, 5)
    deep = depth > MARGIN * max(lacking.shape)
    # The tangents of two cameras, each at an angle to this one, meet at 1 / cos(angle) radii.
    cosines = sorted((_cosine(view, o) for o in others if o.name != view.name), reverse=True)
    height = 1 / cosines[1] - 1 if len(cosines) > 1 and cosines[1] > WIDEST else 1.0
    todo = lacking & (subject[view.name] | (depth > height * depth.max()))
    alike = shows_surface(view, evidence, todo, others, subject)
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
    return grown & (solid | (view.alpha >= INSIDE)), left


def lacking_if_moved(opaque: np.ndarray, solid: np.ndarray) -> float:
    """Return the least share of the others' solid (h, w) that a matte (h, w) lacks when shifted."""
    if not solid.any():
        return 0.0
    reach = round(TURN * max(solid.shape))
    padded = cv2.copyMakeBorder(opaque.astype(np.float32), *(4 * [reach]), cv2.BORDER_REPLICATE)
    shared = cv2.matchTemplate(padded, solid.astype(np.float32), cv2.TM_CCORR)
    return max(0.0, 1 - float(shared.max()) / int(solid.sum()))


@dataclass(frozen=True)
class Misfit:
    """Shares of a matte outside the others' hull, and of their solid subject that it lacks."""

    stray: float
    lacking: float
    moved: float  # what it would lack if its camera had turned as far as suits it best

    @property
    def size(self) -> float:
        """Return the size of the error; over 1 the entire matte is wrong."""
        elsewhere = min(self.stray / STRAY, self.lacking / LACKING)
        return max(elsewhere, self.lacking / MOST_LACKING)

    @property
    def lacks(self) -> bool:
        """Return whether only a large part is missing: there the subject looks like the wall."""
        lost = self.lacking > LACKING and self.moved > self.lacking / 2
        return self.stray <= STRAY and lost

    @property
    def reason(self) -> str:
        """Describe the misfit for people."""
        cause = "the subject looks like the wall there" if self.lacks else "the camera moved"
        return (
            f"its matte misses {self.lacking:.0%} of the subject that the other cameras see, and"
            f" {self.stray:.0%} of it lies outside; check whether {cause}. The"
            " matte was not changed"
        )


@dataclass(frozen=True)
class Agreement:
    """The corrections that the views of one frame set make to each other."""

    # removed and filled pixels (h, w) bool of each camera whose matte is corrected
    removed: dict[str, np.ndarray] = field(default_factory=dict)
    filled: dict[str, np.ndarray] = field(default_factory=dict)
    warnings: list[Note] = field(default_factory=list)  # cameras with unchanged mattes, and why
    # cameras whose mattes are right except for a large part that they lack
    lacking: frozenset[str] = frozenset()
    unchanged: str = ""  # why nothing was compared; empty if mattes were compared

    @property
    def doubted(self) -> set[str]:
        """Return the cameras whose mattes the others contradict."""
        return {*self.removed, *(note.what for note in self.warnings)}


def compare_mattes(views: Sequence[MatteView], cells: int = CELLS) -> Agreement:
    """Compare the views of one frame set, on `cells` cells along each side of space."""
    doubted = {view.name: why for view in views if (why := _why_useless(view))}
    # Most of the others must be right; otherwise the wrong ones cannot be identified.
    most = len(doubted) + (len(views) - len(doubted)) // 3
    lacking = frozenset[str]()
    while True:
        used = [view for view in views if view.name not in doubted]
        if len(used) < FEWEST:
            few = f"{len(used)} usable cameras, expected {FEWEST} or more to overrule one"
            return Agreement(warnings=_named(doubted), unchanged=few)
        removed, filled, misfits = _compare(used, cells)
        # Cameras that wrong ones make look incomplete too can wait until these are completed.
        lacking = lacking or frozenset(name for name, one in misfits.items() if one.lacks)
        worst = max(misfits, key=lambda name: misfits[name].size)
        if misfits[worst].size <= 1 or len(doubted) >= most:
            return Agreement(removed, filled, _named(doubted), lacking)
        doubted[worst] = misfits[worst].reason


def _named(doubted: dict[str, str]) -> list[Note]:
    return [Note(name, why) for name, why in sorted(doubted.items())]


def _why_useless(view: MatteView) -> str:
    """Return why a view cannot judge the other mattes; empty if it can."""
    if view.projection[2, 3] <= 1:  # depth of the ball's centre, in radii
        return "it stands inside what the others look at, or faces away; its matte was not changed"
    share = float((view.alpha[view.valid] > INSIDE).mean()) if view.valid.any() else 0.0
    if share < EMPTY:
        return f"its matte is empty ({share:.2%} of the image)"
    return f"its matte covers {share:.1%} of the image" if share > FULL else ""


def _compare(
    views: Sequence[MatteView], cells: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Misfit]]:
    """Return what to remove and to fill in each view, and how badly it fits the others."""
    longest = max(max(view.alpha.shape) for view in views)
    space = make_space(views, cells, max(1.5, MARGIN * longest))
    place = subject_place(space)
    found = {view.name: evidence_of(view, space, place) for view in views}
    subject = {view.name: subject_of(view, found[view.name]) for view in views}
    removed: dict[str, np.ndarray] = {}
    filled: dict[str, np.ndarray] = {}
    misfits: dict[str, Misfit] = {}
    for view in views:
        mine = found[view.name]
        bad = ruled_out(view, mine)
        bad |= rest_of_shadow(view, bad, mine.solid)
        spots, lacking = missed(view, mine, views, subject)
        opaque = view.alpha > INSIDE
        stray = float((opaque & ~mine.likely).sum()) / int(opaque.sum())
        moved = lacking_if_moved(opaque, mine.solid) if lacking > LACKING else lacking
        misfits[view.name] = Misfit(stray, lacking, moved)
        if bad.any():
            removed[view.name] = bad
        if spots.any():
            filled[view.name] = spots
    return removed, filled, misfits
