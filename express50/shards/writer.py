"""Write, check, split and merge shards.

The same samples give the same bytes, and a group never spans two shards.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from express50.console import count, log
from express50.errors import FormatError
from express50.files.atomic import folder_in_one_step, link_file, write_json
from express50.files.digests import file_sha256
from express50.files.text import KEY_LENGTH, NAME, no_folder, read_json, refusing
from express50.shards.codecs import AGAIN, crc32
from express50.shards.reader import (
    KEY,
    SCHEMA,
    SHARD_NAME,
    SUBJECT_FILES,
    ShardReader,
    read_entries,
    subject_file,
)

BLOCK = tarfile.BLOCKSIZE
RECORD = tarfile.RECORDSIZE


@dataclass(frozen=True)
class PackedSample:
    """Holds one encoded sample: its ids and the bytes of its members by extension (``rgb.jpg``)."""

    subject: str
    expression: str
    camera: str
    members: Mapping[str, bytes]

    @property
    def key(self) -> str:
        """Return the key of the sample in the shards."""
        return sample_key(self.subject, self.expression, self.camera)


def sample_key(subject: str, expression: str, camera: str) -> str:
    """Return a sample's key ``subject_expression_camera``; it has no dot, at which readers split.

    Raises:
        FormatError: an id has other characters than letters, digits, ``_`` and ``-``, or the key
            has over `KEY_LENGTH`.
    """
    for name, value in (("subject", subject), ("expression", expression), ("camera", camera)):
        if not KEY.fullmatch(value):
            raise FormatError(
                f"{name} id {value!r} cannot be part of a key, expected letters, digits, _ and -;"
                " rename it in the capture"
            )
    key = f"{subject}_{expression}_{camera}"
    if not KEY.fullmatch(key):
        raise FormatError(
            f"key {key!r} has {len(key)} characters, expected at most {KEY_LENGTH}; shorten an id"
        )
    return key


class ShardWriter:
    """Writes the shards of one or more splits, then their index and manifest.

    State: the open shard, its running SHA-256, and what was written so far.
    """

    def __init__(self, root: Path, shard_bytes: int) -> None:
        """Write into the empty or absent folder ``root``; a shard is closed at ``shard_bytes``."""
        self.root, self.shard_bytes = Path(root), shard_bytes
        self.root.mkdir(parents=True, exist_ok=True)
        self._shards: list[dict] = []
        self._counts: dict[str, int] = {}
        self._groups: set[tuple[str, str]] = set()
        self._keys: set[str] = set()
        self._file: BinaryIO | None = None
        self._hash = hashlib.sha256()
        self.digests: dict[str, str] = {}  # SHA-256 of every finished shard, for the manifest

    def __del__(self) -> None:
        """Close the shard that an error left unfinished."""
        if file := getattr(self, "_file", None):
            with suppress(OSError):  # a full disk takes none of what is still in its buffer
                file.close()

    def add_group(self, split: str, samples: Sequence[PackedSample]) -> None:
        """Append all samples of one (subject, expression), sorted by camera.

        Raises:
            FormatError: the samples belong to several groups, the group or a key was written
                before, or an id cannot be part of a key.
        """
        groups = {(sample.subject, sample.expression) for sample in samples}
        if len(groups) != 1 or groups & self._groups:
            names = ", ".join(f"{subject}/{expression}" for subject, expression in sorted(groups))
            raise FormatError(
                f"{self.root}: {names}: expected all samples of one expression of a subject, once"
            )
        self._groups |= groups
        size = sum(
            BLOCK + _padded(len(data)) for sample in samples for data in sample.members.values()
        )
        file = self._file
        full = file is not None and file.tell() + size > self.shard_bytes
        if file is None or full or self._shards[-1]["split"] != split:
            self._finish_shard()
            number = self._counts.get(split, 0)
            name = shard_name(split, number)
            self._counts[split] = number + 1
            self._shards.append({"file": name, "split": split, "samples": []})
            file = self._file = (self.root / name).open("xb")  # never over an old shard
        for sample in sorted(samples, key=lambda one: one.camera):
            if sample.key in self._keys:
                raise FormatError(f"key {sample.key} appears twice; rename a subject or expression")
            self._keys.add(sample.key)
            pieces, places, offset = [], {}, file.tell()
            for name, data in sorted(sample.members.items()):
                header = tar_header(f"{sample.key}.{name}", len(data))
                pieces += [header, data, bytes(-len(data) % BLOCK)]
                places[name] = [offset + BLOCK, len(data), crc32(data)]
                offset += BLOCK + _padded(len(data))
            self._write(file, b"".join(pieces))
            ids = ("key", "subject", "expression", "camera")
            row = {name: getattr(sample, name) for name in ids} | {"members": places}
            self._shards[-1]["samples"].append(row)

    def close(self) -> None:
        """Finish the last shard and write ``index.json``."""
        self._finish_shard()
        _write_index(self.root, self._shards)

    def _write(self, file: BinaryIO, data: bytes) -> None:
        """Append to the open shard, and hash the bytes while the processor's cache has them."""
        file.write(data)
        self._hash.update(data)

    def _finish_shard(self) -> None:
        if self._file is None:
            return
        end = self._file.tell() + 2 * BLOCK
        self._write(self._file, bytes(2 * BLOCK + -end % RECORD))
        shard = self._shards[-1]
        shard["bytes"] = self._file.tell()
        self.digests[shard["file"]], self._hash = self._hash.hexdigest(), hashlib.sha256()
        self._file.close()
        self._file = None


def shard_name(split: str, number: int) -> str:
    """Return the name of a split's shard of a number.

    Raises:
        FormatError: the split's name has other characters than letters, digits, ``_`` and ``-``.
    """
    name = f"{split}-{number:06d}.tar"
    if not SHARD_NAME.fullmatch(name):
        raise FormatError(f"split {split!r}: expected letters, digits, _ and -")
    return name


def _write_index(root: Path, shards: Sequence[dict]) -> None:
    index = {"schema": SCHEMA, "shards": shards}
    text = json.dumps(index, separators=(",", ":"), sort_keys=True, allow_nan=False)
    (root / "index.json").write_text(text + "\n", encoding="utf-8")


def tar_header(name: str, size: int) -> bytes:
    """Return the USTAR header (512,) of a file; mode 0644, owner, group and time 0.

    Raises:
        FormatError: the name is not ASCII or does not fit (100 characters, without folders), or
            the size has over 11 octal digits (8 GiB).
    """
    info = tarfile.TarInfo(name)
    info.size = size
    try:
        return info.tobuf(tarfile.USTAR_FORMAT, "ascii", "strict")
    except ValueError:
        limits = "expected at most 100 ASCII characters and 8 GiB"
        raise FormatError(f"{name}: {size} bytes: {limits}") from None


def _padded(size: int) -> int:
    return size + -size % BLOCK


def gather_shards(sources: Sequence[tuple[Path, str]], out: Path) -> dict[str, str]:
    """Link folders of shards, each with its split, into one folder; return SHA-256 by file.

    Shards become hard links if the file system has them, so that no sample is read or stored
    twice. They are renumbered within each split. ``index.json`` is written, cards and manifest are
    not.

    Raises:
        FormatError: a source is damaged or has no manifest.
    """
    shards: list[dict] = []
    digests: dict[str, str] = {}
    for root, split in sources:
        read_entries(root)  # checks what is read below
        known = _manifest_digests(root)
        for shard in read_json(root / "index.json", FormatError)["shards"]:
            name = shard_name(split, sum(row["split"] == split for row in shards))
            shards.append(shard | {"file": name, "split": split})
            if shard["file"] not in known:
                lacks = f"lacks {shard['file']}, which index.json names; {AGAIN}"
                raise FormatError(f"{root / 'manifest.json'}: {lacks}")
            digests[name] = known[shard["file"]]
            link_file(root / shard["file"], out / name)
        for name, digest in known.items():
            if name.endswith(SUBJECT_FILES):
                digests[name] = digest
                link_file(root / name, out / name)
    _write_index(out, shards)
    return digests


def write_manifest(root: Path, digests: Mapping[str, str] | None = None) -> None:
    """Write ``manifest.json``: size and SHA-256 of every file in its folder.

    ``digests`` are the known ones by name; other files are read and hashed.
    """
    files = {}
    for path in sorted(root.iterdir()):
        if path.is_file() and path.name != "manifest.json" and not path.name.startswith("."):
            digest = (digests or {}).get(path.name) or file_sha256(path)
            files[path.name] = {"bytes": path.stat().st_size, "sha256": digest}
    text = json.dumps({"schema": SCHEMA, "files": files}, indent=1, sort_keys=True)
    (root / "manifest.json").write_text(text + "\n", encoding="utf-8")


def verify(root: Path) -> list[str]:
    """List the faults of a folder of shards, one line per fault.

    Checks the SHA-256 of every file in the manifest, the CRC-32 of every member, and that the tar
    headers name the members that the index places there.
    """
    root = Path(root)
    if not root.is_dir():
        return [f"{root}: {no_folder(root)}; name the folder that 'pack' wrote"]
    expected, faults = dict[str, str](), list[str]()
    try:
        expected = _manifest_digests(root)
    except FormatError as error:
        faults.append(str(error))
    for name, digest in sorted(expected.items()):
        if not NAME.fullmatch(name) or not (root / name).is_file():
            faults.append(f"{root / name}: is missing or outside the folder")
        elif file_sha256(root / name) != digest:
            faults.append(f"{root / name}: SHA-256 differs from the manifest's {digest[:12]}...")
    try:
        reader = ShardReader(root)
    except FormatError as error:
        return [*faults, str(error)]
    for number, entry in enumerate(reader.entries):
        for name, (offset, size, _) in entry.members.items():
            path, title = root / entry.shard, f"{entry.key}.{name}"
            try:
                reader.members(number, [name])
                with path.open("rb") as file:
                    file.seek(max(offset - BLOCK, 0))
                    info = tarfile.TarInfo.frombuf(file.read(BLOCK), "ascii", "strict")
            except FormatError as error:
                faults.append(str(error))
            except tarfile.HeaderError as error:
                faults.append(f"{path}: {title}: no tar header in front of it ({error})")
            else:
                if (info.name, info.size) != (title, size):
                    faults.append(
                        f"{path}: the tar names {info.name} with {info.size} bytes where the index"
                        f" has {title} with {size}"
                    )
    return faults


def _manifest_digests(root: Path) -> dict[str, str]:
    """Read a folder's manifest: SHA-256 by file name; FormatError if it is missing or malformed."""
    path = root / "manifest.json"
    if not path.exists():
        raise FormatError(
            f"{path}: the manifest is missing; name the folder of shards (DATASET/pack/shards), "
            f"or {AGAIN}"
        )
    files = read_json(path, FormatError)
    with refusing(FormatError, f"{path}: malformed", AGAIN):
        return {name: str(row["sha256"]) for name, row in files["files"].items()}


def copy_samples(readers: Sequence[ShardReader], out: Path, shard_mb: int) -> int:
    """Write all samples of several readers into the folder `out`; return how many.

    Raises:
        FormatError: there is no sample, a member is damaged, `out` is not empty, two readers hold
            the same (subject, expression), or they hold a subject in different splits or with
            different files.
    """
    out = out.resolve()
    if out.exists() and not out.is_dir():
        raise FormatError(f"{out}: is a file; expected an empty or absent folder")
    if out.exists() and any(out.iterdir()):
        raise FormatError(f"{out}: is not empty; expected an empty or absent folder")
    if not any(len(reader) for reader in readers):
        raise FormatError(f"{readers[0].root}: no sample matches; 'express50 shards ls' lists them")
    splits, samples_in_all = _checked_splits(readers), sum(map(len, readers))
    log(f"{out}: copying {count(samples_in_all, 'sample')}")
    groups = [(reader, *row) for reader in readers for row in reader.groups().items()]
    groups.sort(key=lambda group: splits[group[1][0]])
    names = {s: sorted(k for k, v in splits.items() if v == s) for s in set(splits.values())}
    aside = out.with_name(f".{out.name}.unfinished")
    with folder_in_one_step(aside, out):
        for reader in readers:  # first: they are small, and may contradict each other
            for subject in sorted({entry.subject for entry in reader.entries}):
                _copy_subject_files(reader, subject, aside)
        writer = ShardWriter(aside, shard_mb * 10**6)
        for reader, (subject, expression), numbers in groups:
            samples = [
                PackedSample(subject, expression, reader.entries[n].camera, reader.members(n))
                for n in numbers
            ]
            writer.add_group(splits[subject], samples)
        writer.close()
        write_json(aside / "splits.json", names | {"chosen_by": "the shards these are made of"})
        (aside / "card.md").write_text(_card_of_copies(readers, names), encoding="utf-8")
        write_manifest(aside, writer.digests)
        if out.exists():
            out.rmdir()  # fails if somebody has filled the folder meanwhile
    return samples_in_all


def _card_of_copies(readers: Sequence[ShardReader], splits: Mapping[str, Sequence[str]]) -> str:
    """Describe copied samples as Markdown; the cards of folders that were merged follow."""
    entries = [entry for reader in readers for entry in reader.entries]
    rows: dict[str, Iterable[str]] = {f"{split} subjects": splits[split] for split in splits}
    rows["expressions"] = [entry.expression for entry in entries]
    rows["cameras"] = [entry.camera for entry in entries]
    metas = (reader.meta(number) for reader in readers for number in range(len(reader)))
    stated = ("licence", "consent", "head")
    facts = {tuple(str(meta.get(key) or "not stated") for key in stated) for meta in metas}
    rows |= dict(zip(stated, zip(*facts, strict=True), strict=True))
    lines = ["# Dataset card", "", f"{count(len(entries), 'sample')}", "", "| | |", "|---|---|"]
    lines += [f"| {what} | {', '.join(sorted(set(values)))} |" for what, values in rows.items()]
    if len(readers) > 1:
        lines += ["", "The cards of the folders that were merged:", ""]
        cards = [reader.root / "card.md" for reader in readers]
        lines += [card.read_text("utf-8") if card.is_file() else "(no card)\n" for card in cards]
    return "\n".join([*lines, ""])


def _checked_splits(readers: Sequence[ShardReader]) -> dict[str, str]:
    """Return the split of every subject; FormatError if folders contradict each other."""
    owners: dict[tuple[str, str], ShardReader] = {}
    shapes: dict[str, object] = {}
    for reader in readers:
        for group, (number, *_) in reader.groups().items():
            if owners.setdefault(group, reader) is not reader:
                raise FormatError(
                    f"{reader.root}: {'/'.join(group)} is in {owners[group].root} too, expected in"
                    " one folder; leave it out of one of them with 'express50 shards split', or,"
                    " if it is another person's, rename that capture and pack it again"
                )
            track = reader.meta(number).get("track")
            shape = track.get("shape") if isinstance(track, dict) else None
            if shapes.setdefault(group[0], shape) != shape:  # a track has one for all frames
                raise FormatError(
                    f"{reader.root}: {group[0]} has another shape of the head than in the folders"
                    " before; if it is another person, rename that capture and pack it again,"
                    " otherwise pack this subject in one run"
                )
    splits: dict[str, str] = {}
    for reader in readers:
        for entry in reader.entries:
            if splits.setdefault(entry.subject, entry.split) != entry.split:
                raise FormatError(
                    f"{reader.root}: {entry.subject} is in split {entry.split!r} here and in"
                    f" {splits[entry.subject]!r} elsewhere; pack again with pack.test_subjects set"
                )
    return splits


def _copy_subject_files(reader: ShardReader, subject: str, out: Path) -> None:
    """Copy a subject's files; FormatError if one that samples need is missing, or they differ."""
    for name in SUBJECT_FILES:
        source, target = subject_file(reader.root, subject, name), subject_file(out, subject, name)
        if not source.is_file():
            own = (n for n, entry in enumerate(reader.entries) if entry.subject == subject)
            tracks = (reader.meta(number).get("track") for number in own)
            if any(isinstance(track, dict) and track.get(Path(name).stem) for track in tracks):
                raise FormatError(f"{source}: is missing; copy it again or {AGAIN}")
            continue
        if target.exists() and target.read_bytes() != source.read_bytes():
            raise FormatError(
                f"{source}: differs from the other folder's {target.name}; pack this subject in"
                " one run"
            )
        shutil.copyfile(source, target)
