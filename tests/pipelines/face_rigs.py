"""What a rig would see of a spotted head at some instants: landmarks and features, as numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from express50.geometry.cameras import Camera, project
from express50.geometry.transforms import axis_angle_to_matrix, look_at
from pipelines.calibrate.adjuster import move_pose
from pipelines.calibrate.tracks import FrameSetPoints

SIZE = (640, 480)
RADII = np.array([0.075, 0.11, 0.09])


def face() -> np.ndarray:
    """68 points (68, 3) on the front of an ellipsoid, metres; the eyes' middles are 63 mm apart."""
    rng = np.random.default_rng(3)
    way = rng.normal(size=(68, 3)) * [0.6, 0.6, 0.3] + [0, 0, 1]
    points = RADII * way / np.linalg.norm(way, axis=1, keepdims=True)
    ring = np.array([[np.cos(a), np.sin(a), 0] for a in np.arange(6) * np.pi / 3]) * 0.012
    points[36:42] = ring + [-0.0315, 0.02, 0.08]
    points[42:48] = ring + [0.0315, 0.02, 0.08]
    return points


def face_cameras(count: int = 6, span_deg: float = 90.0) -> dict:
    """Cameras on an arc before the face at two heights, with one radial term."""
    rig = {}
    for i in range(count):
        angle = np.radians(span_deg) * (i / max(count - 1, 1) - 0.5)
        eye = 1.1 * np.array([np.sin(angle), 0.2 * (-1) ** i, np.cos(angle)])
        pose = look_at(eye, np.zeros(3))
        f = 1100.0 * (1 + 0.02 * np.sin(3 * i))
        params = (f, SIZE[0] / 2, SIZE[1] / 2, -0.05)
        rig[f"cam{i:02d}"] = Camera(f"cam{i:02d}", *SIZE, "SIMPLE_RADIAL", params, pose)
    return rig


def see(
    rig: dict[str, Camera],
    sets: int = 2,
    features: int = 130,
    landmark_px: float = 2.0,
    blind: tuple[str, ...] = (),
) -> dict[int, FrameSetPoints]:
    """Landmarks and features in recorded pixels; a tenth of each camera's looks is mixed.

    Features are seen within 75 degrees of the surface's normal, faces by all but `blind` cameras.
    """
    rng = np.random.default_rng(7)
    seen = {}
    for number in range(sets):
        turn = axis_angle_to_matrix(rng.normal(size=3) * 0.1)
        shift = rng.normal(size=3) * 0.01
        shape = face() + rng.normal(size=(68, 3)) * 0.002
        shape[36:48] = face()[36:48]
        way = rng.normal(size=(features, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        spots, normals = (RADII * way) @ turn.T + shift, way @ turn.T
        looks = rng.normal(size=(features, 128))
        looks /= np.linalg.norm(looks, axis=1, keepdims=True)
        landmarks, found = [], {}
        for name, camera in rig.items():
            if name not in blind:
                pixels = project(camera, shape @ turn.T + shift)[0]
                pixels = pixels + rng.normal(size=(68, 2)) * landmark_px
                landmarks.append((name, pixels, np.full(68, 3.0 * landmark_px)))
            towards = camera.center - spots
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            shown = np.flatnonzero(np.sum(towards * normals, axis=1) > np.cos(np.radians(75)))
            pixels = project(camera, spots[shown])[0] + rng.normal(size=(len(shown), 2)) * 0.3
            own = looks[shown] + rng.normal(size=(len(shown), 128)) * 0.02
            mixed = np.flatnonzero(rng.random(len(shown)) < 0.1)
            own[mixed] = own[np.roll(mixed, 1)]
            own /= np.linalg.norm(own, axis=1, keepdims=True)
            found[name] = (pixels, own.astype(np.float32))
        seen[number] = FrameSetPoints(landmarks, found)
    return seen


def perturbed(rig: dict[str, Camera], degrees: float, metres: float) -> dict:
    """Every camera turned and moved so far, each in its own direction."""
    rng = np.random.default_rng(0)
    out = {}
    for name, camera in rig.items():
        turn, shift = rng.normal(size=(2, 3))
        turn *= np.radians(degrees) / np.linalg.norm(turn)
        shift *= metres / np.linalg.norm(shift)
        step = np.concatenate([turn, shift])
        out[name] = replace(camera, cam_from_world=move_pose(camera.cam_from_world, step))
    return out
