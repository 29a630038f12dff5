"""Writes small captures in the layouts that datasets publish, of one rig and known pictures."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from pathlib import Path

import cv2
import h5py
import numpy as np
from PIL import Image

from express50.files.images import encode_jpeg, encode_png
from express50.geometry.cameras import Camera, resized
from express50.geometry.conventions import K_to_opencv, opengl_from_cam_from_world
from express50.geometry.transforms import look_at
from tests.express50.rigs import test_read

WIDTH, HEIGHT = 64, 96
SHAPE = (HEIGHT, WIDTH, 3)


def rig(names, size=(WIDTH, HEIGHT)):
    """Cameras on an arc about a head at (0, 1.2, 0), 1.1 m away."""
    found = {}
    for number, name in enumerate(names):
        angle = np.radians(-50 + 100 * number / max(1, len(names) - 1))
        eye = np.array([1.1 * np.sin(angle), 1.25, 1.1 * np.cos(angle)])
        pose = look_at(eye, np.array([0, 1.2, 0]))
        focal = 1.9 * size[0] + number
        params = (focal, focal, size[0] / 2 + 1.0, size[1] / 2 - 1.0)
        found[name] = Camera(name, *size, "PINHOLE", params, pose)
    return found


def picture(camera: int, frame: int, shape=SHAPE) -> np.ndarray:
    """Blocks that differ by camera and frame, smooth enough for any codec."""
    cells = np.random.default_rng([camera, frame]).integers(40, 210, (12, 8, 3), dtype=np.uint8)
    return cv2.resize(cells, shape[1::-1], interpolation=cv2.INTER_NEAREST)


def jpeg_array(image: np.ndarray) -> np.ndarray:
    return np.frombuffer(encode_jpeg(image, 98), np.uint8)


def write_smc(path: Path, names, frames, *, cameras=True, pictures=True, lacking=(), num=None):
    """A RenderMe-360 file; ``lacking`` are (camera number, frame) without a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs.update({"actor_id": "0026", "age": 27, "gender": "female", "weight": 61.0})
        group = file.create_group("Camera")
        group.attrs["num_device"] = len(names)
        group.attrs["num_frame"] = len(frames) if num is None else num
        group.attrs["resolution"] = np.array([HEIGHT, WIDTH])
        for number, name in enumerate(names):
            for frame in frames if pictures else ():
                if (number, frame) not in lacking:
                    data = jpeg_array(picture(number, frame))
                    group[f"{name[3:]}/color/{frame}"] = data
        for name, camera in rig(names).items() if cameras else ():
            row = file.create_group(f"Calibration/{name[3:]}")
            row["K"], row["D"] = K_to_opencv(camera.K), np.zeros(5)
            row["RT"] = np.linalg.inv(camera.cam_from_world)  # camera to world


def write_renderme(root: Path, cameras=4, expressions=3, frames=5) -> Path:
    """The full release: pictures in raw/0026, cameras in anno/0026."""
    names = [f"cam{n:02d}" for n in range(cameras)]
    for number in range(expressions):
        stem = f"0026_e{number}"
        write_smc(root / "raw/0026" / f"{stem}_raw.smc", names, range(frames), cameras=False)
        write_smc(root / "anno/0026" / f"{stem}_anno.smc", names, range(frames), pictures=False)
    return root / "raw" / "0026"


CCM = [[1.1, 0.02, -0.03, 0.05, 0.01, 0.0, 0.01], [0.0, 0.9, 0.04, 0.0, 0.0, 0.02, 0.0],
       [0.01, 0.0, 1.05, 0.0, 0.03, 0.0, -0.01]]  # fmt: skip


def write_nersemble(root: Path, write_video, sequences=("EMO-1-shout+laugh", "EXP-1-head"), size=5):
    """A participant with three cameras; K belongs to 2200 x 3208 footage."""
    names = ["222200036", "222200037", "222200038"]
    small = (55 * 2, 80 * 2)  # 2200 x 3208 less than a percent off, and even for 4:2:0
    full = {n: resized(c, 2200, 3208) for n, c in rig(names, small).items()}
    path = root / "018"
    (path / "calibration").mkdir(parents=True)
    table = {
        "world_2_cam": {n: c.cam_from_world.tolist() for n, c in full.items()},
        "intrinsics": {n: K_to_opencv(c.K).tolist() for n, c in full.items()},
    }
    (path / "calibration/camera_params.json").write_text(json.dumps(table))
    (path / "calibration/color_calibration.json").write_text(json.dumps(dict.fromkeys(names, CCM)))
    for sequence in sequences:
        folder = path / "sequences" / sequence / "images"
        folder.mkdir(parents=True)
        for number, name in enumerate(names):
            images = [picture(number, f, (small[1], small[0], 3)) for f in range(size)]
            write_video(folder / f"cam_{name}.mp4", images)
    background = path / "sequences" / "BACKGROUND"
    background.mkdir()
    for number, name in enumerate(names):
        image = picture(number, 99, (small[1], small[0], 3))
        (background / f"image_{name}.jpg").write_bytes(encode_jpeg(image, 98))
    return path


def avif(image: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(image).save(data, "AVIF", quality=95, speed=10)
    return data.getvalue()


AVA_FRAMES = [("EXP_neutral_peak", n) for n in (100, 103, 106)] + [
    ("EXP_free_face", n) for n in (250, 251, 260, 261)
]


def write_ava(root: Path, missing=(), unpublished=()) -> Path:
    """A capture of four cameras; K is for 2668 x 4096, pictures are a sixteenth; millimetres."""
    path = root / "20220818--1122--ABC123"
    names = [f"cam{n}" for n in (400981, 401031, 401045, 401163)]
    small = (167, 256)
    (path / "decoder/image").mkdir(parents=True)
    rows = []
    for name, camera in rig(names, small).items():
        full = resized(camera, 2668, 4096)
        pose = full.cam_from_world.copy()
        pose[:3, 3] *= 1e3
        rows.append({
            "cameraId": name[3:], "projectionModel": "pinhole",
            "distortionModel": "RadialAndTangential", "distortion": [0.0] * 4,
            "K": K_to_opencv(full.K).T.tolist(), "T": pose.T.tolist(),
        })  # fmt: skip
    (path / "decoder/camera_calibration.json").write_text(json.dumps({"KRT": rows}))
    with (path / "decoder/frame_list.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("seg_id", "frame_id"), *AVA_FRAMES])
    shape = (small[1], small[0], 3)
    for number, name in enumerate(names):
        with zipfile.ZipFile(path / f"decoder/image/{name}.zip", "w") as archive:
            for _, frame in AVA_FRAMES:
                if (number, frame) not in missing and frame not in unpublished:
                    data = avif(picture(number, frame, shape))
                    archive.writestr(f"{name}/{frame:06d}.avif", data)
    return path


def write_multiface(root: Path) -> Path:
    """A capture of three cameras and two segments, millimetres; pictures at half size."""
    path = root / "m--20180227--0000--6795937--GHS"
    names = ["400002", "400004", "400008"]
    small = (334, 512)
    blocks = []
    frames = [("E001_Neutral_Eyes_Open", n) for n in (7, 8)] + [("E010_Smile", 31)]
    for number, (name, camera) in enumerate(rig(names, small).items()):
        full = resized(camera, 1334, 2048)
        pose = full.cam_from_world[:3].copy()
        pose[:, 3] *= 1e3
        rows = [*K_to_opencv(full.K), np.zeros(5), *pose]
        blocks.append("\n".join([name, *(" ".join(map(repr, map(float, r))) for r in rows)]))
        for segment, frame in frames:
            folder = path / "images" / segment / name
            folder.mkdir(parents=True, exist_ok=True)
            data = encode_png(picture(number, frame, (small[1], small[0], 3)))
            (folder / f"{frame:06d}.png").write_bytes(data)
    (path / "KRT").write_text("\n\n".join(blocks) + "\n\n")
    (path / "frame_list.txt").write_text("".join(f"{s} {n:06d}\n" for s, n in frames))
    return path


def write_transforms(root: Path, steps=2) -> Path:
    """Four cameras and two time steps, as VHAP and GaussianAvatars have them."""
    path = root / "avatar"
    (path / "images").mkdir(parents=True)
    frames = []
    for step in range(steps):
        for number, camera in enumerate(rig([f"cam{n:02d}" for n in range(4)]).values()):
            name = f"images/{step:05d}_{number:02d}.png"
            (path / name).write_bytes(encode_png(picture(number, step)))
            frames.append({
                "file_path": f"./{name}", "timestep_index": step, "camera_index": number,
                "transform_matrix": opengl_from_cam_from_world(camera.cam_from_world).tolist(),
                "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2],
                "cy": camera.K[1, 2], "w": camera.width, "h": camera.height,
            })  # fmt: skip
    (path / "transforms.json").write_text(json.dumps({"frames": frames}))
    return path


def write_colmap(root: Path) -> Path:
    """Four photographs with a COLMAP model in sparse/0, as text."""
    path, cameras = root / "scan", rig([f"p{n}" for n in range(4)])
    (path / "images").mkdir(parents=True)
    for number, name in enumerate(cameras):
        (path / "images" / f"{name}.png").write_bytes(encode_png(picture(number, 0)))
    test_read.write_colmap(path / "sparse/0", cameras)
    return path
