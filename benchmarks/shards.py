"""Write and read packed samples, beside WebDataset, litdata and MosaicML's MDS.

``python -m benchmarks.shards`` packs 2,000 samples of 512 px whose members are the same bytes for
all four, reads them in order, shuffled and at random as bytes, and decodes ours by profile. All
seconds are of the processor, children's too, the least of three passes; no format is asked to wait
for the disk, and files are in the system's cache. Ours checks a CRC-32 a member when it reads and
writes SHA-256 sums when it packs; the others check nothing. A rival that is not installed is `n/a`
with the reason. The last line printed is one JSON object.
"""

from __future__ import annotations

import importlib
import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from skimage.data import astronaut

from benchmarks.common import make_parser
from express50.geometry.pixels import resize_area
from express50.runner.worker import cap_threads, core_seconds
from express50.shards.codecs import (
    ALPHA,
    DEPTH,
    PARTS,
    PROFILES,
    RGB,
    decode_picture,
    encode_pictures,
)
from express50.shards.reader import ShardReader
from express50.shards.writer import PackedSample, ShardWriter, write_manifest

DISTINCT, CAMERAS, PASSES = 40, 20, 3
SHARD = 256 * 10**6
Members = dict[str, bytes]
Passes = dict[str, Callable[[], Iterator[Members]]]


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = make_parser("shards", __doc__)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--side", type=int, default=512)
    options = parser.parse_args(arguments)
    cap_threads(1)
    kinds = {p: [members(n, options.side, p) for n in range(DISTINCT)] for p in PROFILES}
    result: dict = {"samples": options.samples, "side": options.side}
    result["bytes_per_sample"] = {
        profile: round(np.mean([sum(map(len, one.values())) for one in some]))
        for profile, some in kinds.items()
    }
    rates = {profile: decode_rate(some, options.side) for profile, some in kinds.items()}
    plain = opencv_rate(png_of_fast(options.side))
    result["decode_per_s_per_core"] = rates | {"opencv, the JPEG of fast and PNG": plain}
    result["decode_fast_to_opencv"] = round(rates["fast"] / plain, 2)
    given = [kinds["fast"][n % DISTINCT] for n in range(options.samples)]
    with tempfile.TemporaryDirectory() as scratch:
        formats = {
            name: measured(run, given, Path(scratch) / name) for name, run in FORMATS.items()
        }
    print(json.dumps(result | {"formats": formats} | summary(formats)))
    return 0


def summary(formats: dict[str, dict]) -> dict:
    """Return our figures, and their ratios to the best rival's."""
    ours, figures = formats["express50"], {}
    rivals = [row for name, row in formats.items() if name != "express50" and "why" not in row]
    for name in ("pack", "read_sequential", "read_shuffled", "read_random"):
        key = f"{name}_per_s"
        best = max((row[key] for row in rivals if row.get(key)), default=None)
        figures[key] = ours[key]
        figures[f"ratio_{name}"] = round(ours[key] / best, 2) if best else None
    figures["random_access_ms"] = round(1e3 / ours["read_random_per_s"], 4)
    figures["rivals"] = len(rivals)
    return figures


def members(number: int, side: int, profile: str) -> Members:
    """Make a sample: a photograph's crop, a soft matte with strands, a ball's depth with noise."""
    rng = np.random.default_rng(number)
    y, x = rng.integers(0, 128, 2)
    rgb = resize_area(np.ascontiguousarray(astronaut()[y : y + 384, x : x + 384]), side, side)
    v, u = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    wave = 0.03 * np.sin(40 * np.arctan2(v, u) + rng.uniform(0, 6))
    radius = np.hypot(u, v) + wave
    alpha = np.clip((0.72 - radius) * 30, 0, 1)
    depth = 1.2 - 0.1 * np.sqrt(np.maximum(0.6 - u**2 - v**2, 0)) + rng.normal(0, 2e-4, u.shape)
    steps = np.where(alpha > 0.5, np.rint(depth / 5e-5), 0).astype(np.uint16)
    parts = np.where(alpha > 0.5, np.digitize(v, [-0.5, 0.1, 0.4]) + 1, 0).astype(np.uint8)
    found = encode_pictures(rgb, np.rint(255 * alpha).astype(np.uint8), steps, parts, profile)
    K = [[900.0, 0, side / 2], [0, 900.0, side / 2], [0, 0, 1]]
    meta = {"K": K, "width": side, "height": side, "parts": True, "depth_scale_m": 5e-5,
            "track": {"shape": rng.normal(size=200).tolist()}}  # fmt: skip
    return found | {"meta.json": json.dumps(meta).encode()}


def png_of_fast(side: int) -> list[Members]:
    """Return the same samples, of the same JPEG quality, with PNG beside it."""
    found = []
    for number in range(DISTINCT):
        rest = members(number, side, "compact")
        del rest["rgb.jpg"]
        found.append(rest | {"rgb.jpg": members(number, side, "fast")["rgb.jpg"]})
    return found


def decode_rate(some: list[Members], side: int) -> float:
    """Measure the samples per second that one core decodes."""

    def decode() -> None:
        for one in some:
            for names in (RGB, ALPHA, PARTS, DEPTH):
                name = next(name for name in names if name in one)
                decode_picture(name, one[name], side, side, name)
            json.loads(one["meta.json"])

    return round(len(some) / least(decode), 1)


def opencv_rate(some: list[Members]) -> float:
    """Measure the same by OpenCV's decoder alone."""

    def decode() -> None:
        for one in some:
            for name, data in one.items():
                if name != "meta.json":
                    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
                    if image.ndim == 3:
                        cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            json.loads(one["meta.json"])

    return round(len(some) / least(decode), 1)


def least(work: Callable[[], object]) -> float:
    """Return the fewest processor seconds of a few passes."""
    spent = []
    for _ in range(PASSES):
        began = core_seconds()
        work()
        spent.append(core_seconds() - began)
    return min(spent)


def measured(
    run: Callable[[list[Members], Path], Callable[[], Passes]], given: list[Members], folder: Path
) -> dict:
    """Return rates of one format; `why` where it cannot run here."""
    try:
        spent = []
        for _ in range(PASSES):
            shutil.rmtree(folder, ignore_errors=True)
            began = core_seconds()
            opening = run(given, folder)
            spent.append(core_seconds() - began)
        passes = opening()
    except (ImportError, OSError, RuntimeError, AttributeError) as error:
        return {"why": f"n/a: {type(error).__name__}: {error}"[:200]}
    row = {"pack_per_s": round(len(given) / min(spent))}
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    row["bytes_per_sample"] = round(total / len(given))
    expected = {one["rgb.jpg"] for one in given}
    for name, one_pass in passes.items():
        got = [sample["rgb.jpg"] for sample in one_pass()]
        if len(got) != len(given) or not set(got) <= expected:
            return {"why": f"n/a: {name} gave {len(got)} samples, expected {len(given)}"}
        seconds = least(partial(exhaust, one_pass))
        row[f"{name}_per_s"] = round(len(given) / seconds)
    return row


def exhaust(one_pass: Callable[[], Iterator[Members]]) -> None:
    """Take every sample of a pass."""
    for _ in one_pass():
        pass


def order(count: int) -> list[int]:
    """Draw random sample numbers."""
    return random.Random(0).choices(range(count), k=count)


def ours(given: list[Members], folder: Path) -> Callable[[], Passes]:
    """Write our tar with its index; return its passes."""
    writer = ShardWriter(folder, SHARD)
    for first in range(0, len(given), CAMERAS):
        group = given[first : first + CAMERAS]
        writer.add_group("train", [PackedSample("S001", f"e{first:05d}", f"c{k:02d}", one)
                                   for k, one in enumerate(group)])  # fmt: skip
    writer.close()
    write_manifest(folder, writer.digests)

    def passes() -> Passes:
        reader = ShardReader(folder)

        def read(numbers) -> Iterator[Members]:  # noqa: ANN001
            return (reader.members(int(n)) for n in numbers)

        return {
            "read_sequential": lambda: read(range(len(reader))),
            "read_shuffled": lambda: read(np.random.default_rng(0).permutation(len(reader))),
            "read_random": lambda: read(order(len(reader))),
        }

    return passes


def webdataset(given: list[Members], folder: Path) -> Callable[[], Passes]:
    """Write WebDataset: a tar read in a stream, shuffled in a buffer, as its users do."""
    wds = importlib.import_module("webdataset")
    folder.mkdir()
    pattern = str(folder / "train-%06d.tar")
    with wds.ShardWriter(pattern, maxsize=SHARD, verbose=0) as sink:
        for number, one in enumerate(given):
            sink.write({"__key__": f"s{number:06d}"} | one)
    urls = sorted(str(path) for path in folder.glob("*.tar"))

    def passes() -> Passes:
        plain = wds.WebDataset(urls, shardshuffle=False)
        mixed = wds.WebDataset(urls, shardshuffle=len(urls)).shuffle(500)
        return {"read_sequential": lambda: iter(plain), "read_shuffled": lambda: iter(mixed)}

    return passes


def litdata(given: list[Members], folder: Path) -> Callable[[], Passes]:
    """Write litdata's chunks."""
    lit = importlib.import_module("litdata")
    inputs = list(range(len(given)))
    _Given.samples = given
    lit.optimize(_given, inputs, str(folder), num_workers=1, chunk_bytes=64 * 10**6, verbose=False,
                 start_method="fork")  # fmt: skip

    def passes() -> Passes:
        plain = lit.StreamingDataset(str(folder), shuffle=False)
        mixed = lit.StreamingDataset(str(folder), shuffle=True)
        return {
            "read_sequential": lambda: iter(plain),
            "read_shuffled": lambda: iter(mixed),
            "read_random": lambda: (plain[n] for n in order(len(plain))),
        }

    return passes


class _Given:
    """What litdata's worker writes: it takes a function that finds its data itself."""

    samples: list[Members] = []


def _given(number: int) -> Members:
    return _Given.samples[number]


def mosaic(given: list[Members], folder: Path) -> Callable[[], Passes]:
    """Write MosaicML's MDS."""
    streaming = importlib.import_module("streaming")
    columns = dict.fromkeys(given[0], "bytes")
    with streaming.MDSWriter(out=str(folder), columns=columns) as writer:
        for one in given:
            writer.write(one)

    def passes() -> Passes:
        local = importlib.import_module("streaming.base").LocalDataset(str(folder))
        mixed = random.Random(0).sample(range(len(given)), len(given))
        return {
            "read_sequential": lambda: (local[n] for n in range(len(given))),
            "read_shuffled": lambda: (local[n] for n in mixed),
            "read_random": lambda: (local[n] for n in order(len(given))),
        }

    return passes


FORMATS = {"express50": ours, "webdataset": webdataset, "litdata": litdata, "streaming": mosaic}


if __name__ == "__main__":
    os.environ.setdefault("WDS_VERBOSE_CACHE", "0")
    sys.exit(main())
