"""Observations beside the 68 fixed landmarks: irises, and a jaw line that is where it is seen.

Each is a vertex of the mesh that should project to a pixel of one view. They ride along with the
outlines of a `Target`, and are made anew for the current mesh before every round of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from express50.head.model import HeadModel, vertex_normals
from pipelines.track.contour import JAW, contour_points
from pipelines.track.observe import Marks, View
from pipelines.track.pinhole import project_with_slope
from pipelines.track.state import Target

# Cosine between where an eye looks and the camera under which its iris is not trusted.
LOOKS_AT = 0.3
# A rim's place along the cheek is known to this share of the face.
RIM_SHARE = 0.012
# What is left of an eyeball's own misplacement, the same in all views; and prior of all of it.
EYEBALL_M, OFFSET_M = 0.0005, 0.002
# So many expressions count as much as the guess that the eyeballs are where they should be.
GUESSED_EXPRESSIONS = 1


@dataclass(frozen=True)
class Eyes:
    """What relates a subject's irises to the model's.

    Attributes:
        vertices: in the middle of the left and right iris.
        offsets: (2, 3) head space, metres: how far irises are seen from the model's, on the whole.
    """

    vertices: tuple[int, int]
    offsets: np.ndarray


def measure_eyes(
    model: HeadModel, targets: list[Target], meshes: np.ndarray, rotations: np.ndarray
) -> Eyes | None:
    """How far the irises of all expressions lie from those of a fit without them.

    An eyeball misplaced by a millimetre turns a gaze by five degrees, in all expressions alike. The
    median offset over a subject's expressions is therefore taken for such misplacement, and only
    what departs from it for gaze; with few expressions it is shrunk.

    Args:
        model: the head model.
        targets: E expressions.
        meshes: (E, V, 3) of the fit, world.
        rotations: (E, 3, 3) world from head.

    Returns:
        None where the model names no irises.
    """
    vertices = iris_vertices(model)
    if vertices is None:
        return None
    offsets = np.zeros((2, 3))
    for side, vertex in enumerate(vertices):
        found = [
            rotation.T @ offset
            for target, mesh, rotation in zip(targets, meshes, rotations, strict=True)
            if (offset := _offset(model, target, mesh, side, vertex)) is not None
        ]
        if found:
            share = len(found) / (len(found) + GUESSED_EXPRESSIONS)
            offsets[side] = share * np.median(found, axis=0)
    return Eyes(vertices, offsets)


def _offset(
    model: HeadModel, target: Target, mesh: np.ndarray, side: int, vertex: int
) -> np.ndarray | None:
    """World offset (3,) that brings one iris vertex to where the views see it."""
    normal, count = np.eye(3) / OFFSET_M**2, 0
    right = np.zeros(3)
    for view in _seeing(model, target, mesh, side, vertex):
        pixel, slope = project_with_slope(view.camera, mesh[vertex][None])
        weighted = slope[0] / view.irises.sigma[side] ** 2  # type: ignore[union-attr]
        normal += weighted.T @ slope[0]
        right += weighted.T @ (view.irises.centres[side] - pixel[0])  # type: ignore[union-attr]
        count += 1
    return np.linalg.solve(normal, right) if count else None


def _seeing(
    model: HeadModel, target: Target, mesh: np.ndarray, side: int, vertex: int
) -> list[View]:
    """Views with an iris that looks their way."""
    normal = vertex_normals(torch.from_numpy(mesh)[None], model.faces)[0, vertex].numpy()
    found = []
    for view, sigma in zip(target.observation.views, target.sigma, strict=True):
        if view.irises is None or not np.isfinite(sigma).any():
            continue
        towards = view.camera.center - mesh[vertex]
        looks = normal @ towards / max(float(np.linalg.norm(towards)), 1e-9)
        if np.isfinite(view.irises.sigma[side]) and looks > LOOKS_AT:
            found.append(view)
    return found


def iris_vertices(model: HeadModel) -> tuple[int, int] | None:
    """Vertices in the middle of the left and right iris; None where the model names none."""
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


def with_marks(
    model: HeadModel, target: Target, mesh: np.ndarray, rotation: np.ndarray, eyes: Eyes | None
) -> Target:
    """The target with irises, and with the jaw line moved to where the current mesh shows it.

    Args:
        model: the head model.
        target: what one expression is fitted to, as yet without marks.
        mesh: (V, 3) of the current fit, world.
        rotation: (3, 3) world from head.
        eyes: from `measure_eyes`.
    """
    sigma, ids, blocks = target.sigma.copy(), list(target.vertices), []
    irises = [] if eyes is None else _iris_marks(model, target, mesh, rotation, eyes)
    for row, view in enumerate(target.observation.views):
        found = [mark for camera_id, mark in irises if camera_id == view.camera_id]
        if view.visible_contour and np.isfinite(sigma[row]).any():
            found += _move_jaw(model, view, mesh, sigma[row])
        if found:
            vertices, pixels, spread = zip(*found, strict=True)
            index = np.arange(68 + len(ids), 68 + len(ids) + len(vertices))
            blocks.append(Marks(view.camera, index, np.array(pixels), np.array(spread)))
            ids += vertices
    outlines = (*target.outlines, *blocks)
    return replace(target, sigma=sigma, outlines=outlines, vertices=np.array(ids, dtype=np.int64))


Mark = tuple[int, np.ndarray, float]


def _iris_marks(
    model: HeadModel, target: Target, mesh: np.ndarray, rotation: np.ndarray, eyes: Eyes
) -> list[tuple[str, Mark]]:
    """Camera, and vertex, pixel and sigma of the irises that are seen."""
    marks = []
    for side, vertex in enumerate(eyes.vertices):
        views = _seeing(model, target, mesh, side, vertex)
        for view in views:
            _, slope = project_with_slope(view.camera, mesh[vertex][None])
            pixel = view.irises.centres[side] - slope[0] @ rotation @ eyes.offsets[side]  # type: ignore[union-attr]
            # An eyeball is as misplaced in one view as in the next: more views are no evidence.
            common = EYEBALL_M * float(np.linalg.norm(slope[0], axis=1).max()) * len(views) ** 0.5
            spread = float(np.hypot(view.irises.sigma[side], common))  # type: ignore[union-attr]
            marks.append((view.camera_id, (vertex, pixel, spread)))
    return marks


def _move_jaw(model: HeadModel, view: View, mesh: np.ndarray, sigma: np.ndarray) -> list[Mark]:
    """Vertex, pixel and sigma of the jaw's points on the rim.

    `sigma` (68,), changed here, loses them and what the head hides as fixed landmarks.
    """
    line = contour_points(model, mesh, view.camera)
    used = np.isfinite(sigma[:JAW])
    size = float(np.ptp(view.points, axis=0).max())
    spread = np.hypot(view.sigma[:JAW], RIM_SHARE * size)
    taken = np.flatnonzero(used & line.moved & line.usable)
    sigma[:JAW][line.moved | ~line.usable] = np.inf
    return [(int(line.corners[k, 0]), view.points[k], float(spread[k])) for k in taken]
