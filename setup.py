"""Build hook: compiles the native library with the package. All metadata is in pyproject.toml.

Each variant of express50/native/build.py becomes one "extension", so that setuptools puts it in
the right place for wheels, editable installs and ``python setup.py build_ext --inplace``. Without
a working compiler the package installs all the same and says what is missing.
"""

from __future__ import annotations

import runpy
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

# By path: the build may run where the package's own dependencies are not installed.
BUILD = runpy.run_path(str(Path(__file__).parent / "express50" / "native" / "build.py"))


class BuildNative(build_ext):
    """Compile plain shared objects (no Python ABI in their names) with the project's own flags."""

    def get_ext_filename(self, fullname: str) -> str:
        """Path of a variant inside the package."""
        return str(Path(*fullname.split(".")).with_suffix(".so"))

    def build_extension(self, ext: Extension) -> None:
        """Compile one variant; a failure is a warning, because ``ext`` is optional."""
        variant = ext.name.rpartition("gaussians_")[2]
        try:
            BUILD["compile_variant"](variant, Path(self.get_ext_fullpath(ext.name)))
        except BUILD["BuildError"] as error:
            raise CompileError(
                f"{error}\nThe package works without its native library, but Gaussians and meshes"
                " are rendered by slow references. Mend it later with"
                " `python -m express50.native.build`."
            ) from error


setup(
    ext_modules=[
        Extension(
            f"express50.native.gaussians_{variant}",
            sources=[f"express50/native/{name}" for name in BUILD["SOURCES"]],
            optional=True,
        )
        for variant in BUILD["variants"]()
    ],
    cmdclass={"build_ext": BuildNative},
)
