"""The native library: C++ behind a plain C ABI, loaded through ctypes. This file is light.

``setup.py`` compiles one source into one shared object for each instruction set of ``build.VARIANTS``;
at run time the best one that this processor understands is opened.
"""

from __future__ import annotations


def available() -> bool:
    """Whether the native library can be loaded on this machine."""
    return False


def why_missing() -> str:
    """One line on why the library cannot be loaded and how to mend it; empty when it can."""
    return "the native library was not built; run `python -m express50.native.build`"
