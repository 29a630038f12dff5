"""Read the cameras of calibrators and photogrammetry tools.

- caliscope's camera_array.toml and aniposelib's calibration.toml (FreeMoCap, Pose2Sim): world to
  camera; axes, pixels and distortion are OpenCV's; a rotation is a matrix or a Rodrigues vector.
  The unit is the board's (metres in caliscope). caliscope's ``rotation_count`` only rotates
  pictures for display: the calibration is of pictures as recorded.
- Kalibr's camchain: ``T_cn_cnm1`` maps points from the previous camera to this one. The world is
  the first camera's; metres, OpenCV's pixels.
- Qualisys' .qca.txt: camera to world, OpenGL's axes, each row of ``r`` is an axis of the camera;
  millimetres. Intrinsics are in 64ths of a pixel from the corner of the whole sensor, of which
  ``fov_video`` is recorded, including its last row and column.
- Metashape: ``transform`` is camera to chunk, OpenCV's axes; the chunk's or the component's own
  transform maps it to the world. ``cx`` and ``cy`` are relative to the picture's centre, P1 and P2
  are OpenCV's p2 and p1, B1 is fx minus f, and B2 is skew.
- RealityCapture: one sidecar per picture. ``Rotation`` is world to camera by rows, OpenCV's axes;
  ``Position`` is the camera's position. Focal length (divided by 36 mm) and principal point (from
  the centre) are fractions of the longer side; the last two distortion terms are OpenCV's p2, p1.
- VGGT: ``extrinsic`` is world to camera, OpenCV's axes. ``intrinsic`` is for the network's input,
  whose centre is the principal point.
- IDR and NeuS: ``world_mat_<i>`` is K [R|t], world to pixels from the first pixel's centre;
  ``scale_mat_<i>`` only tells where the object is. FaceScape: ``<i>_K``, ``<i>_Rt`` and so on,
  world to camera; OpenCV's axes, pixels and distortion.
- Panoptic Studio: a list of cameras with ``K``, ``distCoef``, ``R`` and ``t``, world to camera;
  centimetres, OpenCV's axes and distortion.

Every reader raises CalibrationError if there are no cameras, a value is missing or malformed, or a
lens has a type or terms that OpenCV's model lacks.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element

import cv2
import h5py
import numpy as np

from express50.errors import CalibrationError, CaptureError
from express50.files.arrays import read_arrays
from express50.files.calibration import finite_array
from express50.files.containers import attribute, child, members, open_hdf5, read_array
from express50.files.text import identifier, read_json_table, read_toml, read_xml, read_yaml
from express50.geometry.cameras import Camera, resized
from express50.geometry.conventions import FLIP_YZ, K_from_opencv
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.camera_builder import (
    NO_SIZE,
    as_rig,
    camera_from_K,
    names_from_files,
    size_from,
)

SUBPIXELS = 64  # Qualisys' units per pixel
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
# Metashape's terms; the first ten are f, cx, cy, B1, B2, then OpenCV's distortion in its order.
TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "p2", "p1", "k3", "k4", "p3", "p4")
PATCH = 14  # pixels; VGGT rounds its input's height to a multiple of this, which stretches it


def read_calibration_toml(path: Path) -> dict[str, Camera]:
    """Read those cameras of caliscope or aniposelib that have a pose, in the file's unit.

    caliscope's are called ``cam_0`` and so on, like its videos; aniposelib's have names.
    """
    table = read_toml(path, CalibrationError)
    rows = table.get("cameras", table)
    if not isinstance(rows, dict):
        raise CalibrationError(f"{path}: cameras is not a table, expected [cameras.0] and so on")
    prefix = "cam_" if rows is not table else ""
    cameras = []
    for key, row in rows.items():
        if not isinstance(row, dict) or not {"rotation", "translation"} <= row.keys():
            continue
        where, name = f"{path}: [{key}]", identifier(str(row.get("name", f"{prefix}{key}")))
        if row.get("fisheye"):
            raise CalibrationError(
                f"{where}: is a fisheye, expected a perspective lens; undistort first"
            )
        rotation = row["rotation"]
        if isinstance(rotation, list) and not any(isinstance(entry, list) for entry in rotation):
            R = axis_angle_to_matrix(finite_array(rotation, (3,), f"{where} has rotation"))
        else:
            R = finite_array(rotation, (3, 3), f"{where} has rotation")
        t = finite_array(row["translation"], (3,), f"{where} has translation")
        size = size_from(row.get("size"), f"{where} has size")
        K = K_from_opencv(finite_array(row.get("matrix"), (3, 3), f"{where} has matrix"))
        dist = row.get("distortions", [])
        count = len(dist) if isinstance(dist, list) else 0
        dist = finite_array(dist, (count,), f"{where} has distortions")
        cameras.append(camera_from_K(name, K, dist, size, make_transform(R, t)))
    return as_rig(cameras, path)


def read_kalibr(path: Path) -> dict[str, Camera]:
    """Read the cameras of a camchain, metres; the world is that of ``cam0``."""
    table = read_yaml(path, CalibrationError)
    names = [f"cam{n}" for n in range(len(table))] if isinstance(table, dict) else []
    if not names or not all(isinstance(table.get(name), dict) for name in names):
        raise CalibrationError(f"{path}: expected tables cam0, cam1 and so on without a gap")
    cameras, pose = [], np.eye(4)
    for name in names:
        row, where = table[name], f"{path}: {name}"
        model = f"{row.get('camera_model')}-{row.get('distortion_model')}"
        if model not in ("pinhole-radtan", "pinhole-none"):
            raise CalibrationError(
                f"{where}: model {model[:60]}, expected pinhole-radtan; calibrate again with"
                " --models pinhole-radtan, or undistort first"
            )
        if name != names[0]:
            step = row.get("T_cn_cnm1")
            pose = finite_array(step, (4, 4), f"{where} has T_cn_cnm1") @ pose
        fx, fy, cx, cy = finite_array(row.get("intrinsics"), (4,), f"{where} has intrinsics")
        size = size_from(row.get("resolution"), f"{where} has resolution")
        K = K_from_opencv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        dist = np.zeros(0)
        if model.endswith("radtan"):
            terms = row.get("distortion_coeffs")
            dist = finite_array(terms, (4,), f"{where} has distortion_coeffs")
        cameras.append(camera_from_K(name, K, dist, size, pose))
    return as_rig(cameras, path)


def read_qualisys(path: Path) -> dict[str, Camera]:
    """Read the active cameras of a calibration exported by QTM, by serial number, metres."""
    cameras = read_xml(path, CalibrationError).iter("camera")
    kept = [c for c in cameras if c.get("active") != "0" and c.get("calibrated") != "false"]
    return as_rig((_qualisys_camera(path, camera) for camera in kept), path)


def _qualisys_camera(path: Path, camera: Element) -> Camera:
    serial = camera.get("serial", "")
    where = f"{path}: camera {serial}"

    def numbers(child: str, keys: str) -> np.ndarray:
        element, names = camera.find(child), keys.split()
        values = None if element is None else [element.get(name) for name in names]
        return finite_array(values, (len(names),), f"{where} has {keys} of {child}")

    left, top, right, bottom = numbers("fov_video", "left top right bottom")
    lens = numbers("intrinsic", "focalLengthU focalLengthV centerPointU centerPointV skew")
    fx, fy, cx, cy, skew = lens / SUBPIXELS
    K = np.array([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]])
    terms = "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2"
    dist = numbers("intrinsic", f"{terms} radialDistortion3")
    axes = numbers("transform", "r11 r12 r13 r21 r22 r23 r31 r32 r33").reshape(3, 3)
    place = 1e-3 * numbers("transform", "x y z")
    size = int(right - left) + 1, int(bottom - top) + 1
    pose = FLIP_YZ @ make_transform(axes, -axes @ place)
    return camera_from_K(serial, K, dist, size, pose)


def read_metashape(path: Path) -> dict[str, Camera]:
    """Read the aligned cameras of a chunk, named after their labels, in the chunk's unit."""
    chunks = list(read_xml(path, CalibrationError).iter("chunk"))
    aligned = [
        c for chunk in chunks for c in chunk.iter("camera") if c.find("transform") is not None
    ]
    parts = {camera.get("component_id", "") for camera in aligned}
    if len(chunks) != 1 or len(parts) != 1:
        raise CalibrationError(
            f"{path}: {len(chunks)} chunks, {len(aligned)} aligned cameras in {len(parts)}"
            " components; expected one chunk, aligned in one component: export only that"
        )
    # The similarity to the world is the component's, else the chunk's.
    part = parts.pop()
    inner = [c for c in chunks[0].iter("component") if c.get("id") == part]
    found = [e.find("transform") for e in [*inner, chunks[0]]]
    element = next((e for e in found if e is not None), None)
    motion = np.eye(4)
    if element is not None:
        where = f"{path}: the chunk's transform"
        turn = _numbers(where, element, "rotation", 9).reshape(3, 3)
        scale = _numbers(where, element, "scale", 1)
        motion = make_transform(turn * scale, _numbers(where, element, "translation", 3))
    sensors = {sensor.get("id"): sensor for sensor in chunks[0].iter("sensor")}
    names = names_from_files([camera.get("label", "") for camera in aligned])
    named = zip(names, aligned, strict=True)
    return as_rig((_metashape_camera(path, name, c, sensors, motion) for name, c in named), path)


def _metashape_camera(
    path: Path, name: str, camera: Element, sensors: dict[str | None, Element], motion: np.ndarray
) -> Camera:
    where = f"{path}: camera {camera.get('label')}"
    sensor = sensors.get(camera.get("sensor_id"))
    found = [] if sensor is None else sensor.findall("calibration")
    lens = next((c for c in found if c.get("class") == "adjusted"), found[-1] if found else None)
    if lens is None or lens.get("type") != "frame":
        raise CalibrationError(
            f"{where}: has no frame lens, expected an aligned camera that is not a fisheye;"
            " undistort first"
        )
    value = {e.tag: _numbers(where, lens, e.tag, 1)[0] for e in lens if e.tag in TERMS}
    odd = [key for key in ("k4", "p3", "p4") if value.get(key)]
    if odd or "f" not in value:
        raise CalibrationError(
            f"{where}: has {', '.join(odd) or 'no f'}, expected f and only cx cy b1 b2 k1 k2 k3 p1"
            " p2; optimise the cameras without other terms"
        )
    f, cx, cy, b1, b2, *dist = (value.get(key, 0.0) for key in TERMS[:10])
    resolution = lens.find("resolution")
    stated = [None if resolution is None else resolution.get(side) for side in ("width", "height")]
    width, height = size = size_from(stated, f"{where} has width and height")
    K = np.array([[f + b1, b2, width / 2 + cx], [0, f, height / 2 + cy], [0, 0, 1]])
    pose = motion @ _numbers(where, camera, "transform", 16).reshape(4, 4)
    turn = pose[:3, :3].T / max(np.cbrt(np.linalg.det(motion[:3, :3])), 1e-9)
    place = make_transform(turn, -turn @ pose[:3, 3])
    return camera_from_K(name, K, dist, size, place)


def _numbers(where: str, element: Element, child: str, count: int) -> np.ndarray:
    words = (element.findtext(child) or "").split()
    return finite_array(words, (count,), f"{where} has {child}")


def read_reality_capture(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Read an XMP sidecar, or a folder of them, named after the files, in the project's unit.

    ``size`` is the width and height of the pictures, which sidecars do not give.
    """
    if size is None:
        raise CalibrationError(f"{path}: {NO_SIZE}")
    files = sorted(path.glob("*.xmp")) if path.is_dir() else [path]
    named = zip(names_from_files([file.name for file in files]), files, strict=True)
    return as_rig((_sidecar(name, file, size) for name, file in named), path)


def _sidecar(name: str, path: Path, size: tuple[int, int]) -> Camera:
    value: dict[str, str] = {}  # properties are either attributes or elements
    for row in read_xml(path, CalibrationError).iter(f"{RDF}Description"):
        value |= row.attrib | {child.tag: child.text or "" for child in row}

    def numbers(key: str, count: int, absent: str = "") -> np.ndarray:
        words = value.get(XCR + key, absent).split()
        return finite_array(words, (count,), f"{path} has xcr:{key}")

    side = max(size)
    f = numbers("FocalLength35mm", 1)[0] * side / 36
    cx, cy = (numbers(f"PrincipalPoint{axis}", 1, "0")[0] * side for axis in "UV")
    K = np.array([[f, 0, size[0] / 2 + cx], [0, f, size[1] / 2 + cy], [0, 0, 1]])
    model = value.get(f"{XCR}DistortionModel", "")
    # RealityCapture's own spelling. Old releases leave out trailing zeros.
    count = min(len(value.get(f"{XCR}DistortionCoeficients", "").split()), 6)
    terms = np.pad(numbers("DistortionCoeficients", count), (0, 6 - count))
    k1, k2, k3, k4, t1, t2 = terms
    uneven = numbers("Skew", 1, "0")[0] or numbers("AspectRatio", 1, "1")[0] != 1
    if k4 or uneven or (terms.any() and not model.startswith("brown")):
        raise CalibrationError(
            f"{path}: lens {model[:40]} {terms.tolist()}, expected brown3 or brown3t2, no skew and"
            " square pixels; set that distortion model and align again"
        )
    R = numbers("Rotation", 9).reshape(3, 3)
    pose = make_transform(R, -R @ numbers("Position", 3))
    return camera_from_K(name, K, [k1, k2, t2, t1, k3], size, pose)


def read_vggt(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Read the cameras of a ``predictions.npz``, called ``cam00`` and so on in file order.

    The unit is the network's own. K is scaled to ``size`` if the network saw whole pictures, which
    means that their aspect ratios agree within its rounding.
    """
    names = ("extrinsic", "intrinsic")
    arrays = read_arrays(path, CalibrationError, "VGGT's predictions", names)
    # The model's own output has a batch of one.
    poses, matrices = (a[0] if a.ndim == 4 else a for a in (arrays[name] for name in names))
    count = len(np.atleast_1d(poses))
    poses = finite_array(poses, (count, 3, 4), f"{path} has extrinsic")
    matrices = finite_array(matrices, (count, 3, 3), f"{path} has intrinsic")
    cameras = []
    for number, (pose, K) in enumerate(zip(poses, matrices, strict=True)):
        own = round(2 * K[0, 2]), round(2 * K[1, 2])
        place = make_transform(pose[:, :3], pose[:, 3])
        cameras.append(camera_from_K(f"cam{number:02d}", K, [], own, place))
    found = as_rig(cameras, path)
    if size is None:
        return found
    off = {n: abs(size[1] * c.width / size[0] - c.height) for n, c in found.items()}
    return {n: resized(c, *size) if off[n] <= PATCH / 2 else c for n, c in found.items()}


def read_idr(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Read the projections of a ``cameras.npz``, named ``000`` and so on, as its pictures are.

    The unit is the file's own; ``size`` is the width and height of the pictures.
    """
    if size is None:
        raise CalibrationError(f"{path}: {NO_SIZE}")
    arrays = read_arrays(path, CalibrationError, "the cameras of IDR or NeuS")
    found = []
    for key in sorted(key for key in arrays if re.fullmatch(r"world_mat_\d{1,4}", key)):
        what = f"{path} has {key}"
        rows = 4 if arrays[key].shape == (4, 4) else 3
        P = finite_array(arrays[key], (rows, 4), what)[:3]
        sign = np.sign(np.linalg.det(P[:, :3]))  # P is known up to a factor
        if not sign:
            raise CalibrationError(f"{what} {P.tolist()}, expected K [R|t]; write the file again")
        K, R = cv2.decomposeProjectionMatrix(sign * P)[:2]
        pose = make_transform(R, np.linalg.solve(K, sign * P[:, 3]))
        name = f"{int(key.rpartition('_')[2]):03d}"
        found.append(camera_from_K(name, K_from_opencv(K / K[2, 2]), [], size, pose))
    return as_rig(found, path)


def read_facescape(path: Path) -> dict[str, Camera]:
    """Read the valid cameras of an expression's ``params.json``, named as its pictures."""
    table = read_json_table(path, CalibrationError)
    found = []
    for name in sorted(key.removesuffix("_valid") for key in table if key.endswith("_valid")):
        if not table[f"{name}_valid"]:
            continue
        what, K = f"{path}: camera {name} has an array", table.get(f"{name}_K")
        side = 4 if isinstance(K, list) and len(K) == 4 else 3
        lens = K_from_opencv(finite_array(K, (side, side), what)[:3, :3])
        pose = np.vstack([finite_array(table.get(f"{name}_Rt"), (3, 4), what), [0, 0, 0, 1]])
        size = size_from([table.get(f"{name}_{side}") for side in ("width", "height")], what)
        dist = finite_array(table.get(f"{name}_distortion"), (5,), what)
        found.append(camera_from_K(identifier(name), lens, dist, size, pose))
    return as_rig(found, path)


def read_panoptic(path: Path) -> dict[str, Camera]:
    """Read the cameras of CMU's Panoptic Studio, named as its videos, such as ``hd_00_05``."""
    rows = read_json_table(path, CalibrationError).get("cameras")
    found = []
    for row in filter(lambda row: isinstance(row, dict), rows if isinstance(rows, list) else []):
        name = identifier(f"{row.get('type')}_{row.get('name')}")
        what = f"{path}: camera {name} has an array"
        K, R = (finite_array(row.get(key), (3, 3), what) for key in ("K", "R"))
        pose = make_transform(R, 0.01 * finite_array(row.get("t"), (3, 1), what).ravel())
        dist = finite_array(row.get("distCoef"), (5,), what)
        size = size_from(row.get("resolution"), what)
        found.append(camera_from_K(name, K_from_opencv(K), dist, size, pose))
    return as_rig(found, path)


NERSEMBLE_SIZE = (2200, 3208)


def read_nersemble(path: Path) -> dict[str, Camera]:
    """Read cameras by serial number, at the release's full size."""
    table = read_json_table(path, CalibrationError)
    poses, intrinsics = table.get("world_2_cam"), table.get("intrinsics")
    if not isinstance(poses, dict) or intrinsics is None:
        raise CalibrationError(
            f"{path}: expected world_2_cam {{serial: 4 x 4}} and intrinsics (3 x 3, or a table by"
            " serial)"
        )
    found = []
    for serial, pose in poses.items():
        own = intrinsics.get(serial) if isinstance(intrinsics, dict) else intrinsics
        what = f"{path}: camera {serial} has an array"
        K, matrix = finite_array(own, (3, 3), what), finite_array(pose, (4, 4), what)
        found.append(camera_from_K(serial, K_from_opencv(K), [], NERSEMBLE_SIZE, matrix))
    return as_rig(found, path)


def read_renderme(path: Path) -> dict[str, Camera]:
    """Read the cameras of an SMC with a Calibration group (in full releases the ``_anno`` one)."""
    try:
        file = open_hdf5(path)
        group = child(file, "Calibration")
        if not isinstance(group, h5py.Group):
            raise CalibrationError(
                f"{path}: has no Calibration group; use the anno file of the same performance"
                f" ({path.name.replace('_raw', '_anno')})"
            )
        pictures = child(file, "Camera")
        size = np.array((2048, 2448))  # height and width of the release's pictures
        if isinstance(pictures, h5py.Group):
            size = attribute(pictures, "resolution", size)
        if size.shape != (2,) or size.dtype.kind not in "ui":
            raise CalibrationError(f"{path}: resolution {size.tolist()}, expected height and width")
        height, width = map(int, size)
        found = []
        for name in members(group):
            if not name.isdecimal() or len(name) > 4:
                raise CalibrationError(f"{path}: camera {name!r}, expected a number such as 07")
            rows = {key: f"Calibration/{name}/{key}" for key in ("K", "RT", "D")}
            what = f"{path}: camera {name} has an array"
            K = finite_array(read_array(file, rows["K"]), (3, 3), what)
            pose = finite_array(read_array(file, rows["RT"]), (4, 4), what)
            has_dist = child(file, rows["D"]) is not None
            dist = np.ravel(read_array(file, rows["D"])) if has_dist else np.zeros(0)
            if np.linalg.matrix_rank(pose) < 4:
                raise CalibrationError(f"{path}: RT of camera {name} cannot be inverted")
            pose, number = np.linalg.inv(pose), f"cam{int(name):02d}"
            lens = K_from_opencv(K), dist[:14], (width, height)
            found.append(camera_from_K(number, *lens, pose))
    except CaptureError as error:
        raise CalibrationError(str(error)) from None
    return as_rig(found, path)
