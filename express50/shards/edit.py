"""Split and merge shards: samples are copied as they are, never decoded."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Sequence
from pathlib import Path

from express50.errors import FormatError
from express50.files.atomic import sync_directory, sync_tree, write_json
from express50.shards.reader import ShardReader, offsets_file
from express50.shards.writer import PackedSample, ShardWriter, write_manifest


def split_shards(
    root: Path,
    out: Path,
    shard_mb: int,
    subjects: Collection[str] | None = None,
    expressions: Collection[str] | None = None,
    cameras: Collection[str] | None = None,
    split: str | None = None,
) -> int:
    """Write the samples of `root` that match into `out`; returns how many.

    Raises:
        FormatError: an id is unknown, nothing matches, a member is damaged, or `out` is not empty.
    """
    reader = ShardReader(root).select(subjects, expressions, cameras, split)
    return _write([reader], out, shard_mb)


def merge_shards(roots: Sequence[Path], out: Path, shard_mb: int) -> int:
    """Write all samples of several folders into `out`; returns how many.

    Raises:
        FormatError: two folders hold the same (subject, expression), or hold a subject in different
            splits or with different offsets; or as `split_shards`.
    """
    return _write([ShardReader(root) for root in roots], out, shard_mb)


def _write(readers: Sequence[ShardReader], out: Path, shard_mb: int) -> int:
    out = out.resolve()
    if out.exists() and not out.is_dir():
        raise FormatError(f"{out}: is a file; expected an empty or absent folder")
    if out.exists() and any(out.iterdir()):
        raise FormatError(f"{out}: is not empty; expected an empty or absent folder")
    if shard_mb < 1:
        raise FormatError(f"--shard-mb is {shard_mb}, expected at least 1")
    if not any(len(reader) for reader in readers):
        raise FormatError(f"{readers[0].root}: no sample matches; 'express50 shards ls' lists them")
    splits = _checked_splits(readers)
    aside = out.with_name(f".{out.name}.unfinished")
    shutil.rmtree(aside, ignore_errors=True)
    writer = ShardWriter(aside, shard_mb * 10**6)
    try:
        for split in sorted(set(splits.values())):
            for reader in readers:
                _copy_split(reader, writer, split)
        writer.close()
        _copy_offsets(readers, aside)
        names = {s: sorted(k for k, v in splits.items() if v == s) for s in set(splits.values())}
        write_json(aside / "splits.json", names | {"chosen_by": "the shards these are made of"})
        _write_card(readers, aside)
        write_manifest(aside, writer.digests)
        sync_tree(aside)
        if out.exists():
            out.rmdir()
        aside.rename(out)
        sync_directory(out.parent)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        for reader in readers:
            reader.close()
    return sum(len(reader) for reader in readers)


def _checked_splits(readers: Sequence[ShardReader]) -> dict[str, str]:
    """Return the split of every subject.

    Raises:
        FormatError: two folders hold the same group, or a subject is in two splits.
    """
    owners: dict[tuple[str, str], ShardReader] = {}
    for reader in readers:
        for group in reader.groups():
            if owners.setdefault(group, reader) is not reader:
                raise FormatError(
                    f"{reader.root}: {'/'.join(group)} is in {owners[group].root} too; split one of"
                    " them so that each expression of a subject is in one folder"
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


def _copy_split(reader: ShardReader, writer: ShardWriter, split: str) -> None:
    for (subject, expression), numbers in reader.groups().items():
        samples = [
            PackedSample(subject, expression, reader.entries[n].camera, reader.members(n))
            for n in numbers
            if reader.entries[n].split == split
        ]
        if samples:
            writer.add_group(split, samples)


def _copy_offsets(readers: Sequence[ShardReader], out: Path) -> None:
    for reader in readers:
        for subject in sorted({entry.subject for entry in reader.entries}):
            source, target = offsets_file(reader.root, subject), offsets_file(out, subject)
            if not source.is_file():
                first = next(n for n, one in enumerate(reader.entries) if one.subject == subject)
                track = reader.meta(first).get("track")
                if isinstance(track, dict) and track.get("offsets"):
                    reader.offsets(subject)  # raises, as its samples need them
                continue
            if target.exists() and target.read_bytes() != source.read_bytes():
                raise FormatError(
                    f"{source}: differs from the other folder's offsets of {subject}; pack this"
                    " subject in one run"
                )
            shutil.copyfile(source, target)


def _write_card(readers: Sequence[ShardReader], out: Path) -> None:
    """Write the sources' cards one after the other: consent and licence stay as they were."""
    parts = []
    for reader in readers:
        card = reader.root / "card.md"
        parts.append(card.read_text(encoding="utf-8") if card.is_file() else "(no card)\n")
    count = len({entry.key for reader in readers for entry in reader.entries})
    folders = f"{len(readers)} folder{'s' if len(readers) > 1 else ''}"
    text = f"# {count} samples of {folders} of shards\n\nTheir cards, as they were:\n\n"
    (out / "card.md").write_text(text + "\n".join(parts), encoding="utf-8")
