"""Read the ChArUco board: its description in `board.toml`, and its corners in images.

Corner positions leave this file in the project's pixels (origin at the corner of the first pixel);
OpenCV counts from that pixel's centre. Corners are refined to the saddle point of a fitted surface
(Lucchese and Mitra 2002), which misses by 0.03 px. OpenCV's gradient-based refinement misses by
0.1 px on small squares, whose other edges come into its window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from express50.capture.index import Index
from express50.capture.raw import VIDEO_SUFFIXES, is_shown
from express50.errors import CalibrationError
from express50.files.containers import read_picture
from express50.files.images import upright
from express50.files.text import refusing
from express50.files.video import VideoReader, frame_times
from express50.geometry.conventions import mirror_opencv_pixels, opencv_pixels_to_corner
from express50.geometry.sampling import evenly

REQUIRED = ("squares_x", "squares_y", "square_length_m", "marker_length_m", "dictionary")
ENOUGH = 4  # corners that show an image's reading direction


@dataclass(frozen=True)
class Board:
    """A flat ChArUco board; `legacy_pattern` is the layout OpenCV printed before version 4.6."""

    squares_x: int
    squares_y: int
    square_length_m: float
    marker_length_m: float
    dictionary: str
    legacy_pattern: bool = False


@dataclass(frozen=True)
class BoardCorners:
    """Board corners found in images, one row each."""

    cameras: tuple[str, ...]
    frames: tuple[str, ...]
    camera: np.ndarray  # (N,) index of `cameras`
    frame: np.ndarray  # (N,) index of `frames`
    corner: np.ndarray  # (N,) id on the board
    pixels: np.ndarray

    def select(self, keep: np.ndarray) -> BoardCorners:
        """Keep the rows where `keep` (N,) is true, with the same camera and frame numbers."""
        columns = (self.camera, self.frame, self.corner, self.pixels)
        return BoardCorners(self.cameras, self.frames, *(column[keep] for column in columns))


def board_from_table(table: Mapping[str, object], where: str) -> Board:
    """Build the board that a parsed `board.toml` describes; `where` names the file in errors."""
    missing = [key for key in REQUIRED if key not in table]
    if missing:
        raise CalibrationError(
            f"{where}: {', '.join(missing)} is missing; board.toml needs {', '.join(REQUIRED)}"
        )
    fix = "counts are integers, lengths metres"
    with refusing(CalibrationError, f"{where}: a value has the wrong kind", fix):
        board = Board(
            squares_x=int(table["squares_x"]),  # type: ignore[call-overload]
            squares_y=int(table["squares_y"]),  # type: ignore[call-overload]
            square_length_m=float(table["square_length_m"]),  # type: ignore[arg-type]
            marker_length_m=float(table["marker_length_m"]),  # type: ignore[arg-type]
            dictionary=str(table["dictionary"]),
            legacy_pattern=bool(table.get("legacy_pattern", False)),
        )
    if problem := _problem(board):
        raise CalibrationError(f"{where}: {problem}")
    return board


def _problem(board: Board) -> str:
    """Say why no such board can be printed; empty if one can."""
    x, y, marker, square = (
        board.squares_x, board.squares_y, board.marker_length_m, board.square_length_m
    )  # fmt: skip
    if min(x, y) < 3:
        return f"squares are {x} x {y}, expected at least 3 x 3"
    if not 0 < marker < square < math.inf:
        return (
            f"marker_length_m {marker} and square_length_m {square}: expected 0 < marker < square;"
            " measure the print and write both in metres"
        )
    if not isinstance(getattr(cv2.aruco, board.dictionary, None), int):
        return f"dictionary is {board.dictionary!r}; expected a name of OpenCV's: DICT_4X4_50, ..."
    count = len(_dictionary(board).bytesList)
    if count < x * y // 2:
        return (
            f"a {x} x {y} board needs {x * y // 2} markers, but {board.dictionary} has {count};"
            " name the dictionary it was printed with"
        )
    return ""


def _dictionary(board: Board) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))


def opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's object for this board (it draws, detects and lists corners)."""
    made = cv2.aruco.CharucoBoard(
        (board.squares_x, board.squares_y), board.square_length_m, board.marker_length_m,
        _dictionary(board),
    )  # fmt: skip
    made.setLegacyPattern(board.legacy_pattern)
    return made


def board_points(board: Board) -> np.ndarray:
    """Return the inner corners (N, 3) in the board's space: metres, x right, y down, z into it.

    Row `i` is corner `i` of OpenCV's detector, row by row from the print's top left.
    """
    across, down = board.squares_x - 1, board.squares_y - 1
    ids = np.arange(across * down)
    columns, rows = ids % across + 1, ids // across + 1
    return np.column_stack([columns, rows, np.zeros_like(ids)]) * board.square_length_m


def detect_corners(
    image: np.ndarray, detector: cv2.aruco.CharucoDetector, board: Board
) -> tuple[np.ndarray, np.ndarray]:
    """Find the board's corners in an image (H, W, 3) uint8: ids (N,), pixels (N, 2).

    White-on-black prints are found in the negative, mirrored images and the back of a board that
    is printed on both sides in the mirror. There the corners run round the board the other way.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    ids, corners = np.zeros(0, int), np.zeros((0, 2))
    for negative, mirrored in product((False, True), repeat=2):
        look = 255 - grey if negative else grey
        look = cv2.flip(look, 1) if mirrored else look
        at, found, _, _ = detector.detectBoard(look)
        if found is not None and len(found) > len(ids):
            ids, corners = np.asarray(found, int).reshape(-1), np.asarray(at, float).reshape(-1, 2)
            if mirrored:
                corners = mirror_opencv_pixels(corners, grey.shape[1])
        if len(ids) >= ENOUGH:
            break
    if len(ids) == 0:
        return ids, corners
    sides = square_sides(board_points(board)[ids, :2], corners, board.square_length_m)
    refined, found = refine_corners(grey, corners, sides)
    return ids[found], opencv_pixels_to_corner(refined[found])


def refine_corners(
    grey: np.ndarray, pixels: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refine corners (N, 2), OpenCV's pixels, in a grey image (H, W) uint8.

    `sides` (N,) are the shorter sides, pixels, of the squares at each corner. Returns the refined
    positions, and a mask (N,) of those that found a saddle close by.
    """
    refined, found = pixels.astype(np.float64).copy(), np.zeros(len(pixels), bool)
    blurred: dict[float, np.ndarray] = {}
    for i, (start, side) in enumerate(zip(pixels, sides, strict=True)):
        # Discs with a radius of 0.15 of a square's shorter side measured best.
        radius = int(np.clip(round(0.15 * side), 2, 25))
        sigma = round(max(0.7, radius / 5), 1)
        if sigma not in blurred:
            blurred[sigma] = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma)
        at = _saddle(blurred[sigma], start, radius)
        if at is not None:
            refined[i], found[i] = at, True
    return refined, found


def _saddle(image: np.ndarray, start: np.ndarray, radius: int) -> np.ndarray | None:
    """Walk to the saddle (2,) near a start; None if there is none or the walk diverges."""
    # Fit a x^2 + b x y + c y^2 + d x + e y + f on a disc of M pixels: its inverse is (6, M).
    x, y = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1))
    inside = (x**2 + y**2 <= (radius + 0.5) ** 2).ravel()
    x, y = x.ravel()[inside].astype(float), y.ravel()[inside].astype(float)
    # Weights fall towards the rim, so that pixels enter and leave the fit smoothly.
    weight = np.exp(-(x**2 + y**2) / (2 * (radius / 1.6) ** 2))
    terms = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
    inverse = np.linalg.pinv(terms * np.sqrt(weight)[:, None]) * np.sqrt(weight)
    side = 2 * radius + 1
    at = start.astype(np.float64)
    for _ in range(6):
        patch = cv2.getRectSubPix(image, (side, side), (float(at[0]), float(at[1])))
        a, b, c, d, e, _ = inverse @ patch.ravel()[inside]
        determinant = 4 * a * c - b * b
        if determinant >= -1e-9:  # a hill, a valley or flat
            return None
        step = np.array([b * e - 2 * c * d, b * d - 2 * a * e]) / determinant
        at = at + step
        if np.abs(at - start).max() > max(1.5, radius):
            return None
        if np.abs(step).max() < 1e-3:
            return at
    return at if np.abs(step).max() < 0.05 else None


def square_sides(board_xy: np.ndarray, pixels: np.ndarray, square: float) -> np.ndarray:
    """Measure the shorter side (N,), pixels, of the squares at corners (N, 2) seen at (N, 2)."""
    homography = cv2.findHomography(board_xy, pixels, 0)[0] if len(board_xy) >= 4 else None
    if homography is None:
        return np.zeros(len(board_xy))

    def mapped(xy: np.ndarray) -> np.ndarray:
        return cv2.perspectiveTransform(xy[None].astype(np.float64), homography)[0]

    here = mapped(board_xy)
    across = np.linalg.norm(mapped(board_xy + [square, 0.0]) - here, axis=1)
    down = np.linalg.norm(mapped(board_xy + [0.0, square]) - here, axis=1)
    return np.minimum(across, down)


def make_detector(board: Board) -> cv2.aruco.CharucoDetector:
    """Return a detector for the board with sub-pixel marker corners."""
    parameters = cv2.aruco.DetectorParameters()
    # The chessboard corners between the markers carry the measurement; a marker's own corners are
    # only refined enough to predict those.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.CharucoDetector(opencv_board(board), cv2.aruco.CharucoParameters(), parameters)


def gather(
    found: Iterable[tuple[str, str, np.ndarray, np.ndarray]], cameras: Iterable[str]
) -> BoardCorners:
    """Stack (camera, frame, ids (N,), pixels (N, 2)) detections into one table."""
    names = tuple(sorted(cameras))
    rows = list(found)
    frames = tuple(sorted({frame for _, frame, _, _ in rows}))
    camera_of, frame_of = ({n: i for i, n in enumerate(group)} for group in (names, frames))
    camera = [np.full(len(ids), camera_of[name]) for name, _, ids, _ in rows]
    frame = [np.full(len(ids), frame_of[name]) for _, name, ids, _ in rows]
    empty = [np.zeros(0, int)]
    return BoardCorners(
        names,
        frames,
        np.concatenate(camera + empty),
        np.concatenate(frame + empty),
        np.concatenate([ids for _, _, ids, _ in rows] + empty),
        np.concatenate([pixels for _, _, _, pixels in rows] + [np.zeros((0, 2))]),
    )


@dataclass(frozen=True)
class BoardFootage:
    """One camera's pictures of the board: image files, or the frames of a video, by name."""

    pictures: Mapping[str, Path]
    times: tuple[int, ...] = ()  # the video's time stamps, none for images
    orientation: int = 1  # how its frames lie

    def read(self, names: Sequence[str]) -> Iterator[tuple[str, Path, np.ndarray]]:
        """Yield name, file and image (H, W, 3) uint8 of the pictures that there are, in order."""
        known = [name for name in names if name in self.pictures]
        if self.times and known:
            path = self.pictures[known[0]]
            with closing(VideoReader(path, self.times)) as video:
                for name in known:
                    yield name, path, upright(video.read(int(name)), self.orientation)
            return
        for name in known:
            path = self.pictures[name].resolve()  # it may be a link to elsewhere
            yield name, self.pictures[name], read_picture(path.parent, path.name)


def board_footage(files: Sequence[Path], orientation: int = 1) -> BoardFootage:
    """Name a camera's pictures of the board: image files by stem, a video's frames by number.

    Raises:
        CaptureError: the video cannot be read.
    """
    if len(files) == 1 and is_shown(files[0], VIDEO_SUFFIXES):
        times = frame_times(files[0])
        pictures = {f"{number:06d}": files[0] for number in range(len(times))}
        return BoardFootage(pictures, times, orientation)
    return BoardFootage({path.stem: path for path in files})


def footage_of_board(index: Index) -> dict[str, BoardFootage]:
    """Return each camera's pictures of the board; none of a camera that has no file."""
    files = index.board["cameras"] if index.board else {}
    return {
        name: board_footage([index.capture / file for file in files.get(name, [])], one.orientation)
        for name, one in index.cameras.items()
    }


def read_corners(
    board: Board,
    footage: Mapping[str, BoardFootage],
    sizes: Mapping[str, tuple[int, int]],
    limit: int,
    look: Callable[[str, str, np.ndarray, np.ndarray, np.ndarray], None] | None = None,
) -> BoardCorners:
    """Detect the board in each camera's `footage`; pictures of one name were taken at one time.

    At most `limit` pictures are read per camera, evenly spaced over all names (0 = all); `sizes`
    are the footage's (width, height). `look` gets camera, name, image, ids and pixels of each.
    """
    names = sorted(set().union(*(one.pictures for one in footage.values())))
    names = evenly(names, limit or len(names))
    detector = make_detector(board)
    found = []
    for camera, one in sorted(footage.items()):
        for name, path, image in one.read(names):
            if (image.shape[1], image.shape[0]) != tuple(sizes[camera]):
                raise CalibrationError(
                    f"{path}: image is {image.shape[1]}x{image.shape[0]}, the footage "
                    f"of {camera} is {sizes[camera][0]}x{sizes[camera][1]}; record the board "
                    "with the settings of the capture"
                )
            ids, pixels = detect_corners(image, detector, board)
            found.append((camera, name, ids, pixels))
            if look is not None:
                look(camera, name, image, ids, pixels)
    return gather(found, footage)
