"""The contact sheet as one static page: a face for every label, cropped alike, nothing fetched."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import partial

import jinja2
import numpy as np

from annotations.sheet import Sheet, Tile, tiles_of
from annotations.ui.faces import FaceFinder, zoom_box
from annotations.ui.frames import crop_to
from express50.capture.frames import read_proxy
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import Express50Error
from express50.files.images import encode_jpeg

WIDTH, HEIGHT = 176, 220  # pixels of a tile; shown smaller, so that it can be enlarged
STRIP_WIDTH, STRIP_HEIGHT = 96, 120
QUALITY = 82


@dataclass(frozen=True)
class Pictures:
    """A tile's picture and the frames around it, side by side, as data addresses; "" for none.

    Attributes:
        face: the frame.
        strip: the frames around it in one picture.
        first: frame of the strip's first picture.
        count: how many pictures the strip holds.
        problem: why there is no picture.
    """

    face: str = ""
    strip: str = ""
    first: int = 0
    count: int = 0
    problem: str = ""


def render_sheet(
    dataset: Dataset, sheet: Sheet, *, faces: FaceFinder | None = None, around: int = 0
) -> str:
    """The page as text.

    Args:
        dataset: where the proxies are.
        sheet: what to show.
        faces: crops to the faces; whole frames without it.
        around: how many frames before and after each label to add.
    """
    pictures = {
        (tile.subject, tile.expression): take_pictures(dataset, tile, faces, around)
        for tile in tiles_of(sheet.rows)
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("annotations", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    several = len(sheet.subjects) > 2
    return environment.get_template("sheet.html").render(
        title=f"Labels of {dataset.root.resolve().name}",
        sheet=sheet,
        counts=sheet.counts(),
        pictures=pictures,
        several=several,
        size=(WIDTH, HEIGHT),
        caption=caption,
    )


def take_pictures(dataset: Dataset, tile: Tile, faces: FaceFinder | None, around: int) -> Pictures:
    """The face of a tile's frame and, in the same framing, of the frames around it."""
    if tile.frame is None:
        return Pictures()
    read = partial(read_proxy, dataset, tile.subject, tile.camera)
    try:
        source = read_index(dataset, tile.subject).cameras[tile.camera]
        face = None if faces is None else faces.find(tile.subject, tile.camera, tile.frame)
        box = zoom_box(face, "face", HEIGHT / WIDTH, source.height / source.width)
        shown = crop_to(read(tile.frame), box, WIDTH, HEIGHT)
        near = range(max(tile.first, tile.frame - around), min(tile.last, tile.frame + around) + 1)
        strip = [crop_to(read(n), box, STRIP_WIDTH, STRIP_HEIGHT) for n in near] if around else []
    except (Express50Error, OSError, IndexError) as error:
        return Pictures(problem=f"cannot be read: {error}")
    if not strip:
        return Pictures(_data(shown))
    return Pictures(_data(shown), _data(np.hstack(strip)), near[0], len(near))


def _data(image: np.ndarray) -> str:
    code = base64.b64encode(encode_jpeg(image, QUALITY)).decode()
    return f"data:image/jpeg;base64,{code}"


def caption(tile: Tile) -> str:
    """Frame, who chose it and how sure that was, in one short line."""
    if tile.state == "missing":
        return ""  # the empty tile itself says why
    if tile.state == "flagged":
        return f"flagged: {tile.words} ({tile.by})"
    sure = "" if tile.confidence is None else f" {tile.confidence:.0%}"
    return f"frame {tile.frame} · {tile.by}{sure}"
