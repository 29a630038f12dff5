"""Turn packed samples into tensors in canonical head space, and choose their order.

Geometry is not stored with the samples: the tracked mesh v_rec is posed from head-model
parameters once per (subject, expression) and kept.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from express50.console import count, log
from express50.contract.segmentation_labels import TORSO
from express50.errors import FormatError, TrainError, few
from express50.geometry.sampling import evenly
from express50.geometry.transforms import make_transform
from express50.head.model import HeadModel, pose
from grmm.config import DataConfig
from grmm.head_crop import behind_torso, crop_view, head_window, sees_head
from grmm.model import HeadState, PinholeView, Rendering

NO_OFFSETS = np.zeros((0, 3), np.float32)
CACHE_BYTES = 512 << 20  # of decoded samples: a few hundred of 512 px
CHECKED_MATTES = 64  # before training, or one per camera: those of a dataset take minutes
DEFAULTS = DataConfig()  # black behind the head
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True)
class SampleKey:
    """Ids of one sample."""

    subject: str
    expression: str
    camera: str

    @property
    def frame(self) -> tuple[str, str]:
        """Return subject and expression."""
        return self.subject, self.expression

    @property
    def name(self) -> str:
        """Return the ids as messages show them: S001/smile/cam00."""
        return f"{self.subject}/{self.expression}/{self.camera}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """Head-model parameters of one frame; world = R @ head + t."""

    shape: np.ndarray  # (S,)
    expression: np.ndarray  # (X,)
    neck: np.ndarray  # (3,) axis-angle, radians
    jaw: np.ndarray  # (3,) axis-angle, radians
    eyes: np.ndarray  # (6,) axis-angles, left then right, radians
    R: np.ndarray  # (3, 3)
    t: np.ndarray  # (3,) metres
    # (V, 3) float32 metres, added to the rest shape, one array for all frames of a subject; (0, 3)
    # where there are none
    offsets: np.ndarray = field(default_factory=lambda: NO_OFFSETS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """The camera and head of one view: a sample without its pictures."""

    K: np.ndarray  # (3, 3) pixels, corner origin
    cam_from_world: np.ndarray  # (4, 4)
    tracked: Tracked  # head-model parameters
    size: tuple[int, int]  # (H, W) of the view


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One decoded view as the shards hold it."""

    image: np.ndarray  # (H, W, 3) uint8 sRGB
    alpha: np.ndarray  # (H, W) uint8
    depth: np.ndarray | None  # (H, W) float32 camera z, metres; 0 where unknown. None: no depth.
    place: Place  # camera and head
    # (H, W) uint8 of segmentation_labels.LABELS. None: the shards have none.
    parts: np.ndarray | None = None
    bare: bool = False  # True if alpha leaves the torso out already

    @property
    def nbytes(self) -> int:
        """Return the memory that its images take, bytes."""
        images = (self.image, self.alpha, self.depth, self.parts)
        return sum(array.nbytes for array in images if array is not None)


class Source(Protocol):
    """A source of samples: the shard reader, or a list in tests."""

    keys: Sequence[SampleKey]
    head: str
    digest: str
    """Differs if any sample differs."""

    def read(self, index: int) -> Sample:
        """Decode one sample."""
        ...

    def place(self, index: int) -> Place:
        """Return a sample's place without decoding a picture: training asks for thousands."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadView:
    """One training view."""

    key: SampleKey
    state: HeadState  # tracked head
    view: PinholeView  # camera in head space
    target: Tensor  # (3, H, W) footage composited on the background
    mask: Tensor  # (H, W) bool, footage alpha over 0.5
    depth: Tensor  # (H, W) metres
    depth_valid: Tensor  # (H, W) bool
    # (H, W) uint8 of segmentation_labels.LABELS. None: the shards have none.
    parts: np.ndarray | None
    hidden: Tensor  # (H, W) bool, where the torso hides the neck (DataConfig.skip_hidden_neck)
    # (H, W) metres, depth of the torso; 0 where unknown or DataConfig.hide_behind_torso is off
    torso: Tensor
    background: float  # grey behind footage and renderings

    def hide_behind_torso(self, rendering: Rendering) -> Rendering:
        """Return a rendering that is background where the torso is in front of what was drawn."""
        depth, behind = rendering.depth, self.background
        images = (rendering.rgb, rendering.image)
        rgb, image = (self.fill_behind_torso(each, depth, behind) for each in images)
        return replace(rendering, rgb=rgb, image=image)

    def fill_behind_torso(self, values: Tensor, depth: Tensor, fill: float) -> Tensor:
        """Return values (..., H, W) with ``fill`` where ``depth`` (H, W) lies behind the torso."""
        return torch.where((self.torso > 0) & (depth > self.torso), fill, values)

    def comparable(self, image: Tensor) -> Tensor:
        """Return ``image`` (3, H, W) with the footage where the neck is hidden."""
        return torch.where(self.hidden, self.target, image)


def with_codes(
    keys: Sequence[SampleKey],
    chosen: Iterable[int],
    subjects: Collection[str],
    expressions: Collection[str],
) -> list[int]:
    """Choose the samples whose person and expression have a code; log which frames do not."""
    known: dict[bool, list[int]] = {True: [], False: []}
    for index in chosen:
        key = keys[index]
        known[key.subject in subjects and key.expression in expressions].append(index)
    if lost := sorted({"/".join(keys[index].frame) for index in known[False]}):
        log(
            f"{count(len(lost), 'frame')} cannot be measured, because nothing of the person or the"
            f" expression was trained or fitted: {few(lost)}"
        )
    return known[True]


class Cache(Generic[Key, Value]):
    """A cache of the newest results, up to a number of bytes; it always keeps the last one."""

    def __init__(self, limit: int, size: Callable[[Value], int]) -> None:
        """Limit the sum of the entries' ``size``, bytes, to ``limit``."""
        self.limit, self.size, self.bytes = limit, size, 0
        self.entries: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return an entry; make it if it is missing."""
        if key in self.entries:
            self.entries.move_to_end(key)
            return self.entries[key]
        value = self.entries[key] = make()
        self.bytes += self.size(value)
        while self.bytes > self.limit and len(self.entries) > 1:
            self.bytes -= self.size(self.entries.popitem(last=False)[1])
        return value


class HeadViews:
    """Samples of a source as head views, with bounded caches of slow results."""

    def __init__(self, source: Source, head: HeadModel, data: DataConfig = DEFAULTS) -> None:
        """Wrap a source tracked with ``head``; items are put on the head's device."""
        self.source, self.head = source, head
        self.background, self.data = data.background, data
        self._hidden: Cache[int, np.ndarray] = Cache(CACHE_BYTES // 8, lambda bits: bits.nbytes)
        self._samples: Cache[int, Sample] = Cache(CACHE_BYTES, lambda sample: sample.nbytes)
        self._coming: dict[int, Future[Sample]] = {}
        self._reader = ThreadPoolExecutor(max_workers=1)
        self._states: Cache[tuple[str, str], HeadState] = Cache(
            CACHE_BYTES // 2, lambda state: state.vertices.nbytes
        )

    @property
    def keys(self) -> Sequence[SampleKey]:
        """Return the ids of all samples."""
        return self.source.keys

    def item(self, index: int, *, crop: bool = False) -> HeadView:
        """Return one sample as tensors on the device.

        Shoulders and clothes are background, where the shards leave them out or label them. With
        ``crop`` only the window around head and matte, as training takes it: outside it, footage
        and rendering are both the background.
        """
        sample, state = self.sample(index), self.state(index)
        height, width = sample.alpha.shape
        view = self.view_of(sample.place)
        matte = sample.alpha
        depth = np.zeros_like(matte) if sample.depth is None else sample.depth
        torso = np.zeros_like(depth)
        if sample.parts is not None:
            labelled = sample.parts == TORSO
            if self.data.hide_behind_torso:
                torso = np.where(labelled, depth, 0)
            depth = np.where(labelled, 0, depth)
            matte = matte if sample.bare else np.where(labelled, 0, matte)
        hidden = self._hidden_neck(index, sample, state, view)
        rows, columns = slice(0, height), slice(0, width)
        if crop:
            rows, columns = head_window(state.vertices, view, matte)
            view = crop_view(view, rows, columns)
        known = self._tensor(depth[rows, columns])
        weight = (self._tensor(matte[rows, columns]) / 255)[..., None]
        image = self._tensor(sample.image[rows, columns]) / 255
        target = image * weight + self.background * (1 - weight)
        return HeadView(
            key=self.keys[index],
            state=state,
            view=view,
            target=target.permute(2, 0, 1).contiguous(),
            mask=weight[..., 0] > 0.5,
            depth=known,
            depth_valid=known > 0,
            parts=None if sample.parts is None else sample.parts[rows, columns],
            hidden=torch.from_numpy(hidden[rows, columns]).to(self.head.device),
            torso=self._tensor(torso[rows, columns]),
            background=self.background,
        )

    def _hidden_neck(
        self, index: int, sample: Sample, state: HeadState, view: PinholeView
    ) -> np.ndarray:
        """Find the pixels (H, W) where the torso hides the neck; the masks are kept as bits."""
        height, width = sample.alpha.shape
        if sample.parts is None or not self.data.skip_hidden_neck:
            return np.zeros((height, width), bool)
        torso = sample.parts == TORSO

        def make() -> np.ndarray:
            return np.packbits(behind_torso(self.head, state.vertices, view, torso))

        bits = np.unpackbits(self._hidden.get(index, make), count=height * width)
        return bits.reshape(height, width).astype(bool)

    def prefetch(self, index: int) -> None:
        """Start decoding the next sample in the background."""
        if index not in self._samples.entries and index not in self._coming:
            self._coming = {index: self._reader.submit(self._read, index)}

    def sample(self, index: int) -> Sample:
        """Return the decoded sample, checked, from the cache if possible.

        Raises:
            FormatError: its images differ in size, or its parameters do not fit the head model.
        """
        coming = self._coming.pop(index, None)
        make = (lambda: self._read(index)) if coming is None else coming.result
        return self._samples.get(index, make)

    def _read(self, index: int) -> Sample:
        sample = self.source.read(index)
        where, size = self.keys[index].name, sample.image.shape[:2]
        for name in ("alpha", "depth", "parts"):
            array = getattr(sample, name)
            if array is not None and array.shape != size:
                raise FormatError(
                    f"{where}: {name} is {array.shape}, expected the image's size {size}; pack the "
                    "dataset again"
                )
        check_tracked(where, sample.place.tracked, self.head)
        return sample

    def check_mattes(self, indices: Sequence[int]) -> None:
        """Look at views, evenly spread and one per camera, and log which show no head.

        Raises:
            TrainError: none does.
        """
        cameras = {self.keys[i].camera: i for i in indices}
        looked = sorted({*evenly(indices, CHECKED_MATTES), *cameras.values()})
        items = ((i, self.item(i)) for i in looked)
        empty = [
            self.keys[i].name
            for i, item in items
            if not (item.mask.any() and sees_head(item.view, item.state.vertices))
        ]
        if not empty:
            return
        words = (
            f"{len(empty)} of {len(looked)} views show no head, by their mattes or cameras"
            f" ({few(empty)}); check them with 'express50 report' and pack again, or give others"
        )
        if len(empty) == len(looked):
            raise TrainError(words)
        log(words)

    def place(self, index: int) -> Place:
        """Return a sample's place; raise FormatError for parameters of another head model."""
        place = self.source.place(index)
        check_tracked(self.keys[index].name, place.tracked, self.head)
        return place

    def state(self, index: int) -> HeadState:
        """Return the tracked head of a sample, posed once per (subject, expression)."""
        return self._states.get(
            self.keys[index].frame, lambda: pose_state(self.head, self.place(index).tracked)
        )

    def view_of(self, place: Place) -> PinholeView:
        """Return a camera in head space, float64: subjects may be far from the origin."""
        camera = place.cam_from_world @ make_transform(place.tracked.R, place.tracked.t)
        return PinholeView(
            K=torch.as_tensor(place.K, dtype=torch.float64, device=self.head.device),
            cam_from_head=torch.as_tensor(camera, dtype=torch.float64, device=self.head.device),
            width=place.size[1],
            height=place.size[0],
        )

    def _tensor(self, array: np.ndarray) -> Tensor:
        # The bytes travel to a GPU as they are, and become floats there.
        there = torch.from_numpy(np.ascontiguousarray(array)).to(self.head.device)
        return there.to(self.head.dtype)


def check_tracked(where: str, tracked: Tracked, head: HeadModel) -> None:
    """Raise FormatError for parameters that the head model does not have."""
    shapes, expressions = head.shape_dirs.shape[2], len(head.expression_names)
    for what, got, limit in (
        ("shape coefficients", len(tracked.shape), shapes),
        ("expression coefficients", len(tracked.expression), expressions),
        ("offsets", len(tracked.offsets), len(head.template)),
    ):
        # Trailing coefficients may be missing; offsets are either complete or absent.
        if got > limit or (what == "offsets" and got not in (0, limit)):
            raise FormatError(
                f"{where}: {got} {what}, head model {head.name!r} has {limit}; was "
                "the dataset tracked with another head model? If not, pack it again"
            )


def pose_state(head: HeadModel, tracked: Tracked) -> HeadState:
    """Rebuild the tracked mesh in head space from parameters."""

    def row(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=head.dtype, device=head.device)[None]

    shape, expression = row(tracked.shape), row(tracked.expression)
    neck, jaw = row(tracked.neck), row(tracked.jaw)
    offsets = row(tracked.offsets) if len(tracked.offsets) else None
    with torch.no_grad():
        vertices = pose(head, shape, expression, neck, jaw, row(tracked.eyes), offsets=offsets)[0]
    missing = len(head.expression_names) - expression.shape[1]
    return HeadState(
        vertices=vertices,
        shape=shape[0],
        expression=torch.nn.functional.pad(expression[0], (0, missing)),
        neck=neck[0],
        jaw=jaw[0],
    )


def padded(values: np.ndarray, length: int) -> np.ndarray:
    """Pad rows (n, ...) with zeros, which missing coefficients are."""
    return np.pad(values, [(0, length - len(values)), *[(0, 0)] * (values.ndim - 1)])


def stacked(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Stack arrays (n, ...) of different lengths; shorter ones are `padded`."""
    length = max(map(len, rows))
    return np.stack([padded(row, length) for row in rows])


class Shuffle:
    """Endless shuffled order over ``indices``, a pure function of (seed, epoch, position).

    A resumed run therefore continues exactly where it stopped. State: the number of samples taken.
    """

    def __init__(self, indices: Sequence[int], seed: int, rank: int = 0, world: int = 1) -> None:
        """Take every world-th entry of the common order for process ``rank``."""
        self.indices, self.seed, self.rank, self.world = list(indices), seed, rank, world
        self.taken = 0
        self._epoch, self._order = -1, np.zeros(0, int)

    def next(self) -> int:
        """Return the index of this rank's next sample."""
        epoch, position = divmod(self.taken + self.rank, len(self.indices))
        if epoch != self._epoch:
            order = np.random.default_rng([self.seed, epoch]).permutation(self.indices)
            self._epoch, self._order = epoch, order
        self.taken += self.world
        return int(self._order[position])

    def peek(self) -> int:
        """Return what `next` will return."""
        taken, index = self.taken, self.next()
        self.taken = taken
        return index

    def state(self) -> dict[str, int]:
        """Return the state that `restore` takes."""
        epoch, position = divmod(self.taken, len(self.indices))
        return {"epoch": epoch, "position": position}

    def restore(self, state: dict[str, int]) -> None:
        """Resume after the last sample taken when ``state`` was saved."""
        self.taken = state["epoch"] * len(self.indices) + state["position"]
