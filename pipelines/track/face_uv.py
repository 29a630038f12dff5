"""Find landmarks on the face UV map, and follow the skin; both slide the mesh to its place.

Patches do not show motion along the skin. If a corner of the mouth appears beside its texel on the
map, the mesh moves by that distance. The map is a cylinder about the head, unrolled and warped
until the 68 landmarks of all head models lie in the same places, so one network reads the maps of
all of them. On it every face is upright, frontal and of one size, and the network, which was
trained from the landmark network for whole heads, sees it at twice the resolution. It does not find
the jaw line, which is not an edge on the map.

The skin's own texture is followed from the resting face to every other expression. Where their maps
differ, optical flow (DIS, Kroeger et al. 2016) measures how far the expression's mesh must slide
(docs/TRACKING.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.interpolate import RBFInterpolator

from express50.errors import HeadModelError
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_to_corner, corner_to_cell
from express50.geometry.raycast import visible_faces
from express50.geometry.sampling import bilinear
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, landmarks, normals_of
from express50.landmarks.network import CROP, MIRROR, LandmarkNet, load_network
from pipelines.track.appearance import robust_mean
from pipelines.track.basis import movable_vertices
from pipelines.track.config import UV_WEIGHTS
from pipelines.track.state import Target
from pipelines.track.surface import (
    FrameSetCrops,
    Visibility,
    flat_barycentrics,
    sample_normals,
    view_colours,
    view_weights,
)
from pipelines.track.terms import MeshPlaces, SlideTerm, landmark_anchors

REDUNDANCY = 2.0  # landmarks that count as one, because neighbours err together
FLOOR_M = 0.0004
VIEW_NOISE = 0.05  # standard deviation of root light between views of one place
LEAST_SEEN, LEAST_VIEWS = 0.1, 2
MOST_VIEWS = 6  # those from the side blur the map
# Factor on the standard deviations of the detector's landmarks that the map shows too: they are
# coarser and err differently in every expression. The others, as corners of open mouths, stay.
DISTRUST = 6.0
TORN_M = 0.004  # texels further apart than this lie on two sides of a gap, as between open lips

# Texels, and how much of the head they cover: about 1.3 mm each on the cheeks.
WIDTH, HEIGHT = 192, 160
RIGHT, TOP = 1.35, 1.2
# Beyond this azimuth a face may straddle the seam at the back.
BACK = 2.6
# Skin that lies further behind a texel's is another sheet; in widths between outer eye corners.
SHEET = 0.04
# Where the landmarks' azimuths (radians) and heights (in widths between the outer eye corners) are
# put on the map, whatever the head.
MARKS = np.array(
    [
        (-1.571, 0.290), (-1.561, 0.079), (-1.552, -0.125), (-1.455, -0.356), (-1.215, -0.547),
        (-0.874, -0.691), (-0.515, -0.800), (-0.214, -0.872), (0.000, -0.880), (0.214, -0.872),
        (0.515, -0.800), (0.874, -0.691), (1.215, -0.547), (1.455, -0.356), (1.552, -0.125),
        (1.561, 0.079), (1.571, 0.290), (-0.657, 0.519), (-0.497, 0.590), (-0.351, 0.611),
        (-0.219, 0.595), (-0.100, 0.536), (0.100, 0.536), (0.219, 0.595), (0.351, 0.611),
        (0.497, 0.590), (0.657, 0.519), (0.000, 0.404), (0.000, 0.284), (0.000, 0.153),
        (0.000, 0.000), (-0.137, -0.128), (-0.076, -0.160), (0.000, -0.169), (0.076, -0.160),
        (0.137, -0.128), (-0.605, 0.367), (-0.483, 0.401), (-0.328, 0.396), (-0.234, 0.341),
        (-0.335, 0.309), (-0.484, 0.314), (0.234, 0.341), (0.328, 0.396), (0.483, 0.401),
        (0.605, 0.367), (0.484, 0.314), (0.335, 0.309), (-0.323, -0.396), (-0.175, -0.340),
        (-0.053, -0.301), (0.000, -0.313), (0.053, -0.301), (0.175, -0.340), (0.323, -0.396),
        (0.177, -0.466), (0.056, -0.501), (0.000, -0.508), (-0.056, -0.501), (-0.177, -0.466),
        (-0.312, -0.396), (-0.156, -0.389), (0.000, -0.398), (0.156, -0.389), (0.312, -0.396),
        (0.156, -0.390), (0.000, -0.399), (-0.156, -0.390),
    ]
)  # fmt: skip

# The rims of closed lips touch: a texel to either side shows which lip a landmark moves with.
LIPS_APART = np.zeros((68, 2))
LIPS_APART[[61, 62, 63], 1], LIPS_APART[[65, 66, 67], 1] = -1.2, 1.2
# First landmark that is read; first column and row of the part of the map that is read; its side.
FIRST = 17
LEFT, UPPER, SIDE = 36, 34, 120
TEXELS_PER_PIXEL = SIDE / CROP

# Following the skin, on a finer map.
FINE = 2  # texels of 0.65 mm on the cheeks
LIGHT_TEXELS = 6.0  # texels over which light and shade are evened out
NOISE = 0.01  # of root light: contrast must stand out from it
SPACING_TEXELS = 4  # texels between places that are followed
RETURN_TEXELS = 0.6  # texels by which the flow there and back may miss
TEXTURED = 0.02  # least contrast, in every direction, of what is followed
SIGMA = 0.5  # texels
FLOW_REDUNDANCY = 30.0  # places that count as one, because neighbours err together
RIM = 9  # texels: closer than this to what is not seen, flow is not trusted


def with_slide(target: Target, slide: SlideTerm | None) -> Target:
    """Add a reading of the map; trust the detector less at landmarks that the map shows."""
    if slide is None:
        return target
    sigma = target.sigma.copy()
    sigma[:, slide.marks] *= DISTRUST
    return replace(target, sigma=sigma, terms=(*target.terms, slide))


def slide_term(
    model: HeadModel,
    uv_map: FaceUvMap,
    pictures: FrameSetCrops,
    mesh: np.ndarray,
    covered: np.ndarray | None = None,
) -> SlideTerm | None:
    """Find where a frame set's skin belongs, about its mesh (V, 3); None if too little is seen.

    Landmarks on vertices that hair has `covered` (V,) are left out: the network guesses there.
    """
    colors, mass = unwrap(model, uv_map, pictures, mesh)
    if not (mass > LEAST_SEEN).any():
        return None
    at, error = read_marks(load_network(UV_WEIGHTS), colors)
    rims = LIPS_APART[FIRST:]
    # Single precision is for places about the head, not for those of the world.
    places = uv_map.image((uv_map.samples.at(mesh) - mesh.mean(0)).astype(np.float32))
    found, step = between(places, at + rims)
    home, home_step = between(places, mark_places() + rims)
    seen = bilinear((mass > LEAST_SEEN).astype(np.float32), at + rims)
    anchors = landmark_anchors(model).some(slice(FIRST, None))
    usable = (seen > 0.99) & (np.maximum(step, home_step) < TORN_M)
    if covered is not None:
        usable &= ~covered[anchors.vertices].any(1)
    good = np.flatnonzero(usable)
    if not len(good):
        return None
    anchors = anchors.some(good)
    # The map rounds off where landmarks lie, but shows well how far they have moved.
    goals = anchors.at(mesh) + found[good] - home[good]
    normals = normals_of(mesh, model.faces)
    sigma = np.hypot(error[good] * step[good], FLOOR_M) * REDUNDANCY**0.5
    return SlideTerm(anchors, good + FIRST, goals, unit(anchors.at(normals)), sigma)


def unwrap(
    model: HeadModel, uv_map: FaceUvMap, pictures: FrameSetCrops, mesh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project the pictures onto the map: root light (HEIGHT, WIDTH, 3), and its weight (H, W).

    Places seen by fewer than two views count as unseen: one view cannot distinguish a move along
    the skin from one off it.
    """
    places, normals = uv_map.samples.at(mesh), sample_normals(uv_map.samples, mesh)
    # Only the pictures that the face looks at most.
    away = [crop.camera.center - places.mean(0) for crop in pictures.crops]
    facing = [normals.mean(0) @ way / max(float(np.linalg.norm(way)), 1e-12) for way in away]
    chosen = np.argsort(facing, kind="stable")[::-1][:MOST_VIEWS]
    pictures = pictures.some(sorted(chosen.tolist()))
    weights = view_weights(Visibility(mesh, model.faces.numpy()), pictures, places, normals)
    # The network reads it in single precision.
    values = view_colours(pictures.images(), weights, places).astype(np.float32)
    trust = (weights**2 * ((weights > 0).sum(0) >= LEAST_VIEWS)).astype(np.float32)
    colors = robust_mean(values, np.ones((1, 1, 1), np.float32), trust, VIEW_NOISE)
    mass = trust.sum(0)[:, None].astype(np.float32)
    return uv_map.image(colors.astype(np.float32)), uv_map.image(mass)[..., 0]


def between(places: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate places (S, 3) at texels (S, 2); also the longest step (S,) between texels."""
    most = places.shape[1] - 2, places.shape[0] - 2
    column, row = np.clip(corner_to_cell(at), 0, most).astype(np.int64).T
    a, b = places[row, column], places[row, column + 1]
    c, d = places[row + 1, column], places[row + 1, column + 1]
    steps = [np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (c, d), (a, c), (b, d))]
    return bilinear(places, at).astype(np.float64), np.max(steps, axis=0)


@dataclass(frozen=True)
class FaceUvMap:
    """The UV map of a head model's face."""

    samples: MeshPlaces  # T places on the mesh, one per texel that shows the head
    texels: np.ndarray  # (T, 2) their rows and columns
    places: np.ndarray  # (V, 2) vertices' columns and rows, corner origin; far off if without
    front: np.ndarray  # (F,) bool, faces of skin that the map shows, however small
    skin: np.ndarray  # (T,) bool, texels of skin: not of eyes, teeth or tongue
    fine: int = 1  # texels per side of a texel of the map that the network reads

    def image(self, values: np.ndarray) -> np.ndarray:
        """Spread values (T, C) over the map (HEIGHT, WIDTH, C), finer by `fine`; 0 off the head."""
        size = HEIGHT * self.fine, WIDTH * self.fine
        out = np.zeros((*size, values.shape[1]), dtype=values.dtype)
        out[tuple(self.texels.T)] = values
        return out


def make_uv_map(model: HeadModel, fine: int = 1) -> FaceUvMap:
    """Lay a head model's template flat; HeadModelError if the eyes' outer corners coincide."""
    vertices = model.template.double().numpy()
    marks = landmarks(model, model.template[None].double())[0].double().numpy()
    if np.linalg.norm(marks[45] - marks[36]) < 1e-6:
        raise HeadModelError(
            f"head model {model.name!r}: landmarks 36 and 45, the outer corners of the eyes,"
            " coincide, so the face has no UV map; correct the model's landmarks or set"
            " track.uv_rounds=0"
        )
    turned, radius = unrolled(vertices, marks)
    # The smoothest warp that brings the landmarks to where they belong.
    warp = RBFInterpolator(
        unrolled(marks, marks)[0], MARKS, kernel="thin_plate_spline", smoothing=1e-4
    )
    places, width, height = fine * to_texels(warp(turned)), fine * WIDTH, fine * HEIGHT
    faces = model.faces.numpy()
    near = (np.abs(turned[:, 0]) < BACK)[faces].all(1)
    ids = np.flatnonzero(near)
    # Seen from outside, what is further from the axis is nearer.
    depth = 10.0 - np.minimum(radius, 5.0)
    flat = np.column_stack([places * depth[:, None], depth])
    camera = Camera("map", width, height, "PINHOLE", (1.0, 1.0, 0.0, 0.0), np.eye(4))
    found = visible_faces(flat, faces[ids], camera)[0]
    face_id = np.where(found >= 0, ids[np.maximum(found, 0)], -1)
    texels = np.argwhere(face_id >= 0)
    of_texel = face_id[tuple(texels.T)]
    bary = flat_barycentrics(places[faces[of_texel]], cell_to_corner(texels[:, ::-1]))
    samples = MeshPlaces(faces[of_texel], bary)
    inside = (~movable_vertices(model))[faces].any(1)
    shown = np.zeros((height, width))
    shown[tuple(texels.T)] = (radius[samples.vertices] * bary).sum(1)
    column, row = np.clip(places[faces].mean(1), 0, (width - 1, height - 1)).astype(np.int64).T
    on_map = ((places[faces] >= 0) & (places[faces] <= (width, height))).all((1, 2))
    front = near & on_map & ~inside & (radius[faces].mean(1) > shown[row, column] - SHEET)
    return FaceUvMap(samples, texels, places, front, ~inside[of_texel], fine)


def unrolled(points: np.ndarray, marks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and height (N, 2) about the head's axis, and distance (N,) from it.

    The axis runs upwards between the ends of the jaw line; heights are above the tip of the nose,
    in widths between the outer corners of the eyes.
    """
    axis = marks[[0, 16]].mean(0)
    unit = float(np.linalg.norm(marks[45] - marks[36]))
    x, z = points[:, 0] - axis[0], points[:, 2] - axis[2]
    height = (points[:, 1] - marks[30, 1]) / unit
    return np.stack([np.arctan2(x, z), height], axis=1), np.hypot(x, z) / unit


def to_texels(turned: np.ndarray) -> np.ndarray:
    """Convert azimuths and heights (N, 2) to column and row (N, 2), corner origin."""
    step = 2.0 * RIGHT / WIDTH
    return np.stack([WIDTH / 2 + turned[:, 0] / step, (TOP - turned[:, 1]) / step], axis=1)


def window(colors: np.ndarray) -> np.ndarray:
    """Cut the part of a map (HEIGHT, WIDTH, 3) that is read, (128, 128, 3)."""
    part = colors[UPPER : UPPER + SIDE, LEFT : LEFT + SIDE]
    return cv2.resize(part, (CROP, CROP), interpolation=cv2.INTER_LINEAR)


def to_window(texels: np.ndarray) -> np.ndarray:
    """Convert texels (..., 2) to pixels of the window, both with corner origin."""
    return (texels - (LEFT, UPPER)) / TEXELS_PER_PIXEL


def read_marks(net: LandmarkNet, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find texels (51, 2) of landmarks 17 to 67 on a map, and their expected error (51,).

    The map (HEIGHT, WIDTH, 3), in [0, 1], and its mirror image are both read; their difference
    counts as error.
    """
    image = torch.from_numpy(window(colors)).permute(2, 0, 1)[None].float()
    with torch.inference_mode():
        output = net(torch.cat([image, image.flip(3)]))
    points, scale = output.points.numpy(), np.exp(output.log_scale.numpy())
    turned = np.stack([CROP - points[1, MIRROR, 0], points[1, MIRROR, 1]], axis=1)
    apart = 0.5 * np.linalg.norm(points[0] - turned, axis=1)
    error = np.hypot(0.5 * (scale[0] + scale[1, MIRROR]), apart)
    texels = 0.5 * (points[0] + turned) * TEXELS_PER_PIXEL + (LEFT, UPPER)
    return texels[FIRST:], (error * TEXELS_PER_PIXEL)[FIRST:]


def mark_places() -> np.ndarray:
    """Return the texels (51, 2) where landmarks 17 to 67 belong."""
    return to_texels(MARKS)[FIRST:]


def reading_map(model: HeadModel) -> FaceUvMap:
    """Make a head's UV map with the texels that are read alone."""
    whole = make_uv_map(model)
    off = whole.texels - (UPPER, LEFT)
    some = np.all((off >= 0) & (off < SIDE), axis=1)
    samples, texels, skin = whole.samples.some(some), whole.texels[some], whole.skin[some]
    return replace(whole, samples=samples, texels=texels, skin=skin)


@dataclass(frozen=True)
class SkinMap:
    """An expression's skin on the fine UV map: evened grey (H, W) uint8, and where it is seen."""

    grey: np.ndarray
    seen: np.ndarray


def skin_map(
    model: HeadModel, uv_map: FaceUvMap, pictures: FrameSetCrops, mesh: np.ndarray
) -> SkinMap:
    """Unwrap a frame set on its mesh (V, 3), light evened out."""
    colors, mass = unwrap(model, uv_map, pictures, mesh)
    seen = (mass > LEAST_SEEN) & (uv_map.image(uv_map.skin[:, None])[..., 0])
    grey, weight = colors.mean(2), seen.astype(np.float32)

    def local(values: np.ndarray) -> np.ndarray:
        share = cv2.GaussianBlur(weight, (0, 0), LIGHT_TEXELS)
        return cv2.GaussianBlur(values * weight, (0, 0), LIGHT_TEXELS) / np.maximum(share, 1e-3)

    away = (grey - local(grey)) * weight
    even = away / np.sqrt(local(away**2) + NOISE**2)
    return SkinMap(np.clip(128.0 + 42.0 * even, 0, 255).astype(np.uint8), seen)


def skin_flows(
    model: HeadModel,
    uv_map: FaceUvMap,
    pictures: list[FrameSetCrops],
    meshes: np.ndarray,
    rest: int | None,
) -> dict[int, tuple[SlideTerm, ...]]:
    """Follow the skin from the resting face, number `rest`, to the other expressions, by index.

    The pictures are of E frame sets with meshes (E, V, 3).
    """
    if rest is None:
        return {}
    maps = [skin_map(model, uv_map, *pair) for pair in zip(pictures, meshes, strict=True)]
    flows: dict[int, tuple[SlideTerm, ...]] = {}
    for index, (moved, mesh) in enumerate(zip(maps, meshes, strict=True)):
        term = None if index == rest else flow_term(uv_map, maps[rest], moved, mesh)
        flows[index] = () if term is None else (term,)
    return flows


def flow_term(
    uv_map: FaceUvMap, still: SkinMap, moved: SkinMap, mesh: np.ndarray
) -> SlideTerm | None:
    """Find where the skin of `still` lies on `moved`, whose mesh is (V, 3); None if unknown."""
    both = still.seen & moved.seen
    inner = cv2.erode(both.astype(np.uint8), np.ones((RIM, RIM), np.uint8)).astype(np.float32)
    first, second = (np.where(both, one.grey, 128).astype(np.uint8) for one in (still, moved))
    there, back = _flow(first, second), _flow(second, first)
    chosen = (uv_map.texels % SPACING_TEXELS == SPACING_TEXELS // 2).all(1)
    ids = np.flatnonzero(chosen & (inner[tuple(uv_map.texels.T)] > 0))
    row, column = uv_map.texels[ids].T
    at = cell_to_corner(uv_map.texels[ids, ::-1])
    goal = at + there[row, column]
    missed = np.linalg.norm(goal + bilinear(back, goal) - at, axis=1)
    contrast = cv2.cornerMinEigenVal(first.astype(np.float32) / 255.0, 9, 3)[row, column]
    sure = (missed < RETURN_TEXELS) & (contrast > TEXTURED**2)
    sure &= bilinear(inner, goal) > 0.99
    ids, at, goal = ids[sure], at[sure], goal[sure]
    if not len(ids):
        return None
    samples = uv_map.samples
    places = uv_map.image((samples.at(mesh) - mesh.mean(0)).astype(np.float32))
    found, step = between(places, goal)
    home, _ = between(places, at)
    anchors = samples.some(ids)
    goals, normals = anchors.at(mesh) + found - home, sample_normals(anchors, mesh)
    return SlideTerm(anchors, np.zeros(0, int), goals, normals, SIGMA * step * FLOW_REDUNDANCY**0.5)


def _flow(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the optical flow (H, W, 2), pixels, from the first picture to the second."""
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    return search.calc(first, second, np.zeros((*first.shape, 2), np.float32))
