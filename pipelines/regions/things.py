"""Find things in front of the tracked face: glasses by colour, hands by how well views agree.

**Glasses.** Frames are too thin for depth maps. But every view sees a place on a frame in a colour
unlike skin, whereas a place in front of a bare face has skin behind it in some view. So colours
carve the space in front of the eyes as silhouettes carve a hull. What is left is glasses if it runs
around an eye; lenses, which show the colours behind them, fill the ring.

**Hands** have the colour of skin, and their outlines lie within the head's. But views that see the
face agree on it, and views that see a hand agree in front of it. So along every ray to the face, a
view is compared with its neighbours, on the tracked mesh and wherever the mattes leave room in
front of it. A ray that ends on the face leaves no room for things in front: agreement carves too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import open3d as o3d
from scipy import ndimage

from express50.capture.frames import reduced
from express50.contract.segmentation_labels import LABELS, label_mask
from express50.geometry.cameras import (
    Camera,
    crop_camera,
    cut_about,
    depth_in,
    inside_frame,
    project_pinhole,
    unproject,
)
from express50.geometry.conventions import cell_to_corner, corner_to_cell
from express50.geometry.pixels import LIGHT_OF_LEVEL, box_about, disc
from express50.geometry.raycast import join_rays
from express50.geometry.sampling import local_moments
from express50.geometry.transforms import unit
from pipelines.regions.colour import colour_logs, like_skin
from pipelines.regions.geometry import FACE, WIDTH_M, TrackedHead, nearest, render_head

EYES, SKIN = LABELS.index("eyes"), LABELS.index("skin")
CELL_M = 0.002
# Ends of the searched box about the middle of the eyes: to the sides, upwards, along the gaze.
BOX_M = ((-0.08, 0.08), (-0.045, 0.04), (-0.03, 0.045))
CLEAR_M, FAR_M = 0.003, 0.03  # from the mesh, between which glasses are looked for
LEAST_VIEWS = 4  # that see an odd colour
VIEWS_PER_MISS = 16  # one in this many views of odd colours may see skin
LEAST_SKIN = 200  # pixels of skin in a view that is asked
LEAST_CELLS = 20  # in a connected part that is kept
FRONT_M, BRIDGE_M, REACH_M = 0.015, 0.005, 0.045  # depth of a rim, half a bridge, rim from its eye
WIDER_OVAL = 1.1  # ellipses through a rim, outside which cells are not its own
BEARINGS, AROUND = 24, 0.6  # about an eye, and the share of them that shows a rim
EYE_M = 0.015  # radius of an eye with its lashes and shadow, which are not glasses
WIDER_M = 0.0012  # by which cells are wider than glasses: odd pixels are dilated by one

SIDE, AROUND_M = 384, 0.1  # most pixels of the crops that are compared, and their margin
NEAR_M = 0.008  # largest distance of the face from the tracked mesh
HEIGHTS_M = np.arange(0.012, 0.1, 0.006)  # in front of the mesh, about which things are looked for
STEPS_M = (-0.0022, -0.0007, 0.0008, 0.0023)  # compared about each of them
APART = (0.5, 0.97)  # cosines between views that are compared: others look alike, or unlike
NEIGHBOURS = 4  # views that a view is compared with, and the cosine that they are nearest to
BEST_APART = 0.8
PATCH_PX, NOISE = 9, 0.006  # side of what is compared and averaged; noise of root light
# Agreement by which a thing must be better than the face to be one, and to leave the face unsure.
THING_MARGIN, BARE_MARGIN = 0.1, -0.05
EDGE_M = 0.005  # from the border between face and thing, within which the nearest edge is taken
LEAST_THING, WITNESSES = 0.005, 2  # share of the face, and views that show it; less is chance

Picture = tuple[Camera, np.ndarray, np.ndarray]
"""A pinhole camera, its frame (H, W, 3) uint8 and its matte (H, W) in [0, 1]."""
_Line = tuple[np.ndarray, np.ndarray]
"""Homogeneous pixels (3, h, w) of places, and what a metre along their rays adds to them."""


def find_glasses(head: TrackedHead, pictures: Sequence[Picture]) -> np.ndarray:
    """Find places (n, 3), world, CELL_M apart, all over frames and lenses; none without glasses."""
    nothing = np.zeros((0, 3))
    eyes = (head.vertices[head.labels.vertices == EYES] - head.center) @ head.R
    if not len(eyes) or len(pictures) < LEAST_VIEWS:
        return nothing
    sides = [eyes[eyes[:, 0] * side > np.median(eyes[:, 0]) * side] for side in (-1, 1)]
    eyes = np.array([np.r_[eye.mean(0)[:2], eye[:, 2].max()] for eye in sides])
    axes = [np.arange(low, high, CELL_M) for low, high in BOX_M]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) + eyes.mean(0)
    odd = _unlike_skin(head, pictures, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    parts, _ = ndimage.label(odd, np.ones((3, 3, 3)))
    odd &= (np.bincount(parts.ravel()) >= LEAST_CELLS)[parts]
    frame = grid[odd]
    beside = np.abs(frame[:, 0] - eyes[:, 0].mean()) > BRIDGE_M
    near = [np.linalg.norm(frame[:, :2] - eye[:2], axis=1) for eye in eyes]
    lenses = []
    for k, eye in enumerate(eyes):
        rim = frame[beside & (near[k] < np.minimum(near[1 - k], REACH_M))]
        rim = rim[np.linalg.norm(rim[:, :2] - eye[:2], axis=1) > EYE_M]
        if len(rim):  # without the bar to the ear
            rim = rim[rim[:, 2] > np.quantile(rim[:, 2], 0.9) - FRONT_M]
        # Unlike brows, a rim runs around its eye.
        if len(np.unique(_bearings(rim[:, :2], eye))) >= AROUND * BEARINGS:
            lenses.append(_lens(rim, eye, grid[:, :, 0, :2]))
    return np.concatenate([frame, *lenses]) @ head.R.T + head.center if lenses else nothing


def _unlike_skin(head: TrackedHead, pictures: Sequence[Picture], grid: np.ndarray) -> np.ndarray:
    """Mark the places (N,) of a grid (N, 3), about the head's centre, that no view sees as skin."""
    local = (grid @ head.R.T).astype(np.float32)
    apart = head.scene.compute_distance(o3d.core.Tensor(local), nthreads=1).numpy()
    ids = np.flatnonzero((apart > CLEAR_M) & (apart < FAR_M))
    odd, seen = np.zeros(len(ids), int), np.zeros(len(ids), int)
    for camera, rgb, alpha in pictures:
        # The others are skin, or beside it.
        open_still = seen - odd <= len(pictures) // VIEWS_PER_MISS
        ids, odd, seen = ids[open_still], odd[open_still], seen[open_still]
        places = local[ids]
        mesh, _ = render_head(head, camera)
        skin = (mesh == SKIN) & (alpha > 0.99)
        if skin.sum() < LEAST_SKIN:
            continue
        logs = colour_logs(rgb)
        unlike = ~like_skin(logs.reshape(-1, 3), logs[skin]).reshape(skin.shape)
        shown = cv2.dilate((unlike & (alpha > 0.5)).astype(np.uint8), np.ones((3, 3), np.uint8))
        pixels, inside = inside_frame(camera, places + head.center)
        column, row = np.clip(pixels.astype(np.int64), 0, np.array(skin.shape[::-1]) - 1).T
        rays = join_rays(places, camera.center - head.center - places)
        inside &= ~head.scene.test_occlusions(rays, nthreads=1).numpy()
        seen += inside
        odd += inside & (shown[row, column] > 0)
    found = np.zeros(len(grid), bool)
    found[ids[(odd >= LEAST_VIEWS) & (seen - odd <= seen // VIEWS_PER_MISS)]] = True
    return found


def _bearings(places: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Return the bearings (N,) of places (N, 2) about an eye, in axes of the head, in steps."""
    x, y = (places - eye[:2]).T
    return ((np.arctan2(y, x) / (2 * np.pi) % 1) * BEARINGS).astype(int)


def _lens(rim: np.ndarray, eye: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Fill a rim (N, 3) with places (n, 3); `grid` (nx, ny, 2) has the columns along the gaze.

    An ellipse closes the rim where it touches the nose and is not found, and tells it from brows
    and bars behind it.
    """
    cells = ((rim[:, :2] - grid[0, 0]) / CELL_M).round().astype(np.int32)
    filled, oval, wider = np.zeros((3, *grid.shape[1::-1]), np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(cells), 1)
    found = np.isin(_bearings(grid.reshape(-1, 2), eye), _bearings(rim[:, :2], eye))
    found = found.reshape(grid.shape[:2]).T
    border = (filled > cv2.erode(filled, np.ones((3, 3), np.uint8))) & found
    middle, axes, angle = cv2.fitEllipseDirect(np.argwhere(border)[:, ::-1])
    cv2.ellipse(oval, (middle, axes, angle), 1, cv2.FILLED)
    cv2.ellipse(wider, (middle, np.multiply(axes, WIDER_OVAL), angle), 1, cv2.FILLED)
    filled[:] = 0
    cv2.fillConvexPoly(filled, cv2.convexHull(cells[wider[cells[:, 1], cells[:, 0]] > 0]), 1)
    places = grid[np.where(found, filled, filled | oval).T > 0]
    plane = np.linalg.lstsq(np.c_[rim[:, :2], np.ones(len(rim))], rim[:, 2], rcond=None)[0]
    return np.c_[places, np.c_[places, np.ones(len(places))] @ plane]


def shown_in_front(places: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) bool that show places (n, 3) of glasses in front of a head.

    The depth (H, W) is the head's, camera z in metres, 0 beside it.
    """
    found = np.zeros(depth.shape, np.uint8)
    pixels, inside = inside_frame(camera, places)
    ahead = depth_in(camera, places[inside])
    column, row = pixels[inside].astype(np.int64).T
    clear = (depth[row, column] == 0) | (ahead < depth[row, column])
    found[row[clear], column[clear]] = 1
    if not clear.any():
        return found > 0
    metre_px = camera.K[0, 0] / np.median(ahead)
    size = (int(np.ceil(CELL_M * metre_px)) | 1) + 2
    whole = cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    return cv2.erode(whole, disc(round(WIDER_M * metre_px))) > 0


@dataclass(frozen=True)
class FaceView:
    """What one view shows where it would see the tracked face if nothing were in front of it."""

    camera: Camera  # pinhole
    depth: np.ndarray  # (H, W) of the head, camera z in metres, 0 beside it
    bare: np.ndarray  # (H, W) bool, surely the face
    covered: np.ndarray  # (H, W) bool, surely something in front of the face
    things: np.ndarray  # (n, 3) places, world, on what covers it


@dataclass(frozen=True)
class _Shot:
    """A crop about the head."""

    camera: Camera
    rgb: np.ndarray  # (H, W, 3)
    alpha: np.ndarray  # (H, W) matte
    grey: np.ndarray  # (H, W) root of light
    mesh: np.ndarray  # (H, W) labels of `render_head`
    depth: np.ndarray  # (H, W) depth of `render_head`

    @cached_property
    def ends(self) -> np.ndarray:
        """Return how far (H, W) from the camera space is empty: everywhere beside the matte."""
        return np.where(self.alpha > 0.5, 0, np.float32(np.inf))


@dataclass(frozen=True)
class _Sweep:
    """How well a view agrees with others on the face and in front of it, in a window (h, w)."""

    camera: Camera
    depth: np.ndarray
    window: tuple[slice, slice]
    face: np.ndarray  # (h, w) bool
    places: np.ndarray  # (h, w, 3) on the head, about its centre
    ways: np.ndarray  # (h, w, 3) unit, towards them
    free: np.ndarray  # (HEIGHTS_M, h, w) bool, where there may be a thing in front of the face
    # `_compare` fills these where there is room for things
    on_face: np.ndarray  # (h, w) best agreement within NEAR_M of the head
    before: np.ndarray  # (HEIGHTS_M, h, w) best agreement in front of the head

    def face_view(self, center: np.ndarray) -> FaceView:
        """Tell the face from things; the head's `center` (3,) is in the world."""
        asked = self.free.any(0)
        score = np.where(self.free, self.before, np.float32(-2))
        better = np.where(asked, score.max(0) - self.on_face, 0)
        size = (PATCH_PX, PATCH_PX)
        better = cv2.blur(better, size) / np.maximum(cv2.blur(asked.astype(np.float32), size), 1e-3)
        bare = self.face & ~(asked & (better > BARE_MARGIN))
        thing = (asked & (better > THING_MARGIN)).astype(np.uint8)
        thing = cv2.morphologyEx(thing, cv2.MORPH_OPEN, _disc(self, WIDTH_M / 2)) > 0
        height = HEIGHTS_M[score.argmax(0)][thing][:, None]
        shown, hidden = np.zeros((2, *self.depth.shape), bool)
        shown[self.window] = cv2.erode(bare.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        hidden[self.window] = thing
        things = center + self.places[thing] - height * self.ways[thing]
        return FaceView(self.camera, self.depth, shown, hidden, things)


def face_views(head: TrackedHead, pictures: Sequence[Picture]) -> list[FaceView]:
    """Separate the face from things in front of it in every view of it; empty if there are none.

    The views' cameras are those of crops of the pictures.
    """
    shots = [shot for picture in pictures if (shot := _shot(head, picture))]
    sweeps = []
    for own, shot in enumerate(shots):
        face = label_mask(shot.mesh, *FACE) & (shot.alpha > 0.5)
        if head.faces_camera(shot.camera) and face.sum() >= LEAST_SKIN:
            sweeps.append(_sweep(head, shots, own, face))
    if len(sweeps) < LEAST_VIEWS:
        return []
    views = [sweep.face_view(head.center) for sweep in sweeps]
    for sweep in sweeps:
        for view in views:
            if view.camera is not sweep.camera:  # where it sees the face, nothing is in front
                ends = np.where(view.bare, view.depth - np.float32(NEAR_M), 0)
                _narrow(sweep.free, head.center, sweep.places, sweep.ways, view.camera, ends)
    views = [sweep.face_view(head.center) for sweep in sweeps]
    pictured = {shot.camera.id: shot for shot in shots}
    views = [_up_to_edges(view, pictured[view.camera.id]) for view in views]
    hidden = [
        v.covered.sum() > LEAST_THING * s.face.sum() for v, s in zip(views, sweeps, strict=True)
    ]
    if sum(hidden) < WITNESSES:
        return []
    return [replace(view, things=_not_before_bare_face(view.things, views)) for view in views]


def _not_before_bare_face(things: np.ndarray, views: Sequence[FaceView]) -> np.ndarray:
    """Leave out the places (n, 3) through which some view sees the face."""
    for view in views:
        pixels, inside = inside_frame(view.camera, things)
        column, row = pixels[inside].astype(np.int64).T
        ahead = depth_in(view.camera, things[inside])
        kept = np.ones(len(things), bool)
        kept[inside] = ~(view.bare[row, column] & (ahead < view.depth[row, column] - NEAR_M))
        things = things[kept]
    return things


def _up_to_edges(view: FaceView, shot: _Shot) -> FaceView:
    """Move the border between face and thing onto an edge of the picture.

    Patches straddle the border, so that it is sure only within EDGE_M.
    """
    around = _disc(view, EDGE_M)
    markers = np.zeros(view.depth.shape, np.int32)
    for number, mask in enumerate((view.bare, view.covered), 1):
        markers[cv2.erode(mask.astype(np.uint8), around) > 0] = number
    beside = (view.depth == 0) | (shot.alpha <= 0.5)
    markers[cv2.erode(beside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = 3
    split = cv2.watershed(np.ascontiguousarray(shot.rgb), markers)
    return replace(view, bare=(split == 1) & ~beside, covered=(split == 2) & ~beside)


def _disc(view: FaceView | _Sweep, radius_m: float) -> np.ndarray:
    """Make a disc of a radius at the head, for morphology."""
    metre_px = view.camera.K[0, 0] / float(np.median(view.depth[view.depth > 0]))
    return disc(max(1, round(radius_m * metre_px)))


def _shot(head: TrackedHead, picture: Picture) -> _Shot | None:
    """Crop a picture to the head and what is near it, at most SIDE pixels; None without a head."""
    camera, rgb, alpha = picture
    pixels, ahead = project_pinhole(camera, head.vertices)
    if (ahead <= 1e-3).any():
        return None
    margin = AROUND_M * camera.K[0, 0] / float(np.median(ahead))
    part, window = cut_about(camera, pixels, margin)
    if min(part.width, part.height) < PATCH_PX:
        return None
    rgb, alpha = (np.ascontiguousarray(image[window]) for image in (rgb, alpha))
    camera, rgb, alpha = reduced(part, rgb, alpha, SIDE)
    grey = np.sqrt(cv2.GaussianBlur(LIGHT_OF_LEVEL[rgb], (0, 0), 0.7)).mean(2)
    return _Shot(camera, rgb, alpha, grey, *render_head(head, camera))


def _sweep(head: TrackedHead, shots: Sequence[_Shot], own: int, face: np.ndarray) -> _Sweep:
    """Compare a view, number `own`, with its neighbours where it sees the `face` (H, W)."""
    camera, depth = shots[own].camera, shots[own].depth
    window = box_about(face, PATCH_PX)
    row, column, _ = nearest(depth[window] > 0)
    shape = row.shape
    cells = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1).reshape(-1, 2)
    part = crop_camera(camera, window[1].start, window[0].start, shape[1], shape[0])
    places = unproject(part, cell_to_corner(cells), depth[window][row, column].ravel())
    ways = unit(places - camera.center)
    places, ways = (values.reshape(*shape, 3) for values in (places - head.center, ways))
    sights = unit(np.array([shot.camera.center - head.center for shot in shots]))
    cosine = sights @ sights[own]
    free = np.repeat(face[None, *window], len(HEIGHTS_M), axis=0)
    for k in np.argsort(np.abs(cosine), kind="stable"):  # views from the side leave the least room
        _narrow(free, head.center, places, ways, shots[k].camera, shots[k].ends)
    none = np.zeros(shape, np.float32), np.full(free.shape, np.float32(-1))
    sweep = _Sweep(camera, depth, window, face[window], places, ways, free, *none)
    ranked = np.argsort(np.abs(cosine - BEST_APART), kind="stable").tolist()
    chosen = [shots[k] for k in ranked if APART[0] < cosine[k] < APART[1]][:NEIGHBOURS]
    _compare(head, sweep, _patches(shots[own].grey[window]), chosen)
    return sweep


def _compare(
    head: TrackedHead, sweep: _Sweep, mine: tuple[np.ndarray, ...], shots: Sequence[_Shot]
) -> None:
    """Fill in how well a view's `_patches` agree with other shots where there is room for things.

    On a bare face that many cameras see, this is a hundredth of the pixels.
    """
    step = STEPS_M[1] - STEPS_M[0]
    about = np.arange(-NEAR_M, NEAR_M + step / 2, step)
    reach = np.ones((2 * PATCH_PX - 1, 2 * PATCH_PX - 1), np.uint8)  # patches are averaged again
    count, parts = cv2.connectedComponents(cv2.dilate(sweep.free.any(0).astype(np.uint8), reach))
    for number in range(1, count):
        box = box_about(parts == number)
        inside = parts[box] == number
        patches = tuple(values[box] for values in mine)
        places, ways = sweep.places[box], sweep.ways[box]
        near = [(shot, _line(shot.camera, head.center, places, ways)) for shot in shots]
        best = np.max([_agreement(patches, near, offset) for offset in about], axis=0)
        sweep.on_face[box][inside] = best[inside]
        for free, before, offset in zip(sweep.free, sweep.before, HEIGHTS_M, strict=True):
            if free[box].any():
                offsets = [offset + more for more in STEPS_M]
                best = np.max([_agreement(patches, near, each) for each in offsets], axis=0)
                before[box][inside] = best[inside]


def _agreement(
    mine: tuple[np.ndarray, ...], near: Sequence[tuple[_Shot, _Line]], offset: float
) -> np.ndarray:
    """Correlate `_patches` of a view with those of neighbours `offset` metres in front of the head.

    The best correlation (h, w) is averaged over a patch; it is -1 where no neighbour sees the
    place.
    """
    best, size = np.full(mine[0].shape, np.float32(-1)), (PATCH_PX, PATCH_PX)
    for shot, line in near:
        point = _pixels_at(line, offset)
        theirs = _patches(_sampled(shot.grey, point, cv2.INTER_LINEAR))
        hidden = _sampled(shot.depth, point)
        seen = (hidden == 0) | (point[2] < hidden + HEIGHTS_M[0])
        seen &= _sampled(shot.alpha, point) > 0.5
        product = cv2.blur(mine[0] * theirs[0], size) - mine[1] * theirs[1]
        best = np.maximum(best, np.where(seen, product / (mine[2] * theirs[2]), -1))
    return cv2.blur(best, size)


def _patches(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a picture (H, W), and mean and deviation, with noise, about each pixel."""
    mean, variance = local_moments(grey, PATCH_PX)
    return grey, mean, np.sqrt(variance + np.float32(NOISE**2))


def _line(camera: Camera, center: np.ndarray, places: np.ndarray, ways: np.ndarray) -> _Line:
    """Project places and ways (h, w, 3), about `center` (3,): homogeneous pixels (3, h, w)."""
    matrix = camera.K @ camera.cam_from_world[:3, :3]
    start = places @ matrix.T + matrix @ (center - camera.center)
    first, second = (np.moveaxis(values, -1, 0) for values in (start, ways @ matrix.T))
    return np.ascontiguousarray(first, np.float32), np.ascontiguousarray(second, np.float32)


def _pixels_at(line: _Line, offset: float) -> np.ndarray:
    """Return x, y and depth (3, h, w) `offset` before; the first pixel's middle is the origin."""
    point = line[0] - np.float32(offset) * line[1]
    point[:2] /= np.maximum(point[2], np.float32(1e-6))
    point[:2] = corner_to_cell(point[:2])
    return point


def _sampled(
    image: np.ndarray, point: np.ndarray, interpolation: int = cv2.INTER_NEAREST
) -> np.ndarray:
    """Look points (3, h, w) of `_pixels_at` up in an image (H, W), which is 0 outside."""
    return cv2.remap(image, point[0], point[1], interpolation, borderMode=cv2.BORDER_CONSTANT)


def _narrow(
    free: np.ndarray,
    center: np.ndarray,
    places: np.ndarray,
    ways: np.ndarray,
    camera: Camera,
    ends: np.ndarray,
) -> None:
    """Remove from the room (HEIGHTS_M, h, w) in front of places what a view sees to be empty.

    That is what lies nearer to its camera than `ends` (H, W), in metres.
    """
    box = box_about(free.max(0))
    line = _line(camera, center, places[box], ways[box])
    for room, offset in zip(free[:, *box], HEIGHTS_M, strict=True):
        if room.any():
            part = (slice(None), *box_about(room))
            point = _pixels_at((line[0][part], line[1][part]), offset)
            room[part[1:]] &= point[2] >= _sampled(ends, point)
