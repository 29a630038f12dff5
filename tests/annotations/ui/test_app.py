"""The real app through Textual's pilot: every key, every message, small terminals, no traceback."""

import asyncio
import fcntl
import gc
import json
import os
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.text import Text
from textual import events
from textual.widgets import Input

from annotations import cli
from annotations.labels import append_label, current_labels, make_mark, read_labels
from annotations.ui import app as app_module
from annotations.ui.panes import Aim, CurveStrip, PicturePane, other_cameras
from annotations.ui.task import TaskScene
from annotations.ui.theme import GROUPS
from annotations.ui.words import fit, hint_line
from express50.capture.index import read_index
from express50.errors import AnnotationError
from tests.annotations.footage import suggest


def piloted(app, act, size=(80, 22)):
    """Run the app; returns what ``act`` returns, which gets the pilot once the screen is drawn."""

    async def run():
        async with app.run_test(size=size) as pilot:
            await pilot.pause()
            return await act(pilot)

    return asyncio.run(run())


def drive(app, *keys, size=(80, 22), check=None):
    """Press keys in the app; returns what ``check`` says of it at the end."""

    async def act(pilot):
        for key in keys:
            await pilot.press(key)
        await pilot.pause()
        return check(app) if check else None

    return piloted(app, act, size)


def line(app, name):
    return app.desk.query_one(f"#{name}").content.plain


def strip_text(app):
    strip = app.desk.query_one(CurveStrip)
    return [line.text for line in strip.render_lines(strip.size.region)]


def labels(dataset, subject="S001"):
    return read_labels(dataset, subject)


def test_enter_accepts_the_suggestion_and_opens_the_next_task(suggested, make_app):
    app = make_app(suggested)
    task = drive(app, "enter", check=lambda app: app.session.task)
    (label,) = labels(suggested)
    assert (label.frame, label.keys, label.shown, label.camera) == (4, 1, True, "cam01")
    assert label.seconds < 30
    assert task.expression == "smile"


def test_every_movement_key_moves_the_cursor(suggested, make_app):
    table = [
        ("right", 21), ("left", 19), (".", 21), (",", 19), ("l", 21), ("h", 19),
        ("shift+right", 30), ("pagedown", 30), ("L", 30), ("pageup", 16), ("shift+left", 16),
        ("home", 16), ("0", 16), ("end", 31), ("$", 31), ("tab", 27), ("shift+tab", 27),
        ("1", 20), ("2", 27), ("5", 20),
    ]  # fmt: skip
    app = make_app(suggested, expressions=["smile"], subjects=["S001"])

    async def act(pilot):
        for key, frame in table:
            await pilot.press("1")
            assert app.desk.view.cursor == 20
            await pilot.press(key)
            assert (key, app.desk.view.cursor) == (key, frame)
            assert app.desk.query_one("#frame", PicturePane).look.frame == frame
        await pilot.press("g", "2", "9", "enter")
        assert app.desk.view.cursor == 29
        await pilot.press("g", "7", "enter")
        await pilot.pause()
        assert "7 is outside" in app.screen.query_one(Input).placeholder
        await pilot.press("escape")
        assert app.desk.view.cursor == 29

    piloted(app, act)


def test_plateau_is_stored_in_the_label(suggested, make_app):
    keys = ("left", "left", "[", "right", "right", "right", "]", "left", "enter")
    drive(make_app(suggested), *keys)
    (label,) = labels(suggested)
    assert (label.first, label.frame, label.last, label.keys) == (2, 4, 5, 9)


def test_frame_outside_its_plateau_is_refused_with_a_message(suggested, make_app):
    keys = ("]", "right", "enter")
    said = drive(make_app(suggested), *keys, check=lambda app: line(app, "message"))
    assert "not saved" in said
    assert "frame 5 is outside its plateau, 0 to 4" in said
    assert labels(suggested) == []


def test_flag_by_digit_or_in_words(suggested, make_app):
    app = make_app(suggested)
    drive(app, "f", "2", "f", "escape", "f", "5", *"tongueless", "enter")
    first, second = labels(suggested)
    assert (first.action, first.reason, first.keys) == ("flag", "occluded", 2)
    assert (second.expression, second.reason) == ("smile", "tongueless")


async def type_ahead(pilot, keys, done):
    """Deliver keys at once, as a slow line does; wait until they are done."""
    for key in keys:
        pilot.app.post_message(events.Key(key, key if len(key) == 1 else None))
    for _ in range(500):
        await pilot.pause(0.01)
        if done():
            return


def test_a_flag_typed_before_its_dialog_is_drawn_is_saved(suggested, make_app):
    piloted(make_app(suggested), lambda pilot: type_ahead(pilot, "f2", lambda: labels(suggested)))
    (flag,) = labels(suggested)
    assert (flag.reason, flag.keys) == ("occluded", 2)


def test_keys_typed_ahead_count_for_the_label_that_they_gave(suggested, make_app):
    keys = ("right", "enter", "left", "left", "enter", "f", "3")
    piloted(
        make_app(suggested),
        lambda pilot: type_ahead(pilot, keys, lambda: len(labels(suggested)) > 2),
    )
    assert [(label.frame, label.keys) for label in labels(suggested)] == [
        (5, 2), (18, 3), (None, 2),
    ]  # fmt: skip


def test_a_reason_typed_before_its_line_is_drawn_is_saved(suggested, make_app):
    keys = ("f", "5", *"tongueless", "enter")
    piloted(make_app(suggested), lambda pilot: type_ahead(pilot, keys, lambda: labels(suggested)))
    (flag,) = labels(suggested)
    assert (flag.reason, flag.keys) == ("tongueless", 13)


def test_a_frame_typed_before_its_dialog_is_drawn_is_opened(suggested, make_app):
    app = make_app(suggested)
    keys = ("g", "7", "enter")
    piloted(app, lambda pilot: type_ahead(pilot, keys, lambda: app.desk.view.cursor == 7))
    assert app.desk.view.cursor == 7
    assert app.session.effort().keys == 3


def test_a_digit_that_reaches_the_dialog_before_its_line_does_is_kept(suggested, make_app):
    app = make_app(suggested)

    async def act(pilot):
        await pilot.press("g")
        early = events.Key("1", "1")
        early._set_forwarded()  # as a busy app does that has no focus yet
        app.screen.post_message(early)
        await pilot.pause()
        await pilot.press("2", "enter")
        return app.desk.view.cursor

    assert piloted(app, act) == 12


def test_the_clock_rests_below_a_dialog_which_dims_nothing(suggested, make_app):
    """Each change below a dialog, and tinting, draws the whole screen again."""
    app = make_app(suggested)

    async def act(pilot):
        await pilot.press("f")
        before = line(app, "status")
        app.session._clock = lambda: app.session._last_key + 30
        app.desk._draw_status()
        below = line(app, "status")
        ground = app.screen.styles.background.a
        await pilot.press("escape")
        app.desk._draw_status()
        return before == below != line(app, "status"), ground

    assert piloted(app, act) == (True, 0)


@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
def test_q_and_what_ends_other_programs_quit(suggested, make_app, monkeypatch, key):
    quits = []

    async def leave(app):
        quits.append(app)

    monkeypatch.setattr(app_module.AnnotateApp, "action_quit", leave)
    app = make_app(suggested)
    drive(app, key)
    assert quits == [app]


@pytest.mark.parametrize("keys", [["f"], ["f", "5"], ["g"], ["question_mark"]])
def test_dialogs_can_be_left_as_other_programs(suggested, make_app, monkeypatch, keys):
    done = []
    for action in ("quit", "suspend_process"):
        kind = app_module.AnnotateApp
        monkeypatch.setattr(
            kind, f"action_{action}", lambda app, action=action: done.append(action)
        )
    drive(make_app(suggested), *keys, "ctrl+z", "ctrl+c")
    assert done == ["suspend_process", "quit"]


def test_no_picture_waits_for_the_garbage_collection(suggested, make_app):
    gc.set_threshold(700, 10, 10)
    assert drive(make_app(suggested), check=lambda app: gc.get_threshold()[0]) >= 50_000


def test_a_mark_against_a_settlement_says_that_it_does_not_count(suggested, make_app):
    mark = make_mark(read_index(suggested, "S001"), "neutral", 6, "cam01", "eve")
    append_label(suggested, replace(mark, action="settle"))
    said = drive(make_app(suggested), "enter", check=lambda app: line(app, "message"))
    assert "eve's settlement (frame 6) stays in force" in said


def test_undo_reopens_the_task_with_a_message(suggested, make_app):
    app = make_app(suggested)
    said = drive(app, "enter", "u", check=lambda app: line(app, "message"))
    assert "undone: S001 neutral frame 4" in said
    assert app.session.task.expression == "neutral"
    assert current_labels(labels(suggested)) == {}
    fresh = make_app(suggested, "bob")
    assert "nothing to undo" in drive(fresh, "u", check=lambda app: line(app, "message"))


def test_undo_says_that_it_takes_back_a_settlement(suggested, make_app):
    mark = make_mark(read_index(suggested, "S001"), "neutral", 6, "cam01", "ann")
    for label in (mark, replace(mark, action="settle")):
        append_label(suggested, label)
    app = make_app(suggested, subjects=["S001"], expressions=["neutral"])
    said = drive(app, "u", check=lambda app: line(app, "message"))
    assert "undone: S001 neutral settlement, frame 6" in said


def test_next_and_previous_leave_tasks_open(suggested, make_app):
    app = make_app(suggested)
    drive(app, "n", "n", "p")
    assert (app.session.task.expression, app.session.done) == ("smile", 0)
    assert "first task" in drive(make_app(suggested), "p", check=lambda app: line(app, "message"))


def test_earlier_mark_is_shown_on_return(suggested, make_app):
    app = make_app(suggested)
    title, strip = drive(
        app, "right", "enter", "p", size=(100, 32),
        check=lambda app: (line(app, "frame-title"), strip_text(app)),
    )  # fmt: skip
    assert "frame 5" in title
    assert "● your mark" in title
    assert "●" in strip[-1]


def test_blind_hides_the_references_own_frame_until_the_decision(suggested, make_app):
    append_label(suggested, make_mark(read_index(suggested, "S001"), "neutral", 7, "cam00", "bob"))
    app = make_app(suggested, blind=True, subjects=["S001"])
    shown = lambda app: line(app, "reference-title")  # noqa: E731
    before = drive(app, check=shown)
    assert "frame" not in before and "bob" not in before
    assert "frame" in drive(make_app(suggested, blind=True), "enter", "p", check=shown)
    other = make_app(suggested, blind=True, subjects=["S002"])
    assert "frame" in drive(other, check=shown)


def test_blind_hides_suggestions_curves_and_marks_until_the_decision(suggested, make_app):
    append_label(suggested, make_mark(read_index(suggested, "S001"), "smile", 22, "cam00", "bob"))
    app = make_app(suggested, blind=True, expressions=["smile"], subjects=["S001"])

    def look(app):
        return app.desk.view.cursor, "".join(strip_text(app))

    cursor, strip = drive(app, "tab", check=look)
    assert cursor == (16 + 31) // 2
    assert not set(strip) & set("○12▁▂▃▄▅▆▇█")
    drive(make_app(suggested, blind=True, expressions=["smile"], subjects=["S001"]), "enter")
    assert [x.shown for x in labels(suggested) if x.annotator == "ann"] == [False]
    open_again = make_app(suggested, blind=True, expressions=["smile"], subjects=["S001"])
    cursor, strip = drive(open_again, check=look)
    assert {"1", "2", "●", "█"} <= set(strip)


def test_narrow_lines_keep_the_essential_parts():
    line = fit(Text(" Jaw open  S001"), Text("2/24 done  25 s  0 keys and more"), 40)
    assert line.plain.startswith(" Jaw open  S001") and line.cell_len == 40
    assert fit(Text("x" * 50), Text("cam05"), 40).plain == "x" * 39 + "…"
    for width in (40, 60, 80, 200):
        assert hint_line(width, True).plain.rstrip().endswith("? help  q quit")
    assert hint_line(40, True).plain.startswith(" ←→ frame  Enter mark")


@pytest.mark.parametrize(
    ("subject", "hint"), [("S001", "find the clearest"), ("S002", "match the reference")]
)
def test_the_screen_says_what_to_look_for_and_how_sure_a_suggestion_is(
    suggested, make_app, subject, hint
):
    app = make_app(suggested, subjects=[subject])
    said, title = drive(app, check=lambda app: (line(app, "message"), line(app, "frame-title")))
    assert f"←→ {hint}  Enter mark" in said
    assert "suggested, 90% sure" in title


def test_help_scrolls_in_a_low_terminal(suggested, make_app):
    app = make_app(suggested)

    async def act(pilot):
        await pilot.press("question_mark")
        await pilot.pause()
        box = app.screen.query_one(".help")
        assert box.max_scroll_y > 0
        await pilot.press("end")
        await pilot.pause(0.5)
        assert box.scroll_y == box.max_scroll_y and len(app.screen_stack) == 3
        await pilot.press("x")
        await pilot.pause()
        assert len(app.screen_stack) == 2

    piloted(app, act, size=(80, 24))


def test_looking_keys_do_not_label(suggested, make_app, monkeypatch):
    monkeypatch.setattr(
        app_module, "FASTEST", 2.0
    )  # a busy machine must not reach the window's end
    app = make_app(suggested)

    async def act(pilot):
        frame = app.desk.query_one("#frame", PicturePane)
        zooms, cameras = [], []
        for _ in range(5):
            await pilot.press("z")
            zooms.append(frame.look.zoom)
        assert zooms == ["mouth", "eyes", "head", "frame", "face"]
        for key in "cc":
            await pilot.press(key)
            reference = app.desk.query_one("#reference", PicturePane).look
            cameras.append((frame.look.camera, reference.camera))
        assert cameras == [("cam00", "cam00"), ("cam01", "cam01")]
        await pilot.press("n", "n", "n", "b")  # smile of S002, against S001
        await pilot.pause()
        assert frame.look.subject == "S001"
        await pilot.press("left")
        assert (frame.look.subject, app.desk.player.blinks) == ("S002", False)
        await pilot.press("home", "space")
        for _ in range(100):
            await pilot.pause(0.1)
            if app.desk.view.cursor > app.desk.view.first:
                break
        await pilot.press("enter")  # stops; a moving frame cannot be meant
        assert not app.desk.player.plays
        assert labels(suggested, "S002") == []
        await pilot.press("question_mark", "x")

    piloted(app, act)


def test_a_second_camera_shows_the_same_moment(suggested, make_app):
    app = make_app(suggested)

    def panes(app):
        names = ("frame", "second", "reference")
        looks = [app.desk.query_one(f"#{name}", PicturePane).look for name in names]
        widths = [app.desk.query_one(f"#{name}").size.width for name in names]
        return app.desk.query_one("#middle").display, looks, widths

    async def act(pilot):
        assert not panes(app)[0]
        await pilot.press("s", "right", "right")
        await pilot.pause()
        shown, (frame, second, _), widths = panes(app)
        assert shown and max(widths) - min(widths) <= 1
        assert (frame.camera, second.camera, frame.frame, second.frame) == (
            "cam01", "cam00", 6, 6,
        )  # fmt: skip
        assert line(app, "second-title").split() == ["cam00", "the", "same", "moment"]
        await pilot.press("c")  # the first camera takes the second one's place
        assert [look.camera for look in panes(app)[1][:2]] == ["cam00", "cam01"]
        await pilot.press("enter")  # the next task: the choice stays
        await pilot.pause()
        shown, (frame, second, _), _ = panes(app)
        assert shown and (frame.frame, second.frame) == (20, 20)
        assert frame.camera != second.camera
        await pilot.resize_terminal(80, 24)
        await pilot.pause()
        async with asyncio.timeout(30):
            while panes(app)[0]:
                await pilot.pause(0.01)
        await pilot.press("s", "s")
        assert "needs 90 columns, this terminal has 80" in line(app, "message")
        await pilot.resize_terminal(110, 30)
        async with asyncio.timeout(30):
            while not panes(app)[0]:
                await pilot.pause(0.01)
        await pilot.press("s")
        assert not panes(app)[0]

    piloted(app, act, size=(110, 30))
    (label,) = labels(suggested)
    assert label.camera == "cam00"  # the mark names the first camera


def test_the_second_camera_is_chosen_among_the_others(suggested, make_app):
    scene = TaskScene(task=None, name="", description="", cameras=("a", "b", "c"))
    aim = Aim(1, "face", None)
    assert other_cameras(scene, aim) == ["a", "c"]
    assert other_cameras(scene, aim._replace(second="c")) == ["c", "a"]
    assert other_cameras(scene, aim._replace(second="b")) == ["a", "c"]
    app = make_app(suggested)

    def alone(app):
        app.desk.scene = replace(app.desk.scene, cameras=("cam01",))
        app.desk.action_next_second()
        picture = app.desk.query_one("#second", PicturePane)
        return picture.look, line(app, "second-title")

    assert drive(app, "s", size=(110, 30), check=alone) == (None, " second camera")


def test_play_stops_at_the_end_of_the_window_and_restarts(suggested, make_app, monkeypatch):
    monkeypatch.setattr(app_module, "FASTEST", 4.0)
    app = make_app(suggested)

    async def act(pilot):
        await pilot.press("end", "left", "space")
        for _ in range(100):
            await pilot.pause(0.1)
            if not app.desk.player.plays:
                break
        assert app.desk.view.cursor == app.desk.view.last
        assert not app.desk.player.plays
        await pilot.press("space")
        assert app.desk.player.plays
        assert app.desk.view.cursor < app.desk.view.last

    piloted(app, act)


def test_task_without_suggestion_opens_in_the_middle_with_a_message(dataset, make_app):
    app = make_app(dataset)
    cursor, message, right = drive(
        app,
        check=lambda app: (
            app.desk.view.cursor, line(app, "message"), app.desk.query_one("#reference").look,
        ),
    )  # fmt: skip
    assert cursor == 7
    assert "align" in message
    assert right is None
    drive(make_app(dataset), "tab", "b", "enter")
    (label,) = labels(dataset)
    assert (label.frame, label.suggested, label.shown) == (7, None, False)


def test_missing_proxies_and_footage_are_reported(suggested, make_app, footage):
    ingest = suggested.root / "ingest"
    ingest.unlink()
    shutil.copytree(footage.root / "ingest", ingest)
    for path in (ingest / "S001" / "proxies").iterdir():
        path.unlink()

    def picture_words(app):
        pane = app.desk.query_one("#frame", PicturePane)
        strips = pane.render_lines(pane.size.region)
        return " ".join(" ".join(strip.text for strip in strips).split())

    assert "proxies are missing" in drive(make_app(suggested), check=picture_words)
    said = drive(make_app(suggested), "enter", check=lambda app: line(app, "message"))
    assert "not marked: S001 cam01 frame 4" in said and labels(suggested) == []
    app = make_app(suggested)
    index = json.loads((ingest / "S001" / "index.json").read_text())
    index["cues"] = index["cues"][1:]
    (ingest / "S001" / "index.json").write_text(json.dumps(index))
    said = drive(app, "enter", "right", "z", "c", "[", "f", "1", "space", "b",
                 check=lambda app: line(app, "message"))  # fmt: skip
    assert "no footage of neutral" in said
    assert labels(suggested) == []


def test_empty_worklist_is_reported(suggested, make_app):
    app = make_app(suggested, expressions=["shout"])
    assert "nothing to label" in drive(app, "enter", "u", "n", "f", "1",
                                       check=lambda app: line(app, "message"))  # fmt: skip


def test_end_of_the_worklist_is_reported(suggested, make_app):
    app = make_app(suggested, subjects=["S002"])
    said = drive(app, *(["f", "3"] * 3), check=lambda app: line(app, "message"))
    assert "all 3 done" in said
    assert {x.action for x in labels(suggested, "S002")} == {"flag"}


@pytest.mark.parametrize("size", [(40, 12), (80, 24), (200, 60), (20, 6)])
def test_app_runs_in_terminals_of_any_size(suggested, make_app, size):
    app = make_app(suggested)
    keys = ("right", "z", "[", "f", "escape", "question_mark", "escape", "n")
    drive(app, *keys, size=size)
    assert app.session.task.expression == "smile"


def test_resize_keeps_the_position(suggested, make_app):
    app = make_app(suggested)

    async def act(pilot):
        await pilot.press("right")
        await pilot.resize_terminal(60, 18)
        strip = app.desk.query_one(CurveStrip)
        async with asyncio.timeout(30):  # the layout follows when the machine has time
            while strip.size.width != 60:
                await pilot.pause(0.01)
        assert app.desk.view.cursor == 5
        assert all(len(text) == 60 for text in strip_text(app))

    piloted(app, act)


def test_click_on_the_strip_moves_the_cursor(suggested, make_app):
    app = make_app(suggested)

    async def act(pilot):
        await pilot.click(CurveStrip, offset=(10 + 5 * 9 + 1, 0))
        assert app.desk.view.cursor == 9

    piloted(app, act, size=(90, 26))


def test_reference_of_another_camera_set_falls_back_to_its_own(suggested, make_app):
    rows = json.loads(suggested.suggestions_file("S001").read_text())
    assert rows["smile"]["camera"] == "cam01"
    suggest(suggested, {"S002": {"smile": [99]}})  # a suggestion outside the window
    app = make_app(suggested, subjects=["S002"], expressions=["smile"])
    assert drive(app, check=lambda app: app.desk.view.cursor) == 23


def test_no_key_is_bound_twice():
    keys = [k for group in GROUPS for key in group for k in key.keys.split(",")]
    assert len(keys) == len(set(keys))


def test_no_color_leaves_words_without_colours_and_pictures_in_grey(
    suggested, make_app, monkeypatch
):
    monkeypatch.setenv("NO_COLOR", "1")

    def colours(app):
        desk, found = app.desk, {}
        for name in ("status", "message", "strip", "frame"):
            widget = desk.query_one(f"#{name}")
            lines = widget.render_lines(widget.size.region)
            styles = [s.style for row in lines for s in row if s.style]
            shades = {c.get_truecolor() for s in styles for c in (s.color, s.bgcolor) if c}
            shades = {c for c in shades if c != (0, 0, 0)} if name != "frame" else shades
            found[name] = shades, any(style.reverse for style in styles)
        return found

    found = drive(make_app(suggested), size=(120, 40), check=colours)
    for name in ("status", "message", "strip"):
        assert not found[name][0], name
    assert found["status"][1] and found["strip"][1]  # what stands out is in reverse
    assert len(found["frame"][0]) > 3
    assert all(red == green == blue for red, green, blue in found["frame"][0])


@pytest.mark.parametrize(("term", "colorterm"), [("xterm", "truecolor"), ("xterm-256color", "")])
def test_pictures_are_grey_unless_the_terminal_says_that_it_has_all_colours(
    suggested, make_app, monkeypatch, term, colorterm
):
    monkeypatch.setenv("TERM", term)
    monkeypatch.setenv("COLORTERM", colorterm)

    def shades(app):
        frame = app.desk.query_one("#frame")
        styles = [s.style for row in frame.render_lines(frame.size.region) for s in row]
        return {c.get_truecolor() for s in styles for c in (s.color, s.bgcolor)}

    found = drive(make_app(suggested), check=shades)
    assert len(found) > 3
    assert all(red == green == blue for red, green, blue in found) == (not colorterm)


def test_ctrl_z_is_bound_and_in_the_help(suggested, make_app, monkeypatch):
    stopped = []

    def stop(app):
        stopped.append(app)

    monkeypatch.setattr(app_module.AnnotateApp, "action_suspend_process", stop)
    app = make_app(suggested)
    drive(app, "ctrl+z")
    assert stopped == [app]


@pytest.mark.parametrize(
    ("term", "encoding", "message"),
    [
        ("dumb", "utf-8", "TERM is 'dumb', which cannot position text"),
        ("", "utf-8", "TERM is '', which cannot position text"),
        ("xterm-256color", "ascii", "set LC_ALL=C.UTF-8"),
    ],
)
def test_terminals_that_cannot_be_drawn_on_are_refused(
    suggested, monkeypatch, term, encoding, message
):
    terminal = SimpleNamespace(isatty=lambda: True, fileno=lambda: 1, encoding=encoding)
    monkeypatch.setattr(cli, "sys", SimpleNamespace(stdin=terminal, stdout=terminal))
    monkeypatch.setenv("TERM", term)
    with pytest.raises(AnnotationError, match=re.escape(message)):
        cli._check_terminal(suggested.root)
    monkeypatch.setenv("TERM", "one-of-tomorrow")  # not in this machine's list
    terminal.encoding = "UTF-8"
    cli._check_terminal(suggested.root)


def read_until(terminal, words, seconds=60):
    """What a pseudo-terminal shows until it shows some bytes, or ends."""
    said, end = b"", time.monotonic() + seconds
    while words not in said and time.monotonic() < end:
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                said += os.read(terminal, 1 << 16)
            except OSError:  # no process has it open any more
                break
    return said


@pytest.fixture
def in_terminal(suggested):
    """The annotator's process in a pseudo-terminal, and our end of it."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    # Tests that run in the background ignore these signals, and so would their processes.
    start = (
        "import runpy; from signal import *; signal(SIGHUP, SIG_DFL); signal(SIGQUIT, SIG_DFL);"
        " runpy.run_module('express50', run_name='__main__')"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", start, "annotate", "ui", suggested.root, "--annotator", "ann"],
        stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"TERM": "xterm-256color"},
    )  # fmt: skip
    os.close(theirs)
    yield process, ours
    process.kill()
    process.wait()
    os.close(ours)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM])
def test_a_signal_saves_and_restores_the_terminal(suggested, in_terminal, number):
    process, terminal = in_terminal
    before = termios.tcgetattr(terminal)
    read_until(terminal, b"0/6")
    os.write(terminal, b"\xff\xe9")  # not UTF-8, as mice of old terminals send
    time.sleep(1.0)  # keys in the same read would be lost with it
    os.write(terminal, b"\r")
    read_until(terminal, b"1/6")
    process.send_signal(number)
    stopped = number == signal.SIGTERM
    said = read_until(terminal, b"interrupted" if stopped else b"to use the labels")
    assert b"\x1b[?1049l" in said  # back to the shell's screen
    assert process.wait(30) == (130 if stopped else 0)
    assert termios.tcgetattr(terminal) == before
    assert len(labels(suggested)) == 1
