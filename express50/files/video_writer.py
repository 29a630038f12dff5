"""Write footage as an H.264 video or numbered images: the same pictures give the same bytes."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np

from express50.files.images import encode_jpeg, encode_png

_BT709 = 1


class VideoFootage:
    """Writes ``video.mp4``: H.264, 4:4:4, BT.709.

    One thread and no B-frames, as the same pictures would give other bytes from run to run: libx264
    placed B-frames in six ways in 40 runs of one thread.
    """

    def __init__(self, folder: Path, width: int, height: int, fps: float, crf: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(folder / "video.mp4"), "w")
        rate = Fraction(fps).limit_denominator(1001)
        stream = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv444p"
        stream.options = {"crf": str(crf), "preset": "veryfast", "bf": "0"}
        context = stream.codec_context
        context.thread_count, context.gop_size = 1, 24
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = 1  # limited, as cameras record
        self._stream = stream

    def __enter__(self) -> VideoFootage:
        return self

    def write(self, image: np.ndarray) -> None:
        """Append a picture (H, W, 3) uint8 sRGB."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = frame.reformat(format="yuv444p", dst_colorspace="ITU709")
        self._container.mux(self._stream.encode(frame))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()


class ImageFootage:
    """Writes ``frames/000000.png`` (or jpg) and so on."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self._folder = folder / "frames"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._suffix = suffix
        self._count = 0

    def __enter__(self) -> ImageFootage:
        return self

    def write(self, image: np.ndarray) -> None:
        """Append a picture (H, W, 3) uint8 sRGB."""
        data = encode_png(image) if self._suffix == "png" else encode_jpeg(image, 97)
        (self._folder / f"{self._count:06d}.{self._suffix}").write_bytes(data)
        self._count += 1

    def __exit__(self, *unused: object) -> None:
        """Nothing is open between pictures."""
