"""3DGS .ply files: round trip, foreign layouts, broken and hostile files, spherical harmonics."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
import torch

from express50.errors import FormatError
from grmm.ply import GaussianCloud, read_ply, sh_to_colors, write_ply
from grmm.rasterize import rasterize


def cloud(n: int = 7, bands: int = 4) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator) * 0.1 + 1e-4,
        "opacities": torch.rand(n, generator=generator) * 0.9 + 0.05,
        "sh": torch.randn(n, bands, 3, generator=generator),
    }


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip(tmp_path, n, bands):
    values = cloud(n, bands)
    write_ply(tmp_path / "a.ply", **values)
    got = read_ply(tmp_path / "a.ply")
    for name, value in values.items():
        assert torch.allclose(getattr(got, name), value, rtol=1e-5, atol=1e-7), name
    write_ply(tmp_path / "b.ply", **values)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_bytes_of_one_gaussian_worked_by_hand(tmp_path):
    write_ply(
        tmp_path / "a.ply",
        means=[[1.0, 2, 3]],
        quats=[[1.0, 0, 0, 0]],
        scales=[[math.e, 1, 1 / math.e]],
        opacities=[0.5],
        colors=[[0.5, 1.0, 0.0]],
    )
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty")
    values = struct.unpack("<17f", body)
    dc = 0.5 * 2 * math.sqrt(math.pi)  # (1 - 0.5) / (1 / (2 sqrt pi))
    expected = [1, 2, 3, 0, 0, 0, 0, dc, -dc, 0, 1, 0, -1, 1, 0, 0, 0]
    assert values == pytest.approx(expected, abs=1e-6)


def test_other_property_order_types_and_elements_are_understood(tmp_path):
    fields = [("opacity", "f8"), ("extra", "u1")]
    fields += [(n, "f4") for n in ["x", "z", "y", "rot_0", "rot_1", "rot_2", "rot_3"]]
    fields += [(f"scale_{i}", "f4") for i in range(3)] + [(f"f_dc_{i}", "f4") for i in range(3)]
    table = np.zeros(2, dtype=[(n, "<" + t if t != "u1" else t) for n, t in fields])
    table["z"], table["y"], table["rot_0"] = 5.0, 6.0, 1.0
    names = {"f8": "double", "u1": "uchar", "f4": "float32"}
    lines = ["ply", "format binary_little_endian 1.0", "comment made by hand", "element vertex 2"]
    lines += [f"property {names[t]} {n}" for n, t in fields]
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header", ""]
    path = tmp_path / "a.ply"
    path.write_bytes("\r\n".join(lines).encode() + table.tobytes())
    got = read_ply(path)
    assert got.means.tolist() == [[0, 6, 5]] * 2
    assert got.opacities.tolist() == [0.5, 0.5]
    assert got.scales.tolist() == [[1, 1, 1]] * 2


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_other_encodings_are_the_same_cloud(tmp_path, encoding):
    write_ply(tmp_path / "a.ply", **cloud(5, 4))
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(5, -1)
    lines = "\n".join(" ".join(repr(float(x)) for x in row) for row in table) + "\n"
    data = lines.encode() if encoding == "ascii" else table.astype(">f4").tobytes()
    header = header.replace(b"binary_little_endian", encoding.encode())
    (tmp_path / "b.ply").write_bytes(header + b"end_header\n" + data)
    expected, got = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(expected, name), getattr(got, name)), name


def test_a_text_file_cut_short_is_named(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text(GOOD.replace("binary_little_endian", "ascii").replace("vertex 1", "vertex 3"))
    with pytest.raises(FormatError, match="3 vertices, the file has 0"):
        read_ply(path)


def test_surfels_of_two_scales_are_flat(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(GOOD.replace("property float scale_2\n", "").encode() + bytes(52))
    assert read_ply(path).scales.tolist() == [[1, 1, 0]]


GOOD = "\n".join(
    ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    + [f"property float {n}" for n in ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]]
    + [f"property float scale_{i}" for i in range(3)]
    + [f"property float rot_{i}" for i in range(4)]
    + ["end_header", ""]
)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ply\n", "plx\n"), "starts with b'plx.n', expected 'ply'"),
        (("binary_little_endian", "text"), "got format text 1.0, expected format ascii, binary"),
        (("binary_little_endian", "ascii"), "vertex line does not fit the header"),
        (("vertex 1", "vertex 1\nproperty uint packed_scale"), "compressed splat file"),
        (("vertex 1", "vertex -1"), "element vertex -1, expected 0 to"),
        (("vertex 1", "vertex 99999999999"), "expected 0 to 50000000 vertices"),
        (("vertex 1", "vertex 2"), "2 vertices need 112 bytes, the file has 56"),
        (("property float x\n", ""), "'x' is missing"),
        (("property float x", "property list uchar int x"), "is not a scalar property"),
        (("property float x", "property float y"), "declared twice"),
        (("property float x", "property float f_rest_0"), "1 f_rest properties"),
        (("end_header", "end"), "no PLY header found"),
    ],
)
def test_broken_files_are_named(tmp_path, change, message):
    path = tmp_path / "bad.ply"
    path.write_bytes(GOOD.replace(*change).encode() + bytes(56))
    with pytest.raises(FormatError, match=message) as error:
        read_ply(path)
    assert "bad.ply" in str(error.value)


@pytest.mark.parametrize(("column", "value"), [(0, math.nan), (6, math.inf), (7, 1000.0)])
def test_values_that_are_not_finite_are_refused(tmp_path, column, value):
    row = np.zeros(14, "<f4")
    row[column] = value
    path = tmp_path / "a.ply"
    path.write_bytes(GOOD.encode() + row.tobytes())
    with pytest.raises(FormatError, match="not finite|logarithms over"):
        read_ply(path)


def test_a_header_without_end_is_given_up(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + b"comment x\n" * 100_000)
    with pytest.raises(FormatError, match="no PLY header"):
        read_ply(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quats": np.zeros((7, 3))}, r"quats has shape \(7, 3\), expected \(7, 4\)"),
        ({"scales": np.full((7, 3), np.nan)}, "scales has 21 values that are not finite"),
        ({"colors": np.zeros((7, 3))}, "exactly one of colors and sh"),
    ],
)
def test_bad_arrays_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        write_ply(tmp_path / "a.ply", **(cloud() | change))


def test_spherical_harmonics_are_orthonormal():
    n = 20_000
    k = torch.arange(n, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * k / n, k * math.pi * (1 + math.sqrt(5))  # Fibonacci sphere
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * angle.cos(), r * angle.sin(), z], 1)
    sh = torch.eye(16, dtype=torch.float64)
    values = torch.stack(
        [
            sh_to_colors(sh[i].reshape(1, 16, 1).expand(n, 16, 3) + shift(), directions)[:, 0] - 3.5
            for i in range(16)
        ]
    )
    gram = values @ values.T * (4 * math.pi / n)
    assert (gram - torch.eye(16, dtype=torch.float64)).abs().max() < 1e-3


def shift() -> torch.Tensor:
    """Lifts every colour by 3, so that none is cut at 0."""
    dc = torch.zeros(1, 16, 1, dtype=torch.float64)
    dc[:, 0] = 3 * 2 * math.sqrt(math.pi)
    return dc


def test_first_band_points_along_the_axes():
    sh = torch.zeros(3, 4, 3)
    sh[:, 1:] = torch.eye(3)  # y, z, x in the colour channels
    got = sh_to_colors(sh, torch.eye(3))
    a = math.sqrt(3 / (4 * math.pi))
    expected = 0.5 + torch.tensor([[0, 0, -a], [-a, 0, 0], [0, a, 0]])
    assert torch.allclose(got, expected.clamp(min=0), atol=1e-6)


def test_a_file_renders(tmp_path):
    values = cloud(20)
    values["means"] = values["means"] * 0.1
    write_ply(tmp_path / "a.ply", **values)
    got: GaussianCloud = read_ply(tmp_path / "a.ply")
    pose = torch.eye(4)
    pose[2, 3] = 1.0
    directions = got.means - torch.tensor([0.0, 0.0, -1.0])
    out = rasterize(
        got.means, got.quats, got.scales, got.opacities, sh_to_colors(got.sh, directions),
        torch.tensor([[60.0, 0, 16], [0, 60, 16], [0, 0, 1]]), pose, 32, 32,
    )  # fmt: skip
    assert out.alpha.max() > 0.5
