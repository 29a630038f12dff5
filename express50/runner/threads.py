"""Limit threads: more than one per core over all processes and pools slows everything down.

The cap is the same inline and in workers: sums over a different number of threads round
differently, and the same data must give the same bytes.
"""

from __future__ import annotations

import functools
import os
import sys

from threadpoolctl import ThreadpoolController

VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def thread_environment(threads: int) -> dict[str, str]:
    """Return environment variables that cap every known pool.

    They work before a library is imported.
    """
    return dict.fromkeys(VARIABLES, str(threads))


def cap_threads(threads: int) -> None:
    """Cap pools in this process: by environment, and directly where a library is loaded already."""
    os.environ.update(thread_environment(threads))
    # A BLAS that is loaded already does not look at the environment; on other numbers of threads it
    # adds up in another order, and bytes would depend on where an item was worked on.
    if "numpy" in sys.modules:
        _libraries(len(sys.modules)).limit(limits=threads, user_api="blas")
    # sys.modules is asked, because importing torch only to cap it would cost seconds.
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)


@functools.lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Find the libraries with a pool.

    Looking for them takes 1.5 ms, and only an import brings new ones.
    """
    return ThreadpoolController()
