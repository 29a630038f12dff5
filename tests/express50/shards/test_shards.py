"""Shards: same bytes, random access, damage found, read by tar and webdataset."""

from __future__ import annotations

import gc
import json
import os
import pickle
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

from express50.__main__ import main
from express50.errors import FormatError, UnknownNameError
from express50.files.images import depth_to_uint16, encode_jpeg, encode_png, image_size
from express50.shards.reader import ShardReader
from express50.shards.writer import (
    PackedSample,
    ShardWriter,
    gather_shards,
    sample_key,
    tar_header,
    verify,
    write_manifest,
)

SIZE = 24


def make_sample(subject: str, expression: str, camera: str, number: int) -> PackedSample:
    rng = np.random.default_rng(number)
    depth = rng.uniform(0.9, 1.2, (SIZE, SIZE))
    valid = rng.uniform(size=(SIZE, SIZE)) > 0.3
    meta = {"subject": subject, "width": SIZE, "height": SIZE, "depth_scale_m": 5e-5}
    return PackedSample(
        subject,
        expression,
        camera,
        {
            "rgb.jpg": encode_jpeg(rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8), 95),
            "alpha.png": encode_png((valid * 255).astype(np.uint8)),
            "depth.png": encode_png(depth_to_uint16(depth, valid)),
            "meta.json": json.dumps(meta).encode(),
        },
    )


def write(root: Path, shard_bytes: int = 30_000) -> Path:
    writer = ShardWriter(root, shard_bytes)
    number = 0
    for split, subjects in (("train", ("S001", "S002")), ("test", ("S003",))):
        for subject in subjects:
            for expression in ("neutral", "jaw_open"):
                cameras = ("cam02", "cam00", "cam01")
                group = [make_sample(subject, expression, c, number + k) for k, c in
                         enumerate(cameras)]  # fmt: skip
                writer.add_group(split, group)
                number += 3
    writer.close()
    write_manifest(root, writer.digests)
    return root


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return write(tmp_path_factory.mktemp("shards") / "out")


def test_writing_twice_gives_the_same_bytes(shards, tmp_path):
    again = write(tmp_path / "again")
    files = sorted(path.name for path in shards.iterdir())
    assert files == sorted(path.name for path in again.iterdir())
    assert all((shards / name).read_bytes() == (again / name).read_bytes() for name in files)


def test_digests_taken_while_writing_are_those_of_the_files(tmp_path):
    root = write(tmp_path / "out")
    taken = (root / "manifest.json").read_bytes()
    write_manifest(root)
    assert (root / "manifest.json").read_bytes() == taken


@pytest.mark.parametrize(("name", "size"), [("a" * 101, 0), ("ä", 0), ("a", 8**11)])
def test_a_header_that_ustar_cannot_hold_is_refused(name, size):
    with pytest.raises(FormatError, match="8 GiB"):
        tar_header(name, size)


def test_sample_is_what_was_written(shards):
    reader = ShardReader(shards)
    assert len(reader) == 18
    sample = reader.sample(reader.keys.index("S001_neutral_cam02"))
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.9, 1.2, (SIZE, SIZE))
    valid = rng.uniform(size=(SIZE, SIZE)) > 0.3
    assert (sample["valid"] == valid).all()
    assert (sample["depth"][~valid] == 0).all()
    np.testing.assert_allclose(sample["depth"][valid], depth[valid], atol=2.6e-5)
    assert (sample["alpha"] == valid).all()
    assert sample["rgb"].shape == (SIZE, SIZE, 3) and sample["rgb"].dtype == np.uint8
    assert sample["meta"]["subject"] == "S001"


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("parts.png", "run 'express50 regions', then 'express50 pack' again"),
        ("depth.lerc", "has no depth.lerc, it has .*depth.png.*; ask for that"),
        ("mesh.ply", "rerun 'express50 pack'"),
    ],
)
def test_a_missing_member_says_what_makes_it(shards, name, fix):
    with pytest.raises(FormatError, match=fix):
        ShardReader(shards).members(0, [name])


def test_groups_stay_in_one_shard_with_members_adjacent(shards):
    reader = ShardReader(shards)
    assert len({entry.shard for entry in reader.entries}) >= 3
    for numbers in reader.groups().values():
        assert len({reader.entries[k].shard for k in numbers}) == 1
        assert [reader.entries[k].camera for k in numbers] == ["cam00", "cam01", "cam02"]
    for path in shards.glob("*.tar"):
        with tarfile.open(path) as tar:
            members = tar.getmembers()
        stems = [info.name.split(".")[0] for info in members]
        assert len(set(stems)) == sum(a != b for a, b in zip(stems, stems[1:], strict=False)) + 1
        assert all((i.mtime, i.uid, i.gid, i.uname) == (0, 0, 0, "") for i in members)
        assert "/" not in "".join(info.name for info in members)


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_reads_every_sample_unchanged(shards):
    webdataset = pytest.importorskip("webdataset")
    reader = ShardReader(shards)
    paths = sorted(str(path) for path in shards.glob("*.tar"))
    read = {}
    for row in webdataset.WebDataset(paths, shardshuffle=False, empty_check=False):
        read[row["__key__"]] = row
    assert sorted(read) == sorted(reader.keys)
    for number, entry in enumerate(reader.entries):
        for name in entry.members:
            assert read[entry.key][name] == reader.members(number)[name]
    del row
    gc.collect()  # webdataset leaves the shards open, of which only this test shall hear


def test_select_by_ids_and_split(shards):
    reader = ShardReader(shards)
    some = reader.select(subjects=["S002"], cameras=["cam01"])
    assert some.keys == ["S002_neutral_cam01", "S002_jaw_open_cam01"]
    assert some.sample(1)["key"] == "S002_jaw_open_cam01"
    assert len(reader.select(split="test")) == 6
    with pytest.raises(UnknownNameError, match="expected one of S001, S002, S003"):
        reader.select(subjects=["S009"])


def test_readers_that_are_gone_leave_no_open_files(shards):
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = open_files()
    for _ in range(5):
        reader = ShardReader(shards)
        for number in range(len(reader)):
            reader.members(number)
        assert open_files() > before
        del reader
    assert open_files() == before


def test_reader_survives_pickling_and_forking(shards):
    reader = ShardReader(shards)
    first = reader.members(0)
    assert pickle.loads(pickle.dumps(reader)).members(0) == first
    child = os.fork()
    if child == 0:
        os._exit(0 if reader.members(0) == first else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert reader.members(0) == first


def test_a_flipped_byte_is_found_and_named(shards, tmp_path, capsys):
    root = shutil.copytree(shards, tmp_path / "bad")
    reader = ShardReader(root)
    entry = reader.entries[4]
    offset = entry.members["depth.png"][0] + 11
    data = bytearray((root / entry.shard).read_bytes())
    data[offset] ^= 1
    (root / entry.shard).write_bytes(data)
    with pytest.raises(FormatError, match=rf"{entry.shard}: {entry.key}.depth.png: damaged"):
        reader.sample(4)
    assert reader.sample(3)["key"] == reader.keys[3]
    assert main(["shards", "verify", str(root)]) == 1
    out = capsys.readouterr().out
    assert entry.key in out and "SHA-256" in out
    assert main(["shards", "verify", str(shards)]) == 0


def test_verifying_a_missing_folder_gives_one_error(tmp_path):
    (tmp_path / "file").touch()
    for name, what in (("file", "is a file, not a folder"), ("absent", "no such folder")):
        (fault,) = verify(tmp_path / name)
        assert f"{name}: {what}; name" in fault


def test_a_header_that_names_another_member_is_found(shards, tmp_path):
    root = shutil.copytree(shards, tmp_path / "bad")
    entry = ShardReader(root).entries[0]
    start = entry.members["alpha.png"][0] - 512
    data = bytearray((root / entry.shard).read_bytes())
    data[start] = ord("X")
    (root / entry.shard).write_bytes(data)
    assert any("tar" in fault and "alpha.png" in fault for fault in verify(root))


@pytest.mark.parametrize("cut", ["truncate", "remove"])
def test_a_short_or_missing_shard_is_named(shards, tmp_path, cut):
    root = shutil.copytree(shards, tmp_path / "bad")
    path = sorted(root.glob("train*.tar"))[0]
    path.unlink() if cut == "remove" else path.write_bytes(path.read_bytes()[:-512])
    with pytest.raises(FormatError, match=path.name):
        ShardReader(root)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(schema="other/9"), "schema 'other/9'"),
        (lambda t: t["shards"][0].update(file="../../etc/passwd"), "shard name"),
        (lambda t: t["shards"][0].update(file="/etc/passwd"), "shard name"),
        (lambda t: t["shards"][0]["samples"][0].pop("members"), "malformed"),
        (lambda t: t["shards"][0]["samples"][0].update(key="a.b"), "key"),
        (
            lambda t: t["shards"][0]["samples"][0]["members"].update({"rgb.jpg": [0, 10**9, 0]}),
            "outside the shard",
        ),
    ],
)
def test_a_forged_index_is_refused(shards, tmp_path, change, message):
    root = shutil.copytree(shards, tmp_path / "bad")
    table = json.loads((root / "index.json").read_text())
    change(table)
    (root / "index.json").write_text(json.dumps(table))
    with pytest.raises(FormatError, match=message):
        ShardReader(root)


def test_a_manifest_that_lacks_a_shard_is_named_when_shards_are_gathered(shards, tmp_path):
    root = shutil.copytree(shards, tmp_path / "bad")
    table = json.loads((root / "manifest.json").read_text())
    table["files"] = {n: row for n, row in table["files"].items() if not n.endswith(".tar")}
    (root / "manifest.json").write_text(json.dumps(table))
    (tmp_path / "out").mkdir()
    with pytest.raises(FormatError, match=r"manifest.json: lacks .*\.tar, which index.json names"):
        gather_shards([(root, "train")], tmp_path / "out")


def test_manifest_cannot_point_outside(shards, tmp_path):
    root = shutil.copytree(shards, tmp_path / "bad")
    table = json.loads((root / "manifest.json").read_text())
    table["files"]["../secret"] = {"bytes": 1, "sha256": "0"}
    (root / "manifest.json").write_text(json.dumps(table))
    assert verify(root) == [f"{root / '../secret'}: is missing or outside the folder"]


@pytest.mark.parametrize("bad", ["S.1", "../x", "a/b", "", "x" * 81, "é", "a b"])
def test_ids_that_tar_readers_split_differently_are_refused(bad):
    with pytest.raises(FormatError, match="letters, digits"):
        sample_key(bad, "smile", "cam00")


def test_writer_refuses_mixed_repeated_and_colliding_groups(tmp_path):
    writer = ShardWriter(tmp_path / "out", 10**6)
    writer.add_group("train", [make_sample("S1", "a_b", "c", 0)])
    with pytest.raises(FormatError, match="all samples of one expression of a subject, once"):
        writer.add_group("train", [make_sample("S1", "a_b", "d", 0)])
    with pytest.raises(FormatError, match="all samples of one expression of a subject, once"):
        writer.add_group("train", [make_sample("S2", "a", "d", 0), make_sample("S3", "a", "d", 0)])
    with pytest.raises(FormatError, match="twice"):
        writer.add_group("train", [make_sample("S1_a", "b", "c", 0)])


def test_image_size_is_read_before_decoding():
    image = np.zeros((7, 1000, 3), np.uint8)
    assert image_size(encode_png(image), "x") == (1000, 7)
    assert image_size(encode_jpeg(image), "x") == (1000, 7)
    for junk in (b"", b"\xff\xd8", b"\xff\xd8\xff\xc0", b"GIF89a" * 9):
        with pytest.raises(FormatError, match="x: "):
            image_size(junk, "x")


def test_a_decompression_bomb_is_refused(tmp_path):
    sample = make_sample("S1", "a", "c", 0)
    bomb = bytearray(sample.members["depth.png"])
    bomb[16:24] = (60_000).to_bytes(4) * 2
    members = {**sample.members, "depth.png": bytes(bomb)}
    writer = ShardWriter(tmp_path / "out", 10**6)
    writer.add_group("train", [PackedSample("S1", "a", "c", members)])
    writer.close()
    with pytest.raises(FormatError, match="expected at most"):
        ShardReader(tmp_path / "out").sample(0)


def test_ls_and_show(shards, tmp_path, capsys):
    assert main(["shards", "ls", str(shards), "--split", "test"]) == 0
    assert "6 samples" in capsys.readouterr().out
    picture = tmp_path / "picture.png"
    command = ["shards", "show", str(shards), "S002_neutral_cam01", "--out", str(picture)]
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["key"] == "S002_neutral_cam01"
    assert image_size(picture.read_bytes(), "x") == (3 * SIZE, SIZE)
    assert main(["shards", "show", str(shards), "nobody"]) == 1


def test_a_shard_that_a_full_disk_left_is_closed_in_silence(tmp_path, capfd):
    (tmp_path / "train-000000.tar").symlink_to("/dev/full")
    writer = ShardWriter(tmp_path, 10**6)
    writer._file = (tmp_path / "train-000000.tar").open("wb")
    writer._file.write(b"x")
    del writer
    gc.collect()
    assert capfd.readouterr().err == ""
