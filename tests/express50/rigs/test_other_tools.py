"""Calibrations in other tools' layouts project points where those tools say that they project.

Each layout is written out here, and so is the tool's own projection.
"""

import json
import re

import cv2
import numpy as np
import pytest

from express50.errors import CalibrationError
from express50.geometry.cameras import project
from express50.geometry.transforms import matrix_to_axis_angle
from express50.rigs.read import guess_format, read_rig
from tests.express50.rigs.test_read import HEAD, make_rig

SIZE = (480, 640)
DIST = (-0.11, 0.07, 0.001, -0.002, 0.02)  # k1 k2 p1 p2 k3
RIG = {name: camera.cam_from_world for name, camera in make_rig(dist=()).items()}
K = np.array([[900.0, 0, 238.5], [0, 905.0, 322.25], [0, 0, 1]])


def opencv_pixels(pose, K=K, dist=DIST):
    """Project as OpenCV does; the pixel origin is the first pixel's centre."""
    turn = cv2.Rodrigues(pose[:3, :3])[0]
    return cv2.projectPoints(HEAD, turn, pose[:3, 3], K, np.array(dist))[0][:, 0]


def listed(array):
    return np.asarray(array).tolist()


def spaced(array):
    return " ".join(repr(float(x)) for x in np.ravel(array))


def write_caliscope(folder):
    rows = "".join(
        f"[cameras.{n}]\ncam_id = {n}\nrotation_count = {n - 1}\nsize = {list(SIZE)}\n"
        f"matrix = {listed(K)}\ndistortions = {list(DIST)}\ntranslation = {listed(pose[:3, 3])}\n"
        f"rotation = {listed(pose[:3, :3])}\n\n"
        for n, pose in enumerate(RIG.values())
    )
    unposed = f"[cameras.9]\ncam_id = 9\nsize = {list(SIZE)}\nmatrix = {listed(K)}\n"
    (folder / "camera_array.toml").write_text(rows + unposed)
    pixels = [opencv_pixels(pose) + 0.5 for pose in RIG.values()]
    return folder / "camera_array.toml", {f"cam_{n}": p for n, p in enumerate(pixels)}


def write_aniposelib(folder):
    rows = "".join(
        f'[cam_{n}]\nname = "{name}"\nsize = {list(SIZE)}\nmatrix = {listed(K)}\n'
        f"distortions = {list(DIST)}\nrotation = {listed(matrix_to_axis_angle(pose[:3, :3]))}\n"
        f"translation = {listed(pose[:3, 3])}\n\n"
        for n, (name, pose) in enumerate(RIG.items())
    )
    (folder / "calibration.toml").write_text(f"{rows}[metadata]\nadjusted = false\nerror = 0.3\n")
    pixels = {name: opencv_pixels(pose) + 0.5 for name, pose in RIG.items()}
    return folder / "calibration.toml", pixels


def write_kalibr(folder):
    """Write a chain; its world is the first camera's, so the points are moved there."""
    text, before = "", None
    for n, pose in enumerate(RIG.values()):
        text += f"cam{n}:\n"
        if before is not None:
            rows = "".join(f"  - {row}\n" for row in listed(pose @ np.linalg.inv(before)))
            text += f"  T_cn_cnm1:\n{rows}"
        text += (
            f"  cam_overlaps: [0]\n  camera_model: pinhole\n  distortion_coeffs: {list(DIST[:4])}\n"
            "  distortion_model: radtan\n"
            f"  intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\n"
            f"  resolution: {list(SIZE)}\n  rostopic: /cam{n}/image_raw\n"
        )
        before = pose
    (folder / "camchain.yaml").write_text(text)
    pixels = [opencv_pixels(pose, dist=DIST[:4]) + 0.5 for pose in RIG.values()]
    return folder / "camchain.yaml", {f"cam{n}": p for n, p in enumerate(pixels)}


def write_qualisys(folder):
    """Write what QTM exports: camera axes x right, y up, z back; mm; 64ths of a sensor's pixel."""
    left, top = 20, 8
    cameras, pixels = "", {}
    for number, pose in enumerate(RIG.values(), 26580):
        axes = np.diag([1, -1, -1]) @ pose[:3, :3]
        place = -1000 * pose[:3, :3].T @ pose[:3, 3]
        turn = " ".join(
            f'r{n // 3 + 1}{n % 3 + 1}="{x!r}"' for n, x in enumerate(listed(axes.ravel()))
        )
        cameras += (
            f'<camera active="1" calibrated="true" serial="{number}" model="Miqus Video">'
            f'<fov_video left="{left}" top="{top}" right="{left + SIZE[0] - 1}"'
            f' bottom="{top + SIZE[1] - 1}"/>'
            f'<transform x="{place[0]}" y="{place[1]}" z="{place[2]}" {turn}/>'
            f'<intrinsic sensorMinU="0" sensorMaxU="69567" focalLengthU="{K[0, 0] * 64}"'
            f' focalLengthV="{K[1, 1] * 64}" centerPointU="{K[0, 2] * 64}"'
            f' centerPointV="{K[1, 2] * 64}" skew="0" radialDistortion1="{DIST[0]}"'
            f' radialDistortion2="{DIST[1]}" radialDistortion3="{DIST[4]}"'
            f' tangentalDistortion1="{DIST[2]}" tangentalDistortion2="{DIST[3]}"/></camera>\n'
        )
        # K counts from the sensor's corner, so what OpenCV makes of it does, too.
        pixels[str(number)] = opencv_pixels(pose) - (left, top)
    text = f"<?xml version='1.0' encoding='ASCII'?>\n<calibration><cameras>\n{cameras}"
    idle = '<camera active="0" serial="1" model="Arqus"/>\n'
    (folder / "Calib.qca.txt").write_text(f"{text}{idle}</cameras></calibration>\n")
    return folder / "Calib.qca.txt", pixels


def on_plane(pose):
    """Return x and y of the points on the plane z = 1."""
    x, y, z = pose[:3, :3] @ HEAD.T + pose[:3, 3:]
    return x / z, y / z


def brown(pose, radial, tangential):
    """Return x and y of the points on the plane z = 1, bent by Brown's lens."""
    (x, y), (k1, k2, k3), (p1, p2) = on_plane(pose), radial, tangential
    r2 = x * x + y * y
    factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * factor + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    v = y * factor + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return u, v


def write_metashape(folder):
    """Write the XML of a chunk that is scaled, turned and moved into the world."""
    f, cx, cy, b1, (k1, k2, k3), (p1, p2) = 880.0, 3.5, -7.25, 1.5, (-0.1, 0.06, 0.02), (2e-3, 1e-3)
    R, t, scale = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0], np.array([4.0, -2.0, 1.0]), 0.25
    chunk_from_world = np.vstack([np.c_[R.T, -R.T @ t] / scale, [0, 0, 0, 1]])
    cameras, pixels = "", {}
    for n, (name, pose) in enumerate(RIG.items()):
        to_chunk = chunk_from_world @ np.linalg.inv(pose)
        to_chunk[:3, :3] *= scale
        cameras += (
            f'<camera id="{n}" sensor_id="0" component_id="0" label="{name}.jpg">'
            f"<transform>{spaced(to_chunk)}</transform></camera>\n"
        )
        u, v = brown(pose, (k1, k2, k3), (p1, p2))
        across, down = SIZE[0] / 2 + cx + u * f + u * b1, SIZE[1] / 2 + cy + v * f
        pixels[name] = np.stack([across, down], 1)
    width, height = SIZE
    lens = (
        f'<calibration type="frame" class="initial"><resolution width="{width}" height="{height}"/>'
    )
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="Chunk 1">'
        f'<sensors><sensor id="0" label="unknown" type="frame">{lens}<f>1000</f></calibration>'
        f"{lens.replace('initial', 'adjusted')}<f>{f}</f><cx>{cx}</cx><cy>{cy}</cy><b1>{b1}</b1>"
        f"<k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><p1>{p1}</p1><p2>{p2}</p2></calibration>"
        "<covariance><params>f cx cy</params></covariance></sensor></sensors>"
        '<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>'
        f'<rotation locked="true">{spaced(R)}</rotation><translation>{spaced(t)}</translation>'
        f"<scale>{scale}</scale></transform></component></components>\n<cameras><group>{cameras}"
        '</group><camera id="9" sensor_id="0" label="not aligned"/></cameras></chunk></document>'
    )
    return folder / "cameras.xml", pixels


def write_realitycapture(folder):
    film, (U, V), (k1, k2, k3), (t1, t2) = 50.0, (0.003, -0.002), (-0.1, 0.06, 0.02), (2e-3, 1e-3)
    pixels, side = {}, max(SIZE)
    for name, pose in RIG.items():
        (folder / f"{name}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
            '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute"'
            f' xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="{film}" xcr:Skew="0"'
            f' xcr:AspectRatio="1" xcr:PrincipalPointU="{U}" xcr:PrincipalPointV="{V}"'
            ' xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">\n'
            f"<xcr:Rotation>{spaced(pose[:3, :3])}</xcr:Rotation>\n"
            f"<xcr:Position>{spaced(-pose[:3, :3].T @ pose[:3, 3])}</xcr:Position>\n"
            f"<xcr:DistortionCoeficients>{k1} {k2} {k3} 0 {t1} {t2}</xcr:DistortionCoeficients>\n"
            "</rdf:Description></rdf:RDF></x:xmpmeta>\n"
        )
        u, v = brown(pose, (k1, k2, k3), (t1, t2))
        shares = np.stack([u * film / 36 + U, v * film / 36 + V], 1)
        pixels[name] = shares * side + np.array(SIZE) / 2
    return folder, pixels


def write_vggt(folder):
    """Write cameras of the network's input, 518 wide and stretched to a multiple of 14."""
    width, height = 518, 686  # 690.67 high without the stretch
    inside = np.array([[700.0, 0, width / 2], [0, 695.0, height / 2], [0, 0, 1]])
    np.savez(
        folder / "predictions.npz",
        extrinsic=np.stack([pose[:3] for pose in RIG.values()]),
        intrinsic=np.stack([inside] * len(RIG)),
        depth=np.zeros((len(RIG), 2, 2, 1), np.float32),
    )
    pixels = {}
    for name, pose in RIG.items():
        x, y = on_plane(pose)
        ends = np.stack([700 * x + width / 2, 695 * y + height / 2], 1)
        pixels[name] = ends * np.array(SIZE) / (width, height)
    return folder / "predictions.npz", pixels


def write_idr(folder):
    """Write projections, one of them negated: they are known up to a factor."""
    arrays = {f"scale_mat_{n}": np.eye(4) for n in range(len(RIG))}
    for n, pose in enumerate(RIG.values()):
        arrays[f"world_mat_{n}"] = np.vstack([(-1) ** n * K @ pose[:3], [0, 0, 0, 1]])
    np.savez(folder / "cameras_sphere.npz", **arrays)
    pixels = [opencv_pixels(pose, dist=()) + 0.5 for pose in RIG.values()]
    return folder / "cameras_sphere.npz", {f"{n:03d}": p for n, p in enumerate(pixels)}


def write_facescape(folder):
    """Write cameras of which the last is not valid."""
    table = {}
    for n, pose in enumerate([*RIG.values(), np.zeros((4, 4))]):
        table |= {f"{n}_K": listed(K), f"{n}_Rt": listed(pose[:3]), f"{n}_distortion": DIST}
        table |= {f"{n}_width": SIZE[0], f"{n}_height": SIZE[1], f"{n}_valid": n < len(RIG)}
    (folder / "params.json").write_text(json.dumps(table))
    pixels = [opencv_pixels(pose) + 0.5 for pose in RIG.values()]
    return folder / "params.json", {str(n): p for n, p in enumerate(pixels)}


def write_panoptic(folder):
    """Write cameras in centimetres, as calibration_<sequence>.json."""
    rows = [
        {"name": f"00_{n:02d}", "type": "hd", "resolution": SIZE, "panel": 0, "node": n}
        | {"K": listed(K), "distCoef": DIST, "R": listed(pose[:3, :3])}
        | {"t": listed(100 * pose[:3, 3:])}
        for n, pose in enumerate(RIG.values())
    ]
    path = folder / "calibration_a.json"
    path.write_text(json.dumps({"calibDataSource": "a", "cameras": rows}))
    pixels = [opencv_pixels(pose) + 0.5 for pose in RIG.values()]
    return path, {f"hd_00_{n:02d}": p for n, p in enumerate(pixels)}


WRITERS = {
    "panoptic": ("panoptic", write_panoptic),
    "idr": ("idr", write_idr),
    "facescape": ("facescape", write_facescape),
    "caliscope": ("toml", write_caliscope),
    "aniposelib": ("toml", write_aniposelib),
    "kalibr": ("kalibr", write_kalibr),
    "qualisys": ("qualisys", write_qualisys),
    "metashape": ("metashape", write_metashape),
    "realitycapture": ("realitycapture", write_realitycapture),
    "vggt": ("vggt", write_vggt),
}


@pytest.mark.parametrize("tool", WRITERS)
def test_points_fall_where_the_tool_projects_them(tmp_path, tool):
    kind, write = WRITERS[tool]
    path, expected = write(tmp_path)
    assert guess_format(path) == kind
    rig = read_rig(path, size=SIZE)
    assert list(rig) == list(expected)
    points = HEAD
    if tool == "kalibr":
        first = next(iter(RIG.values()))
        points = HEAD @ first[:3, :3].T + first[:3, 3]
    for name, camera in rig.items():
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(project(camera, points)[0], expected[name], atol=1e-6, rtol=0)


def test_a_metashape_chunk_without_a_world_is_its_own(tmp_path):
    path, _ = write_metashape(tmp_path)
    world = read_rig(path)
    path.write_text(re.sub(r"<transform><rotation.*</scale></transform>", "", path.read_text()))
    rig = read_rig(path)
    apart, before = (np.linalg.norm(r["cam00"].center - r["cam01"].center) for r in (rig, world))
    assert apart == pytest.approx(before / 0.25)


@pytest.mark.parametrize(
    ("tool", "old", "new", "words"),
    [
        ("caliscope", "size = [480, 640]", "", r"\[0\] has size"),
        ("caliscope", "distortions = [-0.11", "distortions = [-0.11, [1]", "has distortions"),
        ("caliscope", "[cameras.0]", "[cameras.0", "not TOML"),
        ("aniposelib", 'name = "cam01"', 'name = "cam00"', "two cameras are called cam00"),
        ("aniposelib", "[cam_1]", "[cam_1]\nfisheye = true", "cam_1.*fisheye.*undistort"),
        ("aniposelib", "rotation = [", "rotation = [9.0, ", r"got shape \(4,\), expected \(3,\)"),
        ("kalibr", "model: radtan", "model: equidistant", "cam0: model pinhole-equidistant"),
        ("kalibr", "cam1:", "cam7:", "without a gap"),
        ("kalibr", "T_cn_cnm1:\n  - [", "T_cn_cnm1:\n  - [.nan, ", "cam1 has T_cn_cnm1"),
        ("kalibr", "intrinsics: [", "intrinsics: &a [*a, ", "aliases"),
        ("kalibr", "intrinsics: [", "intrinsics: " + 3000 * "[", "over 16 levels"),
        ("qualisys", 'r22="', 'q22="', "camera 26580 has r11 .* of transform"),
        ("qualisys", 'r11="', 'r11="5', "is not a rotation"),
        ("qualisys", "</calibration>", "", "not XML"),
        ("qualisys", "<calibration>", "<!DOCTYPE a><calibration>", "document type"),
        ("metashape", "<k3>", "<k4>0.01</k4><k3>", "has k4, expected"),
        ("metashape", 'type="frame" class="adj', 'type="fisheye" class="adj', "not a fisheye"),
        ("metashape", 'jpg"><transform>', 'jpg"><transform>1 ', r"shape \(17,\)"),
        ("metashape", 'component_id="0"', 'component_id="1"', "2 components"),
        ("metashape", 'sensor_id="0"', 'sensor_id="5"', "has no frame lens"),
        (
            "facescape",
            '"0_K": [',
            '"0_K": [[1, 0, 0], ',
            "camera 0 has an array: got nothing|shape",
        ),
        ("facescape", '"1_distortion"', '"1_d"', "camera 1 has an array: got nothing"),
        ("panoptic", '"t"', '"T"', "camera hd_00_00 has an array: got nothing"),
        ("panoptic", '"distCoef": [', '"distCoef": [1, ', r"got shape \(6,\), expected \(5,\)"),
        ("panoptic", '"cameras"', '"kameras"', "cameras"),
        ("realitycapture", "brown3t2", "division", "cam00.xmp: lens division"),
        ("realitycapture", 'Skew="0"', 'Skew="0.1"', "no skew"),
        ("realitycapture", "Position>", "Position>1 ", "cam00.xmp has xcr:Position"),
    ],
)
def test_damage_is_one_clear_error(tmp_path, tool, old, new, words):
    path, _ = WRITERS[tool][1](tmp_path)
    file = path / "cam00.xmp" if path.is_dir() else path
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=words) as caught:
        read_rig(path, WRITERS[tool][0], SIZE)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_arrays_of_another_shape_and_missing_sizes_are_named(tmp_path):
    path, _ = write_vggt(tmp_path)
    np.savez(path, extrinsic=np.zeros((2, 4, 4)), intrinsic=np.zeros((2, 3, 3)))
    with pytest.raises(CalibrationError, match=r"extrinsic: got shape \(2, 4, 4\)"):
        read_rig(path)
    np.savez(path, extrinsic=np.zeros((2, 3, 4)))
    with pytest.raises(CalibrationError, match="has no intrinsic"):
        read_rig(path)
    write_realitycapture(tmp_path)
    with pytest.raises(CalibrationError, match="--size"):
        read_rig(tmp_path, "realitycapture")
    path, _ = write_idr(tmp_path)
    with pytest.raises(CalibrationError, match="--size"):
        read_rig(path)
    np.savez(path, world_mat_0=np.zeros((3, 4)))
    with pytest.raises(CalibrationError, match=r"has world_mat_0 .* expected K \[R|t\]"):
        read_rig(path, size=SIZE)


def test_footage_of_another_shape_than_the_network_saw_is_refused(tmp_path):
    path, _ = write_vggt(tmp_path)
    assert read_rig(path)["cam00"].height == 686
    with pytest.raises(CalibrationError, match="expected the same aspect ratio"):
        read_rig(path, size=(640, 480))
