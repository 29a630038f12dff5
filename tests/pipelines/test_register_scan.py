"""Scans: any pose and unit, what is written, and what is skipped or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from express50.cli.main import main
from express50.dataset.tracks import read_registration, read_track
from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import pose


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


def run(*arguments: object) -> int:
    return main(["register", *map(str, arguments)])


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "scale", "turn"), [("obj", 1e3, 0.0), ("ply", 1.0, 2.5)])
def test_a_scan_of_any_pose_and_unit_becomes_parameters_and_a_mesh(
    person, tmp_path, capsys, kind, scale, turn
):
    vertices, faces = person
    R, t = axis_angle_to_matrix(turn * np.array([0.5, -0.6, 0.6])), np.array([3.0, -2.0, 1.0])
    placed = vertices @ R.T + t
    scan = write_scan(tmp_path / f"person.{kind}", scale * placed, faces)
    out = tmp_path / "out"
    assert run(out, "--scan", scan, "--json") == 0
    (account,) = json.loads(capsys.readouterr().out)
    assert account["unit"] == ("millimetres" if scale == 1e3 else "metres")
    assert account["registered_mm_median"] < 0.05 and account["seen_share"] > 0.6
    assert account["registered_mm_median"] < 0.2 * account["parameters_mm_median"]
    track = read_track(out / "person" / "track.npz")
    found = read_registration(out / "person" / "registration.npz")
    face = load_head("procedural").regions["face"].numpy()
    off = 1e3 * np.linalg.norm(found.vertices - placed, axis=1)[face]
    assert np.median(off) < 2.5  # vertex to vertex: correspondence, not distance to the surface
    assert track.expressions == ("scan",)
    mesh = trimesh.load(out / "person" / "head.obj", process=False)
    assert np.abs(mesh.bounds.mean(0) / scale - found.vertices.mean(0)).max() < 0.1
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
    assert run(tmp_path / "out", "--scan", folder) == 1
    lines = capsys.readouterr().out.strip().splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "ball", "damaged", "kilometres", "nan", "triangle"
    ]  # fmt: skip
    assert not list((tmp_path / "out").glob("[!.]*"))


def test_wrong_options_are_refused_before_the_work(person, tmp_path):
    scan = write_scan(tmp_path / "a b.obj", *person)
    assert run(tmp_path / "out", "--scan", scan) == 2
    scan = scan.rename(tmp_path / "a.obj")
    assert run(tmp_path / "out", "--scan", scan, "--head", tmp_path / "none.pkl") != 0
    assert run(tmp_path / "out", "--scan", scan, "--scan", scan) == 2
    (tmp_path / "empty").mkdir()
    assert run(tmp_path / "out", "--scan", tmp_path / "empty") == 2
    assert run(tmp_path / "out", "--scan", tmp_path / "none.obj") == 2
    assert run(tmp_path / "out", "--scan", scan, "--items", "S*") == 2
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "letter.txt").write_text("mine")
    assert run(tmp_path / "out", "--scan", scan) == 1
    assert (tmp_path / "out" / "a" / "letter.txt").read_text() == "mine"
