"""The outline that people mark: evenly spaced, on the edge, from the eyes' height to the chin."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import landmarks_of
from express50.landmarks.training.scene import face_front

FOCAL, DISTANCE, SIZE = 900.0, 0.8, 512
HEAD = load_head("procedural")
REST = HEAD.template.double().numpy()
MARKS = landmarks_of(HEAD).astype(np.float64)


def seen(yaw: float, pitch: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the head's vertices and landmarks, turned."""
    turn = axis_angle_to_matrix(np.array([pitch, 0.0, 0.0]))
    turn = turn @ axis_angle_to_matrix(np.array([0.0, yaw, 0.0]))

    def project(points: np.ndarray) -> np.ndarray:
        x, y, z = ((points - MARKS[30]) @ turn.T).T
        return SIZE / 2 + FOCAL * np.stack([x, -y], axis=1) / (DISTANCE - z)[:, None]

    return project(REST), project(MARKS)


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.9])
@pytest.mark.parametrize("pitch", [0.0, 0.3])
def test_points_are_even_and_on_the_edge(yaw, pitch):
    pixels, marks = seen(yaw, pitch)
    line = face_front(HEAD).outline(pixels, marks)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    for half in (steps[:8], steps[8:]):
        assert half.max() < 1.25 * half.min()
    # No landmark of the jaw lies below the chin's edge, and the chin is the lowest of the line.
    assert line[8, 1] >= line[:, 1].max() - 3.0
    assert line[8, 1] > marks[:17, 1].max()


def test_a_mirrored_view_has_the_mirrored_outline():
    one, other = (face_front(HEAD).outline(*seen(yaw)) for yaw in (0.6, -0.6))
    np.testing.assert_allclose(other[::-1] * [-1, 1] + [SIZE, 0], one, atol=4.0)


def test_a_turned_cheek_is_marked_where_it_ends():
    """The far side follows the rim of the cheek; the fixed places there lie behind it."""
    pixels, marks = seen(0.9)
    line, front = face_front(HEAD).outline(pixels, marks), pixels[np.unique(face_front(HEAD).faces)]
    far = slice(0, 6) if abs(line[0, 0] - marks[30, 0]) < abs(line[16, 0] - marks[30, 0]) else None
    far = far or slice(11, 17)
    outwards = np.sign(line[far, 0].mean() - line[8, 0])
    for x, y in line[far]:
        row = front[np.abs(front[:, 1] - y) < 3]
        assert abs((outwards * row[:, 0]).max() - outwards * x) < 5
    assert np.linalg.norm(line[far] - marks[far], axis=1).max() > 10
