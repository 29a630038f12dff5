"""``express50 photo`` tracks the face of a bare photograph or of a video of one camera."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.cli.stages import add_config_options, config_of
from express50.console import FAILED, OK, say, say_json, stdout_to_stderr
from express50.contract.layout import Dataset
from express50.contract.stage import stages
from express50.dataset.tracks import read_track
from express50.errors import ConfigError
from express50.files.images import write_image
from express50.files.text import ID
from express50.head.load import load_head
from express50.head.preview import render_preview
from express50.runner.executor import Pool
from express50.runner.runner import Summary, run_stage
from express50.runner.worker import cap_threads
from pipelines import ingest
from pipelines.photo.capture import Focal, make_photo_capture, open_picture, subject_id
from pipelines.track.config import TrackConfig
from pipelines.track.read_inputs import open_landmarks
from pipelines.track.report import draw_column

STAGES = ("ingest", "calibrate", "observe", "align", "frames", "matte", "track")
SEARCH = 0.08  # people fill a rig's pictures, but not all photographs
PHOTO_SETTINGS = (
    "observe.min_score=0.2", f"track.search={SEARCH}", f"observe.search={SEARCH}",
    "matte.method=grabcut",
)  # fmt: skip
PANEL_TILE, PANEL_YAW = 512, 60.0  # pixels; degrees
WORDS = "track the face in a single photograph or video, without calibration"


def add_commands(subparsers: Any) -> None:
    """Add the ``photo`` command."""
    parser = subparsers.add_parser(
        "photo", help=WORDS, description=WORDS,
        epilog="example: express50 photo portrait.jpg out; see out/track/portrait/qc",
    )  # fmt: skip
    parser.add_argument("picture", type=Path, metavar="PICTURE", help="image or video file")
    parser.add_argument("out", type=Path, metavar="OUT", help="dataset folder to make or extend")
    parser.add_argument("--subject", metavar="ID", help="subject id [the file's name]")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--focal-px", type=float, metavar="F", help="focal length, pixels")
    lens.add_argument(
        "--film-mm", type=float, default=50.0, metavar="MM",
        help="focal length on 35 mm film to assume if EXIF has none [50]",
    )  # fmt: skip
    parser.add_argument(
        "--windows", type=int, default=8, metavar="N",
        help="parts of a video; one frame of each part fits the shape [8]",
    )  # fmt: skip
    parser.add_argument(
        "--matte",
        action="store_true",
        help="also make a matte and fit outlines; by colours around the face, or with your network:"
        " --set matte.method=salient --set matte.weights=FILE",
    )
    add_config_options(parser)
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(handler=run_photo)


def run_photo(args: argparse.Namespace) -> int:
    """Make the capture and run the stages on it."""
    if args.subject is not None and not ID.fullmatch(args.subject):
        raise ConfigError(f"--subject {args.subject!r}: expected letters, digits, '_' and '-'")
    for name, value in (("--focal-px", args.focal_px), ("--film-mm", args.film_mm)):
        if value is not None and not 0 < value < float("inf"):
            raise ConfigError(f"{name} {value}: expected a number above 0")
    if args.windows < 1:
        raise ConfigError(f"--windows {args.windows}: expected at least 1")
    picture = open_picture(args.picture)
    clips = ("track.frames=clips",) if picture.video else ()
    args.set = [*PHOTO_SETTINGS, *clips, *args.set]
    cap_threads(1)
    subject = args.subject or subject_id(args.picture)
    dataset = Dataset(args.out)
    names = [name for name in STAGES if args.matte or name != "matte"]
    with stdout_to_stderr() if args.json else nullcontext():
        loaded = [stages()[name] for name in names]
        configs = [config_of(stage, args) for stage in loaded]
        folder = dataset.root / "photos" / subject
        focal = make_photo_capture(
            picture, folder, subject, configs[-1],
            focal_px=args.focal_px, film_mm=args.film_mm, windows=args.windows,
        )  # fmt: skip
        ingest.register(dataset, [folder])
        with Pool(0) as pool:
            summaries = []
            for stage, config in zip(loaded, configs, strict=True):
                chosen = [i for i in stage.items(dataset) if i.split("/")[0] == subject]
                summaries.append(run_stage(stage, dataset, config, chosen, pool=pool))
                if not summaries[-1].ok:
                    break
        panel = folder / "panel.jpg"
        if summaries[-1].ok:
            write_panel(dataset, subject, configs[-1], panel)
    done = summaries[-1].ok
    if args.json:
        say_json({"focal": vars(focal), "stages": [summary.to_json() for summary in summaries]})
    else:
        _account(focal, summaries)
        if done:
            say(f"track: {dataset.item_dir('track', subject)}", f"picture: {panel}")
    return OK if done else FAILED


def _account(focal: Focal, summaries: list[Summary]) -> None:
    """Print the outputs and how uncertain the focal length is."""
    for summary in summaries:
        say(*summary.lines())
    say(
        f"focal length {focal.pixels:.0f} px ({focal.source}); from the face alone, "
        f"{focal.low:.0f} to {focal.high:.0f} px fit as well"
    )
    if not focal.low <= focal.pixels <= focal.high:
        say("warning: the focal length is outside this range; check it, or give --focal-px")


def write_panel(dataset: Dataset, subject: str, config: TrackConfig, path: Path) -> None:
    """Write the first tracked frame, its overlay and the turned head side by side."""
    track = read_track(dataset.track_file(subject))
    mesh = track.vertices[0].astype(np.float64)
    model = load_head(config.head)
    ((camera_id, camera),) = read_cameras_of(dataset, subject).items()
    image = read_peak_frame(dataset, subject, track.expressions[0], camera_id)
    source = open_landmarks(dataset, subject, config.landmarks, config.search)
    seen = source(image, camera_id, int(track.frames[0]))
    dots = [seen.face.marks(), seen.irises.centres[seen.irises.confidence > 0]]
    column = draw_column(image, camera, model.to(dtype=torch.float64), mesh, dots, PANEL_TILE)
    head = (mesh - track.t[0]) @ track.R[0]
    turned = render_preview(model, head, yaw=PANEL_YAW, size=PANEL_TILE)
    write_image(
        path, np.concatenate([column[:PANEL_TILE], column[PANEL_TILE:], turned], axis=1), quality=90
    )
