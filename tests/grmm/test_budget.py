import pytest

from express50.errors import ConfigError
from express50.files.atomic import write_json
from grmm import train_state
from grmm.cli import build_parser
from grmm.cli.commands import train_config
from grmm.config import choose, resolve


@pytest.fixture
def measured(tmp_path):
    rows = [
        {
            "budget_s": 240.0,
            "setting": "large",
            "psnr_db": 30.0,
            "changes": {"model": {"n_g": 256}},
        },
        {"budget_s": 60.0, "setting": "small", "psnr_db": 28.0, "changes": {"model": {"n_g": 64}}},
    ]
    write_json(tmp_path / "measured.json", rows)
    return tmp_path / "measured.json"


@pytest.mark.parametrize(
    ("seconds", "setting"),
    [(1, "small"), (60, "small"), (239, "small"), (240, "large"), (1e6, "large")],
)
def test_the_longest_measured_budget_that_fits(measured, seconds, setting):
    assert choose(seconds, measured).setting == setting


def arguments(*words):
    return build_parser().parse_args(["config", *words])


def test_command_line_takes_the_measured_setting(capsys):
    """The shipped table: whatever it says reaches the configuration, and --set stands above it."""
    choice = choose(60)
    config = train_config(arguments("--preset", "auto", "--budget", "60s"))
    for table, values in choice.changes.items():
        for key, value in values.items():
            found = getattr(getattr(config, table), key)
            assert (list(found) if isinstance(found, tuple) else found) == value
    assert config.train.seconds == 60 and choice.setting in capsys.readouterr().err
    above = arguments("--preset", "auto", "--budget", "60s", "--set", "model.n_g=32")
    assert train_config(above).model.n_g == 32


@pytest.mark.parametrize(("memory", "preset"), [(80, "paper-plus"), (8, "small")])
def test_a_gpu_is_trained_on_at_the_size_that_it_holds(monkeypatch, capsys, memory, preset):
    monkeypatch.setattr(train_state, "gpu", lambda: ("Some GPU", memory))
    args = build_parser().parse_args(["train", "shards", "out"])
    assert train_config(args) == resolve(preset)
    assert f"{preset}, for Some GPU with {memory} GiB" in capsys.readouterr().err


@pytest.mark.parametrize("by_file", [True, False])
def test_a_time_among_the_settings_is_enough(tmp_path, by_file, capsys):
    """It asked for --budget."""
    (tmp_path / "c.toml").write_text("[train]\nseconds = 90.0\n")
    given = f"--config={tmp_path / 'c.toml'}" if by_file else "--set=train.seconds=90"
    assert train_config(arguments("--preset", "auto", given)) == resolve(
        "demo", changes={"train": {"seconds": 90.0}}
    )
    assert choose(90).setting in capsys.readouterr().err


def test_a_cpu_needs_a_time():
    with pytest.raises(ConfigError, match="--budget"):
        train_config(build_parser().parse_args(["train", "shards", "out"]))
