"""Checkpoints that are damaged, or whose parts do not fit each other."""

import pytest
import torch

from express50.errors import FormatError
from grmm.checkpoint import load_checkpoint
from grmm.train import train
from tests.grmm.synthetic import ellipsoid_head, tiny_config


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
    content["frames"][1]["parameters"][name] = torch.zeros(size)
    torch.save(content, path)
    with pytest.raises(FormatError, match=f"S000/e1: {size} {name}"):
        load_checkpoint(path)


def test_settings_that_are_gone_are_left_out_unless_they_changed_the_result(path):
    content = torch.load(path, weights_only=True)
    old = {"model": {"precision": "float32"}, "train": {"ema": 0.0, "tensorboard": True}}
    for table, values in old.items():
        content["config"][table] |= values
    torch.save(content, path)
    assert load_checkpoint(path).config == tiny_config(train={"iterations": 1})
    content["config"]["model"]["precision"] = "bfloat16"
    torch.save(content, path)
    with pytest.raises(FormatError, match=r"model\.precision"):
        load_checkpoint(path)
