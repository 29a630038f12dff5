"""Finding head models by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from express50.errors import HeadModelError
from express50.head.load import BUILTIN, load_head


def test_unknown_names_say_what_is_known() -> None:
    with pytest.raises(HeadModelError, match="no such file.*procedural"):
        load_head("flame2024")


def test_unknown_endings_are_refused(tmp_path: Path) -> None:
    (tmp_path / "head.glb").write_bytes(b"")
    with pytest.raises(HeadModelError, match="head.glb"):
        load_head(tmp_path / "head.glb")


def test_an_empty_folder_is_not_a_checkout(tmp_path: Path) -> None:
    with pytest.raises(HeadModelError, match="give a checkout"):
        load_head(tmp_path)


def test_a_head_model_of_ones_own_is_read_from_its_arrays(tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    path.write_bytes(BUILTIN.read_bytes())
    head, builtin = load_head(path), load_head("procedural")
    assert head.name == "mine"
    assert head.template.equal(builtin.template) and head.contour is not None
    assert all(head.regions[name].equal(mask) for name, mask in builtin.regions.items())


@pytest.mark.parametrize("change", ["missing", "shape", "regions", "contour", "index"])
def test_a_stored_head_model_that_does_not_fit_is_refused(tmp_path: Path, change: str) -> None:
    with np.load(BUILTIN) as stored:
        arrays = dict(stored)
    if change == "missing":
        del arrays["faces"]
    elif change == "shape":
        arrays["template"] = arrays["template"][:-1]
    elif change == "regions":
        arrays["region_names"] = arrays["region_names"][:-1]
    elif change == "contour":
        arrays["contour"] = arrays["contour"] + len(arrays["template"])
    np.savez(tmp_path / "mine.npz", **arrays)
    if change == "index":
        data = bytearray((tmp_path / "mine.npz").read_bytes())
        data[data.rfind(b"PK\x01\x02")] = 0
        (tmp_path / "mine.npz").write_bytes(data)
    with pytest.raises(HeadModelError, match="mine"):
        load_head(tmp_path / "mine.npz")
