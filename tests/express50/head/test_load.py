"""Finding head models by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from express50.errors import HeadModelError
from express50.head.load import load_head


def test_unknown_names_say_what_is_known() -> None:
    with pytest.raises(HeadModelError, match="no such file.*procedural"):
        load_head("flame2024")


def test_unknown_endings_are_refused(tmp_path: Path) -> None:
    (tmp_path / "head.glb").write_bytes(b"")
    with pytest.raises(HeadModelError, match="head.glb"):
        load_head(tmp_path / "head.glb")


def test_an_empty_folder_is_no_checkout(tmp_path: Path) -> None:
    with pytest.raises(HeadModelError, match="expected a checkout"):
        load_head(tmp_path)
