"""One timeline for all cameras: frame 17 of one is frame 17 of all, whatever files are missing.

A layout tells, camera by camera, which moments it has a picture of. Datasets lack some by design
(AVA-256 lists frames that were never published), so that the n-th files of two cameras may be of
different moments. Moments that a camera lacks are left out for all; a camera that lacks many is
left out itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

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


def common_timeline(
    pictures: Mapping[str, Mapping[Moment, str]],
    order: Sequence[str],
    listed: Collection[Moment] = (),
    required: Collection[Moment] = (),
) -> Timeline:
    """The moments that cameras share.

    Args:
        pictures: name of each picture by moment, by camera.
        order: sequences in the order they are to have.
        listed: moments that the layout's own list names, though no camera may have them.
        required: moments that must not be lost, so that a camera without them is dropped.
    """
    seen = Counter(moment for table in pictures.values() for moment in table)
    common = {m for m, count in seen.items() if 2 * count >= len(pictures)}
    skipped = _reasons(set(listed) - set(seen), "no camera", "has a")
    skipped |= _reasons(set(seen) - common, "most cameras", "have no")
    dropped = {}
    worth = max(LACKING, 1 / len(pictures)) if pictures else LACKING
    for camera, table in pictures.items():
        lacking = common - set(table)
        lost = sorted(lacking & set(required))
        if lost:
            dropped[camera] = f"has no picture of {_words(lost)}, on which the labels stand"
        elif not table.keys() & common or len(lacking) > worth * len(common):
            dropped[camera] = f"has {len(common) - len(lacking)} of {len(common)} frames"
    taken = {camera: table for camera, table in pictures.items() if camera not in dropped}
    holes = {m: [c for c, table in taken.items() if m not in table] for m in common}
    for camera in taken:
        without = {m for m, cameras in holes.items() if cameras and cameras[0] == camera}
        skipped |= _reasons(without, camera, "has no")
    rank = {sequence: number for number, sequence in enumerate(order)}
    whole = [m for m in common if taken and not holes[m]]
    moments = tuple(sorted(whole, key=lambda m: (rank[m[0]], m[1])))
    names = {camera: tuple(table[m] for m in moments) for camera, table in taken.items()}
    return Timeline(moments, names, dropped, skipped)


def _reasons(moments: Collection[Moment], who: str, has: str) -> dict[str, str]:
    """One line a sequence that lost moments."""
    found: dict[str, list[Moment]] = {}
    for moment in sorted(moments):
        found.setdefault(moment[0], []).append(moment)
    return {
        f"{len(lost)} of the frames of {sequence} ({who})": (
            f"{who} {has} picture of {_words(lost)}"
        )
        for sequence, lost in found.items()
    }


def _words(moments: Sequence[Moment]) -> str:
    shown = ", ".join(f"{sequence} {number}" for sequence, number in moments[:SHOWN])
    return shown + (f" and {len(moments) - SHOWN} more" if len(moments) > SHOWN else "")
