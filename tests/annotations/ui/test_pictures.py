"""Sixels that are sent are decoded again and are the picture that was meant."""

import asyncio
import re

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from textual.geometry import Size

from annotations.ui.app import AnnotateApp
from annotations.ui.frames import FrameCrop
from annotations.ui.images import COLOURS, SIXEL_PIXELS, SixelPainter, encode_sixel, quantise
from annotations.ui.panes import PicturePane, shot_of
from annotations.ui.session import Session

SHOT = FrameCrop("S1", "cam", 3, (0.0, 0.0, 1.0, 1.0), 8, 8)


def smooth(height, width):
    y, x = np.mgrid[:height, :width]
    shade = 150 + 90 * np.sin(x / 17) * np.cos(y / 11)
    return (shade[..., None] * [1.0, 0.8, 0.7] + 20 * np.sin(y / 31)[..., None]).astype(np.uint8)


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


@settings(deadline=None, max_examples=40)
@given(height=st.integers(1, 40), width=st.integers(1, 40), colours=st.integers(1, COLOURS))
def test_sixels_of_few_colours_decode_to_the_picture(height, width, colours):
    rng = np.random.default_rng(height * width + colours)
    few = (np.arange(colours)[:, None] * [97, 59, 31] % 32 * 8).astype(np.uint8)
    picture = few[rng.integers(0, colours, (height, width))]
    image, beyond = decode_sixel(encode_sixel(picture))
    assert np.abs(image - picture).max() <= 2  # a channel is sent in percent
    assert (beyond == -1).all()


def test_sixels_of_many_colours_approximate_the_picture():
    picture = smooth(125, 90)
    palette, numbers = quantise(picture)
    image, _ = decode_sixel(encode_sixel(picture))
    assert len(palette) == COLOURS and image.min() >= 0
    assert np.abs(image - palette[numbers]).max() <= 1.3
    assert 10 * np.log10(255**2 / ((image - picture) ** 2).mean()) > 33


def test_sixels_follow_the_panes_last_cell_and_return_the_cursor():
    cell = Size(10, 21)
    painter = SixelPainter(cell)
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
        shape = SixelPainter(Size(11, 24)).shape(pane)
        pixels = shape.columns * shape.across * shape.rows * shape.down
        assert 0.2 * SIXEL_PIXELS < pixels <= SIXEL_PIXELS


class Recorder(AnnotateApp):
    """The app, with what it draws."""

    drawn = ""

    def _display(self, screen, renderable):
        super()._display(screen, renderable)
        if hasattr(renderable, "render_segments"):
            self.drawn += renderable.render_segments(self.console)


def shown(app, name="frame"):
    """The picture that a pane is meant to show."""
    pane = app.desk.query_one(f"#{name}", PicturePane)
    return pane, app.cache.get(shot_of(pane.look, pane.shape))


def test_app_draws_sixels_except_over_dialogs(suggested):
    app = Recorder(Session(suggested, "ann", order="subject"), sixel_cell=Size(7, 15))

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
