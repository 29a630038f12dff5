"""Networks that users bring: loading, tiling, logits; and every way they can be wrong."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from express50.errors import ConfigError, StageError
from pipelines.matte import MatteConfig
from pipelines.matte.learned import (
    BGMV2,
    SALIENT,
    as_opacity,
    background_alpha,
    in_tiles,
    refined,
    salient_alpha,
    spans,
)
from pipelines.networks import load_network
from tests.pipelines.matte_scenes import make_scene
from tests.pipelines.stand_ins import (
    Bad,
    BadPair,
    Bright,
    Difference,
    onnx_bright,
    onnx_difference,
    torchscript,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def pair(rng: np.random.Generator, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A noisy frame and another plate (H, W, 3) uint8."""
    frame, plate = rng.integers(0, 256, (2, height, width, 3)).astype(np.uint8)
    return frame, plate


def expected_difference(frame: np.ndarray, plate: np.ndarray, blurred: bool) -> np.ndarray:
    """What the stand-ins compute, by other means; away from the border."""
    size = np.abs(frame.astype(np.float32) - plate).mean(-1) / 255
    return np.clip(8 * (cv2.blur(size, (3, 3)) if blurred else size), 0, 1)


def test_background_matting_as_torchscript_is_what_the_module_computes(tmp_path, rng) -> None:
    network = load_network(torchscript(Difference(), tmp_path / "net.pth"), BGMV2)
    frame, plate = pair(rng, 97, 70)
    frame = cv2.addWeighted(frame, 0.1, plate, 0.9, 0)
    alpha = background_alpha(network, frame, plate, 512)
    inner = np.s_[1:-1, 1:-1]
    assert alpha.shape == (97, 70) and alpha.dtype == np.float32
    assert alpha.std() > 0.02
    assert alpha[inner] == pytest.approx(expected_difference(frame, plate, True)[inner], abs=1e-5)
    pictures = [np.zeros((64, 64, 3), np.float32)] * 2
    batches = [p.transpose(2, 0, 1)[None] for p in pictures]
    assert network.run(batches)[2].min() == 1.0  # refines where it is needed, as documented


@pytest.mark.parametrize("order", [("src", "bgr"), ("bgr", "src")])
def test_background_matting_as_onnx_goes_by_names(tmp_path, rng, order) -> None:
    network = load_network(onnx_difference(tmp_path / "net.onnx", order), BGMV2)
    frame, plate = pair(rng, 64, 68)
    alpha = background_alpha(network, frame, plate, 512)
    assert alpha == pytest.approx(expected_difference(frame, plate, False), abs=1e-5)


def test_tiles_give_exactly_the_whole(tmp_path, rng, monkeypatch) -> None:
    network = load_network(torchscript(Difference(), tmp_path / "net.pt"), BGMV2)
    frame, plate = pair(rng, 333, 501)
    frame = cv2.addWeighted(frame, 0.1, plate, 0.9, 0)
    whole = background_alpha(network, frame, plate, 1024)
    monkeypatch.setattr("pipelines.matte.learned.OVERLAP", 64)
    tiled = background_alpha(network, frame, plate, 192)
    assert np.array_equal(whole, tiled) and whole.std() > 0.02


def test_tiles_that_differ_fade_and_hide_their_edges() -> None:
    def compute(rows: slice, columns: slice) -> np.ndarray:
        out = np.full((rows.stop - rows.start, columns.stop - columns.start), columns.start > 0)
        out = out.astype(np.float32)
        out[:, :8] += 100 * (columns.start > 0)  # an edge effect
        return out

    joined = in_tiles((64, 192), 128, 64, compute)
    assert [s.start for s in spans(192, 128, 64)] == [0, 64]
    assert (np.diff(joined[0]) >= 0).all() and np.diff(joined[0]).max() < 0.05
    assert joined[0, 0] == 0 and joined[0, -1] == 1


def test_tiles_cover_any_length_with_the_overlap() -> None:
    for length in (1, 63, 64, 511, 512, 513, 2000, 4096):
        cuts = spans(length, 512, 128)
        assert cuts[0].start == 0 and cuts[-1].stop == length
        assert all(a.stop - b.start == 128 for a, b in zip(cuts, cuts[1:], strict=False))
        assert all(s.start % 64 == 0 and s.stop - s.start <= 512 for s in cuts)


@pytest.mark.parametrize("half", [False, True])
def test_salient_networks_with_and_without_sigmoid_agree(tmp_path, half: bool) -> None:
    frame = np.zeros((64, 64, 3), np.uint8)
    frame[16:48, 16:48] = 255
    ends = [onnx_bright(tmp_path / f"{s}.onnx", 64, s, half) for s in (True, False)]
    alphas = [salient_alpha(load_network(path, SALIENT), frame) for path in ends]
    assert alphas[0] == pytest.approx(alphas[1], abs=2e-3)
    assert alphas[0] == pytest.approx((frame[..., 0] > 0).astype(np.float32), abs=1e-3)


def test_the_finest_of_several_scales_is_taken(tmp_path) -> None:
    network = load_network(torchscript(Bright(), tmp_path / "net.pt"), SALIENT)
    frame = np.zeros((40, 60, 3), np.uint8)
    frame[10:30, 20:40] = 255
    alpha = salient_alpha(network, frame)  # seen at 1024 x 1024, so larger than it is
    assert alpha.shape == (40, 60) and network.size is None
    assert np.abs(alpha - (frame[..., 0] > 0)).mean() < 0.02


def test_values_in_0_to_1_are_opacities_and_others_logits() -> None:
    assert as_opacity(np.array([0.0, 0.3, 1.0])) == pytest.approx([0, 0.3, 1])
    assert as_opacity(np.array([-900.0, 0.0, 900.0])) == pytest.approx([0, 0.5, 1], abs=1e-9)


def test_an_enlarged_alpha_follows_the_colours() -> None:
    scene = make_scene(1, "dark", size=384, strands=150)
    small = cv2.resize(scene.alpha, (128, 128), interpolation=cv2.INTER_AREA)
    large = cv2.resize(cv2.GaussianBlur(small, (0, 0), 0.8), (384, 384))
    better = refined(scene.frame, large, 3.0)
    sad = [np.abs(alpha - scene.alpha).sum() for alpha in (large, better)]
    assert sad[1] < 0.85 * sad[0]
    sure = cv2.dilate(((large > 0.01) & (large < 0.99)).astype(np.uint8), np.ones((9, 9))) == 0
    assert np.array_equal(better[sure], large[sure])


def test_refining_in_tiles_is_refining_the_whole(monkeypatch) -> None:
    scene = make_scene(2, "dark", size=320)
    large = cv2.GaussianBlur(scene.alpha, (0, 0), 2)
    whole = refined(scene.frame, large, 2.0)
    monkeypatch.setattr("pipelines.matte.learned.REFINE_TILE", 192)
    assert np.abs(refined(scene.frame, large, 2.0) - whole).mean() < 2e-3


def test_a_file_in_half_precision_runs_on_the_cpu_too(tmp_path, rng) -> None:
    frame, plate = pair(rng, 64, 64)
    paths = [torchscript(Difference(), tmp_path / "single.pt")]
    paths.append(torchscript(Difference().half(), tmp_path / "half.pt"))
    single, half = (background_alpha(load_network(p, BGMV2), frame, plate, 512) for p in paths)
    assert np.abs(single - half).max() < 2e-3


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("nan", r"gave NaN or infinity in 100.0% of its output"),
        ("shape", r"gave shape \(\), expected \(1, channels, height, width\)"),
        ("small", r"gave shape \(1, 512, 512\), expected \(1, 1024, 1024\)"),
        ("raise", r"failed on input \(1, 3, 1024, 1024\) \(.*out of luck\)"),
    ],
)
def test_a_wrong_answer_is_one_line(tmp_path, how: str, message: str) -> None:
    network = load_network(torchscript(Bad(how), tmp_path / "bad.pt"), SALIENT)
    with pytest.raises(
        StageError, match=f"matte.weights .*bad.pt: the network {message}"
    ) as caught:
        salient_alpha(network, np.zeros((8, 8, 3), np.uint8))
    assert "\n" not in str(caught.value)


def test_networks_that_answer_pairs_wrongly_are_refused(tmp_path) -> None:
    black = np.zeros((80, 80, 3), np.uint8)
    for how, message in (("nan", "NaN"), ("small", r"gave shape \(1, 40, 40\)")):
        network = load_network(torchscript(BadPair(how), tmp_path / f"{how}.pt"), BGMV2)
        with pytest.raises(StageError, match=message):
            background_alpha(network, black, black, 512)


def test_a_network_for_another_method_is_named(tmp_path) -> None:
    one = torchscript(Bright(), tmp_path / "one.pt")
    with pytest.raises(StageError, match=r"takes 1 pictures, expected 2 \(src, bgr\)"):
        load_network(one, BGMV2)
    two = onnx_difference(tmp_path / "two.onnx")
    with pytest.raises(StageError, match="takes 2 pictures, expected 1"):
        load_network(two, SALIENT)


@pytest.mark.parametrize("name", ["a.pt", "a.onnx"])
def test_missing_and_damaged_files_are_one_line(tmp_path, name: str) -> None:
    path = tmp_path / name
    with pytest.raises(ConfigError, match="no such file"):
        load_network(path, SALIENT)
    with pytest.raises(ConfigError, match="is a folder, not a file; expected TorchScript"):
        load_network(tmp_path, SALIENT)
    with pytest.raises(ConfigError, match="~nobody-here/a.pt: no such file"):
        load_network("~nobody-here/a.pt", SALIENT)
    torch.save(Bright().state_dict(), tmp_path / "state")
    state = (tmp_path / "state").read_bytes()  # what most downloads of weights are
    whole = torchscript(Bright(), tmp_path / "whole.pt").read_bytes()
    for content in (b"", b"not a network", bytes(4096), whole[: len(whole) // 2], state):
        path.write_bytes(content)
        with pytest.raises(StageError, match=r"matte.weights .*a\.(pt|onnx): ") as caught:
            load_network(path, SALIENT)
        said = str(caught.value)
        assert "\n" not in said and said.endswith("export it, or download it again")
        assert "miniz" not in said and "PytorchStreamReader" not in said


def test_a_pickle_inside_the_file_is_not_executed(tmp_path) -> None:
    good, mark = torchscript(Bright(), tmp_path / "good.pt"), tmp_path / "executed"
    attack = f"cposix\nsystem\n(S'touch {mark}'\ntR.".encode()

    def repacked(path: Path, pickle: bytes | None) -> Path:
        with zipfile.ZipFile(good) as source, zipfile.ZipFile(path, "w") as target:
            for entry in source.namelist():
                swap = pickle is not None and Path(entry).name == "data.pkl"
                target.writestr(entry, pickle if swap else source.read(entry))
        return path

    load_network(repacked(tmp_path / "same.pt", None), SALIENT)
    for start in (b"", b"\x80\x02"):
        with pytest.raises(StageError, match="not TorchScript"):
            load_network(repacked(tmp_path / f"evil{len(start)}.pt", start + attack), SALIENT)
    (tmp_path / "plain.pt").write_bytes(attack)
    torch.save({"weight": torch.ones(1)}, tmp_path / "state.pt")
    for name in ("plain.pt", "state.pt"):
        with pytest.raises(StageError, match="not TorchScript"):
            load_network(tmp_path / name, SALIENT)
    assert not mark.exists()


def test_onnx_without_onnxruntime_says_what_to_install(tmp_path, monkeypatch) -> None:
    path = onnx_bright(tmp_path / "net.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(StageError, match=r"pip install 'express50\[networks\]'"):
        load_network(path, SALIENT)


def test_a_network_with_a_random_part_repeats_itself(tmp_path) -> None:
    network = load_network(torchscript(Bad("random"), tmp_path / "net.pt"), SALIENT)
    frame = np.full((30, 30, 3), 90, np.uint8)
    before = torch.get_rng_state()
    first, second = (salient_alpha(network, frame) for _ in range(2))
    assert np.array_equal(first, second) and first.std() > 0
    assert torch.equal(before, torch.get_rng_state())


def test_a_file_that_changes_is_loaded_anew(tmp_path) -> None:
    path = onnx_bright(tmp_path / "net.onnx", 64)
    assert load_network(path, SALIENT) is load_network(path, SALIENT)
    assert load_network(onnx_bright(path, 32), SALIENT).size == (32, 32)


def test_settings_that_do_not_go_together_are_refused() -> None:
    for change in ({"method": "bgmv2"}, {"weights": "net.pt"}, {"tile": 100}, {"tile": 0}):
        with pytest.raises(ConfigError, match="matte"):
            MatteConfig(**change)
