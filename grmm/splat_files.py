"""Write Gaussians as 3DGS' PLY, as GLB with KHR_gaussian_splatting, and as SPZ.

The latter two follow public specifications: the ratified glTF extension (linear scales, opacities
from 0 to 1, quaternions xyzw, display-referred sRGB) and Niantic's SPZ, version 3. Head space has
the axes of both: right, up, back.
"""

from __future__ import annotations

import gzip
import json
import math
import struct
from dataclasses import dataclass

import numpy as np

from express50.files.images import srgb_to_linear
from express50.geometry.shapes import check_finite

SH_DC = 0.5 / math.sqrt(math.pi)  # value of the constant spherical harmonic
EXTENSION = "KHR_gaussian_splatting"
FLOAT, ARRAY_BUFFER, POINTS = 5126, 34962, 0  # of glTF
SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 3
FRACTION_BITS = 16  # of SPZ's positions: 15 micrometres, up to 128 m
SPZ_COLOUR = 0.15  # bytes per coefficient of the constant harmonic, over 255


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianCloud:
    """N Gaussians with one colour each, head space.

    Attributes:
        means: (N, 3) metres.
        quats: (N, 4) wxyz, unit length.
        scales: (N, 3) standard deviations, metres.
        opacities: (N,).
        colors: (N, 3) in [0, 1], sRGB, as the exported view sees them.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


def ply_bytes(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians in the layout of 3D Gaussian Splatting (Kerbl et al. 2023), degree 0.

    One ``vertex`` element of floats: x y z, nx ny nz (unused), f_dc_0..2, opacity (logit),
    scale_0..2 (log) and rot_0..3 (wxyz). Opacities are kept within 1e-6 of 0 and 1 and scales over
    1e-30, so that logits and logarithms are finite.

    Raises:
        ValueError: a value is not finite.
    """
    _check(gaussians)
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
    """Encode Gaussians as binary glTF; viewers without the extension show coloured points.

    Raises:
        ValueError: a value is not finite.
    """
    _check(gaussians)
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
    views: list[dict] = []
    accessors: list[dict] = []
    parts, offset = [], 0
    for array in attributes.values():
        table = np.ascontiguousarray(array, "<f4")
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[table.shape[1]]
        accessor = {"bufferView": len(views), "componentType": FLOAT, "type": kind}
        accessors.append(accessor | {"count": len(table)})
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": table.nbytes,
                      "target": ARRAY_BUFFER})  # fmt: skip
        parts.append(table.tobytes())
        offset += table.nbytes
    position = np.ascontiguousarray(gaussians.means, "<f4")
    accessors[0] |= {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": POINTS,
        "attributes": {name: number for number, name in enumerate(attributes)},
        "extensions": {EXTENSION: kernel},
    }
    document = {
        "asset": {"version": "2.0", "generator": "grmm export"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return glb_bytes(document, b"".join(parts))


def glb_bytes(document: dict, body: bytes) -> bytes:
    """Encode glTF's JSON and its buffer, whose length is a multiple of 4, as one binary file."""
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def spz_bytes(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians as SPZ, about twenty bytes each before compression.

    Raises:
        ValueError: a value is not finite, or a position is 128 m or more from the origin.
    """
    _check(gaussians)
    fixed = np.rint(gaussians.means.astype(np.float64) * (1 << FRACTION_BITS)).astype(np.int64)
    if np.abs(fixed).max(initial=0) >= 1 << 23:
        raise ValueError(f"means reach {np.abs(gaussians.means).max()} m, expected under 128 m")
    logs = np.log(gaussians.scales.astype(np.float64).clip(min=1e-30))
    harmonics = (gaussians.colors.astype(np.float64) - 0.5) / SH_DC
    parts = [
        struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(fixed), 0, FRACTION_BITS, 0, 0),
        fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        _bytes(255 * gaussians.opacities),
        _bytes(255 * (SPZ_COLOUR * harmonics + 0.5)),
        _bytes(16 * (logs + 10)),
        _smallest_three(gaussians.quats[:, [1, 2, 3, 0]]).tobytes(),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Pack quaternions (N, 4), xyzw, into (N,) uint32.

    Two bits name the largest entry, which is made positive and left out; the others follow in
    order, a bit for the sign and nine for the size over sqrt(1/2).
    """
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest, rows = np.abs(quats).argmax(1), np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    packed = largest.astype(np.uint32)
    others = np.array([[i for i in range(4) if i != skip] for skip in range(4)])[largest]
    for values in np.take_along_axis(quats, others, 1).T:
        size = np.floor(511 * np.abs(values) * np.sqrt(2) + 0.5).clip(max=511).astype(np.uint32)
        packed = packed << 10 | (values < 0).astype(np.uint32) << 9 | size
    return packed.astype("<u4")


def _bytes(values: np.ndarray) -> bytes:
    return np.floor(values + 0.5).clip(0, 255).astype(np.uint8).tobytes()


def _check(gaussians: GaussianCloud) -> None:
    for name, array in vars(gaussians).items():
        check_finite(name, array)
