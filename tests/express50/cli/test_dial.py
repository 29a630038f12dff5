"""Budgets on the command line: wrong usage is one line, and a tuned dataset shows its front."""

import pytest

from express50.__main__ import main
from express50.console import FAILED, USAGE
from express50.contract.layout import Dataset
from express50.dataset.report import render_page
from express50.dial.measuring import tune
from express50.runner.publish import stage_lock
from tests.express50.dial.toy_chain import PAUSE, captures_of, chain_of
from tests.stages import ingest_captures
from tests.synth import make_capture


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--budget", "2"], "expected a time such as 45m"),
        (["--error", "0.5"], "such as 0.5mm"),
        (["--budget", "1h", "--first", "align"], "omit --first and --last"),
        (["--replace"], "--replace needs the CAPTURE"),
        (["--budget", "1h", "--replace"], "--replace needs the CAPTURE"),
        (["--budget", "1h", "--preset", "draft"], "--error choose the settings"),
        (["--budget", "1h", "--set", "track.landmarks=/nope"], "track.landmarks is /nope"),
        (["--budget", "1h", "--set", "track.sampels=1"], "did you mean 'samples'"),
    ],
)
def test_wrong_usage_is_one_line_and_starts_nothing(tmp_path, capsys, options, words):
    assert main(["run", str(tmp_path / "data"), *options]) == USAGE
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not (tmp_path / "data").exists()


def test_a_second_budgeted_run_at_once_is_refused(tmp_path, capsys):
    """The second one's trials failed where the first had the stage, so it chose other settings."""
    make_capture(tmp_path / "S001", cameras=2)
    dataset = ingest_captures(tmp_path / "data", tmp_path / "S001")
    with stage_lock(dataset, "run"):
        for command in (["run", "--budget", "5m"], ["tune"]):
            assert main([command[0], str(dataset.root), *command[1:]]) == FAILED
            assert "another 'run' is running on this dataset; wait" in capsys.readouterr().err


def test_tune_has_no_option_that_needs_chosen_settings(capsys):
    assert main(["tune", "--help"]) == 0
    said = capsys.readouterr().out
    assert "--set" in said
    for option in (["--preset", "draft"], ["--print-job"], ["--strict"]):
        assert option[0] not in said
        assert main(["tune", "DATA", *option]) == USAGE


def test_the_report_shows_the_front(tmp_path, monkeypatch):
    monkeypatch.setenv(PAUSE, "0.02")  # seconds that a busy machine does not drown
    captures = captures_of(tmp_path / "captures", subjects=1, expressions=2)
    table, _ = tune(chain_of(tmp_path / "data", captures))
    page = render_page(Dataset(tmp_path / "data"))
    assert "What time buys" in page and "value, mm" in page
    usual = table["presets"]["standard"]["settings"]
    for point in table["front"]:
        chosen = point["settings"].items() - usual.items()
        assert all(f"{stage} {setting}" in page for stage, setting in chosen)
    assert "nine times in ten" in page and "none does" not in page
