"""Other packages bring stages through entry points; what cannot work is one error."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest

from express50.__main__ import main
from express50.contract import stage
from express50.errors import ConfigError, StageError
from tests.faults import toy

OWN = EntryPoint("toolkit", "pipelines.stages:STAGES", "express50.stages")
OTHER = EntryPoint("another", "tests.express50.contract.test_extensions:STAGES", "express50.stages")
STAGES = (toy.STAGE, replace(toy.STAGE, name="second", runs_first=("toy",)))


@pytest.fixture
def install(monkeypatch):
    def found(*points):
        monkeypatch.setattr(
            stage, "entry_points",
            lambda group, name=None: [
                p for p in points if p.group == group and name in (None, p.name)
            ],
        )  # fmt: skip
        stage.stages.cache_clear()

    yield found
    stage.stages.cache_clear()


def test_stages_of_another_package_follow_those_of_the_toolkit(install):
    install(OTHER, OWN)
    names = list(stage.stages())
    assert names[0] == "ingest" and names[-2:] == ["toy", "second"]
    assert [one.name for one in stage.with_required(["second"])] == ["toy", "second"]


def test_a_source_tree_that_is_not_installed_says_so(install):
    install()
    with pytest.raises(StageError):
        stage.stages()
    with pytest.raises(StageError):
        stage.hook("read_checkpoint")


@pytest.mark.parametrize(
    "points",
    [(OWN, EntryPoint("copy", OWN.value, OWN.group)), (EntryPoint("a", "no.such:X", OWN.group),)],
    ids=["two stages of one name", "does not load"],
)
def test_what_cannot_work_is_one_error(install, points):
    install(*points)
    with pytest.raises(ConfigError):
        stage.stages()


def test_a_broken_command_takes_no_other_with_it(install, capsys):
    install(OWN, EntryPoint("broken", "no.such:COMMAND", "express50.commands"))
    assert main(["config", "pack"]) == 0
    assert main(["broken"]) == 2
    assert "entry point broken = no.such:COMMAND" in capsys.readouterr().err
