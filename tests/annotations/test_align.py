"""The observe and align stages over painted footage, with observations of made-up faces."""

import json
from dataclasses import replace

import numpy as np
import pytest

from annotations import align, observe
from annotations.align.stage import accept_sure
from annotations.labels import (
    AUTOMATIC,
    append_label,
    current_labels,
    make_flag,
    make_mark,
    read_labels,
)
from annotations.observe.stage import FACE, SCHEMA, read_observations
from annotations.suggestions import choose_reference, read_suggestions
from express50.__main__ import main
from express50.capture.index import read_index
from express50.errors import ConfigError, FormatError
from tests.annotations.footage import EXPRESSIONS, FRAMES_EACH
from tests.stages import metrics_of, run_here

FACE_POINTS = np.random.default_rng(0).uniform(0, 100, (68, 2))
SMILE = {"S001": 22, "S002": 26}
JAW = {"S001": 41, "S002": 38}


def act(dataset, subject, strength=2.0, stride=1):
    """Write observations of a face that smiles and opens its mouth at known frames."""
    frames = np.arange(0, 3 * FRAMES_EACH, stride)
    rng = np.random.default_rng(int(subject[1:]))
    points = FACE_POINTS + rng.normal(0, 0.1, (len(frames), 68, 2))
    for apex, part, way in ((SMILE, slice(48, 68), 0), (JAW, slice(5, 12), 1)):
        course = np.exp(-0.5 * ((frames - apex[subject]) / 2.0) ** 2)
        points[:, part, way] += strength * course[:, None]
    folder = dataset.item_dir("observe", subject)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "observations.npz", schema=SCHEMA, cameras=np.array(["cam01"]),
        frames=frames, points=points[None].astype(np.float32),
        scores=np.ones((1, len(frames)), np.float32),
        faces=np.full((1, len(frames), FACE, FACE), 99, np.uint8),
    )  # fmt: skip


def run(dataset, items=None, **values):
    return run_here(align.STAGE, dataset, items, **values)


def peaks(dataset, subject):
    return json.loads(dataset.peaks_file(subject).read_text())


@pytest.fixture
def watched(dataset):
    """The footage with observations of both subjects."""
    for subject in ("S001", "S002"):
        act(dataset, subject)
    return dataset


def test_a_damaged_line_of_labels_is_a_warning(watched):
    path = watched.labels_file("S001")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('{"cut off\n')
    assert run(watched, ["S001"]).ok
    found = metrics_of(watched, "align", "S001")
    assert "line 1 of S001" in found["warnings"][0]["why"]


def test_an_automatic_label_of_a_clock_that_was_ahead_can_be_taken_back(watched):
    index = read_index(watched, "S001")
    mark = make_mark(index, "smile", 21, "cam01", AUTOMATIC)
    append_label(watched, replace(mark, time=mark.time + 3600))
    assert accept_sure(watched, index, {}, 1.0) == {}  # it wrote one undo after the other
    assert [label.action for label in read_labels(watched, "S001")] == ["mark", "undo"]


def test_a_label_in_a_camera_that_is_gone_costs_only_its_expression(watched):
    index = read_index(watched, "S001")
    for expression, frame, change in (
        ("smile", 21, {"camera": "cam9"}),
        ("jaw_open", 40, {"frame": 999}),
    ):
        mark = make_mark(index, expression, frame, "cam01", "ann")
        append_label(watched, replace(mark, **change))
    assert run(watched, ["S001"]).ok
    dropped = {row["what"]: row["why"] for row in metrics_of(watched, "align", "S001")["dropped"]}
    assert dropped["smile"].startswith("labelled by ann: no camera 'cam9' in the footage; label it")
    command = f"annotate mark {watched.root} S001 EXPRESSION FRAME"  # as it can be typed
    assert command in dropped["smile"]
    why = f"labelled by ann: cam01 has {3 * FRAMES_EACH} frames, and no frame 999;"
    assert dropped["jaw_open"].startswith(why)
    assert "smile" not in peaks(watched, "S001") and "neutral" in peaks(watched, "S001")


def test_a_label_whose_frame_shows_another_picture_costs_only_its_expression(watched):
    mark = make_mark(read_index(watched, "S001"), "smile", 21, "cam01", "ann")
    append_label(watched, replace(mark, dhash="f" * 16))
    assert run(watched, ["S001"]).ok
    (dropped,) = metrics_of(watched, "align", "S001")["dropped"]
    assert dropped["what"] == "smile" and "the label says 21 and ffffffffffff" in dropped["why"]
    assert set(peaks(watched, "S001")) == {"neutral", "jaw_open"}


def test_a_label_outside_its_cue_window_is_warned_of(watched):
    """After cues.csv was corrected, it may show another expression."""
    mark = make_mark(read_index(watched, "S001"), "smile", 21, "cam01", "ann")
    append_label(watched, replace(mark, expression="jaw_open"))
    assert run(watched, ["S001"]).ok
    (warning,) = metrics_of(watched, "align", "S001")["warnings"]
    assert warning["what"] == "jaw_open"
    assert warning["why"].startswith("labelled by ann: frame 21 lies outside the cue window 3")


def test_peaks_are_found_and_other_subjects_match_the_reference(watched):
    assert run(watched).ok
    for subject in ("S001", "S002"):
        rows = read_suggestions(watched, subject)
        assert set(rows) == set(EXPRESSIONS)
        assert rows["smile"].frame == pytest.approx(SMILE[subject], abs=1)
        assert rows["jaw_open"].frame == pytest.approx(JAW[subject], abs=1)
        assert len(rows["smile"].activity) == FRAMES_EACH
        assert rows["smile"].confidence > 0.8
    assert read_suggestions(watched, "S001")["smile"].kind == "peak"
    matched = read_suggestions(watched, "S002")["smile"]
    assert matched.kind == "match"
    assert matched.reference == {"subject": "S001", "camera": "cam01", "frame": 22}
    assert peaks(watched, "S002")["smile"]["frame"] == matched.frame


def test_rerun_appends_nothing_and_a_label_of_the_reference_moves_other_suggestions(watched):
    assert run(watched).ok
    before = read_labels(watched, "S002")
    assert run(watched).count("skipped") == 2
    assert read_labels(watched, "S002") == before
    mark = make_mark(read_index(watched, "S001"), "smile", 19, "cam01", "ann")  # half way up
    append_label(watched, mark)
    assert run(watched).count("done") == 2
    assert peaks(watched, "S001")["smile"]["annotator"] == "ann"
    moved = read_suggestions(watched, "S002")["smile"]
    assert moved.frame == pytest.approx(SMILE["S002"] - 3, abs=1)
    assert read_suggestions(watched, "S002")["jaw_open"].frame == pytest.approx(38, abs=1)


def test_flagged_reference_leaves_other_subjects_their_own_peaks(watched):
    append_label(watched, make_flag(read_index(watched, "S001"), "smile", "failed", "ann"))
    assert run(watched).ok
    assert "smile" not in peaks(watched, "S001")
    assert read_suggestions(watched, "S002")["smile"].kind == "peak"
    assert read_suggestions(watched, "S002")["jaw_open"].kind == "match"


def test_choosing_another_reference_matches_to_it(watched):
    assert run(watched).ok
    choose_reference(watched, "S002")
    assert run(watched).count("done") == 2
    assert read_suggestions(watched, "S001")["smile"].reference["subject"] == "S002"


def test_unsure_suggestions_wait_for_a_person(dataset):
    act(dataset, "S001", strength=0.02)
    assert run(dataset, ["S001"]).ok
    assert set(current_labels(read_labels(dataset, "S001"))) == set(EXPRESSIONS)
    sure = {e: row.confidence for e, row in read_suggestions(dataset, "S001").items()}
    threshold = sorted(sure.values())[1]
    assert run(dataset, ["S001"], accept=threshold).ok
    unsure = {e for e, confidence in sure.items() if confidence < threshold}
    assert unsure
    assert set(peaks(dataset, "S001")) == set(EXPRESSIONS) - unsure
    assert not unsure & set(current_labels(read_labels(dataset, "S001")))
    metrics = metrics_of(dataset, "align", "S001")
    assert {row["what"] for row in metrics["dropped"]} == unsure
    assert all("align.accept" in row["why"] for row in metrics["dropped"])
    assert run(dataset, ["S001"]).ok
    assert set(peaks(dataset, "S001")) == set(EXPRESSIONS)


def test_people_can_label_a_subject_without_observations(dataset):
    refused = run(dataset, ["S001"])
    assert not refused.ok
    assert "not observed" in refused.outcomes[0].reason
    for expression, frame in (("smile", 20), ("jaw_open", 40)):
        mark = make_mark(read_index(dataset, "S001"), expression, frame, "cam01", "ann")
        append_label(dataset, mark)
    assert run(dataset, ["S001"]).ok
    assert {e: row["frame"] for e, row in peaks(dataset, "S001").items()} == {
        "smile": 20, "jaw_open": 40,
    }  # fmt: skip


def test_unobserved_reference_leaves_every_subject_its_own_peak(dataset):
    act(dataset, "S002")
    assert run(dataset, ["S002"]).ok
    assert read_suggestions(dataset, "S002")["smile"].kind == "peak"
    metrics = metrics_of(dataset, "align", "S002")
    assert "S001 is not observed" in metrics["dropped"][0]["why"]


def test_curves_cover_frames_between_observed_ones(dataset):
    act(dataset, "S001", stride=2)
    assert run(dataset, ["S001"]).ok
    row = read_suggestions(dataset, "S001")["smile"]
    assert len(row.activity) == FRAMES_EACH
    assert row.frame == pytest.approx(22, abs=2)
    assert row.frame % 2 == 0


def test_damaged_observations_raise_an_error_naming_the_file(dataset):
    act(dataset, "S001")
    path = dataset.observations_file("S001")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FormatError, match="observations.npz"):
        read_observations(dataset, "S001")


def test_changed_suggestion_replaces_the_old_automatic_mark(watched):
    assert run(watched).ok
    index = read_index(watched, "S001")
    mark = make_mark(index, "smile", 30, "cam01", AUTOMATIC)
    append_label(watched, replace(mark, suggested=30, confidence=0.5))
    assert run(watched, match=False).ok
    assert peaks(watched, "S001")["smile"]["frame"] == pytest.approx(22, abs=1)


def test_align_command_observes_first_and_reports_a_missing_face(dataset, capsys, no_faces):
    assert main(["align", str(dataset.root), "--workers", "0"]) == 1
    lines = capsys.readouterr().out
    assert "no camera sees a face" in lines
    assert "Traceback" not in lines
    assert main(["align", str(dataset.root), "--set", "matte.method=key"]) == 2
    assert "observe and align" in capsys.readouterr().err


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="1.5"):
        align.AlignConfig(accept=1.5)
    with pytest.raises(ConfigError, match="cameras"):
        observe.ObserveConfig(cameras=0)
