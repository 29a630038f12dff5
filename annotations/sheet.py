"""Draw the contact sheet: every label as a face on one static HTML page."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

import jinja2
import numpy as np

from annotations.labels import Label, current_labels, lost_frame, origin, read_labels
from annotations.suggestions import Suggested, read_suggestions, reference_subject
from annotations.ui.frames import FaceFinder, crop_to, zoom_box
from annotations.validate import disagreements
from express50.capture.expressions import expression_words
from express50.capture.frames import read_proxy
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset, exclusion_reason, included_subjects
from express50.errors import Express50Error, FormatError, check_known
from express50.files.images import encode_jpeg

STATES = ("person", "rule", "auto", "suggestion", "flagged", "missing")


@dataclass(frozen=True, kw_only=True)
class Tile:
    """One expression of one subject."""

    subject: str  # id of the person shown
    expression: str
    # who chose the frame (``person``, ``rule``, ``auto``: a suggestion accepted by the align stage,
    # ``suggestion``: one not yet accepted), or ``flagged`` or ``missing``
    state: str = "missing"
    reference: bool = False  # whether this is the reference's canonical frame
    # the picture to show; no frame if there is none. A flagged tile shows what was suggested, so
    # that the flag can be judged.
    frame: int | None = None
    camera: str = ""  # whose picture is shown
    first: int = 0  # frame of the cue window
    last: int = 0  # frame of the cue window
    by: str = ""  # who chose, in words
    confidence: float | None = None  # of the suggestion where a suggestion was chosen, 0 to 1
    words: str = ""  # why it is flagged, missing or doubtful
    doubtful: bool = False  # whether somebody should look again


@dataclass(frozen=True)
class SheetRow:
    """One expression across subjects, the reference first where it is known."""

    expression: str
    name: str
    description: str
    tiles: list[Tile]


@dataclass(frozen=True)
class Sheet:
    """Rows in the order of the script, the reference, and the page's warnings."""

    rows: list[SheetRow]
    reference: str
    subjects: list[str]
    notes: list[str]

    @property
    def tiles(self) -> list[Tile]:
        """Return every tile, row by row."""
        return [tile for row in self.rows for tile in row.tiles]

    def counts(self) -> dict[str, int]:
        """Count the tiles by state, and the doubtful ones."""
        states = Counter(tile.state for tile in self.tiles)
        return {s: states[s] for s in STATES} | {"doubtful": sum(t.doubtful for t in self.tiles)}


def make_sheet(
    dataset: Dataset,
    subjects: Collection[str] | None = None,
    expressions: Collection[str] | None = None,
    camera: str | None = None,
    sure: float = 0.5,
) -> Sheet:
    """Make the sheet of some subjects and expressions; excluded subjects are left out.

    The reference is always shown. `camera` is shown wherever a subject has it; by default it is the
    one in which the reference's frame was chosen. Suggestions less sure than `sure` are doubtful.

    Raises:
        AnnotationError: an unknown subject, expression or camera; StageError where nothing is
            ingested.
    """
    reference = reference_subject(dataset)
    where, included = str(dataset.root), included_subjects(dataset)
    check_known(where, "included subject", subjects or (), included)
    chosen = [reference, *(s for s in subjects or included if s != reference)]
    indexes = {subject: read_index(dataset, subject) for subject in chosen}
    names = list(dict.fromkeys(c.expression_id for i in indexes.values() for c in i.cues))
    cameras = dict.fromkeys(c for i in indexes.values() for c in i.cameras)
    check_known(where, "expression", expressions or (), names)
    check_known(where, "camera", [camera] if camera else (), cameras)
    notes: list[str] = []
    columns = {s: _column(dataset, index, sure, notes) for s, index in indexes.items()}
    rows = []
    for name in (n for n in names if not expressions or n in expressions):
        first = columns[reference].get(name, Tile(subject=reference, expression=name))
        tiles = [replace(first, reference=True)]
        for subject in chosen[1:]:
            absent = Tile(subject=subject, expression=name, words="not recorded")
            tiles.append(columns[subject].get(name, absent))
        shown = camera or first.camera
        for place, tile in enumerate(tiles):
            source = indexes[tile.subject].cameras.get(shown)
            if tile.frame is not None and source is not None and tile.frame < source.frames:
                tiles[place] = replace(tile, camera=shown)
        title, description = expression_words(name)
        rows.append(SheetRow(name, title, description, tiles))
    reasons = {s: exclusion_reason(dataset, s) for s in dataset.subjects()}
    notes += [f"{s} is excluded: {why}" for s, why in reasons.items() if why is not None]
    return Sheet(rows, reference, chosen, notes)


def _column(dataset: Dataset, index: Index, sure: float, notes: list[str]) -> dict[str, Tile]:
    """Make the tiles of a subject by expression."""
    suggestions = {}
    try:
        suggestions = read_suggestions(dataset, index.subject)
    except FormatError as error:
        notes.append(str(error))
    force = current_labels(read_labels(dataset, index.subject))
    disputes = {
        row.expression: ", ".join(f"{who} {what}" for who, what in row.said.items())
        for row in disagreements(dataset, subjects=[index.subject])
    }
    tiles = {}
    for cue in index.cues:
        name = cue.expression_id
        last = min(cue.end_frame, index.frames - 1)
        tile = Tile(subject=index.subject, expression=name, first=cue.start_frame, last=last)
        tile = _filled(tile, index, force.get(name), suggestions.get(name))
        doubts = [tile.words] if tile.state not in ("flagged", "missing") and tile.words else []
        if name in disputes:
            doubts.append(disputes[name])
        unsure = tile.confidence is not None and tile.confidence < sure
        words = "; ".join(doubts) or tile.words
        tiles[name] = replace(tile, words=words, doubtful=bool(doubts) or unsure)
    return tiles


def _filled(tile: Tile, index: Index, label: Label | None, hint: Suggested | None) -> Tile:
    """Fill a tile with the label in force, else with the suggestion."""
    fallback = next(iter(index.cameras))
    if hint is not None and tile.first <= hint.frame <= tile.last:
        camera = hint.camera if hint.camera in index.cameras else fallback
        tile = replace(tile, frame=hint.frame, camera=camera)
    if label is None:
        if tile.frame is None or hint is None:
            return replace(tile, frame=None, words="no label")
        return replace(tile, state="suggestion", by="suggested", confidence=hint.confidence)
    state = origin(label)
    if state == "flagged":
        reason = label.reason or "no reason given"
        return replace(tile, state=state, by=label.annotator, words=reason)
    return replace(
        tile,
        state=state,
        frame=label.frame,
        camera=label.camera if label.camera in index.cameras else fallback,
        by=label.annotator + (", settled" if label.action == "settle" else ""),
        confidence=label.confidence if state == "auto" else None,
        words="labelled on other footage" if lost_frame(index, label) else "",
    )


WIDTH, HEIGHT = 176, 220  # pixels of a tile; shown smaller, so that it can be enlarged
STRIP_WIDTH, STRIP_HEIGHT = 96, 120
QUALITY = 82


@dataclass(frozen=True)
class Pictures:
    """A tile's picture and the frames around it, side by side, as data URLs; "" for none."""

    face: str = ""  # the frame
    strip: str = ""  # the frames around it in one picture
    first: int = 0  # frame of the strip's first picture
    count: int = 0  # how many pictures the strip holds
    problem: str = ""  # the reason where the picture is missing


def render_sheet(
    dataset: Dataset, sheet: Sheet, *, faces: FaceFinder | None = None, around: int = 0
) -> str:
    """Render the page as text, with ``around`` frames before and after each label.

    Pictures are cropped to the faces; without a face finder they show full frames.
    """
    pictures = {
        (tile.subject, tile.expression): take_pictures(dataset, tile, faces, around)
        for tile in sheet.tiles
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("annotations", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("sheet.html").render(
        title=f"Labels of {dataset.root.resolve().name}",
        sheet=sheet,
        counts=sheet.counts(),
        pictures=pictures,
        several=len(sheet.subjects) > 2,
        size=(WIDTH, HEIGHT),
    )


def take_pictures(dataset: Dataset, tile: Tile, faces: FaceFinder | None, around: int) -> Pictures:
    """Crop the face of a tile's frame and, in the same framing, of the frames around it."""
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
