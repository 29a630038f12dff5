"""Light, masks and contact sheets."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from express50.geometry import pixels


def test_srgb_curves_are_inverse():
    x = np.linspace(0, 1, 257)
    np.testing.assert_allclose(pixels.linear_to_srgb(pixels.srgb_to_linear(x)), x, atol=1e-7)


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
