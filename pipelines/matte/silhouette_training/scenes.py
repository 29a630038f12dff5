"""Render the twin's people in other bodies, dress them, and photograph them in drawn rooms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from express50.capture.expressions import select
from express50.geometry.cameras import Camera
from express50.geometry.conventions import affine_to_opencv
from express50.geometry.transforms import look_at
from express50.head.model import HeadModel
from express50.twin.body import Body, build_body, pose_body, with_hand
from express50.twin.render import Sampling, bands, render_band
from express50.twin.shade import LitScene, build_scene, find_eyes, make_lighting, shade
from express50.twin.skin import paint_skin, texture_width
from express50.twin.subjects import make_subject, perform
from express50.twin.surface import MISS, Material
from pipelines.matte.cutout import CutView, HeadPlace, average_person
from pipelines.matte.silhouette import CROP, SPAN_M, joined_input

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
GAMMA = 2.2
FINE = 4  # fractional bits of OpenCV's drawing coordinates
MOST_THINGS = 3.9  # logarithm of the most things in a room
X, Y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
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


@dataclass(frozen=True)
class Layer:
    """A person: premultiplied linear light (S, S, 3) and opacity (S, S)."""

    light: np.ndarray
    alpha: np.ndarray


@dataclass(frozen=True)
class TrainingScene:
    """What the network sees, and what it should find."""

    inputs: np.ndarray  # (7, CROP, CROP) float32
    alpha: np.ndarray  # (CROP, CROP) float32
    seen: np.ndarray  # (CROP, CROP) float32, 1 inside of the picture


def draw_scene(view: PersonView, other: PersonView, rng: Rng) -> TrainingScene:
    """Draw a picture of one person; sometimes another one stands behind."""
    person = with_hair_and_hat(recoloured(view, rng), view.labels, rng)
    wall = room(colours_of(person, view), rng)
    if rng.random() < 0.08:
        wall = with_somebody_behind(other, wall, rng)
    wall = wall**GAMMA * np.exp(rng.normal() * 0.4)
    if rng.random() < 0.4:  # the person's shadow
        move = np.array([[1, 0, rng.normal() * 12], [0, 1, rng.normal() * 8]])
        cast = cv2.warpAffine(person.alpha, move, (SIDE, SIDE))
        cast = cv2.GaussianBlur(cast, (0, 0), rng.uniform(2, 10))
        wall = wall * (1 - rng.uniform(0.1, 0.6) * cast[..., None])
    light = person.light * np.exp(rng.normal() * 0.5) + wall * (1 - person.alpha[..., None])
    light *= np.exp(rng.normal(size=3) * 0.12)  # white balance
    image = np.clip(light, 0, 1) ** rng.uniform(0.38, 0.55)
    return photographed(image.astype(np.float32), person.alpha, view.labels, rng)


def recoloured(view: PersonView, rng: Rng) -> Layer:
    """Change the colours of hair and shirt; sometimes open the collar."""
    light, alpha = (view.light.astype(np.float32) / 255) ** 2, view.alpha.astype(np.float32) / 255
    hair, shirt = view.material == Material.HAIR, view.material == Material.CLOTH
    if rng.random() < 0.5 and (hair & (alpha > 0.9)).any():
        mean = np.maximum(light[hair & (alpha > 0.9)].mean(0), 1e-3)
        light[hair] *= (some_light(rng) * rng.uniform(0.3, 1) + 0.003) / mean
    if not shirt.any():
        return Layer(light, alpha)
    grey = light.mean(-1, keepdims=True) / max(float(light[shirt].mean()), 1e-4)
    if rng.random() < 0.85:
        light[shirt] = (grey * np.clip(cloth_colours(rng), 0, 1))[shirt]
    if rng.random() < 0.25:
        rows, columns = np.nonzero(shirt)
        middle, top = columns.mean() + rng.normal() * 6, rows.min()
        left, right = rng.uniform(4, 25, 2)
        neck = [(middle - left, top), (middle + right, top), (middle, top + rng.uniform(8, 60))]
        inside = shirt & (filled(np.array(neck)) > 0.5)
        skin = view.material == Material.SKIN
        bare = rng.random() < 0.6 and skin.any()
        light[inside] = (grey * (light[skin].mean(0) if bare else some_light(rng)))[inside]
    return Layer(light, alpha)


def cloth_colours(rng: Rng) -> np.ndarray:
    """Draw the colours (S, S, 3) of a plain, striped, checked, mottled or printed cloth."""
    cloth = np.tile(some_light(rng), (SIDE, SIDE, 1)).astype(np.float32)
    kind = rng.random()
    column, row = (X + 1) * SIDE / 2, (Y + 1) * SIDE / 2
    if kind < 0.25:
        angle, width = rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)]), rng.uniform(2, 14)
        phase = (column * np.cos(angle) + row * np.sin(angle)) / width * np.pi
        stripe = np.sin(phase + waves(4, 1, rng)[..., 0] / 2) > rng.uniform(-0.5, 0.5)
        cloth[stripe] = some_light(rng)
    elif kind < 0.35:
        width = rng.uniform(3, 12)
        cloth[(column // width + row // width) % 2 > 0] *= rng.uniform(0.2, 1.5)
    elif kind < 0.55:
        cloth *= 1 + waves(int(rng.integers(5, 80)), 3, rng) * rng.uniform(0.1, 0.7)
    elif kind < 0.65:
        print_ = blob(rng.uniform(0.3, 0.9, 2) * SIDE, rng.uniform(4, 25, 2), 0.2, rng)
        cloth[filled(print_) > 0.5] = some_light(rng)
    return cloth


def with_hair_and_hat(person: Layer, labels: np.ndarray, rng: Rng) -> Layer:
    """Add long hair, buns, volume, hats or headphones, of soft shapes about the head."""
    rows, columns = np.nonzero(labels == cv2.GC_FGD)
    if not len(rows):
        return person
    top, low = rows.min(), rows.max()
    size = (low - top) * 0.62  # of the head, pixels
    middle = columns[rows < (top + low) / 2].mean()
    at = lambda x, y: np.array([middle + x * size, top + y * size])  # noqa: E731 - head's place
    hair = some_light(rng) * 0.6
    if rng.random() < 0.35:
        length, width = rng.uniform(0.5, 2.6), rng.uniform(0.4, 0.75)
        shape = blob(
            at(rng.normal() * 0.06, length / 2 - 0.12), (width, length / 2), 0.12, rng, size
        )
        person = painted(person, shape, hair, rng, front=False)
        for side in (-1.0, 1.0):
            if rng.random() < 0.3:
                strand = at(side * rng.uniform(0.32, 0.5), rng.uniform(0.4, 1.3))
                radii = rng.uniform(0.08, 0.2), rng.uniform(0.4, 1)
                person = painted(person, blob(strand, radii, 0.15, rng, size), hair, rng)
    if rng.random() < 0.12:
        bun = at(rng.normal() * 0.4, rng.uniform(-0.45, 0.6))
        shape = blob(bun, rng.uniform(0.12, 0.35, 2), 0.15, rng, size)
        person = painted(person, shape, hair, rng, front=False)
    if rng.random() < 0.12:  # a ponytail
        tail = at(rng.choice([-1, 1]) * rng.uniform(0.3, 0.75), rng.uniform(0.3, 1.2))
        radii = rng.uniform(0.06, 0.2), rng.uniform(0.25, 0.8)
        person = painted(person, blob(tail, radii, 0.15, rng, size), hair, rng, front=False)
    if rng.random() < 0.1:  # a hood or collar
        shape = blob(at(0, rng.uniform(0.9, 1.4)), rng.uniform(0.35, 0.9, 2), 0.12, rng, size)
        person = painted(person, shape, some_light(rng), rng, front=False)
    if rng.random() < 0.12:
        shape = blob(at(0, 0.3), rng.uniform(0.5, 0.85, 2), 0.12, rng, size)
        person = painted(person, shape, hair, rng, front=False)
    if rng.random() < 0.1:
        colour = some_light(rng)
        shape = blob(at(0, 0.12), rng.uniform(0.42, 0.6, 2), 0.05, rng, size)
        shape[:, 1] = np.minimum(shape[:, 1], top + size * rng.uniform(0.1, 0.3))
        person = painted(person, shape, colour, rng)
        if rng.random() < 0.5:
            brim = blob(at(rng.normal() * 0.4, 0.2), (rng.uniform(0.5, 0.9), 0.07), 0.05, rng, size)
            person = painted(person, brim, colour, rng)
    if rng.random() < 0.05:
        for side in (-0.5, 0.5):
            cup = blob(at(side, 0.55), rng.uniform(0.08, 0.2, 2), 0.05, rng, size)
            person = painted(person, cup, some_light(rng) / 2, rng)
    return person


def painted(
    person: Layer, shape: np.ndarray, colour: np.ndarray, rng: Rng, front: bool = True
) -> Layer:
    """Paint a shape (N, 2) with streaks, lit from a side, in front of a person or behind."""
    cover = filled(shape)
    streaks = rng.normal(size=(SIDE // 8, SIDE)).astype(np.float32)
    texture = 1 + cv2.resize(streaks, (SIDE, SIDE))[..., None] * rng.uniform(0.05, 0.4)
    light = np.clip(colour * texture, 0, 1.5) * (1 + rng.normal() * 0.3 * X[..., None])
    if not front:
        cover = cover * (1 - person.alpha)
    kept = 1 - cover if front else np.ones_like(cover)
    painted = person.light * kept[..., None] + np.maximum(light, 0) * cover[..., None]
    return Layer(painted, person.alpha * kept + cover)


def colours_of(person: Layer, view: PersonView) -> list[np.ndarray]:
    """Return mean colours (3,) of skin, hair and shirt, coded as in pictures."""
    masks = (view.material == kind for kind in (Material.SKIN, Material.HAIR, Material.CLOTH))
    means = [person.light[mask].mean(0) for mask in masks if mask.any()]
    return [np.clip(mean, 0, 1) ** (1 / GAMMA) for mean in means]


def some_colour(rng: Rng, own: list[np.ndarray] | None = None) -> np.ndarray:
    """Draw a colour (3,) as in pictures: often grey, and often one of the person's `own`."""
    kind = rng.random()
    if kind < 0.3 and own:
        tone = 1 + 0.4 * rng.uniform(-1, 1) ** 3  # often nearly the same
        mine = own[rng.integers(len(own))] * tone * rng.uniform(0.93, 1.07, 3)
        return np.clip(mine, 0, 1)
    if kind < 0.65:
        return np.clip(rng.uniform(0.05, 0.95) + rng.normal(size=3) * 0.06, 0, 1)
    return rng.uniform(0, 1, 3)


def some_light(rng: Rng) -> np.ndarray:
    """Draw a colour (3,) in linear light."""
    return some_colour(rng) ** GAMMA


def waves(cells: int, channels: int, rng: Rng) -> np.ndarray:
    """Draw smooth noise (S, S, channels) of unit size, with a number of cells along each side."""
    grid = rng.normal(size=(cells, cells, channels)).astype(np.float32)
    large = cv2.resize(grid, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    return large.reshape(SIDE, SIDE, channels)


def clouds(rng: Rng) -> np.ndarray:
    """Draw noise (S, S, 3) whose strength falls with frequency, as in foliage or posters."""
    fall, grey = rng.uniform(0.3, 1.3), rng.random()
    cells = [2, 4, 8, 16, 32, 64]
    noise = sum(((1 - grey) * waves(n, 3, rng) + grey * waves(n, 1, rng)) * n**-fall for n in cells)
    return np.asarray(noise * np.exp(rng.uniform(-3, -1)) / np.std(noise))


def blob(
    centre: np.ndarray, radii: tuple[float, float] | np.ndarray, rough: float, rng: Rng,
    size: float = 1.0,
) -> np.ndarray:  # fmt: skip
    """Draw a smooth closed curve (40, 2) about a centre; radii are multiples of a size."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    radius = np.ones(len(angle))
    for k in range(1, 6):
        radius += rough * rng.normal() / k * np.sin(k * angle + rng.uniform(0, 2 * np.pi))
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]
    return centre + circle * np.asarray(radii) * size


def filled(shape: np.ndarray) -> np.ndarray:
    """Return how far a polygon (N, 2) covers the pixels (S, S)."""
    cover = np.zeros((SIDE, SIDE), np.float32)
    cv2.fillPoly(cover, [np.int32(shape * 2**FINE)], 1.0, cv2.LINE_AA, FINE)
    return cover


def room(own: list[np.ndarray], rng: Rng) -> np.ndarray:
    """Draw a wall (S, S, 3) as in pictures, often with things of the person's `own` colours."""
    wall = np.tile(some_colour(rng, own), (SIDE, SIDE, 1)).astype(np.float32)
    wall *= (1 + rng.normal() * 0.15 * X + rng.normal() * 0.15 * Y)[..., None]
    for channels, share, most in ((1, 0.5, 0.06), (3, 0.25, 0.08)):
        if rng.random() < share:
            wall += waves(int(rng.integers(3, 60)), channels, rng) * rng.uniform(0, most)
    if rng.random() < 0.25:
        wall += clouds(rng)
    things = np.exp(rng.uniform(0, MOST_THINGS)) if rng.random() < 0.7 else 0
    for _ in range(round(things)):
        wall = with_thing(np.ascontiguousarray(wall, np.float32), own, rng)
    if rng.random() < 0.6:  # out of focus
        wall = cv2.GaussianBlur(wall, (0, 0), np.exp(rng.uniform(-1, 1.6)))
    return np.clip(wall, 0, 1)


def with_thing(wall: np.ndarray, own: list[np.ndarray], rng: Rng) -> np.ndarray:
    """Add a board, box, ball or pole to a wall."""
    kind, colour = rng.random(), tuple(map(float, some_colour(rng, own)))
    place, size = rng.uniform(-20, SIDE + 20, 2), np.exp(rng.uniform(1.2, 4.6, 2))
    if kind > 0.85:
        end = [int(value) for value in rng.uniform(0, SIDE, 2)]
        return cv2.line(wall, place.astype(int), end, colour, int(rng.integers(1, 6)), cv2.LINE_AA)
    if kind > 0.65:
        axes = (size / 2).astype(int) + 1
        angle = rng.uniform(0, 180)
        return cv2.ellipse(wall, place.astype(int), axes, angle, 0, 360, colour, -1, cv2.LINE_AA)
    tilt = rng.normal() * 6 if rng.random() < 0.8 else rng.uniform(0, 90)
    corners = cv2.boxPoints((place.tolist(), size.tolist(), tilt))
    inside, look = filled(corners)[..., None], np.array(colour) * np.ones_like(wall)
    if rng.random() < 0.6:
        look = look * (1 + rng.normal() * 0.2 * (X if rng.random() < 0.5 else Y))[..., None]
    if rng.random() < 0.3:
        stripes = (X if rng.random() < 0.5 else Y) * SIDE / 2 // rng.integers(3, 16) % 2
        look = look * (1 - 0.6 * rng.random() * stripes)[..., None]
    if rng.random() < 0.3:
        look = look + waves(int(rng.integers(8, 70)), 3, rng) * rng.uniform(0, 0.25)
    wall = np.ascontiguousarray(wall + inside * (look - wall), np.float32)
    if rng.random() < 0.4:
        edge, line = some_colour(rng, own).tolist(), [np.int32(corners * 2**FINE)]
        cv2.polylines(wall, line, True, edge, int(rng.integers(1, 3)), cv2.LINE_AA, FINE)
    return wall


def with_somebody_behind(other: PersonView, wall: np.ndarray, rng: Rng) -> np.ndarray:
    """Put another person, smaller and at a side, before a wall (S, S, 3)."""
    scale, side = rng.uniform(0.5, 1), rng.choice([-1, 1])
    across = (0.5 * (1 - scale) + side * scale * rng.uniform(0.45, 0.9)) * SIDE
    move = np.array([[scale, 0, across], [0, scale, rng.normal() * 15]])
    rgba = np.dstack([other.light, other.alpha]).astype(np.float32) / 255
    rgba = cv2.warpAffine(rgba, move, (SIDE, SIDE))
    shown = (rgba[..., :3] ** 2) ** (1 / GAMMA)
    return np.where(rgba[..., 3:] > 0.5, shown, wall)


def photographed(
    image: np.ndarray, alpha: np.ndarray, labels: np.ndarray, rng: Rng
) -> TrainingScene:
    """Turn, mirror, blur and cut a picture (S, S, 3) to what the network sees."""
    scale = CROP / SIDE * VIEW_M / SPAN_M * np.exp(rng.normal() * 0.07)
    move = cv2.getRotationMatrix2D((SIDE / 2, SIDE / 2), rng.normal() * 6, scale)
    move[:, 2] += (CROP - SIDE) / 2 + rng.normal(size=2) * 3
    if rng.random() < 0.5:
        move = np.diag([-1.0, 1.0]) @ move + [[0, 0, CROP], [0, 0, 0]]
    move = affine_to_opencv(move)

    def warped(array: np.ndarray, way: int = cv2.INTER_LINEAR) -> np.ndarray:
        size, rim = (CROP, CROP), cv2.BORDER_REPLICATE
        return cv2.warpAffine(array, move, size, flags=way, borderMode=rim)

    image = warped(image)
    if rng.random() < 0.1:
        image = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.2, 1.2))
    noise = rng.standard_normal(image.shape, np.float32) * rng.uniform(0, 0.03)
    seen = np.ones((CROP, CROP), np.float32)
    if rng.random() < 0.7:
        for turn in range(4):
            if rng.random() < 0.7:
                np.rot90(seen, turn)[: int(rng.uniform(0, 0.3) * CROP)] = 0
    inputs = joined_input(np.clip(image + noise, 0, 1), warped(labels, cv2.INTER_NEAREST), seen > 0)
    return TrainingScene(inputs, warped(alpha.astype(np.float32)), seen)
