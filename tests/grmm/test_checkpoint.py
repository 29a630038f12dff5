"""Checkpoints that are damaged, or whose parts do not fit each other."""

import os
import pickle
import zipfile

import numpy as np
import pytest
import torch

from express50.errors import FormatError
from grmm.checkpoint import collect_gallery, load_checkpoint, save_checkpoint
from grmm.data import HeadViews
from grmm.model import GRMM
from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture
def path(tmp_path, source):
    """A checkpoint after one step."""
    train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 1}))
    return tmp_path / "checkpoint.pt"


def test_checkpoint_is_read_with_weights_only_and_damage_is_named(tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(FormatError, match="checkpoint.pt"):
        load_checkpoint(path)
    torch.save({"format": "other/9"}, path)
    with pytest.raises(FormatError, match="other/9"):
        load_checkpoint(path)


def test_a_flipped_bit_in_the_weights_is_named(path):
    load_checkpoint(path)
    whole, name = path.read_bytes(), "colour.bias"
    weights = load_checkpoint(path).model.state_dict()[name].numpy().tobytes()
    place = whole.index(weights) + len(weights) // 2
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    with pytest.raises(FormatError, match=r"checkpoint.pt: its bytes changed .* copy it again"):
        load_checkpoint(path)


def test_shards_of_another_head_model_are_refused(path, source, monkeypatch):
    loaded = load_checkpoint(path)
    loaded.views(source)
    monkeypatch.setattr(source, "head", "procedural")
    with pytest.raises(FormatError, match="tracked with head model 'procedural', the checkpoint"):
        loaded.views(source)


class Command:
    """Pickles to a call of ``os.system``."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


@pytest.mark.parametrize("save", [torch.save, lambda c, path: path.write_bytes(pickle.dumps(c, 4))])
def test_a_checkpoint_that_runs_commands_is_refused_in_our_own_words(tmp_path, save):
    path, mark = tmp_path / "checkpoint.pt", tmp_path / "mark"
    save(Command(mark), path)
    with pytest.raises(FormatError, match="more than tensors") as caught:
        load_checkpoint(path)
    assert not mark.exists()
    assert "weights_only" not in str(caught.value)  # torch advises to switch it off


@pytest.mark.parametrize(
    ("key", "size", "named"),
    [
        ("n_g", 10**6, "colour.bias"),
        ("features", 10**6, "colour.bias"),
        ("shared_widths", [8] * 50_000, "5000[0-9] layers"),
        ("n_g", 16, "colour.bias"),
        ("n_g", 100, "model.n_g"),
        ("n_g", 0, "n_g = 0"),
        ("z_exp", -1, "checkpoint.pt"),
    ],
)
def test_a_configuration_that_the_weights_do_not_have_is_refused(path, key, size, named):
    content = torch.load(path, weights_only=True)
    content["config"]["model"][key] = size
    torch.save(content, path)
    with pytest.raises(FormatError, match=named):
        load_checkpoint(path)


@pytest.mark.parametrize("size", [(0, 9), (9, 2.5), (10**6, 10**6)])
def test_a_camera_whose_size_no_image_has_is_refused(path, size):
    content = torch.load(path, weights_only=True)
    content["cameras"]["cam01"] |= {"width": size[0], "height": size[1]}
    torch.save(content, path)
    with pytest.raises(FormatError, match="cam01"):
        load_checkpoint(path)


@pytest.mark.parametrize(("name", "size"), [("shape", 4), ("expression", 5)])
def test_a_frame_that_the_head_model_cannot_take_is_refused(path, name, size):
    content = torch.load(path, weights_only=True)
    content["parameters"][name] = torch.zeros(len(content["frames"]), size)
    torch.save(content, path)
    with pytest.raises(FormatError, match=f"S000/e0: {size} {name}"):
        load_checkpoint(path)


class Blind(EllipsoidSource):
    """Gives places, no picture."""

    def read(self, index):
        raise AssertionError("a picture was decoded")

    def place(self, index):
        return EllipsoidSource.read(self, index).place


def test_frames_are_collected_without_pictures_and_stored_as_few_arrays(tmp_path):
    sizes = []
    for people in (2, 9):
        views = HeadViews(Blind(size=16, subjects=people, cameras=2), ellipsoid_head())
        gallery = collect_gallery(views, range(len(views.keys)))
        names = [f"S{n:03d}" for n in range(people)]
        model = GRMM(tiny_config().model, views.head, names, ["e0", "e1"])
        path = tmp_path / f"{people}.pt"
        save_checkpoint(
            path, model=model, config=tiny_config(), head_spec="ellipsoid", gallery=gallery
        )
        sizes.append(len(zipfile.ZipFile(path).namelist()))
        again = load_checkpoint(path).gallery
        assert again.frames.keys() == gallery.frames.keys() and len(again.frames) == 2 * people
        for frame, tracked in again.frames.items():
            for name, value in vars(gallery.frames[frame]).items():
                np.testing.assert_array_equal(getattr(tracked, name), value)
    assert sizes[1] - sizes[0] == 7  # the offsets of seven more people


def test_a_setting_that_this_version_does_not_have_is_refused(path):
    content = torch.load(path, weights_only=True)
    content["config"]["model"]["precision"] = "float32"
    torch.save(content, path)
    with pytest.raises(FormatError, match=r"precision.*use the version"):
        load_checkpoint(path)
