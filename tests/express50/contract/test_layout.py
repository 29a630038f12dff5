"""Places in a dataset folder."""

import pytest

from express50.contract.layout import Dataset
from express50.errors import FormatError


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
