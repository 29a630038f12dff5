"""What we say of the paper: pages, preset and code agree."""

import importlib
import re
from functools import reduce
from pathlib import Path

import pytest

from grmm.cli import main
from grmm.config import PRESETS, as_tables, resolve
from grmm.deviations import REASONS, paper_diff

PAGE = (Path(__file__).parents[2] / "docs" / "PAPER.md").read_text(encoding="utf-8")


def settings(lines):
    return {line.split("`")[1] for line in lines if line.startswith("| `")}


def test_the_paper_preset_has_no_deviation():
    assert not settings(paper_diff(resolve("paper")))
    held = resolve("paper", None, ['data.holdout_cameras=["cam01"]', "train.seed=3"])
    assert not settings(paper_diff(held))


@pytest.mark.parametrize("name", PRESETS)
def test_every_setting_of_a_preset_that_differs_is_printed(name):
    letter, own = as_tables(resolve("paper")), as_tables(resolve(name))
    wanted = {f"{t}.{k}" for t in own for k in own[t] if own[t][k] != letter[t][k]}
    assert settings(paper_diff(resolve(name))) == wanted


def test_reasons_are_of_settings_that_a_preset_changes():
    tables = [preset.items() for preset in PRESETS.values()]
    changed = {f"{name}.{key}" for table in tables for name, keys in table for key in keys}
    assert set(REASONS) <= changed


def test_functions_that_the_page_names_exist():
    named = re.findall(r"`(grmm/[\w/]+)\.py: ([\w.]+)`", PAGE)
    assert len(named) > 20
    for path, name in named:
        module = importlib.import_module(path.replace("/", ".").removesuffix(".__init__"))
        assert reduce(getattr, name.split("."), module) is not None
    tables = as_tables(resolve())
    for table, key in re.findall(r"`(model|loss|fit|train)\.(\w+)`", PAGE):
        assert key in tables[table]


def test_the_command_prints_the_difference(capsys):
    assert main(["config", "--preset=paper-plus", "--paper-diff"]) == 0
    printed = capsys.readouterr().out
    assert settings(printed.splitlines()) == settings(paper_diff(resolve("paper-plus")))
    assert "With all settings:" in printed and "200,476 of 262,144" in printed
