"""Image files: types kept, damage named, depth quantised as stated."""

import re
import struct
import zlib

import cv2
import imagecodecs
import numpy as np
import pytest
from PIL import Image

from express50.errors import CaptureError, DiskFullError, FormatError
from express50.files import images
from express50.files.containers import decode_picture
from tests.synth import write_in_adobe_rgb

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("a.png", np.uint8), ("a.png", np.uint16), ("a.tif", np.uint16), ("a.exr", np.float32)],
)
@pytest.mark.parametrize("shape", [(7, 9), (7, 9, 3), (7, 9, 4), (1, 1, 3)])
def test_lossless_round_trip_keeps_type_and_values(tmp_path, name, dtype, shape):
    top = 1.0 if dtype == np.float32 else np.iinfo(dtype).max
    image = (RNG.random(shape) * top).astype(dtype)
    images.write_image(tmp_path / name, image)
    back = images.read_image(tmp_path / name)
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, image)


def test_same_image_gives_same_bytes(tmp_path):
    image = (RNG.random((9, 9, 3)) * 255).astype(np.uint8)
    for name in ("a.png", "a.jpg", "a.exr"):
        images.write_image(tmp_path / name, image)
        first = (tmp_path / name).read_bytes()
        images.write_image(tmp_path / name, image)
        assert (tmp_path / name).read_bytes() == first


def test_an_unwritable_path_says_why(tmp_path):
    with pytest.raises(FormatError, match="absent/a.jpg: cannot be written .No such file"):
        images.write_image(tmp_path / "absent" / "a.jpg", np.zeros((2, 2, 3), np.uint8))


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.exr"])
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, name):
    """OpenImageIO ended the process when a JPEG met a full disk, and cut an EXR short silently."""
    (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(DiskFullError) as caught:
        images.write_image(tmp_path / name, np.zeros((2, 2, 3), np.uint8))
    words = r"the disk is full \(No space left on device; [\d.]+ .?B are free now\); free some"
    assert re.match(rf"{tmp_path / name}: {words}", str(caught.value))


def test_jpeg_refuses_what_it_cannot_hold(tmp_path):
    for image in (np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 4), np.uint8)):
        with pytest.raises(FormatError, match="expected 8 bits, grey or RGB; use .png or .tif"):
            images.write_image(tmp_path / "a.jpg", image)


@pytest.mark.parametrize("kept", [4, 26, 60, -20])
def test_a_cut_png_is_one_error_and_the_decoder_is_silent(tmp_path, capfd, kept):
    whole = images.encode_png((RNG.random((9, 9, 3)) * 255).astype(np.uint8))
    (tmp_path / "a.png").write_bytes(whole[:kept])
    with pytest.raises(FormatError):
        images.read_image(tmp_path / "a.png")
    assert capfd.readouterr().err == ""


def test_a_picture_below_our_limit_is_read_without_a_warning():
    small = images.encode_png(np.zeros((1, 1), np.uint8))
    head = b"IHDR" + struct.pack(">II", 9600, 9600) + small[24:29]
    png = small[:12] + head + struct.pack(">I", zlib.crc32(head)) + small[33:]
    with pytest.raises(CaptureError, match="damaged image"):
        decode_picture(png, "big")


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (9, 4, 3), (6, 3, 4)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_own_png_is_decoded_as_libpng_does(shape, dtype):
    image = RNG.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    data = images.encode_png(image)
    found = images._own_png(data, shape)
    assert found.dtype == dtype and found.flags.writeable
    np.testing.assert_array_equal(found, image)
    np.testing.assert_array_equal(found, imagecodecs.png_decode(data))


def test_png_that_is_damaged_or_not_our_own_is_left_to_libpng(tmp_path):
    image = (RNG.random((9, 8, 3)) * 255).astype(np.uint8)
    data = images.encode_png(image)
    for place in range(24, len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 4
        assert images._own_png(bytes(damaged), image.shape) is None
    for length in range(26, len(data)):
        assert images._own_png(data[:length], image.shape) is None
    other = imagecodecs.png_encode(image, level=5)
    assert images._own_png(other, image.shape) is None
    (tmp_path / "a.png").write_bytes(other)
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.png"), image)


def test_jpeg_keeps_colour_order_and_png_alpha():
    image = np.zeros((16, 16, 4), np.uint8)
    image[..., 0], image[..., 3] = 200, 7
    back = cv2.imdecode(np.frombuffer(images.encode_png(image), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(back, image[..., [2, 1, 0, 3]])
    back = images.decode_image(images.encode_jpeg(image[..., :3]))
    assert abs(int(back[8, 8, 0]) - 200) < 4
    assert back[8, 8, 2] < 6


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 1000.0])
def test_a_depth_that_cannot_be_stored_is_refused(value):
    depth = np.full((2, 2), value)
    with pytest.raises(ValueError, match="in metres"):
        images.depth_to_uint16(depth, np.ones((2, 2), bool))


def test_damaged_and_missing_files_are_named(tmp_path):
    with pytest.raises(FormatError, match="missing.png"):
        images.read_image(tmp_path / "missing.png")
    path = tmp_path / "cut.png"
    images.write_image(path, (RNG.random((64, 64, 3)) * 255).astype(np.uint8))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(FormatError, match="cut.png"):
        images.read_image(path)
    with pytest.raises(FormatError, match="12 bytes"):
        images.decode_image(b"not an image")


@pytest.mark.parametrize(
    ("ending", "mode", "word"),
    [("tif", "CMYK", "CMYK"), ("tif", "LAB", "CIELAB"), ("jpg", "CMYK", "CMYK")],
)
def test_colours_that_cannot_be_converted_truly_are_refused(tmp_path, ending, mode, word):
    path = tmp_path / f"inks.{ending}"
    Image.new(mode, (8, 8)).save(path)
    for read in (images.read_image, images.read_exif):
        with pytest.raises(FormatError, match=f"holds {word}, expected grey or RGB; export it"):
            read(path)
    Image.new("YCbCr", (8, 8), (90, 128, 128)).save(tmp_path / "video.tif")
    assert np.ptp(images.read_image(tmp_path / "video.tif").astype(int) - 90) <= 1


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
def test_colours_of_another_profile_become_those_of_srgb(tmp_path, ending):
    levels = np.linspace(60, 190, 8).astype(np.uint8)  # no colour lies outside of either profile
    image = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(64, 8, 3)
    image = np.kron(image, np.ones((8, 8, 1), np.uint8))
    path = tmp_path / f"a.{ending}"
    write_in_adobe_rgb(path, image)
    profile = images.foreign_profile(path)
    stored = images.read_image(path)
    assert profile.name == "Adobe RGB (compatible)"
    assert np.abs(stored.astype(int) - image).max() > 15
    assert np.abs(profile.to_srgb(stored).astype(int) - image).mean() < 1.5
    for data in (imagecodecs.cms_profile("srgb"), imagecodecs.cms_profile("gray"), b"damaged"):
        Image.fromarray(image).save(path, icc_profile=data)
        assert images.foreign_profile(path) is None
