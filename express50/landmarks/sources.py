"""Open a source of landmarks: the embedded network, the user's FAN weights, or a file.

FAN is the face alignment network (Bulat and Tzimiropoulos 2017). Its published weights are
TorchScript files (2DFAN4, 3DFAN4) that map crops (B, 3, 256, 256) in [0, 1] to heat maps (B, 68,
64, 64). The embedded network finds the face, FAN its points; nothing is downloaded.

A source is called with an image, its camera's id and its frame. It returns a `Marked` face: its
`Detection`, its irises, and which convention its jaw line follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from express50.errors import ConfigError, FormatError
from express50.files.arrays import DAMAGE, read_arrays
from express50.files.text import no_file, read_json, refusing
from express50.geometry.cameras import Camera, normalised
from express50.geometry.conventions import cell_to_corner
from express50.geometry.transforms import scale_of, transform_points
from express50.landmarks import source_files
from express50.landmarks.detector import SMALLEST, Detection, cut_crop, detect, place_crop
from express50.landmarks.irises import Irises, find_irises
from express50.landmarks.network import load_network

SCHEMA = "express50.landmarks/1"
NAMES = ("schema", "cameras", "frames", "points")
POINTS, IRISES = 68, 2
OUTSIDE = 0.5  # share of the image's size that points may lie outside it, as a chin may
UNSURE = 1e-9  # least confidence assumed, so that sigma is finite


@dataclass(frozen=True)
class Marked:
    """A face in an image."""

    face: Detection
    irises: Irises
    visible_contour: bool  # points 0..16 follow the visible edge of the jaw


Source = Callable[[np.ndarray, str, int], Marked]


def _existing_files(landmarks: str) -> dict[str, Path]:
    files = source_files(landmarks)
    for path in files.values():
        if not path.is_file():
            raise ConfigError(
                f"landmarks {landmarks!r}: {no_file(path)}; expected 'embedded', 'fan:' and the "
                "path of FAN's TorchScript weights, or the path of a file of points"
            )
    return files


def try_source(landmarks: str) -> None:
    """Read a source's files as far as possible without cameras; raise as `open_source` does."""
    files = _existing_files(landmarks)
    if "landmarks" in files:
        _read_raw(files["landmarks"])
    elif "fan" in files:
        load_fan(files["fan"])


def open_source(
    landmarks: str,
    cameras: Mapping[str, Camera],
    refinements: int = 3,
    smallest: float = SMALLEST,
    pictures: Mapping[str, Camera] | None = None,
) -> Source:
    """Return a source that is ready to be called.

    `landmarks` are `embedded`, `fan:PATH` (TorchScript weights) or the path of a file of points
    (.npz or .json, see docs/FORMAT.md), which are undistorted with the `cameras`, as recorded.
    `refinements` and `smallest` are those of `detect`. `pictures` are the pinhole cameras of the
    images; by default they have the recorded size.

    Raises:
        ConfigError: the file is missing, or is not of the expected kind.
        FormatError: the file of points is malformed.
    """
    files = _existing_files(landmarks)
    if "landmarks" in files:
        table = read_points(files["landmarks"], cameras, pictures)

        def look_up(image: np.ndarray, camera_id: str, frame: int) -> Marked:
            rows = table.get((camera_id, frame))
            if rows is None:  # a face of score 0
                middle = np.array([image.shape[1], image.shape[0]]) / 2
                unsure = np.full(POINTS, np.inf), np.zeros(POINTS)
                face = Detection(np.tile(middle, (POINTS, 1)), *unsure, 0.0)
                irises = Irises(np.tile(middle, (2, 1)), np.full(2, np.inf), np.zeros(2))
                return Marked(face, irises, visible_contour=True)
            face = given_detection(rows[:POINTS])
            irises = given_irises(rows, face) if len(rows) > POINTS else find_irises(image, face)
            return Marked(face, irises, visible_contour=True)

        return look_up
    net = load_network()
    fan = load_fan(files["fan"]) if "fan" in files else None

    def find(image: np.ndarray, camera_id: str, frame: int) -> Marked:
        face = detect(net, image, refinements, smallest)
        face = face if fan is None else find_with_fan(fan, image, face)
        return Marked(face, find_irises(image, face), visible_contour=fan is not None)

    return find


def given_detection(rows: np.ndarray) -> Detection:
    """Make a detection from rows (68, 3): pixels x, y, NaN where unknown, and confidence 0..1.

    Unknown points are put at the mean of the known ones, with an infinite sigma. The sigma of a
    point of confidence c is 0.6 % of the face's size over c.
    """
    known = np.isfinite(rows[:, :2]).all(1) & (rows[:, 2] > 0)
    if not known.any():
        return Detection(np.zeros((POINTS, 2)), np.full(POINTS, np.inf), np.zeros(POINTS), 0.0)
    points = np.where(known[:, None], rows[:, :2], rows[known, :2].mean(0))
    confidence = np.where(known, rows[:, 2], 0.0)
    size = max(float(np.ptp(rows[known, :2], axis=0).max()), 1.0)
    sigma = np.where(known, 0.006 * size / np.maximum(confidence, UNSURE), np.inf)
    return Detection(points, sigma, confidence, float(confidence[known].mean()))


def given_irises(rows: np.ndarray, face: Detection) -> Irises:
    """Make irises from the last of given points (70, 3): the subject's left one, then the right."""
    found = rows[POINTS : POINTS + IRISES]
    known = np.isfinite(found[:, :2]).all(1) & (found[:, 2] > 0)
    width = [np.linalg.norm(face.points[a] - face.points[b]) for a, b in ((45, 42), (39, 36))]
    confidence = np.where(known, found[:, 2], 0.0)
    sigma = np.where(known, 0.03 * np.array(width) / np.maximum(confidence, UNSURE), np.inf)
    centres = np.where(known[:, None], found[:, :2], face.points[[42, 36]])
    return Irises(centres, np.where(sigma > 0, sigma, np.inf), confidence)


Table = dict[tuple[str, int], np.ndarray]


def read_points(
    path: Path, cameras: Mapping[str, Camera], pictures: Mapping[str, Camera] | None = None
) -> Table:
    """Read points from an .npz or .json by camera and frame, undistorted.

    `cameras` are as recorded; others of the file are left out. `pictures` are the pinhole cameras
    of the undistorted images; by default they have the recorded size. Rows (68 or 70, 3) are x, y
    in pixels of the undistorted image, NaN where a point is unknown, and confidence 0..1.

    Raises:
        FormatError: another format, shape, an infinite number, a confidence out of range, or points
            far outside the image.
    """
    path = Path(path)
    raw = _read_raw(path)
    if not any(camera_id in cameras for camera_id, _ in raw):
        names = sorted({camera_id for camera_id, _ in raw})
        raise FormatError(
            f"{path}: holds landmarks of cameras {', '.join(names[:6]) or 'none'}; expected some"
            f" of {', '.join(list(cameras)[:6])}"
        )
    table = {}
    for key, read in raw.items():
        if key[0] in cameras:
            camera = cameras[key[0]]
            rows = _checked(read, camera, path, key).copy()
            K = (pictures or cameras)[key[0]].K
            focal, middle = K[[0, 1], [0, 1]], K[:2, 2]
            rows[:, :2] = normalised(camera, rows[:, :2]) * focal + middle
            rows[~np.isfinite(rows[:, :2]).all(1)] = (np.nan, np.nan, 0.0)
            table[key] = rows
    return table


def _read_raw(path: Path) -> Table:
    fix = "expected the layout of docs/FORMAT.md"
    with refusing(FormatError, f"{path}: not a file of landmarks", fix):
        if path.suffix.lower() == ".npz":
            return _read_npz(path)
        content = read_json(path, FormatError)
        if content.get("schema") != SCHEMA:
            raise ValueError(f"schema is {content.get('schema')!r}, expected {SCHEMA!r}")
        table: Table = {}
        for camera_id, frames in content["cameras"].items():
            for frame, points in frames.items():
                rows = [[np.nan, np.nan, 0.0] if p is None else [*p, 1.0][:3] for p in points]
                table[camera_id, int(frame)] = np.array(rows, dtype=np.float64)
        return table


def _read_npz(path: Path) -> Table:
    data = read_arrays(path, FormatError, "a file of landmarks", NAMES)
    if str(data["schema"]) != SCHEMA:
        raise ValueError(f"schema is {data['schema']}, expected {SCHEMA}")
    cameras, frames = [str(name) for name in data["cameras"]], data["frames"].tolist()
    points = np.asarray(data["points"], dtype=np.float64)
    shape = (len(cameras), len(frames), points.shape[2] if points.ndim == 4 else POINTS, 2)
    if points.shape != shape:
        raise ValueError(f"points have shape {points.shape}, expected {shape}")
    sure = np.isfinite(points).all(-1).astype(np.float64)
    confidence = np.asarray(data.get("confidence", sure), dtype=np.float64)
    if confidence.shape != shape[:3]:
        raise ValueError(f"confidence has shape {confidence.shape}, expected {shape[:3]}")
    rows = np.concatenate([points, np.asarray(confidence)[..., None]], axis=-1)
    return {(c, int(f)): rows[i, j] for i, c in enumerate(cameras) for j, f in enumerate(frames)}


def _checked(rows: np.ndarray, camera: Camera, path: Path, key: tuple[str, int]) -> np.ndarray:
    """Return the rows, or raise FormatError if they are not usable."""
    where = f"{path}: camera {key[0]}, frame {key[1]}"
    if rows.ndim != 2 or rows.shape[0] not in (POINTS, POINTS + IRISES) or rows.shape[1] != 3:
        raise FormatError(
            f"{where}: points have shape {rows.shape}, expected {POINTS} or {POINTS + IRISES} "
            "of x, y, confidence"
        )
    known = np.isfinite(rows[:, :2]).all(1)
    if np.isinf(rows).any() or not np.isfinite(rows[known, 2]).all():
        raise FormatError(
            f"{where}: a value is infinite, or a known point has no confidence; write NaN (null in "
            "JSON) for an unknown point"
        )
    if ((rows[known, 2] < 0) | (rows[known, 2] > 1)).any():
        raise FormatError(f"{where}: confidence is out of range, expected 0 to 1")
    size = np.array([camera.width, camera.height])
    far = (rows[known, :2] < -OUTSIDE * size) | (rows[known, :2] > (1 + OUTSIDE) * size)
    if far.any():
        worst = rows[known, :2][far.any(1)][0]
        raise FormatError(
            f"{where}: a point is at {worst[0]:.0f}, {worst[1]:.0f} of a {camera.width}x"
            f"{camera.height} image; expected pixels of the footage as recorded"
        )
    return rows


FAN_CROP, HEAT = 256, 64
# FAN's crop spans 200 / 195 times the sum of the sides of a box that reaches from above the brows
# (by BROW of the points' height) to the chin, about a centre RAISE of the box's height higher.
SPAN, RAISE, BROW = 200.0 / 195.0, 0.12, 0.12
REACH = 3  # cells around a heat map's peak that give its place


def load_fan(path: Path) -> torch.jit.ScriptModule:
    """Read TorchScript weights; ConfigError unless they map crops to heat maps."""
    wanted = f"expected FAN's TorchScript weights, (1, 3, {FAN_CROP}, {FAN_CROP}) to 68 heat maps"
    try:
        fan = torch.jit.load(str(path), map_location="cpu").eval()
        with torch.inference_mode():
            output = _heat(fan, torch.zeros(1, 3, FAN_CROP, FAN_CROP))
    except (*DAMAGE, torch.jit.Error) as error:
        # PyTorch's message is a page long and guesses what happened to the file.
        raise ConfigError(f"landmarks: {path} cannot be loaded or called; {wanted}") from error
    if tuple(output.shape) != (1, POINTS, HEAT, HEAT):
        raise ConfigError(f"landmarks: {path} gives {tuple(output.shape)}; {wanted}")
    return fan


def find_with_fan(fan: torch.jit.ScriptModule, image: np.ndarray, face: Detection) -> Detection:
    """Find the points of a detected face with FAN; the face keeps its score.

    A point's confidence is its heat map's peak times the score; sigma comes from the peak's spread.
    The image is (H, W, 3) uint8 RGB.
    """
    window = fan_window(face.points)
    crop = cut_crop(image, window, FAN_CROP)
    with torch.inference_mode():
        batch = torch.from_numpy(crop).permute(2, 0, 1)[None].float() / 255.0
        heat = _heat(fan, batch)[0].double().numpy()
    if not np.isfinite(heat).all():
        raise ConfigError("landmarks: FAN's weights give NaN or infinite heat maps; use others")
    found = []  # of each map's peak: place (2,) and spread in cells, corner origin, and height
    for one in heat:
        row, column = np.unravel_index(int(np.argmax(one)), one.shape)
        rows = slice(max(row - REACH, 0), row + REACH + 1)
        columns = slice(max(column - REACH, 0), column + REACH + 1)
        share = np.clip(one[rows, columns], 0.0, None)
        total = max(float(share.sum()), 1e-12)
        y, x = cell_to_corner(np.mgrid[rows, columns][:, : share.shape[0], : share.shape[1]])
        place = np.array([(share * x).sum(), (share * y).sum()]) / total
        variance = float((share * ((x - place[0]) ** 2 + (y - place[1]) ** 2)).sum()) / total
        found.append((place, (0.5 * variance) ** 0.5, float(one[row, column])))
    cells, spread, height = (np.array(part) for part in zip(*found, strict=True))
    step = FAN_CROP / HEAT
    points = transform_points(window, cells * step)
    scale = scale_of(window)
    confidence = np.clip(height, 0.0, 1.0)
    sigma = np.maximum(spread, 0.5) * step * scale / np.maximum(confidence, 0.05)
    return replace(face, points=points, sigma=sigma, confidence=face.score * confidence)


def fan_window(points: np.ndarray) -> np.ndarray:
    """Place an upright crop around landmarks (68, 2): affine (2, 3) from crop to image pixels."""
    low, high = points.min(0), points.max(0)
    low = low - [0.0, BROW * (high[1] - low[1])]
    centre = 0.5 * (low + high) - [0.0, RAISE * (high[1] - low[1])]
    scale = SPAN * max(float((high - low).sum()), 8.0) / FAN_CROP
    return place_crop(centre, scale * np.eye(2), FAN_CROP)


def _heat(fan: torch.jit.ScriptModule, batch: torch.Tensor) -> torch.Tensor:
    """Run FAN; a stack of hourglasses returns a list, whose last heat maps count."""
    output = fan(batch)
    return output[-1] if isinstance(output, list | tuple) else output
