"""Measure rigs made from one video that was filmed while walking around a person.

``python -m benchmarks.walk OUT`` renders such a video of a synthetic person who sways a little,
with an unsteady hand, motion blur and noise; takes its pictures with ``express50 photo --walk``,
solves their cameras with ``express50 calibrate`` and lays them on the true ones. ``--degrees`` is
how far around the walk goes, ``--pictures`` how many pictures are taken. Errors are of the cameras'
centres and turns; ``far`` are those whose centre is over 100 mm off, ``named`` those that a warning
names. The last line is one JSON object.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import make_parser
from express50.__main__ import main as express50
from express50.capture.frames import read_recorded_cameras
from express50.contract.layout import Dataset
from express50.files.video import VideoFootage
from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at, matrix_to_axis_angle, similarity_fit
from express50.twin import TwinConfig
from express50.twin.body import pose_body
from express50.twin.render import hull_of
from express50.twin.rig import TARGET, expose, make_sensor
from express50.twin.shade import build_scene, find_eyes, make_lighting
from express50.twin.skin import paint_skin, texture_width
from express50.twin.studio import cast_subject, make_view, render_view

WIDTH, HEIGHT, FPS = 720, 960, 24
RADIUS_M, NOISE, BLUR_PX = 0.75, 2.0, 2.0
FAR_MM, FEWEST = 100.0, 4  # a camera that is further off is wrong; cameras that fix a similarity


def walked_cameras(frames: int, degrees: float, seed: int) -> list[Camera]:
    """Place the cameras of a walk around the head by an unsteady hand, all with one lens."""
    rng, places = np.random.default_rng([seed, 1]), np.linspace(0, 1, frames)

    def wander(knots: int, spread: float) -> np.ndarray:
        return np.interp(places, np.linspace(0, 1, knots), rng.normal(0, spread, knots))

    around = np.radians(degrees * (places - 0.5) + wander(20, 1.0))
    up, away, roll = np.radians(4 + wander(15, 3.0)), RADIUS_M + wander(12, 0.04), wander(15, 2.0)
    aims = TARGET + np.stack([wander(25, 0.02), wander(25, 0.02), np.zeros(frames)], axis=1)
    way = [np.sin(around) * np.cos(up), np.sin(up), np.cos(around) * np.cos(up)]
    places = TARGET + away[:, None] * np.stack(way, axis=1)
    focal = 0.86 * HEIGHT
    lens = (focal, focal, WIDTH / 2, HEIGHT / 2, -0.03, 0.01, 0.0, 0.0)
    cameras = []
    for number, (place, aim) in enumerate(zip(places, aims, strict=True)):
        tilt = np.array([math.tan(math.radians(roll[number])), 1.0, 0.0])
        pose = look_at(place, aim, tilt)
        cameras.append(Camera(f"{number:05d}", WIDTH, HEIGHT, "OPENCV", lens, pose))
    return cameras


def film(out: Path, subject: int, cameras: list[Camera], seed: int) -> None:
    """Write video.mp4 of a person who holds still as well as people do, a frame per camera."""
    config = TwinConfig(
        subjects=1, cameras=len(cameras), width=WIDTH, height=HEIGHT, fps=FPS,
        frames_per_expression=len(cameras), expressions=("neutral",), plates=False, board_frames=0,
    )  # fmt: skip
    body, play = cast_subject(config, f"S{subject:03d}")
    texture = paint_skin(body, config.seed, texture_width(WIDTH))
    eyes, lighting = find_eyes(body.model), make_lighting(subject, config.seed)
    rng, sensor = np.random.default_rng([seed, 2]), make_sensor(0, config.seed)
    with VideoFootage(out, WIDTH, HEIGHT, FPS, 18) as video:
        for number, camera in enumerate(cameras):
            posed = pose_body(body, play, number)
            scene = build_scene(body, texture, eyes, lighting, posed, config.seed, None)
            view = replace(make_view(camera, number, config.seed, False), sensor=sensor)
            picture = render_view(scene, view, hull_of(posed.vertices))
            blurred = cv2.filter2D(picture, -1, streak(abs(rng.normal(0, BLUR_PX)), rng.normal()))
            video.write(expose(sensor, blurred, rng, NOISE))


def streak(length: float, angle: float) -> np.ndarray:
    """Return the kernel of a motion of so many pixels."""
    reach = math.ceil(length / 2)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for along in np.linspace(-length / 2, length / 2, 50):
        row, column = along * math.sin(angle), along * math.cos(angle)
        kernel[reach + round(row), reach + round(column)] += 1 / 50
    return kernel


def lay_on(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Find the similarity that lays most centres (N, 3) on the true ones, whatever the others."""
    rng, best = np.random.default_rng(0), np.zeros(len(found), bool)
    for _ in range(2000):
        chosen = rng.choice(len(found), FEWEST, replace=False)
        scale, R, t = similarity_fit(found[chosen], true[chosen])
        near = np.linalg.norm(scale * found @ R.T + t - true, axis=1) < 1e-3 * FAR_MM / 2
        best = near if near.sum() > best.sum() else best
    return similarity_fit(found[best], true[best])


def measure(dataset: Dataset, subject: str, true: dict[str, Camera]) -> dict[str, object]:
    """Compare the cameras that calibrate found with the true ones."""
    cameras = read_recorded_cameras(dataset, subject)
    names = sorted(cameras)
    centres = [np.stack([rig[n].center for n in names]) for rig in (cameras, true)]
    scale, R, t = lay_on(*centres)
    off = 1e3 * np.linalg.norm(scale * centres[0] @ R.T + t - centres[1], axis=1)
    turns = [
        cameras[n].cam_from_world[:3, :3] @ R.T @ true[n].cam_from_world[:3, :3].T for n in names
    ]
    degrees = np.degrees([np.linalg.norm(matrix_to_axis_angle(turn)) for turn in turns])
    metrics = json.loads((dataset.item_dir("calibrate", subject) / "metrics.json").read_text())
    right, stated = off <= FAR_MM, [row["mm"] for row in metrics["uncertainty"].values()]
    return {
        "placed": len(names),
        "far": [name for name, near in zip(names, right, strict=True) if not near],
        "named": [row["what"] for row in metrics["warnings"] if row["what"] in cameras],
        "centre_mm_median": round(float(np.median(off[right])), 2),
        "centre_mm_max": round(float(off.max()), 1),
        "turn_deg_median": round(float(np.median(degrees[right])), 3),
        "stated_mm_median": round(float(np.median(stated)), 2),
        "size_error_percent": round(100 * abs(scale - 1), 2),
    }


def main() -> None:
    """Film, take pictures, solve and compare."""
    parser = make_parser("walk", __doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subject", type=int, default=69)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--degrees", type=float, default=180.0)
    parser.add_argument("--pictures", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    cameras = walked_cameras(args.frames, args.degrees, args.seed)
    if not (args.out / "video.mp4").is_file():
        film(args.out, args.subject, cameras, args.seed)
    data, walk = args.out / "data", args.out / "data" / "photos" / "walk"
    video = [str(args.out / "video.mp4"), str(data), "--subject", "walk"]
    commands = (
        ["photo", *video, "--walk", str(args.pictures)],
        ["ingest", str(data), str(walk)],
        ["calibrate", str(data), "--workers", "0"],
    )
    for command in commands:
        if express50(command) != 0:
            raise SystemExit(f"express50 {command[0]} failed; see above")
    true = {camera.id: camera for camera in cameras}
    row = {"pictures": args.pictures, "degrees": args.degrees}
    print(json.dumps(row | measure(Dataset(data), "walk", true)))


if __name__ == "__main__":
    main()
