"""Record a digital twin under a condition and run the chain up to registration on it.

A condition is a row of ``CONDITIONS``: how many cameras, how many pixels, how far away, and which
fault the footage has. Peaks are the true ones, because alignment has its own rows.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

from annotations import align, observe
from benchmarks.common import keep_cameras, run_or_stop, write_peaks
from benchmarks.matte_disturbances import Shot, before_wall
from benchmarks.matte_scenes import cluttered
from benchmarks.truth import Truth
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.files.calibration import read_cameras, write_cameras
from express50.files.images import read_image, write_image
from express50.geometry.transforms import axis_angle_to_matrix
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from express50.twin import TwinConfig, rig
from express50.twin.record import record
from pipelines import calibrate, depth, frames, ingest, matte, register, track
from pipelines.ingest import add_captures

EXPRESSIONS = ("neutral", "smile")
SETTINGS: dict[str, dict[str, object]] = {  # sizes that fit a small machine, as in the demo
    "track": {"samples": 2500, "offset_modes": 80, "texture_side": 256},
    "depth": {"voxel_mm": 2.8},
}
FRONT = {1: [4], 2: [3, 4], 4: [2, 3, 4, 5]}  # of eight cameras
LIGHT = (0.75, 1.2)  # colour gains of a camera whose lamps moved after its plate was taken
BLUR_PX = 1.5


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What is recorded, and what goes wrong."""

    name: str
    views: int = 8  # cameras that the stages see
    side: int = 256  # pixels of the pictures' sides
    distance: float = 1.0  # of the cameras, in the rig's usual one; the focal length grows with it
    noise: float = 1.0  # of the sensor, in that of a good studio camera
    harm: str = ""  # ``blur``, ``light``, ``turned``, ``plates``, ``wall`` or nothing
    preset: str = ""  # settings of all stages; the demo's if it is empty
    head: str = "procedural"  # model of the person
    costly: bool = False  # takes more than ten minutes of a core, and is run only if it is named

    def row(self, subject: str) -> str:
        """Return the folder of a subject's row."""
        return f"{self.name.replace(' ', '-')}-{subject}"

    def film(self, subject: str) -> str:
        """Return the folder of the recording, which rows share."""
        rest = f"{self.distance}-{self.noise}-{Path(self.head).stem}"
        return f"{max(8, self.views)}-{self.side}-{rest}-{subject}"


CONDITIONS = (
    Condition(name="8 views"),
    Condition(name="4 views", views=4),
    Condition(name="2 views", views=2),
    Condition(name="1 view", views=1),
    Condition(name="blur", harm="blur"),
    Condition(name="wrong light", harm="light"),
    Condition(name="a camera off by a degree", harm="turned"),
    Condition(name="no plates", harm="plates"),
    Condition(name="no plates, 4 views", harm="plates", views=4),
    Condition(name="no plates, cluttered wall", harm="wall"),
    Condition(name="128 px", side=128),
    Condition(name="noise", noise=6.0),
    Condition(name="512 px", side=512),
    # Nearer than this a head does not fit the picture: focal lengths of 20 px are n/a.
    Condition(name="focal length 310 px", distance=0.5),
    Condition(name="focal length 2,500 px", distance=4.0),
    Condition(name="focal length 20,000 px", distance=32.0),
    Condition(name="24 views", views=24),
    Condition(name="draft", preset="draft"),
    Condition(name="standard", preset="standard"),
    Condition(name="1920 px", side=1920, costly=True),
    Condition(name="3840 px", side=3840, costly=True),
)


def make_row(condition: Condition, number: int, root: Path) -> tuple[Dataset, Truth]:
    """Record subject ``number`` and run the stages; existing results are kept."""
    subject = f"S{number:03d}"
    config = TwinConfig(
        subjects=1, first_subject=number, cameras=max(8, condition.views), width=condition.side,
        height=condition.side, expressions=EXPRESSIONS, frames_per_expression=4, board_frames=0,
        give_calibration=True, footage="png", seed=5, noise=condition.noise, head=condition.head,
    )  # fmt: skip
    film = root / "films" / condition.film(subject)
    with mock.patch.object(rig, "RADIUS_M", rig.RADIUS_M * condition.distance):
        record(config, film, workers=1)
    truth = Truth(film / "truth")
    dataset = Dataset(root / "rows" / condition.row(subject))
    capture = dataset.root / "capture" / subject
    if not capture.is_dir():
        shutil.copytree(film / "captures" / subject, capture)
        _harm(capture, condition, truth)
    run_chain(dataset, capture, truth.peaks(subject), condition.preset)
    return dataset, truth


def run_chain(dataset: Dataset, capture: Path, peaks: dict[str, int], preset: str = "") -> None:
    """Run the stages from ingest to registration; a stage that fails ends the row there."""
    add_captures(dataset, [capture])
    for stage in (ingest, calibrate, frames, matte, track, depth, register):
        name, presets = stage.STAGE.name, stage.STAGE.presets
        chosen = presets.get(preset, {}) if preset else SETTINGS.get(name, {})
        settings = build_config(stage.STAGE, chosen)
        if stage is frames:
            write_peaks(dataset, capture.name, peaks)
        summary = run_stage(stage.STAGE, dataset, settings, pool=Pool(0), progress=False)
        for line in (outcome.reason for outcome in summary.outcomes if outcome.reason):
            print(f"{dataset.root.name}: {stage.STAGE.name}: {line}", file=sys.stderr)
        if not summary.count("done") + summary.count("skipped"):
            return


def _harm(capture: Path, condition: Condition, truth: Truth) -> None:
    """Leave cameras and plates out, and spoil pictures or calibration."""
    names = sorted(path.name for path in (capture / "cameras").iterdir())
    keep_cameras(capture, [names[k] for k in FRONT.get(condition.views, range(len(names)))])
    if condition.harm == "turned":
        cameras = read_cameras(capture / "calibration.json")
        turn = np.eye(4)
        turn[:3, :3] = axis_angle_to_matrix(np.array([0.0, np.radians(1.0), 0.0]))
        one = cameras[names[3]]
        cameras[names[3]] = replace(one, cam_from_world=turn @ one.cam_from_world)
        write_cameras(capture / "calibration.json", cameras)
    if condition.harm == "wall":
        _change_walls(capture, truth)
    if condition.harm in ("plates", "wall"):
        shutil.rmtree(capture / "plates")
    for k, folder in enumerate(sorted((capture / "cameras").iterdir())):
        gain = np.random.default_rng([7, k]).uniform(*LIGHT, 3)
        for path in sorted(folder.rglob("*.png")) if condition.harm in ("blur", "light") else ():
            picture = read_image(path)
            if condition.harm == "blur":
                picture = cv2.GaussianBlur(picture, (0, 0), BLUR_PX)
            else:
                picture = np.clip(picture * gain, 0, 255).astype(np.uint8)
            write_image(path, picture)


def _change_walls(capture: Path, truth: Truth) -> None:
    """Put another cluttered wall behind the peak frames of each camera."""
    subject = capture.name
    for k, (name, camera) in enumerate(sorted(truth.cameras(subject).items())):
        for frame in truth.peaks(subject).values() if (capture / "cameras" / name).is_dir() else ():
            path = capture / "cameras" / name / "frames" / f"{frame:06d}.png"
            alpha = truth.render_alpha(subject, frame, camera)
            shot = Shot(
                camera=camera, frame=read_image(path), true=alpha, depth=0 * alpha,
                plate=read_image(capture / "plates" / f"{name}.png"),
                valid=np.ones(alpha.shape, bool),
            )  # fmt: skip
            write_image(path, before_wall(shot, cluttered, np.random.default_rng([11, k])).frame)


SCRIPT = (
    "neutral", "smile", "jaw_open", "pucker", "brow_raise", "wink_left", "anger", "shout",
    "surprise", "sadness", "smile_open", "laugh",
)  # fmt: skip
ALIGN_NOISE = {"1 view": 1.0, "noise": 6.0}


def make_peaks(noise: float, numbers: Sequence[int], root: Path) -> None:
    """Record subjects with one camera and suggest their peaks."""
    folder = root / "peaks" / f"{noise}-{numbers[0]}"
    config = TwinConfig(
        subjects=len(numbers), first_subject=numbers[0], cameras=1, width=192, height=192,
        expressions=SCRIPT, frames_per_expression=10, board_frames=0, give_calibration=True,
        footage="jpg", plates=False, seed=17, noise=noise,
    )  # fmt: skip
    record(config, folder / "twin", workers=1)
    dataset = Dataset(folder / "dataset")
    add_captures(dataset, sorted((folder / "twin" / "captures").iterdir()))
    for stage in (ingest.STAGE, observe.STAGE):
        run_or_stop(stage, dataset, "standard")
    run_or_stop(align.STAGE, dataset, "standard", match=False)
