"""Fixtures that all tests share."""

from __future__ import annotations

import gc
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest

from express50.contract.layout import Dataset
from express50.head.load import load_builtin
from tests.synth import make_capture

REPOSITORY = Path(__file__).resolve().parent.parent


def shared_folder(name: str) -> Path:
    """Folder of material beside the repository; skips the test where it is not there."""
    root = Path(os.environ.get("EXPRESS50_SHARED", REPOSITORY.parent / "shared"))
    if not (root / name).exists():
        pytest.skip(f"{name} is not beside the repository (set EXPRESS50_SHARED)")
    return root / name


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with slow tests first, so that no process is left with them at the end.

    Names that hold an address differ between processes, and pytest-xdist then runs no test at all.
    """
    unstable = [item.nodeid for item in items if " at 0x" in item.nodeid]
    if unstable:
        raise pytest.UsageError(f"{unstable[0]}: the name holds an address; give it an id")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_configure() -> None:
    """Collect no garbage while modules and tests are loaded, and let Ctrl-C end processes."""
    # Shells let what they run in the background ignore Ctrl-C. Processes of tests would inherit it.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage from here on, but leave what is loaded out of the search."""
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    """Let libraries that report what they leak find nothing."""
    gc.unfreeze()


@pytest.fixture(scope="session", autouse=True)
def unsynced() -> Iterator[None]:
    """Do not wait for the disk: only a power failure shows the difference, and no test causes one.

    Workers and other processes that tests start do wait.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: os.fstat(descriptor) and None)
        yield


@pytest.fixture
def shared():
    """Look up material beside the repository by name."""
    return shared_folder


@pytest.fixture(scope="session")
def head():
    """The built-in head; do not change it."""
    return load_builtin()


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Raw capture S001: 3 cameras, 6 frames of 64 px as PNG; do not change it."""
    path = tmp_path_factory.mktemp("captures") / "S001"
    make_capture(path)
    return path


@pytest.fixture(scope="session")
def ingested_once(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Dataset:
    """A dataset with S001 ingested; only copied."""
    from tests.stages import ingest_captures

    return ingest_captures(tmp_path_factory.mktemp("ingested") / "dataset", capture)


@pytest.fixture
def ingested(tmp_path: Path, ingested_once: Dataset) -> Dataset:
    """A dataset with S001 ingested."""
    return Dataset(shutil.copytree(ingested_once.root, tmp_path / "dataset"))


@pytest.fixture(scope="module")
def no_faces() -> Iterator[None]:
    """Footage of toys shows no face: say so without asking the landmark network everywhere."""
    from express50.geometry.transforms import transform_points
    from express50.landmarks import detector

    grid = detector.CROP * np.random.default_rng(0).uniform(0.2, 0.8, (68, 2))

    def nothing(net: object, looks: list[detector.Look]) -> list[detector._Place]:
        found = [transform_points(look.window, grid) for look in looks]
        return [detector._Place(p, p[:17], np.full(68, 99.0), np.zeros(68), 0.0) for p in found]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detector, "_run", nothing)
        yield
