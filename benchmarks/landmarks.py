"""Measure the landmark detector: on photographs of people, on rendered heads, and its cost.

``python -m benchmarks.landmarks``. `real` needs ``--real DIR``: photographs with 68 points per face
in dlib's XML (``*.xml``), cropped to 1.3 times the points' larger side about their mean before
detecting; errors are mean distances over the root of the area of the points' box, in percent. The
points that count are those of the published mark-up, the outline in place of the jaw's landmarks.
`inner` leaves the outline out.

`rendered` shows heads that training never saw, of the built-in model and of that of ``--ict``, in
percent of the square root of the area of the landmarks' box: landmarks and outline, by the head's
turn, and how far errors are from the stated scale (1.0: a Laplace distribution of that scale has
such a mean). `seconds_per_view` is processor time of one core for views of 512 px. `before` has the
same figures for the weights of ``--before``. The last line printed is one JSON object.
"""

from __future__ import annotations

import json
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.common import make_parser
from express50.files.images import write_image
from express50.geometry.pixels import contact_sheet
from express50.head.load import load_head
from express50.landmarks import WEIGHTS
from express50.landmarks.detector import detect, detect_many
from express50.landmarks.network import OUTLINE, POINTS, LandmarkNet, load_network
from express50.landmarks.training.random_heads import random_head
from express50.landmarks.training.scene import HeadScene, TrainingView
from express50.landmarks.training.views import make_backgrounds

CONTEXT, PIXEL = 1.3, 0.5  # dlib counts from the middle of the first pixel
SEED = 20261125
GROUPS = {
    "jaw": slice(0, 17), "brows": slice(17, 27), "nose": slice(27, 36), "eyes": slice(36, 48),
    "mouth": slice(48, 68), "inner": slice(17, 68),
}  # fmt: skip
TURNS = {"front": (0, 25), "turned": (25, 60), "profile": (60, 95)}  # degrees
VIEW, HEAD = 512, 320  # pixels of a view and of the head in it


@dataclass(frozen=True)
class Frame:
    """A picture with true points (68 or 68 + 17, 2); the head's turn in degrees, if known."""

    image: np.ndarray
    points: np.ndarray
    turn: float = 0.0


def main(arguments: list[str] | None = None) -> int:
    """Print the errors of the shipped weights, and of others beside them."""
    parser = make_parser("landmarks", __doc__)
    parser.add_argument("--real", type=Path, help="folder of photographs with dlib's XML")
    parser.add_argument("--ict", help="ICT-FaceKit checkout or .npz, rendered as well")
    parser.add_argument("--before", type=Path, help="other weights, measured beside the shipped")
    parser.add_argument("--heads", type=int, default=30, help="of each model; a view per turn")
    parser.add_argument("--sheet", type=Path, help="picture of the faces with the points over them")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    real = list(read_faces(options.real)) if options.real else []
    rendered = {spec: draw(spec, options.heads) for spec in ("procedural", options.ict) if spec}
    result = {"benchmark": "landmarks"} | measure(load_network(WEIGHTS), real, rendered)
    result["before"] = "n/a: --before names no weights"
    if options.before:
        result["before"] = measure(load_network(options.before), real, rendered)
    if options.sheet:
        write_sheet(options.sheet, load_network(WEIGHTS), real)
    print(json.dumps(result))
    return 0


def measure(net: LandmarkNet, real: list[Frame], rendered: dict[str, list[Frame]]) -> dict:
    """Return all figures of a network."""
    result = {"real": on_real(net, real) if real else "n/a: --real names no folder"}
    for spec, frames in rendered.items():
        result["ict" if spec != "procedural" else spec] = on_rendered(net, frames)
    front = [frame.image for frame in rendered["procedural"] if frame.turn < TURNS["turned"][1]]
    return result | seconds(net, front)


def read_faces(folder: Path) -> Iterator[Frame]:
    """Yield the faces of a folder, cropped; pixels are counted from their corner."""
    for file in sorted(folder.glob("*.xml")):
        for entry in ElementTree.parse(file).getroot().iter("image"):
            picture = cv2.imread(str(folder / str(entry.get("file"))))
            if picture is None:
                raise SystemExit(f"{file}: no picture {entry.get('file')} beside it")
            for box in entry.iter("box"):
                parts = {str(part.get("name")): part for part in box.iter("part")}
                rows = [parts[name] for name in sorted(parts, key=int)]
                points = np.array([[float(row.get(axis, "")) for axis in "xy"] for row in rows])
                if len(points) == 68:
                    yield _cropped(picture[..., ::-1], points + PIXEL)


def _cropped(picture: np.ndarray, points: np.ndarray) -> Frame:
    half, middle = CONTEXT / 2 * np.ptp(points, axis=0).max(), points.mean(0)
    low = np.maximum(np.round(middle - half).astype(int), 0)
    high = np.round(middle + half).astype(int)
    part = picture[low[1] : high[1], low[0] : high[0]]
    return Frame(np.ascontiguousarray(part), points - low)


def shares(found: np.ndarray, frame: Frame, first: int = 0) -> np.ndarray:
    """Return distances (N,) from the true points from `first` on, in percent of the face."""
    true = frame.points[first : first + len(found)]
    return 100 * np.linalg.norm(found - true, axis=1) / size_of(frame)


def size_of(frame: Frame) -> float:
    """Return the root of the area of the landmarks' box, pixels."""
    return float(np.sqrt(np.prod(np.ptp(frame.points[:68], axis=0))))


def on_real(net: LandmarkNet, frames: list[Frame]) -> dict:
    """Return the errors on photographs: of all points, and by group."""
    errors, scores = [], []
    for frame in frames:
        face = detect(net, frame.image)
        errors.append(shares(face.marks(), frame))
        scores.append(face.score)
    table = np.stack(errors)
    return {
        "faces": len(table),
        "nme_percent": round(float(table.mean()), 2),
        "median_percent": round(float(np.median(table.mean(1))), 2),
        **{name: round(float(table[:, part].mean()), 2) for name, part in GROUPS.items()},
        "found": round(float(np.mean(np.array(scores) > 0.5)), 3),
    }


def draw(spec: str, heads: int) -> list[Frame]:
    """Draw frames of random heads of a model before random backgrounds, from all sides in turn."""
    model, rng = load_head(spec), np.random.default_rng([SEED, *spec.encode()[:1]])
    backgrounds = make_backgrounds(20, rng)
    frames = []
    for _ in range(heads):
        scene = HeadScene(model, random_head(model, rng))
        for low, high in TURNS.values():
            yaw = float(rng.uniform(low, high) * rng.choice([-1, 1]))
            view = scene.render(rng, HEAD, np.radians(yaw))
            frames.append(_framed(view, backgrounds[rng.integers(len(backgrounds))], yaw, rng))
    return frames


def _framed(
    view: TrainingView, background: np.ndarray, yaw: float, rng: np.random.Generator
) -> Frame:
    image = cv2.resize(background, (VIEW, VIEW), interpolation=cv2.INTER_CUBIC)
    x, y = rng.integers(0, VIEW - HEAD, 2)
    part = image[y : y + HEAD, x : x + HEAD]
    alpha = view.rgba[..., 3:] / 255.0
    part[:] = (part * (1 - alpha) + view.rgba[..., :3] * alpha).astype(np.uint8)
    return Frame(image, view.points.astype(np.float64) + [x, y], abs(yaw))


def on_rendered(net: LandmarkNet, frames: list[Frame]) -> dict:
    """Return the errors of every kind of point by the head's turn, and how true its scales are."""
    result: dict = {}
    for name, (low, high) in TURNS.items():
        marks, edges, said = [], [], []
        some = [frame for frame in frames if low <= frame.turn < high]
        for frame, face in zip(some, detect_many(net, [one.image for one in some]), strict=True):
            marks.append(shares(face.points, frame))
            said.append(face.sigma / size_of(frame))
            edges.append(shares(face.marks()[:OUTLINE], frame, POINTS))
        result[name] = {
            "landmarks_percent": round(float(np.median(np.mean(marks, axis=1))), 2),
            "outline_percent": round(float(np.median(np.mean(edges, axis=1))), 2),
            "stated": round(float(np.sum(marks) / (200 * np.sum(said))), 2),
        }
    return result


def seconds(net: LandmarkNet, images: list[np.ndarray]) -> dict[str, float]:
    """Return processor seconds per view, one by one and as a frame set."""
    detect_many(net, images[:4])
    began = time.process_time()
    for image in images:
        detect(net, image)
    middle = time.process_time()
    detect_many(net, images)
    return {
        "seconds_per_view": round((middle - began) / len(images), 4),
        "seconds_per_view_together": round((time.process_time() - middle) / len(images), 4),
    }


def write_sheet(path: Path, net: LandmarkNet, frames: list[Frame], side: int = 230) -> None:
    """Write the faces side by side, given points green and found ones red."""
    tiles = []
    for frame in frames:
        scale = side / max(frame.image.shape[:2])
        tile = cv2.resize(frame.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        found = detect(net, frame.image).marks()
        for points, color in ((frame.points, (0, 255, 0)), (found, (255, 0, 0))):
            for x, y in points * scale:
                cv2.circle(tile, (int(x), int(y)), 1, color, -1)
        tiles.append(tile)
    rows = [tiles[start : start + 9] for start in range(0, len(tiles), 9)]
    write_image(path, contact_sheet(rows, tile=(side, side)))


if __name__ == "__main__":
    raise SystemExit(main())
