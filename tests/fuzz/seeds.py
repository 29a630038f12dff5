"""A small valid file for every reader of bytes from outside, and how each is read."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from annotations.exchange import export_labels, read_table
from annotations.labels import make_mark
from annotations.store import append_label, read_labels
from annotations.suggestions import read_suggestions
from express50.capture.frames import decode_proxy, read_gains, read_peaks
from express50.capture.index import read_index
from express50.capture.raw import read_cues
from express50.capture.readers.read import read_any
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.dataset.id_search import files_naming
from express50.dataset.tracks import read_track
from express50.errors import FormatError
from express50.files.calibration import read_cameras
from express50.files.containers import decode_picture as decode_foreign
from express50.files.containers import read_picture, read_srgb8
from express50.files.images import decode_image, read_image, write_image
from express50.files.video import VideoReader, iterate_video
from express50.head.flame import load_flame
from express50.head.ict import read_obj
from express50.landmarks.sources import read_points
from express50.rigs.read import guess_format, read_rig
from express50.runner.ledger import Ledger
from express50.runner.receipts import Receipt
from express50.runner.runner import run_stage
from express50.shards.codecs import decode_picture, encode_pictures
from express50.shards.offsets import read_offsets, write_offsets
from express50.shards.reader import ShardReader, read_entries
from express50.shards.writer import PackedSample, ShardWriter, verify, write_manifest
from grmm.checkpoint import load_checkpoint
from grmm.presets import resolve
from grmm.shard_source import ShardSource
from grmm.study.answers import read_answers, read_study
from pipelines import ingest
from tests.express50.captures.layouts import (
    write_ava,
    write_colmap,
    write_multiface,
    write_nersemble,
    write_renderme,
    write_transforms,
)
from tests.express50.head.flame_files import write_flame
from tests.synth import make_capture, noise_video_images, write_video


@dataclass(frozen=True)
class Reader:
    """How a file is read. ``native`` libraries may kill the process: a pool's worker, which the
    runner replaces, and whose item it sets aside after two deaths (`express50.runner.executor`).
    """

    name: str
    file: str
    read: Callable[[Path], object]
    native: bool = False


def write_seeds(root: Path) -> None:
    """Every valid file, below a folder that is not there yet."""
    root.mkdir()
    make_capture(root / "S001", frames=4)
    _write_dataset(root)
    write_nersemble(root, write_video, sequences=("EMO-1-shout+laugh",), size=2)
    write_ava(root)
    write_multiface(root)
    write_transforms(root)
    write_colmap(root)
    write_renderme(root, cameras=3, expressions=1, frames=2)
    _write_binary_colmap(root)
    _write_yaml(root / "yaml")
    _write_pictures(root)
    (root / "flame").mkdir()
    write_flame(root / "flame")
    _write_arrays(root)
    _write_shards(root)
    _write_networks(root)
    (root / "config.toml").write_text("[ingest]\nproxy_long_side = 64\nproxy_quality = 80\n")
    (root / "grmm.toml").write_text("[train]\niterations = 5\n[model]\nn_g = 32\n")
    study = {"format": "grmm.study/1", "participants": 2, "examples": [1], "questions": ["a"]}
    (root / "study").mkdir()
    (root / "study/study.json").write_text(json.dumps(study))


def _write_dataset(root: Path) -> None:
    dataset = Dataset(root / "data")
    ingest.register(dataset, [root / "S001"])
    run_stage(
        ingest.STAGE, dataset, resolve_config(ingest.STAGE, "draft"), workers=0, progress=False
    )
    index = read_index(dataset, "S001")
    source = index.cameras["cam00"]
    peak = {"frame": 1, "camera": "cam00", "pts": source.pts[1], "dhash": source.dhash[1]}
    align, calibrate = dataset.item_dir("align", "S001"), dataset.item_dir("calibrate", "S001")
    for folder in (align, calibrate):
        folder.mkdir(parents=True)
    (align / "peaks.json").write_text(json.dumps({"neutral": peak}))
    row = {"frame": 1, "confidence": 0.5, "start": 0, "activity": [0.1, 0.2], "candidates": [1]}
    (align / "suggestions.json").write_text(json.dumps({"neutral": row}))
    (calibrate / "gains.json").write_text(json.dumps({"cam00": [1.0, 1.1, 0.9]}))
    mark = make_mark(index, "neutral", 1, "cam00", "anna")
    append_label(dataset, replace(mark, confidence=0.5))
    labels = read_labels(dataset, "S001")
    export_labels(labels, root / "labels.csv")
    export_labels(labels, root / "labels.json")
    with Ledger(root / "ledger.sqlite") as ledger:
        for number in range(40):
            ledger.write(Receipt(stage="a", item=f"i{number}", fingerprint="f", status="done"))
    with sqlite3.connect(root / "ledger.sqlite") as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def _write_binary_colmap(root: Path) -> None:
    import pycolmap

    (root / "binary").mkdir()
    pycolmap.Reconstruction(str(root / "scan/sparse/0")).write_binary(str(root / "binary"))


def _write_yaml(folder: Path) -> None:
    import cv2

    folder.mkdir()
    for name in ("a", "b"):
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        for key, value in (
            ("image_width", 64), ("image_height", 48), ("R", np.eye(3)), ("T", np.ones((3, 1))),
            ("camera_matrix", np.array([[90.0, 0, 32], [0, 90, 24], [0, 0, 1]])),
            ("distortion_coefficients", np.full((5, 1), 0.01)),
        ):  # fmt: skip
            storage.write(key, value)
        storage.release()


def _write_pictures(root: Path) -> None:
    image = noise_video_images(1, 48)[0]
    for name in ("a.png", "a.jpg", "a.tif"):
        write_image(root / name, image)
    write_image(root / "a.exr", image.astype(np.float32) / 255)
    write_image(root / "deep.png", np.full((40, 40), 9000, np.uint16))
    write_video(root / "a.mp4", noise_video_images(6))
    write_video(root / "a.mkv", noise_video_images(6))
    members = encode_pictures(
        image, image[..., 0], image[..., 1].astype(np.uint16) * 99, None, "fast"
    )
    for name, data in members.items():
        (root / name).write_bytes(data)


def _write_arrays(root: Path) -> None:
    rng = np.random.default_rng(0)
    frames, cameras = np.arange(2), np.array(["cam00", "cam01"])
    points = rng.uniform(5, 60, (2, 2, 68, 2))
    np.savez_compressed(
        root / "points.npz", schema="express50.landmarks/1", cameras=cameras, frames=frames,
        points=points,
    )  # fmt: skip
    table = {"cam00": {"0": points[0, 0].tolist()}}
    content = {"schema": "express50.landmarks/1", "cameras": table}
    (root / "points.json").write_text(json.dumps(content))
    turns = np.broadcast_to(np.eye(3), (2, 3, 3))
    np.savez(
        root / "track.npz", schema="express50.track/2", head="procedural",
        expressions=np.array(["neutral", "smile"]), frames=frames, shape=np.zeros(4),
        expression=np.zeros((2, 3)), neck=np.zeros((2, 3)), jaw=np.zeros((2, 3)),
        eyes=np.zeros((2, 6)), R=turns, t=np.zeros((2, 3)),
        vertices=np.zeros((2, 9, 3), np.float32), offsets=np.zeros((9, 3), np.float32),
    )  # fmt: skip
    write_offsets(root, "S001", rng.normal(size=(20, 3)))


def _write_shards(root: Path) -> None:
    from tests.grmm.packed import write_shards
    from tests.grmm.synthetic import EllipsoidSource

    write_shards(root / "shards", EllipsoidSource(subjects=2, cameras=2, size=24))
    write_manifest(root / "shards")
    reader = ShardReader(root / "shards")
    (root / "meta.json").write_bytes(reader.member(0, "meta.json"))


def _write_networks(root: Path) -> None:
    from grmm.checkpoint import Gallery, save_checkpoint
    from grmm.data import Tracked
    from grmm.model import GRMM
    from grmm.scene import PinholeView
    from tests.grmm.synthetic import ellipsoid_head, tiny_config

    head, config = ellipsoid_head(), tiny_config()
    model = GRMM(config.model, head, ["S001"], ["neutral"])
    tracked = Tracked(
        shape=np.zeros(1), expression=np.zeros(1), neck=np.zeros(3), jaw=np.zeros(3),
        eyes=np.zeros(6), R=np.eye(3), t=np.zeros(3), offsets=np.zeros((len(head.template), 3)),
    )  # fmt: skip
    view = PinholeView(K=torch.eye(3), cam_from_head=torch.eye(4), width=9, height=9)
    gallery = Gallery(frames={("S001", "neutral"): tracked}, cameras={"cam00": view})
    save_checkpoint(
        root / "checkpoint.pt", model=model, config=config, head_spec="ellipsoid", gallery=gallery
    )
    torch.jit.script(torch.nn.Conv2d(3, 1, 1)).save(str(root / "matte.pt"))
    torch.save({"features.0.weight": torch.zeros(4, 3, 3, 3)}, root / "vgg.pth")


def _meta(root: Path) -> object:
    """A sample with the mutated meta, whose checksum is right."""
    folder = root / "repacked"
    shutil.rmtree(folder, ignore_errors=True)
    reader = ShardReader(root / "shards")
    members = reader.members(0) | {"meta.json": (root / "meta.json").read_bytes()}
    writer = ShardWriter(folder, 1 << 20)
    entry = reader.entries[0]
    writer.add_group(
        "train", [PackedSample(entry.subject, entry.expression, entry.camera, members)]
    )
    writer.close()
    source = ShardSource(folder, "train")
    return source.read(0), source.window(0)


def read_checkpoint(root: Path) -> object:
    import grmm.checkpoint as module
    from tests.grmm.synthetic import ellipsoid_head

    module.load_head = lambda spec: ellipsoid_head()  # type: ignore[assignment]
    loaded = load_checkpoint(root / "checkpoint.pt")
    return loaded.gallery, dict(loaded.model.state_dict())


def _member(name: str) -> Callable[[Path], object]:
    def read(root: Path) -> object:
        return decode_picture(name, (root / name).read_bytes(), 48, 48, name)

    return read


def _video(name: str) -> Callable[[Path], object]:
    def read(root: Path) -> object:
        stamps = tuple(stamp for stamp, _ in iterate_video(root / name))
        reader = VideoReader(root / name, stamps)
        return reader.read(len(stamps) - 1), reader.read(0)

    return read


def _ledger(root: Path) -> object:
    with Ledger(root / "ledger.sqlite") as ledger:
        rows = ledger.read("a")
        ledger.sha256(root / "a.png")
        ledger.write(Receipt(stage="b", item="x", fingerprint="f", status="done"))
        ledger.forget("b", ["x"])
        return rows


def _capture(name: str) -> Callable[[Path], object]:
    """A capture, and the first picture of each camera where they are pictures."""

    def read(root: Path) -> object:
        raw = read_any(root / name)
        found = [c for c in raw.cameras.values() if c.kind == "frames"]
        return raw, [read_picture(camera.path, camera.names[0]) for camera in found[:2]]

    return read


def _rig(name: str) -> Callable[[Path], object]:
    def read(root: Path) -> object:
        return read_rig(root / name, guess_format(root / name))

    return read


def _study(root: Path) -> object:
    study = read_study(root / "study")
    return study, read_answers(root / "study", study)


def _verified(root: Path) -> None:
    """`verify` returns what is wrong."""
    if faults := verify(root / "shards"):
        raise FormatError("; ".join(faults))


def _searched(root: Path) -> object:
    """A damaged tar is searched too, and then found damaged."""
    found = list(files_naming(root / "shards", "S001"))
    return found, _verified(root)


def _network(root: Path) -> object:
    from pipelines.networks import Role, load_network

    image = np.zeros((4, 4, 3), np.float32)
    return load_network(root / "matte.pt", Role(setting="w", inputs=("a",)))(image)


def _vgg(root: Path) -> object:
    from express50.errors import TrainError
    from express50.files.checkpoints import read_weights

    return read_weights(root / "vgg.pth", TrainError, "vgg", "a state dict")


def readers() -> Iterator[Reader]:
    """Every reader; see the module."""

    def dataset(root: Path) -> Dataset:
        return Dataset(root / "data")

    def points(name: str) -> Callable[[Path], object]:
        # An unknown point is NaN by the format; Inf is what must not pass.
        def read(root: Path) -> object:
            table = read_points(root / name, read_cameras(root / "S001/calibration.json"))
            return [np.nan_to_num(rows, nan=0.0, posinf=np.inf) for rows in table.values()]

        return read

    def plain(read: Callable[[Path], object], file: str) -> Callable[[Path], object]:
        return lambda root: read(root / file)

    index = "data/ingest/S001"
    yield Reader("calibration.json", "S001/calibration.json", _rig("S001/calibration.json"))
    yield Reader("capture.toml", "S001/capture.toml", _capture("S001"))
    yield Reader("cues.csv", "S001/cues.csv", plain(read_cues, "S001/cues.csv"))
    yield Reader("transforms.json", "avatar/transforms.json", _capture("avatar"))
    yield Reader("transforms.json rig", "avatar/transforms.json", _rig("avatar"))
    yield Reader("NeRSemble cameras", "018/calibration/camera_params.json", _capture("018"))
    yield Reader("NeRSemble colours", "018/calibration/color_calibration.json", _capture("018"))
    ava = "20220818--1122--ABC123"
    yield Reader("AVA cameras", f"{ava}/decoder/camera_calibration.json", _capture(ava))
    yield Reader("AVA frames", f"{ava}/decoder/frame_list.csv", _capture(ava))
    yield Reader("AVA zip", f"{ava}/decoder/image/cam400981.zip", _capture(ava))
    multiface = "m--20180227--0000--6795937--GHS"
    yield Reader("Multiface KRT", f"{multiface}/KRT", _capture(multiface))
    yield Reader("Multiface frames", f"{multiface}/frame_list.txt", _capture(multiface))
    yield Reader("SMC pictures", "raw/0026/0026_e0_raw.smc", _capture("raw/0026"), native=True)
    yield Reader("SMC cameras", "anno/0026/0026_e0_anno.smc", _capture("raw/0026"), native=True)
    for kind in ("cameras", "images"):
        yield Reader(f"COLMAP {kind}.txt", f"scan/sparse/0/{kind}.txt", _capture("scan"))
        yield Reader(f"COLMAP {kind}.bin", f"binary/{kind}.bin", _rig("binary"))
    yield Reader("OpenCV YAML", "yaml/a.yml", _rig("yaml"))
    for name in ("a.png", "a.jpg", "a.tif", "a.exr", "deep.png"):
        yield Reader(f"image {name}", name, plain(read_image, name), native=True)
    yield Reader("JPEG as a frame", "a.jpg", plain(read_srgb8, "a.jpg"), native=True)
    for name in ("a.png", "a.jpg"):
        yield Reader(f"bytes {name}", name, lambda r, n=name: decode_image((r / n).read_bytes()))
        yield Reader(
            f"member {name}", name, lambda r, n=name: decode_foreign((r / n).read_bytes(), n)
        )
    for name in ("rgb.jpg", "alpha.zst", "depth.lerc"):
        yield Reader(f"shard {name}", name, _member(name))
    for name in ("a.mp4", "a.mkv"):
        yield Reader(f"video {name}", name, _video(name), native=True)
    yield Reader("track.npz", "track.npz", plain(read_track, "track.npz"))
    yield Reader("points.npz", "points.npz", points("points.npz"))
    yield Reader("points.json", "points.json", points("points.json"))
    yield Reader("offsets.npy", "S001.offsets.npy", lambda r: read_offsets(r, "S001"))
    template = "head_template_mesh.obj"
    for name in ("flame.pkl", "landmark_embedding.npy", "FLAME_masks.pkl", template):
        yield Reader(f"FLAME {name}", f"flame/{name}", lambda r: load_flame(r / "flame/flame.pkl"))
    yield Reader("OBJ", "flame/head_template_mesh.obj",
                 plain(read_obj, "flame/head_template_mesh.obj"))  # fmt: skip
    yield Reader("shards index.json", "shards/index.json", plain(read_entries, "shards"))
    yield Reader("shards manifest", "shards/manifest.json", _verified)
    yield Reader("shard meta.json", "meta.json", _meta)
    yield Reader("shard tar, withdrawn", "shards/train-000000.tar", _searched)
    yield Reader("checkpoint.pt", "checkpoint.pt", read_checkpoint)
    yield Reader("VGG weights", "vgg.pth", _vgg)
    yield Reader("TorchScript", "matte.pt", _network, native=True)
    yield Reader("index.json", f"{index}/index.json", lambda r: read_index(dataset(r), "S001"))
    yield Reader("captures.json", "data/captures.json", lambda r: dataset(r).captures())
    yield Reader("proxy table", f"{index}/proxies/cam00.json",
                 lambda r: decode_proxy(r / index / "proxies", "cam00", 1))  # fmt: skip
    yield Reader("proxy tar", f"{index}/proxies/cam00.tar",
                 lambda r: decode_proxy(r / index / "proxies", "cam00", 1))  # fmt: skip
    align = "data/align/S001"
    yield Reader("peaks.json", f"{align}/peaks.json", lambda r: read_peaks(dataset(r), "S001"))
    yield Reader("suggestions.json", f"{align}/suggestions.json",
                 lambda r: read_suggestions(dataset(r), "S001"))  # fmt: skip
    yield Reader("gains.json", "data/calibrate/S001/gains.json",
                 lambda r: read_gains(dataset(r), "S001"))  # fmt: skip
    yield Reader("label events", "data/labels/S001.jsonl",
                 lambda r: read_labels(dataset(r), "S001"))  # fmt: skip
    for name in ("labels.csv", "labels.json"):
        yield Reader(f"import {name}", name, plain(read_table, name))
    yield Reader("ledger.sqlite", "ledger.sqlite", _ledger)
    yield Reader("stage config", "config.toml",
                 lambda r: resolve_config(ingest.STAGE, "draft", r / "config.toml"))  # fmt: skip
    yield Reader("grmm config", "grmm.toml", lambda r: resolve("demo", r / "grmm.toml"))
    yield Reader("study.json", "study/study.json", _study)
