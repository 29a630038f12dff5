"""Imports: what another tool made becomes the stage's output, or one line says why not."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from express50.__main__ import main
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.depth_files import read_depth
from express50.dataset.tracks import read_track
from express50.errors import StageError
from express50.files.calibration import read_cameras, write_cameras
from express50.files.images import read_alpha, write_image
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.meshes import read_surface
from express50.geometry.pixels import shrink
from express50.geometry.transforms import make_transform
from express50.runner.ledger import Ledger
from pipelines.depth import STAGE as DEPTH
from pipelines.frames import STAGE as FRAMES
from pipelines.imports.footage_check import check_landmarks, check_masks_show_face, edge_contrast
from pipelines.imports.pictures import PeakFrame, check_pattern, fill, ray_lengths
from pipelines.matte import STAGE as MATTE
from pipelines.track import STAGE as TRACK
from pipelines.track.observe import LandmarkView, Observation
from tests.express50.dataset.tracked import track_arrays, world_vertices, write_track
from tests.express50.head.flame_files import write_flame
from tests.pipelines.bump_dataset import make_dataset
from tests.pipelines.bump_head import render
from tests.stages import run_here

pytestmark = pytest.mark.usefixtures("no_faces")
CAMERAS, SIZE = 6, 96
FIELDS = ("shape", "expression", "neck", "jaw", "eyes", "R", "t", "vertices", "offsets")


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> tuple[Dataset, Path, Path]:
    """A dataset whose subject is tracked with a FLAME of the tests; its export; FLAME's file."""
    root = tmp_path_factory.mktemp("imports")
    dataset, flame = make_dataset(root, cameras=CAMERAS, size=SIZE), write_flame(root)
    arrays = track_arrays(flame)
    from express50.head.load import load_head

    arrays["t"] = 0.01 * arrays["t"]  # in the pictures
    posed = world_vertices(load_head(flame), arrays, arrays["offsets"].astype(float))
    write_track(dataset.track_file("S001"), arrays | {"vertices": posed.astype(np.float32)})
    out = root / "avatars"
    assert main(["export", str(dataset.root), str(out), "--format=gaussian-avatars"]) == 0
    return dataset, out / "S001", flame


@pytest.fixture
def dataset(original, tmp_path) -> Dataset:
    """A copy that a test may change."""
    shutil.copytree(original[0].root, tmp_path / "data")
    return Dataset(tmp_path / "data")


@pytest.fixture
def avatar(original, tmp_path) -> Path:
    return Path(shutil.copytree(original[1], tmp_path / "avatar"))


def take(kind: str, dataset: Dataset, source: object, *options: str) -> int:
    return main(["import", kind, str(dataset.root), str(source), *options])


def error_of(capsys) -> str:
    """The one line that says what is wrong."""
    seen = capsys.readouterr()
    lines = [line for line in (seen.err + seen.out).splitlines() if "  warning" not in line]
    lines = [line for line in lines if not re.match(r"import |\w+ \d/\d ", line)]  # the account
    assert len(lines) == 1, lines
    return lines[0]


def assert_same_track(dataset: Dataset, expected: Dataset) -> None:
    found, true = read_track(dataset.track_file("S001")), read_track(expected.track_file("S001"))
    assert found.expressions == true.expressions and (found.frames == true.frames).all()
    for name in FIELDS:
        one, other = getattr(found, name), getattr(true, name)
        if name in ("shape", "expression"):  # the import has all of the model's coefficients
            assert not one[..., other.shape[-1] :].any()
            one = one[..., : other.shape[-1]]
        np.testing.assert_allclose(one, other, atol=1e-5, err_msg=name)


def test_our_export_comes_back_as_the_track(original, dataset, capsys) -> None:
    shutil.rmtree(dataset.item_dir("track", "S001"))
    assert take("track", dataset, original[1], f"--head={original[2]}") == 0
    assert "1 done + 0 failed" in capsys.readouterr().out
    assert_same_track(dataset, original[0])
    with Ledger(dataset.ledger) as ledger:
        receipt = ledger.read("track")["S001"]
    assert receipt.imported and receipt.metrics["imported"]["expressions"] == 2


def test_a_track_of_another_world_is_moved_by_its_cameras(original, dataset, avatar) -> None:
    turn = cv2.Rodrigues(np.array([0.3, -0.8, 0.2]))[0]
    motion = make_transform(turn, np.array([1.0, -2.0, 0.5]))
    table = json.loads((avatar / "transforms.json").read_text())
    for row in table["frames"]:
        row["transform_matrix"] = (motion @ np.array(row["transform_matrix"])).tolist()
    (avatar / "transforms.json").write_text(json.dumps(table))
    for path in (avatar / "flame_param").iterdir():
        with np.load(path) as file:
            arrays = dict(file)
        from express50.head.load import load_head
        from tests.express50.head.flame_reader import flame_vertices

        model = load_head(original[2])
        before = flame_vertices(model, arrays) @ motion[:3, :3].T + motion[:3, 3]
        R = motion[:3, :3] @ cv2.Rodrigues(arrays["rotation"][0].astype(float))[0]
        arrays["rotation"] = cv2.Rodrigues(R)[0].T.astype(np.float32)
        after = flame_vertices(model, arrays)
        arrays["translation"] = arrays["translation"] + (before - after).mean(0)
        np.savez(path, **arrays)
    assert take("track", dataset, avatar, f"--head={original[2]}") == 0
    assert_same_track(dataset, original[0])


@pytest.mark.parametrize("in_clip", [False, True])
def test_files_of_vhap_are_read_by_frame(original, dataset, tmp_path, in_clip) -> None:
    steps = []
    for k in range(2):
        with np.load(original[1] / f"flame_param/{k:05d}.npz") as file:
            steps.append(dict(file))
    for k, name in enumerate(("neutral", "smile") if in_clip else ("all",)):
        rows = steps[k : k + 1] if in_clip else steps
        folder = tmp_path / f"vhap_{name}"
        folder.mkdir()
        arrays = {n: np.concatenate([row[n] for row in rows]) for n in steps[0] if n not in
                  ("shape", "static_offset")}  # fmt: skip
        ids = np.array([f"frame_{i:05d}" for i in range(len(rows))])
        shared = {n: steps[0][n] for n in ("shape", "static_offset")}
        np.savez(folder / "tracked_flame_params_30.npz", timestep_id=ids, **arrays, **shared)
        np.savez(folder / "tracked_flame_params_0.npz", nothing=np.zeros(1))
    source = tmp_path / ("vhap_{expression}" if in_clip else "vhap_all")
    assert take("track", dataset, source, f"--head={original[2]}") == 0
    assert_same_track(dataset, original[0])


def change_table(avatar: Path, change) -> None:
    path = avatar / "transforms.json"
    table = json.loads(path.read_text())
    for row in table["frames"]:
        change(row)
    path.write_text(json.dumps(table))


def change_matrix(change):
    def changed(row: dict) -> None:
        row["transform_matrix"] = change(np.array(row["transform_matrix"])).tolist()

    return changed


def in_millimetres(matrix: np.ndarray) -> np.ndarray:
    matrix[:3, 3] *= 1000
    return matrix


def moved(row: dict) -> None:
    if row["camera_id"] == "cam02":
        row["transform_matrix"][0][3] += 0.2


WRONG = {
    "intrinsics": (lambda row: row.update(fl_x=1.2 * row["fl_x"]), "intrinsics"),
    "opencv": (change_matrix(lambda m: m @ FLIP_YZ), "--axes opencv"),
    "world to camera": (change_matrix(np.linalg.inv), "world to camera"),
    "millimetres": (change_matrix(in_millimetres), "its unit is not the metre"),
    "moved": (moved, "camera cam02"),
    "names": (lambda row: row.update(camera_id="x" + row["camera_id"]), "from another capture"),
    "frame": (lambda row: row.update(timestep_index_original=7), "is of frame 7"),
}


@pytest.mark.parametrize("case", sorted(WRONG))
def test_wrong_cameras_are_named_in_one_line(original, dataset, avatar, capsys, case) -> None:
    change, words = WRONG[case]
    change_table(avatar, change)
    before = dataset.track_file("S001").read_bytes()
    assert take("track", dataset, avatar, f"--head={original[2]}") == 1
    assert words in error_of(capsys)
    assert dataset.track_file("S001").read_bytes() == before
    if case == "opencv":
        assert take("track", dataset, avatar, f"--head={original[2]}", "--axes=opencv") == 0
        assert_same_track(dataset, original[0])


def test_missing_frames_and_other_subjects_are_named(original, dataset, avatar, capsys) -> None:
    table = json.loads((avatar / "transforms.json").read_text())
    rest = [row for row in table["frames"] if row["timestep_id"] != "smile"]
    (avatar / "transforms.json").write_text(json.dumps(table | {"frames": rest}))
    assert take("track", dataset, avatar, f"--head={original[2]}") == 1
    assert "no time step of smile (frame 1)" in error_of(capsys)
    meta = json.loads((avatar / "export.json").read_text())
    (avatar / "export.json").write_text(json.dumps(meta | {"subject": "S009"}))
    assert take("track", dataset, avatar, f"--head={original[2]}") == 1
    assert "is of subject S009, expected S001" in error_of(capsys)
    take("track", dataset, avatar / "absent.npz", f"--head={original[2]}")
    assert "absent.npz: no such file; expected a folder or FLAME parameters" in error_of(capsys)


def test_another_head_model_is_refused(dataset, avatar, capsys) -> None:
    for path in (avatar / "flame_param").iterdir():
        with np.load(path) as file:
            np.savez(path, **dict(file) | {"shape": np.ones(300, np.float32)})
    with np.load(dataset.track_file("S001")) as file:
        head = str(file["head"])
    assert take("track", dataset, avatar, f"--head={head}") == 1
    assert "300 shape coefficients, the head model has 6" in error_of(capsys)


def change_parameters(**arrays: np.ndarray):
    def change(avatar: Path) -> None:
        for path in (avatar / "flame_param").iterdir():
            with np.load(path) as file:
                np.savez(path, **dict(file) | arrays)

    return change


DAMAGED = {
    "cut off": (
        lambda avatar: (avatar / "transforms.json").write_text('{"frames": ['),
        "transforms.json: not JSON",
    ),
    "no frames": (
        lambda avatar: (avatar / "transforms.json").write_text('{"frames": {}}'),
        "transforms.json: has no frames",
    ),
    "no ids": (
        lambda avatar: change_table(
            avatar, lambda row: [row.pop(key) for key in ("camera_id", "camera_index")]
        ),
        "frame 0: has no camera_id",
    ),
    "two axes": (
        change_parameters(static_offset=np.zeros((1, 120, 2))),
        "static_offset is (1, 120, 2), expected (1, V, 3)",
    ),
    "words": (change_parameters(dynamic_offset=np.array(["none"])), "expected numbers"),
}


@pytest.mark.parametrize("case", sorted(DAMAGED))
def test_damaged_tracks_are_named_in_one_line(original, dataset, avatar, capsys, case) -> None:
    change, words = DAMAGED[case]
    change(avatar)
    assert take("track", dataset, avatar, f"--head={original[2]}") == 1
    assert words in error_of(capsys)


def test_cameras_beside_those_of_the_export_are_refused(original, dataset, avatar, capsys) -> None:
    options = [f"--head={original[2]}", "--cameras=camera_params.json"]
    assert take("track", dataset, avatar, *options) == 1
    assert "has cameras of its own; leave --cameras out" in error_of(capsys)


def test_runs_keep_an_import_until_its_cameras_change(original, dataset, capsys) -> None:
    assert take("track", dataset, original[1], f"--head={original[2]}") == 0
    path = dataset.track_file("S001")
    before = path.read_bytes()
    for settings in ({}, {"samples": 999}):
        done = run_here(TRACK, dataset, **settings)
        assert done.ok and done.count("skipped") == 1
        assert any("kept 1 imported" in line for line in done.lines())
    assert path.read_bytes() == before
    capsys.readouterr()
    assert main(["status", str(dataset.root)]) == 0
    assert "imported track: 1 of its items" in capsys.readouterr().out
    main(["check", str(dataset.root), "--fix"])
    assert path.read_bytes() == before and "outdated" not in capsys.readouterr().out

    cameras = read_cameras(dataset.cameras_file("S001"))
    other = {n: replace(c, params=(*c.params[:2], 40.0, *c.params[3:])) for n, c in cameras.items()}
    write_cameras(dataset.cameras_file("S001"), other)
    main(["check", str(dataset.root), "--fix"])
    assert "since then these changed: cameras" in capsys.readouterr().out and path.is_file()
    for _ in range(2):  # the second time, too, the stage makes nothing in its place
        failed = run_here(TRACK, dataset)
        assert "since then these changed: cameras" in failed.outcomes[0].reason
        assert not path.exists()
    assert (dataset.stale_dir / "track/S001/track.npz").read_bytes() == before
    assert main(["import", "remove", str(dataset.root), "track"]) == 0
    assert main(["import", "remove", str(dataset.root), "track"]) == 0
    assert "0 imported items removed; none matches '*'" in capsys.readouterr().out
    with Ledger(dataset.ledger) as ledger:
        assert ledger.read("track") == {}


def masks_of(dataset: Dataset, folder: Path, write) -> str:
    for expression in ("neutral", "smile"):
        for camera in read_cameras_of(dataset, "S001"):
            alpha = read_alpha(dataset.matte_file("S001", expression, camera))
            path = folder / expression / f"{camera}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path, alpha)
    return str(folder / "{expression}" / "{camera}.png")


MASKS = {
    "grey": write_image,
    "binary": lambda path, alpha: write_image(path, (alpha > 127).astype(np.uint8)),
    "sixteen bits": lambda path, alpha: write_image(path, alpha.astype(np.uint16) * 257),
    "rgba": lambda path, alpha: write_image(path, np.dstack([alpha // 2] * 3 + [alpha])),
}


@pytest.mark.parametrize("kind", sorted(MASKS))
def test_masks_of_every_kind_become_mattes(original, dataset, tmp_path, kind) -> None:
    pattern = masks_of(dataset, tmp_path / "masks", MASKS[kind])
    for expression in ("neutral", "smile"):
        shutil.rmtree(dataset.item_dir("matte", f"S001/{expression}"))
    assert take("matte", dataset, pattern) == 0
    for camera in read_cameras_of(dataset, "S001"):
        found = read_alpha(dataset.matte_file("S001", "smile", camera))
        true = read_alpha(original[0].matte_file("S001", "smile", camera))
        expected = np.where(true > 127, 255, 0) if kind == "binary" else true
        np.testing.assert_array_equal(found, expected)
    done = run_here(MATTE, dataset)
    assert done.count("skipped") == 2


def test_masks_of_recorded_or_reduced_size_fit_reduced_pictures(dataset, tmp_path, capsys) -> None:
    pattern = masks_of(dataset, tmp_path / "masks", write_image)
    true = read_alpha(dataset.matte_file("S001", "smile", "cam01"))
    assert run_here(FRAMES, dataset, image_side=48).ok
    reduced = tmp_path / "masks" / "smile" / "cam02.png"
    write_image(reduced, shrink(read_alpha(reduced), 48))
    assert take("matte", dataset, pattern) == 0
    found = read_alpha(dataset.matte_file("S001", "smile", "cam01"))
    np.testing.assert_array_equal(found, shrink(true, 48))
    assert read_alpha(dataset.matte_file("S001", "smile", "cam02")).shape == (48, 48)
    assert run_here(FRAMES, dataset).ok
    failed = run_here(MATTE, dataset)
    assert failed.count("failed") == 2
    for outcome in failed.outcomes:  # no later stage may read a matte of other pictures
        assert "since then these changed: size of pictures" in outcome.reason
        assert not dataset.item_dir("matte", outcome.item).exists()


def test_places_of_a_pattern_are_filled_at_any_width() -> None:
    peak = PeakFrame(expression="smile", frame=345, clip_frame=5)
    pattern = "{subject}/{frame:012d}_{clip_frame:03}_{frame}.png"
    assert check_pattern(pattern, ("frame",)) == {"subject", "frame", "clip_frame"}
    assert fill(pattern, "S001", peak) == Path("S001/000000000345_005_345.png")


def test_a_subject_without_masks_does_not_stop_the_others(tmp_path, capsys) -> None:
    dataset = make_dataset(tmp_path, subjects=("S001", "S002"), cameras=CAMERAS, size=SIZE)
    pattern = masks_of(dataset, tmp_path / "masks" / "S002", write_image)
    pattern = pattern.replace("/S002/", "/{subject}/")
    capsys.readouterr()
    assert take("matte", dataset, pattern) == 1
    said, shown = capsys.readouterr()
    begun = "import matte: checking 2 items against the footage\n"
    assert f"{begun}matte 1/2 S002/neutral done" in shown
    assert "= 2 done + 1 failed" in said
    assert "failed S001: StageError: S001: 12 of 12 files are missing" in said
    done = run_here(MATTE, dataset, ["S002/smile"])
    assert any("kept 1 imported" in line and "DATASET matte'" in line for line in done.lines())


def test_tracks_and_depth_of_the_recorded_size_fit_reduced_pictures(
    original, dataset, tmp_path
) -> None:
    pattern = depths_of(dataset, tmp_path / "depth", as_exr)
    track = read_track(dataset.track_file("S001"))
    assert run_here(FRAMES, dataset, image_side=48).ok
    assert take("track", dataset, original[1], f"--head={original[2]}") == 0
    found = read_track(dataset.track_file("S001"))
    np.testing.assert_allclose(found.vertices, track.vertices, atol=1e-5)
    for expression in ("neutral", "smile"):
        shutil.rmtree(dataset.item_dir("matte", f"S001/{expression}"))
    assert take("depth", dataset, pattern, "--unit=m") == 0
    camera = read_cameras_of(dataset, "S001")["cam02"]
    _, alpha, true = render(camera)
    depth, valid = read_depth(dataset.item_dir("depth", "S001/smile") / "cam02.png")
    assert depth.shape == (camera.height, camera.width) == (48, 48)
    inside = valid & (alpha == 1)
    assert inside.sum() > 0.9 * (alpha == 1).sum()
    assert np.median(np.abs(depth - true)[inside]) < 3e-4, "pixels of 7 mm"
    assert abs(np.median((depth - true)[:, :24][inside[:, :24]])) < 1e-4, "not shifted"


def test_masks_that_do_not_fit_are_named(dataset, tmp_path, capsys) -> None:
    pattern = masks_of(dataset, tmp_path / "masks", write_image)
    folder = tmp_path / "masks" / "smile"
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}

    def line() -> str:
        assert take("matte", dataset, pattern) == 1
        for name, data in kept.items():
            (folder / name).write_bytes(data)
        return error_of(capsys)

    alpha = read_alpha(folder / "cam01.png")
    write_image(folder / "cam01.png", alpha[::2, ::2])
    assert "48x48, expected the 96x96 of camera cam01" in line()
    write_image(folder / "cam01.png", np.zeros_like(alpha))
    assert "the mask of cam01 is empty" in line()
    write_image(folder / "cam01.png", np.pad(alpha[:, 26:], ((0, 0), (0, 26))))
    assert "the mask of cam01 does not show" in line()
    (folder / "cam01.png").unlink()
    assert "1 of 12 files are missing" in line()
    assert take("matte", dataset, str(tmp_path / "{view}.png")) == 2
    assert "unknown placeholder {view}" in error_of(capsys)


def depths_of(dataset: Dataset, folder: Path, write, change=lambda depth, rays: depth) -> str:
    for name, camera in read_cameras_of(dataset, "S001").items():
        depth = change(render(camera)[2], ray_lengths(camera))
        for expression in ("neutral", "smile"):
            path = folder / expression / name
            path.parent.mkdir(parents=True, exist_ok=True)
            ending = write(path, depth.astype(np.float32))
    return str(folder / "{expression}" / ("{camera}" + ending))


def as_png(path: Path, depth: np.ndarray) -> str:
    write_image(path.with_suffix(".png"), np.rint(depth * 1e4).astype(np.uint16))
    return ".png"


def as_exr(path: Path, depth: np.ndarray) -> str:
    write_image(path.with_suffix(".exr"), depth)
    return ".exr"


def as_npy(path: Path, depth: np.ndarray) -> str:
    np.save(path.with_suffix(".npy"), np.where(depth > 0, depth * 1000, np.nan))
    return ".npy"


DEPTHS = {"png": (as_png, "0.0001"), "exr": (as_exr, "m"), "npy": (as_npy, "mm")}


@pytest.mark.parametrize("kind", sorted(DEPTHS))
def test_depth_of_every_kind_becomes_depth_and_surface(dataset, tmp_path, kind) -> None:
    write, unit = DEPTHS[kind]
    pattern = depths_of(dataset, tmp_path / "depth", write)
    assert take("depth", dataset, pattern, f"--unit={unit}") == 0
    camera = read_cameras_of(dataset, "S001")["cam02"]
    _, alpha, true = render(camera)
    depth, valid = read_depth(dataset.item_dir("depth", "S001/smile") / "cam02.png")
    inside = valid & (true > 0)
    assert inside.sum() > 0.9 * (alpha > 0.5).sum()
    assert np.abs(depth - true)[inside].max() < 1e-4
    surface = read_surface(dataset.surface_file("S001", "smile"))
    from tests.pipelines.bump_head import distance

    assert len(surface.faces) > 500
    assert np.median(np.abs(distance(surface.vertices))) < 2e-3  # pixels of 3.4 mm
    done = run_here(DEPTH, dataset)
    assert done.count("skipped") == 2


def test_a_background_at_infinity_in_numbers_is_unknown(dataset, tmp_path) -> None:
    def blender(depth, rays):
        return np.where(depth > 0, depth, 1e10)

    pattern = depths_of(dataset, tmp_path / "depth", as_exr, blender)
    shutil.rmtree(dataset.stage_dir("matte"))  # nothing else says where the background is
    assert take("depth", dataset, pattern, "--unit=m") == 0
    depth, valid = read_depth(dataset.item_dir("depth", "S001/smile") / "cam02.png")
    assert 0 < valid.mean() < 0.9 and depth.max() < 10


def test_depth_with_a_wrong_unit_or_measure_is_named(dataset, tmp_path, capsys) -> None:
    def line(change, *options: str) -> str:
        pattern = depths_of(dataset, tmp_path / "depth", as_exr, change)
        assert take("depth", dataset, pattern, *options) == 1
        lines = capsys.readouterr().out.splitlines()
        assert sum("failed S001/neutral" in line for line in lines) == 1
        assert not dataset.item_dir("depth", "S001/neutral").exists()
        return lines[1]

    plain = lambda depth, rays: depth  # noqa: E731
    assert "its unit is 0.001 times as large" in line(lambda d, rays: 1000 * d, "--unit=m")
    assert "its unit is 1000 times as large" in line(plain, "--unit=mm")
    assert "negative" in line(lambda depth, rays: -depth, "--unit=m")
    assert "differ" in line(lambda depth, rays: 0.93 * depth, "--unit=m")
    pattern = depths_of(dataset, tmp_path / "rays", as_exr, lambda depth, rays: depth * rays)
    assert take("depth", dataset, pattern, "--unit=m", "--ray") == 0
    assert take("depth", dataset, pattern, "--unit=inch") == 2


def test_an_empty_map_is_named_and_the_others_are_fused(dataset, tmp_path, capsys) -> None:
    pattern = depths_of(dataset, tmp_path / "depth", as_npy)
    blank = np.full((SIZE, SIZE), np.nan)
    np.save(pattern.format(expression="smile", camera="cam02"), blank)
    for camera in read_cameras_of(dataset, "S001"):
        np.save(pattern.format(expression="neutral", camera=camera), blank)
    assert take("depth", dataset, pattern, "--unit=mm") == 1
    said = capsys.readouterr().out
    assert "= 1 done + 1 failed" in said and "unexpected" not in said
    assert "warning S001/smile: cam02: depth is unknown everywhere inside the matte" in said
    assert "S001/neutral: its depth maps have no known depth inside the mattes" in said


def face(cameras: dict, points: np.ndarray) -> Observation:
    from express50.geometry.cameras import project_pinhole

    views = tuple(
        LandmarkView(camera, project_pinhole(camera, points)[0], np.ones(68), 1.0)
        for name, camera in cameras.items()
    )
    covariance = np.full((68, 3, 3), 1e-6)
    return Observation("smile", 1, views, np.ones((len(views), 68), bool), points, covariance)


def test_the_faces_of_the_footage_tell_other_subjects_apart(original) -> None:
    cameras = read_cameras_of(original[0], "S001")
    points = np.random.default_rng(0).uniform([-0.06, -0.07, 0.06], [0.06, 0.05, 0.09], (68, 3))
    seen = face(cameras, points)
    assert check_landmarks(None, points, "x") is None
    assert check_landmarks(seen, points + 0.001, "x") < 0.03
    with pytest.raises(StageError, match="another subject"):
        check_landmarks(seen, points + [0.03, 0, 0], "x")
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[22:-22, 22:-22] = 255
    check_masks_show_face(seen, dict.fromkeys(cameras, mask), "x")
    with pytest.raises(StageError, match="inverted"):
        check_masks_show_face(seen, dict.fromkeys(cameras, 255 - mask), "x")
    other = np.where(np.arange(SIZE) > 74, 255, 0).astype(np.uint8)[None].repeat(SIZE, 0)
    with pytest.raises(StageError, match="another subject"):
        check_masks_show_face(seen, dict.fromkeys(cameras, other), "x")


def test_outlines_lie_where_their_pictures_have_edges(original) -> None:
    rgb, alpha, _ = render(read_cameras_of(original[0], "S001")["cam02"])
    own = (alpha * 255).astype(np.uint8)
    assert edge_contrast(rgb, own) > 2.5
    for wrong in (cv2.erode(own, np.ones((7, 7))), np.roll(own, 12, 1)):
        assert edge_contrast(rgb, wrong) < 1.5
