"""Filming: a subject's frames through every camera, plates and board pictures, written to files."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from express50.capture.expressions import select
from express50.files.images import encode_png, linear_to_srgb
from express50.files.video_writer import ImageFootage, VideoFootage
from express50.geometry.cameras import Camera
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.twin.board import BoardSpec, background, board_poses, render_board, room_width
from express50.twin.body import Body, build_body, pose_body
from express50.twin.config import TwinConfig, subject_number
from express50.twin.noise import random_stream
from express50.twin.performance import TwinPerformance, perform
from express50.twin.render import RowBand, Sampling, bands, hull_of, render_bands, window_of
from express50.twin.rig import make_rig
from express50.twin.shade import LitScene, build_scene, find_eyes, make_lighting, shade
from express50.twin.skin import paint_skin, texture_width
from express50.twin.subjects import make_subject
from express50.twin.truth import write_truth

# Rays and plates of so many pixels are kept between frames (about 50 bytes each); beyond, every
# band is made anew for every frame.
_KEEP_PIXELS = 4_000_000


@cache
def _head(spec: str) -> HeadModel:
    """Load a head model once: it takes seconds, and a worker films several subjects."""
    return load_head(spec)


Film = VideoFootage | ImageFootage


def cast_subject(config: TwinConfig, subject_id: str) -> tuple[Body, TwinPerformance]:
    """Make a subject's body and its performance."""
    model, number = _head(config.head), subject_number(subject_id)
    subject = make_subject(model, subject_id, number, config.seed)
    # Strands follow the pixels: thin enough to be finer than one, not finer than can be seen.
    detail = float(np.clip(min(config.width, config.height) / 512, 0.6, 3.0))
    body = build_body(model, subject, config.seed, detail if config.hair else 0.0)
    script = select(config.expressions)
    play = perform(model, script, config.frames_per_expression, config.fps, number, config.seed)
    return body, play


class StudioView:
    """One camera with what every frame shares: sensor, rays, the empty studio."""

    def __init__(self, camera: Camera, index: int, seed: int, keep: bool) -> None:
        self.camera, self.index = camera, index
        self.sensor: Sensor = make_sensor(index, seed)
        self._seed = seed
        self._room = room_width(camera)
        self._kept = list(self._make()) if keep else None

    def _make(self):  # noqa: ANN202
        for band in bands(self.camera):
            rows = slice(band.pad[0], band.pad[0] + band.bottom - band.top)
            shape = band.centre[rows].shape
            rays = band.centre[rows].reshape(-1, 3)
            yield band, background(self._seed, band.origin, rays, self._room).reshape(shape)

    def bands(self):  # noqa: ANN201
        """Iterate over pairs of rays and the empty studio's linear picture there."""
        return self._make() if self._kept is None else iter(self._kept)

    def plate(self) -> np.ndarray:
        """Return the empty studio, linear (H, W, 3)."""
        return np.concatenate([plate for _, plate in self.bands()])


def film_subject(
    config: TwinConfig,
    subject_id: str,
    camera_indices: list[int],
    capture: Path,
    truth: Path,
    tick: Callable[[], None],
) -> None:
    """Record all frames of one subject in some cameras, and their plates.

    Args:
        config: the recording.
        subject_id: who.
        camera_indices: which cameras of the rig; others may be filmed by other processes.
        capture: the capture's folder.
        truth: the folder of its truth; whoever films camera 0 writes it.
        tick: called after every picture.
    """
    body, play = cast_subject(config, subject_id)
    number, seed = body.subject.number, config.seed
    rig = list(make_rig(config.cameras, config.width, config.height, seed).values())
    keep = config.width * config.height * len(camera_indices) <= _KEEP_PIXELS
    views = [StudioView(rig[k], k, seed, keep) for k in camera_indices]
    texture = paint_skin(body, seed, texture_width(min(config.width, config.height)))
    eyes, lighting = find_eyes(body.model), make_lighting(number, seed)
    with ExitStack() as stack:
        films = [_open(config, capture, view.camera) for view in views]
        for film in films:
            stack.enter_context(film)
        for frame in range(play.frames):
            posed = pose_body(body, play, frame)
            scene = build_scene(body, texture, eyes, lighting, posed, seed)
            hull = hull_of(posed.vertices)
            for view, film in zip(views, films, strict=True):
                picture = render_view(scene, view, hull)
                chance = random_stream(seed, number, 11, view.index, frame)
                film.write(expose(view.sensor, picture, chance, config.noise))
                tick()
    if 0 in camera_indices:
        write_truth(truth, config.head, body, play, {camera.id: camera for camera in rig})
    if config.plates:
        for view in views:
            chance = random_stream(seed, number, 12, view.index)
            write_png(
                capture / "plates" / f"{view.camera.id}.png",
                expose(view.sensor, view.plate(), chance, config.noise),
            )


def render_view(scene: LitScene, view: StudioView, hull: np.ndarray) -> np.ndarray:
    """Render the linear picture (H, W, 3) of a frame in one camera, before the sensor.

    ``hull`` holds the corners of the convex hull of the scene's vertices.
    """
    window = window_of(view.camera, hull)
    picture = np.empty((view.camera.height, view.camera.width, 3), np.float32)
    for band, plate in view.bands():
        picture[band.top : band.bottom] = plate
        part = _subject_in(scene, window, band)
        if part is not None:
            colour, alpha, (x0, y0, x1, y1) = part
            picture[y0:y1, x0:x1] *= 1.0 - alpha[..., None]
            picture[y0:y1, x0:x1] += colour
    return picture


def _subject_in(scene: LitScene, window: tuple[int, int, int, int], band: RowBand):  # noqa: ANN202
    return render_bands(
        scene.caster, scene.body.material, window, band, Sampling(), partial(shade, scene)
    )


def film_board(
    config: TwinConfig, camera_indices: list[int], folder: Path, tick: Callable[[], None]
) -> None:
    """Write ``<folder>/<camera>/000000.png`` of every board pose in some cameras."""
    spec = BoardSpec()
    rig = list(make_rig(config.cameras, config.width, config.height, config.seed).values())
    poses = board_poses(spec, config.board_frames, config.seed)
    for index in camera_indices:
        camera, sensor = rig[index], make_sensor(index, config.seed)
        for number, pose in enumerate(poses):
            picture = render_board(spec, pose, camera, config.seed)
            chance = random_stream(config.seed, 402, index, number)
            image = expose(sensor, picture, chance, config.noise)
            write_png(folder / camera.id / f"{number:06d}.png", image)
            tick()


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a PNG, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(image))


def _open(config: TwinConfig, capture: Path, camera: Camera) -> Film:
    folder = capture / "cameras" / camera.id
    if config.footage == "video":
        return VideoFootage(folder, camera.width, camera.height, config.fps, config.crf)
    return ImageFootage(folder, config.footage)


_SHOT, _READ = 0.0055, 0.0016  # noise of a clean studio exposure, linear light
_KNEE = 0.75
_CURVE_STEPS = 16384


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One camera's colour gain (3,) and how much its corners darken."""

    gain: np.ndarray
    vignette: float


def make_sensor(camera_index: int, seed: int) -> Sensor:
    """Draw a camera's sensor."""
    rng = random_stream(seed, 301, camera_index)
    gain = 0.85 * rng.uniform(0.94, 1.06) * (1.0 + rng.normal(0.0, 0.025, 3))
    return Sensor(gain=gain.astype(np.float32), vignette=float(rng.uniform(0.02, 0.08)))


def expose(
    sensor: Sensor, linear: np.ndarray, rng: np.random.Generator, noise: float
) -> np.ndarray:
    """Expose linear light (H, W, 3) float32: the 8-bit sRGB picture (H, W, 3)."""
    height, width = linear.shape[:2]
    y = (np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    falloff = 1.0 - sensor.vignette * 0.5 * (x[None] ** 2 + y[:, None] ** 2)
    signal = linear * sensor.gain * falloff[..., None]
    if noise > 0:
        grain = rng.standard_normal(signal.shape, dtype=np.float32)
        signal = signal + noise * grain * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(signal, 0.0))
    steps = np.clip(signal * (_CURVE_STEPS / 2.0), 0, _CURVE_STEPS - 1).astype(np.int32)
    return _CURVE[steps]


def _tone(linear: np.ndarray) -> np.ndarray:
    """Compress light above the knee softly, so that highlights do not clip hard."""
    over = np.maximum(linear - _KNEE, 0.0)
    return np.minimum(linear, _KNEE) + (1 - _KNEE) * (1.0 - np.exp(-over / (1 - _KNEE)))


# Linear light 0 to 2 in fine steps; one step is at most half of one level.
_CURVE = np.rint(
    255.0 * linear_to_srgb(_tone((np.arange(_CURVE_STEPS) + 0.5) * 2.0 / _CURVE_STEPS))
).astype(np.uint8)
