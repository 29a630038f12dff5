"""Rigs written in other tools' layouts come back as the cameras they were."""

import json
from functools import partial

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from express50.errors import CalibrationError
from express50.files.calibration import write_cameras
from express50.geometry.cameras import Camera, project, resized
from express50.geometry.conventions import K_to_opencv, opengl_from_cam_from_world
from express50.geometry.transforms import look_at, matrix_to_axis_angle
from express50.rigs.camera_builder import names_from_files
from express50.rigs.read import guess_format, read_rig

HEAD = np.array([[0.02, 1.3, 0.05], [-0.05, 1.22, -0.03], [0.0, 1.25, 0.0]])


def make_rig(count=4, dist=(-0.11, 0.07, 0.001, -0.002), size=(640, 480)):
    rig = {}
    for k in range(count):
        angle = np.radians(-60 + 40 * k)
        eye = np.array([np.sin(angle), 1.3 + 0.05 * k, np.cos(angle)])
        pose = look_at(eye, np.array([0, 1.25, 0]))
        params = (900.0 + k, 905.0, size[0] / 2 + 3, size[1] / 2 - 2, *dist)
        model = "OPENCV" if dist else "PINHOLE"
        rig[f"cam{k:02d}"] = Camera(f"cam{k:02d}", *size, model, params, pose)
    return rig


def assert_same(found, expected):
    assert sorted(found) == sorted(expected)
    for name, camera in expected.items():
        other = found[name]
        assert (other.width, other.height) == (camera.width, camera.height)
        pixels, wanted = project(other, HEAD)[0], project(camera, HEAD)[0]
        np.testing.assert_allclose(pixels, wanted, atol=1e-6, rtol=0)


def write_colmap(folder, rig):
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(rig.items(), 1):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model=camera.model, width=camera.width, height=camera.height,
                params=list(camera.params), camera_id=number,
            )
        )  # fmt: skip
        image = pycolmap.Image(name=f"{name}.png", camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(camera.cam_from_world[:3])
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    model.write_text(str(folder))


def write_transforms(path, rig, extra=()):
    frames = [
        {
            "file_path": f"images/{name}.png",
            "transform_matrix": opengl_from_cam_from_world(camera.cam_from_world).tolist(),
            "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2], "cy": camera.K[1, 2], "w": camera.width, "h": camera.height,
            **dict(zip(("k1", "k2", "p1", "p2"), camera.dist[:4].tolist(), strict=True)),
        }
        for name, camera in rig.items()
    ]  # fmt: skip
    path.write_text(json.dumps({"frames": frames, **dict(extra)}))


def write_yaml(folder, rig, rodrigues=False):
    folder.mkdir()
    for name, camera in rig.items():
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", K_to_opencv(camera.K))
        storage.write("distortion_coefficients", camera.dist[:5, None])
        R = camera.cam_from_world[:3, :3]
        if rodrigues:
            storage.write("rvec", matrix_to_axis_angle(R)[:, None])
        else:
            storage.write("R", R)
        storage.write("T", camera.cam_from_world[:3, 3:])
        storage.release()


def write_easymocap(folder, rig):
    """Both files name all cameras; sizes are not always given."""
    folder.mkdir()
    names = [name.removeprefix("cam") for name in rig]
    storages = [
        cv2.FileStorage(str(folder / f"{part}.yml"), cv2.FILE_STORAGE_WRITE)
        for part in ("intri", "extri")
    ]
    for storage in storages:
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in names:
            storage.write("", name)
        storage.endWriteStruct()
    for name, camera in zip(names, rig.values(), strict=True):
        R = camera.cam_from_world[:3, :3]
        storages[0].write(f"K_{name}", K_to_opencv(camera.K))
        storages[0].write(f"dist_{name}", camera.dist[:5, None])
        storages[1].write(f"R_{name}", matrix_to_axis_angle(R)[:, None])
        storages[1].write(f"Rot_{name}", R)
        storages[1].write(f"T_{name}", camera.cam_from_world[:3, 3:])
    for storage in storages:
        storage.release()


ROUND_TRIPS = {
    "colmap": ("colmap", write_colmap),
    "transforms": ("transforms", write_transforms),
    "opencv": ("opencv", write_yaml),
    "opencv-rodrigues": ("opencv", partial(write_yaml, rodrigues=True)),
}


@pytest.mark.parametrize(("kind", "write"), ROUND_TRIPS.values(), ids=ROUND_TRIPS.keys())
def test_cameras_come_back_as_they_were_written(tmp_path, kind, write):
    path, rig = tmp_path / "transforms.json", make_rig()
    write(path, rig)
    assert guess_format(path) == kind
    assert_same(read_rig(path), rig)


def test_easymocaps_two_files_hold_all_cameras(tmp_path):
    path, rig = tmp_path / "calibration", make_rig()
    write_easymocap(path, rig)
    expected = {name.removeprefix("cam"): camera for name, camera in rig.items()}
    for given in (path, path / "intri.yml", path / "extri.yml"):
        assert guess_format(given) == "opencv"
        assert_same(read_rig(given, size=(640, 480)), expected)
    with pytest.raises(
        CalibrationError, match="images' size; pass --size .* to 'express50 cameras'"
    ):
        read_rig(path)
    (path / "extri.yml").unlink()
    with pytest.raises(CalibrationError, match=r"intri.yml: expected a 3 x 3 matrix called"):
        read_rig(path)


def test_colmap_fisheye_is_refused_by_name(tmp_path):
    write_colmap(tmp_path / "sparse", make_rig(dist=()))
    file = tmp_path / "sparse" / "cameras.txt"
    rows = [row.split() for row in file.read_text().splitlines()]
    for row in rows:
        if "PINHOLE" in row:
            row[1], row[8:] = "OPENCV_FISHEYE", ["0", "0", "0", "0"]
    file.write_text("\n".join(map(" ".join, rows)))
    with pytest.raises(CalibrationError, match="OPENCV_FISHEYE.*image_undistorter"):
        read_rig(tmp_path / "sparse")


@pytest.mark.parametrize(
    ("extra", "words"),
    [({"is_fisheye": True}, "is_fisheye.*undistort"), ({"k4": 0.1}, "k4 is 0.1.*undistort")],
)
def test_lenses_that_opencv_lacks_are_refused(tmp_path, extra, words):
    write_transforms(tmp_path / "transforms.json", make_rig(), extra)
    with pytest.raises(CalibrationError, match=words):
        read_rig(tmp_path)


def test_angles_of_view_give_both_focal_lengths(tmp_path):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "w": 20, "h": 10}
    for angles, expected in (
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.9}, 5 / np.tan(0.45)),
        ({"camera_angle_x": 1.0}, 10 / np.tan(0.5)),
    ):
        (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame], **angles}))
        K = read_rig(tmp_path)["a"].K
        assert K[0, 0] == pytest.approx(10 / np.tan(0.5)) and K[1, 1] == pytest.approx(expected)


def test_two_files_that_would_be_one_camera_are_refused(tmp_path):
    frame = {"transform_matrix": np.eye(4).tolist(), "fl_x": 9.0, "w": 20, "h": 10}
    frames = [frame | {"file_path": f"images/{name}.png"} for name in ("a b", "a_b")]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(CalibrationError, match="images/a b.png and images/a_b.png are both camera"):
        read_rig(tmp_path)


def test_matrices_may_be_lists_of_rows(tmp_path):
    rig = make_rig(count=2)
    write_yaml(tmp_path / "rig", rig)
    camera = rig["cam00"]
    (file,) = (tmp_path / "rig").glob("cam00*")
    rows = {
        "camera_matrix": K_to_opencv(camera.K), "R": camera.cam_from_world[:3, :3],
        "T": camera.cam_from_world[:3, 3:],
    }  # fmt: skip
    text = f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
    text += "".join(f"{key}: {value.tolist()}\n" for key, value in rows.items())
    text += f"distortion_coefficients: {camera.dist[:5].tolist()}\n"
    file.write_text(text)
    assert_same(read_rig(tmp_path / "rig"), rig)
    file.write_text(text.replace("R: [[", "R: [[0.5, "))
    with pytest.raises(CalibrationError, match="R cannot be read as a matrix"):
        read_rig(tmp_path / "rig")


def test_transforms_of_many_time_steps_share_cameras_and_must_not_move(tmp_path):
    rig = make_rig(count=2)
    path = tmp_path / "transforms.json"
    write_transforms(path, rig)
    frames = json.loads(path.read_text())["frames"]
    steps = [
        f | {"file_path": f"images/{t:05d}_{k:02d}.png", "camera_index": k, "timestep_index": t}
        for t in range(3)
        for k, f in enumerate(frames)
    ]
    path.write_text(json.dumps({"frames": steps}))
    assert_same(read_rig(path), rig)
    steps[-1] = steps[-1] | {"transform_matrix": np.eye(4).tolist()}
    path.write_text(json.dumps({"frames": steps}))
    with pytest.raises(CalibrationError, match="cam01 moves between frames"):
        read_rig(path)


def test_transforms_by_angle_of_view_need_a_size(tmp_path):
    pose = opengl_from_cam_from_world(make_rig()["cam00"].cam_from_world).tolist()
    path = tmp_path / "t.json"
    frames = [{"file_path": "r_0", "transform_matrix": pose}]
    path.write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames}))
    with pytest.raises(CalibrationError, match="--size"):
        read_rig(path)
    camera = read_rig(path, size=(800, 600))["r_0"]
    np.testing.assert_allclose(camera.K, [[400, 0, 400], [0, 400, 300], [0, 0, 1]])


def test_yaml_without_pose_names_file_and_keys(tmp_path):
    write_yaml(tmp_path / "yaml", make_rig())
    file = tmp_path / "yaml" / "cam02.yml"
    file.write_text(file.read_text().replace("\nT:", "\nelsewhere:"))
    with pytest.raises(CalibrationError, match=r"cam02\.yml: no pose; expected R .* T or"):
        read_rig(tmp_path / "yaml")


def test_nersemble_shared_and_own_intrinsics_scale_to_the_footage(tmp_path):
    rig = make_rig(dist=(), size=(2200, 3208))
    serials = {f"2222000{k}": c for k, c in enumerate(rig.values())}
    table = {
        "world_2_cam": {s: c.cam_from_world.tolist() for s, c in serials.items()},
        "intrinsics": {s: K_to_opencv(c.K).tolist() for s, c in serials.items()},
    }
    path = tmp_path / "camera_params.json"
    path.write_text(json.dumps(table))
    assert guess_format(path) == "nersemble"
    assert_same(read_rig(path), serials)
    half = {s: resized(c, 1100, 1604) for s, c in serials.items()}
    assert_same(read_rig(path, size=(1100, 1604)), half)
    table["intrinsics"] = table["intrinsics"]["22220000"]
    path.write_text(json.dumps(table))
    assert len(read_rig(path)) == 4
    with pytest.raises(CalibrationError, match="same aspect ratio"):
        read_rig(path, size=(1100, 1100))


def test_renderme_reads_camera_to_world_and_names_the_file_that_has_none(tmp_path):
    rig = make_rig(dist=(), size=(2448, 2048))
    path = tmp_path / "0026_e0_anno.smc"
    with h5py.File(path, "w") as file:
        file.create_group("Camera").attrs["resolution"] = np.array([2048, 2448])
        for number, camera in enumerate(rig.values()):
            group = file.create_group(f"Calibration/{number:02d}")
            group["K"] = K_to_opencv(camera.K)
            group["D"] = np.zeros(5)
            group["RT"] = np.linalg.inv(camera.cam_from_world)
    assert guess_format(path) == "renderme360"
    assert_same(read_rig(path), rig)
    raw = tmp_path / "0026_e0_raw.smc"
    with h5py.File(raw, "w") as file:
        file.create_group("Camera")
    with pytest.raises(CalibrationError, match="0026_e0_anno.smc"):
        read_rig(raw)


def test_units_become_metres(tmp_path):
    rig = make_rig()
    write_cameras(tmp_path / "c.json", rig)
    found = read_rig(tmp_path / "c.json", metres_per_unit=1e-3)
    np.testing.assert_allclose(found["cam01"].center, 1e-3 * rig["cam01"].center)
    with pytest.raises(CalibrationError, match="expected a positive number"):
        read_rig(tmp_path / "c.json", metres_per_unit=float("nan"))


@pytest.mark.parametrize("content", ["", "{}", "[1]", "\x00\x01", '{"frames": []}'])
def test_rubbish_is_one_clear_error(tmp_path, content):
    path = tmp_path / "rubbish.json"
    path.write_text(content)
    with pytest.raises(
        CalibrationError, match="known calibration.*'express50 cameras check|not JSON"
    ):
        read_rig(path)
    for kind in ("transforms", "nersemble", "express50", "renderme360"):
        with pytest.raises(CalibrationError, match="rubbish.json"):
            read_rig(path, kind)


def test_folders_are_answered_with_what_to_give(tmp_path):
    (tmp_path / "calibration.json").touch()
    with pytest.raises(CalibrationError, match="a capture; give its calibration.json"):
        read_rig(tmp_path)
    with pytest.raises(CalibrationError, match=r"holds no \.yml or \.yaml file"):
        read_rig(tmp_path, "opencv")
    with pytest.raises(CalibrationError, match="is a folder, expected an HDF5 file such as .smc$"):
        read_rig(tmp_path, "renderme360")


def test_thin_prism_distortion_is_refused(tmp_path):
    write_yaml(tmp_path / "yaml", make_rig(count=1))
    file = tmp_path / "yaml" / "cam00.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    K = storage.getNode("camera_matrix").mat()
    R, t = storage.getNode("R").mat(), storage.getNode("T").mat()
    storage.release()
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    rows = {"camera_matrix": K, "dist_coeffs": np.full((12, 1), 0.01), "R": R, "T": t}
    for key, value in rows.items():
        storage.write(key, value)
    storage.release()
    with pytest.raises(CalibrationError, match="thin-prism"):
        read_rig(file, size=(640, 480))


def test_names_come_from_folders_or_files():
    assert names_from_files(["cam00/0.jpg", "cam01/0.jpg"]) == ["cam00", "cam01"]
    assert names_from_files(["a.jpg", "b.jpg"]) == ["a", "b"]
    assert names_from_files(["images/a b.jpg", "images/c.jpg"]) == ["a_b", "c"]
    assert names_from_files(["cam.1+.jpg", "cam.2.jpg"]) == ["cam_1", "cam_2"]
    assert names_from_files(["x/a.jpg", "x/b.jpg", "y/a.jpg"]) == ["x_a", "x_b", "y_a"]
