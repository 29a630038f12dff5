"""Whatever bytes a file holds: valid, finite data or one line of error, soon and in little memory.

All readers run in one process of their own (``python -m tests.fuzz``), each file's in a child of it
with a bound on its memory, so that what kills it is counted and not suffered. A native library that
crashes on a file is no failure here: in a pool it kills a worker, whose item the runner tries once
more alone and then sets aside (`express50.runner.executor`); docs/LOG.md says which ones did.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY
from tests.fuzz.mutations import draw_steps, mutate
from tests.fuzz.seeds import readers

CASES = 24
NAMES = [reader.name for reader in readers()]
NATIVE = {reader.name for reader in readers() if reader.native}


@pytest.fixture(scope="module")
def account() -> dict[str, dict]:
    run = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", "--cases", str(CASES), "--bombs", "--json"],
        cwd=REPOSITORY, env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", NAMES)
def test_a_mutated_file_is_read_or_refused(account: dict[str, dict], name: str) -> None:
    row = account["readers"][name]
    tolerated = ("crash",) if name in NATIVE else ()
    bad = [line for line in row["bad"] if not any(f": {word}: " in line for word in tolerated)]
    assert not bad, bad
    assert row["refused"] > 0  # mutations that nobody notices would test nothing
    assert row["read"] + row["refused"] + row["crash"] == CASES


def test_no_bomb_goes_off(account: dict[str, dict]) -> None:
    assert len(account["bombs"]) > 90
    assert {n: how for n, how in account["bombs"].items() if how != "refused"} == {}


def test_mutations_are_the_same_on_every_run_and_differ_from_the_file() -> None:
    steps = draw_steps(CASES)
    assert steps == draw_steps(CASES)
    data = json.dumps({"a": [1.5, 2], "b": "word"}).encode() * 20
    changed = [mutate(data, one, "x") for one in steps]
    assert changed == [mutate(data, one, "x") for one in steps]
    assert sum(one != data for one in changed) > 0.8 * CASES
