"""Every action of ``express50 annotate`` without a screen, through the command line."""

import csv
import io
import json

import numpy as np
import pytest

from annotations.observe.stage import read_observations
from annotations.suggestions import reference_subject
from annotations.validate import MarkedClip, agreement, interval_alpha
from express50.__main__ import main
from express50.capture.index import read_peak_rows
from express50.contract.layout import Dataset, included_subjects
from express50.dataset.export import tracked_subjects
from express50.dataset.tracks import existing_track
from express50.errors import StageError

from .labelled import EXPRESSIONS, make_dataset, suggest


@pytest.fixture
def dataset(tmp_path):
    found = make_dataset(tmp_path / "data")
    suggest(found, "S001", {"neutral": (2, 0.9), "smile": (14, 0.2)})
    return found


@pytest.fixture
def annotate(dataset, capsys):
    def call(action, *words, code=0):
        assert main(["annotate", action, str(dataset.root), *words, "--json"]) == code
        return json.loads(capsys.readouterr().out)

    return call


def mark(annotate, who, expression, frame, subject="S001"):
    return annotate("mark", subject, expression, str(frame), "--annotator", who)


@pytest.mark.parametrize(
    ("read", "command"),
    [
        (reference_subject, "ingest"),
        (lambda data: read_observations(data, "S001"), "align"),
        (lambda data: read_peak_rows(data, "S001"), "align"),
        (lambda data: existing_track(data, "S001"), "track"),
        (lambda data: tracked_subjects(data, []), "track"),
    ],
)
def test_advised_commands_name_the_dataset(tmp_path, read, command):
    root = tmp_path / "my data"
    with pytest.raises(StageError) as caught:
        read(Dataset(root))
    assert f"run \"express50 {command} '{root}'" in str(caught.value)


def test_suggest_lists_least_sure_first_and_next_follows(annotate):
    assert [row["expression"] for row in annotate("suggest")] == ["smile", "neutral"]
    first = annotate("next", "--annotator", "ann", "--subject", "S001")
    assert [t["expression"] for t in first["tasks"]] == ["wink_left", "smile", "neutral"]
    mark(annotate, "ann", "wink_left", 24)
    left = annotate("next", "--annotator", "ann", "--subject", "S001")
    assert left["left"] == 2


def test_mark_stores_the_suggestion_and_undo_removes_the_mark(annotate):
    label = mark(annotate, "ann", "smile", 15)
    assert (label["suggested"], label["confidence"], label["dhash"]) == (14, 0.2, f"{15:016x}")
    assert [row["frame"] for row in annotate("labels")] == [15]
    annotate("undo", "S001", "smile", "--annotator", "ann")
    assert annotate("labels") == []


def test_status_counts_people_rules_and_flags(annotate):
    mark(annotate, "ann", "smile", 14)
    annotate("flag", "S001", "wink_left", "occluded", "--annotator", "ann")
    status = annotate("status")
    row = status["subjects"][0]
    assert (row["by_person"], row["flagged"], row["expressions"]) == (1, 1, len(EXPRESSIONS))
    assert status["annotators"]["ann"]["labels"] == 2
    annotate("undo", "S001", "smile", "--annotator", "ann")
    assert annotate("status")["annotators"]["ann"]["labels"] == 1


def test_labels_of_an_expression_that_is_gone_do_not_count(annotate, dataset):
    mark(annotate, "ann", "smile", 14)
    mark(annotate, "ann", "neutral", 2)
    index = json.loads(dataset.index_file("S001").read_text())
    cues = [cue for cue in index["cues"] if "smile" not in str(cue)]  # renamed in cues.csv
    assert len(cues) == len(index["cues"]) - 1
    dataset.index_file("S001").write_text(json.dumps(index | {"cues": cues}))
    row = annotate("status")["subjects"][0]
    assert (row["by_person"], row["expressions"]) == (1, len(EXPRESSIONS) - 1)


def test_agree_measures_and_review_settles_without_losing_labels(annotate):
    for who, smile, wink in (("ann", 12, 24), ("bob", 18, 25)):
        mark(annotate, who, "smile", smile)
        mark(annotate, who, "wink_left", wink)
    found = annotate("agree")
    assert found["overall"]["within_1"] == 0.5 and found["overall"]["median_frames"] == 3.5
    assert set(found["pairs"]) == {"ann+bob"} and set(found["expressions"]) == {
        "smile",
        "wink_left",
    }
    (row,) = annotate("review")
    assert (row["expression"], row["spread"]) == ("smile", 6)
    annotate("review", "--settle", "S001", "smile", "bob", "--annotator", "eve")
    assert annotate("review") == []
    (settled,) = annotate("review", "--all")
    assert settled["said"] == {"ann": "frame 12", "bob": "frame 18"}
    force = {row["expression"]: row["frame"] for row in annotate("labels")}
    assert force["smile"] == 18


def test_a_mark_against_a_settlement_says_that_it_does_not_count(annotate, dataset, capsys):
    for who, frame in (("ann", 12), ("bob", 18)):
        mark(annotate, who, "smile", frame)
    annotate("review", "--settle", "S001", "smile", "bob", "--annotator", "eve")
    root = str(dataset.root)
    assert main(["annotate", "mark", root, "S001", "smile", "13", "--annotator", "ann"]) == 0
    said = capsys.readouterr().out
    assert "eve's settlement (frame 18) stays in force" in said and "to use it" not in said
    assert main(["annotate", "undo", root, "S001", "smile", "--annotator", "eve"]) == 0
    assert "to use it" in capsys.readouterr().out


def test_review_counts_settled_disagreements_apart(annotate, dataset, capsys):
    for expression in ("smile", "wink_left"):
        start = 10 * EXPRESSIONS.index(expression)
        mark(annotate, "ann", expression, start)
        mark(annotate, "bob", expression, start + 5)
    annotate("review", "--settle", "S001", "smile", "bob", "--annotator", "eve")
    assert main(["annotate", "review", str(dataset.root), "--all"]) == 0
    assert "1 to review, 1 settled" in capsys.readouterr().out


def test_alpha_is_krippendorffs_on_time_within_the_clip():
    # two annotators; the pairwise definition, written out
    values = [np.array([0.1, 0.2]), np.array([0.5, 0.5]), np.array([0.9, 0.6])]
    flat = np.concatenate(values)
    expected = np.mean(
        [(a - b) ** 2 for i, a in enumerate(flat) for j, b in enumerate(flat) if i != j]
    )
    observed = np.mean([(v[0] - v[1]) ** 2 for v in values])
    assert interval_alpha(values) == pytest.approx(1 - observed / expected)
    assert interval_alpha([np.array([0.3, 0.3])] * 4) is None
    far = [
        MarkedClip("S", f"e{k}", 1000 * k, 11, {"a": 1000 * k, "b": 1000 * k + 10})
        for k in range(5)
    ]
    assert agreement(far)["alpha"] < 0  # frame numbers alone would say nearly 1
    assert agreement([])["alpha"] is None
    assert agreement(far[:1])["alpha"] is None  # its spread is also the expected one


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_export_and_import_round_trip_without_loss_or_duplicates(
    annotate, dataset, tmp_path, ending
):
    mark(annotate, "ann", "smile", 14)
    annotate("flag", "S002", "smile", "failed: blinked, twice", "--annotator", "bob")
    annotate("exclude", "S002", "heavy makeup", "--annotator", "bob")
    annotate("flag", "S001", "neutral", '=cmd|" /C calc"!A0', "--annotator", "'-'")
    annotate("flag", "S002", "neutral", "'quoted' = said", "--annotator", "ann")
    file = tmp_path / f"labels.{ending}"
    assert annotate("export", str(file))["events"] == 5
    if ending == "csv":  # a spreadsheet must not run a reason
        assert not any(
            cell.startswith("=")
            for row in csv.reader(file.read_text().splitlines())
            for cell in row
        )
    assert annotate("import", str(file)) == {"file": str(file), "new": 0, "known": 5}
    before = {s: dataset.labels_file(s).read_text() for s in ("S001", "S002")}
    for subject in before:
        dataset.labels_file(subject).unlink()
    assert annotate("import", str(file))["new"] == 5
    assert {s: dataset.labels_file(s).read_text() for s in before} == before


@pytest.mark.parametrize("between", [";", "\t"])
def test_a_table_that_a_spreadsheet_wrote_is_imported(annotate, dataset, tmp_path, between, capsys):
    annotate("flag", "S002", "smile", "failed: blinked, twice", "--annotator", "bob")
    annotate("export", str(tmp_path / "labels.csv"))
    rows = csv.reader((tmp_path / "labels.csv").read_text().splitlines())
    text = io.StringIO()
    csv.writer(text, delimiter=between).writerows([*rows, 18 * [""]])
    file = tmp_path / "LABELS.CSV"
    file.write_bytes(text.getvalue().encode("utf-8-sig"))
    assert annotate("import", str(file)) == {"file": str(file), "new": 0, "known": 1}
    file.write_bytes(text.getvalue().encode("utf-16"))
    assert main(["annotate", "import", str(dataset.root), str(file)]) == 1
    assert "is UTF-16 text; save it as UTF-8" in capsys.readouterr().err


def test_numbers_that_a_spreadsheet_rounded_do_not_bring_old_labels_back(
    annotate, dataset, tmp_path, capsys
):
    mark(annotate, "ann", "smile", 14)
    file = tmp_path / "labels.csv"
    annotate("export", str(file))
    with file.open() as table:
        (row,) = csv.DictReader(table)
    mark(annotate, "ann", "smile", 15)

    def bring(**change):
        with file.open("w") as table:
            writer = csv.DictWriter(table, row, delimiter=";")
            writer.writeheader()
            writer.writerow(row | change)
        return main(["annotate", "import", str(dataset.root), str(file)])

    time = row["time"]
    for saved in (f"{float(time):.15g}", f"{float(time):.0f}", time.replace(".", ",")):
        assert bring(time=saved, confidence="0,2", shown=row["shown"].upper()) == 0
        assert "0 new events, 1 known already" in capsys.readouterr().out
    assert [label["frame"] for label in annotate("labels")] == [15]
    assert bring(annotator="eve", shown="FALSE") == 0
    for change in ({"time": "1.8E+09"}, {"dhash": "1.23457E+15"}):
        assert bring(annotator="zoe", **change) == 1
        assert "a spreadsheet changed it: export again" in capsys.readouterr().err


def test_export_replaces_no_events_that_are_not_stored(annotate, dataset, tmp_path, capsys):
    """Somebody may have typed export for import."""
    mark(annotate, "ann", "smile", 14)
    file = tmp_path / "labels.json"
    annotate("export", str(file))
    assert annotate("export", str(file), "--subject", "S002")["events"] == 0  # all are stored
    annotate("export", str(file))
    rows = json.loads(file.read_text())
    for text, error in (
        (json.dumps([*rows, rows[0] | {"annotator": "bob"}]), "holds 1 event that the dataset"),
        ('{"my": "notes"}', "is not a table of labels; name another file"),
    ):
        file.write_text(text)
        assert main(["annotate", "export", str(dataset.root), str(file)]) == 1
        assert error in capsys.readouterr().err and file.read_text() == text
    form = tmp_path / "form.csv"
    form.write_text("name,age\n")  # to be filled in
    for action, error in (("export", "is not a table of labels"), ("import", "which have subject")):
        assert main(["annotate", action, str(dataset.root), str(form)]) == 1
        assert error in capsys.readouterr().err and form.read_text() == "name,age\n"


@pytest.mark.parametrize("name", ["labels.csv", "labels.json"])
def test_importing_a_table_without_rows_says_so(annotate, dataset, tmp_path, capsys, name):
    annotate("export", str(tmp_path / name))
    assert main(["annotate", "import", str(dataset.root), str(tmp_path / name)]) == 0
    assert "has no rows of events; nothing was imported" in capsys.readouterr().out


def test_import_of_another_datasets_frame_writes_nothing(annotate, dataset, tmp_path, capsys):
    mark(annotate, "ann", "smile", 14)
    file = tmp_path / "labels.json"
    annotate("export", str(file))
    rows = json.loads(file.read_text())
    rows[0]["dhash"] = "f" * 16
    file.write_text(json.dumps(rows))
    dataset.labels_file("S001").unlink()
    assert main(["annotate", "import", str(dataset.root), str(file)]) != 0
    assert "row 1" in capsys.readouterr().err
    assert not dataset.labels_file("S001").exists()


def test_rule_marks_last_frames_once_and_ranks_below_people(annotate):
    assert annotate("rule") == []  # no RenderMe-360 expression here
    marks = annotate("rule", "--expression", "smile", "--subject", "S001")
    assert [m["frame"] for m in marks] == [19]
    assert annotate("rule", "--expression", "smile", "--subject", "S001") == []
    mark(annotate, "ann", "smile", 14)
    assert [row["frame"] for row in annotate("labels")] == [14]


def test_exclude_and_include_a_subject(annotate, dataset):
    annotate("exclude", "S002", "large glasses", "--annotator", "ann")
    report = annotate("coverage")
    assert report["excluded"] == {"S002": "large glasses"}
    assert included_subjects(dataset) == ["S001"] and report["gender"] == report["age"] == {}
    annotate("include", "S002", "--annotator", "ann")
    assert included_subjects(dataset) == ["S001", "S002"]


def test_excluding_the_chosen_reference_asks_for_another(annotate, dataset, capsys):
    annotate("reference", "S001")
    for subject, asks in (("S002", False), ("S001", True)):
        assert main(["annotate", "exclude", str(dataset.root), subject, "glasses"]) == 0
        assert ("choose one of" in capsys.readouterr().out) is asks
        annotate("include", subject)


def test_validate_finds_a_frame_that_is_not_the_one_labelled(annotate, dataset):
    mark(annotate, "ann", "smile", 14)
    assert annotate("validate")["ok"] is True
    path = dataset.labels_file("S001")
    path.write_text(path.read_text().replace(f"{14:016x}", "0" * 16))
    found = annotate("validate", code=1)
    assert found["counts"]["identity"] == 1


def test_validate_passes_over_labels_of_expressions_that_the_cues_no_longer_name(annotate, dataset):
    mark(annotate, "ann", "smile", 14)
    path = dataset.index_file("S001")
    index = json.loads(path.read_text())
    index["cues"] = [cue for cue in index["cues"] if "smile" not in str(cue)]
    path.write_text(json.dumps(index))
    assert annotate("validate")["ok"] is True


def test_validate_counts_unreadable_lines(annotate, dataset):
    mark(annotate, "ann", "smile", 14)
    path = dataset.labels_file("S001")
    path.write_text("garbage\n" + path.read_text() + '{"a')
    found = annotate("validate", code=1)
    assert found["counts"]["unreadable"] == 2
    assert [row["frame"] for row in annotate("labels")] == [14]


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        (', "expression"', ' "expression"', "not JSON"),
        ('"annotator"', '"anotator"', "no annotator"),
        ('"frame": 14', '"frame": "14"', "frame is '14'"),
        ('"frame"', '"fame"', "needs a frame"),
        ('"mark"', '"mrk"', "'mrk'"),
    ],
)
def test_a_line_that_was_edited_wrongly_is_an_error(
    annotate, dataset, capsys, before, after, named
):
    mark(annotate, "ann", "smile", 14)
    path = dataset.labels_file("S001")
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    assert main(["annotate", "labels", str(dataset.root)]) != 0
    error = capsys.readouterr().err
    assert "line 1" in error and named in error and error.count("\n") == 1


def test_one_person_is_one_annotator_however_the_name_is_typed(annotate):
    mark(annotate, "Zoë ", "smile", 14)
    assert mark(annotate, "Zoe\u0308", "smile", 15)["annotator"] == "Zoë"
    assert annotate("agree")["expressions"] == {}


def test_undo_and_review_say_what_they_mean(annotate, dataset, capsys):
    mark(annotate, "ann", "smile", 14)
    mark(annotate, "ann", "smile", 15)
    words = ["--annotator", "ann"]
    assert main(["annotate", "undo", str(dataset.root), "S001", "smile", *words]) == 0
    said = capsys.readouterr().out
    assert "frame 15 undone by ann; now frame 14 by ann is in force; run" in said
    mark(annotate, "bob", "smile", 16)
    assert main(["annotate", "undo", str(dataset.root), "S001", "smile", *words]) == 0
    assert "frame 14 undone by ann; now frame 16 by bob is in force" in capsys.readouterr().out
    assert main(["annotate", "undo", str(dataset.root), "S001", "smile", *words]) == 1
    assert "ann has no label on it to undo; frame 16 by bob is" in capsys.readouterr().err
    assert main(["annotate", "review", str(dataset.root)]) == 0
    assert "at most 2 frames apart agree" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["review", "--settle", "S001", "smile", "nobody"], "'nobody'"),
        (["undo", "S001", "neutral"], "neutral"),
        (["flag", "S001", "smile", "a\rb"], repr("a\rb")),
        (["mark", "S001", "smile", "14", "--annotator", "a\x1b[31m"], repr("a\x1b[31m")),
        (["include", "S001"], "S001 is not excluded"),
    ],
)
def test_invalid_input_prints_one_line_naming_it(annotate, dataset, capsys, words, named):
    mark(annotate, "ann", "smile", 14)
    before = dataset.labels_file("S001").read_bytes()
    action, *rest = words
    assert main(["annotate", action, str(dataset.root), *rest]) == 1
    err = capsys.readouterr().err
    assert named in err and err.count("\n") == 1
    assert dataset.labels_file("S001").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["next", "--count", "-3"], "--count: got '-3', expected a whole number, 0 to"),
        (["review", "--beyond", "-1"], "'-1', expected a whole number, 0 to"),
        (["sheet", "labels.csv"], "labels.csv: expected the name of a page, which ends in .html"),
        (["sheet", "x.html", "--sure", "9"], "--sure: got '9', expected a number, 0 to 1"),
        (["sheet", "x.html", "--sure", "nan"], "got 'nan'"),
        (["review", "--settle", "S009", "smile", "14"], "no subject 'S009'"),
        (["rule", "--expression", "smlie"], "no expression 'smlie'"),
    ],
)
def test_wrong_usage_is_refused(dataset, capsys, words, named):
    action, *rest = words
    assert main(["annotate", action, str(dataset.root), *rest]) == 2
    assert named in capsys.readouterr().err


def test_a_disagreement_is_settled_by_a_reason_in_words(annotate):
    mark(annotate, "ann", "smile", 14)
    annotate("review", "--settle", "S001", "smile", "flag:eyes shut", "--annotator", "eve")
    (label,) = annotate("labels")
    assert (label["action"], label["reason"]) == ("settle", "eyes shut")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frame": None}, "frame"),
        ({"expression": "nope"}, "'nope'"),
        ({"reason": "a\nb"}, repr("a\nb")),
        ({"camera": "z"}, "'z'"),
        ({"dhash": "f" * 16}, "f" * 16),
        ({"pts": 3}, "pts 140"),
        ({"expression": ""}, "no expression; expected columns"),
        ({"frame": "1e9"}, "frame is '1e9', expected a whole number"),
    ],
)
def test_import_refuses_invalid_events(annotate, dataset, tmp_path, capsys, change, named):
    mark(annotate, "ann", "smile", 14)
    file = tmp_path / "labels.json"
    annotate("export", str(file))
    row = json.loads(file.read_text())[0] | {"annotator": "bob"} | change
    file.write_text(json.dumps([{k: v for k, v in row.items() if v is not None}]))
    before = dataset.labels_file("S001").read_bytes()
    assert main(["annotate", "import", str(dataset.root), str(file)]) == 1
    assert named in capsys.readouterr().err
    assert dataset.labels_file("S001").read_bytes() == before


def test_an_exclusion_is_imported_though_the_subject_has_no_cues(annotate, dataset, tmp_path):
    path = dataset.index_file("S001")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"cues": []}))
    annotate("exclude", "S001", "no script", "--annotator", "ann")
    annotate("export", str(tmp_path / "labels.csv"))
    dataset.labels_file("S001").unlink()
    assert annotate("import", str(tmp_path / "labels.csv"))["new"] == 1
    assert included_subjects(dataset) == ["S002"]


def test_without_a_login_name_the_annotator_must_be_given(annotate, dataset, monkeypatch, capsys):
    def nobody():
        raise KeyError("getpwuid(): uid not found: 54321")  # as in a container of another user

    monkeypatch.setattr("getpass.getuser", nobody)
    assert annotate("flag", "S001", "smile", "failed", "--annotator", "ann")["annotator"] == "ann"
    assert main(["annotate", "flag", str(dataset.root), "S001", "smile", "failed"]) == 2
    assert "--annotator" in capsys.readouterr().err
    assert annotate("status")["annotators"]["ann"]["labels"] == 1


def test_reference_is_the_first_unless_chosen(annotate):
    assert annotate("reference") == {"reference": "S001"}
    assert annotate("reference", "S002") == {"reference": "S002"}


@pytest.mark.parametrize(
    ("action", "rows"),
    [
        ("status", [["S001", "3", "1", "0", "0", "0", "-"], ["ann", "1", "-", "0.0", "-", "1.0"]]),
        ("labels", [["S001", "smile", "frame", "14", "ann"]]),
        ("coverage", [["S001", "1", "0", "0", "0", "2"], ["S002", "0", "0", "0", "0", "3"]]),
        ("agree", [["all", "1", "0.0", "0.0", "1.0", "4.0", "0.0", "-"]]),
        ("suggest", [["S001", "smile", "14", "0.2", "peak"]]),
        ("next", [["S001", "neutral", "0.10"], ["S002", "smile", "1.00"]]),
    ],
)
def test_verbs_print_tables(annotate, dataset, capsys, action, rows):
    mark(annotate, "ann", "smile", 14)
    if action == "agree":
        mark(annotate, "bob", "smile", 18)
    words = ["--annotator", "ann"] if action == "next" else []
    assert main(["annotate", action, str(dataset.root), *words]) == 0
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row for row in rows if row not in printed] == []


def test_a_folder_that_is_not_a_dataset_is_refused(tmp_path, capsys):
    assert main(["annotate", "status", str(tmp_path)]) == 2
    assert f"{tmp_path}: not a dataset" in capsys.readouterr().err


def test_the_terminal_does_not_open_without_included_subjects(annotate, dataset, capsys):
    for subject in ("S001", "S002"):
        annotate("exclude", subject, "large glasses")
    assert main(["annotate", "ui", str(dataset.root)]) == 1
    assert "no subject is ingested, or all are excluded" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["auto", "rule:last-frame", " "])
def test_the_toolkits_own_names_are_refused(dataset, name):
    words = ["S001", "smile", "failed", "--annotator", name]
    assert main(["annotate", "flag", str(dataset.root), *words]) != 0
    assert not dataset.labels_file("S001").exists()


def test_a_flag_is_shown_with_its_reason_and_its_author(dataset, tmp_path, capsys):
    root = str(dataset.root)
    assert main(["annotate", "flag", root, "S001", "smile", "failed", "--annotator", "me"]) == 0
    assert capsys.readouterr().out.startswith("S001 smile: flagged 'failed' by me; run ")
    assert main(["annotate", "export", root, str(tmp_path / "l.csv"), "--subject", "S001"]) == 0
    assert "1 event of 1 subject\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["S009", "smile", "3"], ["S001", "smil", "3"], ["S001", "smile", "9", "--camera=x"]]
)
def test_a_name_that_is_not_there_is_wrong_usage(dataset, words, capsys):
    assert main(["annotate", "mark", str(dataset.root), *words]) == 2
    assert "expected one of" in capsys.readouterr().err
    assert not dataset.labels_file("S001").exists()
