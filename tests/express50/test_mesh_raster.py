"""Visibility by the native z-buffer against rays, and what it says of bad input."""

from __future__ import annotations

import sys
import types
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from express50 import native
from express50.geometry import mesh_backends
from express50.geometry.cameras import Camera
from express50.geometry.mesh_raster import face_neighbors, rasterize
from express50.head.builtin import load_builtin
from tests.express50.mesh_scenes import camera, head_camera, oracle, sphere


@pytest.fixture(scope="module")
def head():
    model = load_builtin()
    return model.template.double().numpy(), model.faces.numpy()


@pytest.mark.parametrize("cull", [False, True])
@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0])
def test_agrees_with_embree_on_a_head(head, angle, cull):
    view = head_camera(512, angle)
    got = rasterize(*head, view, pairs=False, cull=cull)
    rays = rasterize(*head, view, pairs=False, cull=cull, backend="open3d")
    covered = got.face_id >= 0
    differs = got.face_id != rays.face_id
    assert covered.mean() > 0.15
    assert differs.sum() < 1e-4 * covered.sum()
    apart = np.abs(got.depth - rays.depth)[~differs]  # rays are float32: grazed faces are noise
    assert np.quantile(apart, 0.999) < 1e-6 and apart.max() < 1e-4


def test_agrees_with_solved_rays(head):
    vertices, faces = sphere(6, 0.5)
    view = camera(40, 30, 35.0)
    vertices = vertices + [0.05, -0.02, 1.3]
    face_id, depth, clear = oracle(vertices, faces, view, 0.01)
    got = rasterize(vertices, faces, view)
    assert clear.mean() > 0.9 and (face_id >= 0).mean() > 0.2
    np.testing.assert_array_equal(got.face_id[clear], face_id[clear])
    np.testing.assert_allclose(got.depth[clear], depth[clear], rtol=1e-6)


def test_pixel_centres_are_at_halves():
    """A square whose sides run between the centres of columns 2|3 and 5|6, rows 1|2 and 3|4."""
    corners = np.array([[3.0, 2, 1], [6, 2, 1], [6, 4, 1], [3, 4, 1]])
    view = Camera("c", 8, 6, "PINHOLE", (1.0, 1.0, 0.0, 0.0), np.eye(4))
    got = rasterize(corners, np.array([[0, 1, 2], [0, 2, 3]]), view)
    expected = np.zeros((6, 8), bool)
    expected[2:4, 3:6] = True
    np.testing.assert_array_equal(got.face_id >= 0, expected)
    np.testing.assert_array_equal(got.depth, expected.astype(np.float32))


def test_the_lower_face_wins_ties_in_any_order_and_no_centre_on_an_edge_is_lost():
    # the diagonal of the square runs through pixel centres
    corners = np.array([[0.0, 0, 1], [8, 0, 1], [8, 8, 1], [0, 8, 1]])
    view = Camera("c", 8, 8, "PINHOLE", (1.0, 1.0, 0.0, 0.0), np.eye(4))
    for faces in (
        [[0, 1, 2], [0, 2, 3]],
        [[0, 2, 3], [0, 1, 2]],
        [[0, 1, 2], [0, 1, 2], [2, 3, 0]],
    ):
        got = rasterize(corners, np.array(faces), view)
        assert (got.face_id >= 0).all()
        assert (np.diagonal(got.face_id) == 0).all()
        assert not (got.face_id == 1).any() or len(faces) == 2


def test_faces_are_culled_by_their_winding():
    vertices, faces = sphere(8)
    inside = rasterize(vertices, faces, camera(32, 32, 20.0), cull=True)
    assert (inside.face_id < 0).all()
    assert (rasterize(vertices, faces, camera(32, 32, 20.0)).face_id >= 0).all()
    outside = vertices + [0, 0, 3.0]
    seen = [rasterize(outside, faces, camera(32, 32, 40.0), cull=c).face_id for c in (False, True)]
    np.testing.assert_array_equal(*seen)
    assert (seen[0] >= 0).mean() > 0.3


def test_views_in_threads_give_the_same_bytes(head):
    views = [head_camera(128, angle) for angle in np.linspace(0, 6, 8)]
    neighbors = face_neighbors(head[1])
    serial = [rasterize(*head, view, neighbors=neighbors) for view in views]
    with ThreadPoolExecutor(4) as pool:
        threads = list(pool.map(lambda view: rasterize(*head, view, neighbors=neighbors), views))
    for a, b in zip(serial, threads, strict=True):
        assert a.face_id.tobytes() == b.face_id.tobytes()
        assert a.depth.tobytes() == b.depth.tobytes()
        assert a.pairs.tobytes() == b.pairs.tobytes()


def test_outlines_of_a_sphere_are_its_circle():
    vertices, faces = sphere(60)
    view = Camera("c", 200, 200, "PINHOLE", (180.0, 180.0, 100.0, 100.0), np.eye(4))
    raster = rasterize(vertices + [0, 0, 3.0], faces, view)
    covered = (raster.face_id >= 0).reshape(-1)
    near, far = raster.pairs[:, 0], raster.pairs[:, 1]
    assert covered[near].all() and not covered[far].any()
    # tangent rays: sin = 1/3; each piece counts along one axis: 8 r / sqrt(2) crossings
    radius = 180 * np.tan(np.arcsin(1 / 3))
    assert len(near) == pytest.approx(8 * radius / np.sqrt(2), rel=0.02)
    centre = np.stack([near % 200 + 0.5, near // 200 + 0.5], 1) - 100
    assert np.abs(np.linalg.norm(centre, axis=1) - radius).max() < 1.5


def test_outlines_before_a_surface_are_found_and_seams_of_faces_are_not():
    vertices, faces = sphere(20)
    count = len(vertices)
    wall = np.array([[-9.0, -9, 5], [9, -9, 5], [9, 9, 5], [-9, 9, 5]])
    both = np.concatenate([vertices + [0, 0, 3.0], wall])
    index = np.concatenate([faces, [[count, count + 2, count + 1], [count, count + 3, count + 2]]])
    raster = rasterize(both, index, camera(100, 100, 90.0))
    ids = raster.face_id.reshape(-1)[raster.pairs[:, :2]]
    assert len(ids) > 100 and (raster.face_id >= 0).all()
    assert (ids[:, 0] < len(faces)).all() and (ids[:, 1] >= len(faces)).all()


def test_neighbors_meet_in_an_edge():
    _, faces = sphere(6)
    neighbors = face_neighbors(faces)
    assert (neighbors >= 0).all()
    for corner in range(3):
        edge = faces[:, [(corner + 1) % 3, (corner + 2) % 3]]
        other = faces[neighbors[:, corner]]
        assert (other[:, :, None] == edge[:, None, :]).any(1).all()
    three = face_neighbors(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert (three == -1).all()
    assert face_neighbors(np.zeros((0, 3), int)).shape == (0, 3)
    np.testing.assert_array_equal(face_neighbors(np.array([[0, 1, 2]])), [[-1, -1, -1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.full((3, 3), np.nan)}, "9 values that are not finite"),
        ({"vertices": np.zeros((3, 2))}, r"vertices has shape \(3, 2\), expected \(any, 3\)"),
        ({"faces": np.array([[0, 1, 3]])}, r"ids 0..3, expected 0..2"),
        ({"faces": np.array([[0, 1, -1]])}, r"ids -1..1, expected 0..2"),
        ({"faces": np.array([[0.0, 1, 2]])}, "faces are float64, expected whole numbers"),
        ({"neighbors": np.array([[0, 1, -1]])}, "neighbors hold ids -1..1, expected -1..0"),
        ({"camera": camera(4, 4, 4.0, np.full((4, 4), np.nan))}, "vertices in camera space has 9"),
        ({"near": 0.0}, "expected metres above 0"),
        ({"backend": "gpu"}, "backend is 'gpu', expected auto, native"),
        ({"neighbors": np.zeros((2, 3), int)}, r"neighbors has shape \(2, 3\)"),
        ({"camera": Camera("c7", 4, 4, "SIMPLE_RADIAL", (4.0, 2, 2, 0.1), np.eye(4))}, "'c7' has"),
    ],
)
def test_bad_input_is_one_clear_error(change, message):
    arguments = {
        "vertices": np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]),
        "faces": np.array([[0, 1, 2]]),
        "camera": camera(4, 4, 4.0),
    }
    with pytest.raises(ValueError, match=message) as caught:
        rasterize(**(arguments | change))
    assert "\n" not in str(caught.value)


def test_without_the_library_rays_are_cast_and_it_says_so(monkeypatch):
    vertices, faces = sphere(8)
    view = camera(64, 48, 40.0)
    vertices = vertices + [0, 0, 3.0]
    expected = rasterize(vertices, faces, view)
    monkeypatch.setattr(native, "why_missing", lambda: "the native library was not built; build it")
    with pytest.warns(UserWarning, match="slowly and without outlines: the native library"):
        got = rasterize(vertices, faces, view)
    assert got.pairs is None
    assert (got.face_id != expected.face_id).mean() < 2e-3


def test_nvdiffrast_is_asked_with_its_own_signature(monkeypatch):
    """On a stand-in that draws clip-space triangles on the CPU; the real one was not at hand."""
    vertices, faces = sphere(8)
    vertices, view = vertices + [0.1, 0, 3.0], camera(64, 48, 40.0)
    expected = rasterize(vertices, faces, view, cull=True)
    with pytest.raises(ValueError, match="needs the package nvdiffrast and a CUDA device"):
        rasterize(vertices, faces, view, backend="nvdiffrast")

    def draw(context, pos, tri, resolution):
        """Divide by w, map y = -1 to the first row, and look along z, as nvdiffrast does."""
        height, width = resolution
        ndc = (pos[0, :, :3] / pos[0, :, 3:]).double().numpy()
        assert (np.abs(ndc[:, 2]) < 1).all()
        # parallel rays along z are a pinhole camera's far away
        flat = np.stack([(ndc[:, 0] + 1) / 2 * width, (ndc[:, 1] + 1) / 2 * height], 1)
        far = 1e7
        place = np.concatenate([flat * (far + ndc[:, 2:]) / far, far + ndc[:, 2:]], 1)
        lens = Camera("", width, height, "PINHOLE", (far, far, 0.0, 0.0), np.eye(4))
        seen = rasterize(place, tri.numpy(), lens, pairs=False).face_id
        out = torch.zeros(1, height, width, 4)
        out[0, ..., 3] = torch.from_numpy(seen + 1)
        return out, None

    package, module = types.ModuleType("nvdiffrast"), types.ModuleType("nvdiffrast.torch")
    package.torch, module.rasterize, module.RasterizeCudaContext = package, draw, lambda: None
    package.torch = module
    monkeypatch.setitem(sys.modules, "nvdiffrast", package)
    monkeypatch.setitem(sys.modules, "nvdiffrast.torch", module)
    monkeypatch.setattr(mesh_backends.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self: self)
    got = rasterize(vertices, faces, view, cull=True, backend="nvdiffrast")
    covered = (expected.face_id >= 0).sum()
    same = got.face_id == expected.face_id
    assert (~same).sum() < 0.02 * covered and covered > 100
    assert np.abs(got.depth - expected.depth)[same].max() < 1e-5
    assert abs(len(got.pairs) - len(expected.pairs)) <= 2
