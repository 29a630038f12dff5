"""``express50 photo`` tracks the face in a single photograph or video, without calibration."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from express50.console import FAILED, OK, add_command, log, number, say, say_json, stdout_to_stderr
from express50.contract.layout import Dataset, check_results_folder
from express50.contract.stage import Command, stages
from express50.errors import ConfigError, advised
from express50.files.text import ID

if TYPE_CHECKING:
    from pipelines.photo.capture import PhotoSource

STAGES = ("ingest", "calibrate", "observe", "align", "frames", "matte", "track")
SEARCH = 0.08  # as `express50.landmarks.detector.SMALL`, which takes seconds to import
PHOTO_SETTINGS = (
    "observe.min_score=0.2", f"track.search={SEARCH}", f"observe.search={SEARCH}",
    "matte.method=grabcut",
)  # fmt: skip
WINDOWS, FILM_MM = 8, 50.0
WALK = 24  # pictures, one every 8 degrees from ear to ear
WORDS = "track the face in a single photograph or video, without calibration"


def add_commands(subparsers: Any) -> None:
    """Add the ``photo`` command."""
    from express50.cli.stages import add_config_options

    parser = add_command(
        subparsers, "photo", run_photo, WORDS, dataset=False,
        example="express50 photo portrait.jpg out\n"
        "picture of the result: out/panels/portrait/panel.jpg",
    )  # fmt: skip
    parser.add_argument("picture", type=Path, metavar="PICTURE", help="image or video file")
    parser.add_argument("out", type=Path, metavar="OUT", help="dataset to make or extend")
    parser.add_argument("--subject", metavar="ID", help="subject's id (default: the file's name)")
    lens = parser.add_mutually_exclusive_group()
    length = number(1, kind=float)
    words = "focal length, pixels (default: from EXIF, else by --film-mm)"
    lens.add_argument("--focal-px", type=length, metavar="PX", help=words)
    lens.add_argument(
        "--film-mm", type=length, default=FILM_MM, metavar="MM",
        help="focal length to assume if EXIF has none, mm on 35 mm film (default: 50)",
    )  # fmt: skip
    parser.add_argument(
        "--windows", type=number(1), default=WINDOWS, metavar="N",
        help="frames of a video that fit the head's shape, evenly spread (default: 8)",
    )  # fmt: skip
    parser.add_argument(
        "--walk", type=number(3), nargs="?", const=WALK, metavar="N",
        help="the video was filmed while walking around a person who holds still: only write its"
        f" N sharpest pictures (default: {WALK}), as cameras of one moment for 'express50 run'",
    )  # fmt: skip
    parser.add_argument(
        "--matte",
        action="store_true",
        help="also make a matte and fit outlines: by colours around the face, or with your network"
        " (--set matte.method=salient --set matte.weights=FILE)",
    )
    add_config_options(parser)


def run_photo(args: argparse.Namespace) -> int:
    """Make the capture and run the stages on it."""
    # Imported here: the list of commands must not wait for torch.
    from express50.cli.stages import config_of
    from express50.runner.executor import Pool
    from express50.runner.runner import run_stage
    from express50.runner.worker import cap_threads
    from pipelines import ingest
    from pipelines.photo.capture import make_photo_capture, open_picture, subject_id, write_panel

    if args.subject is not None and not ID.fullmatch(args.subject):
        raise ConfigError(f"--subject {args.subject!r}: expected letters, digits, '_' and '-'")
    picture = open_picture(args.picture)
    cap_threads(1)
    subject = args.subject or subject_id(args.picture)
    dataset = Dataset(args.out)
    if not dataset.ledger.exists():
        check_results_folder(args.out)
    folder = dataset.root / "photos" / subject
    known = dataset.captures().get(subject, folder)
    if known.exists() and known.resolve() != folder.resolve():
        raise ConfigError(
            f"{args.out}: subject {subject} already has the capture {known}; give the picture"
            " another id with --subject, or name another OUT"
        )
    if profile := picture.hdr or (picture.profile and picture.profile.name):
        log(f"{picture.path}: its colours are converted from {profile!r} to sRGB")
    if args.walk:
        return walk(args, picture, folder, subject)
    clips, given = ("track.frames=clips",) if picture.video else (), args.set
    args.set = [*PHOTO_SETTINGS, *clips, *given]
    names = [name for name in STAGES if args.matte or name != "matte"]
    with stdout_to_stderr() if args.json else nullcontext():
        loaded = [stages()[name] for name in names]
        configs = [config_of(stage, args) for stage in loaded]
        capture = make_photo_capture(
            picture, folder, subject, configs[-1],
            focal_px=args.focal_px, film_mm=args.film_mm, windows=args.windows,
        )  # fmt: skip
        # Small windows take most of the time of frames without a face.
        searches = (f"{name}.search={capture.search:.3g}" for name in ("observe", "track"))
        args.set = [*PHOTO_SETTINGS, *searches, *clips, *given]
        configs = [config_of(stage, args) for stage in loaded]
        ingest.add_captures(dataset, [folder])
        with Pool(0) as pool:
            summaries = []
            for stage, config in zip(loaded, configs, strict=True):
                chosen = [i for i in stage.items(dataset) if i.split("/")[0] == subject]
                summaries.append(run_stage(stage, dataset, config, chosen, pool=pool))
                # Without a matte, `track` fits a frame to its landmarks alone.
                if not summaries[-1].ok and not (stage.name == "matte" and picture.video):
                    break
        # Not in the capture: ingest would be outdated.
        panel = dataset.root / "panels" / subject / "panel.jpg"
        if summaries[-1].ok:
            write_panel(dataset, subject, configs[-1], panel)
    if args.json:
        table = [summary.to_json() for summary in summaries]
        say_json({"focal": vars(capture.focal), "stages": table})
        return OK if summaries[-1].ok else FAILED
    for summary in summaries:
        say(*summary.lines())
    say(*capture.focal.lines())
    if not summaries[-1].ok:
        return FAILED
    say(f"track: {dataset.item_dir('track', subject)}", f"picture: {panel}")
    return OK


def walk(args: argparse.Namespace, video: PhotoSource, folder: Path, subject: str) -> int:
    """Write the capture of a video filmed while walking around a person; no stage runs.

    Raises:
        ConfigError: the file is not a video, or an option belongs to the stages.
    """
    from express50.files.video import video_tags
    from pipelines.ingest.scan import odd_tags
    from pipelines.photo.capture import write_walk_capture

    if not video.video:
        raise ConfigError(f"--walk: {video.path} is a photograph, expected a video")
    of_photos = args.matte, args.windows != WINDOWS, args.film_mm != FILM_MM
    if any(of_photos) or args.set or args.config or args.preset:
        raise ConfigError(
            "--walk only writes pictures, and takes no option but --subject, --focal-px and --json;"
            " give --set, --config and --preset to 'express50 run', which makes mattes too"
        )
    for odd in odd_tags(replace(video_tags(video.path), hdr="")):  # that is converted
        log(f"warning: {video.path}: {odd}")
    frames = write_walk_capture(video, folder, subject, args.walk, args.focal_px)
    if args.json:
        say_json({"capture": str(folder), "frames": frames})
    else:
        say(f"pictures: {len(frames)} in {folder}")
        say(f"next: {advised('express50 run', args.out, folder)}")
    return OK


COMMAND = Command(WORDS, add_commands)
