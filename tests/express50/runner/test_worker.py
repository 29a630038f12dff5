"""Caps reach libraries that are loaded already."""

from __future__ import annotations

from threadpoolctl import threadpool_info, threadpool_limits

from express50.runner.worker import cap_threads


def test_a_loaded_blas_is_capped() -> None:
    import numpy as np

    np.linalg.inv(np.eye(3))
    with threadpool_limits(2, user_api="blas"):
        cap_threads(1)
        pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
        assert pools and all(pool["num_threads"] == 1 for pool in pools)
