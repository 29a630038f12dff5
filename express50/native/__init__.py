"""Load the native library, C++ behind a plain C ABI, through ctypes. This file is light.

``setup.py`` compiles one source into a shared object for each instruction set of ``build.py``; at
run time the best one that this processor understands is opened.
"""

from __future__ import annotations

import ctypes
from functools import cache

# `build` is imported where it is used: `python -m express50.native.build` must not find it loaded.
FIX = "build it with `python -m express50.native.build` (needs g++) or reinstall the package"


class NativeLibraryError(RuntimeError):
    """The native library is missing, stale or does not load."""


@cache
def why_missing() -> str:
    """Return one line on why the library cannot be loaded and how to fix it; empty when it can."""
    try:
        load()
    except NativeLibraryError as error:
        return str(error)
    return ""


@cache
def load(variant: str | None = None) -> ctypes.CDLL:
    """Return the library of ``variant``, or the best that was built and this processor can run.

    Raises:
        NativeLibraryError: it was not built, is older than its source or does not load.
    """
    from express50.native.build import VARIANTS, library_file

    if variant is not None:
        return _open(variant)
    # The baseline variant runs anywhere and reports what the processor can do.
    level = _open("baseline").native_level()
    for name in reversed(list(VARIANTS)[: level + 1]):
        if library_file(name).exists():
            return _open(name)
    raise NativeLibraryError(f"no variant of the native library was built; {FIX}")


def _open(variant: str) -> ctypes.CDLL:
    """Open one variant and compare its digest with the sources, where they are installed too."""
    from express50.native.build import library_file, source_digest

    path = library_file(variant)
    if not path.exists():
        raise NativeLibraryError(f"the native library {path.name} was not built; {FIX}")
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise NativeLibraryError(f"the native library does not load: {error}; {FIX}") from error
    library.native_digest.restype = ctypes.c_char_p
    try:
        expected = source_digest()
    except FileNotFoundError:  # installed without its sources: nothing to compare with
        return library
    if library.native_digest().decode() != expected:
        raise NativeLibraryError(f"the native library {path.name} is older than its source; {FIX}")
    return library
