"""Matte every camera of one peak, let the cameras correct each other, and write the mattes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_peak_frame, read_plate_image
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.error_model import error_bounds, error_models, expect
from express50.errors import CaptureError, NoFaceError, StageError
from express50.files.images import write_image
from express50.geometry.cameras import Camera, pinhole, resized
from express50.geometry.pixels import box_about, resize_area, shrink, tile_sheet
from express50.geometry.sampling import evenly, local_moments, undistorted_mask
from pipelines.matte.cutout import (
    MANY,
    CutView,
    HeadPlace,
    cut_out,
    find_head,
    find_neighbours,
    make_cut_view,
    region_of,
)
from pipelines.matte.key import dilated, eroded_about, key_alpha, opened
from pipelines.matte.plates import (
    LEAST_SHARE,
    MOST_WHITE,
    MatchedPlate,
    exposed,
    exposure_gain,
    match_plate,
    white_share,
)
from pipelines.matte.visual_hull import (
    EMPTY,
    INSIDE,
    SIDE,
    Agreement,
    Ball,
    MatteView,
    ball_of,
    compare_mattes,
    is_thing,
)
from pipelines.matte.wall import Wall, read_wall, soft_alpha, valid_pixels

COLUMNS = 6  # of the contact sheet
TILE = 240
SHOWN = 192  # longest side of the pictures in the contact sheet, pixels
RED, GREEN = (235, 50, 40), (50, 220, 80)
# Share of a side of the image that a subject's upper half may cover before it counts as cut off.
MOST_CONTACT = 0.02
SIDES = ("top", "right", "bottom", "left")  # of an image
OUTWARD = np.array([[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]])  # of the camera, by side
UPRIGHT = np.array([0, 0, 0.2, 0])  # share of a side that is as strong a sign as a camera's bottom
RIM = 0.008  # share of the longer side: distance from the outline in which errors are predicted
RIM_ROWS = 8  # rows of pixels that are judged within that distance, at least
WINDOW = 5  # pixels, odd: side of the window in which alpha's spread is measured
# Pictures with other people: least alpha that may be the subject's; radius of the smallest part of
# somebody else, share of the longer side; and the least share of an image that is taken out.
SURE_WALL, BESIDE, LEAST_OTHER = 13, 0.006, 1e-3
ENOUGH_VIEWS = 8  # to place the head by
LIKE_THE_WALL = (
    "its matte lacked a large part of the subject, which looks like the wall there; the part was"
    " added as the other cameras see it, so look at its outline, and record with more light or"
    " another wall"
)
SOMETHING_ELSE = "another person or thing is in the picture; its matte leaves it out"
NEARBY = 0.04  # share of the longer side: width of the neighbourhood that describes an outline

Read = Callable[[str], tuple[np.ndarray, np.ndarray]]
"""Read a camera's frame (H, W, 3) uint8 and its valid pixels (H, W) bool."""
MatteFunction = Callable[[np.ndarray, Any, np.ndarray], np.ndarray]
"""Solve opacity (H, W) float32 from a frame (H, W, 3) uint8, a plate or None, and valid pixels."""


@dataclass(frozen=True)
class CameraMatte:
    """The matte of one camera alone."""

    alpha: np.ndarray  # (H, W) uint8
    rgb: np.ndarray  # the frame reduced to `SHOWN`
    noise: float  # `wall_noise` of the full frame
    plated: bool = True
    sure: bool = True  # unless a plate had to be changed
    plate: np.ndarray | None = None  # reduced to `SHOWN`, in the frame's exposure


def run(
    dataset: Dataset, item: str, out: Path, *, method: str, weights: str, tile: int,
    shadow: float, agreeing: bool,
) -> Result:  # fmt: skip
    """Write `<camera>.png` per camera, and a contact sheet; `agreeing` cameras correct each other.

    Raises:
        StageError: no camera could be matted.
    """
    cv2.setNumThreads(1)  # the runner counts one core per item
    cameras = read_cameras_of(dataset, item.split("/")[0], undistorted=False)
    ball = ball_of(cameras)
    shots = Shots(dataset, item, method, _matte_function(method, weights, tile, shadow), cameras)
    keyed, dropped, odd_plates = camera_mattes(shots, ball)
    if not keyed:
        raise StageError(f"{item}: {dropped[0].why if dropped else 'no camera is calibrated'}")
    mattes, views, found, changed = agree(shots.read, cameras, keyed, ball if agreeing else None)
    if not agreeing:
        found = Agreement(unchanged="matte.agree is off")
    elif ball is None:
        alone = "it is the only camera" if len(cameras) == 1 else ""
        found = Agreement(unchanged=alone or "the cameras do not look at one place")
    alphas = {name: matte.alpha for name, matte in mattes.items()}
    final = {
        name: corrected(alpha, found.removed.get(name), found.filled.get(name))
        for name, alpha in alphas.items()
    }
    for name, alpha in final.items():
        write_image(out / f"{name}.png", alpha)
    _write_picture(out, mattes, found)
    figures = {
        "method": method,
        "views": len(views),
        "without_plate": [name for name, matte in mattes.items() if not matte.plated],
        "coverage": {name: round(float(a.mean()) / 255, 6) for name, a in final.items()},
        "border_contact": {name: border_contact(alpha) for name, alpha in final.items()},
        "removed": {name: _excess(alphas[name], final[name]) for name in found.removed},
        "filled": {name: _excess(final[name], alphas[name]) for name in found.filled},
        **({"unchanged": found.unchanged} if found.unchanged else {}),
    }
    named = {note.what for note in found.warnings}
    body = body_sides({name: cameras[name] for name in final}, final)
    odd = [note for note in matte_warnings(final, body) if note.what not in named]
    bounds = {
        name: error_bounds("matte", rim_figures(alpha, own.rgb, own.noise, own.plated, len(mattes)))
        for (name, alpha), own in zip(final.items(), mattes.values(), strict=True)
    }
    figures["expected"] = {name: asdict(e) for name, b in bounds.items() if (e := b.expected)}
    expected = expect(error_models()["matte"], np.concatenate([b.typical for b in bounds.values()]))
    return Result(figures, dropped, [*odd_plates, *changed, *found.warnings, *odd], expected)


def agree(
    read: Read, cameras: Mapping[str, Camera], mattes: Mapping[str, CameraMatte], ball: Ball | None
) -> tuple[Mapping[str, CameraMatte], list[MatteView], Agreement, list[Note]]:
    """Compare the mattes in the `ball`, after completing them and taking other people out of them.

    Nothing is compared without a ball. Returns the mattes, what was compared, the result, and which
    mattes were cut out again.
    """
    whole, views, found = completed(read, cameras, mattes, ball)
    notes = [Note(name, LIKE_THE_WALL) for name, own in whole.items() if own is not mattes[name]]
    # Shadows are common, and the faces take far longer to find than all this.
    thing = any(is_thing(v, found.removed[v.name]) for v in views if v.name in found.removed)
    plated = any(own.plated for own in mattes.values())
    if ball is None or not plated or not (thing or found.warnings):
        return whole, views, found, notes
    alone = without_others(read, cameras, whole, found.doubted, thing, ball)
    if alone is whole:
        return whole, views, found, notes
    notes += [Note(name, SOMETHING_ELSE) for name, own in alone.items() if own is not whole[name]]
    return alone, *compared(cameras, alone, ball), notes


def compared(
    cameras: Mapping[str, Camera], mattes: Mapping[str, CameraMatte], ball: Ball | None
) -> tuple[list[MatteView], Agreement]:
    """Compare the mattes in the `ball`, if there is one."""
    if ball is None:
        return [], Agreement()
    views = [make_view(cameras[n], ball, m.rgb, m.alpha, plate=m.plate) for n, m in mattes.items()]
    return views, compare_mattes(views)


def camera_mattes(
    shots: Shots, ball: Ball | None
) -> tuple[dict[str, CameraMatte], list[Note], list[Note]]:
    """Matte each camera of a peak; those without a plate are cut out together.

    Only one camera's full images are in memory at a time. `ball` is the volume that the cameras
    look at, None if they share none. Also returns the cameras without a matte, and warnings.
    """
    cameras = shots.cameras
    found: dict[str, CameraMatte] = {}
    seen: dict[str, CutView] = {}
    dropped: list[Note] = []
    odd: dict[str, str] = {}
    for name in cameras:
        try:
            frame, valid = shots.read(name)
            own, why = shots.matte(name, frame, valid)
        except (CaptureError, StageError) as error:
            dropped.append(Note(name, str(error)))
            continue
        if why or (own is not None and not own.sure):
            odd[name] = why
        if own is None:
            seen[name] = make_cut_view(pinhole(cameras[name]), frame, valid)
        else:
            found[name] = own
    try:
        found |= _with_other_views(shots, found, seen, odd, ball) if seen or odd else {}
    except NoFaceError as error:
        dropped = sorted(
            [*dropped, *(Note(name, str(error)) for name in seen)], key=lambda n: n.what
        )
    warnings = [Note(name, why) for name, why in odd.items() if why]
    return {name: found[name] for name in cameras if name in found}, dropped, warnings


@dataclass(frozen=True)
class Shots:
    """The frames of a peak, and how each is matted."""

    dataset: Dataset
    item: str
    method: str
    matte_one: MatteFunction
    cameras: Mapping[str, Camera]

    def read(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Read a frame (H, W, 3) uint8 and its valid pixels (H, W) bool."""
        subject, expression = self.item.split("/")
        frame = read_peak_frame(self.dataset, subject, expression, name)
        return frame, valid_pixels(self.cameras[name])

    def wall(self, name: str, frame: np.ndarray, valid: np.ndarray) -> Wall | None:
        """Read the wall that other moments show, if it is that of this frame."""
        found = read_wall(self.dataset, self.item.split("/")[0], name)
        return found if found is not None and found.fits(frame, valid) else None

    def matte(
        self, name: str, frame: np.ndarray, valid: np.ndarray, person: np.ndarray | None = None
    ) -> tuple[CameraMatte | None, str]:
        """Matte a frame alone, None without a plate that fits; see `_plate`."""
        subject = self.item.split("/")[0]
        found, why = _plate(self.dataset, subject, name, frame, valid, self.method, person)
        if found is None and self.method != "salient":
            return None, why
        alpha = self.matte_one(frame, None if found is None else found.plate, valid)
        own = _camera_matte(alpha, frame, valid)
        if found is None:
            return own, why
        plate = exposed(shrink(found.plate, SHOWN), exposure_gain(frame, found.plate))
        return replace(own, sure=found.sure, plate=np.rint(plate).astype(np.uint8)), why


def _camera_matte(alpha: np.ndarray, frame: np.ndarray, valid: np.ndarray) -> CameraMatte:
    found = np.rint(np.where(valid, alpha, np.float32(0)) * 255).astype(np.uint8)
    return CameraMatte(found, shrink(frame, SHOWN), wall_noise(found, frame))


def _with_other_views(
    shots: Shots, found: dict[str, CameraMatte], seen: dict[str, CutView], odd: dict[str, str],
    ball: Ball | None,
) -> dict[str, CameraMatte]:  # fmt: skip
    """Matte the cameras that were only `seen`, knowing where the faces say that the person is.

    Plates that did not fit as they were (`odd`) are compared anew, beside the person: their body
    may leave a turned camera's picture at the top. The reasons in `odd` are updated.

    Raises:
        NoFaceError: no camera shows a face.
    """
    cameras, views = shots.cameras, dict(seen)
    for name, own in found.items():  # read again, as most captures have all plates
        views[name] = make_cut_view(pinhole(cameras[name]), *shots.read(name), own.alpha)
    place = find_head([views[name] for name in cameras if name in views])
    rest: dict[str, CameraMatte] = {}
    for name in odd:
        frame, valid = shots.read(name)
        keyed, odd[name] = shots.matte(name, frame, valid, region_of(views[name], place))
        if keyed is not None:
            rest[name] = keyed
        known = None if keyed is None else keyed.alpha
        views[name] = make_cut_view(pinhole(cameras[name]), frame, valid, known)
    unplated = [name for name in {**seen, **odd} if name not in rest]
    ordered = [views[name] for name in cameras if name in views]
    cuts = cut_out(ordered, ball, place) if unplated else {}
    for name in unplated:
        frame, valid = shots.read(name)
        alpha = soft_alpha(frame, valid, cuts[name], shots.wall(name, frame, valid))
        cut = _camera_matte(alpha, frame, valid)
        rest[name] = replace(cut, plated=False)
    return rest


def completed(
    read: Read, cameras: Mapping[str, Camera], mattes: Mapping[str, CameraMatte], ball: Ball | None
) -> tuple[Mapping[str, CameraMatte], list[MatteView], Agreement]:
    """Add to mattes that were made with plates what they lack because it looks like the wall.

    A camera that lacks a large part of the subject which the others see is cut out as without a
    plate, until none does: with a part added in one, more cameras see what another lacks. Also
    returns what was compared in the end, and the result.
    """
    final, views, place = dict(mattes), dict[str, CutView](), None
    done = {name for name, own in mattes.items() if not own.plated}
    while True:
        seen, found = compared(cameras, final, ball)
        todo = found.lacking - done
        if ball is None or not todo or len(final) < MANY:
            return final, seen, found
        for name, own in final.items():
            known = None if name in todo else own.alpha
            views[name] = make_cut_view(pinhole(cameras[name]), *read(name), known)
        try:
            place = place or find_head(evenly([*views.values()], ENOUGH_VIEWS))
        except NoFaceError:
            return final, seen, found
        cuts = cut_out([*views.values()], ball, place)
        for name in todo:
            alpha = np.rint(255 * soft_alpha(*read(name), cuts[name])).astype(np.uint8)
            final[name] = replace(final[name], alpha=np.maximum(final[name].alpha, alpha))
        done |= todo


def without_others(
    read: Read, cameras: Mapping[str, Camera], found: Mapping[str, CameraMatte],
    doubted: Set[str], thing: bool, ball: Ball,
) -> Mapping[str, CameraMatte]:  # fmt: skip
    """Take other people out of mattes that were made with plates.

    A plate shows what is in front of the wall, not whose it is. If a camera shows another face, or
    a `thing` that is not the subject, the subject is cut out of the cameras that show faces, and of
    the `doubted` ones, whose mattes disagree with others, until no further ones do.
    """
    views = {
        name: make_cut_view(pinhole(cameras[name]), *read(name), own.alpha)
        for name, own in found.items()
    }
    try:
        place = find_head(evenly([*views.values()], ENOUGH_VIEWS))
    except NoFaceError:
        return found
    plated = {name for name, own in found.items() if own.plated}
    others: dict[str, list[HeadPlace]] = {}
    for group in (plated & doubted, plated - doubted):
        others |= {name: find_neighbours(views[name], place) for name in group}
        others = {name: heads for name, heads in others.items() if heads}
        if not others and not thing:  # a camera has moved
            return found
    final, done = dict(found), set[str]()
    while todo := plated & (others.keys() | doubted) - done:
        done |= todo
        for name in todo:
            wall = shrink(found[name].alpha, max(views[name].valid.shape)) < SURE_WALL
            views[name] = replace(views[name], known=None, wall=wall)
        cuts = cut_out([*views.values()], ball, place, others)
        for name in done:
            alpha = _kept(found[name].alpha, soft_alpha(*read(name), cuts[name]))
            if _excess(found[name].alpha, alpha) > LEAST_OTHER:
                final[name] = replace(found[name], alpha=alpha)
        doubted = compared(cameras, final, ball)[1].doubted
    return final


def _kept(alpha: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Keep of an alpha (H, W) uint8 what is the subject's `own` (H, W) float32, as cut out.

    The alpha is better at the wall, so it only changes beside large parts of other people.
    """
    reach = max(1, round(BESIDE * max(alpha.shape)))
    other = opened((alpha > 127) & (own < INSIDE), reach, eroded_about)
    near = ~eroded_about(~other, 2 * reach)
    return np.where(near, np.minimum(alpha, np.rint(255 * own)), alpha).astype(np.uint8)


def _plate(
    dataset: Dataset, subject: str, camera: str, frame: np.ndarray, valid: np.ndarray, method: str,
    person: np.ndarray | None = None,
) -> tuple[MatchedPlate | None, str]:  # fmt: skip
    """Read a plate and match it to the frame; also returns a warning, empty if all is well.

    `person` (h, w) bool, of any size, is where the person may be, if that is known.
    """
    if method not in ("key", "bgmv2"):
        return None, ""
    plate = read_plate_image(dataset, subject, camera)
    if plate is None and method == "bgmv2":
        raise StageError(
            f"no clean plate of {camera}; photograph the empty set as plates/{camera}.png and run"
            " 'express50 ingest' and 'express50 frames' again, or set matte.method to key, grabcut"
            " or salient"
        )
    if plate is None or method == "bgmv2":
        return None if plate is None else MatchedPlate(plate, 1.0, sure=True), ""
    matched = match_plate(plate, frame, valid, person)
    if matched.share >= LEAST_SHARE:
        return matched, ""
    white = {"frame": white_share(frame, valid), "plate": white_share(plate, valid)}
    which = max(white, key=lambda name: white[name])
    if white[which] > MOST_WHITE:
        return None, (
            f"{white[which]:.0%} of its {which}'s top and sides is white: the {which} is"
            " overexposed, so the camera was matted without the plate; record both with the same"
            " exposure, below white"
        )
    compared = "border beside the person" if matched.beside else "top and sides"
    return None, (
        f"its plate explains {matched.share:.0%} of the frame's {compared}, expected"
        f" {LEAST_SHARE:.0%}: it shows another set or place, so the camera was matted without it;"
        " photograph the plate again"
    )


def _matte_function(method: str, weights: str, tile: int, shadow: float) -> MatteFunction:
    """Return the function that mattes one frame; torch is imported for networks only."""
    if method in ("key", "grabcut"):
        return lambda frame, plate, valid: key_alpha(frame, plate, valid, shadow)
    from pipelines.matte.learned import BGMV2, SALIENT, background_alpha, salient_alpha
    from pipelines.networks import load_network as load_weights

    network = load_weights(weights, SALIENT if method == "salient" else BGMV2)
    if method == "salient":
        return lambda frame, plate, valid: salient_alpha(network, frame)
    return lambda frame, plate, valid: background_alpha(
        network, frame, exposed(plate, exposure_gain(frame, plate)), tile
    )


def make_view(
    camera: Camera, ball: Ball, image: np.ndarray, alpha: np.ndarray, side: int = SIDE,
    plate: np.ndarray | None = None,
) -> MatteView:  # fmt: skip
    """Reduce a recorded camera with its undistorted image, alpha and plate, uint8, of any sizes."""
    rgb = shrink(image, side)
    size = rgb.shape[1], rgb.shape[0]
    small = resized(camera, *size)
    share = resize_area(alpha, *size).astype(np.float32) / 255
    behind = None if plate is None else resize_area(plate, *size)
    return MatteView.of(pinhole(small), ball, rgb, share, undistorted_mask(small), behind)


def corrected(
    alpha: np.ndarray, removed: np.ndarray | None, filled: np.ndarray | None
) -> np.ndarray:
    """Clear and fill pixels (h, w) bool of an alpha (H, W) uint8, with soft edges.

    All other pixels keep their exact values.
    """
    if removed is None and filled is None:
        return alpha
    size = (alpha.shape[1], alpha.shape[0])
    out = alpha.astype(np.float32)
    if removed is not None:
        out *= 1 - cv2.resize(removed.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    if filled is not None:
        weight = cv2.resize(filled.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        out = np.maximum(out, 255 * weight)
    return np.rint(out).astype(np.uint8)


def _excess(more: np.ndarray, less: np.ndarray) -> float:
    """Return the share of the image's opacity by which one alpha (H, W) uint8 exceeds another."""
    return round(float(cv2.subtract(more, less).sum()) / 255 / more.size, 6)


def border_contact(alpha: np.ndarray) -> dict[str, float]:
    """Return the share of each side of the image that an alpha (H, W) uint8 covers."""
    lines = alpha[0], alpha[:, -1], alpha[-1], alpha[:, 0]
    return {s: round(float((line > 127).mean()), 4) for s, line in zip(SIDES, lines, strict=True)}


def rim_of(alpha: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) bool about the outline of an alpha (H, W) uint8.

    Of large pictures, every n-th row and column is enough to state an error.
    """
    reach = max(1, round(RIM * max(alpha.shape)))
    step = max(1, reach // RIM_ROWS)
    rim = np.zeros(alpha.shape, bool)
    window = box_about(alpha > 12, reach)
    square = np.ones((step, step), np.uint8)  # or single strands would be left out
    most, least = (way(alpha[window], square)[::step, ::step] for way in (cv2.dilate, cv2.erode))
    near = [dilated(mask, reach / step) for mask in (most > 12, least < 243)]
    rim[window][::step, ::step] = near[0] & near[1]
    return rim


def rim_figures(
    alpha: np.ndarray, rgb: np.ndarray, noise: float, plated: bool, views: int
) -> dict[str, np.ndarray | float]:
    """Return figures of the N rim pixels of an alpha (H, W) uint8 that predict its errors.

    The frame (h, w, 3) uint8 may be reduced; `noise` is that of the full one. If a subject differs
    from the wall by little more than noise, keying may miss parts and leave a ragged outline.
    """
    contrast, side = cv2.resize(outline_contrast(alpha, rgb), alpha.shape[::-1]), max(alpha.shape)
    margin = max(1, round(RIM * side)) + _nearby_side(alpha) + WINDOW  # beyond it all is 0
    window = box_about(alpha, margin)
    rim, share = rim_of(alpha)[window], alpha[window].astype(np.float32) / 255
    open_part = share * (1 - share)
    inside = (share > 0.5).astype(np.uint8)
    edge = inside - cv2.erode(inside, np.ones((3, 3)))
    ragged = cv2.blur(edge.astype(np.float32), (_nearby_side(alpha),) * 2)[rim]
    contrast = contrast[window][rim]
    return {
        "soft": 0.05 + 4 * open_part[rim],
        "spread": 0.01 + np.sqrt(local_moments(share, WINDOW)[1])[rim],
        # Length of the outline nearby, as a multiple of a straight one's.
        "ragged": 0.1 + ragged * _nearby_side(alpha),
        "faint": (0.5 + noise) / (2 + contrast),
        "noise": 0.5 + noise,
        "width": 0.1 + float(open_part.sum()) / max(int(edge.sum()), 1),
        "side": float(side),
        "plated": 1.0 if plated else 2.0,
        "views": float(views),
    }


def wall_noise(alpha: np.ndarray, rgb: np.ndarray) -> float:
    """Measure the noise (8-bit steps) of a frame's wall, (H, W, 3) uint8; inf if no wall shows.

    It is the mean absolute Laplacian, capped where the wall has edges; every fourth row is enough.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    behind = cv2.dilate(alpha, np.ones((5, 5)))[::4] < 3
    grain = np.abs(cv2.Laplacian(grey, cv2.CV_16S)[::4][behind])
    return float(np.minimum(grain, 4 + 4 * np.median(grain)).mean()) if grain.size else np.inf


def outline_contrast(alpha: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Return how far apart (h, w) the mean colours of subject and wall nearby are, 8-bit steps."""
    inside = cv2.resize(alpha, rgb.shape[1::-1], interpolation=cv2.INTER_AREA) / np.float32(255)
    smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), 1)
    one, other = (
        _nearby(smooth * part[..., None]) / (_nearby(part)[..., None] + 1e-3)
        for part in (inside, 1 - inside)
    )
    return np.linalg.norm(one - other, axis=-1)


def _nearby_side(values: np.ndarray) -> int:
    return max(3, 2 * round(NEARBY * max(values.shape[:2]) / 2) + 1)


def _nearby(values: np.ndarray) -> np.ndarray:
    """Average values (H, W[, C]) over the neighbourhood."""
    return cv2.blur(values, (_nearby_side(values), _nearby_side(values)))


def body_sides(cameras: Mapping[str, Camera], alphas: dict[str, np.ndarray]) -> dict[str, str]:
    """Return the side of each camera's image at which the body leaves it.

    That is the bottom, unless cameras lie on their side: from all around, a subject leaves the
    images mostly downwards. A single camera does not show which way that is.
    """
    if len(cameras) < 2:
        return dict.fromkeys(cameras, "bottom")
    ways = {name: OUTWARD @ camera.cam_from_world[:3, :3] for name, camera in cameras.items()}
    weights = [[*border_contact(alphas[name]).values()] + UPRIGHT for name in cameras]
    down = np.einsum("cs,csd->d", weights, [*ways.values()])
    return {name: SIDES[int(np.argmax(outward @ down))] for name, outward in ways.items()}


def matte_warnings(alphas: dict[str, np.ndarray], body: Mapping[str, str]) -> list[Note]:
    """Warn of cameras whose matte is empty, or whose subject's upper half is cut off.

    `body` names the side at which the body may leave a camera's image. Shoulders may leave it
    beside that.
    """
    notes = []
    for name, alpha in alphas.items():
        share = float(alpha.mean()) / 255
        if share < EMPTY:
            notes.append(Note(name, f"its matte is empty ({share:.2%} of the image)"))
            continue
        turns = SIDES.index(body[name]) - SIDES.index("bottom")
        upright = np.rot90(alpha, turns)
        top = int(np.argmax((upright > 127).any(axis=1)))
        head = np.where(np.arange(len(upright))[:, None] <= (top + len(upright)) // 2, upright, 0)
        contact = np.roll([*border_contact(head).values()], turns)
        cut = [side for side, share in zip(SIDES, contact, strict=True) if share > MOST_CONTACT]
        if cut:
            several = [", ".join(cut[:-1]), cut[-1]] if len(cut) > 1 else cut
            sides, whole = " and ".join(several), border_contact(alpha)
            most = max(whole[side] for side in cut)
            notes.append(Note(name, f"the subject leaves the image at the {sides} ({most:.0%})"))
    return notes


def _write_picture(out: Path, mattes: Mapping[str, CameraMatte], found: Agreement) -> None:
    """Draw every camera's subject: removed pixels are red, filled pixels are green."""
    odd = {note.what for note in found.warnings}
    tiles = {}
    for name, matte in mattes.items():
        opaque = shrink(matte.alpha, SHOWN) > 255 * INSIDE
        tile = np.where(opaque[..., None], matte.rgb, matte.rgb // 3)
        for masks, colour in ((found.removed, RED), (found.filled, GREEN)):
            if name in masks:
                mask = cv2.resize(masks[name].astype(np.uint8), tile.shape[1::-1]) > 0
                tile[mask] = (0.3 * tile[mask] + 0.7 * np.array(colour)).astype(np.uint8)
        tiles[name + ("?" if name in odd else "")] = tile
    (out / "qc").mkdir()
    write_image(out / "qc" / "agreement.jpg", tile_sheet(tiles, COLUMNS, TILE), quality=88)
