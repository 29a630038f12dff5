"""Read and write Gaussians as the .ply of 3D Gaussian Splatting, which other viewers understand.

The layout is that of Kerbl et al. 2023: one ``vertex`` element of floats, x y z, nx ny nz
(ignored), f_dc_0..2 and f_rest_* (spherical harmonics, channel by channel), opacity (logit),
scale_0..2 (log) and rot_0..3 (wxyz). Other properties are skipped. What other tools make of it is
read too: any order and number type, binary of either byte order, ASCII, and surfels of two scales
(2DGS, Huang et al. 2024), which are flat. Compressed files (``packed_*``) are refused by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from express50.errors import FormatError
from express50.geometry.shapes import check_finite, check_shape

MAX_HEADER_BYTES = 1 << 16
MAX_GAUSSIANS = 50_000_000
_ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
SH_DC = 0.5 / math.sqrt(math.pi)  # value of the constant spherical harmonic
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
    "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4",
    "uint32": "<u4", "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


@dataclass(frozen=True)
class GaussianCloud:
    """Gaussians as a .ply stores them, activated: ready for ``grmm.rasterize``.

    Attributes:
        means: (N, 3) in the file's unit.
        quats: (N, 4) wxyz, as stored (any length).
        scales: (N, 3) standard deviations, in the file's unit.
        opacities: (N,) in (0, 1).
        sh: (N, B, 3) spherical harmonics, B = 1, 4, 9 or 16; sRGB = 0.5 + sum of basis * sh.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor


def read_ply(path: str | Path) -> GaussianCloud:
    """Read a 3DGS .ply into float32 tensors.

    Raises:
        FormatError: not such a file, a property is missing, it is cut short, or holds NaN or Inf.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: no such file; expected a 3DGS .ply file")
    with path.open("rb") as stream:
        encoding, dtype, count = _read_header(path, stream)
        table = _read_table(path, stream, encoding, dtype, count)
    number = sum(name.startswith("f_rest_") for name in dtype.names or ())
    if number not in (0, 9, 24, 45):
        raise FormatError(f"{path}: {number} f_rest properties, expected 0, 9, 24 or 45")
    rest, bands = [f"f_rest_{i}" for i in range(number)], 1 + number // 3
    sh = np.empty((count, bands, 3), np.float32)
    sh[:, 0] = _columns(path, table, ["f_dc_0", "f_dc_1", "f_dc_2"])
    if rest:
        sh[:, 1:] = _columns(path, table, rest).reshape(count, 3, bands - 1).transpose(0, 2, 1)
    cloud = GaussianCloud(
        means=torch.from_numpy(_columns(path, table, ["x", "y", "z"])),
        quats=torch.from_numpy(_columns(path, table, [f"rot_{i}" for i in range(4)])),
        scales=torch.from_numpy(_scales(path, table)),
        opacities=torch.from_numpy(_columns(path, table, ["opacity"])[:, 0]).sigmoid(),
        sh=torch.from_numpy(sh),
    )
    if not bool(torch.isfinite(cloud.scales).all()):
        raise FormatError(f"{path}: scale_* hold logarithms over 88, expected log of a size")
    return cloud


def write_ply(
    path: str | Path,
    *,
    means: ArrayLike,
    quats: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike | None = None,
    sh: ArrayLike | None = None,
) -> None:
    """Write Gaussians as binary little endian 3DGS .ply; the same values give the same bytes.

    Arrays or CPU tensors: means (N, 3), quats (N, 4), scales (N, 3), opacities (N,) and either
    sRGB ``colors`` (N, 3) or spherical harmonics ``sh`` (N, B, 3). Opacities are kept within 1e-6
    of 0 and 1 and scales over 1e-30, so that their logits and logarithms are finite.

    Raises:
        ValueError: a shape does not fit, a value is not finite, or not one of colors and sh.
    """
    if (colors is None) == (sh is None):
        raise ValueError("expected exactly one of colors and sh")
    if sh is None:
        sh = (np.asarray(colors, np.float64)[:, None, :] - 0.5) / SH_DC
    n, bands = np.shape(means)[0], np.shape(sh)[1]
    arrays = {}
    for name, array, shape in (
        ("means", means, (n, 3)), ("quats", quats, (n, 4)), ("scales", scales, (n, 3)),
        ("opacities", opacities, (n,)), ("sh", sh, (n, bands, 3)),
    ):  # fmt: skip
        arrays[name] = np.asarray(array, np.float64)
        check_shape(name, arrays[name], shape, where=str(path))
        check_finite(name, arrays[name], where=str(path))
    alpha = arrays["opacities"].clip(1e-6, 1 - 1e-6)
    columns = [
        arrays["means"],
        np.zeros((n, 3)),
        arrays["sh"][:, 0],
        arrays["sh"][:, 1:].transpose(0, 2, 1).reshape(n, 3 * (bands - 1)),
        np.log(alpha / (1 - alpha))[:, None],
        np.log(arrays["scales"].clip(min=1e-30)),
        arrays["quats"],
    ]
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(3 * (bands - 1))]
    names += ["opacity"] + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate(columns, 1).astype("<f4")
    Path(path).write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def sh_to_colors(sh: Tensor, directions: Tensor) -> Tensor:
    """Colours (N, 3) >= 0 of spherical harmonics (N, B, 3) seen along directions (N, 3).

    ``directions`` point from the camera to the Gaussians, any length over 0. Source of the basis:
    real spherical harmonics (Sloan 2008), in the signs and order of 3DGS.
    """
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(1)
    one = torch.ones_like(x)
    a, b = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    c, d = math.sqrt(5 / (16 * math.pi)), math.sqrt(35 / (32 * math.pi))
    e, f = math.sqrt(105 / (4 * math.pi)), math.sqrt(21 / (32 * math.pi))
    g = math.sqrt(7 / (16 * math.pi))
    basis = [
        SH_DC * one,
        -a * y, a * z, -a * x,
        b * x * y, -b * y * z, c * (3 * z * z - 1), -b * x * z, b / 2 * (x * x - y * y),
        -d * y * (3 * x * x - y * y), e * x * y * z, -f * y * (5 * z * z - 1),
        g * z * (5 * z * z - 3), -f * x * (5 * z * z - 1), e / 2 * z * (x * x - y * y),
        -d * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    weights = torch.stack(basis[: sh.shape[1]], 1)
    return ((weights[..., None] * sh).sum(1) + 0.5).clamp(min=0.0)


def _header_words(path: Path, stream: BinaryIO) -> list[list[str]]:
    """Words of each header line between ``ply`` and ``end_header``, comments left out."""
    lines: list[list[str]] = []
    while not lines or lines[-1] != ["end_header"]:
        line = stream.readline(1024)
        if not line.endswith(b"\n") or stream.tell() > MAX_HEADER_BYTES:
            raise FormatError(f"{path}: no PLY header found; expected a 3DGS .ply file")
        lines.append(line.decode("latin-1").split())
        if lines[0] != ["ply"]:
            raise FormatError(f"{path}: starts with {line[:20]!r}, expected 'ply'")
    return [line for line in lines[1:-1] if line and line[0] not in ("comment", "obj_info")]


def _read_header(path: Path, stream: BinaryIO) -> tuple[str, np.dtype, int]:
    """Encoding, row type and number of the vertices; leaves the stream at the first of them."""
    lines = _header_words(path, stream)
    first = lines[0] if lines else ["nothing"]
    if first[:1] != ["format"] or first[1:2] not in [[e] for e in _ENCODINGS] or len(first) != 3:
        expected = ", ".join(_ENCODINGS)
        raise FormatError(f"{path}: got {' '.join(first)}, expected format {expected} 1.0")
    if any(line[0] == "property" and line[-1].startswith("packed_") for line in lines):
        raise FormatError(
            f"{path}: a compressed splat file (packed_*), expected f_dc_*, scale_* and rot_*;"
            " export it as an uncompressed .ply"
        )
    if len(lines) < 2 or lines[1][:2] != ["element", "vertex"]:
        raise FormatError(f"{path}: the first element is not 'vertex'")
    count = int(lines[1][2]) if len(lines[1]) == 3 and lines[1][2].isdecimal() else -1
    if not 0 <= count <= MAX_GAUSSIANS:
        raise FormatError(f"{path}: {' '.join(lines[1])}, expected 0 to {MAX_GAUSSIANS} vertices")
    fields = []
    for line in lines[2:]:
        if line[0] == "element":  # faces of other tools come after the vertices
            break
        if len(line) != 3 or line[0] != "property" or line[1] not in _TYPES:
            raise FormatError(f"{path}: {' '.join(line)!r} is not a scalar property")
        fields.append((line[2], _TYPES[line[1]]))
    if not fields or len({name for name, _ in fields}) != len(fields):
        raise FormatError(f"{path}: it has no vertex properties, or one is declared twice")
    return first[1], np.dtype(fields), count


def _read_table(
    path: Path, stream: BinaryIO, encoding: str, dtype: np.dtype, count: int
) -> np.ndarray:
    """The vertices, in ``dtype`` or its other byte order; FormatError if some are missing."""
    if encoding == "ascii":
        rows = list(islice(stream, count))
        try:
            values = [tuple(map(float, row.split())) for row in rows]
            table = np.array(values, np.dtype([(name, "<f8") for name in dtype.names or ()]))
        except ValueError as error:
            raise FormatError(f"{path}: a vertex line does not fit the header: {error}") from error
        if len(rows) < count:
            raise FormatError(
                f"{path}: {count} vertices, the file has {len(rows)}; it was cut short, copy it"
                " again"
            )
        return table
    have, need = path.stat().st_size - stream.tell(), count * dtype.itemsize
    if have < need:
        raise FormatError(
            f"{path}: {count} vertices need {need} bytes, the file has {have}; it was cut"
            " short, copy it again"
        )
    swapped = encoding == "binary_big_endian"
    return np.fromfile(stream, dtype=dtype.newbyteorder(">") if swapped else dtype, count=count)


def _scales(path: Path, table: np.ndarray) -> np.ndarray:
    """Standard deviations (N, 3); a surfel's third is 0."""
    names = [f"scale_{i}" for i in range(3)]
    flat = "scale_2" not in (table.dtype.names or ())
    logs = _columns(path, table, names[:2] if flat else names)
    with np.errstate(over="ignore"):  # refused by the caller
        scales = np.exp(logs)
    return np.pad(scales, ((0, 0), (0, 3 - scales.shape[1])))


def _columns(path: Path, table: np.ndarray, names: list[str]) -> np.ndarray:
    """Float32 columns (N, len(names)) of a table; FormatError if one is missing or not finite."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise FormatError(f"{path}: property {missing[0]!r} is missing; is this a 3DGS .ply file?")
    with np.errstate(over="ignore", invalid="ignore"):  # infinite then, and refused
        columns = np.stack([table[name].astype(np.float32) for name in names], 1)
    if not np.isfinite(columns).all():
        raise FormatError(f"{path}: {', '.join(names)} hold values that are not finite")
    return columns
