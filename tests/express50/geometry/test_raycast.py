"""Ray casting against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.cameras import Camera
from express50.geometry.raycast import visible_faces

FACES = np.array([[0, 1, 2], [3, 4, 5]])
NEAR = np.array([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [-1.0, 1.0, 2.0]])
FAR = np.array([[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [-9.0, 9.0, 4.0]])


@pytest.mark.parametrize("shift", [0.0, 10_000.0])
def test_the_nearest_face_is_seen_at_its_depth(shift: float) -> None:
    pose = np.eye(4)
    pose[0, 3] = -shift
    camera = Camera("c", 8, 8, "PINHOLE", (4.0, 4.0, 4.0, 4.0), pose)
    vertices = np.concatenate([NEAR, FAR]) + [shift, 0.0, 0.0]
    face, depth = visible_faces(vertices, FACES, camera)
    y, x = (np.mgrid[:8, :8] + 0.5 - 4.0) / 4.0
    near = (x > -0.5) & (y > -0.5) & (x + y < 0)
    assert (face[near] == 0).all()
    np.testing.assert_allclose(depth[near], 2.0, atol=1e-5)
    far = (x + y < 0) & ~near
    assert (face[far] == 1).all()
    np.testing.assert_allclose(depth[far], 4.0, atol=1e-5)
    nothing = x + y > 0
    assert (face[nothing] == -1).all()
    assert np.isinf(depth[nothing]).all()
