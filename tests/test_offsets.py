"""Static offsets go with the shards, once a subject, and the trainer's mesh is the tracked one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from express50.errors import FormatError
from express50.head.load import load_head
from express50.shards.reader import ShardReader
from express50.shards.writer import verify
from grmm.checkpoint import Gallery, load_checkpoint, save_checkpoint
from grmm.data import HeadViews, pose_state
from grmm.edit import interpolate_tracked, transfer
from grmm.model import GRMM
from grmm.shard_source import ShardSource
from pipelines.depth import STAGE as DEPTH
from pipelines.depth.config import DepthConfig
from pipelines.pack import STAGE as PACK
from pipelines.pack.config import PackConfig
from tests.express50.dataset.tracked import track_arrays, world_vertices, write_track
from tests.grmm.synthetic import tiny_config
from tests.pipelines.bump_dataset import make_dataset, published


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """Folder of shards, and the arrays of the one track with offsets; S002 has none."""
    dataset = make_dataset(tmp_path_factory.mktemp("offsets"), ("S001", "S002"), cameras=3, size=64)
    published(dataset, DEPTH, DepthConfig(voxel_mm=8, use_track=False))
    arrays = track_arrays("procedural", turn=0.1)
    # The bump head stands in the middle of the rig.
    arrays["t"] -= arrays["vertices"].mean(1)
    vertices = world_vertices(load_head("procedural"), arrays, arrays["offsets"])
    arrays["vertices"] = vertices.astype(np.float32)
    write_track(dataset.track_file("S001"), arrays)
    published(dataset, PACK, PackConfig(size=32, test_subjects=("S002",)))
    return dataset.item_dir("pack", "shards"), arrays


def test_rebuilt_vertices_are_the_tracked_ones(packed) -> None:
    root, arrays = packed
    source, head = ShardSource(root, "*"), load_head("procedural")
    views, seen = HeadViews(source, head), set()
    for index, key in enumerate(source.keys):
        if key.subject != "S001":
            assert len(source.read(index).tracked.offsets) == 0
            continue
        tracked = source.read(index).tracked
        rebuilt = views.state(index).vertices.double().numpy() @ tracked.R.T + tracked.t
        row = arrays["expressions"].tolist().index(key.expression)
        np.testing.assert_allclose(rebuilt, arrays["vertices"][row], atol=1e-6)
        seen.add(row)
    assert seen == {0, 1}
    assert np.abs(arrays["offsets"]).mean() > 1e-3


def test_offsets_are_stored_once_a_subject_and_checked(packed, tmp_path) -> None:
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
        with pytest.raises(FormatError, match="not offsets .*No such file"):
            ShardSource(root).read(0)
    finally:
        path.write_bytes(good)
    with pytest.raises(FormatError, match="expected letters"):
        reader.offsets("../S001")


def test_checkpoints_transfer_and_interpolation_keep_offsets(packed, tmp_path) -> None:
    root, arrays = packed
    source, head = ShardSource(root, "*"), load_head("procedural")
    frames = {(k.subject, k.expression): source.read(i).tracked for i, k in enumerate(source.keys)}
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
