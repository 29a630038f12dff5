"""Fixtures that tests of GRMM on the toy data set share."""

from __future__ import annotations

import pytest

from grmm import checkpoint as checkpoint_module
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head


@pytest.fixture
def toy_head(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints are read with the toy head, whatever head they name."""
    monkeypatch.setattr(checkpoint_module, "load_head", lambda spec: ellipsoid_head())


@pytest.fixture(scope="module")
def source() -> EllipsoidSource:
    """Two subjects, two expressions and three cameras of 32 px."""
    return EllipsoidSource(size=32)
