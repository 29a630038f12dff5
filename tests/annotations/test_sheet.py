"""The contact sheet shows every label in its place, on a page that fetches nothing."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from annotations.labels import AUTOMATIC, append_label, make_flag, make_mark
from annotations.sheet import STRIP_WIDTH, make_sheet, render_sheet, take_pictures
from annotations.ui.frames import crop_to
from express50.__main__ import main
from express50.capture.frames import read_proxy
from express50.capture.index import read_index
from express50.errors import UnknownNameError
from express50.files.images import decode_image
from tests.annotations.footage import suggest


@pytest.fixture
def labelled(suggested):
    """Labels of every kind; nothing at all for jaw_open of S002."""
    first, second = (read_index(suggested, s) for s in ("S001", "S002"))
    for label in (
        replace(make_mark(first, "neutral", 4, "cam01", AUTOMATIC), suggested=4, confidence=0.9),
        make_mark(first, "smile", 21, "cam00", "ann"),
        make_mark(first, "jaw_open", 47, "cam00", "rule:last-frame"),
        replace(make_mark(second, "neutral", 6, "cam01", AUTOMATIC), suggested=6, confidence=0.3),
        make_flag(second, "smile", "occluded <by> a hand", "bob"),
    ):
        append_label(suggested, label)
    suggest(suggested, {"S002": {"neutral": [4], "smile": [20]}})
    return suggested


class Page(HTMLParser):
    """The tiles of a page: attributes, picture's address and caption."""

    def __init__(self, text):
        super().__init__()
        self.tiles, self._inside = {}, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag == "figure":
            self._inside = attrs | {"img": "", "words": ""}
            self.tiles[attrs["data-subject"], attrs["data-expression"]] = self._inside
        elif tag == "img":
            self._inside["img"] = attrs["src"]

    def handle_endtag(self, tag):
        self._inside = None if tag == "figure" else self._inside

    def handle_data(self, data):
        if self._inside is not None:
            self._inside["words"] += data


def picture(address):
    head, code = address.split(",", 1)
    assert head == "data:image/jpeg;base64"
    return decode_image(base64.b64decode(code), "page")


def cells(sheet):
    return {(t.subject, t.expression): t for row in sheet.rows for t in row.tiles}


def test_tiles_show_the_label_in_force_and_its_origin(labelled):
    found = cells(make_sheet(labelled))
    said = {key: (t.state, t.frame, t.doubtful) for key, t in found.items()}
    assert said == {
        ("S001", "neutral"): ("auto", 4, False),
        ("S001", "smile"): ("person", 21, False),
        ("S001", "jaw_open"): ("rule", 47, False),
        ("S002", "neutral"): ("auto", 6, True),
        ("S002", "smile"): ("flagged", 20, False),
        ("S002", "jaw_open"): ("missing", None, False),
    }
    assert [t.reference for t in found.values()] == [True, False] * 3
    assert found["S002", "smile"].words == "occluded <by> a hand"
    assert cells(make_sheet(labelled, sure=0.2))["S002", "neutral"].doubtful is False


def test_disagreements_and_changed_footage_are_doubtful(labelled):
    index = read_index(labelled, "S001")
    append_label(labelled, make_mark(index, "smile", 28, "cam00", "bob"))
    mark = make_mark(index, "neutral", 4, "cam00", "ann")
    append_label(labelled, type(mark)(**vars(mark) | {"dhash": "0" * 16}))
    found = cells(make_sheet(labelled, subjects=["S001"]))
    assert found["S001", "smile"].words == "ann frame 21, bob frame 28"
    assert "other footage" in found["S001", "neutral"].words
    assert found["S001", "smile"].doubtful and found["S001", "neutral"].doubtful


def test_row_uses_one_camera_where_subjects_have_it(labelled):
    found = cells(make_sheet(labelled))
    assert {t.camera for t in found.values() if t.expression == "neutral"} == {"cam01"}
    assert found["S002", "smile"].camera == "cam00"  # the reference's
    everywhere = cells(make_sheet(labelled, camera="cam00")).values()
    assert {t.camera for t in everywhere if t.frame is not None} == {"cam00"}


@pytest.mark.parametrize(
    ("selection", "named"),
    [({"subjects": ["S9"]}, "S9"), ({"expressions": ["x"]}, "x"), ({"camera": "top"}, "top")],
)
def test_unknown_selection_raises_with_its_name(labelled, selection, named):
    with pytest.raises(UnknownNameError, match=named):
        make_sheet(labelled, **selection)


def test_page_shows_the_frames_without_external_resources(labelled):
    text = render_sheet(labelled, make_sheet(labelled), around=4)
    assert not re.search(r"https?://|<link|@import|src=\"(?!data:)", text)
    tiles = Page(text).tiles
    assert len(tiles) == 6
    shown = picture(tiles["S001", "smile"]["img"])
    frames = {n: read_proxy(labelled, "S001", "cam00", n) for n in (20, 21, 22)}
    whole = {n: crop_to(f, (0, -0.125, 1, 1.125), *shown.shape[1::-1]) for n, f in frames.items()}
    apart = {n: np.abs(shown.astype(int) - f).mean() for n, f in whole.items()}
    assert min(apart, key=apart.get) == 21 and apart[21] < 6
    strip = picture(tiles["S001", "smile"]["data-strip"])
    assert (tiles["S001", "smile"]["data-first"], strip.shape[1]) == ("17", 9 * STRIP_WIDTH)
    end = picture(tiles["S001", "jaw_open"]["data-strip"])
    assert end.shape[1] == 5 * STRIP_WIDTH  # frames beyond the window are another expression
    empty = tiles["S002", "jaw_open"]
    assert empty["img"] == "" and "no label" in empty["words"]
    assert "occluded <by> a hand" in tiles["S002", "smile"]["words"]
    assert "doubtful" in tiles["S002", "neutral"]["class"]
    assert "30%" in tiles["S002", "neutral"]["words"]


def test_unreadable_frame_is_reported_on_its_tile(labelled):
    tile = cells(make_sheet(labelled))["S001", "smile"]
    broken = type(tile)(**vars(tile) | {"frame": 999})
    assert "no frame 999" in take_pictures(labelled, broken, None, 0).problem


def test_unreadable_suggestions_and_exclusions_are_noted(labelled, capsys):
    labelled.suggestions_file("S001").write_text("[")
    assert main(["annotate", "exclude", str(labelled.root), "S002", "heavy makeup"]) == 0
    sheet = make_sheet(labelled)
    assert sheet.subjects == ["S001"]
    assert "express50 align" in sheet.notes[0] and "heavy makeup" in sheet.notes[1]


def test_the_command_writes_the_page_and_counts(labelled, tmp_path, capsys):
    file = tmp_path / "new" / "sheet.html"
    words = ["annotate", "sheet", str(labelled.root), str(file), "--subject", "S002", "--json"]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "sheet.html: drawing 6 labels\n" in printed.err  # before what may take minutes
    said = json.loads(printed.out)
    assert said["bytes"] == file.stat().st_size
    assert said["tiles"]["flagged"] == 1 and said["tiles"]["missing"] == 1
    page = Page(file.read_text())
    assert set(page.tiles["S002", "neutral"]) >= {"data-strip"}
    numbers = re.search("#strip span {.*?}", file.read_text())[0]
    assert "inset:100% 0 auto" in numbers and "background" not in numbers  # below the small faces
    assert main([*words[:4], "--camera", "top"]) == 2
    assert "top" in capsys.readouterr().err
    (tmp_path / "taken").write_text("x")
    for wrong in (tmp_path, tmp_path / "taken" / "sheet.html"):
        assert main([*words[:3], str(wrong)]) != 0
        assert "drawing" not in capsys.readouterr().err, "refused before the work"
