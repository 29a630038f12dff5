"""Networks on the smallest and the largest pictures, and figures at their limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.matte.learned import BGMV2, SALIENT, background_alpha, salient_alpha
from pipelines.matte.stage import border_contact, matte_warnings
from pipelines.networks import load_network
from tests.pipelines.stand_ins import Difference, onnx_bright, torchscript


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (3, 2), (65, 1)])
def test_the_smallest_pictures(tmp_path, shape: tuple[int, int]) -> None:
    frame, plate = np.full((*shape, 3), 255, np.uint8), np.zeros((*shape, 3), np.uint8)
    pair = load_network(torchscript(Difference(), tmp_path / "a.pt"), BGMV2)
    assert background_alpha(pair, frame, plate, 512).shape == shape
    assert background_alpha(pair, frame, plate, 512).min() > 0.5
    salient = load_network(onnx_bright(tmp_path / "b.onnx"), SALIENT)
    assert salient_alpha(salient, frame) == pytest.approx(np.ones(shape), abs=1e-3)


def test_an_odd_4k_frame_goes_through_in_tiles(tmp_path) -> None:
    rng = np.random.default_rng(0)
    plate = rng.integers(0, 200, (2161, 3839, 3)).astype(np.uint8)
    frame = plate.copy()
    frame[500:1700, 1500:2400] += 50
    network = load_network(torchscript(Difference(), tmp_path / "net.pt"), BGMV2)
    seen = []

    def run(batches):
        seen.append(batches[0].shape[2:])
        return network.run(batches)

    alpha = background_alpha(replace(network, run=run), frame, plate, 2048)
    assert len(seen) == 4 and max(max(side) for side in seen) <= 2048
    inside = np.zeros(alpha.shape, bool)
    inside[500:1700, 1500:2400] = True
    assert alpha[501:1699, 1501:2399].min() == 1 and alpha.shape == (2161, 3839)
    assert alpha[~inside].sum() < 2 * (1200 + 900) + 4


def test_an_odd_4k_frame_is_seen_small_and_refined_in_tiles(tmp_path) -> None:
    frame = np.zeros((2161, 3839, 3), np.uint8)
    y, x = np.mgrid[:2161, :3839]
    disc = (x - 1900) ** 2 + (y - 1100) ** 2 < 120**2
    frame[disc] = 255
    network = load_network(onnx_bright(tmp_path / "net.onnx", 1024), SALIENT)
    alpha = salient_alpha(network, frame)
    assert alpha.shape == disc.shape and np.isfinite(alpha).all()
    assert np.abs(alpha - disc).sum() < 0.004 * disc.sum()


def test_warnings_of_empty_and_cut_off_mattes() -> None:
    alpha = np.zeros((40, 60), np.uint8)
    alpha[10:, 20:40] = 255  # at the bottom the body leaves the image
    full = np.full((4, 6), 255, np.uint8)
    assert border_contact(full) == dict.fromkeys(("top", "right", "bottom", "left"), 1.0)
    alphas = {"a": alpha, "b": np.zeros((40, 60), np.uint8), "c": full}
    notes = matte_warnings(alphas, dict.fromkeys(alphas, "bottom"))
    assert [note.what for note in notes] == ["b", "c"]
