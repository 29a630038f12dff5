"""A toy data set with known answers: coloured ellipsoids, ray cast analytically (no rasteriser)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from express50.geometry.transforms import look_at
from express50.head.model import REGIONS, HeadModel
from grmm.config import Config, resolve
from grmm.data import Place, Sample, SampleKey, Tracked
from tests.balls import meet_ball

AXES = np.array([0.08, 0.11, 0.09])  # metres
STRETCH = 0.015  # metres the first expression coefficient adds to the y axis


def ellipsoid_head(rows: int = 10, columns: int = 16) -> HeadModel:
    """A lat-long ellipsoid in the head model's layout.

    The lowest ring plays the teeth, two above it the inside of the mouth.
    """
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    polar, azimuth = np.pi * (1 - v), 2 * np.pi * (u - 0.5)
    unit = np.stack(
        [np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], -1
    )
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    unit = unit.reshape(-1, 3)
    count = len(unit)
    expression = np.zeros((count, 3, 4))
    expression[:, 1, 0] = STRETCH * unit[:, 1]
    skinning = np.zeros((count, 5))
    skinning[:, 0] = 1
    height = torch.from_numpy(v.reshape(-1))
    regions = {name: torch.zeros(count, dtype=torch.bool) for name in REGIONS}
    regions |= {"teeth": height < 0.15, "mouth_interior": (height > 0.35) & (height < 0.55)}
    return HeadModel(
        name="ellipsoid",
        template=torch.from_numpy(AXES * unit).float(),
        shape_dirs=torch.zeros(count, 3, 3),
        expression_dirs=torch.from_numpy(expression).float(),
        pose_dirs=torch.zeros(36, 3 * count),
        joint_regressor=torch.full((5, count), 1 / count),
        skinning=torch.from_numpy(skinning).float(),
        faces=torch.from_numpy(faces),
        uv=torch.from_numpy(np.stack([u, v], -1).reshape(-1, 2)).float(),
        uv_faces=torch.from_numpy(faces),
        landmark_faces=torch.zeros(68, dtype=torch.int64),
        landmark_bary=torch.full((68, 3), 1 / 3),
        shape_names=("s0", "s1", "s2"),
        expression_names=("e0", "e1", "e2", "e3"),
        regions=regions,
    )


class EllipsoidSource:
    """Subjects (by colour) x expressions (by height) x cameras on a ring."""

    head = "ellipsoid"
    digest = "toy"

    def __init__(self, subjects=2, expressions=2, cameras=3, size=40, offset=(0.2, -0.1, 0.3)):
        self.size, self.offset = size, np.array(offset)
        self.cameras = {f"cam{i:02d}": self._camera(i, cameras) for i in range(cameras)}
        self.keys = [
            SampleKey(subject=f"S{s:03d}", expression=f"e{e}", camera=camera)
            for s in range(subjects)
            for e in range(expressions)
            for camera in self.cameras
        ]

    def _camera(self, number: int, count: int) -> np.ndarray:
        angle = 2 * np.pi * number / count
        eye = self.offset + 0.6 * np.array([np.sin(angle), 0.2, np.cos(angle)])
        return look_at(eye, self.offset)

    def read(self, index: int) -> Sample:
        key = self.keys[index]
        subject, expression = int(key.subject[1:]), int(key.expression[1:])
        size, camera = self.size, self.cameras[key.camera]
        focal = 2.2 * size
        K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
        turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the head looks along world +x
        axes = AXES + np.array([0, STRETCH * expression, 0])
        image, alpha, depth = cast(axes, K, camera, turn, self.offset, size, subject)
        tracked = Tracked(
            shape=np.zeros(3),
            expression=np.array([expression, 0, 0, 0.0]),
            neck=np.zeros(3),
            jaw=np.zeros(3),
            eyes=np.zeros(6),
            R=turn,
            t=self.offset,
        )
        place = Place(K=K, cam_from_world=camera, tracked=tracked, size=(size, size))
        return Sample(image=image, alpha=alpha, depth=depth, place=place)

    def place(self, index: int) -> Place:
        return self.read(index).place


def cast(axes, K, camera, turn, offset, size, subject):
    """Image, alpha and depth of an ellipsoid by the quadratic formula."""
    pixels = np.arange(size) + 0.5
    x, y = np.meshgrid((pixels - K[0, 2]) / K[0, 0], (pixels - K[1, 2]) / K[1, 1])
    rays = np.stack([x, y, np.ones_like(x)], -1)
    rotation = turn.T @ camera[:3, :3].T  # head from camera
    directions = rays @ rotation.T / axes
    origin = turn.T @ (-camera[:3, :3].T @ camera[:3, 3] - offset) / axes
    depth, through = meet_ball(origin, directions)
    hit = through > 0
    depth = np.where(hit, depth, 0.0)
    point = origin + depth[..., None] * directions
    tint = np.array([[0.9, 0.5, 0.4], [0.4, 0.6, 0.9], [0.5, 0.8, 0.4]])[subject % 3]
    pattern = 0.6 + 0.25 * np.sin(4 * point[..., :1]) + 0.15 * np.sign(point[..., 1:2])
    image = np.where(hit[..., None], tint * pattern, 0.3)
    return (255 * image).astype(np.uint8), (255 * hit).astype(np.uint8), depth.astype(np.float32)


def tiny_config(**tables: dict[str, object]) -> Config:
    """The demo preset at toy size; keyword tables override fields."""
    config = resolve("demo")
    settings: dict[str, dict[str, object]] = {
        "model": {
            "n_g": 32, "z_id": 8, "z_exp": 4, "features": 4, "seed_channels": 8, "ladder": (8, 8),
            "shared_widths": (16, 16), "film_width": 8, "mesh_width": 8, "refine_widths": (8, 12),
            "identity_modes": 2,
        },
        "train": {"iterations": 4, "evaluate_images": 2},
        "fit": {"stage1_iterations": 3, "stage2_iterations": 3},
    }  # fmt: skip
    for table, values in tables.items():
        settings.setdefault(table, {}).update(values)
    for table, values in settings.items():
        config = replace(config, **{table: replace(getattr(config, table), **values)})
    return config
