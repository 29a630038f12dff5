"""Scans at the extremes: any axes, turned and mirrored triangles, holes, no mesh, odd landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from express50.errors import FormatError, StageError
from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_builtin
from express50.head.model import landmarks, landmarks_of, pose
from pipelines.register.scan import find_landmarks
from pipelines.register.scan_input import GREY, UNITS, Scan, check_face, read_scan

NONE = np.full((68, 3), np.nan)


@pytest.fixture(scope="module")
def head():
    """The mean head as a scan, its landmarks, and the middles of its triangles."""
    model = load_builtin()
    vertices, faces = model.template.double().numpy(), model.faces.numpy()
    marks = landmarks_of(model).astype(np.float64)
    scan = Scan(vertices, faces, np.full((len(vertices), 3), GREY), "metres", False)
    return scan, marks, vertices[faces].mean(1)


def turned(scan: Scan, R: np.ndarray) -> Scan:
    return replace(scan, vertices=scan.vertices @ R.T)


def off_mm(found, marks: np.ndarray) -> float:
    return 1e3 * float(np.nanmedian(np.linalg.norm(found.points - marks, axis=1)))


@pytest.mark.parametrize(
    "turn",
    [(np.pi / 2, 0, 0), (np.pi / 2**0.5, 0, -np.pi / 2**0.5)],
    ids=["z up", "upside down and turned to a side"],
)
def test_a_face_is_found_in_any_axes(head, turn):
    scan, marks, _ = head
    R = axis_angle_to_matrix(np.array(turn))
    assert off_mm(find_landmarks(turned(scan, R), marks, NONE), marks @ R.T) < 5


def test_holes_a_missing_half_and_doubled_triangles_do_no_harm(head):
    scan, marks, middles = head
    rng = np.random.default_rng(0)
    hole = np.linalg.norm(middles - marks[2] - [0.01, 0.01, 0.02], axis=1) < 0.02
    back = middles[:, 2] < marks[8, 2] - 0.07
    kept = scan.faces[~hole & ~back]
    kept = np.concatenate(
        [kept, kept[:500, ::-1], kept[rng.integers(0, len(kept), 500), :1][:, [0] * 3]]
    )
    assert off_mm(find_landmarks(replace(scan, faces=kept), marks, NONE), marks) < 5


@pytest.mark.parametrize(
    ("axes", "order"), [((1, 1, 1), -1), ((-1, 1, 1), 1), ((1, 1, -1), 1)],
    ids=["inside out", "mirrored", "handedness"],
)  # fmt: skip
def test_inside_out_and_mirrored_scans_are_refused(head, axes, order):
    scan, marks, _ = head
    wrong = replace(
        scan,
        vertices=scan.vertices * np.array(axes, float),
        faces=np.ascontiguousarray(scan.faces[:, ::order]),
    )
    with pytest.raises(StageError, match="inside out, or mirrored"):
        find_landmarks(wrong, marks, NONE)
    with pytest.raises(StageError, match="mirrored"):
        find_landmarks(wrong, marks, marks * axes)


def test_a_mask_that_is_inside_out_is_refused(head):
    scan, marks, middles = head
    mask = scan.faces[middles[:, 2] > marks[8, 2] - 0.06]
    with pytest.raises(StageError, match="mirrored"):
        hollow = replace(scan, faces=np.ascontiguousarray(mask[:, ::-1]))
        check_face(find_landmarks(hollow, marks, NONE).points, marks, "seen")


def test_few_landmarks_say_where_to_look_and_replace_what_is_found(head):
    scan, marks, _ = head
    few, ids = NONE.copy(), [30, 36, 45, 48, 54]
    few[ids] = marks[ids]
    found = find_landmarks(scan, marks, few)
    np.testing.assert_array_equal(found.points[ids], marks[ids])
    assert not found.inliers[:, ids].any() and off_mm(found, marks) < 5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m * [-1, 1, 1], "mirrored"),
        (lambda m: 1e3 * m, "1e\\+03 times"),
        (lambda m: 0 * m, "0 times"),
        (lambda m: np.where(np.isin(np.arange(68), [36, 39, 42, 45])[:, None], m, np.nan), "line"),
        (lambda m: np.where(np.arange(68)[:, None] == 30, m, np.nan), "1 points"),
        (lambda m: NONE, "0 points"),
        (lambda m: np.roll(m, 1, 0), "in order"),
    ],
)
def test_points_that_do_not_form_a_face_are_refused(head, change, words):
    with pytest.raises(StageError, match=words):
        check_face(change(head[1]), head[1], "landmarks")


def test_a_mouth_that_is_wide_open_is_a_face(head):
    model = load_builtin()
    none = torch.zeros(1, 0)
    mesh = pose(model, none, none, jaw=torch.tensor([[0.6, 0.0, 0.0]]))
    check_face(landmarks(model, mesh)[0].double().numpy(), head[1], "seen")


def test_landmarks_far_off_the_scan_are_refused(head):
    scan, marks, _ = head
    with pytest.raises(StageError, match="off the scan"):
        find_landmarks(scan, marks, marks + [0.0, 0.0, 0.05])


@pytest.mark.parametrize("unit", [*UNITS, "kilometres", "decimetres"])
def test_units_are_told_apart(head, tmp_path, unit):
    scan, path = head[0], tmp_path / "scan.ply"
    size = UNITS.get(unit) or {"kilometres": 1e3, "decimetres": 0.1}[unit]
    trimesh.Trimesh(scan.vertices / size, scan.faces, process=False).export(path)
    if unit in UNITS:
        found = read_scan(path)
        assert found.unit == unit
        assert np.ptp(found.vertices, 0).max() == pytest.approx(
            np.ptp(scan.vertices, 0).max(), 1e-3
        )
    else:
        with pytest.raises(FormatError, match=unit):
            read_scan(path)


@pytest.mark.parametrize("kind", ["obj", "ply", "glb", "stl"])
@pytest.mark.parametrize("content", [b"", b"not a mesh\n" * 20])
def test_files_without_a_mesh_are_refused(tmp_path, kind, content):
    path = tmp_path / f"scan.{kind}"
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read_scan(path)
    assert len(str(caught.value).splitlines()) == 1


def test_points_without_triangles_are_refused(head, tmp_path):
    trimesh.PointCloud(head[0].vertices).export(tmp_path / "points.ply")
    with pytest.raises(FormatError, match="triangle mesh"):
        read_scan(tmp_path / "points.ply")
