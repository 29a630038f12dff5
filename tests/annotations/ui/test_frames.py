"""Pictures in memory: bounded, decoded ahead, and honest about frames that cannot be read."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from annotations.ui import frames
from annotations.ui.frames import Face, FrameCache, FrameCrop, crop_to, zoom_box
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, CaptureError

WHOLE = (0.0, 0.0, 1.0, 1.0)


def shot(frame, size=8):
    return FrameCrop("S1", "cam", frame, WHOLE, size, size)


def painter(dataset, wanted):
    return np.full((wanted.height, wanted.width, 3), wanted.frame % 256, np.uint8)


class Counter:
    """A painter that counts the pictures it decodes."""

    count = 0

    def __call__(self, dataset, wanted):
        self.count += 1
        return painter(dataset, wanted)


def wait_until(true, seconds=5.0):
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.005)
    assert true()


@pytest.fixture
def cache(monkeypatch):
    """A cache that paints its pictures."""
    monkeypatch.setattr(frames, "read_shot", painter)
    cache = FrameCache(Dataset(Path("data")))
    yield cache
    cache.close()


def test_cache_is_bounded_and_drops_the_least_recently_used(cache, monkeypatch):
    each = 8 * 8 * 3
    decode = Counter()
    monkeypatch.setattr(frames, "read_shot", decode)
    monkeypatch.setattr(frames, "LIMIT_BYTES", 3 * each)
    for frame in (1, 2, 3, 1, 4):
        assert cache.get(shot(frame))[0, 0, 0] == frame
        assert cache._bytes <= 3 * each
    assert decode.count == 4
    cache.get(shot(1))
    assert decode.count == 4
    cache.get(shot(2))
    assert decode.count == 5


def test_picture_larger_than_the_cache_is_returned(cache, monkeypatch):
    monkeypatch.setattr(frames, "LIMIT_BYTES", 10)
    assert cache.get(shot(5)).shape == (8, 8, 3)
    assert cache._bytes == 0


def test_wanted_pictures_are_decoded_ahead_by_urgency(cache, monkeypatch):
    order, gate = [], threading.Event()

    def slow(dataset, wanted):
        gate.wait(5)
        order.append(wanted.frame)
        return painter(dataset, wanted)

    monkeypatch.setattr(frames, "read_shot", slow)
    cache.want([shot(9)])
    wait_until(cache.idle)  # the thread has taken 9 and waits at the gate
    cache.want([shot(7), shot(8)], later=True)
    cache.want([shot(1), shot(2)])
    gate.set()
    wait_until(lambda: len(order) == 5)
    assert order == [9, 1, 2, 7, 8]
    wait_until(lambda: cache._bytes == 5 * 8 * 8 * 3)
    cache.get(shot(2))
    assert len(order) == 5


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (FileNotFoundError("cam.json"), "express50 ingest data"),
        (CaptureError("no frame 3 of camera 'cam'"), "no frame 3"),
        (IndexError("list index"), "frame 3"),
    ],
)
def test_unreadable_frame_raises_and_keeps_the_thread_alive(cache, monkeypatch, error, remedy):
    def broken(dataset, wanted):
        raise error

    monkeypatch.setattr(frames, "read_shot", broken)
    with pytest.raises(AnnotationError, match=remedy):
        cache.get(shot(3))
    cache.want([shot(3)])  # must not kill the thread
    wait_until(cache.idle)
    monkeypatch.setattr(frames, "read_shot", painter)
    cache.want([shot(4)])
    wait_until(lambda: cache._bytes > 0)


def test_crop_beyond_the_border_is_black():
    image = np.full((20, 30, 3), 200, np.uint8)
    out = crop_to(image, (-0.5, 0.0, 0.5, 1.0), 40, 20)
    assert out.shape == (20, 40, 3)
    assert out[:, :18].max() == 0
    assert out[:, 22:].min() == 200
    assert crop_to(image, (2.0, 2.0, 3.0, 3.0), 4, 4).max() == 0
    assert crop_to(image, (0.5, 0.5, 0.5, 0.5), 4, 6).shape == (6, 4, 3)


@pytest.mark.parametrize("zoom", ["face", "mouth", "eyes", "head", "frame"])
@pytest.mark.parametrize("pane_aspect", [0.3, 1.0, 2.5])
def test_zoom_does_not_distort(zoom, pane_aspect):
    face = Face(0.4, 0.3, 0.12)
    left, top, right, bottom = zoom_box(face, zoom, pane_aspect, 0.5625)
    assert (bottom - top) * 0.5625 / (right - left) == pytest.approx(pane_aspect, rel=0.02)
    if zoom == "frame":
        assert left <= 0 and top <= 0 and right >= 1 and bottom >= 1
    else:
        assert left < 0.4 < right


def test_mouth_and_eyes_are_inside_the_face_and_the_face_inside_the_head():
    face = Face(0.5, 0.4, 0.1)
    mouth, eyes, whole, head = (
        zoom_box(face, z, 0.75, 1.0) for z in ("mouth", "eyes", "face", "head")
    )
    for inner, outer in ((mouth, whole), (eyes, whole), (whole, head)):
        assert inner[1] > outer[1] and inner[3] < outer[3]
    assert mouth[1] > eyes[1]
