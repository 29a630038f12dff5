"""Ray-cast the built-in head with a shirt and hair of plain shapes: views of known parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from express50.contract.segmentation_labels import LABELS
from express50.geometry.cameras import Camera, pinhole_camera, rays
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from express50.head.model import pose
from express50.twin.surface import MISS, Caster
from pipelines.regions.geometry import SCALP, TrackedHead, head_labels, make_head

COLOURS = {"skin": (205, 160, 140), "hair": (60, 40, 30), "torso": (70, 110, 170)}
# Metres, head space: the shirt begins over the neck's end, so that it hides some neck.
SHIRT_TOP = -0.13
COLLAR_RADII, SHIRT_RADII = (0.09, 0.1), (0.22, 0.17)


@dataclass(frozen=True)
class RegionScene:
    """One view: the head, its camera, frame (H, W, 3), alpha and depth (H, W), true labels."""

    head: TrackedHead
    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    labels: np.ndarray


@lru_cache(maxsize=4)
def tracked(jaw: float = 0.0, offset: tuple[float, float, float] = (0, 0, 0)) -> TrackedHead:
    """Pose the built-in head: its jaw opened, radians, and moved by an offset, metres."""
    model = load_head("procedural")
    none = torch.zeros(1, 1)
    vertices = pose(model, none, none, jaw=torch.tensor([[jaw, 0.0, 0.0]]))[0].double().numpy()
    return make_head(vertices + offset, np.eye(3), head_labels(model))


def camera_at(azimuth_deg: float, size: int = 160, distance: float = 1.0) -> Camera:
    """Place a camera around the head that sees 45 cm of it."""
    angle = np.radians(azimuth_deg)
    target = np.array([0.0, -0.04, 0.0])
    eye = target + distance * np.array([np.sin(angle), 0.05, np.cos(angle)])
    K = np.array([[distance * size / 0.45, 0, size / 2], [0, distance * size / 0.45, size / 2],
                  [0, 0, 1.0]])  # fmt: skip
    return pinhole_camera("cam", K, size, size, look_at(eye, target))


def shirt() -> tuple[np.ndarray, np.ndarray]:
    """Make a tube around the neck that opens into shoulders: vertices (N, 3), faces (M, 3)."""
    around, s = np.meshgrid(np.linspace(0, 2 * np.pi, 49)[:-1], np.linspace(0, 1, 9))
    width, deep = (a + (b - a) * s for a, b in zip(COLLAR_RADII, SHIRT_RADII, strict=True))
    points = np.stack([width * np.cos(around), SHIRT_TOP - 0.16 * s, deep * np.sin(around) - 0.04],
                      axis=-1)  # fmt: skip
    index = np.arange(points[..., 0].size).reshape(around.shape)
    a, b = index[:-1], index[1:]
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([c, d, b], -1)]).reshape(-1, 3)
    return points.reshape(-1, 3), faces


def locks(head: TrackedHead) -> tuple[np.ndarray, np.ndarray]:
    """Make a cap of hair over the scalp, and one lock that falls over the left shoulder."""
    scalp = head.labels.vertices == SCALP
    cap = head.labels.faces[scalp[head.labels.faces].all(1)]
    middle = np.array([0.0, 0.03, -0.01])
    lifted = middle + (head.vertices - middle) * 1.08
    ribbon = np.array([[0.085, 0.0, 0.03], [0.105, 0.0, 0.03], [0.105, -0.25, 0.115],
                       [0.085, -0.25, 0.115]])  # fmt: skip
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + len(lifted)
    return np.concatenate([lifted, ribbon]), np.concatenate([cap, faces])


def make_scene(
    azimuth_deg: float = 0.0, jaw: float = 0.0, size: int = 160, hair: bool = True, seed: int = 0
) -> RegionScene:
    """Ray-cast a view: what is hit first gives colour and label."""
    head, camera = tracked(jaw), camera_at(azimuth_deg, size)
    pieces = [(head.vertices, head.labels.faces), shirt(), *([locks(head)] if hair else [])]
    starts = np.cumsum([0] + [len(v) for v, _ in pieces])
    counts = np.cumsum([len(f) for _, f in pieces])
    caster = Caster(
        np.concatenate([v for v, _ in pieces]),
        np.concatenate([f + start for (_, f), start in zip(pieces, starts, strict=False)]),
    )
    origin, directions = rays(camera)
    depth, face, uv = caster.cast(origin, directions.reshape(-1, 3))
    hit = face != MISS
    piece = np.where(hit, np.searchsorted(counts, face, side="right"), -1)
    corner = np.stack([1 - uv.sum(1), *uv.T], axis=1).argmax(1)
    on_head = piece == 0
    labels = np.zeros(len(hit), np.uint8)
    labels[on_head] = head.labels.vertices[head.labels.faces[face[on_head], corner[on_head]]]
    labels[labels == SCALP] = LABELS.index("skin")
    labels[piece == 1], labels[piece == 2] = LABELS.index("torso"), LABELS.index("hair")
    rng = np.random.default_rng(seed)
    colour = np.zeros((len(hit), 3))
    colour[hit] = COLOURS["skin"]
    colour[piece == 1], colour[piece == 2] = COLOURS["torso"], COLOURS["hair"]
    colour += rng.normal(0, 4, colour.shape)
    shape = directions.shape[:2]
    return RegionScene(
        head, camera, np.clip(colour, 0, 255).astype(np.uint8).reshape(*shape, 3),
        hit.astype(np.float32).reshape(shape),
        np.where(hit, depth, 0).astype(np.float32).reshape(shape), labels.reshape(shape),
    )  # fmt: skip
