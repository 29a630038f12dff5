"""ARKit's blend shapes on the built-in head: names, directions, and the GLB that holds them."""

import json
import struct

import numpy as np
import pytest
import torch

from express50.errors import ConfigError
from express50.head.load import load_head
from grmm.checkpoint import Checkpoint, Gallery
from grmm.data import Tracked
from grmm.edit import HeadCodes
from grmm.export import arkit_controls, arkit_targets, mesh_glb
from grmm.model import GRMM
from tests.grmm.synthetic import tiny_config


@pytest.fixture(scope="module")
def built_in():
    head, config = load_head("procedural"), tiny_config()
    model = GRMM(config.model, head, ("S",), ("neutral",))
    gallery = Gallery(frames={}, cameras={})
    loaded = Checkpoint(config=config, head_spec="procedural", head=head, model=model,
                    gallery=gallery, optimizer={}, loop={})  # fmt: skip
    zeros = np.zeros
    tracked = Tracked(shape=zeros(3), expression=zeros(71), neck=zeros(3), jaw=zeros(3),
                      eyes=zeros(6), R=np.eye(3), t=zeros(3))  # fmt: skip
    codes = HeadCodes(z_id=model.z_id[0], z_exp=model.z_exp[0], tracked=tracked)
    return loaded, arkit_targets(loaded, codes)


def test_shapes_move_what_their_names_say(built_in):
    loaded, targets = built_in
    assert len(targets) == 52 and all(np.abs(t).max() > 5e-4 for t in targets.values())
    iris = {side: loaded.head.regions[f"{side}_iris"].numpy() for side in ("left", "right")}
    lips, teeth = (loaded.head.regions[n].numpy() for n in ("lips", "lower_teeth"))
    move = lambda name, where: targets[name][where].mean(0)  # noqa: E731
    assert move("jawOpen", teeth)[1] < -0.003
    assert move("eyeLookUpLeft", iris["left"])[1] > 1e-3 > move("eyeLookUpLeft", iris["right"])[1]
    assert move("eyeLookDownRight", iris["right"])[1] < -1e-3
    assert (
        move("eyeLookInLeft", iris["left"])[0]
        < -1e-3
        < 1e-3
        < move("eyeLookOutLeft", iris["left"])[0]
    )
    assert move("eyeLookInRight", iris["right"])[0] > 1e-3
    left = lips & (loaded.head.template[:, 0].numpy() > 0.015)
    near, far = (np.abs(move(f"mouthSmile{side}", left)).max() for side in ("Left", "Right"))
    assert near > 2 * far


def test_the_file_holds_them(built_in):
    loaded, targets = built_in
    vertices = loaded.head.template.numpy()
    content = mesh_glb(loaded.head, vertices, np.zeros((4, 4, 3), np.uint8), targets)
    size = struct.unpack("<I", content[12:16])[0]
    document, body = json.loads(content[20 : 20 + size]), content[28 + size :]
    (mesh,) = document["meshes"]
    assert mesh["extras"]["targetNames"] == list(targets) and len(mesh["weights"]) == 52
    (primitive,) = mesh["primitives"]

    def array(number):
        accessor = document["accessors"][number]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(body, "<f4", 3 * accessor["count"], start).reshape(-1, 3)

    rest = array(primitive["attributes"]["POSITION"])
    opened = array(primitive["targets"][list(targets).index("jawOpen")]["POSITION"])
    nearest = torch.cdist(torch.tensor(rest), torch.tensor(vertices)).argmin(1).numpy()
    unique = np.abs(vertices[nearest] - rest).max(1) < 1e-7
    same = np.abs(opened - targets["jawOpen"][nearest]).max(1) < 1e-6
    assert unique.all() and same.mean() > 0.98  # a few vertices of the mouth share a place


def test_heads_without_the_names_are_refused():
    with pytest.raises(ConfigError, match="named expressions"):
        arkit_controls(("expression_0", "expression_1"))
