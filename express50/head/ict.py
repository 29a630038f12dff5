"""Load ICT-FaceKit's light face model (USC Institute for Creative Technologies, MIT licence).

Reads a checkout of the public repository (`FaceXModel/*.obj`) or the same arrays in one `.npz`.
The model has blend shapes but no skeleton: joints and skinning are made here, those of the jaw from
the model's `jawOpen` shape. Regions come from the vertex ranges and landmarks of its README.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from skimage.measure import points_in_poly

from express50.errors import HeadModelError
from express50.files.arrays import read_arrays
from express50.files.text import read_text, refusing
from express50.geometry.meshes import check_faces, mesh_parts, open_edges
from express50.geometry.sampling import smoothstep
from express50.head.model import PARENTS, HeadModel, check_head

VERTEX_COUNT = 26719
METRES_PER_UNIT = 0.01
# ICT-FaceKit's own, except for the brows (17 to 26), which its README has up to 8 mm above
# published marks, and 56, 58, 61, 63, 65 and 67 of the lips, which are nearer to the middle here.
LANDMARKS = (
    1225, 1888, 1052, 367, 1719, 1722, 2199, 1447, 966, 3661, 4390, 3927, 3924, 2608, 3272, 4088,
    3443, 270, 495, 1916, 2037, 2003, 4203, 4233, 4116, 2736, 2511, 978, 4527, 4942, 4857, 1140,
    2075, 1147, 4269, 3360, 1507, 1542, 1537, 1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732,
    5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6480, 5518, 5976, 5841, 5702, 5736, 5533, 6241,
    6207, 6485, 5517, 5981,
)  # fmt: skip
# First vertex of each part and the one after its last (README, "Face Model Topology").
RANGES = {
    "face_area": (0, 9409),
    "narrow_face": (0, 6706),
    "head_and_neck": (9409, 11248),
    "mouth_socket": (11248, 13294),
    "eye_socket_left": (13294, 13678),
    "eye_socket_right": (13678, 14062),
    "gums_tongue": (14062, 17039),
    "upper_teeth": (17039, 19247),
    "lower_teeth": (19247, 21451),
    "left_eyeball": (21451, 23021),
    "right_eyeball": (23021, 24591),
    "eyelashes": (25351, 26719),
}
# Shells for transparent shaders of game engines; as opaque faces they would hide the eyes.
_HIDDEN_MATERIALS = ("M_EyeBlend", "M_EyeOcclusion", "M_LacrimalFluid")
_NPZ_KEYS = (
    "v_template", "shapedirs", "exprdirs", "expression_names", "faces", "uv", "uv_faces",
    "face_material", "materials",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class IctArrays:
    """ICT-FaceKit as stored: centimetres, UDIM texture tiles, triangles with material names."""

    template: np.ndarray
    shape_dirs: np.ndarray
    expression_dirs: np.ndarray
    expression_names: tuple[str, ...]
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    face_material: np.ndarray


def load_ict(path: str | Path) -> HeadModel:
    """Load ICT-FaceKit from a checkout (or its FaceXModel folder) or from an .npz of its arrays.

    Raises:
        HeadModelError: a file is missing or damaged, or the model has another topology.
    """
    path = Path(path)
    arrays = read_ict_npz(path) if path.suffix == ".npz" else read_ict_checkout(path)
    if arrays.template.shape != (VERTEX_COUNT, 3):
        raise HeadModelError(
            f"{path}: template has shape {arrays.template.shape}, expected ({VERTEX_COUNT}, 3); "
            "give ICT-FaceKit's light model"
        )
    if "jawOpen" not in arrays.expression_names:
        raise HeadModelError(f"{path}: no expression jawOpen, expected for the jaw; copy it again")
    with refusing(HeadModelError, f"{path}: arrays do not fit"):
        _check_mesh(arrays.template, arrays.faces)
        _check_mesh(arrays.uv, arrays.uv_faces)
        return check_head(build_ict_head(arrays))


def read_ict_npz(path: Path) -> IctArrays:
    """Read the arrays from one .npz; pickled objects are refused."""
    data = read_arrays(path, HeadModelError, "an ICT .npz", _NPZ_KEYS)
    with refusing(HeadModelError, f"{path}: not a readable ICT .npz"):
        return IctArrays(
            template=data["v_template"].astype(np.float64),
            shape_dirs=data["shapedirs"].astype(np.float32),
            expression_dirs=data["exprdirs"].astype(np.float32),
            expression_names=tuple(str(name) for name in data["expression_names"]),
            faces=data["faces"].astype(np.int64),
            uv=data["uv"].astype(np.float64),
            uv_faces=data["uv_faces"].astype(np.int64),
            face_material=data["materials"].astype(str)[data["face_material"]],
        )


def read_ict_checkout(path: Path) -> IctArrays:
    """Read `generic_neutral_mesh.obj`, `identityNNN.obj` and the expression OBJ files."""
    folder = path / "FaceXModel" if (path / "FaceXModel").is_dir() else path
    neutral = folder / "generic_neutral_mesh.obj"
    if not neutral.is_file():
        raise HeadModelError(
            f"{path}: no FaceXModel/generic_neutral_mesh.obj; give a checkout of ICT-FaceKit"
        )
    template, uv, faces, uv_faces, material = read_obj(neutral)
    others = sorted(file for file in folder.glob("*.obj") if file != neutral)
    identities = [file for file in others if file.stem.startswith("identity")]
    expressions = [file for file in others if not file.stem.startswith("identity")]
    if not identities or not expressions:
        raise HeadModelError(
            f"{folder}: {len(identities)} identity and {len(expressions)} expression OBJ files,"
            " expected identity000.obj ... and browDown_L.obj ...; check ICT-FaceKit out again"
        )
    return IctArrays(
        template=template,
        shape_dirs=_offsets(identities, template),
        expression_dirs=_offsets(expressions, template),
        expression_names=tuple(file.stem for file in expressions),
        faces=faces,
        uv=uv,
        uv_faces=uv_faces,
        face_material=material,
    )


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Read vertices (V,3), texture coordinates (T,2), faces (F,3), their uv (F,3), material (F,).

    Polygons are split into fans. Faces without texture coordinates get coordinate 0.
    """
    vertices: list[list[str]] = []
    uv: list[list[str]] = []
    corners: list[tuple[str, str, str]] = []
    material, materials = "", []
    with refusing(HeadModelError, f"{path}: not an OBJ file"):
        for line in read_text(path, HeadModelError).split("\n"):
            words = line.split()
            if not words:
                continue
            if words[0] == "v":
                vertices.append(words[1:4])
            elif words[0] == "vt":
                uv.append(words[1:3])
            elif words[0] == "usemtl":
                material = words[1]
            elif words[0] == "f":
                for second, third in zip(words[2:-1], words[3:], strict=True):
                    corners.append((words[1], second, third))
                    materials.append(material)
        index = np.array(
            [[corner.split("/")[:2] + ["1"] for corner in face] for face in corners], dtype=object
        )
        faces = index[:, :, 0].astype(np.int64) - 1
        uv_faces = np.where(index[:, :, 1] == "", "1", index[:, :, 1]).astype(np.int64) - 1
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        coordinates = np.array(uv or [["0", "0"]], dtype=np.float64).reshape(-1, 2)
        _check_mesh(points, faces)
        _check_mesh(coordinates, uv_faces)
    return points, coordinates, faces, uv_faces, np.array(materials)


def _check_mesh(points: np.ndarray, faces: np.ndarray) -> None:
    """Raise ValueError if a coordinate is not finite or a face refers to a missing point."""
    if not np.isfinite(points).all():
        raise ValueError("a coordinate is NaN or infinite")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(f"faces have shape {faces.shape}, expected (F, 3)")
    check_faces(faces, len(points))


def build_ict_head(arrays: IctArrays) -> HeadModel:
    """Build a head model, in metres, from the arrays; add joints, skinning, landmarks, regions."""
    template = arrays.template * METRES_PER_UNIT
    regions = ict_regions(template, arrays.faces, arrays.uv_faces)
    jaw_open = arrays.expression_names.index("jawOpen")
    opened = arrays.expression_dirs[:, :, jaw_open].astype(np.float64) * METRES_PER_UNIT
    joints, skinning = _rig(template, opened, regions)
    shown = ~np.isin(arrays.face_material, _HIDDEN_MATERIALS)
    faces = arrays.faces[shown]
    # Each landmark is put on the first face that has its vertex.
    face, corner = np.array([np.argwhere(faces == vertex)[0] for vertex in LANDMARKS]).T
    # Of the UDIM tiles, packed into [0, 1], tile 0 (the face) gets 3/4 of the side, others 1/4.
    uv = np.clip(arrays.uv, 0.0, None)
    tile = np.minimum(np.floor(uv[:, 0]).astype(int), 7)
    uv = uv - np.stack([tile, np.zeros_like(tile)], axis=1)
    cells = [(0.75, 0.0), (0.75, 0.25), (0.75, 0.5), (0.75, 0.75)]
    cells += [(0.0, 0.75), (0.25, 0.75), (0.5, 0.75)]
    uv = np.array([(0.0, 0.0), *cells])[tile] + uv * np.where(tile == 0, 0.75, 0.25)[:, None]
    return HeadModel(
        name="ict",
        template=tensor(template),
        shape_dirs=tensor(arrays.shape_dirs * METRES_PER_UNIT),
        expression_dirs=tensor(arrays.expression_dirs * METRES_PER_UNIT),
        pose_dirs=torch.zeros(9 * (len(PARENTS) - 1), VERTEX_COUNT * 3),
        joint_regressor=tensor(_regressor(template, joints, regions)),
        skinning=tensor(skinning),
        faces=torch.from_numpy(faces),
        uv=tensor(np.clip(uv, 0.0, 1.0)),
        uv_faces=torch.from_numpy(arrays.uv_faces[shown]),
        landmark_faces=torch.from_numpy(face),
        landmark_bary=tensor(np.eye(3)[corner]),
        shape_names=tuple(f"identity{i:03d}" for i in range(arrays.shape_dirs.shape[2])),
        expression_names=arrays.expression_names,
        regions={name: torch.from_numpy(mask) for name, mask in regions.items()},
    )


def tensor(array: np.ndarray) -> torch.Tensor:
    """Return an array as a float32 tensor."""
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def _offsets(files: list[Path], template: np.ndarray) -> np.ndarray:
    """Return vertex offsets (V, 3, files) of OBJ files from the template."""
    columns = []
    for file in files:
        lines = read_text(file, HeadModelError).splitlines()
        with refusing(HeadModelError, f"{file}: not an OBJ file"):
            rows = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
        if rows.shape != template.shape:
            raise HeadModelError(
                f"{file}: {rows.shape[0]} vertices, expected the neutral's {template.shape[0]};"
                " copy it again"
            )
        columns.append((rows - template).astype(np.float32))
    return np.stack(columns, axis=2)


def _rig(
    template: np.ndarray, opened: np.ndarray, regions: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return joints (5, 3) and skinning (V, 5) for the template; `opened` is the jawOpen offset."""
    height = template[:, 1]
    chin = template[LANDMARKS[8]]
    floor = height.min()
    jaw_joint, jaw_weight = _jaw_rig(template, opened, regions["lower_teeth"])
    neck_ring = np.abs(height - chin[1]) < 0.02
    neck_ring &= regions["neck"] | regions["scalp"]
    centre = template[neck_ring].mean(0) if neck_ring.any() else np.array([0.0, chin[1], 0.0])
    neck_joint = np.array([0.0, chin[1], centre[2]])
    root_joint = np.array([0.0, 0.5 * (floor + chin[1]), centre[2]])
    # Level sets of the neck's weight rise towards the nape, as a skull sits on a spine.
    level = (height - 0.25 * (template[:, 2] - centre[2]) - floor) / (chin[1] - floor)
    head = smoothstep((level - 0.25) / 0.85, 0.0, 1.0)
    head = np.where(regions["face"] | regions["mouth_interior"] | regions["teeth"], 1.0, head)
    skinning = np.zeros((template.shape[0], 5))
    skinning[:, 2] = jaw_weight * head
    for column, side in ((3, "left_eyeball"), (4, "right_eyeball")):
        skinning[regions[side]] = 0.0
        skinning[regions[side], column] = 1.0
    rest = head - skinning[:, 2:].sum(1)
    skinning[:, 1] = np.clip(rest, 0.0, None)
    skinning[:, 0] = 1.0 - skinning[:, 1:].sum(1)
    eyes = [template[regions[side]].mean(0) for side in ("left_eyeball", "right_eyeball")]
    return np.stack([root_joint, neck_joint, jaw_joint, *eyes]), skinning


def _jaw_rig(
    template: np.ndarray, opened: np.ndarray, lower_teeth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the jaw's hinge (3,) and weights (V,) that reproduce the jawOpen shape.

    The lower teeth are rigid, so their motion in the y-z plane is a rotation about a fixed point c:
    d = (R - I)(p - c). A vertex's weight is its motion over that of a rigid jaw at its place.

    Raises:
        ValueError: the shape does not turn the lower teeth.
    """
    points, motion = template[lower_teeth][:, 1:], opened[lower_teeth][:, 1:]
    centred = points - points.mean(0)
    moved = centred + motion - motion.mean(0)
    overlap = centred.T @ moved
    # The rotation that best aligns two planar point sets (Procrustes in two dimensions).
    angle = np.arctan2(overlap[0, 1] - overlap[1, 0], overlap[0, 0] + overlap[1, 1])
    if abs(angle) < 1e-4:
        raise ValueError("jawOpen does not turn the lower teeth, so the jaw's hinge is unknown")
    rotation = np.array([[np.cos(angle) - 1, -np.sin(angle)], [np.sin(angle), np.cos(angle) - 1]])
    hinge = points.mean(0) - np.linalg.solve(rotation, motion.mean(0))
    rigid = np.linalg.norm((template[:, 1:] - hinge) @ rotation.T, axis=1)
    weight = np.linalg.norm(opened[:, 1:], axis=1) / np.maximum(rigid, 1e-3)
    below = smoothstep((hinge[0] + 0.03 - template[:, 1]) / 0.03, 0.0, 1.0)
    return np.array([0.0, hinge[0], hinge[1]]), np.clip(weight, 0.0, 1.0) * below


def _regressor(
    template: np.ndarray, joints: np.ndarray, regions: dict[str, np.ndarray]
) -> np.ndarray:
    """Return the joint regressor (5, V): least-norm weights of the vertices near each joint."""
    rows = np.zeros((5, template.shape[0]))
    skin = ~(regions["teeth"] | regions["mouth_interior"] | regions["tongue"])
    for row, joint in enumerate(joints):
        side = {3: "left_eyeball", 4: "right_eyeball"}.get(row)
        near = np.linalg.norm(template - joint, axis=1)
        chosen = regions[side] if side else skin & (near <= np.sort(near[skin])[400])
        system = np.vstack([template[chosen].T, np.ones(chosen.sum())])
        uniform = np.full(chosen.sum(), 1.0 / chosen.sum())
        target = np.append(joint, 1.0) - system @ uniform
        rows[row, chosen] = uniform + np.linalg.lstsq(system, target, rcond=None)[0]
    return rows


def ict_regions(
    template: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray
) -> dict[str, np.ndarray]:
    """Return masks (V,) bool by region, of a template (V, 3), metres, with all faces (F, 3)."""
    number = np.arange(len(template))
    part = {name: (number >= first) & (number < end) for name, (first, end) in RANGES.items()}
    marks, (x, y, z) = template[list(LANDMARKS)], template.T
    skin = part["face_area"] | part["head_and_neck"]
    ears = part["face_area"] & (np.abs(x) > 0.069) & (z < 0.031) & (y > -0.024) & (y < 0.044)
    brow_top = marks[17:27, 1].max() + 0.0095
    face = part["narrow_face"] & ~ears & (y > marks[8, 1] - 0.03)
    # Behind the ears the scalp extends down to the height of the mouth.
    scalp = skin & ~face & ~ears & (y > np.where(z < 0.0, -0.035, 0.01))
    nose, margin = marks[27:36, :2], np.array([0.006, 0.004])
    near_nose = (template[:, :2] > nose.min(0) - margin) & (template[:, :2] < nose.max(0) + margin)
    lips = marks[48:60, :2]
    lips = lips.mean(0) + 1.04 * (lips - lips.mean(0))
    end = np.isin(number, open_edges(faces))  # the neck's lower end is open
    regions = {
        "face": face,
        "neck": skin & ~face & ~ears & ~scalp,
        "scalp": scalp,
        "forehead": face & (y > brow_top),
        "nose": face & near_nose.all(1),
        "lips": face & points_in_poly(template[:, :2], lips),
        "left_ear": ears & (x > 0),
        "right_ear": ears & (x < 0),
        "teeth": part["upper_teeth"] | part["lower_teeth"],
        "upper_teeth": part["upper_teeth"],
        "lower_teeth": part["lower_teeth"],
        "tongue": _tongue(template, faces, uv_faces, part["gums_tongue"]),
        "eyelashes": part["eyelashes"],
        "mouth_interior": part["mouth_socket"] | part["gums_tongue"],
        "boundary": skin & end & (y < np.quantile(y, 0.05)),
    }
    for side in ("left", "right"):
        ball = part[f"{side}_eyeball"]
        centre = template[ball].mean(0)
        radius = np.linalg.norm(template - centre, axis=1)
        regions[f"{side}_eyeball"] = ball
        # An iris of 6 mm radius on a ball of 12 mm spans half a radian from the axis.
        regions[f"{side}_iris"] = ball & (z - centre[2] > np.cos(0.5) * radius)
        near = np.linalg.norm((template - centre) * np.array([1.0, 1.3, 0.7]), axis=1)
        regions[f"{side}_eye_region"] = face & (near < 0.026)
    return regions


def _tongue(
    template: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray, gums: np.ndarray
) -> np.ndarray:
    """Find the tongue (V,) bool: the two large texture islands within 2 cm of the middle.

    Gums and tongue are connected in the mesh, but not in the texture map.
    """
    inside = gums[faces].all(1)
    corners = uv_faces[inside]
    islands = mesh_parts(corners, uv_faces.max() + 1)[corners[:, 0]]
    mask = np.zeros(template.shape[0], dtype=bool)
    for island in np.unique(islands):
        ids = np.unique(faces[inside][islands == island])
        if ids.size > 200 and np.abs(template[ids, 0]).max() < 0.0205:
            mask[ids] = True
    return mask
