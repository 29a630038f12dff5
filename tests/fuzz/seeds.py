"""A small valid file for every reader of bytes from outside, and how each is read."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import torch
import trimesh

from annotations.exchange import export_labels, read_table
from annotations.labels import append_label, make_mark, read_labels
from annotations.suggestions import read_suggestions
from express50.capture.frames import decode_proxy, read_gains
from express50.capture.index import read_index, read_peaks
from express50.capture.raw import read_cues
from express50.capture.readers.read import read_any
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track
from express50.dataset.withdraw import files_naming, id_finder
from express50.errors import FormatError, TrainError
from express50.files.arrays import read_weights
from express50.files.containers import read_picture
from express50.files.images import read_image, write_image
from express50.files.video import VideoReader, iterate_video
from express50.head.flame import load_flame
from express50.landmarks.sources import read_points
from express50.rigs.read import guess_format, read_rig
from express50.runner.ledger import Ledger, Receipt
from express50.shards.codecs import decode_picture, encode_pictures
from express50.shards.reader import ShardReader, read_entries, write_offsets, write_registered
from express50.shards.writer import verify, write_manifest
from pipelines import ingest
from pipelines.register.scan_input import KINDS, read_landmarks, read_scan
from tests.express50.capture.layouts import (
    write_ava,
    write_colmap,
    write_multiface,
    write_nersemble,
    write_renderme,
    write_transforms,
)
from tests.express50.head.flame_files import write_flame
from tests.express50.rigs.test_other_tools import SIZE, WRITERS
from tests.express50.rigs.test_read import make_rig, write_yaml
from tests.grmm.packed import write_shards
from tests.grmm.synthetic import EllipsoidSource
from tests.stages import ingest_captures
from tests.synth import make_capture, noise_video_images, write_video

AVA = "20220818--1122--ABC123"
MULTIFACE = "m--20180227--0000--6795937--GHS"
INDEX, ALIGN = "data/ingest/S001", "data/align/S001"


def write_seeds(root: Path) -> None:
    """Write every valid file below an empty folder."""
    make_capture(root / "S001", frames=4)
    _write_dataset(root)
    write_nersemble(root, write_video, sequences=("EMO-1-shout+laugh",), size=2)
    write_ava(root)
    write_multiface(root)
    write_transforms(root)
    write_colmap(root)
    write_renderme(root, cameras=3, expressions=1, frames=2)
    (root / "binary").mkdir()
    pycolmap.Reconstruction(str(root / "scan/sparse/0")).write_binary(str(root / "binary"))
    write_yaml(root / "yaml", make_rig(2))
    for tool, (_, write) in WRITERS.items():
        (root / tool).mkdir()
        write(root / tool)
    _write_pictures(root)
    (root / "flame").mkdir()
    write_flame(root / "flame")
    _write_arrays(root)
    _write_scans(root)
    write_shards(root / "shards", EllipsoidSource(subjects=2, cameras=2, size=24))
    write_manifest(root / "shards")
    torch.save({"features.0.weight": torch.zeros(4, 3, 3, 3)}, root / "vgg.pth")
    (root / "config.toml").write_text("[ingest]\nproxy_long_side = 64\nproxy_quality = 80\n")


def _write_dataset(root: Path) -> None:
    dataset = ingest_captures(root / "data", root / "S001")
    index = read_index(dataset, "S001")
    source = index.cameras["cam00"]
    peak = {"frame": 1, "camera": "cam00", "pts": source.pts[1], "dhash": source.dhash[1]}
    row = {"frame": 1, "confidence": 0.5, "start": 0, "activity": [0.1, 0.2], "candidates": [1]}
    for path, table in (
        (root / ALIGN / "peaks.json", {"neutral": peak}),
        (root / ALIGN / "suggestions.json", {"neutral": row}),
        (root / "data/calibrate/S001/gains.json", {"cam00": [1.0, 1.1, 0.9]}),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(table))
    mark = make_mark(index, "neutral", 1, "cam00", "anna")
    append_label(dataset, replace(mark, confidence=0.5))
    for name in ("labels.csv", "labels.json"):
        export_labels(read_labels(dataset, "S001"), root / name)
    with Ledger(root / "ledger.sqlite") as ledger:
        for number in range(40):
            ledger.write(Receipt(stage="a", item=f"i{number}", fingerprint="f", status="done"))
    with closing(sqlite3.connect(root / "ledger.sqlite")) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def _write_scans(root: Path) -> None:
    """Write a mesh in every format that a scan may have, and landmarks."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    for kind in KINDS:
        ball.export(root / f"ball{kind}")
    rows = ball.vertices[:68].tolist()
    marks = "".join('<point x="{}" y="{}" z="{}"/>'.format(*row) for row in rows)
    (root / "marks.pp").write_text(f"<PickedPoints>{marks}</PickedPoints>")
    (root / "marks.json").write_text(json.dumps({str(k): row for k, row in enumerate(rows)}))
    np.savetxt(root / "marks.txt", rows)


def _write_pictures(root: Path) -> None:
    image = noise_video_images(1, 48)[0]
    for name in ("a.png", "a.jpg", "a.tif"):
        write_image(root / name, image)
    write_image(root / "a.exr", image.astype(np.float32) / 255)
    write_video(root / "a.mp4", noise_video_images(6))
    write_video(root / "a.mkv", noise_video_images(6))
    depth = image[..., 1].astype(np.uint16) * 99
    for name, data in encode_pictures(image, image[..., 0], depth, None, "fast").items():
        (root / name).write_bytes(data)


def _write_arrays(root: Path) -> None:
    rng = np.random.default_rng(0)
    frames, cameras = np.arange(2), np.array(["cam00", "cam01"])
    points = rng.uniform(5, 60, (2, 2, 68, 2))
    schema = "express50.landmarks/1"
    np.savez(root / "points.npz", schema=schema, cameras=cameras, frames=frames, points=points)
    table = {"schema": schema, "cameras": {"cam00": {"0": points[0, 0].tolist()}}}
    (root / "points.json").write_text(json.dumps(table))
    np.savez(
        root / "track.npz", schema="express50.track/2", head="procedural",
        expressions=np.array(["neutral", "smile"]), frames=frames, shape=np.zeros(4),
        expression=np.zeros((2, 3)), neck=np.zeros((2, 3)), jaw=np.zeros((2, 3)),
        eyes=np.zeros((2, 6)), R=np.broadcast_to(np.eye(3), (2, 3, 3)), t=np.zeros((2, 3)),
        vertices=np.zeros((2, 9, 3), np.float32), offsets=np.zeros((9, 3), np.float32),
    )  # fmt: skip
    write_offsets(root, "S001", rng.normal(size=(20, 3)))
    write_registered(root, "S001", {"smile": (rng.normal(size=(20, 3)), rng.uniform(size=20))})


def _video(path: Path) -> object:
    stamps = tuple(stamp for stamp, _ in iterate_video(path))
    reader = VideoReader(path, stamps)
    return reader.read(len(stamps) - 1), reader.read(0)


def _ledger(path: Path) -> None:
    with Ledger(path) as ledger:
        ledger.read("a")
        ledger.write(Receipt(stage="b", item="x", fingerprint="f", status="done"))
        ledger.forget("b", ["x"])


def _capture(path: Path) -> None:
    """Read a capture, and the first picture of two cameras where they are pictures."""
    cameras = [camera for camera in read_any(path).cameras.values() if camera.kind == "frames"]
    for camera in cameras[:2]:
        read_picture(camera.path, camera.names[0])


def _points(root: Path, name: str) -> None:
    read_points(root / name, read_rig(root / "S001/calibration.json", "express50"))


def _verified(shards: Path) -> None:
    list(files_naming(id_finder("S001"), shards))
    if faults := verify(shards):
        raise FormatError("; ".join(faults))


def _proxy(root: Path) -> None:
    decode_proxy(root / INDEX / "proxies", "cam00", 1)


def _capture_of(folder: str) -> Callable[[Path], object]:
    return lambda root: _capture(root / folder)


def _rig_of(path: str) -> Callable[[Path], object]:
    return lambda root: read_rig(root / path, guess_format(root / path))


def _tool(tool: str) -> Callable[[Path], object]:
    """Read the one calibration in a tool's folder, or the folder of sidecars."""

    def read(root: Path) -> object:
        files = list((root / tool).iterdir())
        return read_rig(files[0] if len(files) == 1 else root / tool, WRITERS[tool][0], SIZE)

    return read


def _data(read: Callable[..., object]) -> Callable[[Path], object]:
    return lambda root: read(Dataset(root / "data"), "S001")


def _member(name: str) -> Callable[[Path], object]:
    return lambda root: decode_picture(name, (root / name).read_bytes(), 48, 48, name)


def _flame(root: Path) -> object:
    return load_flame(root / "flame/flame.pkl")


# The file that is mutated, and what reads it.
READERS: dict[str, Callable[[Path], object]] = {
    "S001/calibration.json": _rig_of("S001/calibration.json"),
    "S001/capture.toml": _capture_of("S001"),
    "S001/cues.csv": lambda root: read_cues(root / "S001/cues.csv"),
    "avatar/transforms.json": _capture_of("avatar"),
    "018/calibration/camera_params.json": _capture_of("018"),
    "018/calibration/color_calibration.json": _capture_of("018"),
    f"{AVA}/decoder/camera_calibration.json": _capture_of(AVA),
    f"{AVA}/decoder/frame_list.csv": _capture_of(AVA),
    f"{AVA}/decoder/image/cam400981.zip": _capture_of(AVA),
    f"{MULTIFACE}/KRT": _capture_of(MULTIFACE),
    f"{MULTIFACE}/frame_list.txt": _capture_of(MULTIFACE),
    "raw/0026/0026_e0_raw.smc": _capture_of("raw/0026"),
    "anno/0026/0026_e0_anno.smc": _capture_of("raw/0026"),
    "scan/sparse/0/cameras.txt": _capture_of("scan"),
    "scan/sparse/0/images.txt": _capture_of("scan"),
    "binary/cameras.bin": _rig_of("binary"),
    "binary/images.bin": _rig_of("binary"),
    "yaml/cam00.yml": _rig_of("yaml"),
    "caliscope/camera_array.toml": _tool("caliscope"),
    "aniposelib/calibration.toml": _tool("aniposelib"),
    "kalibr/camchain.yaml": _tool("kalibr"),
    "qualisys/Calib.qca.txt": _tool("qualisys"),
    "metashape/cameras.xml": _tool("metashape"),
    "realitycapture/cam00.xmp": _tool("realitycapture"),
    "panoptic/calibration_a.json": _tool("panoptic"),
    "vggt/predictions.npz": _tool("vggt"),
    **{f"a.{end}": lambda root, end=end: read_image(root / f"a.{end}")
       for end in ("png", "jpg", "tif", "exr")},
    "a.mp4": lambda root: _video(root / "a.mp4"),
    "a.mkv": lambda root: _video(root / "a.mkv"),
    "rgb.jpg": _member("rgb.jpg"),
    "alpha.zst": _member("alpha.zst"),
    "depth.lerc": _member("depth.lerc"),
    "track.npz": lambda root: read_track(root / "track.npz"),
    "points.npz": lambda root: _points(root, "points.npz"),
    "points.json": lambda root: _points(root, "points.json"),
    "S001.offsets.npy": lambda root: ShardReader(root, ()).offsets("S001"),
    "S001.registered.npz": lambda root: ShardReader(root, ()).registered("S001"),
    "flame/flame.pkl": _flame,
    "flame/landmark_embedding.npy": _flame,
    "flame/FLAME_masks.pkl": _flame,
    "flame/head_template_mesh.obj": _flame,
    "shards/index.json": lambda root: read_entries(root / "shards"),
    "shards/manifest.json": lambda root: _verified(root / "shards"),
    "shards/train-000000.tar": lambda root: _verified(root / "shards"),
    **{f"ball{kind}": lambda root, kind=kind: read_scan(root / f"ball{kind}") for kind in KINDS},
    **{f"marks.{end}": lambda root, end=end: read_landmarks(root / f"marks.{end}")
       for end in ("pp", "json", "txt")},
    "vgg.pth": lambda root: read_weights(root / "vgg.pth", TrainError, "vgg", "a state dict"),
    f"{INDEX}/index.json": _data(read_index),
    "data/captures.json": lambda root: Dataset(root / "data").captures(),
    f"{INDEX}/proxies/cam00.json": _proxy,
    f"{INDEX}/proxies/cam00.tar": _proxy,
    f"{ALIGN}/peaks.json": _data(read_peaks),
    f"{ALIGN}/suggestions.json": _data(read_suggestions),
    "data/calibrate/S001/gains.json": _data(read_gains),
    "data/labels/S001.jsonl": _data(read_labels),
    "labels.csv": lambda root: read_table(root / "labels.csv"),
    "labels.json": lambda root: read_table(root / "labels.json"),
    "ledger.sqlite": lambda root: _ledger(root / "ledger.sqlite"),
    "config.toml": lambda root: resolve_config(ingest.STAGE, "draft", root / "config.toml"),
}  # fmt: skip
