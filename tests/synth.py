"""Tiny captures for tests: a textured ball with a moving mark, ray-traced in a known rig."""

from __future__ import annotations

import struct
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import imagecodecs
import numpy as np
import OpenImageIO as oiio
from PIL import Image

from express50.capture.frames import FootageReader, FrameReader
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.files.calibration import write_cameras
from express50.files.images import write_image
from express50.geometry.cameras import Camera, rays
from express50.geometry.transforms import look_at
from tests.balls import meet_ball

RADIUS_M = 0.1
EXPRESSIONS = ("neutral", "smile")


def read_frame(
    dataset: Dataset, subject: str, camera_id: str, frame: int, undistort: bool = True
) -> np.ndarray:
    """Read one frame (H, W, 3) of the footage: the picture made of it, or as it was recorded."""
    if undistort:
        with FootageReader(dataset, subject) as footage:
            return footage.read(camera_id, frame)
    with closing(FrameReader(read_index(dataset, subject), camera_id)) as reader:
        return reader.read(frame)


def make_rig(cameras: int = 3, size: int = 64) -> dict[str, Camera]:
    """Cameras on an arc, 0.6 m from the origin, looking at it."""
    rig = {}
    for number in range(cameras):
        angle = (number - (cameras - 1) / 2) * 0.5
        eye = 0.6 * np.array([np.sin(angle), 0.1, np.cos(angle)])
        pose = look_at(eye, np.zeros(3))
        name = f"cam{number:02d}"
        params = (1.6 * size, 1.6 * size, size / 2, size / 2, 0.0, 0.0, 0.0, 0.0)
        rig[name] = Camera(name, size, size, "OPENCV", params, pose)
    return rig


def render_ball(camera: Camera, frame: int | None) -> np.ndarray:
    """(H, W, 3) uint8 of the ball at a frame, or of the bare background for None."""
    origin, directions = rays(camera)
    height, width = directions.shape[:2]
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    image = np.stack([60 + 40 * (row // 8 % 2), 70 + 30 * (column // 8 % 2), 90 + row % 16], -1)
    if frame is None:
        return image.astype(np.uint8)
    depth, through = meet_ball(origin, directions, RADIUS_M)
    normal = (origin + depth[..., None] * directions) / RADIUS_M
    shade = 0.4 + 0.6 * np.clip(normal @ np.array([0.3, 0.5, 0.8]), 0, 1)
    mark_angle = 0.35 * frame
    mark = np.array([np.sin(mark_angle), 0.3 * np.cos(mark_angle), 0.8])
    marked = normal @ (mark / np.linalg.norm(mark)) > 0.85
    colour = np.where(marked[..., None], [240, 60, 40], [210, 170, 140])
    return np.where(through[..., None] > 0, colour * shade[..., None], image).astype(np.uint8)


def make_capture(
    path: Path,
    *,
    subject: str = "S001",
    cameras: int = 3,
    frames: int = 6,
    size: int = 64,
    video: bool = False,
    plates: bool = True,
    calibration: bool = True,
    expressions: tuple[str, ...] = EXPRESSIONS,
) -> dict[str, Camera]:
    """Write a raw capture; expressions share the frames evenly. Returns the true cameras."""
    rig = make_rig(cameras, size)
    path.mkdir(parents=True)
    (path / "capture.toml").write_text(f'subject = "{subject}"\nfps = 24\n')
    if calibration:
        write_cameras(path / "calibration.json", rig)
    write_cues(path, expressions, frames)
    for name, camera in rig.items():
        images = [render_ball(camera, frame) for frame in range(frames)]
        folder = path / "cameras" / name
        if video:
            folder.mkdir(parents=True)
            write_video(folder / "video.mp4", images)
        else:
            write_frames(folder / "frames", images)
        if plates:
            (path / "plates").mkdir(exist_ok=True)
            write_image(path / "plates" / f"{name}.png", render_ball(camera, None))
    return rig


def write_cues(path: Path, expressions: tuple[str, ...], frames: int) -> None:
    """Cues of equal length, one after another."""
    each = frames // max(1, len(expressions))
    rows = [f"{e},{i * each},{(i + 1) * each - 1}" for i, e in enumerate(expressions)]
    text = "\n".join(["expression_id,start_frame,end_frame", *rows])
    (path / "cues.csv").write_text(text + "\n")


def write_frames(folder: Path, images: list[np.ndarray]) -> None:
    """Numbered PNG files."""
    folder.mkdir(parents=True)
    for number, image in enumerate(images):
        write_image(folder / f"{number:06d}.png", image)


def write_video(
    path: Path,
    images: list[np.ndarray],
    codec: str = "libx264",
    gop: int = 12,
    b_frames: int = 2,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    ticks: list[int] | None = None,
    rate: int = 24,
    pix_fmt: str = "yuv420p",
) -> None:
    """H.264 with B-frames, as cameras write it; ``ticks`` are time stamps in 96ths of a second."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pix_fmt
        stream.codec_context.gop_size = gop
        stream.codec_context.max_b_frames = b_frames
        stream.codec_context.thread_count = 1
        if ticks is not None:
            stream.codec_context.time_base = Fraction(1, 96)
        stream.options = {"crf": "12"} | (options or {})
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            if ticks is not None:
                frame.pts, frame.time_base = ticks[number], Fraction(1, 96)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def turn_video(path: Path) -> None:
    """Have the container ask for a turn to the right, as a telephone held upright does."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 44  # ISO/IEC 14496-12, 8.3.2
    one = 1 << 16
    data[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def noise_video_images(count: int, size: int = 64) -> list[np.ndarray]:
    """Blocky images that differ a lot from frame to frame, so that hashes tell them apart."""
    rng = np.random.default_rng(0)
    blocks = rng.integers(0, 256, (count, 9, 9, 3), dtype=np.uint8)
    scale = -(-size // 9)
    return [np.kron(b, np.ones((scale, scale, 1), np.uint8))[:size, :size] for b in blocks]


def write_in_adobe_rgb(path: Path, image: np.ndarray) -> None:
    """Write an sRGB image (H, W, 3) uint8 with the colours, and the ICC profile, of Adobe RGB."""
    ours, theirs = (imagecodecs.cms_profile(name) for name in ("srgb", "adobergb"))
    stored = imagecodecs.cms_transform(image, ours, theirs, colorspace="rgb", outcolorspace="rgb")
    Image.fromarray(stored).save(path, icc_profile=theirs, quality=98, subsampling=0, lossless=True)


def write_photo(path: Path, image: np.ndarray, **attributes: object) -> Path:
    """Write a photograph with tags of EXIF, in the best quality."""
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], 3, "uint8")
    for name, value in attributes.items():
        spec.attribute(name.replace("Exif_", "Exif:"), value)
    spec.attribute("Compression", "jpeg:98")
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(np.ascontiguousarray(image))
    file.close()
    return path
