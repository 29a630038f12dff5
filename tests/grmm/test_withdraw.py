"""Withdrawal from a checkpoint: the row is nowhere in the file, others are untouched."""

import pytest
import torch

from express50.errors import ConfigError, FormatError
from grmm.checkpoint import load_checkpoint, read_content, redact
from grmm.edit import trained_head
from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture
def trained(tmp_path):
    source, config = EllipsoidSource(size=32), tiny_config(train={"iterations": 1})
    train(source, ellipsoid_head(), tmp_path, config)
    return tmp_path / "checkpoint.pt", source, config


def test_codes_frames_and_the_optimizers_memory_go(trained):
    path, source, config = trained
    before = load_checkpoint(path)
    first, *others = before.model.subjects
    code = before.model.z_id[0].detach().numpy().tobytes()
    assert others and code in path.read_bytes() and first.encode() in path.read_bytes()
    assert redact(path, first)
    assert code not in path.read_bytes() and first.encode() not in path.read_bytes()
    after = load_checkpoint(path)
    assert list(after.model.subjects) == others
    assert torch.equal(after.model.z_id, before.model.z_id[1:])
    assert {subject for subject, _ in after.gallery.frames} == set(others)
    for name, value in after.model.state_dict().items():
        assert name == "z_id" or torch.equal(value, before.model.state_dict()[name]), name
    with pytest.raises(ConfigError, match="no state to resume from"):
        train(source, ellipsoid_head(), path.parent, config, resume=True)
    assert not redact(path, first)


def test_frames_used_by_another_persons_fit_are_removed(trained):
    path = trained[0]
    content = read_content(path)
    lender = content["subjects"][0]
    content["subjects"] = content["subjects"][1:]
    content["model"]["z_id"] = content["model"]["z_id"][1:].clone()
    torch.save(content, path)
    assert redact(path, lender)
    left = read_content(path)
    assert left["subjects"] == content["subjects"]
    assert lender not in {frame["subject"] for frame in left["frames"]} | set(left["offsets"])


def test_an_expression_that_nobody_else_shows_goes_with_its_code(trained):
    path = trained[0]
    content = read_content(path)
    (first, *_), (own, *rest) = content["subjects"], content["expressions"]
    places = [
        n
        for n, f in enumerate(content["frames"])
        if f["expression_id"] != own or f["subject"] == first
    ]
    content["frames"] = [content["frames"][n] for n in places]
    content["parameters"] = {k: v[places] for k, v in content["parameters"].items()}
    code = content["model"]["z_exp"][0].numpy().tobytes()
    torch.save(content, path)
    assert redact(path, first)
    assert code not in path.read_bytes()
    left = load_checkpoint(path)
    assert list(left.model.expressions) == rest
    assert torch.equal(left.model.z_exp, content["model"]["z_exp"][1:])
    for subject in left.model.subjects:
        for expression in left.model.expressions:
            trained_head(left, subject, expression)


def test_a_model_of_nobody_else_is_deleted_and_other_files_are_refused(trained, tmp_path):
    path = trained[0]
    for subject in read_content(path)["subjects"]:
        assert redact(path, subject)
    assert not path.exists()
    (tmp_path / "x.pt").write_bytes(b"no model")
    with pytest.raises(FormatError, match="not a checkpoint"):
        redact(tmp_path / "x.pt", "S001")
