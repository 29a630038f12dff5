"""Exports: readers of other conventions get back the tracked heads, in the user's world."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from express50.__main__ import main
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.export_avatar import centred
from express50.files.calibration import read_cameras, write_cameras
from express50.files.images import read_alpha, read_image, write_image
from express50.geometry.meshes import split_seams
from express50.geometry.pixels import srgb_to_linear
from express50.head.load import load_head
from express50.head.model import normals_of
from express50.rigs.per_picture import read_transforms
from tests.express50.dataset.tracked import track_arrays, world_vertices, write_track
from tests.express50.head.flame_files import write_flame
from tests.express50.head.flame_reader import flame_vertices
from tests.faults.toy import tree
from tests.pipelines.bump_dataset import make_dataset
from tests.synth import read_frame

CAMERAS = 3


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    """S001 is tracked with the built-in head, S002 with one in FLAME's layout, S003 not at all.

    The principal points of S002's cameras are in the middle of their images, S001's are not.
    """
    root = tmp_path_factory.mktemp("export")
    made = make_dataset(root, ("S001", "S002", "S003"), cameras=CAMERAS, size=48)
    flame = write_flame(root)
    for subject, head in (("S001", "procedural"), ("S002", flame)):
        write_track(made.track_file(subject), track_arrays(head))
    made.track_file("S003").unlink()
    path = made.cameras_file("S002")
    write_cameras(path, {name: replace(camera, params=(163.2, 163.2, 24.0, 24.0))
                         for name, camera in read_cameras(path).items()})  # fmt: skip
    return made


def track_of(dataset: Dataset, subject: str) -> dict[str, np.ndarray]:
    with np.load(dataset.track_file(subject)) as table:
        return dict(table)


def export(dataset: Dataset, out: Path, kind: str, *options: str) -> int:
    return main(["export", str(dataset.root), str(out), "--format", kind, *options])


@pytest.fixture(scope="module")
def avatars(dataset, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("avatars")
    assert export(dataset, out, "gaussian-avatars") == 0
    return out


@pytest.mark.parametrize("subject", ["S001", "S002"])
def test_a_reader_of_flames_convention_gets_the_tracked_vertices(dataset, avatars, subject):
    track, table = track_of(dataset, subject), read_json(avatars / subject / "transforms.json")
    model = load_head(str(track["head"]))
    exact = world_vertices(model, track, track["offsets"])
    for step, name in enumerate(track["expressions"]):
        frame = next(row for row in table["frames"] if row["timestep_id"] == name)
        assert frame["timestep_index"] == step
        with np.load(avatars / subject / frame["flame_param_path"]) as arrays:
            found = flame_vertices(model, dict(arrays))
        np.testing.assert_allclose(found, exact[step], atol=5e-6)
    turned = np.abs(track["R"] - np.eye(3)).max()
    assert turned > 0.3 and np.abs(track["offsets"]).mean() > 1e-3


def read_json(path: Path) -> dict:
    return json.loads(path.read_text())


def test_parameters_have_the_shapes_that_readers_expect(avatars) -> None:
    model = load_head("procedural")
    sizes = {"translation": (1, 3), "rotation": (1, 3), "neck_pose": (1, 3), "jaw_pose": (1, 3),
             "eyes_pose": (1, 6), "expr": (1, len(model.expression_names)),
             "shape": (len(model.shape_names),),
             "static_offset": (1, len(model.template), 3)}  # fmt: skip
    for name in ("flame_param/00000.npz", "flame_param/00001.npz", "canonical_flame_param.npz"):
        with np.load(avatars / "S001" / name, allow_pickle=False) as arrays:
            assert {key: arrays[key].shape for key in arrays.files} == sizes
            assert {arrays[key].dtype for key in arrays.files} == {np.dtype(np.float32)}
            if name.startswith("canonical"):
                assert arrays["jaw_pose"].tolist() == [[np.float32(0.3), 0, 0]]
                assert not arrays["expr"].any() and not arrays["rotation"].any()


def test_tables_name_every_view_and_divide_them(avatars) -> None:
    root = avatars / "S001"
    whole = read_json(root / "transforms.json")
    assert len(whole["frames"]) == 2 * CAMERAS
    assert whole["timestep_indices"] == [0, 1] and whole["camera_indices"] == [0, 1, 2]
    for row in whole["frames"]:
        stem = f"{row['timestep_index']:05d}_{row['camera_index']:02d}.png"
        assert row["file_path"] == f"images/{stem}" and row["fg_mask_path"] == f"fg_masks/{stem}"
        image = cv2.imread(str(root / row["file_path"]), cv2.IMREAD_UNCHANGED)
        assert image.shape == (row["h"], row["w"], 4)
        assert row["camera_angle_x"] == pytest.approx(2 * math.atan(row["w"] / 2 / row["fl_x"]))
    parts = {name: read_json(root / f"transforms_{name}.json") for name in ("train", "val", "test")}
    views = {
        name: {(row["timestep_index"], row["camera_index"]) for row in part["frames"]}
        for name, part in parts.items()
    }
    # Two expressions: three tenths of them round to none for testing.
    assert views["train"] == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert views["val"] == {(0, 2), (1, 2)} and views["test"] == set()


def test_divisions_can_be_chosen(dataset, tmp_path) -> None:
    options = ["--subject=S001", "--test-expression=neutral", "--validation-camera=cam00"]
    assert export(dataset, tmp_path, "gaussian-avatars", *options) == 0
    parts = {
        name: {(r["timestep_id"], r["camera_id"]) for r in
               read_json(tmp_path / "S001" / f"transforms_{name}.json")["frames"]}
        for name in ("train", "val", "test")
    }  # fmt: skip
    assert parts["train"] == {("smile", "cam01"), ("smile", "cam02")}
    assert parts["val"] == {("smile", "cam00")}
    assert parts["test"] == {("neutral", f"cam0{k}") for k in range(CAMERAS)}


def test_cameras_survive_the_trip_through_opengl(dataset, avatars) -> None:
    for subject, moved in (("S001", CAMERAS), ("S002", 0)):
        read = read_transforms(avatars / subject, None).values()
        cameras = read_cameras_of(dataset, subject).values()
        for ours, theirs in zip(cameras, read, strict=True):
            np.testing.assert_allclose(theirs.cam_from_world, ours.cam_from_world, atol=1e-12)
            np.testing.assert_allclose(theirs.K, centred(ours).K, atol=1e-9)
            assert theirs.K[0, 2] == theirs.width / 2
        meta = read_json(avatars / subject / "export.json")
        assert len(meta["cameras_centred"]) == moved


def test_pictures_are_the_stages_own_with_their_mattes(dataset, avatars, tmp_path) -> None:
    image = read_frame(dataset, "S002", "cam01", 0)
    alpha = read_alpha(dataset.matte_file("S002", "neutral", "cam01"))
    found = read_image(avatars / "S002/fg_masks/00000_01.png")
    np.testing.assert_array_equal(found, alpha)
    kept = cv2.imread(str(avatars / "S002/images/00000_01.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(kept[..., 2::-1], image)
    np.testing.assert_array_equal(kept[..., 3], alpha)
    assert (
        export(dataset, tmp_path, "gaussian-avatars", "--background=white", "--subject=S002") == 0
    )
    flat = read_image(tmp_path / "S002/images/00000_01.png")
    assert flat.shape == image.shape
    assert (flat[alpha == 0] == 255).all()
    np.testing.assert_array_equal(flat[alpha == 255], image[alpha == 255])


def test_heads_that_are_not_flame_say_so_and_bring_meshes(dataset, avatars) -> None:
    ours, flame = (read_json(avatars / s / "export.json") for s in ("S001", "S002"))
    assert flame["coefficients"] == "FLAME" and "expression_names" not in flame
    assert not (avatars / "S002/meshes").exists()
    assert ours["coefficients"] == "the head model's own"
    assert len(ours["expression_names"]) == len(load_head("procedural").expression_names)
    row = read_json(avatars / "S001/transforms.json")["frames"][-1]
    mesh = trimesh.load(avatars / "S001" / row["mesh_path"], process=False, maintain_order=True)
    expected = track_of(dataset, "S001")["vertices"][row["timestep_index"]]
    assert np.abs(mesh.bounds - [expected.min(0), expected.max(0)]).max() < 1e-6
    assert ours["world_from_export"] == np.eye(4).tolist()


def test_exporting_twice_gives_the_same_bytes_and_leaves_nothing_aside(dataset, avatars) -> None:
    before = tree(avatars)
    assert export(dataset, avatars, "gaussian-avatars") == 0
    assert tree(avatars) == before
    assert sorted(path.name for path in avatars.iterdir()) == ["S001", "S002"]


@pytest.mark.parametrize("kind", ["gaussian-avatars", "glb"])
def test_an_interrupted_export_leaves_the_former_one(dataset, tmp_path, monkeypatch, kind) -> None:
    assert export(dataset, tmp_path, kind, "--subject=S001") == 0
    before, writes = tree(tmp_path), []

    def stop(path: Path, data: bytes) -> int:
        writes.append(path)
        if len(writes) > 1:
            raise KeyboardInterrupt
        return len(data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", stop)
        assert export(dataset, tmp_path, kind, "--subject=S001") == 130
    assert len(writes) == 2
    assert tree(tmp_path) == before
    # A kill gives no time to clean up: what it left is taken away by the next run.
    (tmp_path / ".S001.part").mkdir()
    (tmp_path / ".S001.part" / "half").write_text("x")
    (tmp_path / "S001").rename(tmp_path / ".S001.part.former")
    assert export(dataset, tmp_path, kind, "--subject=S001") == 0
    assert tree(tmp_path) == before


def test_a_folder_that_is_not_an_export_is_kept(dataset, tmp_path, capsys) -> None:
    (tmp_path / "S001").mkdir()
    (tmp_path / "S001" / "thesis.tex").write_text("years of work")
    assert export(dataset, tmp_path, "obj", "--subject=S001") == 1
    assert "has no export.json" in capsys.readouterr().err
    assert (tmp_path / "S001" / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize("kind", ["obj", "ply", "glb"])
def test_meshes_are_in_the_users_world(dataset, tmp_path, kind) -> None:
    assert export(dataset, tmp_path, kind, "--subject=S001", "--expression=smile") == 0
    assert {path.name for path in (tmp_path / "S001").iterdir()} == {f"smile.{kind}", "export.json"}
    track, model = track_of(dataset, "S001"), load_head("procedural")
    mesh = trimesh.load(tmp_path / "S001" / f"smile.{kind}", process=False, force="mesh")
    expected = track["vertices"][1][model.faces.numpy()]
    np.testing.assert_allclose(mesh.vertices[mesh.faces], expected, atol=1e-6)
    if kind == "ply":
        np.testing.assert_array_equal(mesh.vertices, track["vertices"][1])
    if kind == "glb":  # else viewers show flat facets
        (mesh,) = trimesh.load_scene(tmp_path / "S001/smile.glb", process=False).geometry.values()
        places, _, _ = split_seams(model.faces.numpy(), model.uv_faces.numpy())
        smooth = normals_of(track["vertices"][1], model.faces)[places]
        np.testing.assert_allclose(mesh.vertex_normals, smooth, atol=1e-5)


@pytest.fixture
def textured(dataset):
    """A texture whose red rises with u and green with v."""
    side = 64
    v, u = np.meshgrid(1 - (np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side,
                       indexing="ij")  # fmt: skip
    image = np.rint(255 * np.stack([u, v, 0 * u], -1)).astype(np.uint8)
    path = dataset.item_dir("track", "S001") / "albedo.png"
    write_image(path, image)
    yield image
    path.unlink()


def test_textures_are_the_right_way_up(dataset, tmp_path, textured) -> None:
    model = load_head("procedural")
    for kind in ("obj", "ply", "glb"):
        assert export(dataset, tmp_path / kind, kind, "--subject=S001", "--expression=smile") == 0
    corner_uv = model.uv.numpy()[model.uv_faces.numpy()]
    for kind in ("obj", "glb"):
        mesh = trimesh.load(tmp_path / kind / f"S001/smile.{kind}", process=False, force="mesh")
        np.testing.assert_allclose(mesh.visual.uv[mesh.faces], corner_uv, atol=1e-6)
        material = mesh.visual.material
        picture = np.asarray(material.image if kind == "obj" else material.baseColorTexture)
        np.testing.assert_array_equal(picture[..., :3], textured)
    assert (tmp_path / "obj/S001/smile.mtl").read_text().endswith("map_Kd albedo.png\n")
    mesh = trimesh.load(tmp_path / "ply/S001/smile.ply", process=False)
    uv = np.zeros((len(model.template), 2))
    uv[model.faces.numpy().ravel()] = model.uv.numpy()[model.uv_faces.numpy().ravel()]
    used = np.unique(model.faces.numpy())
    colours = mesh.visual.vertex_colors[used, :2] / 255
    np.testing.assert_allclose(colours, uv[used], atol=1.01 / 64)


def test_views_without_a_matte_are_counted(dataset, tmp_path, capsys) -> None:
    path = dataset.matte_file("S001", "smile", "cam01")
    data = path.read_bytes()
    path.unlink()
    try:
        assert export(dataset, tmp_path, "gaussian-avatars", "--subject=S001", "--json") == 0
    finally:
        path.write_bytes(data)
    account = json.loads(capsys.readouterr().out)[0]
    assert (account["read"], account["views"]) == (6, 5)
    assert [row["what"] for row in account["dropped"]] == ["smile/cam01"]
    assert "run 'express50 matte'" in account["dropped"][0]["why"]


def test_masks_of_the_head_alone_come_from_regions(dataset, tmp_path) -> None:
    folder = dataset.item_dir("regions", "S002/neutral")
    folder.mkdir(parents=True)
    mask = np.zeros((48, 48), np.uint8)
    mask[:20] = 200
    for k in range(CAMERAS):
        write_image(folder / f"cam0{k}_head.png", mask)
    options = ["--subject=S002", "--expression=neutral", "--head-only"]
    assert export(dataset, tmp_path, "gaussian-avatars", *options) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "S002/fg_masks/00000_02.png"), mask)


def test_smaller_pictures_belong_to_smaller_cameras(dataset, tmp_path) -> None:
    options = ["--subject=S001", "--subject=S002", "--expression=smile", "--downscale=5"]
    assert export(dataset, tmp_path, "gaussian-avatars", *options) == 0
    for subject in ("S001", "S002"):
        table = read_json(tmp_path / subject / "transforms.json")
        cameras = read_cameras_of(dataset, subject)
        for row in table["frames"]:
            image = cv2.imread(str(tmp_path / subject / row["file_path"]), cv2.IMREAD_UNCHANGED)
            assert image.shape == (row["h"], row["w"], 4) and max(image.shape) <= 12
            assert (row["cx"], row["cy"]) == (row["w"] / 2, row["h"] / 2)
            assert row["fl_x"] == pytest.approx(cameras[row["camera_id"]].K[0, 0] / 5)
            assert row["fl_x"] == pytest.approx(row["fl_y"])
        # The head's middle, by what is left of the matte, is where the whole picture has it.
        row = table["frames"][0]
        small = read_image(tmp_path / subject / row["fg_mask_path"]).astype(float)
        y, x = np.mgrid[: row["h"], : row["w"]] + 0.5
        found = np.array([(small * x).sum(), (small * y).sum()]) / small.sum()
        full = read_alpha(dataset.matte_file(subject, "smile", row["camera_id"])).astype(float)
        y, x = np.mgrid[:48, :48] + 0.5
        there = np.array([(full * x).sum(), (full * y).sum(), full.sum()]) / full.sum()
        ray = np.linalg.inv(cameras[row["camera_id"]].K) @ there
        expected = [row["fl_x"] * ray[0] + row["cx"], row["fl_y"] * ray[1] + row["cy"]]
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_colour_gains_are_divided_out(dataset, tmp_path) -> None:
    path = dataset.gains_file("S002")
    path.write_text(json.dumps({"cam01": [1.2, 1.0, 0.8]}))
    try:
        options = ["--subject=S002", "--expression=neutral", "--even-colour"]
        assert export(dataset, tmp_path, "gaussian-avatars", *options) == 0
    finally:
        path.unlink()
    for number, gain in ((0, np.ones(3)), (1, np.array([1.2, 1.0, 0.8]))):
        image = read_frame(dataset, "S002", f"cam0{number}", 0)
        kept = cv2.imread(str(tmp_path / f"S002/images/00000_0{number}.png"), cv2.IMREAD_UNCHANGED)
        light = srgb_to_linear(kept[..., 2::-1] / 255.0) * gain
        unclipped = kept[..., 2::-1].max(-1) < 255
        expected = srgb_to_linear(image / 255.0)
        np.testing.assert_allclose(light[unclipped], expected[unclipped], atol=0.006)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--format=fbx"], 2, "unknown 'fbx'; expected "),
        (["--format=obj", "--subject=S9"], 2, "no subject 'S9'; expected one of S001, S002, S003"),
        (["--format=obj", "--subject=S003"], 1, "'S003' is not tracked; run 'express50 track /"),
        (["--format=obj", "--expression=wink"], 2, "no tracked expression 'wink'; expected one"),
        (["--format=glb", "--downscale=2"], 2, "--format glb: --background, --head-only"),
        (["--format=gaussian-avatars", "--validation-camera=x"], 2, "expected one of cam00, cam01"),
        (["--format=gaussian-avatars", "--test-expression=x"], 2, "no expression 'x'; expected"),
        (["--format=gaussian-avatars", "--downscale=0"], 2, "got '0', expected a whole"),
        (["--format=gaussian-avatars", "--downscale=99"], 2, "downscale 99: expected 1"),
        (["--format=gaussian-avatars", "--head-only", "--expression=smile", "--subject=S001"], 1,
         "express50 regions"),
        (["--format=gaussian-avatars", "--test-expression=smile", "--test-expression=neutral"], 2,
         "leave some to train on"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_is_one_line(
    dataset, tmp_path, capsys, options, code, message
) -> None:
    assert main(["export", str(dataset.root), str(tmp_path / "out"), *options]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def write_sequence(dataset: Dataset, subject: str, **changes: object) -> dict[str, np.ndarray]:
    """Two clips of three frames, whose parameters are those of the peaks, mixed."""
    track = track_of(dataset, subject)
    mixed = {
        name: track[name][[0, 1, 1, 1, 0, 1]]
        for name in ("expression", "neck", "jaw", "eyes", "R", "t")
    }
    first, second = track["expressions"][:2].tolist()
    sequence = mixed | {
        "schema": "express50.sequence/1", "head": str(track["head"]), "shape": track["shape"],
        "cues": np.array([first] * 3 + [second] * 3), "frames": np.arange(5, 11),
        "rate": 24.0,
    } | changes  # fmt: skip
    np.savez(dataset.item_dir("track", subject) / "sequence.npz", **sequence)
    return sequence


def test_every_frame_of_a_clip_is_a_mesh(dataset, tmp_path):
    track, sequence = track_of(dataset, "S001"), write_sequence(dataset, "S001")
    clips = ("--subject", "S001", "--frames", "clips")
    assert export(dataset, tmp_path, "ply", *clips) == 0
    first, second = dict.fromkeys(sequence["cues"].tolist())
    names = [f"{first}_{n:06d}" for n in (5, 6, 7)] + [f"{second}_{n:06d}" for n in (8, 9, 10)]
    assert sorted(path.stem for path in (tmp_path / "S001").glob("*.ply")) == sorted(names)
    exact = world_vertices(load_head("procedural"), track, track["offsets"])
    for name, row in zip(names, (0, 1, 1, 1, 0, 1), strict=True):
        mesh = trimesh.load(tmp_path / "S001" / f"{name}.ply", process=False)
        np.testing.assert_allclose(mesh.vertices, exact[row], atol=2e-6)
    assert export(dataset, tmp_path / "one", "obj", *clips, "--expression", second) == 0
    assert len(list((tmp_path / "one" / "S001").glob("*.obj"))) == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "x/1"}, "schema 'x/1'"),
        ({"frames": np.arange(4)}, "frames has shape (4,)"),
        ({"R": np.ones((6, 3, 3))}, "R is not a rotation"),
        ({"t": np.full((6, 3), np.nan)}, "t has 18 values that are not finite"),
        ({"cues": np.array(["../x"] * 6)}, "expected letters"),
        ({"head": "other"}, "does not belong to the track beside it"),
    ],
)
def test_a_damaged_sequence_is_one_line(dataset, tmp_path, capsys, changes, words):
    write_sequence(dataset, "S001", **changes)
    assert export(dataset, tmp_path, "obj", "--subject", "S001", "--frames", "clips") == 1
    assert words in capsys.readouterr().err


def test_clips_without_tracks_or_mattes_are_refused(dataset, tmp_path, capsys):
    assert export(dataset, tmp_path, "obj", "--subject", "S002", "--frames", "clips") == 1
    assert "track.frames=clips" in capsys.readouterr().err
    assert export(dataset, tmp_path, "gaussian-avatars", "--frames", "clips") == 2
    assert "needs a matte of every frame" in capsys.readouterr().err
