"""Select parts of another dataset's layout, and align its cameras to one timeline.

A capture.toml states which sequences and cameras to take, under which names. A layout lists the
moments of which each camera has a picture. Datasets lack some by design (AVA-256 lists frames that
were never published), so that the n-th files of two cameras may show different moments. Moments
that a camera lacks are left out for all cameras; a camera that lacks many is left out itself.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50.capture.raw import RawCamera
from express50.console import count
from express50.errors import CaptureError, few
from express50.files.text import identifier, is_number

EXPRESSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9_]*")
# A camera that lacks more than this share of the moments is dropped; otherwise the moments are.
# With few cameras its own share of all cameras is the limit, so that fewer pictures are lost.
LACKING = 0.02
SHOWN = 4  # moments that a reason names

Moment = tuple[str, int]  # sequence, the layout's own frame number


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Parts of a layout to read; the names are the layout's own."""

    sequences: tuple[str, ...] = ()  # shell patterns; none takes the layout's usual ones
    cameras: tuple[str, ...] = ()  # shell patterns of cameras to take; none takes all
    expressions: Mapping[str, str] = field(default_factory=dict)  # our expression id by sequence
    # length of one unit of the calibration's world; None if it is not given
    metres_per_unit: float | None = None

    def has_sequence(self, name: str, usual: str = "*") -> bool:
        """Return whether a sequence is selected."""
        return any(fnmatch.fnmatchcase(name, p) for p in self.sequences or (usual,))

    def left_out(self, sequences: Sequence[str]) -> dict[str, str]:
        """Return the sequences that are not selected, with the reason."""
        return {f"sequence {s}": "not selected" for s in sequences if not self.has_sequence(s)}

    def has_camera(self, name: str) -> bool:
        """Return whether a camera is selected."""
        return not self.cameras or any(fnmatch.fnmatchcase(name, p) for p in self.cameras)

    def expression(self, sequence: str) -> str:
        """Return the expression id of a sequence: the given one, else one made of its name."""
        return self.expressions.get(sequence) or identifier(sequence, "_")


def unique_ids(root: Path, names: Iterable[str], stem: Callable[[str], str]) -> dict[str, str]:
    """Return the camera id of each name's stem; CaptureError if two names become one id."""
    owners: dict[str, str] = {}
    for name in names:
        camera = identifier(stem(name))
        if camera in owners:
            raise CaptureError(
                f"{root}: {owners[camera]} and {name} both become camera {camera}; rename one"
            )
        owners[camera] = name
    return {name: camera for camera, name in owners.items()}


def folder_id(path: Path) -> str:
    """Return the name of a folder, or of the folder that holds a file, as an id."""
    return identifier((path if path.is_dir() else path.parent).resolve().name)


def parse_selection(meta: Mapping[str, Any], where: Path) -> Selection:
    """Return the selection that a capture.toml makes; CaptureError if a value has a wrong type."""
    scale = meta.get("metres_per_unit")
    if scale is not None and not (is_number(scale) and 0 < scale < math.inf):
        raise CaptureError(f"{where}: metres_per_unit is {scale!r}, expected a number above 0")
    names = meta.get("expressions", {})
    if not isinstance(names, dict) or not all(
        isinstance(v, str) and EXPRESSION.fullmatch(v) for v in names.values()
    ):
        raise CaptureError(
            f"{where}: expressions is {names!r}, expected a table from sequence to an id of "
            "letters, digits and '_'"
        )
    return Selection(
        sequences=_patterns(meta, "sequences", where),
        cameras=_patterns(meta, "cameras", where),
        expressions=names,
        metres_per_unit=None if scale is None else float(scale),
    )


def _patterns(meta: Mapping[str, Any], key: str, where: Path) -> tuple[str, ...]:
    value = meta.get(key, [])
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise CaptureError(f"{where}: {key} is {value!r}, expected a list such as ['EXP*']")
    return tuple(value)


def check_selection(selection: Selection, sequences: Sequence[str], cameras: Sequence[str]) -> None:
    """Refuse patterns that match nothing: a typing error would look like missing data.

    Raises:
        CaptureError: a pattern matches nothing of the layout.
    """
    for what, patterns, known in (
        ("sequences", selection.sequences, sequences),
        ("[expressions]", tuple(selection.expressions), sequences),
        ("cameras", selection.cameras, cameras),
    ):
        for pattern in patterns:
            if not fnmatch.filter(known, pattern):
                raise CaptureError(
                    f"capture.toml: {what} names {pattern!r}, which matches nothing; expected some"
                    f" of {few(known, 8) or 'none'}"
                )


@dataclass(frozen=True)
class Timeline:
    """Footage of the moments that all taken cameras share."""

    cameras: dict[str, RawCamera]  # the taken cameras by id
    gaps: tuple[int, ...]  # places of moments left out, among those that most cameras have
    sequences: tuple[str, ...]  # in order
    dropped: dict[str, str]  # cameras that were left out, with the reason
    skipped: dict[str, str]  # sequences and frames that were left out, with the reason


def common_timeline(
    root: Path,
    pictures: Mapping[str, Mapping[Moment, str]],
    order: Sequence[str],
    kind: str = "frames",
    listed: Collection[Moment] = (),
    required: Collection[Moment] = (),
    dropped: Mapping[str, str] | None = None,
) -> Timeline:
    """Find the moments that all cameras share.

    Args:
        root: the folder that the names are relative to.
        pictures: name of each picture or video by moment, by camera.
        order: sequences in the order they are to have.
        kind: ``frames``, or ``videos`` of one moment each.
        listed: moments that the layout's own list names, though no camera may have them.
        required: moments that must not be lost, so that a camera without them is dropped.
        dropped: cameras that are left out already, with the reason.

    Raises:
        CaptureError: the cameras share no moment.
    """
    counts = Counter(moment for table in pictures.values() for moment in table)
    present = sum(map(bool, pictures.values()))
    common = {moment for moment, count in counts.items() if 2 * count >= present}
    lost = dict(dropped or {}) | _lacking_cameras(pictures, common, required, kind)
    taken = {camera: table for camera, table in pictures.items() if camera not in lost}
    skipped = _reasons(set(listed) - counts.keys(), "no camera", "has a", kind)
    skipped |= _reasons(counts.keys() - common, "most cameras", "have no", kind)
    shared = common if taken else set()
    for camera, table in taken.items():
        skipped |= _reasons(shared - table.keys(), camera, "has no", kind)
        shared = shared & table.keys()
    if not shared:
        reasons = few([f"{what}: {why}" for what, why in (lost | skipped).items()], SHOWN)
        raise CaptureError(
            f"{root}: its cameras share no {kind} ({reasons or 'it has no cameras'}); "
            "copy or download them again"
        )
    rank = {sequence: number for number, sequence in enumerate(order)}
    whole = sorted(common, key=lambda m: (rank[m[0]], m[1]))
    gaps = tuple(place for place, moment in enumerate(whole) if moment not in shared)
    moments = [moment for moment in whole if moment in shared]
    lengths = Counter(sequence for sequence, _ in moments)
    images = kind == "frames"
    cameras = {
        camera: RawCamera(
            id=camera,
            kind=kind,
            path=root,
            names=tuple(table[moment] for moment in moments),
            counts=tuple(lengths.values()) if images else (),
            stamps=tuple(number for _, number in moments) if images else (),
        )
        for camera, table in taken.items()
    }
    return Timeline(cameras, gaps, tuple(lengths), lost, skipped)


def _lacking_cameras(
    pictures: Mapping[str, Mapping[Moment, str]],
    common: Collection[Moment],
    required: Collection[Moment],
    kind: str,
) -> dict[str, str]:
    """Find the cameras that lack too many common moments to be kept, with the reason."""
    worth = max(LACKING, 1 / max(1, sum(map(bool, pictures.values()))))
    dropped = {}
    for camera, table in pictures.items():
        lacking = set(common) - table.keys()
        lost = sorted(lacking & set(required))
        if lost:
            dropped[camera] = f"lacks {_words(lost)}, which is labelled"
        elif len(lacking) == len(common) or len(lacking) > worth * len(common):
            dropped[camera] = f"has {len(common) - len(lacking)} of {len(common)} {kind}"
    return dropped


def _reasons(moments: Collection[Moment], who: str, has: str, kind: str) -> dict[str, str]:
    """Write one line per sequence that lost moments."""
    found: dict[str, list[Moment]] = {}
    for moment in sorted(moments):
        found.setdefault(moment[0], []).append(moment)
    return {
        f"{count(len(lost), kind[:-1])} of {sequence} ({who})": f"{who} {has} picture of"
        f" {_words(lost)}"
        for sequence, lost in found.items()
    }


def _words(moments: Sequence[Moment]) -> str:
    return few([f"{sequence} {number}" for sequence, number in moments], SHOWN)
