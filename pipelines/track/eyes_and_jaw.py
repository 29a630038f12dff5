"""Fit eyes, lips and jaw line: irises turn the eyes, shut lids and lips meet.

**Irises** are pixels that the iris vertices should project to. An eyeball misplaced by a millimetre
turns the gaze by five degrees in every expression alike, so the median offset over a subject's
expressions is attributed to misplacement, and only the rest to gaze.

**Lids**: an eye is shut if cameras find no iris that they find at other times. Contrast decides
that over some twenty pixels, whereas the distance between the lids is a few. Half-shut eyes stay
as seen.

**Lips** are shut unless they are clearly seen apart. Independent errors of landmarks would part
them, mostly in depth, which a single picture does not show.

**Jaw line**: people, and networks trained on their marks, mark the visible edge of the cheek where
the head turns away. A landmark whose skin faces the camera keeps its place in the embedding, one
that turned past the rim moves along its line of candidates to the rim, and one that the head hides
is left out. The choice is made again for every mesh. The embedded network marks fixed places and
needs none of this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera, project_with_slope
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, normals_of
from express50.landmarks.irises import EYES
from express50.landmarks.network import INNER_LIPS
from pipelines.track.observe import LandmarkView, Observation, triangulate_views
from pipelines.track.state import Target
from pipelines.track.terms import MeshPlaces, PixelTerm, ShutTerm, Sighting, landmark_anchors

LOOKS_AT = 0.3  # cosine between gaze and camera below which an iris is not trusted
# Standard deviations of an eyeball's misplacement: what remains of it, and the prior of it.
EYEBALL_M, OFFSET_M = 0.0005, 0.002
GUESSED_EXPRESSIONS = 1  # number of expressions that count as showing eyeballs in place
RIM_SHARE = 0.012  # error of a rim's place along the cheek, as a share of the face

# A camera counts for an eye if it finds the iris in more than this share of the other frame sets
# and the eye is now at least this share of its usual width there: it has not turned away.
USUAL, WIDE = 0.5, 0.75
LEAST_CAMERAS = 2
# Lashes and folds are sometimes mistaken for irises, with little confidence. An eye is shut if the
# squared confidences over the cameras sum to at most this share of the usual.
CHANCE = 0.3
GAP = 0.1  # share of the gap between the lids that is left
# Lips are shut if they are seen apart by less than this number of standard deviations. These are at
# least this share of the best view's, because all views of a mouth err together.
LIPS_SHUT, COMMON_SHARE = 3.0, 0.5

JAW = 17
# Cosine between skin and line of sight: above it a point is in plain view, and within RIM of a
# right angle skin forms the rim (triangles are finite).
FACING, RIM = -0.1, 0.2
RIM_REACH_M = 0.16  # metres further along the cheek per unit of cosine nearer to the rim
CLEAR_M = 0.004  # visibility is tested this far off the skin: the rim hides itself from any ray


@dataclass(frozen=True)
class EyeOffsets:
    """Offsets (2, 3) of a subject's irises from two vertices in their middle, left and right.

    They are in head space, metres, the median over the expressions.
    """

    vertices: tuple[int, int]
    offsets: np.ndarray


def measure_eyes(
    model: HeadModel, targets: list[Target], meshes: np.ndarray, rotations: np.ndarray
) -> EyeOffsets | None:
    """Measure where irises are seen against a fit without them; None if the model has no irises.

    Meshes (E, V, 3) and rotations (E, 3, 3), world from head, are those of the E targets' fit.
    Offsets are shrunk where few expressions show an iris.
    """
    vertices = iris_vertices(model)
    if vertices is None:
        return None
    offsets = np.zeros((2, 3))
    for side, vertex in enumerate(vertices):
        found = []
        for target, mesh, rotation in zip(targets, meshes, rotations, strict=True):
            normal, right = np.eye(3) / OFFSET_M**2, np.zeros(3)
            views = _seeing(model, target, mesh, side, vertex)
            for view, centre, sigma in views:
                pixel, slope = project_with_slope(view.camera, mesh[vertex][None])
                weighted = slope[0] / sigma**2
                normal += weighted.T @ slope[0]
                right += weighted.T @ (centre - pixel[0])
            if views:
                found.append(rotation.T @ np.linalg.solve(normal, right))
        if found:
            share = len(found) / (len(found) + GUESSED_EXPRESSIONS)
            offsets[side] = share * np.median(found, axis=0)
    return EyeOffsets(vertices, offsets)


def _seeing(
    model: HeadModel, target: Target, mesh: np.ndarray, side: int, vertex: int
) -> list[tuple[LandmarkView, np.ndarray, float]]:
    """Return the views that one eye looks at, with its iris' pixel (2,) and sigma."""
    normal = normals_of(mesh, model.faces)[vertex]
    found = []
    for view, sigma in zip(target.observation.views, target.sigma, strict=True):
        if view.irises is None or not np.isfinite(sigma).any():
            continue
        towards = view.camera.center - mesh[vertex]
        looks = normal @ towards / max(float(np.linalg.norm(towards)), 1e-9)
        if np.isfinite(view.irises.sigma[side]) and looks > LOOKS_AT:
            found.append((view, view.irises.centres[side], float(view.irises.sigma[side])))
    return found


def iris_vertices(model: HeadModel) -> tuple[int, int] | None:
    """Find the vertices in the middle of the left and right iris; None without irises."""
    found = []
    for side in ("left", "right"):
        names = [f"{side}_pupil", f"{side}_iris"]
        masks = [model.regions[name].numpy() for name in names if name in model.regions]
        masks = [mask for mask in masks if mask.any()]
        if not masks:
            return None
        ids = np.flatnonzero(masks[0])
        places = model.template.numpy()[ids]
        found.append(int(ids[np.linalg.norm(places - places.mean(0), axis=1).argmin()]))
    return found[0], found[1]


def with_irises_and_jaw(
    model: HeadModel,
    target: Target,
    mesh: np.ndarray,
    rotation: np.ndarray,
    eyes: EyeOffsets | None,
) -> Target:
    """Add irises to a target and move its jaw line to where the current mesh (V, 3) shows it.

    `rotation` (3, 3) is world from head; `eyes` are from `measure_eyes`.
    """
    sigma, terms = target.sigma.copy(), list(target.terms)
    if eyes is not None:
        terms.append(_iris_term(model, target, mesh, rotation, eyes))
    for own, view in zip(sigma, target.observation.views, strict=True):
        if not view.visible_contour or not np.isfinite(own).any():
            continue
        line = contour_points(model, mesh, view.camera)
        size = float(np.ptp(view.points, axis=0).max())
        spread = np.hypot(view.sigma[:JAW], RIM_SHARE * size)
        taken = np.flatnonzero(np.isfinite(own[:JAW]) & line.moved & line.usable)
        seen = Sighting(view.camera, np.arange(len(taken)), view.points[taken], spread[taken])
        terms.append(PixelTerm(MeshPlaces.of_vertices(line.places.vertices[taken, 0]), (seen,)))
        # Landmarks on the rim, and those that the head hides, lose their fixed places.
        own[:JAW][line.moved | ~line.usable] = np.inf
    return replace(target, sigma=sigma, terms=tuple(terms))


def _iris_term(
    model: HeadModel, target: Target, mesh: np.ndarray, rotation: np.ndarray, eyes: EyeOffsets
) -> PixelTerm:
    sightings = []
    for side, vertex in enumerate(eyes.vertices):
        views = _seeing(model, target, mesh, side, vertex)
        for view, centre, sigma in views:
            _, slope = project_with_slope(view.camera, mesh[vertex][None])
            pixel = centre - slope[0] @ rotation @ eyes.offsets[side]
            # An eyeball is equally misplaced in every view: more views are not more evidence.
            common = EYEBALL_M * float(np.linalg.norm(slope[0], axis=1).max()) * len(views) ** 0.5
            spread = np.array([np.hypot(sigma, common)])
            sightings.append(Sighting(view.camera, np.array([side]), pixel[None], spread))
    return PixelTerm(MeshPlaces.of_vertices(np.array(eyes.vertices)), tuple(sightings))


def shut_terms(model: HeadModel, observation: Observation) -> tuple[ShutTerm, ...]:
    """Make the term of an observation's shut eyes and lips, if there are any."""
    gap, sigma = lips_gap(observation)
    lips = [INNER_LIPS] if abs(gap) < LIPS_SHUT * sigma else []
    pairs = [*(EYES[side][2:] for side in observation.shut), *lips]
    if not pairs:
        return ()
    marks = landmark_anchors(model)
    upper, lower = (np.concatenate(ids) for ids in zip(*pairs, strict=True))
    return (ShutTerm(marks.some(upper).minus(marks.some(lower))),)


def lips_gap(observation: Observation) -> tuple[float, float]:
    """Return how far apart the inner lips are seen, in shares of the mouth's width, and its sigma.

    The mean over the views by how well they see it; both are infinite if none does.
    """
    upper, lower = (list(ids) for ids in INNER_LIPS)
    gaps, sigmas = [], []
    for view in observation.views:
        along = view.points[54] - view.points[48]
        width = float(np.linalg.norm(along))
        sigma = float(view.sigma[upper + lower].mean())
        if 0 < sigma < np.inf and width > 0:
            across = np.array([-along[1], along[0]]) / width**2
            gaps.append(float((view.points[lower] - view.points[upper]).mean(0) @ across))
            sigmas.append(sigma / width)
    if not gaps:
        return np.inf, np.inf
    weights = np.array(sigmas) ** -2
    least = COMMON_SHARE * min(sigmas)
    return float(np.average(gaps, weights=weights)), max(float(weights.sum() ** -0.5), least)


def shut_lids(
    observations: list[Observation], others: Sequence[Observation] | None = None
) -> list[Observation]:
    """Find shut eyes in one person's observations and move their upper lids to the lower ones.

    Each is compared with `others`, in most of which eyes are open; by default with the rest.
    """
    shut = np.zeros((len(observations), 2), dtype=bool)
    for side in range(2):
        seen = [_irises(observation, side) for observation in observations]
        usual = None if others is None else [_irises(other, side) for other in others]
        shut[:, side] = [
            _is_shut(now, seen[:k] + seen[k + 1 :] if usual is None else usual)
            for k, now in enumerate(seen)
        ]
    found = []
    for observation, sides in zip(observations, shut, strict=True):
        views = []
        for view in observation.views if sides.any() else ():
            points = view.points.copy()
            for eye in np.flatnonzero(sides):
                upper, lower = (list(lid) for lid in EYES[eye][2:])
                points[upper] = points[lower] + GAP * (points[upper] - points[lower])
            views.append(replace(view, points=points))
        if views:
            observation, _ = triangulate_views(observation.expression, observation.frame, views)
            observation = replace(observation, shut=tuple(np.flatnonzero(sides).tolist()))
        found.append(observation)
    return found


def _irises(observation: Observation, side: int) -> dict[str, tuple[float, float]]:
    """Map cameras to the confidence of one eye's iris, 0 if none, and the eye's width, pixels."""
    first, last = EYES[side][:2]
    return {
        view.camera_id: (
            float(view.irises.confidence[side]),
            float(np.linalg.norm(view.points[last] - view.points[first])),
        )
        for view in observation.views
        if view.irises is not None
    }


def _is_shut(
    now: dict[str, tuple[float, float]], others: list[dict[str, tuple[float, float]]]
) -> bool:
    usual = []
    for camera, (_, width) in now.items():
        then = [other[camera] for other in others if camera in other]
        found = np.array([pair for pair in then if pair[0] > 0]).reshape(-1, 2)
        if len(found) > USUAL * len(then) and width > WIDE * np.median(found[:, 1]):
            usual.append(np.median(found[:, 0]))
    if len(usual) < max(1, min(LEAST_CAMERAS, len(now))):
        return False
    # Any camera counts here: a head that turned shows its irises to others.
    return sum(sure**2 for sure, _ in now.values()) <= CHANCE * np.square(usual).sum()


@dataclass(frozen=True)
class JawLine:
    """The jaw line in one view."""

    places: MeshPlaces  # 17 points
    moved: np.ndarray  # (17,) bool, points that left the embedding for the rim
    usable: np.ndarray  # (17,) bool, points that the camera sees


def contour_points(model: HeadModel, vertices: np.ndarray, camera: Camera) -> JawLine:
    """Choose the 17 points of the jaw line that a pinhole camera sees on a mesh (V, 3), world.

    Without `contour` candidates in the model every point keeps its place.
    """
    faces = model.faces.numpy()
    corners = faces[model.landmark_faces[:JAW].numpy()].copy()
    bary = model.landmark_bary[:JAW].numpy().astype(np.float64)
    normals = normals_of(vertices, model.faces)
    facing = (normals * unit(camera.center - vertices)).sum(1)
    own = (vertices[corners] * bary[..., None]).sum(1)
    moved = np.zeros(JAW, dtype=bool)
    for point, line in enumerate(model.contour or ()):
        if (facing[corners[point]] * bary[point]).sum() > FACING:
            continue
        rim = line.numpy()[np.abs(facing[line.numpy()]) < RIM]
        moved[point] = True
        if len(rim):
            way = np.linalg.norm(vertices[rim] - own[point], axis=1)
            best = rim[int((way + RIM_REACH_M * np.abs(facing[rim])).argmin())]
            corners[point], bary[point] = best, (1.0, 0.0, 0.0)
    clear = vertices[corners] + CLEAR_M * normals[corners]
    sight = (clear * bary[..., None]).sum(1) - camera.center
    hits = mesh_scene(vertices, faces).cast_rays(join_rays(camera.center, sight))
    # Directions are not unit vectors: the ray's parameter is 1 at the point.
    seen = hits["t_hit"].numpy() > 0.999
    return JawLine(MeshPlaces(corners, bary), moved, seen)
