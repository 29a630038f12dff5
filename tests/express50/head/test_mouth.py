"""Teeth and mouth on FLAME's topology: on a stand-in of FLAME's size, ids and lips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
from scipy.ndimage import binary_dilation

from express50.dataset.export import Head
from express50.dataset.export_avatar import write_parameters
from express50.dataset.tracks import read_track
from express50.errors import HeadModelError
from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms import rigid_fit
from express50.head.flame import load_flame, read_flame
from express50.head.load import BUILTIN, load_head
from express50.head.model import HeadModel, landmarks, pose, vertex_normals
from express50.head.mouth import (
    CORNERS,
    LOWER_RING,
    UPPER_RING,
    add_mouth,
    mouth_loop,
    place_charts,
)
from tests.express50.dataset.tracked import track_arrays, write_track
from tests.express50.head.flame_head import MOUTH, write_flame_size
from tests.express50.head.flame_reader import flame_vertices

OLD, TEETH, POUCH = slice(0, 5023), slice(5023, 5143), slice(5143, 5208)
UPPER_ROWS, LOWER_ROWS, EDGE_ROWS = (0, 2, 4, 5), (1, 3, 6, 7), (2, 3, 5, 7)


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return write_flame_size(tmp_path_factory.mktemp("flame_size"))


@pytest.fixture(scope="module")
def bare(path) -> HeadModel:
    return read_flame(path)


@pytest.fixture(scope="module")
def model(path) -> HeadModel:
    return load_flame(path)


def rows_of(vertices: torch.Tensor, rows: tuple[int, ...]) -> np.ndarray:
    """Tooth vertices (N, 3) of some of the eight rows."""
    return vertices[TEETH].reshape(8, 15, 3)[list(rows)].reshape(-1, 3).numpy()


def test_what_was_there_stays_and_counts_are_known(model, bare) -> None:
    assert (len(bare.template), len(bare.faces)) == (5023, 9976)
    assert (len(model.template), len(model.faces)) == (5208, 9976 + 168 + 160)
    for name in ("template", "shape_dirs", "expression_dirs", "skinning"):
        assert torch.equal(getattr(model, name)[OLD], getattr(bare, name))
    assert torch.equal(model.faces[:9976], bare.faces)
    assert torch.equal(model.uv_faces[:9976], bare.uv_faces)
    assert torch.equal(model.joint_regressor[:, OLD], bare.joint_regressor)
    assert not model.joint_regressor[:, 5023:].any()
    shape, expression, angle = torch.randn(2, 5), torch.randn(2, 3), 0.2 * torch.randn(2, 3)
    one, other = (pose(m, shape, expression, neck=angle, jaw=angle) for m in (model, bare))
    torch.testing.assert_close(one[:, OLD], other)
    torch.testing.assert_close(landmarks(model, one), landmarks(bare, other))


def test_regions_name_the_teeth_and_the_pouch(model) -> None:
    numbers = {name: torch.nonzero(model.regions[name])[:, 0] - 5023 for name in
               ("upper_teeth", "lower_teeth", "teeth", "mouth_interior")}  # fmt: skip
    assert numbers["teeth"].tolist() == list(range(120))
    assert numbers["mouth_interior"].tolist() == list(range(120, 185))
    assert set((numbers["upper_teeth"] // 15).tolist()) == set(UPPER_ROWS)
    assert set((numbers["lower_teeth"] // 15).tolist()) == set(LOWER_ROWS)
    others = [m for n, m in model.regions.items() if n not in numbers]
    assert not any(bool(mask[5023:].any()) for mask in others)


def test_teeth_stand_where_readers_of_the_layout_put_them(model) -> None:
    """Distances of the layout: 1.5 ring distances behind the lips, 2 high, 1 thick, 0.4 overjet."""
    upper, lower = (
        model.template[list(ring)].double().numpy() for ring in (UPPER_RING, LOWER_RING)
    )
    unit = np.linalg.norm(upper - lower, axis=1).mean()
    assert 0.006 < unit < 0.009
    rows = model.template[TEETH].double().numpy().reshape(8, 15, 3)
    middle = (upper + lower) / 2
    for row in rows:
        np.testing.assert_allclose(row[:, 0], middle[:, 0], atol=1e-7)
    level, behind = middle[:, 1].mean(), middle[:, 2:]
    heights = [2.1, -2.1, 0.1, -0.1, 2.1, 0.1, -2.1, -0.1]
    depths = [1.5, 1.9, 1.5, 1.9, 2.5, 2.5, 2.9, 2.9]
    for row, height, depth in zip(rows, heights, depths, strict=True):
        np.testing.assert_allclose(row[:, 1], level + height * unit, atol=1e-7)
        np.testing.assert_allclose(row[:, 2:], behind - depth * unit, atol=1e-7)


@pytest.mark.parametrize("angle", [0.1, 0.35, -0.05])
def test_lower_teeth_move_rigidly_with_the_jaw_and_upper_teeth_stay(model, angle) -> None:
    model = model.to(dtype=torch.float64)
    zero, jaw = torch.zeros(1, 1, dtype=torch.float64), torch.tensor([[angle, 0, 0.0]]).double()
    shut, wide = pose(model, zero, zero)[0], pose(model, zero, zero, jaw=jaw)[0]
    np.testing.assert_allclose(rows_of(wide, UPPER_ROWS), rows_of(shut, UPPER_ROWS), atol=1e-12)
    before, after = rows_of(shut, LOWER_ROWS), rows_of(wide, LOWER_ROWS)
    R, t = rigid_fit(before, after)
    np.testing.assert_allclose(before @ R.T + t, after, atol=1e-12)
    turn = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    np.testing.assert_allclose(R, turn, atol=1e-9)
    # The pouch hangs on the loop: its floor goes with the jaw, its roof does not.
    loop = mouth_loop(model.faces[:9976].numpy(), "head")
    moved, led = (wide - shut)[POUCH][:32], (wide - shut)[loop]
    np.testing.assert_allclose(moved.norm(dim=1), led.norm(dim=1), atol=0.012 * abs(angle) + 1e-4)


def test_the_whole_mouth_turns_with_the_neck(model) -> None:
    model = model.to(dtype=torch.float64)
    zero = torch.zeros(1, 1, dtype=torch.float64)
    turned = pose(model, zero, zero, neck=torch.tensor([[0.2, -0.3, 0.1]]).double())[0, TEETH]
    still = pose(model, zero, zero)[0, TEETH]
    R, t = rigid_fit(still.numpy(), turned.numpy())
    np.testing.assert_allclose(still.numpy() @ R.T + t, turned.numpy(), atol=1e-12)


def test_bases_of_the_teeth(model) -> None:
    assert not model.expression_dirs[TEETH].any()
    assert not model.pose_dirs.reshape(36, -1, 3)[:, TEETH].any()
    rings = model.shape_dirs[torch.tensor([UPPER_RING, LOWER_RING])].mean(0)
    torch.testing.assert_close(model.shape_dirs[TEETH], rings.repeat(8, 1, 1))
    torch.testing.assert_close(model.skinning.sum(1), torch.ones(5208))
    loop = mouth_loop(model.faces[:9976].numpy(), "head")
    torch.testing.assert_close(model.expression_dirs[POUCH][:32], model.expression_dirs[loop])


def boundary_edges(faces: np.ndarray) -> set[tuple[int, int]]:
    """Directed edges without an opposite; every directed edge may occur once."""
    edges = [tuple(edge) for edge in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()]
    known = set(edges)
    assert len(edges) == len(known)
    return {(a, b) for a, b in edges if (b, a) not in known}


def test_faces_are_wound_alike_and_the_loop_is_closed(model, bare) -> None:
    before, after = (boundary_edges(m.faces.numpy()) for m in (bare, model))
    assert len(before) == 32 + 30
    left = {e for e in after if max(e) < 5023}
    assert len(left) == 30 and CORNERS[0] not in {v for e in left for v in e}
    # Each jaw is a strip of 4 by 15 vertices, open at its roots and ends.
    assert len(after) - len(left) == 2 * (2 * 14 + 2 * 3)


def test_faces_of_the_mouth_look_outwards(model) -> None:
    vertices = model.template.double().numpy()
    faces = model.faces[9976:].numpy()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for teeth, rows in ((faces[:84], (0, 1)), (faces[84:168], (1, -1))):
        number = (teeth - 5023) // 15
        back = np.isin(number, (4, 5, 6, 7)).all(1)
        front = np.isin(number, (0, 1, 2, 3)).all(1)
        edge = ~back & ~front
        own = normals[:84] if rows[0] == 0 else normals[84:168]
        assert front.sum() == back.sum() == edge.sum() == 28
        assert (own[front, 2] > 0).all() and (own[back, 2] < 0).all()
        assert (own[edge, 1] < 0).all() if rows[0] == 0 else (own[edge, 1] > 0).all()
    # The pouch is seen from within: from the middle of the loop every face turns its front.
    eye = vertices[mouth_loop(model.faces[:9976].numpy(), "head")].mean(0) - [0, 0, 0.004]
    inside = ((eye - corners[168:].mean(1)) * normals[168:]).sum(1)
    assert (inside > 0).all()


def test_teeth_stay_behind_closed_lips(model) -> None:
    """Edges stand free but for the last column at each corner; roots are in the gums."""
    vertices, faces = model.template.numpy(), model.faces.numpy()
    tooth = model.regions["teeth"].numpy()
    scene = mesh_scene(vertices, faces[~tooth[faces].any(1)])

    def tensor(array: np.ndarray) -> o3d.core.Tensor:
        return o3d.core.Tensor(np.ascontiguousarray(array, np.float32))

    points = vertices[tooth] + np.array([2e-5, 1e-5, 0])
    ahead = np.tile([0, 0, 1.0], (120, 1))
    above = np.concatenate([points[:, :2], np.full((120, 1), 0.3), -ahead], 1)
    skin = 0.3 - scene.cast_rays(tensor(above))["t_hit"].numpy()
    assert (skin - points[:, 2]).min() > 0.005  # metres behind what is seen from before
    hits = scene.count_intersections(tensor(np.concatenate([points, ahead], 1))).numpy()
    in_flesh = (hits % 2 == 1).reshape(8, 15)
    assert not in_flesh[list(EDGE_ROWS), 1:-1].any()
    assert in_flesh[[0, 1, 4, 6]].all()
    depth = scene.compute_distance(tensor(points)).numpy().reshape(8, 15)
    assert (depth[list(EDGE_ROWS)][in_flesh[list(EDGE_ROWS)]] < 0.001).all()


def doubled_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed areas (...) of flat triangles with corners (..., 2)."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def covered(uv: np.ndarray, faces: np.ndarray, size: int = 700) -> np.ndarray:
    """How many triangles hold each texel's centre (size, size)."""
    count = np.zeros((size, size), int)
    for a, b, c in uv[faces] * size:
        low = np.floor(np.minimum(np.minimum(a, b), c)).astype(int).clip(0)
        high = np.ceil(np.maximum(np.maximum(a, b), c)).astype(int).clip(0, size)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        area = doubled_area(a, b, c)
        if abs(area) < 1e-12 or not x.size:
            continue
        p = np.stack([x, y], -1)
        inside = np.ones(x.shape, bool)
        for s, e in ((a, b), (b, c), (c, a)):
            way = (e[0] - s[0]) * (p[..., 1] - s[1]) - (e[1] - s[1]) * (p[..., 0] - s[0])
            inside &= way * np.sign(area) > 1e-9
        count[low[1] : high[1], low[0] : high[0]] += inside
    return count


def test_charts_overlap_neither_each_other_nor_the_heads(model) -> None:
    uv, faces = model.uv.double().numpy(), model.uv_faces.numpy()
    parts = {"head": faces[:9976], "upper": faces[9976:10060], "lower": faces[10060:10144],
             "pouch": faces[10144:]}  # fmt: skip
    maps = {name: covered(uv, part) for name, part in parts.items()}
    for name, least in (("upper", 0.01), ("lower", 0.01), ("pouch", 0.015)):
        assert maps[name].max() == 1  # no two of its own triangles
        assert (maps[name] > 0).mean() > least
    together = sum((one > 0).astype(int) for one in maps.values())
    assert together.max() == 1
    near = binary_dilation(maps["head"] > 0, iterations=3)
    assert not (near & (sum(maps[n] for n in ("upper", "lower", "pouch")) > 0)).any()
    corner = uv[faces]
    area = doubled_area(*np.moveaxis(corner, 1, 0))
    assert (area[9976:] > 0).all() and (uv >= 0).all() and (uv <= 1).all()


@pytest.mark.parametrize(("components", "shapes"), [(8, 6), (40, 30), (330, 300)])
def test_any_number_of_coefficients(tmp_path, components, shapes) -> None:
    model = load_flame(write_flame_size(tmp_path, components))
    assert model.shape_dirs.shape == (5208, 3, shapes)
    assert model.expression_dirs.shape == (5208, 3, components - shapes)
    assert not model.expression_dirs[TEETH].any()


def test_rings_may_run_from_either_side(bare) -> None:
    """Ids say the order of columns, not the side they start on: a mirrored head is wound right."""
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    model = add_mouth(replace(bare, template=bare.template * mirror, faces=bare.faces.flip(1),
                              uv_faces=bare.uv_faces.flip(1)))  # fmt: skip
    vertices, front = model.template.numpy(), model.faces[9976 : 9976 + 28].numpy()
    corners = vertices[front]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    number = (front - 5023) // 15
    assert (normals[np.isin(number, (0, 2)).all(1), 2] > 0).all()


def square(left: float, bottom: float, right: float, top: float) -> tuple[np.ndarray, np.ndarray]:
    uv = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    return uv, np.array([[0, 1, 2], [0, 2, 3]])


def test_room_is_found_where_there_is_any() -> None:
    uv, faces = square(0.0, 0.0, 1.0, 0.8)
    boxes = place_charts(uv, faces, ((0.3, 0.1), (0.3, 0.1), (0.5, 0.5)), "head")
    for k, (left, bottom, right, top) in enumerate(boxes):
        assert 0.8 < bottom < top <= 1 and 0 <= left < right <= 1
        for other in boxes[:k]:
            assert left >= other[2] or right <= other[0] or bottom >= other[3] or top <= other[1]
    np.testing.assert_allclose(boxes[0][2:] - boxes[0][:2], (0.3, 0.1), atol=2 / 512)
    assert 0.05 < boxes[2][3] - boxes[2][1] < 0.2
    uv, faces = square(0.0, 0.0, 1.0, 1.0)
    with pytest.raises(HeadModelError, match="no room for a mouth"):
        place_charts(uv, faces, ((0.1, 0.1),), "full")


def test_the_lips_of_the_stand_in_are_those_of_a_face(bare) -> None:
    ring = bare.template[list(UPPER_RING + LOWER_RING)].numpy()
    assert np.abs(ring - MOUTH).max(0)[0] < 0.03 and np.ptp(ring[:, 1]) < 0.02


def test_a_head_of_ones_own_is_not_flame_whatever_its_name(tmp_path) -> None:
    path = tmp_path / "flame-mine.npz"
    path.write_bytes(BUILTIN.read_bytes())
    track = read_track(write_track(tmp_path / "track.npz", track_arrays(path)))
    head = Head(subject="S001", track=track, model=load_head(path), albedo=None)
    write_parameters(head, ["neutral"], np.zeros(3), tmp_path)
    assert (tmp_path / "meshes/00000.obj").is_file()


def test_readers_of_the_layout_get_5143_vertices(path, model, tmp_path) -> None:
    arrays = track_arrays(path, turn=0.5)
    track = read_track(write_track(tmp_path / "track.npz", arrays))
    head = Head(subject="S001", track=track, model=model, albedo=None)
    write_parameters(head, list(track.expressions), np.zeros(3), tmp_path)
    with np.load(tmp_path / "flame_param/00001.npz") as stored:
        assert stored["static_offset"].shape == (1, 5143, 3)
        assert stored["shape"].shape == (300,) and stored["expr"].shape == (1, 100)
        found = flame_vertices(model, dict(stored))
    np.testing.assert_allclose(found[:5143], arrays["vertices"][1, :5143], atol=5e-6)


@pytest.mark.parametrize("scale", [1e3, 1e-3, 0.0])
def test_heads_in_other_units_are_named(bare, scale) -> None:
    with pytest.raises(HeadModelError, match="rings are .* mm apart, expected 2 to 30") as caught:
        add_mouth(replace(bare, template=bare.template * scale))
    assert "\n" not in str(caught.value)


def test_vertices_in_another_order_are_named(bare) -> None:
    """5023 vertices of something else: the ids mean nothing there."""
    order = torch.from_numpy(np.random.default_rng(0).permutation(5023))
    with pytest.raises(HeadModelError, match="rings are .* mm apart|no open loop"):
        add_mouth(replace(bare, template=bare.template[order]))
    cut = replace(bare, faces=bare.faces[4000:], uv_faces=bare.uv_faces[4000:])
    with pytest.raises(HeadModelError, match="no open loop of 32 vertices"):
        add_mouth(cut)


@pytest.mark.parametrize("deviations", [-6.0, 6.0])
def test_far_identities_and_wide_jaws_stay_finite(model, deviations) -> None:
    shape = torch.full((1, model.shape_dirs.shape[2]), deviations)
    expression = torch.full((1, model.expression_dirs.shape[2]), deviations)
    jaw = torch.tensor([[np.pi, 0.0, 0.0]], dtype=torch.float32)
    vertices = pose(model, shape, expression, jaw=jaw)
    assert torch.isfinite(vertices).all()
    assert torch.isfinite(vertex_normals(vertices, model.faces)).all()
