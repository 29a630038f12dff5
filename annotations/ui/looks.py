"""From a scene and a view to what is shown: looks, shots to decode, the strip's content."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from annotations.suggestions import Suggested
from annotations.ui.faces import FaceFinder
from annotations.ui.frames import Shot
from annotations.ui.painters import PaneShape
from annotations.ui.picture import Look, shot_of
from annotations.ui.scene import Scene
from annotations.ui.strip import StripContent
from annotations.ui.view import View
from express50.capture.index import CameraSource

AHEAD = 64  # frames about the cursor that are decoded before they are asked for


class Aim(NamedTuple):
    """How both pictures are looked at: camera (counted from the best), zoom, finder of faces."""

    camera: int
    zoom: str
    faces: FaceFinder | None


def camera_name(scene: Scene, number: int) -> str:
    """A camera by its number, round and round."""
    return scene.cameras[number % len(scene.cameras)] if scene.cameras else ""


def subject_look(scene: Scene, view: View, aim: Aim) -> Look | None:
    """The frame under the cursor; None where there is no footage."""
    if scene.index is None:
        return None
    camera = camera_name(scene, aim.camera)
    # One framing for the whole window, so that only the face moves when one steps.
    anchor = view.candidates[0] if view.candidates else (view.first + view.last) // 2
    face = None if aim.faces is None else aim.faces.find(scene.task.subject, camera, anchor)
    aspect = _aspect(scene.index.cameras[camera])
    return Look(scene.task.subject, camera, view.cursor, face, aim.zoom, aspect)


def reference_look(scene: Scene, aim: Aim) -> Look | None:
    """The reference's canonical frame, in the same camera where the reference has it."""
    canonical, index = scene.reference, scene.reference_index
    if canonical is None or index is None:
        return None
    camera = camera_name(scene, aim.camera)
    if camera not in index.cameras or canonical.frame >= index.cameras[camera].frames:
        camera = canonical.camera
    face = None
    if aim.faces is not None:
        face = aim.faces.find(canonical.subject, camera, canonical.frame)
    aspect = _aspect(index.cameras[camera])
    return Look(canonical.subject, camera, canonical.frame, face, aim.zoom, aspect)


def _aspect(source: CameraSource) -> float:
    return source.height / source.width


def frames_ahead(view: View, count: int = AHEAD) -> list[int]:
    """Frames that the next keys may ask for: the nearest, ten on either side, the suggestions."""
    near = [view.cursor, *view.candidates, view.cursor + 10, view.cursor - 10]
    for away in range(1, count):
        near += [view.cursor + away, view.cursor - away]
    inside = (frame for frame in near if view.first <= frame <= view.last)
    return list(dict.fromkeys(inside))[:count]


def shots_ahead(
    scene: Scene, view: View, aim: Aim, shape: PaneShape, count: int = AHEAD
) -> list[Shot]:
    """Pictures to decode for a task, most urgent first; finds the faces on the way."""
    here, there = subject_look(scene, view, aim), reference_look(scene, aim)
    shots = [shot_of(here.at(n), shape) for n in frames_ahead(view, count)] if here else []
    if there is not None:
        shots.insert(1, shot_of(there, shape))
    return shots


def strip_content(scene: Scene, view: View, hidden: bool) -> StripContent:
    """What the strip shows; nothing that could sway the annotator while that is hidden."""
    found = None if hidden else scene.suggestion
    return StripContent(
        view=view,
        activity=curve_in_window(found, None if found is None else found.activity, view),
        match=curve_in_window(found, None if found is None else found.match, view),
        mine=scene.mine,
        in_force=None if hidden else scene.in_force,
    )


def curve_in_window(
    found: Suggested | None, values: Sequence[float] | None, view: View
) -> tuple[float, ...]:
    """A curve with one value for each frame of the window; its ends are continued."""
    if found is None or not values:
        return ()
    places = (min(max(n - found.start, 0), len(values) - 1) for n in _frames(view))
    return tuple(float(values[place]) for place in places)


def _frames(view: View) -> range:
    return range(view.first, view.last + 1)
