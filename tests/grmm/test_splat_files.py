"""PLY, GLB with KHR_gaussian_splatting and SPZ: read back by readers of the specifications."""

import gzip
import json
import math
import os
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from express50.errors import ConfigError
from grmm.export import GaussianCloud, ply_bytes, splats_glb, spz_bytes

SH_DC = 0.28209479177387814
ATTRIBUTES = ("/meshes/0/primitives/0/attributes/KHR_gaussian_splatting", "")
SCRIPT = """const v = require("gltf-validator"), fs = require("fs");
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(r => console.log(JSON.stringify(r.issues)));"""


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(50, 4))
    return GaussianCloud(
        means=rng.uniform(-0.2, 0.2, (50, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(2e-4, 1e-2, (50, 3)).astype(np.float32),
        opacities=rng.uniform(0, 1, 50).astype(np.float32),
        colors=rng.uniform(0, 1, (50, 3)).astype(np.float32),
    )


def read_ply(content):
    header, _, body = content.partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    column = dict(zip(names, table.T, strict=True))
    many = lambda *keys: np.stack([column[key] for key in keys], 1)  # noqa: E731
    return GaussianCloud(
        means=many("x", "y", "z"),
        quats=many("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=np.exp(many("scale_0", "scale_1", "scale_2")),
        opacities=1 / (1 + np.exp(-column["opacity"])),
        colors=0.5 + SH_DC * many("f_dc_0", "f_dc_1", "f_dc_2"),
    )


def read_glb(content):
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size = struct.unpack("<I", content[12:16])[0]
    document = json.loads(content[20 : 20 + size])
    body = content[28 + size :]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    arrays = {}
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays[name.split(":")[-1]] = np.frombuffer(part, "<f4").reshape(accessor["count"], -1)
    return GaussianCloud(
        means=arrays["POSITION"],
        quats=arrays["ROTATION"][:, [3, 0, 1, 2]],
        scales=arrays["SCALE"],
        opacities=arrays["OPACITY"][:, 0],
        colors=0.5 + SH_DC * arrays["SH_DEGREE_0_COEF_0"],
    )


def read_spz(content):
    data = gzip.decompress(content)
    magic, version, count, degree, bits, flags, _ = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, degree, flags) == (0x5053474E, 3, 0, 0)
    sizes = [9 * count, count, 3 * count, 3 * count, 4 * count]
    ends = 16 + np.cumsum(sizes)
    assert ends[-1] == len(data)
    parts = [np.frombuffer(data[e - s : e], np.uint8) for s, e in zip(sizes, ends, strict=True)]
    wide = np.zeros((3 * count, 4), np.uint8)
    wide[:, 1:] = parts[0].reshape(-1, 3)
    quats = np.zeros((count, 4))
    for row, word in enumerate(parts[4].view("<u4").tolist()):
        largest = word >> 30
        for entry in (i for i in range(3, -1, -1) if i != largest):
            value = (word & 511) / 511 / np.sqrt(2)
            quats[row, entry] = -value if word & 512 else value
            word >>= 10
        quats[row, largest] = np.sqrt(max(0.0, 1 - (quats[row] ** 2).sum()))
    return GaussianCloud(
        means=(wide.view("<i4").reshape(-1, 3) >> 8) / 2**bits,
        quats=quats[:, [3, 0, 1, 2]],
        scales=np.exp(parts[3].reshape(-1, 3) / 16 - 10),
        opacities=parts[1] / 255,
        colors=0.5 + SH_DC * (parts[2].reshape(-1, 3) / 255 - 0.5) / 0.15,
    )


@pytest.mark.parametrize(
    ("write", "read", "means", "angle", "relative", "shade"),
    [
        (ply_bytes, read_ply, 0, 1e-3, 1e-5, 1e-6),
        (splats_glb, read_glb, 0, 1e-3, 0, 1e-6),
        (spz_bytes, read_spz, 2**-17, 6e-3, 0.032, 0.0039),
    ],
)
def test_what_is_written_is_read_back(cloud, write, read, means, angle, relative, shade):
    """Equal to rounding; SPZ within half a step of its codes."""
    back = read(write(cloud))
    np.testing.assert_allclose(back.means, cloud.means, rtol=0, atol=means)
    cosine = np.abs((back.quats * cloud.quats).sum(1)) / np.linalg.norm(back.quats, axis=1)
    assert np.arccos(cosine.clip(max=1)).max() < angle
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=relative + 1e-7)
    np.testing.assert_allclose(back.opacities, cloud.opacities, rtol=0, atol=max(shade / 1.9, 1e-5))
    np.testing.assert_allclose(back.colors, cloud.colors, rtol=0, atol=shade)


@pytest.fixture
def one():
    """One Gaussian whose logarithms and logit are whole numbers."""
    return GaussianCloud(
        means=np.array([[1.0, 2, 3]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.array([[math.e, 1, 1 / math.e]]),
        opacities=np.array([0.5]),
        colors=np.array([[0.5, 1.0, 0.0]]),
    )


def test_bytes_of_one_gaussian_worked_by_hand(one):
    header, _, body = ply_bytes(one).partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty")
    dc = 0.5 * 2 * math.sqrt(math.pi)  # (1 - 0.5) / (1 / (2 sqrt pi))
    expected = [1, 2, 3, 0, 0, 0, 0, dc, -dc, 0, 1, 0, -1, 1, 0, 0, 0]
    assert struct.unpack("<17f", body) == pytest.approx(expected, abs=1e-6)


def test_extreme_opacities_and_scales_stay_finite(one):
    flat = replace(one, opacities=np.array([1.0]), scales=np.zeros((1, 3)))
    body = ply_bytes(flat).partition(b"end_header\n")[2]
    assert np.isfinite(np.frombuffer(body, "<f4")).all()


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_values_that_are_not_finite_are_refused(one, name):
    with pytest.raises(ValueError, match=name):
        replace(one, **{name: np.full_like(getattr(one, name), np.nan)})


def test_spz_refuses_far_positions(cloud):
    with pytest.raises(ConfigError, match="128 m"):
        spz_bytes(replace(cloud, means=cloud.means + 130))


def test_khronos_validator_finds_nothing_wrong(cloud, tmp_path):
    """GLTF_VALIDATOR names a folder where `npm install gltf-validator` was run."""
    folder = os.environ.get("GLTF_VALIDATOR")
    if folder is None or shutil.which("node") is None:
        pytest.skip("needs node, and GLTF_VALIDATOR: a folder with npm's gltf-validator")
    path = tmp_path / "a.glb"
    path.write_bytes(splats_glb(cloud))
    command = ["node", "-e", SCRIPT, str(path)]
    out = subprocess.run(command, cwd=Path(folder), capture_output=True, text=True, check=True)
    messages = json.loads(out.stdout)["messages"]
    # Version 2.0.0-dev.3.10 of the validator knows neither the extension nor its attribute names.
    unknown = {"UNSUPPORTED_EXTENSION": "/extensionsUsed/0",
               "MESH_PRIMITIVE_INVALID_ATTRIBUTE": ":".join(ATTRIBUTES)}  # fmt: skip
    others = [m for m in messages if not m["pointer"].startswith(unknown.get(m["code"], "-"))]
    assert not others, others
