"""Offsets and registered meshes go with the shards; the trainer's mesh is the tracked one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from express50.dataset.tracks import REGISTRATION_SCHEMA
from express50.errors import FormatError
from express50.files.digests import file_sha256
from express50.head.load import load_head
from express50.shards.reader import ShardReader, write_registered
from express50.shards.writer import copy_samples, verify
from grmm.checkpoint import Gallery, load_checkpoint, save_checkpoint
from grmm.data import HeadViews, pose_state
from grmm.edit import interpolate_tracked, transfer
from grmm.model import GRMM
from grmm.shard_source import ShardSource
from pipelines.depth import STAGE as DEPTH
from pipelines.depth import DepthConfig
from pipelines.pack import ENCODE, EncodeConfig, PackConfig
from pipelines.pack import STAGE as PACK
from tests.express50.dataset.tracked import track_arrays, world_vertices, write_track
from tests.grmm.synthetic import tiny_config
from tests.pipelines.bump_dataset import make_dataset, published


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """Folder of shards, and the arrays of the one track with offsets; S002 has none.

    S001's smile is registered; the registration of its neutral face is of another track, that of
    S002's is damaged.
    """
    dataset = make_dataset(tmp_path_factory.mktemp("offsets"), ("S001", "S002"), cameras=3, size=64)
    published(dataset, DEPTH, DepthConfig(voxel_mm=8))
    arrays = track_arrays("procedural", turn=0.1)
    # The bump head stands in the middle of the rig.
    arrays["t"] -= arrays["vertices"].mean(1)
    vertices = world_vertices(load_head("procedural"), arrays, arrays["offsets"])
    arrays["vertices"] = vertices.astype(np.float32)
    path = write_track(dataset.track_file("S001"), arrays)
    for item, track in (("S001/smile", file_sha256(path)), ("S001/neutral", "0" * 64)):
        write_registration(dataset.registration_file(*item.split("/")), track)
    damaged = dataset.registration_file("S002", "neutral")
    damaged.parent.mkdir(parents=True)
    damaged.write_bytes(b"PK")
    published(dataset, ENCODE, EncodeConfig(size=32))
    published(dataset, PACK, PackConfig(test_subjects=("S002",)))
    return dataset.item_dir("pack", "shards"), arrays


def write_registration(path: Path, track: str) -> None:
    """Write numbers in the form of a registration of a track's digest."""
    rng, count = np.random.default_rng(3), len(load_head("procedural").template)
    arrays = {
        name: rng.uniform(-0.015, 0.015, (count, 3)).astype(np.float32)
        for name in ("vertices", "offsets")
    }
    sigma = rng.uniform(4e-4, 3e-3, count).astype(np.float32)
    path.parent.mkdir(parents=True)
    np.savez(
        path, schema=REGISTRATION_SCHEMA, track=track, residual=0 * sigma, sigma=sigma,
        seen=sigma < 1e-3, **arrays,
    )  # fmt: skip


def test_rebuilt_vertices_are_the_tracked_ones(packed) -> None:
    root, arrays = packed
    source, head = ShardSource(root, "*"), load_head("procedural")
    views, seen = HeadViews(source, head), set()
    for index, key in enumerate(source.keys):
        if key.subject != "S001":
            assert len(source.read(index).place.tracked.offsets) == 0
            continue
        tracked = source.read(index).place.tracked
        rebuilt = views.state(index).vertices.double().numpy() @ tracked.R.T + tracked.t
        row = arrays["expressions"].tolist().index(key.expression)
        np.testing.assert_allclose(rebuilt, arrays["vertices"][row], atol=1e-6)
        seen.add(row)
    assert seen == {0, 1}
    assert np.abs(arrays["offsets"]).mean() > 1e-3


def test_offsets_are_stored_once_per_subject_and_checked(packed, tmp_path) -> None:
    root, arrays = packed
    assert [path.name for path in root.glob("*.npy")] == ["S001.offsets.npy"]
    assert verify(root) == []
    path = root / "S001.offsets.npy"
    good = path.read_bytes()
    reader = ShardReader(root)
    np.testing.assert_array_equal(reader.offsets("S001"), arrays["offsets"])
    try:
        for data in (good[:-8], b"", b"\x80\x04N.", b"PK\x03\x04" + good):
            path.write_bytes(data)
            with pytest.raises(FormatError, match=r"S001\.offsets\.npy: not? offsets") as caught:
                ShardSource(root).read(0)
            assert "\n" not in str(caught.value)
            assert any("SHA-256 differs" in fault for fault in verify(root))
        np.save(path, arrays["offsets"][:-1])
        with pytest.raises(FormatError, match="offsets, head model 'procedural'"):
            HeadViews(ShardSource(root), load_head("procedural")).sample(0)
        np.save(path, np.full((5, 3), np.nan, np.float32))
        with pytest.raises(FormatError, match="NaN or Inf"):
            reader.offsets("S001")
        np.save(path, np.zeros((5, 3)))
        with pytest.raises(FormatError, match=r"float64 \(5, 3\), expected float32 \(V, 3\)"):
            reader.offsets("S001")
        path.unlink()
        with pytest.raises(FormatError, match=r"S001.offsets.npy: no such file; .*express50 pack"):
            ShardSource(root).read(0)
    finally:
        path.write_bytes(good)
    with pytest.raises(FormatError, match="expected letters"):
        reader.offsets("../S001")


def test_registered_meshes_are_packed_and_others_are_named(packed) -> None:
    root, _ = packed
    reader = ShardReader(root)
    given = np.load(root.parents[1] / "register" / "S001" / "smile" / "registration.npz")
    ((name, (offsets, sigma)),) = reader.registered("S001").items()
    assert name == "smile"
    np.testing.assert_allclose(offsets, given["offsets"], atol=4e-6)
    np.testing.assert_allclose(sigma, given["sigma"], atol=1e-6)
    told = {tuple(key.split("_")[:2]): reader.meta(n) for n, key in enumerate(reader.keys)}
    assert [k for k, meta in told.items() if meta["track"]["registered"]] == [("S001", "smile")]
    assert not (root / "S002.registered.npz").exists()
    metrics = json.loads((root / "metrics.json").read_text())
    assert metrics["registered"] == 3 and metrics["kept"] == 12
    assert "| registered mesh | 3 of 12 samples |" in (root / "card.md").read_text()
    encoded = root.parents[1] / "encode"
    why = {
        row["what"]: row["why"]
        for subject in ("S001", "S002")
        for row in json.loads((encoded / subject / "metrics.json").read_text())["warnings"]
    }
    assert "belongs to another track; run 'express50 register' again" in why["S001/neutral"]
    assert "not a registration" in why["S002/neutral"]


def test_damaged_registered_meshes_are_one_clear_error(packed, tmp_path) -> None:
    good = {
        "expressions": np.array(["smile"]),
        "offsets": np.zeros((1, 5, 3), np.float16),
        "sigma": np.ones((1, 5), np.float16),
    }
    changes = (
        ({"sigma": np.ones((1, 4), np.float16)}, r"sigma has shape \(1, 4\), expected \(1, 5\)"),
        (
            {"offsets": np.full((1, 5, 3), np.nan, np.float16)},
            "offsets has 15 values that are not finite",
        ),
        ({"sigma": np.full((1, 5), "x")}, "sigma is <U1, expected numbers"),
        ({"expressions": np.array("smile")}, r"expressions has shape \(\)"),
    )
    for change, words in changes:
        np.savez(tmp_path / "S001.registered.npz", **(good | change))
        with pytest.raises(FormatError, match=f"S001.registered.npz: .*{words}.*express50 pack"):
            ShardReader(tmp_path, ()).registered("S001")
    with pytest.raises(FormatError, match=r"S002.registered.npz: no such file; .*express50 pack"):
        ShardReader(tmp_path, ()).registered("S002")


def test_copied_samples_keep_the_files_beside_their_shards(packed, tmp_path, monkeypatch) -> None:
    root, _ = packed
    names = ("S001.offsets.npy", "S001.registered.npz")
    parts = []
    for expression in ("neutral", "smile"):
        parts.append(tmp_path / expression)
        copy_samples([ShardReader(root).select(expressions=[expression])], parts[-1], 1)
    copy_samples([ShardReader(part) for part in parts], tmp_path / "merged", 1)
    for name in names:
        assert (tmp_path / "merged" / name).read_bytes() == (root / name).read_bytes()
    assert verify(tmp_path / "merged") == []
    write_registered(parts[0], "S001", {"neutral": (np.zeros((5, 3)), np.ones(5))})
    with monkeypatch.context() as patch:
        patch.setattr(
            "express50.shards.writer.ShardWriter", None
        )  # found before a sample is copied
        with pytest.raises(FormatError, match=r"differs from the other folder's S001.registered"):
            copy_samples([ShardReader(part) for part in parts], tmp_path / "again", 1)
    (parts[1] / names[1]).unlink()
    with pytest.raises(FormatError, match=r"S001.registered.npz: is missing"):
        copy_samples([ShardReader(parts[1])], tmp_path / "again", 1)
    (parts[0] / names[1]).unlink()  # its samples need none
    assert copy_samples([ShardReader(parts[0])], tmp_path / "fewer", 1) == 6


def test_checkpoints_transfer_and_interpolation_keep_offsets(packed, tmp_path) -> None:
    root, arrays = packed
    source, head = ShardSource(root, "*"), load_head("procedural")
    frames = {
        (key.subject, key.expression): source.place(i).tracked for i, key in enumerate(source.keys)
    }
    one, other = frames["S001", "smile"], frames["S002", "neutral"]
    assert transfer(one, other).offsets is one.offsets
    assert len(transfer(other, one).offsets) == 0
    same = interpolate_tracked(one, frames["S001", "neutral"], 0.5)
    assert same.offsets is one.offsets
    for a, b, t in ((one, other, 0.25), (other, one, 0.75)):
        blend = interpolate_tracked(a, b, t).offsets
        np.testing.assert_allclose(blend, 0.75 * arrays["offsets"], rtol=1e-6)
    config = tiny_config()
    model = GRMM(config.model, head, ["S001", "S002"], ["neutral", "smile"])
    path = tmp_path / "checkpoint.pt"
    gallery = Gallery(frames=frames, cameras={})
    save_checkpoint(path, model=model, config=config, head_spec="procedural", gallery=gallery)
    loaded = load_checkpoint(path)
    for (subject, expression), tracked in frames.items():
        state = pose_state(loaded.head, loaded.gallery.frames[subject, expression])
        assert torch.equal(state.vertices, pose_state(head, tracked).vertices)
