"""Light, masks and contact sheets."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from express50.geometry import pixels


def test_srgb_curves_are_inverse():
    x = np.linspace(0, 1, 257)
    np.testing.assert_allclose(pixels.linear_to_srgb(pixels.srgb_to_linear(x)), x, atol=1e-7)


def hlg_of(nits):
    """Return HLG values of light (..., 3) in cd/m2, BT.2020 (BT.2100-2, table 5, inverted)."""
    shown = nits / 1000
    luma = np.maximum(shown @ [0.2627, 0.6780, 0.0593], 1e-9)
    scene = shown * luma[..., None] ** (1 / 1.2 - 1)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(
        scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c
    )


def pq_of(nits):
    """Return PQ values of light (..., 3) in cd/m2 (BT.2100-2, table 4, inverted)."""
    power = (nits / 10_000) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


@pytest.mark.parametrize(("curve", "encode"), [("HLG", hlg_of), ("PQ", pq_of)])
def test_pictures_of_high_dynamic_range_become_srgb(curve, encode):
    """White is 203 cd/m2; what is brighter stays below the brightest level, in order."""
    rng = np.random.default_rng(0)
    image = rng.integers(20, 200, (64, 64, 3), dtype=np.uint8)
    wide = pixels.LIGHT_OF_LEVEL[image] @ np.linalg.inv(pixels.NARROWER).T
    stored = np.rint(255 * encode(203 * np.clip(wide, 0, None))).astype(np.uint8)
    off = np.abs(pixels.hdr_to_srgb(stored, curve) - image.astype(int))
    assert off.mean() < 1.5 and np.percentile(off, 99) <= 6  # of 8 stored bits
    bright = np.rint(255 * encode(np.array([0, 10, 203, 400, 1000])[:, None] * np.ones(3)))
    grey = pixels.hdr_to_srgb(bright.astype(np.uint8)[None], curve)[0, :, 1].tolist()
    assert grey == sorted(grey) and grey[0] == 0 and 240 < grey[2] < 250 and grey[3] > grey[2]


def test_contact_sheet_pads_short_rows():
    row = [np.zeros((10, 20, 3), np.uint8)] * 3
    sheet = pixels.contact_sheet([row, row[:1]], labels=["a", "b"], tile=(40, 50))
    assert sheet.shape == (80, 150, 3)


def test_a_tile_sheet_writes_each_name_above_its_own_tile():
    tiles = {name: np.zeros((60, 60, 3), np.uint8) for name in ("a", "b", "c")}
    sheet = pixels.tile_sheet(tiles, 2, 60)
    assert sheet.shape == (120, 120, 3)
    for row, column in ((0, 0), (0, 60), (60, 0)):
        assert sheet[row : row + 20, column : column + 60].max() > 200
    assert sheet[60:, 60:].max() == 24


def test_contact_sheet_writes_captions_above_its_columns():
    row = [np.zeros((10, 20, 3), np.uint8)] * 2
    sheet = pixels.contact_sheet([row], tile=(40, 50), captions=["", "depth"])
    assert sheet.shape == (60, 100, 3)
    assert sheet[:20, :50].max() == 24 and sheet[:20, 50:].max() > 200


def test_distances_to_an_edge_are_the_same_wherever_a_mask_lies():
    """OpenCV's own differ in the last bit with the addresses of its arrays."""
    mask = np.hypot(*(np.mgrid[:97, :83] - 45.0)) < 31.0
    expected = distance_transform_edt(mask).astype(np.float32)
    for offset in range(0, 64, 8):
        room = np.zeros(mask.size + 64, bool)
        placed = room[offset : offset + mask.size].reshape(mask.shape)
        placed[:] = mask
        assert pixels.edge_distance(placed).tobytes() == expected.tobytes()


def test_a_box_holds_the_marked_pixels_and_a_margin_within_the_image():
    mask = np.zeros((6, 9), bool)
    mask[1:3, 6] = True
    assert pixels.box_about(mask) == np.s_[1:3, 6:7]
    assert pixels.box_about(mask, 2) == np.s_[0:5, 4:9]
    assert mask[pixels.box_about(mask, 20)].shape == mask.shape
    assert mask[pixels.box_about(~(mask | True))].size == 0
