"""Pictures beyond characters: what is sent is decoded again and is the picture that was meant."""

import asyncio
import base64
import re
import unicodedata

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textual.geometry import Size

from annotations.ui import kitty, painters
from annotations.ui.app import AnnotateApp
from annotations.ui.frames import Shot
from annotations.ui.picture import Picture, shot_of
from annotations.ui.session import open_session
from annotations.ui.sixel import COLOURS, encode_sixel, quantise
from annotations.ui.terminal import CellSize, choose_pictures
from express50.files.images import decode_image

SHOT = Shot("S1", "cam", 3, (0.0, 0.0, 1.0, 1.0), 8, 8)
MESSAGE = re.compile(r"\x1b_G([^;\x1b]*)(?:;([^\x1b]*))?\x1b\\")


def noise(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def smooth(height, width):
    y, x = np.mgrid[:height, :width]
    shade = 150 + 90 * np.sin(x / 17) * np.cos(y / 11)
    return (shade[..., None] * [1.0, 0.8, 0.7] + 20 * np.sin(y / 31)[..., None]).astype(np.uint8)


def kitty_pictures(text):
    """What a terminal would hold after these messages: number to (picture, columns, rows)."""
    held, data, head = {}, "", {}
    for keys, payload in MESSAGE.findall(text):
        said = dict(pair.split("=") for pair in keys.split(","))
        assert said["q"] == "2"  # an answer would be read as keys
        if said.get("a") == "d":
            assert said["d"] == "I"
            del held[int(said["i"])]
            continue
        assert len(payload) <= 4096 and (said["m"] == "0" or len(payload) % 4 == 0)
        head, data = head | said, data + payload
        if said["m"] == "0":
            assert (head["a"], head["U"], head["f"], head["t"]) == ("T", "1", "100", "d")
            image = decode_image(base64.b64decode(data), "kitty")
            held[int(head["i"])] = image, int(head["c"]), int(head["r"])
            data, head = "", {}
    assert data == ""
    return held


def placed(lines):
    """Number, and (row, column) of each cell of placeholder lines."""
    cells, numbers = [], set()
    signs = kitty.diacritics()
    for line in lines:
        for text, style, _ in line:
            for at in range(0, len(text), 3):
                mark, row, column = text[at : at + 3]
                if mark != kitty.PLACEHOLDER:
                    break
                cells.append((signs.index(row), signs.index(column)))
                numbers.add(int.from_bytes(bytes(style.color.triplet), "big"))
    return numbers, cells


def decode_sixel(text):
    """The picture of a sixel sequence, by the manual; pixels that nothing painted are -1."""
    body = re.fullmatch(r'\x1bP0;1;0q"1;1;(\d+);(\d+)(.*)\x1b\\', text, re.DOTALL)
    width, height = int(body[1]), int(body[2])
    image = np.full((-(-height // 6) * 6, width, 3), -1.0)
    palette, colour, x, y = {}, None, 0, 0
    token = re.compile(r"#(\d+);2;(\d+);(\d+);(\d+)|#(\d+)|!(\d+)([?-~])|([?-~])|([$-])")
    end = 0
    for found in token.finditer(body[3]):
        assert found.start() == end
        end = found.end()
        if found[1]:
            palette[int(found[1])] = np.array([int(found[k]) * 2.55 for k in (2, 3, 4)])
        elif found[5]:
            colour = palette[int(found[5])]
        elif found[9]:
            x, y = 0, y + 6 * (found[9] == "-")
        else:
            bits, count = ord(found[7] or found[8]) - 63, int(found[6] or 1)
            for row in range(6):
                if bits >> row & 1:
                    image[y + row, x : x + count] = colour
            x += count
            assert x <= width
    assert end == len(body[3])
    return image[:height], image[height:]


def test_the_table_of_diacritics_is_kittys():
    signs = kitty.diacritics()
    assert len(signs) == len(set(signs)) == 297
    assert {unicodedata.combining(sign) for sign in signs} == {230}
    assert [hex(ord(signs[n])) for n in (0, 1, 2, 3, 9, 296)] == [
        "0x305", "0x30d", "0x30e", "0x310", "0x34a", "0x1d244",
    ]  # fmt: skip


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (97, 61), (270, 240)])
def test_kitty_sends_the_very_picture_in_bounded_messages(shape):
    picture = noise(*shape)
    text = kitty.transmit(0x123456, kitty.encode_png(picture), 30, 20)
    assert MESSAGE.sub("", text) == ""
    (number, (image, columns, rows)) = kitty_pictures(text).popitem()
    assert (number, columns, rows) == (0x123456, 30, 20)
    np.testing.assert_array_equal(image, picture)


def test_placeholders_name_their_row_and_column_also_when_cut():
    lines = kitty.placeholder_strips(0xABCDEF, 6, 3)
    assert placed(lines) == ({0xABCDEF}, [(y, x) for y in range(3) for x in range(6)])
    assert [line.cell_length for line in lines] == [6, 6, 6]
    assert placed([lines[1].crop(2, 5)]) == ({0xABCDEF}, [(1, 2), (1, 3), (1, 4)])
    left, right = lines[2].divide([2, 6])
    assert (left.cell_length, placed([right])[1]) == (2, [(2, x) for x in range(2, 6)])


def test_kitty_forgets_what_is_not_kept_and_sends_nothing_twice():
    sent = []
    painter = painters.KittyPainter(sent.append, iter(range(70000, 80000)))
    pane = Size(4, 2)
    shots = [SHOT._replace(frame=n) for n in range(painters.KEPT + 3)]
    for shot in shots:
        painter.strips(shot, pane, lambda shot: np.full((8, 8, 3), shot.frame, np.uint8))
    before = len(sent)
    painter.strips(shots[-1], pane, noise)
    assert len(sent) == before
    held = kitty_pictures("".join(sent))
    assert sorted(image[0, 0, 0] for image, _, _ in held.values()) == list(range(3, len(shots)))


@settings(deadline=None, max_examples=40)
@given(height=st.integers(1, 40), width=st.integers(1, 40), colours=st.integers(1, COLOURS))
def test_sixels_of_few_colours_are_the_picture(height, width, colours):
    rng = np.random.default_rng(height * width + colours)
    few = (np.arange(colours)[:, None] * [97, 59, 31] % 32 * 8).astype(np.uint8)
    picture = few[rng.integers(0, colours, (height, width))]
    image, beyond = decode_sixel(encode_sixel(picture))
    assert np.abs(image - picture).max() <= 2  # a channel is sent in percent
    assert (beyond == -1).all()


def test_sixels_of_many_colours_are_near_the_picture_and_paint_every_pixel():
    picture = smooth(125, 90)
    palette, numbers = quantise(picture)
    image, _ = decode_sixel(encode_sixel(picture))
    assert len(palette) == COLOURS and image.min() >= 0
    assert np.abs(image - palette[numbers]).max() <= 1.3
    assert 10 * np.log10(255**2 / ((image - picture) ** 2).mean()) > 33


def test_sixels_follow_the_panes_last_cell_and_return_the_cursor():
    cell = CellSize(10, 21)
    painter = painters.SixelPainter(cell)
    pane = Size(12, 5)
    shape = painter.shape(pane)
    assert (shape.columns, shape.rows, shape.cell_aspect) == (12, 5, 2.1)
    picture = smooth(105, 120)
    lines = painter.strips(SHOT, pane, lambda shot: picture)
    assert [line.cell_length for line in lines] == [12] * 5
    assert all(not any(s.control for s in line) for line in lines[:-1])
    *blank, drawing = lines[-1]
    assert "".join(s.text for s in blank) == " " * 12
    start, end = "\x1b7\x1b[4A\x1b[12D", "\x1b8"
    assert drawing.style is None
    assert drawing.text.startswith(start) and drawing.text.endswith(end)
    image, _ = decode_sixel(drawing.text[len(start) : -len(end)])
    assert image.shape == picture.shape


def test_large_panes_send_no_more_pixels_than_the_limit():
    for pane in (Size(400, 150), Size(297, 120), Size(1000, 2)):
        for painter, limit in (
            (painters.SixelPainter(CellSize(11, 24)), painters.SIXEL_PIXELS),
            (painters.KittyPainter(lambda data: None, iter([1])), painters.KITTY_PIXELS),
        ):
            shape = painter.shape(pane)
            pixels = shape.columns * shape.across * shape.rows * shape.down
            assert 0.2 * limit < pixels <= limit


KITTY = {"TERM": "xterm-kitty", "KITTY_WINDOW_ID": "1"}


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        (KITTY, "kitty"),
        ({"TERM": "xterm-kitty"}, "kitty"),  # over ssh
        ({"TERM": "xterm-ghostty"}, "kitty"),
        ({"TERM": "xterm-256color", "TERM_PROGRAM": "ghostty"}, "kitty"),
        ({"TERM": "foot"}, "sixel"),
        ({"TERM": "xterm-256color", "TERM_PROGRAM": "WezTerm"}, "sixel"),
        ({"TERM": "xterm-256color", "LC_TERMINAL": "iTerm2"}, "sixel"),
        ({"TERM": "xterm-256color"}, "blocks"),
        ({}, "blocks"),
        (KITTY | {"TERM": "tmux-256color", "TMUX": "/tmp/x"}, "blocks"),
        (KITTY | {"TMUX": "/tmp/x"}, "blocks"),
        ({"TERM": "screen.xterm-256color"}, "blocks"),
        ({"TERM": "foot", "STY": "1.pts"}, "blocks"),
        ({"TERM": "xterm-256color", "KITTY_WINDOW_ID": "1", "TERM_PROGRAM": "vscode"}, "blocks"),
    ],
)
def test_pictures_are_chosen_by_what_the_terminal_says_of_itself(environ, expected, monkeypatch):
    cell = CellSize(8, 16)
    assert choose_pictures("auto", environ, is_terminal=True, cell=cell) == expected
    assert choose_pictures("auto", environ, is_terminal=False, cell=cell) == "blocks"
    assert choose_pictures("halfblocks", environ, is_terminal=True) == "halfblocks"
    if expected == "sixel":  # nobody knows how many pixels a pane has
        monkeypatch.setattr("annotations.ui.terminal.cell_size", lambda: None)
        assert choose_pictures("auto", environ, is_terminal=True) == "blocks"


class Recorder(AnnotateApp):
    """The app, with what it writes to the terminal."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.raw, self.drawn = "", ""

    def write_raw(self, data):
        self.raw += data

    def _display(self, screen, renderable):
        super()._display(screen, renderable)
        if hasattr(renderable, "render_segments"):
            self.drawn += renderable.render_segments(self.console)


def shown(app, name="frame"):
    """The picture that a pane is meant to show."""
    pane = app.desk.query_one(f"#{name}", Picture)
    return pane, app.cache.get(shot_of(pane.look, pane.shape))


def test_the_app_shows_by_kitty_what_it_means_and_characters_below_a_dialog(suggested):
    app = Recorder(open_session(suggested, "ann", order="subject"), pictures="kitty")

    async def run():
        async with app.run_test(size=(80, 22)) as pilot:
            for key in ("right", "right", "left"):
                await pilot.press(key)
            await pilot.pause()
            held = kitty_pictures(app.raw)
            assert len(held) <= 4  # three frames and the reference, each sent once
            for name in ("frame", "reference"):
                pane, picture = shown(app, name)
                lines = pane.render_lines(pane.size.region)
                (number,), cells = placed(lines)
                np.testing.assert_array_equal(held[number][0], picture)
                assert held[number][1:] == pane.size
                assert len(cells) == pane.size.area
            panes = [app.desk.query_one(f"#{name}", Picture) for name in ("frame", "reference")]
            await pilot.press("question_mark")
            await pilot.pause()
            before, app.drawn = app.raw, ""
            await pilot.press("escape")
            await pilot.pause()
            assert app.raw == before
            cells = sum(pane.size.area for pane in panes)
            assert app.drawn.count(kitty.PLACEHOLDER) in (cells, 2 * cells)

    asyncio.run(run())


def test_the_app_draws_sixels_and_none_over_a_dialog(suggested):
    app = Recorder(
        open_session(suggested, "ann", order="subject"), pictures="sixel", cell=CellSize(7, 15)
    )

    async def run():
        async with app.run_test(size=(80, 22)) as pilot:
            await pilot.press("right")
            await pilot.pause()
            pane, picture = shown(app)
            found = re.findall(r"\x1bP0;1;0q.*?\x1b\\", app.drawn, re.DOTALL)
            images = [decode_sixel(text)[0] for text in found]
            same = [i for i in images if i.shape == picture.shape]
            assert min(np.abs(i - picture).mean() for i in same) < 6
            assert picture.shape == (pane.size.height * 15, pane.size.width * 7, 3)
            await pilot.press("f")
            app.drawn = ""
            await pilot.press("x")
            pane.refresh()
            await pilot.pause()
            assert "\x1bP" not in app.drawn
            await pilot.press("escape")
            await pilot.pause()
            assert app.drawn.count("\x1bP") >= 2  # two panes; a slow machine draws them again

    asyncio.run(run())
