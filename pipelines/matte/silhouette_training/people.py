"""Render the twin's people from all sides, in other bodies, for the silhouette network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from express50.capture.expressions import select
from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.head.model import HeadModel
from express50.twin.body import Body, build_body, pose_body, with_hand
from express50.twin.render import Sampling, bands, render_band
from express50.twin.shade import LitScene, build_scene, find_eyes, make_lighting, shade
from express50.twin.skin import paint_skin, texture_width
from express50.twin.subjects import make_subject, perform
from express50.twin.surface import MISS
from pipelines.matte.cutout import CutView, HeadPlace, average_person
from pipelines.matte.silhouette import CROP, SPAN_M

SIDE = 144  # pixels of a view
VIEW_M = SPAN_M * SIDE / CROP * 1.05  # what it shows
TWIN_SEED = 5  # no benchmark records people of this seed
POSES, VIEWS = 2, 6  # per person; half of the views are from the front
WORN = {
    "glasses": 0.2, "fringe": 0.2, "beard": 0.12, "hand": 0.12, "moustache": 0.08, "mask": 0.08,
    "microphone": 0.05,
}  # fmt: skip
BALD = 0.06
PLACE_M, SIZE = 0.006, 0.04  # errors of the head's place: metres, and logarithm of its size
EMPTY = 255
Rng = np.random.Generator


@dataclass(frozen=True)
class PersonView:
    """A rendered person."""

    light: np.ndarray  # (S, S, 3) uint8, 255 times the root of premultiplied linear light
    alpha: np.ndarray  # (S, S) uint8
    material: np.ndarray  # (S, S) uint8, `EMPTY` beside the person
    labels: np.ndarray  # (S, S) uint8, GrabCut's, of an average person at the head's place


def draw_people(model: HeadModel, count: int, first: int) -> list[PersonView]:
    """Render `count` people of the twin, from the number `first` on."""
    return [
        view for number in range(first, first + count) for view in views_of_person(model, number)
    ]


def views_of_person(model: HeadModel, number: int) -> list[PersonView]:
    """Render one person in random poses from random sides."""
    rng = np.random.default_rng([TWIN_SEED, number, 15])
    subject = make_subject(model, f"S{number}", number, TWIN_SEED)
    length = subject.look.hair_length_m * rng.uniform(0.7, 1.5)
    subject = replace(subject, look=replace(subject.look, hair_length_m=length))
    worn = tuple(kind for kind, share in WORN.items() if rng.random() < share)
    detail = 0.0 if rng.random() < BALD else 0.6
    body = in_other_clothes(build_body(model, subject, TWIN_SEED, detail, worn), rng)
    script = select(None)
    chosen = [script[k] for k in rng.choice(len(script), POSES, replace=False)]
    play = perform(model, chosen, 4, 24.0, number, TWIN_SEED)
    body = with_hand(body, play, TWIN_SEED)
    texture, eyes = paint_skin(body, TWIN_SEED, texture_width(SIDE)), find_eyes(model)
    views = []
    for frame in sorted(play.peaks.values()):
        posed = pose_body(body, play, frame)
        light = make_lighting(int(rng.integers(10**6)), TWIN_SEED)
        scene = build_scene(body, texture, eyes, light, posed, TWIN_SEED, None)
        head = posed.vertices[: len(model.template)].mean(0)
        pose = play.R[frame], play.t[frame]
        views += [
            render(scene, random_camera(head, k < VIEWS / 2, rng), *pose, rng) for k in range(VIEWS)
        ]
    return views


def in_other_clothes(body: Body, rng: Rng) -> Body:
    """Make the shirt wider, narrower, deeper, longer, or turned against the head."""
    shirt = body.extras.cloth_vertices.astype(np.float64)
    top, middle, turn = shirt[:, 1].max(), shirt.mean(0), rng.normal() * 0.3
    size = rng.uniform([0.78, 1.0, 0.8], [1.3, 1.0, 1.4])
    turned = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    moved = middle + (shirt - middle) * size @ turned.T
    moved[:, 1] = top - (top - shirt[:, 1]) * rng.uniform(1.3, 2.2)
    share = np.clip((top - shirt[:, 1:2]) / 0.1, 0, 1)  # the collar stays at the neck
    cloth = (shirt + share * (moved - shirt)).astype(np.float32)
    return replace(body, extras=replace(body.extras, cloth_vertices=cloth))


def random_camera(head: np.ndarray, front: bool, rng: Rng) -> Camera:
    """Draw a camera that looks at the chin of a head (3,), world, from anywhere or the front."""
    azimuth = rng.normal() * 0.9 if front else rng.uniform(-np.pi, np.pi)
    height, distance = np.radians(rng.uniform(-25, 35)), rng.uniform(0.6, 2.5)
    out = np.array([
        -np.sin(azimuth) * np.cos(height), np.sin(height), np.cos(azimuth) * np.cos(height)
    ])  # fmt: skip
    aim = head + rng.normal(size=3) * 0.02 - [0, 0.07, 0]
    pose = look_at(aim + distance * out, aim, np.array([np.tan(rng.normal() * 0.12), 1.0, 0]))
    focal = SIDE * distance / (VIEW_M * rng.uniform(0.93, 1.07))
    return Camera("view", SIDE, SIDE, "PINHOLE", (focal, focal, SIDE / 2, SIDE / 2), pose)


def render(
    scene: LitScene, camera: Camera, turn: np.ndarray, shift: np.ndarray, rng: Rng
) -> PersonView:
    """Render a scene whose head has a pose; one band of rows is the whole picture."""
    (band,) = bands(camera)
    part = render_band(
        scene.caster, scene.body.material, (0, 0, SIDE, SIDE), band, Sampling(edge=5, inside=1),
        partial(shade, scene),
    )  # fmt: skip
    assert part is not None
    face = scene.caster.cast(band.origin, band.centre[band.rows].reshape(-1, 3))[1]
    hit = face != MISS
    material = np.where(hit, scene.body.material[np.where(hit, face, 0)], EMPTY)
    size, error = float(np.exp(rng.normal() * SIZE)), rng.normal(size=3) * PLACE_M
    view = CutView(camera, np.zeros((SIDE, SIDE, 3), np.uint8), np.ones((SIDE, SIDE), bool))
    return PersonView(
        light=np.rint(255 * np.sqrt(np.clip(part[0], 0, 1))).astype(np.uint8),
        alpha=np.rint(255 * part[1]).astype(np.uint8),
        material=material.reshape(SIDE, SIDE).astype(np.uint8),
        labels=average_person(view, HeadPlace(size, turn, shift + error)),
    )
