"""Serve packed shards as training samples."""

from __future__ import annotations

import fnmatch
import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from express50.console import log
from express50.errors import ConfigError, FormatError
from express50.files.digests import text_digest
from express50.geometry.transforms import is_rigid, make_transform
from express50.head import head_path
from express50.shards.reader import ShardReader
from grmm.data import Place, Sample, SampleKey, Tracked

FOCALS = 0.05, 1e4  # least and largest focal length, sides of the picture: 168 to 0.006 degrees
log_once = functools.cache(log)  # a command may open shards often
INSET_PX = 2  # of the footage's border, which undistortion cannot fill
SIZES: dict[str, tuple[int, ...] | None] = {  # of what is tracked; None: any vector
    "shape": None, "expression": None, "neck": (3,), "jaw": (3,), "eyes": (6,), "R": (3, 3),
    "t": (3,),
}  # fmt: skip


class ShardSource:
    """Samples of one split (``*``: of all) of a folder of shards."""

    def __init__(self, root: Path, split: str = "train") -> None:
        """Open the shards; FormatError unless they hold samples of one head model."""
        reader = ShardReader(root)
        chosen = tuple(entry for entry in reader.entries if split in ("*", entry.split))
        self.reader = ShardReader(root, chosen)
        if not chosen:
            what = "samples" if split == "*" else f"{split} samples, only of other splits"
            raise FormatError(f"{root}: no {what}; rerun 'express50 pack' with more subjects")
        self.keys: Sequence[SampleKey] = [
            SampleKey(subject=entry.subject, expression=entry.expression, camera=entry.camera)
            for entry in self.reader.entries
        ]
        first = self.reader.meta(0)
        if not isinstance(head := first.get("head"), str):
            where = f"{root}: {self.reader.entries[0].key}"
            raise FormatError(f"{where}: meta names no head model; rerun 'express50 pack'")
        self.head = head
        if first.get("torso") != "removed" and not first.get("parts"):
            log_once(
                f"{root}: has no part labels, so shoulders count as head; to leave them out, run"
                " 'express50 regions' and pack the dataset again"
            )
        lines = (
            f"{entry.key} {name} {size} {crc:08x}\n"
            for entry in self.reader.entries
            for name, (_, size, crc) in sorted(entry.members.items())
        )
        self.digest = text_digest("".join(lines))
        self._offsets: dict[str, np.ndarray] = {}

    def read(self, index: int) -> Sample:
        """Decode one sample; FormatError if it is damaged or tracked with another head model."""
        sample = self.reader.sample(index)
        rows, columns, _ = seen_window(sample["meta"], sample["key"])
        return Sample(
            image=sample["rgb"][rows, columns],
            alpha=np.rint(sample["alpha"] * 255).astype(np.uint8)[rows, columns],
            depth=sample["depth"][rows, columns] if sample["valid"].any() else None,
            place=self._place(index, sample["meta"]),
            parts=None if sample["parts"] is None else sample["parts"][rows, columns],
            bare=sample["meta"].get("torso") == "removed",
        )

    def place(self, index: int) -> Place:
        """Read a sample's place from its meta alone; errors are those of `read`."""
        return self._place(index, self.reader.meta(index))

    def _place(self, index: int, meta: dict) -> Place:
        entry = self.reader.entries[index]
        where = f"{self.reader.root / entry.shard}: {entry.key}"
        if not _is_one_head(meta.get("head"), self.head):
            raise FormatError(
                f"{where}: tracked with head model {meta.get('head')!r}, the first sample with "
                f"{self.head!r}; train on one of them: pack them into different folders"
            )
        rows, columns, size = seen_window(meta, where)
        K = _matrix(meta, "K", (3, 3), where)
        low, high = (factor * max(size) for factor in FOCALS)
        fits = ((low < K.diagonal()[:2]) & (K.diagonal()[:2] < high)).all()
        if not fits or (abs(K) > high).any() or K[1, 0] or (K[2] != (0, 0, 1)).any():
            raise FormatError(
                f"{where}: K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with"
                f" fx and fy of {low:g} to {high:g} px; correct the cameras and pack again"
            )
        K[:2, 2] -= columns.start, rows.start
        cam_from_world = _matrix(meta, "cam_from_world", (4, 4), where)
        tracked = self._tracked(meta, self.keys[index].subject, where)
        head_pose = make_transform(tracked.R, tracked.t)
        for name, pose in (("cam_from_world", cam_from_world), ("the track's R", head_pose)):
            if not is_rigid(pose):
                raise FormatError(
                    f"{where}: {name} is not a rotation and a translation (determinant"
                    f" {np.linalg.det(pose[:3, :3]):.4g}, expected 1); correct it and pack again"
                )
        return Place(
            K=K,
            cam_from_world=cam_from_world,
            tracked=tracked,
            size=(rows.stop - rows.start, columns.stop - columns.start),
        )

    def window(self, index: int) -> tuple[slice, slice, tuple[int, int]]:
        """Return the window of a sample that its camera saw; see `seen_window`."""
        return seen_window(self.reader.meta(index), f"{self.reader.root}: {self.keys[index]}")

    def _tracked(self, meta: dict, subject: str, where: str) -> Tracked:
        track = meta.get("track")
        if not isinstance(track, dict):
            raise FormatError(f"{where}: meta has no track; rerun 'express50 track' and 'pack'")
        tracked = Tracked(
            **{name: _matrix(track, name, size, where) for name, size in SIZES.items()}
        )
        if not track.get("offsets", False):
            return tracked
        if subject not in self._offsets:
            self._offsets[subject] = self.reader.offsets(subject)
        return replace(tracked, offsets=self._offsets[subject])


class MixedSource:
    """Several folders of shards as one: EXPRESS-50 and RenderMe-360, for example.

    Expressions of one id share their code (neutral, most often); subjects must differ.
    """

    def __init__(self, sources: Sequence[ShardSource]) -> None:
        """Join sources; FormatError if head models differ, or a subject is in two folders."""
        self.head = sources[0].head
        owners: dict[str, ShardSource] = {}
        for source in sources:
            if not _is_one_head(source.head, self.head):
                raise FormatError(
                    f"{source.reader.root}: tracked with head model {source.head!r}, "
                    f"{sources[0].reader.root} with {self.head!r}; track both with one"
                )
            for subject in sorted({key.subject for key in source.keys}):
                if owners.setdefault(subject, source) is not source:
                    raise FormatError(
                        f"{source.reader.root}: subject {subject} is also in "
                        f"{owners[subject].reader.root}; expected different ids in each dataset: "
                        "rename the capture and pack it again"
                    )
        self._sources = [(source, i) for source in sources for i in range(len(source.keys))]
        self.keys: Sequence[SampleKey] = [source.keys[i] for source, i in self._sources]
        self.digest = text_digest("".join(f"{source.digest}\n" for source in sources))

    def read(self, index: int) -> Sample:
        """Decode one sample, as `ShardSource.read` does."""
        source, number = self._sources[index]
        return source.read(number)

    def place(self, index: int) -> Place:
        """Read one sample's place, as `ShardSource.place` does."""
        source, number = self._sources[index]
        return source.place(number)


def _is_one_head(named: object, other: str) -> bool:
    """Return whether two names mean one head model; two machines may name it by different paths."""
    return named == other or (isinstance(named, str) and head_path(named) == head_path(other))


def open_shards(roots: Sequence[Path], split: str) -> ShardSource | MixedSource:
    """Open one folder of shards, or several mixed; see the two sources for errors."""
    sources = [ShardSource(root, split) for root in roots]
    return sources[0] if len(sources) == 1 else MixedSource(sources)


def select(keys: Sequence[SampleKey], subjects: str, expressions: str, cameras: str) -> list[int]:
    """Select samples whose ids match shell patterns, several joined by commas.

    Raises:
        ConfigError: a pattern, or all of them together, match nothing.
    """
    found = list(range(len(keys)))
    for kind, text in (("subject", subjects), ("expression", expressions), ("camera", cameras)):
        known = sorted({getattr(key, kind) for key in keys})
        chosen: set[str] = set()
        for pattern in map(str.strip, text.strip(", ").split(",")):
            matching = fnmatch.filter(known, pattern)
            if not matching:
                raise ConfigError(f"no {kind} is {pattern!r}; the shards have {', '.join(known)}")
            chosen.update(matching)
        found = [i for i in found if getattr(keys[i], kind) in chosen]
    if not found:
        raise ConfigError(
            f"no sample has subject {subjects}, expression {expressions} and camera {cameras}; "
            "choose ids that occur together"
        )
    return found


def seen_window(meta: dict, where: str) -> tuple[slice, slice, tuple[int, int]]:
    """Return the rows and columns of a packed sample that its camera saw, and the packed (H, W).

    Packing squares reach beyond the footage where a head stands at the border of the image. What
    lies there is black in the sample, yet not background: a model trained on it would cut off
    necks. A sample without ``crop`` was not cut out: all of it was seen.

    Raises:
        FormatError: the crop does not touch the footage.
    """
    try:
        size = (int(meta["height"]), int(meta["width"]))
        crop = meta.get("crop")
        if not crop:
            return slice(0, size[0]), slice(0, size[1]), size
        spans = []
        for start, source, length in zip(
            (crop["y0"], crop["x0"]), reversed(meta["source_size"]), size, strict=True
        ):
            scale = length / crop["side"]
            low = max(0, math.ceil((INSET_PX - start) * scale))
            high = min(length, math.floor((source - INSET_PX - start) * scale))
            spans.append(slice(low, high))
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        words = f"{type(error).__name__}: {error}"
        raise FormatError(f"{where}: malformed crop ({words}); rerun 'express50 pack'") from None
    if any(span.stop <= span.start for span in spans):
        raise FormatError(f"{where}: its crop lies outside the footage; rerun 'express50 pack'")
    return spans[0], spans[1], size


def _matrix(table: dict, name: str, size: tuple[int, ...] | None, where: str) -> np.ndarray:
    """Return a finite float64 array of the table; ``size`` None: any vector."""
    try:
        array = np.array(table[name], dtype=np.float64)
    except KeyError:
        raise FormatError(f"{where}: meta has no {name}; rerun 'express50 pack'") from None
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"{where}: {name} is not an array of numbers") from None
    if (array.ndim != 1) if size is None else (array.shape != size):
        raise FormatError(f"{where}: {name} has shape {array.shape}, expected {size or '(any,)'}")
    if not np.isfinite(array).all():
        raise FormatError(f"{where}: {name} holds NaN or Inf; rerun 'express50 track'")
    return array
