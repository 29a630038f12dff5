"""Shards split and merged: the same samples to the byte, and nothing half-written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from express50.__main__ import main
from express50.errors import FormatError, UnknownNameError
from express50.shards.reader import ShardReader
from express50.shards.writer import ShardWriter, copy_samples, verify, write_manifest
from tests.express50.shards.test_shards import make_sample, write


def content(root: Path) -> dict[str, dict[str, bytes]]:
    reader = ShardReader(root)
    return {entry.key: reader.members(n) for n, entry in enumerate(reader.entries)}


def test_a_split_folder_merges_to_the_same_samples(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    whole = write(tmp_path / "whole")
    parts = [tmp_path / "train", tmp_path / "test"]
    for part in parts:
        assert main(["shards", "split", str(whole), str(part), "--split", part.name]) == 0
        assert verify(part) == []
    assert main(["shards", "merge", *map(str, parts), str(tmp_path / "again")]) == 0
    again, said = tmp_path / "again", capsys.readouterr().err
    assert f"{parts[1]}: copying 6 samples\n" in said and f"{again}: copying 18 samples\n" in said
    assert verify(again) == [] and content(again) == content(whole)
    cards = [(folder / "card.md").read_text() for folder in (*parts, again)]
    assert "| train subjects | S001, S002 |" in cards[0] and "S003" not in cards[0]
    assert "\n6 samples\n" in cards[1] and "S001" not in cards[1]
    assert "\n18 samples\n" in cards[2] and cards[2].endswith(cards[0] + "\n" + cards[1] + "\n")
    splits = json.loads((again / "splits.json").read_text())
    assert splits["train"] == ["S001", "S002"] and splits["test"] == ["S003"]
    assert [e.split for e in ShardReader(again).entries].count("test") == 6


def test_parts_are_chosen_by_ids(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole")
    chosen = ShardReader(whole).select(["S002"], ["neutral"], ["cam00", "cam02"])
    count = copy_samples([chosen], tmp_path / "some", 1)
    assert count == 2 and set(content(tmp_path / "some")) == {
        "S002_neutral_cam00", "S002_neutral_cam02",
    }  # fmt: skip
    with pytest.raises(UnknownNameError, match="S009"):
        ShardReader(whole).select(["S009"])


def test_twice_the_same_people_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole")
    with pytest.raises(FormatError, match="S001/neutral is in"):
        copy_samples([ShardReader(whole), ShardReader(whole)], tmp_path / "out", 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["whole"]


def test_a_subject_in_two_splits_is_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole")
    writer = ShardWriter(tmp_path / "other", 10**6)
    writer.add_group("test", [make_sample("S001", "smile", "cam00", 0)])
    writer.close()
    write_manifest(tmp_path / "other")
    with pytest.raises(FormatError, match="S001 is in split 'test' here and in 'train'"):
        copy_samples([ShardReader(whole), ShardReader(tmp_path / "other")], tmp_path / "out", 1)


def test_two_people_with_one_id_are_refused(tmp_path: Path) -> None:
    readers = []
    for expression, shape in (("smile", [0.5, -1.0]), ("pout", [0.5, -1.5])):
        sample = make_sample("S001", expression, "cam00", 0)
        meta = json.loads(sample.members["meta.json"]) | {"track": {"shape": shape}}
        members = {**sample.members, "meta.json": json.dumps(meta).encode()}
        writer = ShardWriter(tmp_path / expression, 10**6)
        writer.add_group("train", [replace(sample, members=members)])
        writer.close()
        readers.append(ShardReader(tmp_path / expression))
    with pytest.raises(FormatError, match="pout: S001 has another shape of the head"):
        copy_samples(readers, tmp_path / "out", 1)


def test_a_damaged_member_and_a_full_folder_are_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(FormatError, match="not empty"):
        copy_samples([ShardReader(whole)], tmp_path / "full", 1)
    entry = ShardReader(whole).entries[0]
    shard = whole / entry.shard
    data = bytearray(shard.read_bytes())
    data[entry.members["rgb.jpg"][0] + 9] ^= 255
    shard.write_bytes(bytes(data))
    with pytest.raises(FormatError, match="damaged"):
        copy_samples([ShardReader(whole)], tmp_path / "out", 1)
    assert not (tmp_path / "out").exists()


def test_odd_places_to_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = write(tmp_path / "whole")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert copy_samples([ShardReader(whole).select(split="test")], Path(), 1) == 6
    assert verify(tmp_path / "here") == []
    (tmp_path / "file").touch()
    with pytest.raises(FormatError, match="is a file"):
        copy_samples([ShardReader(whole)], tmp_path / "file", 1)
