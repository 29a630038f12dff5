"""Configuration: order of sources, types, and errors that name the nearest known key."""

from dataclasses import dataclass
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.contract.config import (
    config_toml,
    field_documents,
    made_with,
    parse_assignment,
    resolve_config,
)
from express50.contract.stage import Result, Stage
from express50.errors import ConfigError, nearest


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A config with every supported type."""

    iterations: int = 100
    """Steps, 1 to 10000;
    more is better."""
    rate: float = 0.5
    mode: Literal["fast", "slow"] = "fast"
    refine: bool = True
    sizes: tuple[int, ...] = (1, 2)
    weights: str = ""

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}, expected at least 1")


STAGE = Stage(
    name="track",
    version=1,
    config=Sample,
    presets={"draft": {"iterations": 10}, "reference": {"iterations": 900}},
    items=lambda dataset: [],
    inputs=lambda dataset, item, config: {},
    run=lambda dataset, item, config, out: Result(),
)


def resolve(*assignments, preset="standard", file=None):
    return resolve_config(STAGE, preset, file, assignments, ["depth"])


def test_set_wins_over_file_wins_over_preset(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("[track]\niterations = 20\nrate = 2\n[depth]\nvoxels = 1\n")
    assert resolve(preset="draft") == Sample(iterations=10)
    assert resolve(preset="draft", file=file) == Sample(iterations=20, rate=2.0)
    assert resolve("track.iterations=30", preset="draft", file=file).iterations == 30
    assert resolve("track.rate=1", "track.rate=3").rate == 3.0


@pytest.mark.parametrize(
    ("assignment", "key", "value"),
    [
        ("track.iterations=200", "iterations", 200),
        ("track.mode=slow", "mode", "slow"),
        ("track.mode='slow'", "mode", "slow"),
        ("track.refine=false", "refine", False),
        ("track.sizes=[3, 4, 5]", "sizes", (3, 4, 5)),
        ("track.sizes=[]", "sizes", ()),
        ("track.weights=/a/b.pth", "weights", "/a/b.pth"),
        ("depth.voxels=3", "iterations", 100),
    ],
)
def test_values_are_typed(assignment, key, value):
    found = getattr(resolve(assignment), key)
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("track.iteratons=5", "unknown key track.iteratons .did you mean 'iterations'"),
        ("trak.iterations=5", "no stage 'trak' in this command .did you mean 'track'"),
        ("track.iterations=2.5", "got 2.5, expected a whole number"),
        ("track.iterations=true", "got True, expected a whole number"),
        ("track.refine=1", "got 1, expected true or false"),
        ("track.rate=nan", "got NaN"),
        ("track.mode=fas", "got 'fas' .did you mean 'fast'.{2}; expected one of 'fast', 'slow'"),
        ("track.sizes=3", "expected a list"),
        ("track.sizes=[1, 'x']", r"track.sizes\[1\]: got 'x'"),
        ("track.iterations=0", "track: iterations is 0, expected at least 1"),
        ("track.iterations", "expected TABLE.KEY=VALUE"),
        ("iterations=3", "expected TABLE.KEY=VALUE"),
    ],
)
def test_wrong_assignments_say_what_is_wrong(assignment, message):
    with pytest.raises(ConfigError, match=message):
        resolve(assignment)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[trak]\n", r"unknown table \[trak\] .did you mean 'track'"),
        ("track = 3\n", "track is a value, expected a table"),
        ("[track]\nrefin = true\n", "unknown key track.refin .did you mean 'refine'"),
        ("[track\n", "not TOML"),
    ],
)
def test_wrong_files_say_what_is_wrong(tmp_path, text, message):
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        resolve(file=file)


def test_missing_file_and_unknown_preset(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        resolve(file=tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="is a folder, not a file$"):
        resolve(file=tmp_path)
    with pytest.raises(ConfigError, match="unknown preset 'drat' .did you mean 'draft'"):
        resolve(preset="drat")


def test_documents_stand_in_the_toml():
    text = config_toml("track", Sample())
    assert field_documents(Sample) == {"iterations": "Steps, 1 to 10000; more is better."}
    assert "# Steps, 1 to 10000; more is better.\niterations = 100\n" in text


def test_settings_are_known_again_when_their_documentation_changes(tmp_path):
    known = {"few": Sample(iterations=7), "many": Sample(iterations=900)}
    path = tmp_path / "track.toml"
    path.write_text(config_toml("track", known["many"]).replace("more is better", "few do"))
    assert made_with(path, STAGE, known) == "many"
    path.write_text(path.read_text().replace("900", "901"))
    assert made_with(path, STAGE, known) is None


@settings(deadline=None, max_examples=30)
@given(
    iterations=st.integers(1, 10**9),
    rate=st.floats(allow_nan=False, allow_infinity=False),
    sizes=st.lists(st.integers(-5, 5)).map(tuple),
    weights=st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
)
def test_saved_toml_reads_back_as_the_same_config(
    tmp_path_factory, iterations, rate, sizes, weights
):
    config = Sample(iterations=iterations, rate=rate, sizes=sizes, weights=weights)
    file = tmp_path_factory.getbasetemp() / "c.toml"
    file.write_text(config_toml("track", config), encoding="utf-8")
    assert resolve(preset="draft", file=file) == config


def test_assignment_keeps_equal_signs_and_dots():
    assert parse_assignment("a.b=x=y") == ("a", "b", "x=y")
    assert parse_assignment("a.b=/c.d/e=f") == ("a", "b", "/c.d/e=f")


@pytest.mark.parametrize(
    ("word", "known", "found"),
    [
        ("drat", "draft standard reference", "draft"),
        ("Standard", "draft standard reference", "standard"),
        ("default", "draft standard reference", None),
        ("train", "tune twin track", None),
        ("list", "ingest pack", None),
        ("clean", "plan prune", None),
        ("stats", "status tune", "status"),
        ("size", "noise image_side", "image_side"),
        ("blur", "proxy_quality blur_ratio", "blur_ratio"),
        ("jwa", "jaw neck", "jaw"),
        ("S009", "S007 S008 S010", None),
        ("s002", "S001 S002", "S002"),
        ("S01", "S001 S011", "S001"),
        ("anything", "", None),
        ("", "a b", None),
    ],
)
def test_only_likely_slips_are_suggested(word, known, found):
    assert nearest(word, known.split()) == (f" (did you mean {found!r}?)" if found else "")
