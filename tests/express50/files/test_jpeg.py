"""JPEGs that were cut short are recognised, whatever stands before and after them."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from express50.errors import CaptureError, FormatError
from express50.files.containers import read_picture
from express50.files.images import decode_image, encode_jpeg, is_cut_short, read_image

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 56, 3), dtype=np.uint8)
PLAIN = encode_jpeg(PICTURE, 90)
PROGRESSIVE = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
RESTARTS = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 1])[1].tobytes()


def with_thumbnail(data: bytes) -> bytes:
    """An APP1 segment that holds a whole JPEG, as EXIF does, before all others."""
    body = b"Exif\0\0" + PLAIN
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]


@pytest.mark.parametrize("data", [PLAIN, PROGRESSIVE, RESTARTS])
def test_whole_pictures_are_whole(data):
    assert not is_cut_short(data) and not is_cut_short(data + b"\0" * 100)
    assert not is_cut_short(with_thumbnail(data))
    assert not is_cut_short(b"") and not is_cut_short(b"\x89PNG")


@given(st.floats(0.0, 0.999))
def test_a_jpeg_cut_anywhere_is_found(share):
    for data in (PLAIN, PROGRESSIVE, RESTARTS, with_thumbnail(PLAIN)):
        # the very last scan of a progressive file may be cut from its marker on
        cut = data[: max(2, min(int(share * len(data)), len(data) - 2))]
        assert is_cut_short(cut)


def test_no_reader_takes_half_a_picture(tmp_path):
    half = PLAIN[: len(PLAIN) // 2]
    (tmp_path / "half.jpg").write_bytes(half)
    for read in (lambda: read_image(tmp_path / "half.jpg"), lambda: decode_image(half, "half.jpg")):
        with pytest.raises(FormatError, match=r"half.jpg: truncated"):
            read()
    with pytest.raises(CaptureError, match="truncated"):
        read_picture(tmp_path, "half.jpg")


@pytest.mark.parametrize("shape", [(2, 65_501, 3), (0, 4, 3)])
def test_sides_that_jpeg_does_not_have_are_refused(shape, capfd):
    with pytest.raises(FormatError, match="65500"):
        encode_jpeg(np.zeros(shape, np.uint8))
    assert capfd.readouterr().err == ""
