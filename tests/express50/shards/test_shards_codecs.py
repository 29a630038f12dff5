"""Pictures in shards: every profile gives back what it promises; hostile bytes give one error."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.errors import FormatError
from express50.shards.codecs import (
    ALPHA,
    DEPTH,
    PARTS,
    PROFILES,
    RGB,
    crc32,
    decode_picture,
    encode_pictures,
)


def pictures(width: int = 40, height: int = 28, seed: int = 0):
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0, 255, width, dtype=np.uint8)
    rgb = np.broadcast_to(ramp[None, :, None], (height, width, 3)).copy()
    alpha = rng.integers(0, 256, (height, width), np.uint8)
    depth = np.where(alpha > 99, rng.integers(1, 65536, (height, width)), 0).astype(np.uint16)
    return rgb, alpha, depth, (alpha // 16).astype(np.uint8)


def decode(members: dict[str, bytes], names: tuple[str, ...], width: int, height: int):
    (name,) = set(names) & set(members)
    return decode_picture(name, members[name], width, height, name)


@pytest.mark.parametrize("profile", PROFILES)
@given(width=st.integers(1, 70), height=st.integers(1, 70), seed=st.integers(0, 9))
@settings(max_examples=15, deadline=None)
def test_all_but_colours_come_back_to_the_bit(profile, width, height, seed) -> None:
    rgb, alpha, depth, parts = pictures(width, height, seed)
    members = encode_pictures(rgb, alpha, depth, parts, profile)
    np.testing.assert_array_equal(decode(members, ALPHA, width, height), alpha)
    np.testing.assert_array_equal(decode(members, DEPTH, width, height), depth)
    np.testing.assert_array_equal(decode(members, PARTS, width, height), parts)
    off = np.abs(decode(members, RGB, width, height).astype(int) - rgb)
    assert off.max() <= (0 if profile == "lossless" else 12)


def test_parts_may_be_absent() -> None:
    rgb, alpha, depth, _ = pictures()
    assert not set(PARTS) & set(encode_pictures(rgb, alpha, depth, None, "fast"))


@pytest.mark.parametrize("profile", PROFILES)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_bytes_give_an_image_of_the_size_or_one_error(profile, data) -> None:
    members = encode_pictures(*pictures(), profile)
    name = data.draw(st.sampled_from(sorted(members)))
    blob = bytearray(members[name])
    for _ in range(data.draw(st.integers(1, 4))):
        blob[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
    blob = blob[: data.draw(st.integers(0, len(blob)))]
    try:
        image = decode_picture(name, bytes(blob), 40, 28, "here")
    except FormatError as error:
        assert str(error).startswith("here: ") and "\n" not in str(error)
    else:
        assert image.shape[:2] == (28, 40)


def test_a_picture_of_an_unknown_name_is_refused_by_it() -> None:
    png = encode_pictures(*pictures(), "lossless")["rgb.png"]
    with pytest.raises(FormatError, match="rgb.webp"):
        decode_picture("rgb.webp", png, 40, 28, "here")


def test_what_would_grow_is_refused_before_it_does() -> None:
    rgb, alpha, depth, parts = pictures(300, 300)
    members = encode_pictures(rgb, alpha, depth, parts, "fast")
    with pytest.raises(FormatError, match="expected the meta's 10x10"):
        decode_picture("depth.lerc", members["depth.lerc"], 10, 10, "here")
    with pytest.raises(FormatError, match="cannot be decoded|expected 300x299"):
        decode_picture("alpha.zst", members["alpha.zst"], 300, 299, "here")
    bomb = bytearray(members["depth.lerc"])
    for field, value in ((14, 60_000), (18, 60_000)):
        struct.pack_into("<i", bomb, field, value)
    with pytest.raises(FormatError, match="expected at most"):
        decode_picture("depth.lerc", bytes(bomb), 300, 300, "here")
    deep = bytearray(members["depth.lerc"])
    struct.pack_into("<i", deep, 22, 10**6)
    with pytest.raises(FormatError, match="one channel"):
        decode_picture("depth.lerc", bytes(deep), 300, 300, "here")


def test_a_picture_of_four_channels_is_refused() -> None:
    image = np.zeros((8, 8, 4), np.uint8)
    with pytest.raises(FormatError, match="expected uint8"):
        decode_picture("rgb.png", cv2.imencode(".png", image)[1].tobytes(), 8, 8, "here")


@given(st.binary(max_size=300))
def test_the_checksum_is_that_of_zlib(data: bytes) -> None:
    assert crc32(data) == zlib.crc32(data)
