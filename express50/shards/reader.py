"""Read packed samples in any order from USTAR tar shards in WebDataset's conventions.

A folder of shards holds ``<split>-000000.tar`` ..., ``index.json`` (the place and CRC-32 of every
member) and ``manifest.json`` (the SHA-256 of every file). The members of a sample are adjacent.
Their key has no dot, so that ``tar``, ``webdataset`` and Hugging Face ``datasets`` read the shards
as they are. The writer is in :mod:`express50.shards.writer`.

``meta.json`` of a sample: ids ``subject expression camera``, ``frame``, ``fps``; ``K``,
``cam_from_world``, ``width``, ``height`` of the picture as packed; ``depth_scale_m``; ``head`` and
``track`` {shape offsets registered expression neck jaw eyes R t}, the head model and its
parameters, with world = R @ head + t in the cameras' world (``offsets``: whether
``<subject>.offsets.npy`` beside the shards is to be added to the rest shape; ``registered``:
whether ``<subject>.registered.npz`` has the expression's mesh); ``label`` (who chose the
frame), ``torso`` (removed or kept in alpha), ``parts`` (whether there are labels),
``occluded`` (share of the face that each of hand and apparel hides), ``crop``, ``source_size``
(of the peak frame that was cropped) and, if that was reduced, ``recorded_size``; ``consent``,
``licence``, ``session``.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.contract.segmentation_labels import COLOURS
from express50.errors import FormatError, check_known
from express50.files.arrays import read_arrays, read_npy
from express50.files.text import KEY_LENGTH, no_folder, parse_json, read_json, refusing
from express50.geometry.pixels import contact_sheet
from express50.geometry.shapes import check_finite, check_shape
from express50.shards.codecs import AGAIN, ALPHA, DEPTH, PARTS, RGB, crc32, decode_picture

SCHEMA = "express50.shards/1"
_COPY_AGAIN = f"copy the shards again or {AGAIN}"
MADE_BY = {"parts": "regions", "depth": "depth"}  # stages without which `pack` lacks a member
SUBJECT_FILES = ("offsets.npy", "registered.npz")  # beside the shards, if `track` in meta says so
KEY = re.compile(rf"[A-Za-z0-9_-]{{1,{KEY_LENGTH}}}")
SHARD_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*-[0-9]{6}\.tar")


@dataclass(frozen=True)
class Entry:
    """Locates one sample: its ids, its shard, and (offset, size, crc32) of each member."""

    key: str
    subject: str
    expression: str
    camera: str
    split: str
    shard: str
    members: dict[str, tuple[int, int, int]]


class ShardReader:
    """Gives random access to the samples of a folder of shards; safe to fork and to pickle.

    State: one open file per shard, opened at its first use.
    """

    def __init__(self, root: Path, entries: tuple[Entry, ...] | None = None) -> None:
        """Read the index of ``root``, or use the given part of it.

        Raises:
            FormatError: the index is missing, malformed, or does not fit the shards.
        """
        self.root = Path(root)
        self.entries = read_entries(self.root) if entries is None else entries
        self._files: dict[str, int] = {}
        self._owner = os.getpid()

    def __del__(self) -> None:
        """Close the files that this process opened."""
        if getattr(self, "_owner", None) == os.getpid():
            self.close()

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.entries)

    def __getstate__(self) -> dict:
        """Leave open files out: they stay in the process that opened them."""
        return self.__dict__ | {"_files": {}}

    @property
    def keys(self) -> list[str]:
        """List the keys of all samples, in order."""
        return [entry.key for entry in self.entries]

    def groups(self) -> dict[tuple[str, str], list[int]]:
        """List the sample numbers of every (subject, expression)."""
        table: dict[tuple[str, str], list[int]] = {}
        for number, entry in enumerate(self.entries):
            table.setdefault((entry.subject, entry.expression), []).append(number)
        return table

    def select(
        self,
        subjects: Collection[str] | None = None,
        expressions: Collection[str] | None = None,
        cameras: Collection[str] | None = None,
        split: str | None = None,
    ) -> ShardReader:
        """Return a reader of the samples that match all the given ids; None matches any.

        Raises:
            UnknownNameError: an id or a split is unknown; the error lists the known ones.
        """
        wanted = {"subject": subjects, "expression": expressions, "camera": cameras}
        wanted["split"] = None if split is None else [split]
        chosen = self.entries
        for name, values in wanted.items():
            if values is None:
                continue
            known = {getattr(entry, name) for entry in self.entries}
            check_known(str(self.root), name, sorted(values), sorted(known))
            chosen = tuple(entry for entry in chosen if getattr(entry, name) in values)
        return ShardReader(self.root, chosen)

    def members(self, number: int, names: Collection[str] | None = None) -> dict[str, bytes]:
        """Read the bytes of a sample's members by name, all by default, checked by CRC-32.

        Raises:
            FormatError: the member is missing, or its bytes are damaged.
        """
        entry = self.entries[number]
        if self._owner != os.getpid():  # after a fork, leave the parent's descriptors alone
            self._files, self._owner = {}, os.getpid()
        if entry.shard not in self._files:
            self._files[entry.shard] = os.open(self.root / entry.shard, os.O_RDONLY)
        file, found = self._files[entry.shard], {}
        for name in entry.members if names is None else names:
            offset, size, crc = self._place(entry, name)
            # Reading the whole sample and slicing it would copy twice: a third slower.
            data = os.pread(file, size, offset)
            if len(data) != size or crc32(data) != crc:
                raise FormatError(
                    f"{self.root / entry.shard}: {entry.key}.{name}: damaged, CRC-32"
                    f" {crc32(data):08x}, expected {crc:08x}; {_COPY_AGAIN}"
                )
            found[name] = data
        return found

    def _place(self, entry: Entry, name: str) -> tuple[int, int, int]:
        if name not in entry.members:
            where = f"{self.root / entry.shard}: {entry.key}"
            has, stem = ", ".join(entry.members), name.partition(".")[0]
            fix = AGAIN
            if f"{stem}." in has:  # another profile names it so
                fix = "ask for that"
            elif stem in MADE_BY:
                fix = f"run 'express50 {MADE_BY[stem]}', then 'express50 pack' again"
            raise FormatError(f"{where}: has no {name}, it has {has}; {fix}")
        return entry.members[name]

    def meta(self, number: int) -> dict:
        """Return the sample's meta.json; FormatError if damaged or without ``depth_scale_m``."""
        return self._meta(number, self.members(number, ["meta.json"])["meta.json"])

    def _meta(self, number: int, data: bytes) -> dict:
        entry = self.entries[number]
        where = f"{self.root / entry.shard}: {entry.key}: meta"
        meta = parse_json(data, where, FormatError, AGAIN)
        scale = meta.get("depth_scale_m") if isinstance(meta, dict) else None
        if not isinstance(scale, float) or not 0 < scale < 1:
            raise FormatError(f"{where}: depth_scale_m is {scale!r}, expected metres; {AGAIN}")
        return meta

    def sample(self, number: int) -> dict:
        """Decode one sample.

        Returns:
            key; rgb (H, W, 3) uint8 sRGB; alpha (H, W) float32 in [0, 1]; depth (H, W) float32
            metres, 0 where not valid; valid (H, W) bool; parts (H, W) uint8 of
            ``segmentation_labels.LABELS``, or None if it was packed without; meta dict.

        Raises:
            FormatError: a member is damaged, or its size is not the one in meta.
        """
        entry, members = self.entries[number], self.members(number)
        meta = self._meta(number, members.get("meta.json", b""))
        alpha = self._picture(entry, members, ALPHA, meta)
        steps = self._picture(entry, members, DEPTH, meta)
        return {
            "key": entry.key,
            "rgb": self._picture(entry, members, RGB, meta),
            "alpha": alpha.astype(np.float32) / 255,
            "depth": steps.astype(np.float32) * np.float32(meta["depth_scale_m"]),
            "valid": steps > 0,
            "parts": self._picture(entry, members, PARTS, meta) if meta.get("parts") else None,
            "meta": meta,
        }

    def offsets(self, subject: str) -> np.ndarray:
        """Read the offsets (V, 3) float32, metres, of a subject's rest shape.

        Only subjects whose meta says so have them.

        Raises:
            FormatError: the file is missing, damaged, or holds something else.
        """
        path = subject_file(self.root, subject, "offsets.npy")
        array = read_npy(path, FormatError, "offsets", _COPY_AGAIN)
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype != np.float32:
            raise FormatError(
                f"{path}: {array.dtype} {array.shape}, expected float32 (V, 3); {_COPY_AGAIN}"
            )
        if not np.isfinite(array).all():
            raise FormatError(f"{path}: holds NaN or Inf; {_COPY_AGAIN}")
        return array

    def registered(self, subject: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Read a subject's registered meshes by expression; only those whose meta says so exist.

        A mesh is offsets (V, 3) float32, metres, to add to the rest shape of the track, whose
        joints stay; and the standard deviation (V,) float32, metres, of the vertices along their
        normals.

        Raises:
            FormatError: the file is missing, damaged, or holds something else.
        """
        path = subject_file(self.root, subject, "registered.npz")
        wanted = ("expressions", "offsets", "sigma")
        arrays = read_arrays(path, FormatError, "registered meshes", wanted, _COPY_AGAIN)
        names, offsets, sigma = (arrays[name] for name in wanted)
        with refusing(FormatError, f"{path}: not registered meshes", _COPY_AGAIN):
            check_shape("expressions", names, (None,))
            check_shape("offsets", offsets, (len(names), None, 3))
            check_shape("sigma", sigma, offsets.shape[:2])
            for name, array in (("offsets", offsets), ("sigma", sigma)):
                if array.dtype.kind != "f":
                    raise ValueError(f"{name} is {array.dtype}, expected numbers")
                check_finite(name, array)
        pairs = zip(offsets.astype(np.float32), sigma.astype(np.float32), strict=True)
        return dict(zip(names.tolist(), pairs, strict=True))

    def close(self) -> None:
        """Close the open shards."""
        files, self._files = self._files, {}
        for file in files.values():
            os.close(file)

    def _picture(
        self, entry: Entry, members: dict[str, bytes], names: tuple[str, ...], meta: dict
    ) -> np.ndarray:
        """Decode the picture that is stored under one of several names."""
        name = next((name for name in names if name in members), names[0])
        self._place(entry, name)
        where = f"{self.root / entry.shard}: {entry.key}.{name}"
        width, height = meta.get("width"), meta.get("height")
        if not (isinstance(width, int) and isinstance(height, int) and min(width, height) > 0):
            raise FormatError(f"{where}: meta gives {width!r} x {height!r} pixels; {AGAIN}")
        return decode_picture(name, members[name], width, height, where)


def read_entries(root: Path) -> tuple[Entry, ...]:
    """Read and check ``index.json``.

    Raises:
        FormatError: it is missing or malformed, a shard's name could lead out of the folder, or a
            member lies outside its shard.
    """
    path = root / "index.json"
    if not path.exists():
        what = f"{path}: the index is missing" if root.is_dir() else f"{root}: {no_folder(root)}"
        packed = root / "pack" / "shards"
        place = packed if packed.is_dir() else "DATASET/pack/shards"
        raise FormatError(f"{what}; name the folder that 'pack' wrote, {place}")
    table = read_json(path, FormatError, AGAIN)
    if not isinstance(table, dict) or table.get("schema") != SCHEMA:
        got = table.get("schema") if isinstance(table, dict) else type(table).__name__
        raise FormatError(f"{path}: schema {got!r}, expected {SCHEMA!r}; {AGAIN}")
    entries: list[Entry] = []
    with refusing(FormatError, f"{path}: malformed", AGAIN):
        for shard in table["shards"]:
            entries += _shard_entries(root, shard)
    if len({entry.key for entry in entries}) != len(entries):
        raise FormatError(f"{path}: a key appears twice; {AGAIN}")
    return tuple(entries)


def _shard_entries(root: Path, shard: dict) -> Iterator[Entry]:
    name = str(shard["file"])
    if not SHARD_NAME.fullmatch(name):
        raise FormatError(f"{root}: shard name {name!r}, expected one like train-000000.tar")
    path = root / name
    size = path.stat().st_size if path.is_file() else -1
    if size != shard["bytes"]:
        got = "is missing" if size < 0 else f"has {size:,} bytes"
        raise FormatError(f"{path}: {got}, expected {shard['bytes']:,} bytes; copy the shard again")
    for row in shard["samples"]:
        members = {str(k): (int(a), int(b), int(c)) for k, (a, b, c) in row["members"].items()}
        if any(a < 0 or b < 0 or a + b > size for a, b, _ in members.values()):
            raise FormatError(f"{path}: {row['key']} lies outside the shard; {AGAIN}")
        ids = {name: row[name] for name in ("key", "subject", "expression", "camera")}
        for kind, text in (*ids.items(), ("split", shard["split"])):
            if not KEY.fullmatch(text):  # files are named after them
                raise FormatError(f"{path}: {kind} {text!r}, expected letters, digits, _ and -")
        yield Entry(**ids, split=shard["split"], shard=name, members=members)


def sample_panels(sample: dict) -> list[np.ndarray]:
    """Draw RGB, alpha, depth (near is bright) and labels (black if there are none), uint8."""
    depth, valid = sample["depth"], sample["valid"]
    low, high = np.percentile(depth[valid], [1, 99]) if valid.any() else (0.0, 1.0)
    near = np.clip((high - depth) / max(float(high - low), 1e-6), 0, 1)
    shade = np.where(valid, 55 + 200 * near, 0).astype(np.uint8)
    alpha = (sample["alpha"] * 255).astype(np.uint8)
    parts = np.zeros(valid.shape, np.uint8) if sample["parts"] is None else sample["parts"]
    return [sample["rgb"], alpha, shade, COLOURS[parts]]


def sample_picture(sample: dict) -> np.ndarray:
    """Lay a sample's panels side by side, (H, 3 or 4 W, 3)."""
    panels = sample_panels(sample)[: 3 if sample["parts"] is None else 4]
    return contact_sheet([panels], tile=sample["depth"].shape)


def subject_file(root: Path, subject: str, name: str) -> Path:
    """Return the path of one of a subject's SUBJECT_FILES.

    Raises:
        FormatError: the subject's id has characters that a key may not have.
    """
    if not KEY.fullmatch(subject):
        raise FormatError(f"subject id {subject!r}: expected letters, digits, _ and -")
    return root / f"{subject}.{name}"


def write_offsets(root: Path, subject: str, offsets: np.ndarray) -> None:
    """Write a subject's offsets (V, 3), metres, as float32."""
    path, data = subject_file(root, subject, "offsets.npy"), io.BytesIO()
    np.save(data, offsets.astype(np.float32), allow_pickle=False)
    path.write_bytes(data.getbuffer())  # straight to a file, NumPy does not say why it failed


def write_registered(
    root: Path, subject: str, meshes: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> None:
    """Write a subject's registered meshes by expression, see `ShardReader.registered`.

    They are stored as float16, which rounds moves of up to 15 mm by at most 0.004 mm.
    """
    offsets, sigma = (
        np.stack([mesh[part] for mesh in meshes.values()]).astype(np.float16) for part in (0, 1)
    )
    path = subject_file(root, subject, "registered.npz")
    np.savez(path, expressions=np.array(list(meshes)), offsets=offsets, sigma=sigma)
