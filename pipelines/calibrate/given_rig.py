"""Compare given cameras with what was recorded: find those that moved, refine those a little off.

To find cameras that have moved, points are fitted with one camera free after the other. The one
that explains most has moved, and the rest are tried again, so that a bump is not blamed on
neighbours. Refinement changes all cameras, but only if held-out points then fit clearly better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import MODELS, Camera, pinhole, project, triangulate
from express50.geometry.transforms import matrix_to_axis_angle
from pipelines.calibrate.adjuster import (
    AdjustedRig,
    RigPriors,
    adjust_rig,
    single_camera_gains,
    triangulate_tracks,
)
from pipelines.calibrate.footage import at_footage_size, reduced_camera
from pipelines.calibrate.footage_rig import EYES
from pipelines.calibrate.tracks import (
    LEAST_POINTS,
    FrameSetPoints,
    PointTracks,
    join_tracks,
    mirrored_cameras,
    neighbours,
)

MOVE_BANDS = ((0.1, 0.015), (0.02, 0.003))
"""Two passes, bumps of degrees first: largest distance of matches from epipolar lines, and least
shift of a moved camera's picture, as shares of the diagonal."""
LEAST_GAIN, GAIN_RATIO = 30.0, 4.0
"""Freeing a moved camera must lower the robust cost by this much (noise alone: half a chi-square
of six, under 15) and that much more than freeing any other, and by GAIN_RATIO times what the median
other camera would. With few points in common, freeing any of three cameras explains chance matches
about as well."""
MOVE_PRIORS = RigPriors(turn_rad=np.radians(1.0), move_m=0.01)
MOVE_SCALES, ITERATIONS = (6.0, 3.0, 1.5), 4
"""Sigmas at which residuals flatten: a camera that is off by a few pixels must not be rejected
together with the mismatches. Four iterations per scale name the cameras that convergence names."""
HELD = 5  # every fifth point is held out: it judges the result
CLEARLY = 0.8
"""Held-out errors must fall below this share of those before; true rigs gain up to 6 %, too."""
REFINE_BAND = 0.03  # of features about the given rig's epipolar lines, as a share of the diagonal
REFINE_SCALES = (3.0, 1.5)
EYES_MM, USUAL_EYES_MM = (46.0, 80.0), 63.0
"""Pupils of adults are 54 to 74 mm apart, of six-year-olds 50 mm; landmarks err by up to 4 %."""
ODD_FACES, EXPLAINED, WORST = 0.6, 0.6, 10.0
"""Mean error of a face's landmarks over its expected one: true rigs have 0.2 to 0.3, and odd ones
more than the first. What explains it leaves less than this share. Views count up to the last."""
LENS = RigPriors(focal=0.005, focal_spread=0.005, centre=0.002, bend=0.005)  # of given lenses


@dataclass(frozen=True)
class CameraMove:
    """The estimated motion of a camera since it was calibrated.

    Only the picture's shift is measured: turns and moves trade places at a head's distance.
    """

    shift_px: float
    turn_deg: float
    move_mm: float
    odd_face: bool  # its face is so far off that it may be another person's


@dataclass(frozen=True)
class FootageCheck:
    """The result of checking cameras against points that two or more of them see."""

    points: int
    error_px: float | None  # median reprojection error, None without points
    moved: dict[str, CameraMove]  # the surest first
    unchecked: dict[str, str]  # a reason per camera
    mirrored: dict[str, str]  # the reason to believe that a camera's pictures are
    exchanged: tuple[tuple[str, str], ...]  # pairs of cameras that fit each other's footage
    size: str  # what is odd about the size of heads, or empty
    cameras: dict[str, Camera]  # with the corrected poses


def check_footage(
    cameras: Mapping[str, Camera], seen: Mapping[int, FrameSetPoints]
) -> FootageCheck:
    """Search three or more cameras for those that have moved since they were calibrated.

    `seen` are points by frame number, in pixels of `reduced_camera`.

    Raises:
        CalibrationError: fewer than three cameras.
    """
    if len(cameras) < 3:
        raise CalibrationError(
            f"{len(cameras)} cameras; three or more are needed to say which one has moved"
        )
    now = {name: reduced_camera(camera) for name, camera in cameras.items()}
    odd = {frame: _odd_faces(now, points) for frame, points in seen.items()}
    now, exchanged, size = _judge_faces(
        now, {frame: points.without(odd[frame]) for frame, points in seen.items()}
    )
    moved: list[str] = []
    for band, least_shift in MOVE_BANDS:
        tracks = join_tracks(now, seen, band, verified=False)
        now, found = _free_moved_cameras(now, tracks, least_shift)
        moved += [name for name in found if name not in moved]
    fit = _fit(now, tracks, triangulate_tracks(now, tracks), ())
    errors = np.linalg.norm(fit.errors, axis=1)
    corrected = {n: replace(c, cam_from_world=now[n].cam_from_world) for n, c in cameras.items()}
    moves = {
        name: CameraMove(
            _picture_shift(cameras[name], corrected[name], fit, tracks),
            *_turn_and_move(cameras[name], corrected[name]),
            any(name in names for names in odd.values()),
        )
        for name in moved
    }
    widths = {name: camera.width for name, camera in now.items()}
    return FootageCheck(
        points=len(fit.points),
        error_px=float(np.median(errors)) if len(errors) else None,
        moved=moves,
        unchecked={
            name: f"shares {count} points with two others, expected {LEAST_POINTS} or more"
            for name, count in zip(tracks.names, tracks.shared_points(), strict=True)
            if count < LEAST_POINTS
        },
        mirrored=mirrored_cameras(seen, widths, neighbours(cameras)),
        exchanged=exchanged,
        size=size,
        cameras=corrected,
    )


def _odd_faces(cameras: Mapping[str, Camera], seen: FrameSetPoints) -> set[str]:
    """Name the cameras whose face is not where at least three cameras, and most, see one.

    It is another person's, or the camera has moved far.
    """
    views = [(cameras[name], pixels.mean(0)) for name, pixels, _ in seen.landmarks]
    if len(views) < 4:
        return set()
    middles = np.stack([middle for _, middle in views])
    places = np.concatenate([
        triangulate([views[a][0], views[b][0]], middles[[a, b], None])
        for a, b in combinations(range(len(views)), 2)
    ])  # fmt: skip
    off = np.stack([np.linalg.norm(project(c, places)[0] - middle, axis=1) for c, middle in views])
    reach = [MOVE_BANDS[0][0] * np.hypot(camera.width, camera.height) for camera, _ in views]
    near = off < np.array(reach)[:, None]  # a NaN is not
    kept = near[:, near.sum(0).argmax()]
    if kept.sum() <= max(2, len(views) / 2):
        return set()
    return {name for (name, _, _), keep in zip(seen.landmarks, kept, strict=True) if not keep}


def _judge_faces(
    cameras: dict[str, Camera], seen: Mapping[int, FrameSetPoints]
) -> tuple[dict[str, Camera], tuple[tuple[str, str], ...], str]:
    """Find exchanged cameras and wrong focal lengths by the faces that cameras see together.

    Returns the cameras without these faults, the pairs, and what is odd about the heads' size.
    With under three cameras that see faces, nothing is judged.
    """
    faces = {frame: FrameSetPoints(points.landmarks, {}) for frame, points in seen.items()}
    tracks = join_tracks(cameras, faces, 1.0, verified=False)
    if len(np.unique(tracks.camera)) < 3:
        return cameras, (), ""
    showing = [tracks.names[i] for i in np.unique(tracks.camera)]
    error, _ = _fit_faces(cameras, tracks)
    pairs: list[tuple[str, str]] = []
    while error > ODD_FACES:  # exchange pairs while that explains most of the error
        tried = {
            (min(a, b), max(a, b)): {
                **cameras,
                a: replace(cameras[b], id=a),
                b: replace(cameras[a], id=b),
            }
            for a in showing
            for b in cameras
            if a != b
            and cameras[a].width == cameras[b].width
            and cameras[a].height == cameras[b].height
        }
        errors = {pair: _fit_faces(rig, tracks)[0] for pair, rig in tried.items()}
        best = min(errors, key=lambda pair: errors[pair], default=None)
        if best is None or errors[best] > EXPLAINED * error:
            break
        cameras, error = tried[best], errors[best]
        pairs.append(best)
    cameras, size = _judge_size(cameras, tracks)
    return cameras, tuple(pairs), size


def _judge_size(cameras: dict[str, Camera], tracks: PointTracks) -> tuple[dict[str, Camera], str]:
    """Compare the distance between the eyes with that of people.

    The cameras get other focal lengths if these alone explain the distance. The warning is empty if
    the distance is usual.
    """
    error, eyes_mm = _fit_faces(cameras, tracks)
    nowhere = not 1e-3 < eyes_mm < np.inf  # cameras of one place do not triangulate
    if nowhere or EYES_MM[0] < eyes_mm < EYES_MM[1]:
        return cameras, ""
    factor = eyes_mm / USUAL_EYES_MM
    other = {}  # the cameras with focal lengths that explain the distance
    for name, camera in cameras.items():
        params = [
            p * factor if key in ("f", "fx", "fy") else p
            for key, p in zip(MODELS[camera.model], camera.params, strict=True)
        ]
        other[name] = replace(camera, params=tuple(params))
    share = _fit_faces(other, tracks)[0] / max(error, 1e-9)
    focal = f"the focal lengths {_times(1 / factor)}" if share < 1 / EXPLAINED else ""
    lengths = f"the rig's lengths {_times(factor)}" if share > EXPLAINED else ""
    words = (
        f"faces have their eyes {eyes_mm:.0f} mm apart, people 54 to 74 mm; probably"
        f" {' or '.join(filter(None, (focal, lengths)))}: give focal lengths in pixels of the"
        " footage, and the calibration, or square_length_m in board.toml, in metres"
    )
    return cameras if lengths else other, words


def _times(ratio: float) -> str:
    """Describe a length that is `ratio` times the right one."""
    long = ratio > 1
    return f"are {float(f'{max(ratio, 1 / ratio):.2g}'):g} times too {'long' if long else 'short'}"


def _fit_faces(cameras: Mapping[str, Camera], tracks: PointTracks) -> tuple[float, float]:
    """Return the mean error of views of faces, over the expected one, and eyes' distance in mm."""
    points = triangulate_tracks(cameras, tracks)
    errors = []
    for number in np.unique(tracks.camera):
        mine = tracks.camera == number
        pixels = project(cameras[tracks.names[number]], points[tracks.point[mine]])[0]
        off = np.linalg.norm(pixels - tracks.pixels[mine], axis=1) / tracks.sigma[mine]
        errors += np.median(np.nan_to_num(off, nan=WORST).reshape(-1, 68), axis=1).tolist()
    eyes = np.stack([points.reshape(-1, 68, 3)[:, side].mean(1) for side in EYES])
    gap = float(np.median(np.linalg.norm(eyes[0] - eyes[1], axis=1)))
    return float(np.minimum(errors, WORST).mean()), 1e3 * gap


def _free_moved_cameras(
    cameras: Mapping[str, Camera], tracks: PointTracks, least_shift: float
) -> tuple[dict[str, Camera], list[str]]:
    """Free one camera after the other while that explains enough; at most a third of the rig.

    The first-order gain does not distinguish a moved camera from its neighbours where few cameras
    see each other. So the three with the largest gain are each freed in a fit of their own.
    """
    points = triangulate_tracks(cameras, tracks)
    free: tuple[str, ...] = ()
    fit = _fit(cameras, tracks, points, free)
    while len(free) < max(1, len(cameras) // 3):
        gain = single_camera_gains(fit, tracks, MOVE_PRIORS, MOVE_SCALES[-1], free)
        enough = (tracks.shared_points() >= LEAST_POINTS) & (gain >= 0.5 * LEAST_GAIN)
        likely = [tracks.names[i] for i in np.argsort(-gain, kind="stable") if enough[i]]
        tried = {
            name: _fit(cameras, tracks, points, (*free, name))
            for name in [n for n in likely if n not in free][:3]
        }
        if not tried:
            break
        name = min(tried, key=lambda name: (tried[name].cost, name))
        found, camera = tried[name], cameras[name]
        shift = _picture_shift(camera, found.cameras[name], found, tracks)
        others = single_camera_gains(found, tracks, MOVE_PRIORS, MOVE_SCALES[-1], (*free, name))
        rival = max((fit.cost - tried[n].cost for n in tried if n != name), default=0.0)
        needed = max(LEAST_GAIN + rival, GAIN_RATIO * float(np.median(others)))
        if shift < least_shift * np.hypot(camera.width, camera.height):
            break
        if fit.cost - found.cost < needed:
            break
        free, fit = (*free, name), found
    return fit.cameras, list(free)


def _fit(
    cameras: Mapping[str, Camera], tracks: PointTracks, points: np.ndarray, free: tuple[str, ...]
) -> AdjustedRig:
    return adjust_rig(cameras, tracks, points, MOVE_PRIORS, MOVE_SCALES, free, ITERATIONS)


def _picture_shift(before: Camera, after: Camera, fit: AdjustedRig, tracks: PointTracks) -> float:
    """Return median length, pixels, by which a camera's picture shifts between two of its poses."""
    seen = fit.points[tracks.point[tracks.camera == tracks.names.index(before.id)]]
    old, new = (project(pinhole(camera), seen)[0] for camera in (before, after))
    length = np.linalg.norm(new - old, axis=1)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) else 0.0


def _turn_and_move(before: Camera, after: Camera) -> tuple[float, float]:
    """Return degrees and millimetres by which a camera was turned and moved."""
    turn = after.cam_from_world[:3, :3] @ before.cam_from_world[:3, :3].T
    degrees = float(np.degrees(np.linalg.norm(matrix_to_axis_angle(turn))))
    return degrees, 1e3 * float(np.linalg.norm(after.center - before.center))


@dataclass(frozen=True)
class RefinedRig:
    """Cameras after refinement, and median errors of held-out points before and after."""

    cameras: dict[str, Camera]
    before_px: float
    after_px: float
    kept: str  # why the given cameras stayed, empty if they were replaced

    def figures(self, given: Mapping[str, Camera]) -> dict[str, object]:
        """Return metrics, including how far each camera was turned and moved."""
        moves = {}
        for name, after in {} if self.kept else self.cameras.items():
            turn_deg, move_mm = _turn_and_move(given[name], after)
            moves[name] = {"turn_deg": round(turn_deg, 4), "move_mm": round(move_mm, 3)}
        before, later = (
            round(error, 4) if np.isfinite(error) else None
            for error in (self.before_px, self.after_px)
        )
        return {
            "held_out_before_px": before,
            "held_out_after_px": later,
            "kept_given": bool(self.kept),
            "why": self.kept,
            "moves": moves,
        }


def refine_by_footage(
    given: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    *,
    turn_deg: float,
    move_mm: float,
    lenses: bool,
    start: Mapping[str, Camera] | None = None,
) -> RefinedRig:
    """Refine cameras, and if asked `lenses`, by points they saw at the same instants.

    `seen` are points by frame number, in pixels of `reduced_camera`. `turn_deg` and `move_mm` are
    standard deviations of how far cameras may be off. `start` are the given cameras with corrected
    poses of those that have clearly moved.
    """
    small = {name: reduced_camera(camera) for name, camera in given.items()}
    poses = {name: camera.cam_from_world for name, camera in (start or given).items()}
    placed = {name: replace(camera, cam_from_world=poses[name]) for name, camera in small.items()}
    tracks = join_tracks(placed, seen, REFINE_BAND)
    enough = tracks.shared_points() >= LEAST_POINTS
    names = tuple(n for n, ok in zip(tracks.names, enough, strict=True) if ok)
    tracks = tracks.of_cameras(names)
    held, fit = (tracks.select((tracks.point % HELD == 0) == side) for side in (True, False))
    if len(names) < 3 or len(held.camera) < LEAST_POINTS:
        why = "cameras share too few points"
        return RefinedRig(dict(given), np.nan, np.nan, why)
    priors = replace(
        LENS if lenses else RigPriors(), turn_rad=np.radians(turn_deg), move_m=move_mm * 1e-3
    )
    points = triangulate_tracks(placed, fit)
    found = adjust_rig(placed, fit, points, priors, REFINE_SCALES).cameras
    before, before_px = _judge(small, held)
    after, after_px = _judge(found, held)
    if not after < CLEARLY * before:
        why = "held-out points fit no better"
        return RefinedRig(dict(given), before_px, after_px, why)
    refined = dict(given)
    for name, camera in found.items():
        full = at_footage_size(camera, given[name]) if lenses else given[name]
        refined[name] = replace(full, cam_from_world=camera.cam_from_world)
    return RefinedRig(refined, before_px, after_px, "")


def _judge(cameras: Mapping[str, Camera], held: PointTracks) -> tuple[float, float]:
    """Return mean robust cost and median feature error, pixels, of held-out tracks."""
    points = triangulate_tracks(cameras, held)
    fit = adjust_rig(cameras, held, points, RigPriors(), REFINE_SCALES[-1:], free=(), iterations=15)
    errors = np.linalg.norm(fit.errors, axis=1)
    features = errors[held.features()]
    median = float(np.median(features if len(features) else errors))
    return fit.cost / len(errors), median
