"""Caps reach libraries that are loaded already."""

from __future__ import annotations

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from express50.errors import DiskFullError
from express50.runner import worker
from express50.runner.worker import cap_threads


def test_a_loaded_blas_is_capped() -> None:
    import numpy as np

    np.linalg.inv(np.eye(3))
    with threadpool_limits(2, user_api="blas"):
        cap_threads(1)
        pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
        assert pools and all(pool["num_threads"] == 1 for pool in pools)


def test_items_of_a_batch_that_were_made_before_the_disk_was_full_are_recorded(monkeypatch):
    def run_task(task):
        if task == "full":
            raise DiskFullError("the disk is full")
        return f"receipt of {task}"

    monkeypatch.setattr(worker, "run_task", run_task)
    assert worker.run_tasks(["a", "b", "full", "c"]) == ["receipt of a", "receipt of b"]
    with pytest.raises(DiskFullError):
        worker.run_tasks(["full", "c"])
