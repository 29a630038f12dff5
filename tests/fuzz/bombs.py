"""Files made to exhaust memory or time, to run code, or to lead out of a folder."""

from __future__ import annotations

import io
import json
import os
import pickle
import sqlite3
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import torch

from annotations.exchange import read_table
from express50.capture.frames import read_peaks
from express50.capture.index import read_index
from express50.capture.raw import read_capture_toml
from express50.capture.readers.read import read_any
from express50.contract.layout import Dataset
from express50.dataset.id_search import files_naming
from express50.dataset.tracks import read_track
from express50.errors import FormatError, HeadModelError
from express50.files.calibration import read_cameras
from express50.files.checkpoints import read_weights
from express50.files.containers import member_bytes, open_hdf5, read_array, read_picture
from express50.files.images import decode_image, encode_jpeg, read_image
from express50.files.pickles import read_object_array, read_pickle
from express50.files.video import iterate_video
from express50.head.ict import read_obj
from express50.head.pickled_arrays import to_array
from express50.rigs.read import read_rig
from express50.runner.ledger import Ledger
from express50.shards.codecs import decode_picture
from express50.shards.reader import read_entries
from tests.fuzz.checkpoints import checkpoint_bombs

Case = tuple[str, Callable[[], object]]


def bombs(root: Path) -> Iterator[Case]:
    """Name and reading of every such file, written below a folder that holds the seeds."""
    (root / "bombs").mkdir()
    parts = (_pictures, _arrays, _pickles, checkpoint_bombs, _texts, _containers, _names)
    for part in parts:
        yield from part(root, root / "bombs")


def _put(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(999)))


def _pictures(root: Path, out: Path) -> Iterator[Case]:
    for name, size in (("over the limit", (60_000, 60_000)), ("under it", (14_000, 14_000))):
        file = _put(out / f"{size[0]}.png", _png(*size))
        yield f"PNG {name}", lambda f=file: read_image(f)
        yield f"PNG bytes {name}", lambda f=file: decode_image(f.read_bytes())
        yield f"PNG frame {name}", lambda f=file: read_picture(f.parent, f.name)
    jpeg = encode_jpeg(np.zeros((8, 8, 3), np.uint8))
    frame = jpeg.index(b"\xff\xc0")
    wide = jpeg[: frame + 5] + struct.pack(">HH", 65_500, 65_500) + jpeg[frame + 9 :]
    # A small header for who goes by lengths, a large one for who looks for the next marker.
    hidden = b"\xff\x01\x00\x13" + wide[frame : frame + 19]
    for name, data in (("huge", wide), ("with two headers", jpeg[:frame] + hidden + jpeg[frame:])):
        file = _put(out / f"{len(data)}.jpg", data)
        yield f"JPEG bytes {name}", lambda d=data: decode_image(d)
        yield f"JPEG frame {name}", lambda f=file: read_picture(f.parent, f.name + "!")
    yield "JPEG huge", lambda: read_image(_put(out / "wide.jpg", wide))
    exr = (root / "a.exr").read_bytes()
    at = exr.index(b"dataWindow\0box2i\0") + 21
    for side in (13_000, 2_000_000_000):
        window = exr[:at] + struct.pack("<4i", 0, 0, side, side) + exr[at + 16 :]
        yield f"EXR {side}", lambda w=window: read_image(_put(out / "w.exr", w))
    tiff = (root / "a.tif").read_bytes()
    directory = struct.unpack_from("<I", tiff, 4)[0]
    for tag, where in ((256, "width"), (257, "height")):
        entry = next(i for i in range(directory + 2, len(tiff), 12)
                     if struct.unpack_from("<H", tiff, i)[0] == tag)  # fmt: skip
        huge = tiff[:entry] + struct.pack("<HHII", tag, 4, 1, 2**31 - 9) + tiff[entry + 12 :]
        yield f"TIFF {where}", lambda h=huge: read_image(_put(out / "w.tif", h))
    depth = imagecodecs.lerc_encode(np.zeros((900, 900), np.uint16), level=0)
    yield (
        "LERC of many bands",
        lambda: decode_picture("depth.lerc", bytes(depth) * 3000, 900, 900, "a"),
    )
    zeros = bytes(imagecodecs.zstd_encode(bytes(1 << 28), level=1))
    yield "zstd of zeros", lambda: decode_picture("alpha.zst", zeros, 48, 48, "a")


def _npy(shape: str, kind: str = "<f8") -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def _zip(path: Path, name: str, data: bytes, claim: int | None = None) -> Path:
    """A zip of one member, which may claim another size."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    if claim is not None:
        whole = bytearray(path.read_bytes())
        struct.pack_into("<I", whole, whole.index(b"PK\x01\x02") + 24, claim)
        path.write_bytes(whole)
    return path


def _arrays(root: Path, out: Path) -> Iterator[Case]:
    for n, shape in enumerate(("(1099511627776, 64)", "(-1, 5)", "(4294967296,) * 2", "(2**70,)")):
        file = _zip(out / f"{n}.npz", "vertices.npy", _npy(shape))
        yield f"npz {shape}", lambda f=file: read_track(f)
    objects = _zip(out / "o.npz", "vertices.npy", _npy("(9,)", "|O") + pickle.dumps([1]))
    yield "npz of objects", lambda: read_track(objects)
    claims = _zip(out / "c.npz", "vertices.npy", _npy("(1,)") + bytes(8), 0xFFFFFFF0)
    yield "npz that claims 4 GiB", lambda: read_track(claims)
    long = _put(out / "l.npy", _npy("(" + "1," * 30_000 + ")"))
    yield "npy with a long header", lambda: read_object_array(long)
    yield "OBJ of a far vertex", lambda: read_obj(_put(out / "a.obj", b"v 1 2 3\nf 1 1 999999\n"))


def _pickles(root: Path, out: Path) -> Iterator[Case]:
    mark = out / "executed"
    call = f"cposix\nsystem\n(S'touch {mark}'\ntR.".encode()
    doubled = b"]q\x00" + b"".join(
        b"]" + bytes([0x71, n + 1]) + b"(h" + bytes([n]) + b"h" + bytes([n]) + b"e"
        for n in range(60)
    )
    stride = (
        b"ctorch._utils\n_rebuild_tensor_v2\n(ctorch.storage\n_load_from_bytes\n(B\x00\x00\x00\x00"
        b"tRI0\n(I1099511627776\nt(I0\nttR."
    )
    files = {
        "calls the shell": call,
        "a table of 2^31 entries": b"\x80\x02Nr\xff\xff\xff\x7f.",
        "bytes that are not there": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b".",
        "a frame that is not there": b"\x80\x04\x95" + struct.pack("<Q", 1 << 60) + b".",
        "text that is not there": b"\x80\x04\x8d" + struct.pack("<Q", 1 << 62) + b".",
        "evaluates": b"cbuiltins\neval\n(S'1'\ntR.",
        "an array made by a call": b"cnumpy\nndarray\n((I99999999999\ntS'f8'\ntR.",
        "a view of one number": stride,
        "nested": b"]" * 99_999 + b"a" * 99_998 + b".",
    }
    for name, data in files.items():
        file = _put(out / f"{len(name)}.pkl", data)
        yield f"pickle: {name}", lambda f=file: to_array(read_pickle(f), "a", "a")
    lists = _put(out / "lists.pkl", doubled + b".")
    yield "pickle: lists in lists", lambda: to_array(read_pickle(lists), "a", "a")
    array = _put(out / "a.npy", _npy("()", "|O") + call)
    yield "npy that calls the shell", lambda: read_object_array(array)
    content = io.BytesIO()
    torch.save({"a": torch.zeros(3)}, content)
    with zipfile.ZipFile(content) as source, zipfile.ZipFile(out / "c.pt", "w") as made:
        for name in source.namelist():
            made.writestr(name, call if name.endswith("data.pkl") else source.read(name))
    legacy = _put(out / "legacy.pt", call)
    packed = _zip(out / "p.pt", "archive/data.pkl", bytes(100), 0xFFFFFFF0)
    for file in (out / "c.pt", legacy, packed):
        yield f"weights {file.name}", lambda f=file: read_weights(f, HeadModelError, str(f), "w")


def _texts(root: Path, out: Path) -> Iterator[Case]:
    rigs = {
        "nested": "[" * 200_000, "long number": '{"a": ' + "9" * 5000 + "}",
        "key twice": '{"a": {}, "a": {}}', "NaN": '{"world_to_camera": NaN}', "a list": "[1]",
        "infinite": '{"world_to_camera": 1e999}', "no text": "\udcff",
    }  # fmt: skip
    for name, text in rigs.items():
        file = _put(out / f"{len(text)}.json", text.encode(errors="surrogateescape"))
        yield f"JSON {name}", lambda f=file: read_cameras(f)
        yield f"labels {name}", lambda f=file: read_table(f)
    tables = {"nested": "a = " + "[" * 100_000, "dotted": "a" + ".a" * 20_000 + " = 1",
              "nan": "fps = nan", "long number": "a = " + "9" * 5000}  # fmt: skip
    for name, text in tables.items():
        file = _put(out / f"{len(text)}.toml", text.encode())
        yield f"TOML {name}", lambda f=file: read_capture_toml(f)
    matrix = "%YAML:1.0\n---\nimage_width: 9\nimage_height: 9\nK: !!opencv-matrix\n   rows: {0}\n"
    matrix += "   cols: {0}\n   dt: d\n   data: [ 1. ]\n"
    yamls = {
        "matrix": matrix.format(60_000), "flow": "%YAML:1.0\n---\na: " + "[" * 200_000,
        "dashes": "%YAML:1.0\n---\na:\n" + "- " * 200_000, "XML": '<?xml version="1.0"?><a/>',
    }  # fmt: skip
    for name, text in yamls.items():
        file = _put(out / f"{len(text)}.yml", text.encode())
        yield f"YAML {name}", lambda f=file: read_rig(f)
    for kind in ("cameras", "images"):
        folder = out / f"colmap_{kind}"
        folder.mkdir()
        for name in ("cameras", "images"):
            _put(folder / f"{name}.bin", (root / f"binary/{name}.bin").read_bytes())
        data = (folder / f"{kind}.bin").read_bytes()
        _put(folder / f"{kind}.bin", struct.pack("<Q", 1 << 60) + data[8:])
        yield f"COLMAP {kind}", lambda f=folder: read_rig(f)


def _containers(root: Path, out: Path) -> Iterator[Case]:
    video = root / "a.mp4"
    playlists = {
        "HLS": f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{video}\n#EXT-X-ENDLIST\n",
        "concat": f"ffconcat version 1.0\nfile {os.path.relpath(video, out)}\n",
        "SDP": "v=0\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    }
    for name, text in playlists.items():
        file = _put(out / f"{name}.mp4", text.encode())
        yield f"playlist {name}", lambda f=file: list(iterate_video(f))
    boxes = struct.pack(">I4s", 8, b"ftyp") + struct.pack(">I4s", 8, b"free") * 1_100_000
    yield "MP4 of a million boxes", lambda: list(iterate_video(_put(out / "b.mp4", boxes)))
    smc = out / "0026_e0.smc"
    with h5py.File(smc, "w") as file:
        file.create_dataset("huge", (1 << 40,), np.uint8, chunks=(1 << 20,))
        file.create_dataset("packed", (1 << 29,), np.uint8, chunks=(1 << 20,), compression="gzip")
        file["soft"] = h5py.SoftLink("/huge")
        file["external"] = h5py.ExternalLink(str(root / "raw/0026/0026_e0_raw.smc"), "/Camera")
    for name in ("huge", "packed", "soft", "external"):
        yield f"HDF5 {name}", lambda n=name: read_array(open_hdf5(smc), n, "a")
    archive = _zip(out / "c.zip", "cam/1.avif", bytes(100), 0xFFFFFFF0)
    yield "zip that claims 4 GiB", lambda: member_bytes(archive, "cam/1.avif")
    with tarfile.open(out / "sparse.tar", "w") as tar:
        info = tarfile.TarInfo("a.json")
        info.size, info.pax_headers = (
            10,
            {"GNU.sparse.map": "0,10", "GNU.sparse.size": str(1 << 50)},
        )
        tar.addfile(info, io.BytesIO(bytes(10)))
    yield "sparse tar", lambda: _named(out)
    program = (
        "CREATE VIEW receipts AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    )
    for name, text in {
        "endless view": f"{program} SELECT i FROM n",
        "trigger": "CREATE TABLE digests (path); CREATE TRIGGER t AFTER INSERT ON digests BEGIN "
        "DELETE FROM digests; END",
        "other tables": "CREATE TABLE people (name)",
    }.items():
        file = out / f"{name}.sqlite"
        with sqlite3.connect(file) as database:
            database.executescript(text)
        database.close()
        yield f"ledger with {name}", lambda f=file: Ledger(f).read("a")


def _named(folder: Path) -> None:
    """What names nobody is read to its end, quickly."""
    if list(files_naming(folder, "nobody-has-this-name")):
        raise AssertionError("a subject that is not there was found")
    raise FormatError("read to its end")


def _names(root: Path, out: Path) -> Iterator[Case]:
    os.mkfifo(out / "pipe.json")
    (out / "zero.json").symlink_to("/dev/zero")
    (out / "folder.json").mkdir()
    for name in ("pipe", "zero", "folder", "absent"):
        yield f"calibration: {name}", lambda n=name: read_cameras(out / f"{n}.json")
        yield f"labels: {name}", lambda n=name: read_table(out / f"{n}.json")
    (root / "S001/frames").symlink_to("/etc")
    for name in (
        "/etc/passwd",
        "../a.png",
        "a/../../a.png",
        "frames/passwd",
        "a\0.png",
        "x" * 9999,
    ):
        yield f"picture {name[:20]!r}", lambda n=name: read_picture(root / "S001", n)
    rig = json.loads((root / "S001/calibration.json").read_text())
    yield (
        "camera that climbs",
        lambda: read_cameras(
            _put(out / "climbs.json", json.dumps({"../../x": rig["cam00"]}).encode())
        ),
    )
    table = json.loads((root / "avatar/transforms.json").read_text())
    table["frames"][0]["file_path"] = "../../../etc/passwd"
    (out / "avatar").mkdir()
    _put(out / "avatar/transforms.json", json.dumps(table).encode())
    yield "transforms that climb", lambda: read_any(out / "avatar")
    row = json.loads((root / "labels.json").read_text())[0] | {"subject": "../../x"}
    labels = _put(out / "climb.json", json.dumps([row]).encode())
    yield "labels that climb", lambda: read_table(labels)
    index = json.loads((root / "shards/index.json").read_text())
    index["shards"][0]["samples"][0]["expression"] = "../x"
    (out / "shards").mkdir()
    for file in (root / "shards").iterdir():
        (out / "shards" / file.name).symlink_to(file)
    (out / "shards/index.json").unlink()
    _put(out / "shards/index.json", json.dumps(index).encode())
    yield "shards that climb", lambda: read_entries(out / "shards")
    dataset = Dataset(root / "data")
    yield "subject that climbs", lambda: _edited(dataset.captures_file, "S001", dataset.captures)
    camera = dataset.root / "ingest/S001/index.json"
    yield "index that climbs", lambda: _edited(camera, "cam00", lambda: read_index(dataset, "S001"))
    peaks = dataset.root / "align/S001/peaks.json"
    yield "peaks that climb", lambda: _edited(peaks, "neutral", lambda: read_peaks(dataset, "S001"))


def _edited(path: Path, word: str, read: Callable[[], object]) -> object:
    """Reading with one id in a file replaced by one that leads elsewhere."""
    path.write_text(path.read_text().replace(f'"{word}"', '"../../../x"', 1))
    return read()
