"""Pictures of head models."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from express50.__main__ import main
from express50.errors import HeadModelError
from express50.files.images import read_image
from express50.head.load import load_builtin
from express50.head.preview import POSES, expression_vector, pose_sheet, render_preview


def test_a_head_fills_the_middle_of_the_picture():
    head = load_builtin()
    image = render_preview(head, head.template, size=64)
    background = image[0, 0].astype(int)
    differs = np.abs(image.astype(int) - background).max(-1) > 20
    assert image.shape == (64, 64, 3) and image.dtype == np.uint8
    assert differs[20:44, 26:38].mean() > 0.9 and not differs[:, :4].any()


def test_a_name_without_a_side_sets_both():
    head = load_builtin()
    vector = expression_vector(head, {"eyeBlink": 0.5})[0]
    named = {head.expression_names[i] for i in torch.nonzero(vector)[:, 0]}
    assert named == {"eyeBlink_L", "eyeBlink_R"}
    with pytest.raises(HeadModelError, match="no expression 'eyeBlonk'"):
        expression_vector(head, {"eyeBlonk": 1.0})


def test_the_sheet_has_a_row_per_pose():
    sheet = pose_sheet(load_builtin(), yaws=(0.0,), size=24)
    assert sheet.shape == (24 * len(POSES), 24, 3)


def test_the_command_writes_the_sheet(tmp_path, capsys):
    out = tmp_path / "sheets" / "head.png"
    assert main(["head", "preview", str(out), "--yaws", "0,40", "--size", "16"]) == 0
    assert read_image(out).shape == (16 * len(POSES), 32, 3)
    assert "procedural" in capsys.readouterr().out
    for wrong in (["--yaws", "left"], ["--yaws", "nan"], ["--size", "0"]):
        assert main(["head", "preview", str(out), *wrong]) == 2
