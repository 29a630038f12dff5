"""Check sync, light and focus of the cameras: figures for ``checks.json`` and warnings for people.

- Sync: every camera sees the same face move, so the curve of how much changes from frame to frame
  is compared with the median curve of the others. The likeliest path of lags (Viterbi) shows where
  a camera lost or repeated frames.
- Light: the subject moves, but the background and most of the face do not. Each cell of a frame is
  compared with its own median over time, and the median over the cells counts.
- Focus: the width of the sharpest edges is compared with the other cameras and over time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import cv2
import numpy as np
import scipy

from express50.files.video import VideoTags
from express50.geometry.pixels import linear_to_srgb, shrink, srgb_to_linear
from express50.geometry.sampling import edge_width

SIDE = 96  # longer side, pixels, of the images in which movement is measured
FEWEST_CAMERAS, FEWEST_FRAMES = 3, 24
SPAN = 15  # frames of the running mean that is subtracted: views differ in how much they see
STEP_COST = 10.0  # cost of a change of lag, in units of log likelihood
FRAME_COST = 1.0  # cost per frame of a lag: cameras mostly lose few frames
START_COST = 7.0  # cost of being out of step from the start
ALIKE = 0.35  # least correlation with the other cameras at which a camera is judged
EARLY = 8  # a change of lag before this frame of a clip counts as one before its start
LEAST_SPREAD = 0.15  # of curves of unit variance, between different views
MOVING = 1.5  # ratio of quick to slow movement; noise alone has less than 1.2
STILL = 0.05  # share of a camera's usual movement below which a frame repeats the one before

CELLS = 16
DARK, BRIGHT = 0.004, 0.85  # linear light between which a cell shows the camera's gain
DRIFT_SPAN = 9  # frames of the running median: a passing hand is not a drift
FEWEST_CELLS = 12
FEWEST_DRIFT_FRAMES = 12  # with fewer, a movement looks like a drift
DIM = 0.05  # linear light, level 63 of 255, below which nothing in a picture is well exposed
COLOURLESS = 0.03  # share by which red, green and blue differ at most in pictures without colours
EXPOSURE_DRIFT, COLOUR_DRIFT = 0.15, 0.06  # stops over the capture from which on it is a warning
_CURVE = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0).astype(np.float32)


@dataclass(frozen=True)
class CameraMeasurements:
    """Measurements of one camera's frames."""

    frames: np.ndarray  # (N,) the frames that were decoded
    moves: np.ndarray  # (N,) movement since the one before, grey levels
    cells: np.ndarray  # (N, 16, 16, 3) linear light
    widths: tuple[tuple[int, float], ...]  # some frames, and the width of their sharpest edges
    tags: VideoTags | None = None  # what its first video says of its pictures; None if it has none


@dataclass
class FrameMeasures:
    """Measures the decoded frames of one camera one by one.

    Sharpness is measured at most once in ``focus_every`` frames, and never if that is 0.
    """

    focus_every: int
    frames: list[int] = field(default_factory=list)
    moves: list[float] = field(default_factory=list)
    cells: list[np.ndarray] = field(default_factory=list)
    widths: list[tuple[int, float]] = field(default_factory=list)
    before: np.ndarray | None = None
    next_look: int = 0

    def add(self, frame: int, image: np.ndarray, small: np.ndarray) -> None:
        """Measure a frame (H, W, 3) uint8, given with its proxy (h, w, 3)."""
        grey = small_grey(small)
        self.frames.append(frame)
        self.moves.append(movement(self.before, grey))
        self.cells.append(light_cells(small).astype(np.float16))
        self.before = grey
        if self.focus_every and frame >= self.next_look:
            self.next_look = frame + self.focus_every
            if (width := edge_width(image)) is not None:
                self.widths.append((frame, width))

    def finish(self, tags: VideoTags | None) -> CameraMeasurements:
        """Return the measurements of all frames."""
        cells = np.stack(self.cells)
        return CameraMeasurements(
            np.array(self.frames), np.array(self.moves), cells, tuple(self.widths), tags
        )


def check_quality(
    measured: Mapping[str, CameraMeasurements],
    digests: Mapping[str, str],
    clips: Sequence[int],
    every: int,
    sync_frames: int,
    blur_ratio: float,
) -> tuple[dict, dict[str, str]]:
    """Return the figures for ``checks.json`` and the warnings by camera.

    ``digests`` are of each camera's files, ``clips`` the frames of each recording. Sync is checked
    if ``every`` is 1: all frames were decoded.
    """
    moves: dict[str, np.ndarray] = {}
    steps: dict[str, list[Step]] = {}
    unjudged: dict[str, str] = {}
    warnings = {}
    if every > 1:
        unjudged = dict.fromkeys(sorted(measured), "not all frames were decoded (ingest.every)")
        if sync_frames and len(measured) >= FEWEST_CAMERAS and max(clips) >= FEWEST_FRAMES:
            warnings["sync"] = (
                f"not checked, as one of {every} frames was decoded; if cameras may be out of step,"
                " ingest with --set ingest.every=1"
            )
    else:
        count = min(sum(clips), *(len(s.moves) for s in measured.values()))
        moves = {name: s.moves[:count] for name, s in measured.items()}
        if sync_frames:
            steps, unjudged = find_steps(moves, clips, sync_frames)
    stuck = find_repeats(moves)
    drifts = {n: measure_drift(s.cells.astype("float32"), s.frames) for n, s in measured.items()}
    widths, blurred = judge_focus({n: s.widths for n, s in measured.items()}, blur_ratio)
    grey = [name for name, s in measured.items() if is_colourless(s.cells)]
    first: dict[str, str] = {}
    for name in sorted(measured):
        faults = []
        if (twin := first.setdefault(digests[name], name)) != name:
            faults.append(f"has the same files as camera {twin}; remove the copy")
        if name in steps:
            faults.append(describe_steps(steps[name]))
        if frames := stuck.get(name):
            shown = ", ".join(map(str, frames[:6])) + (", ..." if len(frames) > 6 else "")
            faults.append(
                f"repeats the frame before in {len(frames)} frames ({shown}) while others move"
            )
        faults += describe_dark(measured[name].cells)
        if name in grey and len(grey) < len(measured):
            faults.append(
                "no colours, unlike other cameras: look at its mattes, because people and walls"
                " are separated by brightness alone"
            )
        faults += describe_drift(drifts[name])
        faults += [blurred[name]] if name in blurred else []
        if faults:
            warnings[f"camera {name}"] = "; ".join(faults)
    if len(unjudged) == len(measured) and all_move(moves, clips):
        warnings["sync"] = (
            "all cameras see movement, but no two the same: they are out of step by more than"
            f" {sync_frames} frames, or show different things; cut their footage so that all begin"
            " at the same moment"
        )
    figures = {
        "sync": {
            "out_of_step": {k: [asdict(s) for s in v] for k, v in steps.items()},
            "repeats": stuck,
            "unjudged": unjudged,
        },
        "light": {k: asdict(d) if d else None for k, d in drifts.items()},
        "focus_px": widths,
    }
    return figures, warnings


@dataclass(frozen=True)
class Step:
    """From ``frame`` on, a camera's frame n shows what the others show in n + ``lag``."""

    frame: int
    lag: int


def all_move(moves: Mapping[str, np.ndarray], clips: Sequence[int]) -> bool:
    """Return whether enough cameras see something move for long enough to be compared."""
    if len(moves) < FEWEST_CAMERAS or max(clips) < FEWEST_FRAMES:
        return False
    slow, fast = np.percentile(np.stack(list(moves.values()))[:, 1:], (10, 90), axis=1)
    return bool((fast > MOVING * slow).all())


def small_grey(image: np.ndarray) -> np.ndarray:
    """Return a grey image float32, longer side at most 96 pixels, of an image (H, W, 3) uint8."""
    return shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), SIDE)


def movement(before: np.ndarray | None, after: np.ndarray) -> float:
    """Return the mean change between two small grey images, grey levels; 0 for the first."""
    return 0.0 if before is None else float(np.abs(after - before).mean())


def find_steps(
    moves: Mapping[str, np.ndarray], clips: Sequence[int], reach: int
) -> tuple[dict[str, list[Step]], dict[str, str]]:
    """Find the steps of cameras that are out of step, and why other cameras cannot be judged.

    ``moves`` (F,) are all of one length; ``clips`` are the frames of each recording and ``reach``
    is the largest lag, frames.
    """
    names = sorted(moves)
    if len(names) < FEWEST_CAMERAS:
        return {}, dict.fromkeys(names, f"fewer than {FEWEST_CAMERAS} cameras")
    total, start = len(moves[names[0]]), 0
    lags = {name: np.zeros(total, np.int64) for name in names}
    judged: set[str] = set()
    for count in clips:
        part = slice(start, min(start + count, total))
        found: dict[str, np.ndarray] = {}
        alike: set[str] = set()
        if part.stop - part.start >= FEWEST_FRAMES:
            curves = {n: _curve(moves[n][part].astype(float)) for n in names}
            found, alike = _lags_of_clip(curves, reach)
        for name, path in lags.items():
            # A clip that cannot be judged goes on as the one before it ended.
            path[part] = found.get(name, 0) if name in alike else path[start - 1]
        judged |= alike
        start += count
    edges = {name: np.flatnonzero(np.diff(path, prepend=0)) for name, path in lags.items()}
    steps = {n: [Step(int(t), int(lags[n][t])) for t in at] for n, at in edges.items() if len(at)}
    why = "too few frames or too little movement that others see too"
    return steps, {name: why for name in names if name not in judged}


def _curve(moves: np.ndarray) -> np.ndarray:
    """Return the logarithm of movement (F,) less its running mean, scaled to unit deviation."""
    floor = max(float(np.median(moves)) * 0.2, 1e-3)
    values = np.log(moves + floor)
    values[0] = values[1]  # the first frame has no predecessor
    span = min(SPAN, len(values) // 2 * 2 - 1)
    padded = np.pad(values, span // 2, mode="reflect")
    values = values - np.convolve(padded, np.ones(span) / span, mode="valid")
    return values / max(float(values.std()), 1e-6)


def _lags_of_clip(
    curves: Mapping[str, np.ndarray], reach: int
) -> tuple[dict[str, np.ndarray], set[str]]:
    """Return the lags (F,) of cameras out of step, and the cameras that move as the others do.

    The camera with the strongest evidence is taken out first: left in, it would distort what the
    others are compared with.
    """
    lags: dict[str, np.ndarray] = {}
    alike: set[str] = set()
    while len(curves) - len(lags) >= FEWEST_CAMERAS:
        left = {name: curve for name, curve in curves.items() if name not in lags}
        rest = {n: np.median([c for m, c in left.items() if m != n], axis=0) for n in left}
        # The spread of the median camera: with its own, a camera out of step would look normal.
        misses = [np.mean((left[n] - rest[n])[1:] ** 2) for n in left]
        spread = max(float(np.median(misses)), LEAST_SPREAD)
        gains = {}
        for name in left:
            path, gain, correlation = _likeliest_lags(left[name], rest[name], reach, spread)
            if correlation >= ALIKE:
                alike.add(name)
                if path.any():
                    gains[name] = gain, path
        if not gains:
            break
        worst = max(gains, key=lambda name: gains[name][0])
        path = gains[worst][1]
        for t in np.flatnonzero(np.diff(path[:EARLY]))[:1]:
            path[: t + 1] = path[t + 1]
        lags[worst] = path
    return lags, alike


def _likeliest_lags(
    curve: np.ndarray, rest: np.ndarray, reach: int, spread: float
) -> tuple[np.ndarray, float, float]:
    """Return the likeliest lag (F,) of each frame, and its log likelihood over no lag at all.

    The correlation of the curve with that of the others along these lags comes third.
    """
    count = len(curve)
    lags = np.arange(-reach, reach + 1)
    at = np.arange(count)[:, None] + lags
    beyond = (at < 0) | (at >= count)
    miss = (curve[:, None] - rest[np.clip(at, 0, count - 1)]) ** 2 / (2 * spread)
    # Beyond the clip there is nothing to compare: lags cost there what being in step costs.
    miss = np.minimum(np.where(beyond, miss[:, reach : reach + 1], miss), 6.0)
    total = miss[0] + (START_COST + FRAME_COST * np.abs(lags)) * (lags != 0)
    far = np.abs(lags[:, None] - lags)
    change = (STEP_COST + FRAME_COST * far) * (far > 0)
    never = np.where(far > 0, np.inf, 0.0)
    came = np.zeros((count, len(lags)), dtype=np.int64)
    for t in range(1, count):
        # So near the end, frames without a counterpart would decide about a change.
        late = t >= count - 2 * reach
        ways = total[:, None] + (never if late else change)
        came[t] = ways.argmin(axis=0)
        total = ways.min(axis=0) + miss[t]
    path = np.zeros(count, dtype=np.int64)
    state = int(total.argmin())
    gain = float(miss[:, reach].sum() - total[state])
    for t in range(count - 1, -1, -1):
        path[t] = lags[state]
        state = int(came[t, state])
    at = np.arange(count) + path
    inside = (at >= 1) & (at < count)
    a, b = curve[inside], rest[at[inside]]
    flat = len(a) < FEWEST_FRAMES // 2 or a.std() < 1e-9 or b.std() < 1e-9
    return path, gain, 0.0 if flat else float(np.corrcoef(a, b)[0, 1])


def describe_steps(steps: Sequence[Step]) -> str:
    """Describe the steps of a camera for people."""
    parts = []
    before = 0
    for step in steps:
        change = step.lag - before
        frames = f"{abs(change)} frame{'s' if abs(change) > 1 else ''}"
        if step.frame == 0:
            side = "ahead of" if step.lag > 0 else "behind"
            parts.append(f"is {frames} {side} the others from its start")
        else:
            what = "loses" if change > 0 else "repeats or gains"
            parts.append(f"{what} {frames} at about frame {step.frame}")
        before = step.lag
    return "; ".join(parts) + "; cut its footage so that the cameras show the same moment"


def find_repeats(moves: Mapping[str, np.ndarray]) -> dict[str, list[int]]:
    """Find the frames of each camera that repeat the one before while most others move."""
    names = sorted(moves)
    if len(names) < FEWEST_CAMERAS:
        return {}
    table = np.stack([moves[name] for name in names])
    usual = np.median(table, axis=1, keepdims=True)
    moving = (table > 0.5 * usual).sum(axis=0) > len(names) // 2
    stuck = (table < STILL * usual) & moving
    stuck[:, 0] = False
    return {
        n: np.flatnonzero(row).tolist() for n, row in zip(names, stuck, strict=True) if row.any()
    }


@dataclass(frozen=True)
class Drift:
    """Range of a camera's light over the capture, in stops."""

    exposure: float  # mean over red, green and blue
    red: float  # against green
    blue: float  # against green
    brightest: int  # frame of the largest exposure
    darkest: int  # frame of the smallest exposure


def light_cells(image: np.ndarray) -> np.ndarray:
    """Return the mean linear light (16, 16, 3) float32 of an image (H, W, 3) uint8."""
    return cv2.resize(_CURVE[image], (CELLS, CELLS), interpolation=cv2.INTER_AREA)


def describe_dark(cells: np.ndarray) -> list[str]:
    """Describe a camera whose cells (F, 16, 16, 3) are dark in all frames; empty if they are not.

    Files of 16 bits look like this if they hold a sensor's 10 to 14 bits.
    """
    brightest = float(cells.max())
    if brightest >= DIM:
        return []
    level = 255 * float(linear_to_srgb(np.array(brightest, np.float32)))
    return [
        f"is very dark: its brightest parts have level {level:.0f} of 255; correct its exposure, or"
        " if its files hold 10 to 14 bits in 16, multiply the values to fill all 16"
    ]


def is_colourless(cells: np.ndarray) -> bool:
    """Return whether no cell (F, 16, 16, 3) of a camera that is not dark has a colour."""
    seen = cells[cells.max(-1) >= DIM].astype(np.float32)
    return bool(len(seen)) and bool((np.ptp(seen, axis=-1) < COLOURLESS * seen.max(-1)).all())


def measure_drift(cells: np.ndarray, frames: np.ndarray) -> Drift | None:
    """Measure the drift of a camera's cells (N, 16, 16, 3); None with too few frames or cells.

    ``frames`` (N,) are the frames' numbers.
    """
    if len(cells) < FEWEST_DRIFT_FRAMES:
        return None
    usual = np.median(cells, axis=0)
    usable = ((usual > DARK) & (usual < BRIGHT)).all(axis=-1)
    if usable.sum() < FEWEST_CELLS:
        return None
    stops = np.log2(np.maximum(cells[:, usable], 1e-4) / usual[usable])  # (F, N, 3)
    curve = scipy.ndimage.median_filter(np.median(stops, axis=1), (DRIFT_SPAN, 1), mode="nearest")
    exposure = curve.mean(axis=1)
    return Drift(
        exposure=float(np.ptp(exposure)),
        red=float(np.ptp(curve[:, 0] - curve[:, 1])),
        blue=float(np.ptp(curve[:, 2] - curve[:, 1])),
        brightest=int(frames[exposure.argmax()]),
        darkest=int(frames[exposure.argmin()]),
    )


def describe_drift(drift: Drift | None) -> list[str]:
    """Describe the faults of a camera's light; empty if there are none."""
    if drift is None:
        return []
    wrong = []
    if drift.exposure > EXPOSURE_DRIFT:
        wrong.append(
            f"exposure changes by {drift.exposure:.2f} stops between frame {drift.darkest} (dark) "
            f"and {drift.brightest} (bright)"
        )
    colours = [(n, v) for n, v in (("red", drift.red), ("blue", drift.blue)) if v > COLOUR_DRIFT]
    if colours:
        changes = " and ".join(f"{name} by {value:.2f} stops" for name, value in colours)
        wrong.append(f"white balance changes, {changes} against green")
    return wrong


def judge_focus(
    widths: Mapping[str, Sequence[tuple[int, float]]], ratio: float
) -> tuple[dict[str, float], dict[str, str]]:
    """Return each camera's median width, pixels, and the cameras out of focus with the reason.

    ``widths`` are (frame, width) samples; edges ``ratio`` times as wide as usual are out of focus.
    """
    middle = {name: float(np.median([w for _, w in rows])) for name, rows in widths.items() if rows}
    wrong = {}
    for name, width in middle.items():
        others = [w for other, w in middle.items() if other != name]
        usual = float(np.median(others)) if len(others) > 1 else width
        if width > ratio * max(usual, 0.5):
            wrong[name] = (
                f"out of focus: its sharpest edges are {width:.1f} px wide, the other cameras' "
                f"{usual:.1f}"
            )
            continue
        third = max(1, len(widths[name]) // 3)
        first, last = widths[name][:third], widths[name][-third:]
        before, after = (float(np.median([w for _, w in rows])) for rows in (first, last))
        if len(widths[name]) >= 6 and max(before, after) > ratio * max(min(before, after), 0.5):
            wrong[name] = (
                f"its focus changes: the sharpest edges are {before:.1f} px wide about frame "
                f"{first[0][0]}, {after:.1f} about frame {last[-1][0]}"
            )
    return middle, wrong
