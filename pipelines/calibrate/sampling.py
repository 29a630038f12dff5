"""Images of a raw capture taken at the same moments, for checks that come before ingest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from express50.capture.index import Cue
from express50.capture.raw import RawCamera, RawCapture, read_capture
from express50.errors import CaptureError
from express50.files.containers import read_picture
from express50.files.video import iterate_video


def read_moments(
    root: Path, count: int, reduce: Callable[[str, np.ndarray], np.ndarray | None]
) -> dict[int, dict[str, np.ndarray]]:
    """Images (H, W, 3) uint8 of cameras at up to `count` moments, by frame number.

    The moments are spread over the cues' middles, or over the images where there are no cues.
    Each image is kept as `reduce(camera, image)` returns it, and left out where that is None.

    Raises:
        CaptureError: the capture is unusable, or a camera has no such frame.
    """
    capture = read_capture(root)
    wanted = moments_of(capture, count)
    found: dict[int, dict[str, np.ndarray]] = {frame: {} for frame in wanted}
    for name, camera in sorted(capture.cameras.items()):
        for frame, image in _read(camera, wanted):
            kept = reduce(name, image)
            if kept is not None:
                found[frame][name] = kept
    return found


def moments_of(capture: RawCapture, count: int) -> list[int]:
    """Frame numbers of up to `count` moments; a video without cues offers its first frame."""
    lengths = [len(camera.names) for camera in capture.cameras.values() if camera.names]
    return spread_moments(capture.cues, count) or spread(range(min(lengths, default=1)), count)


def spread_moments(cues: Sequence[Cue], count: int) -> list[int]:
    """Middle frames of up to `count` cues, evenly chosen; none where there are no cues."""
    return spread(sorted((cue.start_frame + cue.end_frame) // 2 for cue in cues), count)


def spread(frames: Sequence[int], count: int) -> list[int]:
    """Up to `count` of some frames, evenly chosen."""
    picks = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[i] for i in picks]


def _read(camera: RawCamera, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Wanted frames one by one, so that no more than one full-size image is held."""
    if camera.kind == "frames":
        missing = [frame for frame in wanted if frame >= len(camera.names)]
        if not missing:
            for frame in wanted:
                yield frame, read_picture(camera.path, camera.names[frame], camera.orientation)
            return
        length = len(camera.names)
    else:
        for length, (_, image) in enumerate(iterate_video(camera.path), 1):
            if length - 1 in wanted:
                yield length - 1, image
            if length > max(wanted):
                return
        missing = [frame for frame in wanted if frame >= length]
    raise CaptureError(f"{camera.path}: has {length} frames, frame {missing[0]} was expected")
