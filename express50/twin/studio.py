"""Film a subject through every camera, with plates and board pictures; write files and truth.

Of the truth only parameters are stored; benchmarks make meshes, depth and alpha from them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from express50.capture.expressions import select
from express50.files.calibration import write_cameras
from express50.files.images import encode_png
from express50.files.video import ImageFootage, VideoFootage
from express50.geometry.cameras import Camera
from express50.head import absolute_head
from express50.head.load import load_head
from express50.twin import TwinConfig
from express50.twin.body import Body, build_body, pose_body, with_hand
from express50.twin.render import RowBand, Sampling, hull_of, render_band, window_of
from express50.twin.rig import (
    Sensor,
    board_poses,
    expose,
    make_rig,
    make_sensor,
    render_board,
    studio_bands,
)
from express50.twin.shade import LitScene, build_scene, find_eyes, make_lighting, shade
from express50.twin.skin import living_skin, paint_skin, texture_width
from express50.twin.subjects import TwinPerformance, make_subject, perform

# Up to this many pixels, rays and plates are kept between frames (about 50 bytes per pixel);
# above, every band is made again for every frame.
_KEEP_PIXELS = 4_000_000
OF_PLAY = ("strength", "expression", "jaw", "neck", "eyes", "R", "t")
"""Arrays of a performance that are stored as truth."""

# Loading a head model takes seconds, and a worker films several subjects.
_head = cache(load_head)


def cast_subject(config: TwinConfig, subject_id: str) -> tuple[Body, TwinPerformance]:
    """Make a subject's body and its performance."""
    # The number in the id, such as S001, seeds everything about the subject.
    model, number = _head(config.head), int(subject_id.removeprefix("S"))
    subject = make_subject(model, subject_id, number, config.seed, config.personal)
    # Strands are thinner than a pixel, but not much, as that would not be visible.
    detail = float(np.clip(min(config.width, config.height) / 512, 0.6, 3.0))
    body = build_body(model, subject, config.seed, detail if config.hair else 0.0, config.wear)
    script = select(config.expressions)
    play = perform(model, script, config.frames_per_expression, config.fps, number, config.seed)
    return with_hand(body, play, config.seed), play


@dataclass(frozen=True, kw_only=True)
class StudioView:
    """One camera and what all its frames share; ``bands`` returns its `studio_bands`."""

    camera: Camera
    index: int
    sensor: Sensor
    bands: Callable[[], Iterable[tuple[RowBand, np.ndarray]]]


def make_view(camera: Camera, index: int, seed: int, keep: bool) -> StudioView:
    """Make a view of the rig's camera of this index; `keep` its bands or make them every time."""
    make: Callable[[], Iterable[tuple[RowBand, np.ndarray]]] = partial(studio_bands, camera, seed)
    if keep:
        make = partial(list, list(make()))
    return StudioView(camera=camera, index=index, sensor=make_sensor(index, seed), bands=make)


def film_subject(
    config: TwinConfig,
    subject_id: str,
    camera_indices: list[int],
    capture: Path,
    truth: Path,
    tick: Callable[[], None],
) -> None:
    """Record all frames of one subject in some cameras, and their plates.

    Other processes may film the other cameras; the one with camera 0 writes the truth. ``tick`` is
    called after every picture.
    """
    body, play = cast_subject(config, subject_id)
    number, seed = body.subject.number, config.seed
    rig = list(make_rig(config.cameras, config.width, config.height, seed).values())
    keep = config.width * config.height * len(camera_indices) <= _KEEP_PIXELS
    views = [make_view(rig[k], k, seed, keep) for k in camera_indices]
    texture = paint_skin(body, seed, texture_width(min(config.width, config.height)))
    eyes, lighting = find_eyes(body.model), make_lighting(number, seed)
    with ExitStack() as stack:
        films: list[VideoFootage | ImageFootage] = []
        for view in views:
            folder, size = capture / "cameras" / view.camera.id, (config.width, config.height)
            if config.footage == "video":
                video = VideoFootage(folder, *size, config.fps, config.crf)
                films.append(stack.enter_context(video))
            else:
                films.append(ImageFootage(folder, config.footage))
        for frame in range(play.frames):
            posed = pose_body(body, play, frame)
            living = None
            if config.personal:
                who = number, seed, body.subject.look.age
                living = living_skin(body.model, *who, config.personal, play.expression[frame])
            scene = build_scene(body, texture, eyes, lighting, posed, seed, living)
            hull = hull_of(posed.vertices)
            for view, film in zip(views, films, strict=True):
                picture = render_view(scene, view, hull)
                chance = np.random.default_rng([seed, number, 11, view.index, frame])
                film.write(expose(view.sensor, picture, chance, config.noise))
                tick()
    if 0 in camera_indices:
        write_truth(truth, config.head, body, play, {camera.id: camera for camera in rig})
    if config.plates:
        for view in views:
            chance = np.random.default_rng([seed, number, 12, view.index])
            plate = np.concatenate([plate for _, plate in view.bands()])
            image = expose(view.sensor, plate, chance, config.noise)
            write_png(capture / "plates" / f"{view.camera.id}.png", image)


def render_view(scene: LitScene, view: StudioView, hull: np.ndarray) -> np.ndarray:
    """Render the linear picture (H, W, 3) of a frame in one camera, before the sensor.

    ``hull`` has the corners of the convex hull of the scene's vertices.
    """
    window = window_of(view.camera, hull)
    picture = np.empty((view.camera.height, view.camera.width, 3), np.float32)
    for band, plate in view.bands():
        picture[band.top : band.bottom] = plate
        part = render_band(
            scene.caster, scene.body.material, window, band, Sampling(), partial(shade, scene)
        )
        if part is not None:
            colour, alpha, place = part
            picture[place] *= 1.0 - alpha[..., None]
            picture[place] += colour
    return picture


def film_board(
    config: TwinConfig, camera_indices: list[int], folder: Path, tick: Callable[[], None]
) -> None:
    """Write ``<folder>/<camera>/<number>.png`` of every board pose in some cameras."""
    rig = list(make_rig(config.cameras, config.width, config.height, config.seed).values())
    poses = board_poses(config.board_frames, config.seed)
    for index in camera_indices:
        camera, sensor = rig[index], make_sensor(index, config.seed)
        for number, pose in enumerate(poses):
            picture = render_board(pose, camera, config.seed)
            chance = np.random.default_rng([config.seed, 402, index, number])
            image = expose(sensor, picture, chance, config.noise)
            write_png(folder / camera.id / f"{number:06d}.png", image)
            tick()


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a PNG; make its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(image))


def write_truth(
    folder: Path, head: str, body: Body, play: TwinPerformance, cameras: Mapping[str, Camera]
) -> None:
    """Write a subject's truth: cameras.json, peaks.json, subject.json, frames.npz, body.npz.

    If needed, also its own motion in own.npz, and what it wears and holds in worn.npz.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_cameras(folder / "cameras.json", cameras)
    subject = body.subject
    about = {"id": subject.id, "number": subject.number, "head": absolute_head(head),
             "look": asdict(subject.look), "cues": play.cues}  # fmt: skip
    words = json.dumps(about, indent=1, default=np.ndarray.tolist)
    (folder / "subject.json").write_text(words + "\n")
    (folder / "peaks.json").write_text(json.dumps(play.peaks, indent=1) + "\n")
    np.savez_compressed(folder / "frames.npz", **{name: getattr(play, name) for name in OF_PLAY})
    extras = body.extras
    if subject.own is not None:
        np.savez_compressed(folder / "own.npz", own=subject.own)
    np.savez_compressed(
        folder / "body.npz",
        shape=subject.shape, offsets=subject.offsets, scalp=body.scalp, centre=body.centre,
        hair_vertices=extras.hair.vertices, hair_faces=extras.hair.faces,
        hair_moves=extras.hair.moves,
        cloth_vertices=extras.cloth_vertices, cloth_faces=extras.cloth_faces,
        skull=extras.skull, skull_rest=extras.skull_rest,
    )  # fmt: skip
    if len(extras.worn.faces):
        np.savez_compressed(folder / "worn.npz", hand=extras.hand, **vars(extras.worn))
