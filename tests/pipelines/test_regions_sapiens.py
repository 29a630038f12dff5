"""Parts of the body by the user's segmentation network: classes, sizes, wrong answers."""

from __future__ import annotations

import numpy as np
import pytest

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.errors import StageError
from pipelines.networks import LABEL_OF_CLASS, SAPIENS, load_network, segment
from pipelines.regions.geometry import head_alpha
from tests.pipelines.stand_ins import Bright, Thirds, torchscript, traced_thirds


def test_parts_are_named_and_the_torso_goes(tmp_path) -> None:
    network = load_network(torchscript(Thirds(), tmp_path / "parts.pt"), SAPIENS)
    labels = segment(network, np.zeros((200, 100, 3), np.uint8))
    middle = [LABELS[label] for label in labels[[20, 100, 180], 50]]
    assert middle == ["hair", "skin", "torso"]
    assert label_mask(labels, "background")[:, [2, 97]].all()
    head = head_alpha(np.ones((200, 100), np.float32), labels)
    assert head[:135, 50].min() == 1 and head[146:, 50].max() == 0
    # What the network calls background goes with the nearer part: strands beside the hair stay.
    assert head[20, 2] == 1 and head[190, 2] == 0


def test_a_traced_network_gives_parts_at_the_frames_own_size(tmp_path) -> None:
    network = load_network(traced_thirds(tmp_path / "parts.pt2"), SAPIENS)
    frame = np.zeros((101, 77, 3), np.uint8)
    frame[:50] = 255
    labels = segment(network, frame)
    assert label_mask(labels, "hair")[:48].all() and label_mask(labels, "torso")[53:].all()


def test_the_class_numbers_are_sapiens_own() -> None:
    known = {0: "background", 1: "apparel", 2: "skin", 3: "hair", 4: "torso", 5: "hand"}
    known |= {
        14: "hand",
        21: "torso",
        22: "torso",
        23: "lips",
        24: "lips",
        25: "teeth",
        26: "teeth",
        27: "tongue",
    }
    assert {k: LABELS[LABEL_OF_CLASS[k]] for k in known} == known


def test_no_head_is_empty_and_no_body_keeps_all() -> None:
    alpha = np.full((9, 9), 0.5, np.float32)
    for part, expected in (("torso", 0.0), ("background", 0.0), ("hair", 0.5)):
        labels = np.full((9, 9), LABELS.index(part), np.uint8)
        assert (head_alpha(alpha, labels) == expected).all()


def test_an_answer_of_other_classes_is_one_line(tmp_path) -> None:
    network = load_network(torchscript(Bright(), tmp_path / "one.pt"), SAPIENS)
    with pytest.raises(StageError, match=r"regions.segmentation .*expected \(28, height, width\)"):
        segment(network, np.zeros((80, 80, 3), np.uint8))


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (3, 2), (65, 1)])
def test_the_smallest_pictures(tmp_path, shape: tuple[int, int]) -> None:
    frame = np.full((*shape, 3), 255, np.uint8)
    labels = segment(load_network(torchscript(Thirds(), tmp_path / "c.pt"), SAPIENS), frame)
    assert labels.shape == shape
    assert np.isfinite(head_alpha(np.ones(shape, np.float32), labels)).all()
