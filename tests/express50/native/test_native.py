"""The native library's loader and build."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from express50 import native
from express50.native import build


@pytest.fixture
def fresh_loader():
    """Forget what was loaded, before and after."""
    for function in (native.load, native.why_missing):
        function.cache_clear()
    yield
    for function in (native.load, native.why_missing):
        function.cache_clear()


def test_the_best_variant_of_this_processor_is_loaded(fresh_loader):
    level = native.load("baseline").native_level()
    assert Path(native.load()._name) == build.library_file(list(build.VARIANTS)[level])
    assert native.why_missing() == ""


def test_a_missing_library_error_says_how_to_build_it(fresh_loader, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "library_file", lambda variant: tmp_path / f"{variant}.so")
    assert "was not built; build it with `python -m express50.native.build`" in native.why_missing()


def test_a_stale_library_is_not_used(fresh_loader, monkeypatch):
    monkeypatch.setattr(build, "source_digest", lambda: "0" * 16)
    with pytest.raises(native.NativeLibraryError, match="is older than its source; build it with"):
        native.load()


def test_a_file_that_is_not_a_library_is_reported(fresh_loader, tmp_path, monkeypatch):
    (tmp_path / "baseline.so").write_bytes(b"not a library")
    monkeypatch.setattr(build, "library_file", lambda variant: tmp_path / f"{variant}.so")
    assert "does not load" in native.why_missing()


def test_without_native_library_the_reference_renders_and_says_so(fresh_loader, monkeypatch):
    from grmm.rasterize import rasterize, resolve_backend
    from tests.grmm.gaussian_scenes import random_scene

    monkeypatch.setattr(build, "source_digest", lambda: "0" * 16)
    with pytest.warns(UserWarning, match="slow torch reference: the native library"):
        assert resolve_backend() == "reference"
    with pytest.raises(native.NativeLibraryError):
        rasterize(**random_scene(3, 3).tensors, width=8, height=8, backend="cpu")


def test_without_compiler_the_build_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(build.BuildError, match="no C.. compiler found; install g"):
        build.compile_variant("baseline", tmp_path / "x.so")


def test_a_compiler_that_fails_leaves_nothing_behind(monkeypatch, tmp_path):
    compiler = tmp_path / "bad-compiler"
    compiler.write_text("#!/bin/sh\necho broken >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(build.BuildError, match="failed on gaussians.cpp .baseline.: broken"):
        build.compile_variant("baseline", tmp_path / "out" / "x.so")
    assert list((tmp_path / "out").iterdir()) == []


def test_flags_leave_floating_point_alone():
    """-ffast-math would flush denormals in the whole process once the library is loaded."""
    flags = [*build.FLAGS, *(flag for extra in build.VARIANTS.values() for flag in extra)]
    assert not any("fast-math" in flag or "march=native" in flag for flag in flags)
    code = (
        "import numpy as np; from express50 import native; native.load();"
        "assert np.float32(1e-40) * np.float32(0.5) > 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": "."})


def test_loader_is_light():
    code = (
        "import sys; import express50.native;"
        "assert not {'numpy', 'torch'} & set(sys.modules), 'heavy import'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": "."})
