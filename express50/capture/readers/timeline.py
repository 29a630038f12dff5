"""One timeline for all cameras: frame 17 of one is frame 17 of all, whatever files are missing.

A layout lists, camera by camera, the moments it has a picture of. Datasets lack some by design
(AVA-256 lists frames that were never published), so that the n-th files of two cameras may show
different moments. Moments that a camera lacks are left out for all; a camera that lacks many is
left out itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from express50.capture.raw import RawCamera

# Share of the moments beyond which a camera is dropped rather than the moments, unless the camera
# is a larger share of all cameras: then fewer pictures are lost with the moments.
LACKING = 0.02
SHOWN = 4  # moments that a reason names

Moment = tuple[str, int]  # sequence, the layout's own frame number


@dataclass(frozen=True)
class Timeline:
    """Moments that all taken cameras share.

    Attributes:
        moments: in order.
        names: name of each moment's picture, by camera.
        dropped: cameras that were left out, with the reason.
        skipped: sequences and frames that were left out, with the reason.
    """

    moments: tuple[Moment, ...]
    names: dict[str, tuple[str, ...]]
    dropped: dict[str, str]
    skipped: dict[str, str]

    @property
    def sequences(self) -> tuple[str, ...]:
        """Sequences in order."""
        return tuple(dict.fromkeys(sequence for sequence, _ in self.moments))

    @property
    def counts(self) -> tuple[int, ...]:
        """Moments of each sequence."""
        table = Counter(sequence for sequence, _ in self.moments)
        return tuple(table[sequence] for sequence in self.sequences)

    @property
    def stamps(self) -> tuple[int, ...]:
        """The layout's own frame number of each moment."""
        return tuple(number for _, number in self.moments)

    def cameras(self, root: Path) -> dict[str, RawCamera]:
        """Return the taken cameras, whose pictures are image files named relative to the root."""
        counts, stamps = self.counts, self.stamps
        return {
            name: RawCamera(
                id=name, kind="frames", path=root, names=names, counts=counts, stamps=stamps
            )
            for name, names in self.names.items()
        }


def common_timeline(
    pictures: Mapping[str, Mapping[Moment, str]],
    order: Sequence[str],
    listed: Collection[Moment] = (),
    required: Collection[Moment] = (),
    noun: str = "frames",
) -> Timeline:
    """Find the moments that all cameras share.

    Args:
        pictures: name of each picture by moment, by camera.
        order: sequences in the order they are to have.
        listed: moments that the layout's own list names, though no camera may have them.
        required: moments that must not be lost, so that a camera without them is dropped.
        noun: plural of what a camera has of a moment, for the reasons.
    """
    seen = {moment for table in pictures.values() for moment in table}
    common = common_moments(pictures)
    dropped = lacking_cameras(pictures, common, required, noun)
    taken = {camera: table for camera, table in pictures.items() if camera not in dropped}
    skipped = _reasons(set(listed) - seen, "no camera", "has a", noun)
    skipped |= _reasons(seen - common, "most cameras", "have no", noun)
    whole = set(common) if taken else set()
    for camera, table in taken.items():
        skipped |= _reasons(whole - table.keys(), camera, "has no", noun)
        whole &= table.keys()
    rank = {sequence: number for number, sequence in enumerate(order)}
    moments = tuple(sorted(whole, key=lambda m: (rank[m[0]], m[1])))
    names = {camera: tuple(table[m] for m in moments) for camera, table in taken.items()}
    return Timeline(moments, names, dropped, skipped)


def common_moments(pictures: Mapping[str, Mapping[Moment, str]]) -> set[Moment]:
    """Find the moments of which at least half of the cameras have a picture."""
    seen = Counter(moment for table in pictures.values() for moment in table)
    return {moment for moment, count in seen.items() if 2 * count >= len(pictures)}


def lacking_cameras(
    pictures: Mapping[str, Mapping[Moment, str]],
    common: Collection[Moment],
    required: Collection[Moment],
    noun: str,
) -> dict[str, str]:
    """Find the cameras that lack so many common moments that they are dropped, with the reason."""
    worth = max(LACKING, 1 / len(pictures)) if pictures else LACKING
    dropped = {}
    for camera, table in pictures.items():
        lacking = set(common) - table.keys()
        lost = sorted(lacking & set(required))
        if lost:
            dropped[camera] = f"lacks {_words(lost)}, which is labelled"
        elif len(lacking) == len(common) or len(lacking) > worth * len(common):
            dropped[camera] = f"has {len(common) - len(lacking)} of {len(common)} {noun}"
    return dropped


def _reasons(moments: Collection[Moment], who: str, has: str, noun: str) -> dict[str, str]:
    """Write one line per sequence that lost moments."""
    found: dict[str, list[Moment]] = {}
    for moment in sorted(moments):
        found.setdefault(moment[0], []).append(moment)
    return {
        f"{len(lost)} of the {noun} of {sequence} ({who})": f"{who} {has} picture of {_words(lost)}"
        for sequence, lost in found.items()
    }


def _words(moments: Sequence[Moment]) -> str:
    shown = ", ".join(f"{sequence} {number}" for sequence, number in moments[:SHOWN])
    return shown + (f" and {len(moments) - SHOWN} more" if len(moments) > SHOWN else "")
