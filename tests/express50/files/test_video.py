"""Frame-exact video: counts by decoding, seeks by time stamp, truncation is an error."""

import av
import cv2
import numpy as np
import pytest

from express50.capture.frames import dhash
from express50.errors import CaptureError
from express50.files import video as video_module
from express50.files.video import (
    VideoReader,
    VideoTags,
    check_whole,
    frame_times,
    iterate_sparsely,
    iterate_video,
    video_tags,
)
from tests.synth import noise_video_images, write_video

FRAMES = 61


@pytest.fixture(
    scope="module",
    params=[
        {"gop": 12, "b_frames": 2},
        {"gop": 60, "b_frames": 8},
        {"gop": 16, "b_frames": 4, "options": {"x264-params": "open-gop=1:bframes=4:b-pyramid=2"}},
        {"gop": 1, "b_frames": 0},
        {"gop": 24, "codec": "libx265", "options": {"x265-params": "log-level=none:bframes=6"}},
        {"gop": 12, "b_frames": 3, "name": "camcorder.mts"},
        {"gop": 12, "b_frames": 0, "name": "cinema.mxf"},
        {"gop": 12, "b_frames": 2, "name": "broadcast.ts", "codec": "mpeg2video"},
        # Smaller frames share time stamps, and are refused.
        {"gop": 12, "name": "camcorder.mpg", "codec": "mpeg2video", "options": {"b": "4M"}},
        {"gop": 12, "b_frames": 0, "name": "windows.wmv", "codec": "wmv2"},
        {"gop": 12, "b_frames": 3, "name": "stream.flv"},
    ],
    ids=["closed", "long", "open", "intra", "h265", "mts", "mxf", "ts", "mpg", "wmv", "flv"],
)
def video(request, tmp_path_factory):
    options = dict(request.param)
    path = tmp_path_factory.mktemp("video") / options.pop("name", "video.mp4")
    write_video(path, noise_video_images(FRAMES), **options)
    return path


@pytest.mark.parametrize("threads", ["1", "3"])
def test_random_reads_give_the_sequential_frames(video, threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    sequential = list(iterate_video(video))
    assert len(sequential) == FRAMES
    pts = tuple(stamp for stamp, _ in sequential)
    assert list(pts) == sorted(set(pts))
    reader = VideoReader(video, pts)
    order = np.random.default_rng(1).integers(0, FRAMES, 40)
    for frame in [0, FRAMES - 1, 1, *order]:
        assert np.array_equal(reader.read(int(frame)), sequential[frame][1]), frame
    reader.close()


@pytest.mark.parametrize(("matrix", "space"), [(1, "ITU709"), (5, "ITU601"), (6, "ITU601"), (9, 9)])
@pytest.mark.parametrize("shape", [(1, 1), (77, 101), (48, 64)])
def test_full_chroma_gives_ffmpegs_colours(monkeypatch, shape, matrix, space):
    image = np.random.default_rng(matrix).integers(0, 256, (*shape, 3), dtype=np.uint8)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    frame = frame.reformat(format="yuv444p", dst_colorspace=space)
    frame.colorspace, frame.color_range = matrix, video_module.LIMITED
    ours = video_module._pixels("video.mp4", frame)
    monkeypatch.setattr(video_module, "LUMA", {})
    ffmpegs = video_module._pixels("video.mp4", frame)
    assert np.abs(ours.astype(int) - ffmpegs).max() <= 1
    assert (ours == ffmpegs).mean() > 0.9 or ours.size < 10


def test_exact_colours_of_reduced_chroma(tmp_path):
    rows, columns = np.mgrid[:64, :96]
    image = np.stack([columns * 2, 200 - columns, 60 + 2 * rows], axis=2).astype(np.uint8)
    # H.273, equations 38 to 42, BT.601: the luma and chroma of the picture, by rounding alone.
    red, green, blue = image.transpose(2, 0, 1) / 255
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    chroma = ((blue - luma) / 1.772, (red - luma) / 1.402)
    planes = [16 + 219 * luma, *(128 + 224 * c.reshape(32, 2, 48, 2).mean((1, 3)) for c in chroma)]
    frame = av.VideoFrame(96, 64, "yuv420p")
    frame.pts = 0
    for plane, values in zip(frame.planes, planes, strict=True):
        rows_of_bytes = np.zeros((plane.height, plane.line_size), np.uint8)
        rows_of_bytes[:, : plane.width] = np.rint(values)
        plane.update(rows_of_bytes.tobytes())
    with av.open(str(tmp_path / "video.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    reader = VideoReader(tmp_path / "video.mkv", (0,))
    quick, exact = reader.read(0).astype(int) - image, reader.read_exactly(0).astype(int) - image
    assert np.abs(exact.mean((0, 1))).max() < 0.25 and np.abs(exact).mean() < 0.6
    assert np.abs(quick.mean((0, 1))).max() > 1.0  # otherwise it is not needed any more


def test_colours_of_hd_video_without_a_colour_matrix_are_those_that_opencv_wrote(tmp_path):
    """Players take BT.709 for it; this would be 5 levels off here."""
    rows, columns = np.mgrid[:720, :1280]
    image = np.stack([30 + columns // 7, 200 - columns // 11, 60 + rows // 8], 2).astype(np.uint8)
    path = tmp_path / "video.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 24, (1280, 720))
    writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    read = VideoReader(path, frame_times(path)).read_exactly(0)
    assert np.abs(read.astype(int) - image).mean() < 3


def test_a_read_decodes_what_it_needs_from_the_nearest_key_frame(tmp_path, monkeypatch):
    path, decoded = tmp_path / "video.mp4", []
    write_video(path, noise_video_images(FRAMES), gop=12, b_frames=2)
    pts = tuple(stamp for stamp, _ in iterate_video(path))
    reader, decode = VideoReader(path, pts), video_module._decode

    def counted(*arguments):
        for frame in decode(*arguments):
            decoded.append(frame.pts)
            yield frame

    monkeypatch.setattr(video_module, "_decode", counted)
    reader.read(50)
    reader.close()
    with av.open(str(path)) as container:
        keys = [frame.pts for frame in container.decode(video=0) if frame.key_frame]
    nearest = max(key for key in keys if key <= pts[50])
    between = [stamp for stamp in pts if nearest <= stamp <= pts[50]]
    assert decoded[0] == nearest
    assert decoded[-1] == pts[50]
    assert set(decoded) < set(between)  # those that others refer to


def test_a_key_frame_before_a_frame_is_found_and_reads_go_on(video):
    with av.open(str(video)) as container:
        frames = list(container.decode(video=0))
    reader = VideoReader(video, tuple(frame.pts for frame in frames))
    for wanted in (0, 5, 30, FRAMES - 1):
        found = reader.key_frame(wanted)
        earlier = [k for k in range(wanted + 1) if frames[k].key_frame]
        # Without an index, it may be an earlier one, or the frame itself.
        assert found in ([earlier[-1]] if video.suffix in (".mp4", ".mxf") else [wanted, *earlier])
        assert np.array_equal(reader.read(found), frames[found].to_ndarray(format="rgb24"))


def test_forward_reads_do_not_seek(video, monkeypatch):
    pts = tuple(stamp for stamp, _ in iterate_video(video))
    reader = VideoReader(video, pts)
    monkeypatch.setattr(reader, "_seek", lambda frame: pytest.fail("seek"))
    for frame in (0, 1, 2, 10, 20):
        reader.read(frame)


@pytest.mark.parametrize(
    ("shift", "frame", "message"),
    [
        (0, FRAMES, "frame 61 does not exist, expected 0 to 60"),
        (1000, FRAMES - 1, "no frame with time stamp"),
    ],
)
def test_frames_outside_and_foreign_time_stamps_are_refused(video, shift, frame, message):
    pts = tuple(stamp + shift for stamp, _ in iterate_video(video))
    with pytest.raises(CaptureError, match=message):
        VideoReader(video, pts).read(frame)


def test_frames_are_counted_by_decoding(tmp_path):
    """An edit list hides the first frames: the container still counts them, decoding does not."""
    images = noise_video_images(24)
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    write_video(whole, images, gop=24, b_frames=0)
    with av.open(str(whole)) as source, av.open(str(cut), "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        start = [p.pts for p in source.demux(stream) if p.pts is not None][8]
        source.seek(0, stream=stream)
        for packet in source.demux(stream):
            if packet.pts is None:
                continue
            packet.pts -= start
            packet.dts -= start
            packet.stream = copy
            target.mux(packet)
    decoded = [image for _, image in iterate_video(cut)]
    with av.open(str(cut)) as container:
        claimed = container.streams.video[0].frames
    assert (len(decoded), claimed) == (16, 24)
    assert dhash(decoded[0]) == dhash([image for _, image in iterate_video(whole)][8])


@pytest.mark.parametrize("faststart", [False, True])
@pytest.mark.parametrize("kept", [0.05, 0.4, 0.8, 0.999])
def test_truncated_file_is_a_capture_error(tmp_path, faststart, kept):
    path = tmp_path / "video.mp4"
    options = {"movflags": "faststart"} if faststart else {}
    write_video(path, noise_video_images(30), container_options=options)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(CaptureError, match="copy"):
        list(iterate_video(path))


def test_fragmented_file_cut_in_a_fragment_is_a_capture_error(tmp_path):
    path = tmp_path / "video.mp4"
    flags = {"movflags": "frag_keyframe+empty_moov"}
    write_video(path, noise_video_images(48), gop=8, container_options=flags)
    check_whole(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match="truncated"):
        list(iterate_video(path))


@pytest.mark.parametrize("data", [b"", b"no video at all", b"\0" * 4096])
def test_junk_is_a_capture_error(tmp_path, data):
    path = tmp_path / "video.mp4"
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="cannot be opened"):
        list(iterate_video(path))


def test_sound_only_is_a_capture_error(tmp_path):
    path = tmp_path / "video.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
        frame.sample_rate = 44100
        for packet in [*stream.encode(frame), *stream.encode()]:
            container.mux(packet)
    with pytest.raises(CaptureError, match="no video stream"):
        list(iterate_video(path))


@pytest.mark.parametrize("every", [2, 5, 1000])
def test_sparse_reading_lists_all_frames_and_decodes_those_coded_alone(video, every):
    whole = list(iterate_video(video))
    told: list[VideoTags] = []
    sparse = list(iterate_sparsely(video, every, told.append))
    assert [stamp for stamp, _ in sparse] == [stamp for stamp, _ in whole]
    decoded = [frame for frame, (_, image) in enumerate(sparse) if image is not None]
    assert decoded[0] == 0 and min(np.diff(decoded), default=every) >= every
    assert all(np.array_equal(sparse[frame][1], whole[frame][1]) for frame in decoded)
    assert told == [video_tags(video)]


def test_sparse_reading_of_videos_all_of_whose_frames_stand_alone_is_even(tmp_path):
    write_video(tmp_path / "video.mp4", noise_video_images(FRAMES), gop=1)
    rows = iterate_sparsely(tmp_path / "video.mp4", 7, lambda tags: None)
    decoded = [frame for frame, (_, image) in enumerate(rows) if image is not None]
    assert decoded == list(range(0, FRAMES, 7))


def encode(path, **options):
    """Write FRAMES frames of a moving picture as H.264."""
    picture = noise_video_images(1)[0]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options=options)
        stream.width, stream.height, stream.pix_fmt = picture.shape[1], picture.shape[0], "yuv420p"
        for shift in range(FRAMES):
            image = np.roll(picture, 3 * shift, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def test_an_avi_file_whose_time_stamps_are_out_of_order_is_refused(tmp_path):
    encode(tmp_path / "video.avi", bf="3", g="12")
    for read in (iterate_video, lambda path: iterate_sparsely(path, 5, lambda tags: None)):
        with pytest.raises(CaptureError, match="video.avi: time stamps of frames are not in order"):
            list(read(tmp_path / "video.avi"))


def test_an_mxf_file_whose_time_stamps_are_out_of_order_is_refused(tmp_path):
    encode(tmp_path / "video.mxf", bf="3", g="12")
    with pytest.raises(CaptureError, match="video.mxf: time stamps of frames are not in order"):
        list(iterate_video(tmp_path / "video.mxf"))


def test_frames_that_only_claim_to_stand_alone_are_not_decoded_sparsely(tmp_path):
    encode(tmp_path / "video.mp4", **{"x264-params": "intra-refresh=1:keyint=10"})
    whole = list(iterate_video(tmp_path / "video.mp4"))
    sparse = list(iterate_sparsely(tmp_path / "video.mp4", 5, lambda tags: None))
    assert [stamp for stamp, _ in sparse] == [stamp for stamp, _ in whole]
    decoded = [frame for frame, (_, image) in enumerate(sparse) if image is not None]
    assert decoded == [0] and np.array_equal(sparse[0][1], whole[0][1])
