"""Scans: any pose and unit, landmarks, what is written, and what is skipped or refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from express50.__main__ import main
from express50.dataset.tracks import read_registration, read_track
from express50.errors import FormatError
from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import landmarks, pose
from pipelines.register.scan_input import landmarks_beside, read_landmarks


@pytest.fixture(scope="module")
def person():
    """A person of the built-in head: skin alone, as a scanner would see it; and all vertices."""
    model = load_head("procedural")
    shape = 0.7 * np.random.default_rng(5).normal(size=(1, model.shape_dirs.shape[2]))
    vertices = pose(model, torch.from_numpy(shape).float(), torch.zeros(1, 0))[0].double().numpy()
    hidden = ("mouth_interior", "teeth", "tongue", "gums")
    inside = np.any([model.regions[name].numpy() for name in hidden], axis=0)
    faces = model.faces.numpy()
    return vertices, faces[~inside[faces].any(1)]


def write_scan(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


def marks_of(vertices: np.ndarray) -> np.ndarray:
    return landmarks(load_head("procedural"), torch.from_numpy(vertices)[None].float())[0].numpy()


def rows_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "index.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def run(*arguments: object) -> int:
    return main(["register", *map(str, arguments)])


@pytest.mark.slow
def test_a_turned_scan_in_millimetres_becomes_parameters_and_a_mesh(person, tmp_path, capsys):
    vertices, faces = person
    R, t = axis_angle_to_matrix(2.5 * np.array([0.5, -0.6, 0.6])), np.array([3.0, -2.0, 1.0])
    placed = vertices @ R.T + t
    scan = write_scan(tmp_path / "person.obj", 1e3 * placed, faces)
    out = tmp_path / "out"
    assert run(out, "--scan", scan, "--json") == 0
    (account,) = json.loads(capsys.readouterr().out)
    assert account["unit"] == "millimetres"
    assert account["registered_mm_median"] < 0.05 and account["seen_share"] > 0.6
    assert account["registered_mm_median"] < 0.2 * account["parameters_mm_median"]
    track = read_track(out / "person" / "track.npz")
    found = read_registration(out / "person" / "registration.npz")
    face = load_head("procedural").regions["face"].numpy()
    off = 1e3 * np.linalg.norm(found.vertices - placed, axis=1)[face]
    assert np.median(off) < 2.5  # vertex to vertex: correspondence, not distance to the surface
    assert track.expressions == ("scan",)
    mesh = trimesh.load(out / "person" / "head.obj", process=False)
    assert np.abs(mesh.bounds.mean(0) / 1e3 - found.vertices.mean(0)).max() < 0.1
    assert (out / "person" / "qc" / "registration.jpg").is_file()
    made = (out / "person" / "track.npz").stat().st_mtime_ns
    assert run(out, "--scan", scan, "--json") == 0  # current
    assert json.loads(capsys.readouterr().out)[0]["skipped"]
    assert (out / "person" / "track.npz").stat().st_mtime_ns == made


def test_a_bad_scan_does_not_stop_the_others_and_is_one_line(person, tmp_path, capsys):
    vertices, faces = person
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "damaged.ply").write_bytes(b"ply\nformat binary")
    write_scan(folder / "kilometres.obj", 1e-3 * vertices, faces)
    write_scan(folder / "triangle.ply", vertices, faces[:1])
    with_nan = vertices.copy()
    with_nan[faces[0, 0], 1] = np.nan
    write_scan(folder / "nan.ply", with_nan, faces)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    ball.export(folder / "ball.stl")
    (folder / "notes.txt").write_text("no scan")
    (folder / "my scan.ply").touch()
    (folder / "nan.stl").touch()  # a second scan of this name
    assert run(tmp_path / "out", "--scan", folder) == 1
    *lines, last = capsys.readouterr().out.strip().splitlines()
    names = ["ball", "damaged", "kilometres", "my scan.ply", "nan", "nan.stl", "triangle"]
    assert [line.split(":")[0] for line in lines] == names
    assert "in kilometres" in lines[2] and "7 failed" in last
    assert "rename the file" in lines[3] and "rename the file" in lines[5]
    assert [path.name for path in (tmp_path / "out").glob("[!.]*")] == ["index.csv"]
    rows = rows_of(tmp_path / "out")
    assert list(rows) == names and all(row["error"] and not row["mesh"] for row in rows.values())
    (folder / "my scan.ply").unlink()
    run(tmp_path / "out", "--scan", folder / "triangle.ply")
    assert "my scan.ply" not in rows_of(tmp_path / "out")


@pytest.mark.slow
def test_a_folder_with_landmarks_becomes_a_data_set(person, tmp_path, capsys):
    vertices, faces = person
    folder, out = tmp_path / "scans", tmp_path / "out"
    folder.mkdir()
    placed = 100 * vertices @ [[1.0, 0, 0], [0, 0, -1], [0, -1, 0]]  # upside down, y up to z down
    write_scan(folder / "good.ply", placed @ np.diag([-1.0, 1, 1]), faces)
    np.savetxt(folder / "good.txt", 100 * marks_of(vertices) @ [[-1, 0, 0], [0, 0, -1], [0, -1, 0]])
    write_scan(folder / "off.ply", vertices, faces)
    (folder / "off.csv").write_text(
        "chin,0,0,3\n" + "nose_tip,0,0,0\nnasion,0,0,1\nupper_lip,1,0,0"
    )
    assert run(out, "--scan", folder) == 1
    rows = rows_of(out)
    good, off = rows["good"], rows["off"]
    assert (good["unit"], good["metres_per_unit"], good["landmarks"]) == (
        "centimetres",
        "0.01",
        "68",
    )
    assert float(good["registered_mm_median"]) < 0.05 < float(good["registered_mm_p95"]) + 0.05
    assert (out / good["mesh"]).is_file() and (out / good["parameters"]).is_file()
    metrics = json.loads((out / "good" / "metrics.json").read_text())
    assert metrics["landmarks_mm_median"] < 0.8  # the detector's are 3 mm off
    assert good["error"] == good["warnings"] == "" and "off the scan" in off["error"]
    capsys.readouterr()
    assert run(out, "--scan", folder / "good.ply") == 0
    assert "good: current" in capsys.readouterr().out
    assert rows_of(out) == rows  # rows of other runs stay
    (folder / "good.txt").write_text("0 0 0\n")
    assert run(out, "--scan", folder / "good.ply") == 1  # other landmarks are another input
    assert "1 points without names" in rows_of(out)["good"]["error"]


def test_landmarks_are_read_in_any_layout(tmp_path):
    points = np.random.default_rng(0).normal(size=(68, 3)).round(3)
    rows, inner = points.tolist(), points.copy()
    inner[:17] = np.nan
    named = {"Nose tip": rows[30], "36": rows[36], "left-eye outer": rows[45], "chin": rows[8]}
    few = np.full((68, 3), np.nan)
    few[[8, 30, 36, 45]] = points[[8, 30, 36, 45]]
    line = '<point x="{}" y="{}" z="{}" name="{}" active="1"/>'.format
    marked = "".join(line(*row, k + 1) for k, row in enumerate(rows))
    texts = {
        "all.json": (json.dumps(rows), points),
        "all.txt": ("\n".join("{} {} {}".format(*row) for row in rows), points),
        "all.pp": (f"<PickedPoints>{marked}</PickedPoints>", points),
        "inner.csv": ("x,y,z\n" + "\n".join("{},{},{}".format(*row) for row in rows[17:]), inner),
        "named.json": (json.dumps(named), few),
        "named.csv": ("\n".join(f"{k}; {x}; {y}; {z}" for k, (x, y, z) in named.items()), few),
    }
    for name, (text, expected) in texts.items():
        (tmp_path / name).write_text(text)
        np.testing.assert_array_equal(read_landmarks(tmp_path / name), expected)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "", "0 points"),
        ("a.txt", "0 0 0\n" * 67, "67 points"),
        ("a.txt", "0 0\n" * 68, "expected 3"),
        ("a.csv", "0,0,0\n" * 30 + "0,nan,0\n" + "0,0,0\n" * 37, "expected 3 finite"),
        ("a.csv", "elbow,0,0,0", "'elbow'"),
        ("a.csv", "68,0,0,0", "from 0 to 67"),
        ("a.csv", "nose_tip,0,0,0\npronasale,0,0,0", "twice"),
        ("a.json", "[[NaN, 0, 0]]", "NaN"),
        ("a.json", '{"chin": 3}', "cannot be read as landmarks"),
        ("a.json", "7", "cannot be read as landmarks"),
        ("a.pp", "<PickedPoints><point/>", "cannot be read as landmarks"),
        (
            "a.pp",
            '<PickedPoints><point x="0" y="0" name="chin"/></PickedPoints>',
            "cannot be read as landmarks",
        ),
    ],
)
def test_wrong_landmarks_are_one_clear_line(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=words) as caught:
        read_landmarks(tmp_path / name)
    assert len(str(caught.value).splitlines()) == 1


def test_landmarks_lie_beside_their_scan(tmp_path):
    scan = tmp_path / "a.ply"
    assert landmarks_beside(scan) is None
    (tmp_path / "a_picked_points.pp").touch()
    assert landmarks_beside(scan) == tmp_path / "a_picked_points.pp"
    (tmp_path / "a_landmarks.json").touch()
    with pytest.raises(FormatError, match="keep one"):
        landmarks_beside(scan)


def test_wrong_options_are_refused_before_the_work(person, tmp_path):
    scan = write_scan(tmp_path / "a.obj", *person)
    assert run(tmp_path / "out", "--scan", scan, "--head", tmp_path / "none.pkl") != 0
    (tmp_path / "empty").mkdir()
    assert run(tmp_path / "out", "--scan", tmp_path / "empty") == 2
    assert run(tmp_path / "out", "--scan", tmp_path / "none.obj") == 2
    for words in ("--items S*", "--workers 8", "--threads 4", "--preset draft", "--strict"):
        assert run(tmp_path / "out", "--scan", scan, *words.split()) == 2
    assert run(tmp_path / "out", "--head", "ict.npz") == 2  # without a scan
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "letter.txt").write_text("mine")
    assert run(tmp_path / "out", "--scan", scan) == 1
    assert (tmp_path / "out" / "a" / "letter.txt").read_text() == "mine"
    (tmp_path / "out" / "a" / "metrics.json").write_text('{"psnr_db": 30}')
    assert run(tmp_path / "out", "--scan", scan) == 1, "it may be the folder of a fit"
    assert (tmp_path / "out" / "a" / "letter.txt").read_text() == "mine"
    (tmp_path / "out" / "index.csv").write_text("mine")
    assert run(tmp_path / "out", "--scan", scan) != 0
    assert (tmp_path / "out" / "index.csv").read_text() == "mine"
