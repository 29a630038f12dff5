"""Export one head: PLY for splat viewers, GLB for other 3D software, NPZ for arrays.

A textured mesh may get ARKit's 52 blend shapes as glTF morph targets. Each moves the jaw, an eye,
or one or two coefficients that the head model has by name (the built-in head, ICT-FaceKit). What
the mesh decoder adds for these parameters is included.

Gaussians are written as 3DGS' PLY, as GLB with KHR_gaussian_splatting (the ratified glTF extension:
linear scales, opacities from 0 to 1, quaternions xyzw, display-referred sRGB) and as Niantic's SPZ,
version 3. Head space has the axes of both: right, up, back.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import distance_transform_edt

from express50.errors import ConfigError
from express50.files.atomic import write_bytes
from express50.geometry.meshes import encode_glb, split_seams
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.shapes import check_finite
from express50.head.model import HeadModel, normals_of
from grmm.checkpoint import Checkpoint
from grmm.config import SCALE_RANGE_MM
from grmm.edit import HeadCodes, controlled
from grmm.head_crop import neck_cut
from grmm.model import PinholeView

SIDED = (
    "eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide",
    "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthPress", "mouthLowerDown",
    "mouthUpperUp", "browDown", "browOuterUp", "cheekSquint", "noseSneer",
)  # fmt: skip
SINGLE = (
    "jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker",
    "mouthLeft", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower",
    "mouthShrugUpper", "browInnerUp", "cheekPuff", "tongueOut",
)  # fmt: skip
JAW, EYE = 0.35, 0.4  # radians of jawOpen and of eyeLook...
TURNS = {  # joint controls: entry of an axis-angle, and its sign; the left is +x
    "jawOpen": ("jaw.0", 1), "eyeLookDownLeft": ("eyes.0", 1), "eyeLookDownRight": ("eyes.3", 1),
    "eyeLookUpLeft": ("eyes.0", -1), "eyeLookUpRight": ("eyes.3", -1),
    "eyeLookOutLeft": ("eyes.1", 1), "eyeLookInLeft": ("eyes.1", -1),
    "eyeLookInRight": ("eyes.4", 1), "eyeLookOutRight": ("eyes.4", -1),
}  # fmt: skip

SH_DC = 0.5 / math.sqrt(math.pi)  # value of the constant spherical harmonic
EXTENSION = "KHR_gaussian_splatting"
FLOAT, ARRAY_BUFFER, POINTS = 5126, 34962, 0  # of glTF
SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 3
FRACTION_BITS = 16  # of SPZ's positions: 15 micrometres, up to 128 m
SPZ_COLOUR = 0.15  # share of a byte's range per unit of the constant harmonic's coefficient


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianCloud:
    """N Gaussians with one colour each, head space.

    Raises:
        ValueError: a value is not finite.
    """

    means: np.ndarray  # (N, 3) metres
    quats: np.ndarray  # (N, 4) wxyz, unit length
    scales: np.ndarray  # (N, 3) standard deviations, metres
    opacities: np.ndarray  # (N,)
    colors: np.ndarray  # (N, 3) in [0, 1], sRGB, as the exported view sees them

    def __post_init__(self) -> None:
        for name, array in vars(self).items():
            check_finite(name, array)


def write_export(
    path: Path, loaded: Checkpoint, head: HeadCodes, view: PinholeView, form: str
) -> str:
    """Write a head in a format; returns a description of what was written.

    ``ply`` holds Gaussians in the 3DGS layout, ``spz`` in Niantic's, ``splats`` as GLB with
    KHR_gaussian_splatting; these three cut the neck. ``glb`` is the textured mesh, ``arkit`` has
    morph targets; ``npz`` holds all Gaussians' arrays, mesh, codes and parameters.
    """
    gaussians, vertices, texture = decoded(loaded, head, view)
    if form in ("glb", "arkit"):
        targets = arkit_targets(loaded, head) if form == "arkit" else {}
        write_bytes(path, mesh_glb(loaded.head, vertices, texture, targets))
        return f"mesh of {len(vertices)} vertices, texture {len(texture)} px"
    if form == "npz":
        write_bytes(path, arrays_npz(loaded, head, gaussians, vertices))
    else:
        gaussians = with_neck_cut(loaded.head, vertices, gaussians)
        encode = {"ply": ply_bytes, "spz": spz_bytes, "splats": splats_glb}[form]
        write_bytes(path, encode(gaussians))
    return f"{len(gaussians.means)} Gaussians"


def with_neck_cut(head: HeadModel, vertices: np.ndarray, gaussians: GaussianCloud) -> GaussianCloud:
    """Apply `neck_cut` to the Gaussians of a deformed mesh (V, 3)."""
    arrays = (vertices, gaussians.means, gaussians.quats, gaussians.scales)
    share = neck_cut(head, *map(torch.from_numpy, arrays)).numpy()
    smaller = replace(gaussians, scales=gaussians.scales * share[:, None])
    return GaussianCloud(**{name: array[share > 0] for name, array in vars(smaller).items()})


@torch.no_grad()
def decoded(
    loaded: Checkpoint, head: HeadCodes, view: PinholeView
) -> tuple[GaussianCloud, np.ndarray, np.ndarray]:
    """Decode a head; colours are those that ``view`` sees, before refinement.

    Beside the Gaussians come the vertices (V, 3), metres, of the deformed mesh v_rec + v_id +
    M_face v_exp, and its texture (n_g, n_g, 3) uint8 sRGB. The texture holds the Gaussians'
    colours; texels that no face covers have the nearest one's, because viewers blend across seams.
    """
    model, state = loaded.model, head.state(loaded)
    gaussians = model.geometry(head.z_id, head.z_exp, state)
    colours = model.appearance(head.z_id, state, view)[:, :3]
    cloud = GaussianCloud(
        means=gaussians.means.cpu().numpy(),
        quats=torch.nn.functional.normalize(gaussians.quats, dim=1).cpu().numpy(),
        scales=1e-3 * gaussians.scales_mm.clamp(*SCALE_RANGE_MM).cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy(),
        colors=colours.cpu().numpy(),
    )
    side = loaded.config.model.n_g
    row, column = np.divmod(model.texels.cpu().numpy(), side)
    texture, bare = np.zeros((side, side, 3), np.uint8), np.ones((side, side), bool)
    texture[row, column] = (255 * colours.clamp(0, 1)).round().byte().cpu().numpy()
    bare[row, column] = False
    nearest = distance_transform_edt(bare, return_distances=False, return_indices=True)
    vertices = (state.vertices + gaussians.displacement).cpu().numpy()
    return cloud, vertices, texture[tuple(nearest)]


def arrays_npz(
    loaded: Checkpoint, head: HeadCodes, gaussians: GaussianCloud, vertices: np.ndarray
) -> bytes:
    """Encode everything about one head as .npz."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        **vars(gaussians),
        mesh_vertices=vertices,
        mesh_faces=loaded.head.faces.cpu().numpy(),
        z_id=head.z_id.cpu().numpy(),
        z_exp=head.z_exp.cpu().numpy(),
        head=np.array(loaded.head_spec),
        **{f"flame_{name}": value for name, value in vars(head.tracked).items()},
    )
    return buffer.getvalue()


def mesh_glb(
    head: HeadModel, vertices: np.ndarray, texture: np.ndarray, targets: dict[str, np.ndarray]
) -> bytes:
    """Encode the textured mesh as binary glTF; vertices are split at the UV map's seams.

    ``targets`` (V, 3) by name become morph targets. Without normals, viewers show flat facets.
    """
    places, uv_places, faces = split_seams(head.faces.cpu().numpy(), head.uv_faces.cpu().numpy())
    uv, picture = head.uv.cpu().numpy()[uv_places], Image.fromarray(texture)
    content = encode_glb(
        "head",
        vertices[places],
        faces,
        normals=normals_of(vertices, head.faces.cpu())[places],
        uv=uv,
        baseColorTexture=picture,
        roughnessFactor=1.0,
    )
    return with_morph_targets(content, places, targets) if targets else content


def arkit_controls(names: tuple[str, ...]) -> dict[str, list[tuple[str, float]]]:
    """Return the controls that each of the 52 shapes moves, and by how much.

    Raises:
        ConfigError: the head model lacks a shape's coefficients, as FLAME does.
    """
    table: dict[str, tuple[str, ...]]
    table = {name: (name, f"{name}_L", f"{name}_R") for name in SINGLE}
    for name in SIDED:
        table |= {f"{name}Left": (f"{name}_L",), f"{name}Right": (f"{name}_R",)}
    controls = {}
    for shape, candidates in table.items():
        known = [name for name in candidates if name in names]
        moves = [(f"expression.{name}", 1.0) for name in known]
        if shape in TURNS:
            entry, sign = TURNS[shape]
            moves.append((entry, sign * (JAW if shape == "jawOpen" else EYE)))
        if not moves:
            raise ConfigError(
                f"--format arkit: the head model has no coefficient for {shape}; expected one with "
                "named expressions: the built-in head or ICT-FaceKit"
            )
        controls[shape] = moves
    return controls


@torch.no_grad()
def arkit_targets(loaded: Checkpoint, head: HeadCodes) -> dict[str, np.ndarray]:
    """Return what each shape adds to the head's vertices, (V, 3) metres."""

    def vertices(codes: HeadCodes) -> np.ndarray:
        state = codes.state(loaded)
        moved = loaded.model.geometry(codes.z_id, codes.z_exp, state).displacement
        return np.asarray((state.vertices + moved).cpu())

    rest, tracked, targets = vertices(head), head.tracked, {}
    for shape, moves in arkit_controls(loaded.head.expression_names).items():
        changes = {}
        for name, amount in moves:
            table, _, entry = name.partition(".")
            # A coefficient is set to 1; a joint's turn is added to its pose.
            own = 0.0 if table == "expression" else float(getattr(tracked, table)[int(entry)])
            changes[name] = (own + amount,)
        targets[shape] = vertices(controlled(loaded, head, changes)) - rest
    return targets


def with_morph_targets(glb: bytes, positions: np.ndarray, targets: dict[str, np.ndarray]) -> bytes:
    """Add morph targets to a GLB of one mesh, whose P POSITIONs are vertices ``positions``."""
    size = struct.unpack("<I", glb[12:16])[0]
    document, body = json.loads(glb[20 : 20 + size]), bytearray(glb[28 + size :])
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    primitive["targets"] = [
        {"POSITION": _add_array(document, body, moved[positions], bounds=True)}
        for moved in targets.values()
    ]
    mesh["weights"] = [0.0] * len(targets)
    mesh["extras"] = {"targetNames": list(targets)}
    return glb_bytes(document, body)


def _add_array(
    document: dict, body: bytearray, array: np.ndarray, bounds: bool, **view: int
) -> int:
    """Append an array (N, 1, 3 or 4) to a glTF document's buffer; returns its accessor's number.

    ``bounds`` states its least and largest values; ``view`` adds entries to its buffer view.
    """
    table = np.ascontiguousarray(array, "<f4")
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[table.shape[1]]
    views, accessors = document["bufferViews"], document["accessors"]
    accessor = {"bufferView": len(views), "componentType": FLOAT, "type": kind}
    accessor["count"] = len(table)
    if bounds:
        accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
    views.append({"buffer": 0, "byteOffset": len(body), "byteLength": table.nbytes} | view)
    accessors.append(accessor)
    body += table.tobytes()
    return len(accessors) - 1


def ply_bytes(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians in the layout of 3D Gaussian Splatting (Kerbl et al. 2023), degree 0.

    One ``vertex`` element of floats: x y z, nx ny nz (unused), f_dc_0..2, opacity (logit),
    scale_0..2 (log) and rot_0..3 (wxyz). Opacities are kept within 1e-6 of 0 and 1 and scales over
    1e-30, so that logits and logarithms are finite.
    """
    alpha = gaussians.opacities.astype(np.float64).clip(1e-6, 1 - 1e-6)
    columns = {
        "x y z": gaussians.means,
        "nx ny nz": np.zeros_like(gaussians.means),
        "f_dc_0 f_dc_1 f_dc_2": (gaussians.colors.astype(np.float64) - 0.5) / SH_DC,
        "opacity": np.log(alpha / (1 - alpha))[:, None],
        "scale_0 scale_1 scale_2": np.log(gaussians.scales.astype(np.float64).clip(min=1e-30)),
        "rot_0 rot_1 rot_2 rot_3": gaussians.quats,
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(alpha)}"]
    header += [f"property float {name}" for names in columns for name in names.split()]
    table = np.concatenate(list(columns.values()), 1).astype("<f4")
    return "\n".join([*header, "end_header", ""]).encode("ascii") + table.tobytes()


def splats_glb(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians as binary glTF; viewers without the extension show coloured points."""
    light = srgb_to_linear(gaussians.colors.clip(0, 1))  # as COLOR_0 holds it
    colours = np.concatenate([light, gaussians.opacities[:, None]], 1)
    attributes = {
        "POSITION": gaussians.means,
        "COLOR_0": colours,
        f"{EXTENSION}:ROTATION": gaussians.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (gaussians.colors - 0.5) / SH_DC,
    }
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": POINTS, "attributes": {}, "extensions": {EXTENSION: kernel}}
    document: dict = {
        "asset": {"version": "2.0", "generator": "grmm export"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{}],
        "bufferViews": [],
        "accessors": [],
    }
    body = bytearray()
    primitive["attributes"] = {
        name: _add_array(document, body, array, name == "POSITION", target=ARRAY_BUFFER)
        for name, array in attributes.items()
    }
    return glb_bytes(document, body)


def glb_bytes(document: dict, body: bytes | bytearray) -> bytes:
    """Encode glTF's JSON and its buffer, whose length is a multiple of 4, as one binary file."""
    document["buffers"][0]["byteLength"] = len(body)
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def spz_bytes(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians as SPZ, about twenty bytes each before compression.

    Raises:
        ConfigError: a position is 128 m or more from the origin.
    """
    fixed = np.rint(gaussians.means.astype(np.float64) * (1 << FRACTION_BITS)).astype(np.int64)
    if np.abs(fixed).max(initial=0) >= 1 << 23:
        far = np.abs(gaussians.means).max()
        raise ConfigError(f"the head reaches {far:.4g} m, SPZ holds under 128 m; check --control")
    logs = np.log(gaussians.scales.astype(np.float64).clip(min=1e-30))
    harmonics = (gaussians.colors.astype(np.float64) - 0.5) / SH_DC
    # Of a quaternion, two bits name the largest entry, which is made positive and left out; the
    # others follow in order, a bit for the sign and nine for the size over sqrt(1/2).
    quats = gaussians.quats[:, [1, 2, 3, 0]]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest, rows = np.abs(quats).argmax(1), np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    packed = largest.astype(np.uint32)
    others = np.array([[i for i in range(4) if i != skip] for skip in range(4)])[largest]
    for values in np.take_along_axis(quats, others, 1).T:
        size = np.floor(511 * np.abs(values) * np.sqrt(2) + 0.5).clip(max=511).astype(np.uint32)
        packed = packed << 10 | (values < 0).astype(np.uint32) << 9 | size
    parts = [
        struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(fixed), 0, FRACTION_BITS, 0, 0),
        fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        _bytes(255 * gaussians.opacities),
        _bytes(255 * (SPZ_COLOUR * harmonics + 0.5)),
        _bytes(16 * (logs + 10)),
        packed.astype("<u4").tobytes(),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def _bytes(values: np.ndarray) -> bytes:
    return np.floor(values + 0.5).clip(0, 255).astype(np.uint8).tobytes()
