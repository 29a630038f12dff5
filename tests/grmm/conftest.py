"""Fixtures that tests of GRMM on the toy data set share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from express50.head import load
from grmm import ablate, checkpoint
from grmm.data import HeadViews
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head


@pytest.fixture(autouse=True, scope="module")
def toy_head() -> Iterator[None]:
    """Checkpoints and shards are read with the toy head, whatever head they name."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (load, checkpoint, ablate):  # whoever was imported before binds its own
            patch.setattr(module, "load_head", lambda spec: ellipsoid_head())
        yield


@pytest.fixture(scope="module")
def source() -> EllipsoidSource:
    """Two subjects, two expressions and three cameras of 32 px."""
    return EllipsoidSource(size=32)


@pytest.fixture(scope="module")
def views(source: EllipsoidSource) -> HeadViews:
    """The samples of ``source``, or of what a test file calls so."""
    return HeadViews(source, ellipsoid_head())
