"""Compile the native library: ``python -m express50.native.build`` builds it in place.

One source, one shared object for each instruction set in ``VARIANTS``. The package's ``setup.py``
runs this file by path, so it may import nothing but the standard library.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCE = HERE / "gaussians.cpp"
SOURCES = (
    "gaussians.cpp", "render.h", "render_gradient.h", "blend.h", "blend_gradient.h", "tiles.h",
    "projection.h", "lanes.h",
)  # fmt: skip

# Best last; their order is what `native_level` in the library returns. No -ffast-math: linking with
# it would flush denormals to zero in the whole process, and NaN checks would be optimised away.
VARIANTS: dict[str, tuple[str, ...]] = {
    "baseline": (),
    "avx2": ("-mavx2", "-mfma", "-mbmi", "-mbmi2"),
    "avx512": (
        "-mavx2", "-mfma", "-mbmi", "-mbmi2",
        "-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl",
    ),
}  # fmt: skip
FLAGS = ("-std=c++17", "-O3", "-shared", "-fPIC", "-fvisibility=hidden")


class BuildError(Exception):
    """The library could not be compiled; the message is the compiler's."""


def variants() -> tuple[str, ...]:
    """List the variants that can run on this kind of processor."""
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    return tuple(VARIANTS) if x86 else ("baseline",)


def library_file(variant: str) -> Path:
    """Return the path of a variant's shared object."""
    return HERE / f"gaussians_{variant}.so"


def source_digest() -> str:
    """Return the digest of all sources; it is compiled into the library to notice a stale one."""
    digest = hashlib.sha256()
    for name in SOURCES:
        digest.update((HERE / name).read_bytes())
    return digest.hexdigest()[:16]


def compiler() -> str:
    """Return the path of the C++ compiler: $CXX, g++, c++ or clang++; BuildError without any."""
    for name in (os.environ.get("CXX", ""), "g++", "c++", "clang++"):
        found = shutil.which(name) if name else None
        if found:
            return found
    raise BuildError("no C++ compiler found; install g++ (apt-get install g++) or set CXX")


def compile_variant(variant: str, target: Path) -> None:
    """Compile one variant to ``target``, with OpenMP where the compiler has it.

    Raises:
        BuildError: the compiler is missing or refuses the source.
    """
    command = [compiler(), *FLAGS, *VARIANTS[variant], f'-DEXPRESS50_DIGEST="{source_digest()}"']
    target.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed, so that a process that has the old one open keeps all of it.
    partial = target.with_name(f".{target.name}.{os.getpid()}")
    for openmp in (["-fopenmp"], []):
        run = subprocess.run(
            [*command, *openmp, str(SOURCE), "-o", str(partial)], capture_output=True, text=True
        )
        if run.returncode == 0:
            partial.replace(target)
            return
    partial.unlink(missing_ok=True)
    raise BuildError(f"{command[0]} failed on {SOURCE.name} ({variant}): {run.stderr.strip()}")


def main() -> int:
    """Build every variant next to this file; 1 if that failed."""
    try:
        with ThreadPoolExecutor(max_workers=2) as pool:
            files = [library_file(variant) for variant in variants()]
            for file, _ in zip(files, pool.map(compile_variant, variants(), files), strict=True):
                sys.stdout.write(f"built {file}\n")
    except BuildError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
