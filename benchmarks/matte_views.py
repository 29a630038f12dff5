"""Measure how several views help each other: against the key, and without plates.

``python -m benchmarks.matte_views`` records a rig of 24 cameras with the digital twin (a minute),
or takes ``--dataset`` and ``--truth``, disturbs the peaks and measures the mattes before and after
the cameras have agreed, with all cameras and with every third:

- ``undisturbed``: nothing may get worse (``sad_ratio_to_key`` at most 1.01);
- ``shadow``: three cameras in eight see a shadow, too deep for the key, on the backdrop;
- ``object``: a quarter of the cameras see a stand with a cable behind the subject;
- ``person``: a third of the cameras see another person behind the subject;
- ``patch``: a patch of the skin has one colour in all views, and two have the same behind it;
- ``bumped``: one camera was turned after calibration, its matte is right where it now looks.

``no_plate`` withholds the plates: mattes of all cameras together (`cut_out`), with the walls that
all moments show (`learn_walls`), before the set as recorded, bland and cluttered walls, and walls
of the skin's and the shirt's colour. Beside its ``sad`` are that of the key, which has the plates
(``sad_plate``), that of one moment without the others (``sad_moment``), and that of each camera cut
alone (``sad_alone``). ``sad_ratio_to_plate`` and ``worst_ratio``, that of the worst camera, are
printed per scene and of all scenes together.

``plates`` has the same figures for plates that were shifted, or taken in other light or elsewhere,
in front of the recorded and the cluttered set: ``sad`` as `match_plate` brings them to the frame
when it knows where the faces place the person, ``sad_untouched`` as they are, ``sad_right`` with
the right plate, and the share that is ``refused``.

Disturbances are laid on the recorded frames in linear light with the true alpha, and keyed again.
``sad`` is the summed absolute error in thousands, ``mae`` its mean, both means over cameras and
peaks; ``*_key`` is each camera alone, ``*_outvoted`` what the cameras correct in each other while
nobody else is taken out. ``named`` counts the cameras that were found wrong; ``bumped`` has one per
peak. ``seconds_per_moment`` is processor time, reading and keying excluded.
The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common import (
    add_twin_options,
    check_twin_options,
    make_parser,
    means,
    named_or_recorded,
    rounded,
    true_pictures,
)
from benchmarks.matte import errors
from benchmarks.matte_disturbances import DISTURBANCES, Shot, other_plates, walls
from benchmarks.truth import Truth
from express50.contract.layout import Dataset
from express50.errors import NoFaceError
from express50.files.images import write_image
from express50.geometry.cameras import pinhole
from express50.geometry.pixels import contact_sheet, shrink
from express50.geometry.sampling import evenly
from express50.twin import TwinConfig
from pipelines.matte import MatteConfig
from pipelines.matte.cutout import CutView, cut_out, find_head, make_cut_view, region_of
from pipelines.matte.key import key_alpha
from pipelines.matte.plates import LEAST_SHARE, match_plate
from pipelines.matte.stage import SHOWN, CameraMatte, agree, compared, corrected
from pipelines.matte.visual_hull import Agreement, ball_of
from pipelines.matte.wall import MOMENTS, Wall, learn_walls, soft_alpha

RIG = TwinConfig(
    subjects=1, first_subject=61, cameras=24, width=384, height=384, footage="jpg",
    expressions=(
        "neutral", "smile", "brow_raise", "cheeks_puff", "nose_wrinkle", "pucker", "wink_left",
        "jaw_open",
    ), frames_per_expression=4, board_frames=0, give_calibration=True,
)  # fmt: skip
Figures = dict[str, float]


@dataclass(frozen=True)
class Keyed:
    """A shot and what its camera alone makes of it, (H, W) uint8."""

    shot: Shot
    alpha: np.ndarray


def main() -> int:
    """Run and print."""
    parser = make_parser("matte_views", __doc__)
    add_twin_options(parser)
    parser.add_argument("--subject", type=int, default=RIG.first_subject, help="of the twin")
    parser.add_argument("--recording", type=Path, default=Path("build/bench-views"))
    parser.add_argument("--peaks", type=int, default=2, help="moments, at most")
    parser.add_argument("--pictures", type=Path, help="folder for pictures")
    parser.add_argument("--plates-only", action="store_true", help="leave out no_plate")
    args = parser.parse_args()
    check_twin_options(parser, args)
    cv2.setNumThreads(1)
    twin = replace(RIG, first_subject=args.subject)
    dataset, truth = named_or_recorded(args, twin, args.recording)
    rows: dict[tuple[int, str], list[Figures]] = {}
    plates: dict[str, list[Figures]] = {}
    for subject, frame in moments(dataset, truth, args.peaks):
        clean = shots_of(dataset, truth, subject, frame)
        undone: dict[int, Keyed] = {}  # most shots of a scene are untouched, and keyed once
        for scene, disturb in DISTURBANCES.items():
            keyed = [undone.get(id(shot)) or key(shot) for shot in disturb(clean)]
            undone |= {id(k.shot): k for k in keyed if scene == "undisturbed"}
            for step in (1, 3):
                row = measure(keyed[::step], sheet_of(args, scene, step, frame))
                rows.setdefault((len(keyed[::step]), scene), []).append(row)
                words = subject, frame, scene, len(keyed[::step]), rounded(row)
                print(*words, file=sys.stderr)
        for scene in ("recorded", "cluttered"):
            shots = scenes(clean, clean)[scene]
            for wrong, plated in other_plates(shots[::4]).items():
                plates.setdefault(f"{scene}_{wrong}", []).append(with_plates(plated, shots[::4]))
    unplated = {} if args.plates_only else by_scene(bare_rows(args, dataset, truth), "plate")
    result = {
        "benchmark": "matte_views",
        **by_scene(rows, "key"),
        "no_plate": unplated | together(unplated),
        "plates": {name: means(mine) for name, mine in plates.items()},
    }
    print(json.dumps(rounded(result)))
    return 0


def moments(dataset: Dataset, truth: Truth, limit: int) -> list[tuple[str, int]]:
    """Return (subject, frame) of an even choice of the peaks."""
    every = [(s, frame) for s in dataset.subjects() for frame in truth.peaks(s).values()]
    return evenly(every, limit)


def shots_of(dataset: Dataset, truth: Truth, subject: str, frame: int) -> list[Shot]:
    """Return undistorted frames and plates of a moment with their true alpha and depth."""
    return [
        Shot(
            camera=camera,
            depth=truth.render_depth(subject, frame, pinhole(camera))[0],
            **true_pictures(dataset, truth, subject, camera, frame),
        )
        for camera in truth.cameras(subject).values()
    ]


def key(shot: Shot) -> Keyed:
    """Return the shot with its camera's own alpha."""
    alpha = key_alpha(shot.frame, shot.plate, shot.valid, MatteConfig().shadow)
    return Keyed(shot, np.rint(255 * alpha).astype(np.uint8))


def measure(keyed: list[Keyed], sheet: Path | None) -> Figures:
    """Return errors of one moment before and after the cameras agree, and the seconds it takes."""
    started = time.process_time()
    ball = ball_of({k.shot.camera.id: k.shot.camera for k in keyed})
    if ball is None:
        sys.exit("the rig looks at no one place; name another --dataset")
    shots = {k.shot.camera.id: k.shot for k in keyed}
    cameras = {name: shot.camera for name, shot in shots.items()}
    alone = {
        k.shot.camera.id: CameraMatte(
            k.alpha, shrink(k.shot.frame, SHOWN), 0.0, plate=shrink(k.shot.plate, SHOWN)
        )
        for k in keyed
    }
    read = lambda name: (shots[name].frame, shots[name].valid)  # noqa: E731
    mattes, _, found, _ = agree(read, cameras, alone, ball)
    after = after_agreement(mattes, found)
    seconds = time.process_time() - started
    if sheet is not None:
        pictures = [[k.shot.frame, k.alpha, a] for k, a in zip(keyed, after, strict=True)]
        write_sheet(sheet, pictures, [k.shot for k in keyed])
    outvoted = after_agreement(alone, compared(cameras, alone, ball)[1])
    row: Figures = {}
    for kind, alphas in (("", after), ("_key", [k.alpha for k in keyed]), ("_outvoted", outvoted)):
        found_errors = [errors(a / 255, k.shot.true) for k, a in zip(keyed, alphas, strict=True)]
        row |= {f"{name}{kind}": means(found_errors)[name] for name in ("sad", "mae")}
    return row | {"named": float(len(found.warnings)), "seconds_per_moment": seconds}


def after_agreement(mattes: Mapping[str, CameraMatte], found: Agreement) -> list[np.ndarray]:
    """Return the alphas (H, W) uint8 that cameras correct in each other."""
    return [
        corrected(matte.alpha, found.removed.get(name), found.filled.get(name))
        for name, matte in mattes.items()
    ]


def write_sheet(path: Path, pictures: list[list[np.ndarray]], shots: list[Shot]) -> None:
    """Write a row of pictures for each of the first eight cameras."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, contact_sheet(pictures[:8], [shot.camera.id for shot in shots[:8]]))


def scenes(shots: list[Shot], first: list[Shot]) -> dict[str, list[Shot]]:
    """Return the shots as recorded and before other walls."""
    return {"recorded": shots, **walls(shots, first)}


def bare_rows(
    args: argparse.Namespace, dataset: Dataset, truth: Truth
) -> dict[tuple[int, str], list[Figures]]:
    """Return the errors without plates, by number of cameras and scene."""
    rows: dict[tuple[int, str], list[Figures]] = {}
    for subject in dataset.subjects():
        frames = evenly(list(truth.peaks(subject).values()), MOMENTS)
        taken = [shots_of(dataset, truth, subject, frame) for frame in frames]
        everywhere = [scenes(shots, taken[0]) for shots in taken]
        for scene in everywhere[0]:
            for step in (1, 3):
                shots = [moment[scene][::step] for moment in everywhere]
                learned = learned_walls(shots)
                for k in evenly(range(len(frames)), args.peaks):
                    sheet = sheet_of(args, f"no-plate-{scene}", step, frames[k])
                    row = without_plates(shots[k], learned, sheet)
                    rows.setdefault((len(shots[k]), scene), []).append(row)
                    print(scene, len(shots[k]), rounded(row), file=sys.stderr, flush=True)
    return rows


def learned_walls(moments: list[list[Shot]]) -> dict[str, Wall]:
    """Return the walls that the cameras show at several moments."""
    shots = [{shot.camera.id: shot for shot in moment} for moment in moments]
    cameras = {name: shot.camera for name, shot in shots[0].items()}
    read = lambda name, k: shots[k][name].frame  # noqa: E731
    return dict(learn_walls(cameras, read, range(len(shots)), cameras))


def without_plates(shots: list[Shot], learned: dict[str, Wall], sheet: Path | None) -> Figures:
    """Return the errors of a moment whose plates are withheld, beside those with plates."""
    ball = ball_of({shot.camera.id: shot.camera for shot in shots})
    views = [make_cut_view(pinhole(shot.camera), shot.frame, shot.valid) for shot in shots]
    started = time.process_time()
    cuts = cut_out(views, ball)
    alphas = [
        soft_alpha(shot.frame, shot.valid, cuts[shot.camera.id], learned.get(shot.camera.id))
        for shot in shots
    ]
    seconds = time.process_time() - started
    moment = [soft_alpha(shot.frame, shot.valid, cuts[shot.camera.id]) for shot in shots]
    alone = [_alone(shot, view) for shot, view in zip(shots, views, strict=True)]
    keyed = [key(shot).alpha / 255 for shot in shots]
    if sheet is not None:
        steps = [(255 * alpha).astype(np.uint8) for alpha in alphas]
        write_sheet(sheet, [[s.frame, a] for s, a in zip(shots, steps, strict=True)], shots)
    sad, sad_plate, sad_moment, sad_alone = (
        np.array([errors(a, shot.true)["sad"] for a, shot in zip(found, shots, strict=True)])
        for found in (alphas, keyed, moment, alone)
    )
    return {
        "sad": float(sad.mean()),
        "sad_plate": float(sad_plate.mean()),
        "sad_moment": float(sad_moment.mean()),
        "sad_alone": float(sad_alone.mean()),
        "worst_ratio": float((sad / sad_plate).max()),
        "seconds_per_view": seconds / len(shots),
    }


def _alone(shot: Shot, view: CutView) -> np.ndarray:
    try:
        return soft_alpha(shot.frame, shot.valid, cut_out([view], None)[view.name])
    except NoFaceError:
        return np.zeros(shot.true.shape, np.float32)


def with_plates(wrong: list[Shot], right: list[Shot]) -> Figures:
    """Return errors of shots with wrong plates; those that are refused count for nothing else."""
    kept: list[Figures] = []
    views = [make_cut_view(pinhole(shot.camera), shot.frame, shot.valid) for shot in right]
    place = find_head(views)
    for shot, good, view in zip(wrong, right, views, strict=True):
        matched = match_plate(shot.plate, shot.frame, shot.valid, region_of(view, place))
        if matched.share >= LEAST_SHARE:
            plates = {"sad": matched.plate, "sad_untouched": shot.plate, "sad_right": good.plate}
            kept.append(
                {
                    name: errors(key(replace(shot, plate=plate)).alpha / 255, shot.true)["sad"]
                    for name, plate in plates.items()
                }
            )
    return means(kept) | {"refused": 1 - len(kept) / len(wrong)}


def by_scene(rows: dict[tuple[int, str], list[Figures]], base: str) -> dict[str, Any]:
    """Return means over the peaks by number of cameras and scene, with SAD's ratio to a base's."""
    table: dict[str, Any] = {}
    for (count, scene), mine in rows.items():
        row = means(mine)
        row[f"sad_ratio_to_{base}"] = row["sad"] / row[f"sad_{base}"]
        table.setdefault(f"cameras_{count}", {})[scene] = row
    return table


def together(table: dict[str, Any]) -> Figures:
    """Return the ratios to mattes with plates of all scenes together."""
    rows = [row for scenes in table.values() for row in scenes.values()]
    if not rows:
        return {}
    total, plates = (sum(row[name] for row in rows) for name in ("sad", "sad_plate"))
    worst = max(row["worst_ratio"] for row in rows)
    return {"sad_ratio_to_plate": total / plates, "worst_ratio": worst}


def sheet_of(args: argparse.Namespace, scene: str, step: int, frame: int) -> Path | None:
    """Return where the picture of a measurement goes, if anywhere."""
    if args.pictures is None or step == 1:
        return None
    return args.pictures / f"{scene}-{frame}.png"


if __name__ == "__main__":
    sys.exit(main())
