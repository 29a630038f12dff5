"""Places in a dataset folder."""

from pathlib import Path

import pytest

from express50.__main__ import main
from express50.contract.layout import Dataset, check_results_file, check_results_folder
from express50.errors import ConfigError, FormatError


def test_subjects_are_those_with_an_index_sorted(tmp_path):
    dataset = Dataset(str(tmp_path))
    for name in ("S002", "S001", "empty"):
        (tmp_path / "ingest" / name).mkdir(parents=True)
    for name in ("S002", "S001"):
        (tmp_path / "ingest" / name / "index.json").touch()
    assert dataset.subjects() == ["S001", "S002"]


def test_captures_table_is_checked(tmp_path):
    dataset = Dataset(tmp_path)
    assert dataset.captures() == {}
    for text, message in (("[", "not JSON"), ("[1]", "got list"), ('{"a": 1}', "'a': 1")):
        dataset.captures_file.write_text(text)
        with pytest.raises(FormatError, match=message):
            dataset.captures()


def test_results_do_not_go_among_a_datasets_own_files(tmp_path, monkeypatch):
    for name in ("data/config", "data/track/S001", "shards"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("data/ledger.sqlite", "data/config/track.toml", "shards/index.json"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path / "data")
    for place in ("", "track", "track/S001", "labels", "config/new"):
        with pytest.raises(ConfigError, match="belongs to the dataset"):
            check_results_folder(tmp_path / "data" / place)
        if place:
            with pytest.raises(ConfigError, match="belongs to the dataset"):
                check_results_file(tmp_path / "data" / place / "S001.jsonl")
    for place in ("grmm/train", "export", "..", "../shards"):
        check_results_folder(Path(place))
        check_results_file(Path(place) / "picture.png")
    check_results_file(Path("avatar.html"))
    with pytest.raises(IsADirectoryError):
        check_results_file(tmp_path)
    (tmp_path / "shards/manifest.json").touch()
    with pytest.raises(ConfigError, match="holds shards; name another folder"):
        check_results_folder(tmp_path / "shards")
    (tmp_path / "capture.toml").touch()
    with pytest.raises(ConfigError, match="is a capture; name another folder"):
        check_results_folder(tmp_path)


def test_shards_do_not_go_among_a_datasets_own_files(tmp_path, capsys):
    (tmp_path / "config").mkdir()
    for name in ("ledger.sqlite", "config/pack.toml"):
        (tmp_path / name).touch()
    for action in ("split", "merge"):
        assert main(["shards", action, str(tmp_path), str(tmp_path / "pack/test")]) == 2
        assert "belongs to the dataset" in capsys.readouterr().err
