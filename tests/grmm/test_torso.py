import json
from dataclasses import replace

import numpy as np
import torch

from express50.contract.segmentation_labels import TORSO
from express50.files.images import encode_png, write_image
from express50.head import load
from express50.shards.writer import sample_key
from grmm.cli import main
from grmm.config import DataConfig
from grmm.data import HeadViews
from grmm.head_crop import behind_torso
from grmm.model import PinholeView, Rendering
from grmm.render import to_uint8
from grmm.shard_source import ShardSource
from tests.grmm import packed
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head


class Dressed(EllipsoidSource):
    """The toy head with a bright shirt in front of its lower end."""

    def read(self, index):
        sample = super().read(index)
        rows = slice(int(0.8 * self.size), None)
        sample.image[rows], sample.alpha[rows] = 255, 255
        sample.depth[rows] = 0.55
        return sample


class Labelled(Dressed):
    """Dressed, with labels of the shirt."""

    def read(self, index):
        sample = super().read(index)
        parts = np.ones(sample.alpha.shape, np.uint8)
        parts[int(0.8 * self.size) :] = TORSO
        return replace(sample, parts=parts)


class Behind(Labelled):
    """Labelled, with the left half of the shirt far behind the head."""

    def read(self, index):
        sample = super().read(index)
        sample.depth[int(0.8 * self.size) :, : self.size // 2] = 2.0
        return sample


class Bare(Labelled):
    """Labelled, with a matte that is said to leave the torso out."""

    def read(self, index):
        return replace(super().read(index), bare=True)


def test_a_labelled_torso_is_background():
    item = HeadViews(Labelled(size=64), ellipsoid_head()).item(0)
    shirt = slice(int(0.8 * 64), None)
    assert float(item.target[:, shirt].max()) == 0
    assert not item.mask[shirt].any() and not item.depth_valid[shirt].any()
    assert item.mask[20:40].any() and item.depth_valid[20:40].any()


def test_a_matte_without_torso_or_labels_is_taken_as_it_is():
    for source in (Bare, Dressed):
        item = HeadViews(source(size=64), ellipsoid_head()).item(0)
        assert float(item.target[:, 58:, 20:44].min()) == 1 and item.mask[58:].all()


def test_nothing_is_drawn_behind_the_torso_and_all_in_front_of_it():
    hiding = DataConfig(hide_behind_torso=True, background=0.25)
    item = HeadViews(Behind(size=64), ellipsoid_head(), hiding).item(0)
    picture, depth = torch.full((3, 64, 64), 0.5), torch.full((64, 64), 0.6)
    drawn = Rendering(image=picture, rgb=picture, depth=depth, alpha=depth, gaussians=None)
    shown = item.hide_behind_torso(drawn)
    assert not item.depth_valid[52:].any()
    for image in (shown.image, shown.rgb):
        assert (image[:, 52:, 32:] == 0.25).all()
        assert (image[:, 52:, :32] == 0.5).all() and (image[:, :50] == 0.5).all()
    plain = HeadViews(Behind(size=64), ellipsoid_head()).item(0)
    assert torch.equal(plain.hide_behind_torso(drawn).image, picture)


def necked_head():
    """The ellipsoid: its lower third is the neck."""
    head = ellipsoid_head(24, 32)
    return replace(head, regions=head.regions | {"neck": head.template[:, 1] < -0.03})


def test_a_torso_in_front_of_the_neck_hides_it_and_nothing_beside_it():
    head = necked_head()
    K = torch.tensor([[140.0, 0, 32], [0, 140, 32], [0, 0, 1]], dtype=torch.float64)
    camera = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    camera[2, 3] = 0.6
    view = PinholeView(K=K, cam_from_head=camera, width=64, height=64)
    torso = np.zeros((64, 64), bool)
    torso[46:] = True
    hidden = behind_torso(head, head.template, view, torso)
    assert hidden[48:54, 30:34].all()
    assert not hidden[:, :12].any() and not hidden[:46].any() and not hidden[62:].any()
    bare = ellipsoid_head()
    assert not behind_torso(bare, bare.template, view, torso).any()
    assert not behind_torso(head, head.template, view, ~torso & torso).any()


def test_a_hidden_neck_is_neither_trained_on_nor_scored():
    plain = HeadViews(Labelled(size=64), necked_head()).item(0)
    item = HeadViews(Labelled(size=64), necked_head(), DataConfig(skip_hidden_neck=True)).item(0)
    shirt = torch.from_numpy(Labelled(size=64).read(0).parts == TORSO)
    assert not plain.hidden.any() and 0 < item.hidden.sum() < shirt.sum()
    assert not (item.hidden & ~shirt).any() and not (item.hidden & item.mask).any()
    assert torch.equal(item.target, plain.target)
    image = torch.rand(3, 64, 64)
    shown = item.comparable(image)
    assert torch.equal(shown[:, item.hidden], item.target[:, item.hidden])
    assert torch.equal(shown[:, ~item.hidden], image[:, ~item.hidden])


def test_other_methods_are_scored_on_the_same_pixels(tmp_path, monkeypatch):
    monkeypatch.setattr(load, "load_head", lambda spec: necked_head())
    without_parts = packed.packed

    def with_parts(source, index):
        sample, parts = without_parts(source, index), source.read(index).parts
        meta = json.loads(sample.members["meta.json"]) | {"parts": True}
        members = {"parts.png": encode_png(parts), "meta.json": json.dumps(meta).encode()}
        return replace(sample, members=dict(sample.members) | members)

    monkeypatch.setattr(packed, "packed", with_parts)
    root = packed.write_shards(tmp_path / "shards", Labelled(size=64))
    views = HeadViews(ShardSource(root), necked_head(), DataConfig(skip_hidden_neck=True))
    for index, key in enumerate(views.keys):
        item = views.item(index)
        assert item.hidden.any()
        wrong = torch.where(item.hidden, 1 - item.target, item.target)
        (tmp_path / "made").mkdir(exist_ok=True)
        write_image(tmp_path / "made" / f"{sample_key(**vars(key))}.png", to_uint8(wrong))
    assert main(["score", str(tmp_path / "made"), str(root), str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert found["psnr_db"] > 50 and found["ssim"] > 0.999
