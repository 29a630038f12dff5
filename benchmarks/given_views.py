"""Track an unseen person from the given views alone, and judge the fit on views held out.

A capture of the given pictures is made from what ``frames`` wrote: one frame set, those cameras,
the plates of the empty set, and the rig's calibration, which needs no picture of the person.
Every stage runs on it, so that shape, pose, expression, mattes and labels are of these pictures
alone. Its samples and its track are then packed together with the held-out pictures of the whole
dataset: what a fit draws comes from the given views, what it is compared with from all.
``python -m benchmarks.given_views DATASET OUT --subject S004 --cameras cam05,cam04`` writes
``OUT/shards``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common import make_parser
from express50.__main__ import main as express50
from express50.capture.frames import read_cameras_of, read_peak_frame, read_plate_image
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.files.atomic import write_json
from express50.files.calibration import write_cameras
from express50.files.images import write_image
from express50.shards.reader import ShardReader, write_offsets
from express50.shards.writer import PackedSample, ShardWriter, write_manifest

SHARD_BYTES = 256_000_000


def write_given_capture(
    dataset: Dataset, subject: str, expression: str, cameras: Sequence[str], folder: Path
) -> Path:
    """Write a capture of one frame set as some cameras saw it, undistorted."""
    shutil.rmtree(folder, ignore_errors=True)
    known = read_cameras_of(dataset, subject)
    for name in cameras:
        images = folder / "cameras" / name / "frames"
        images.mkdir(parents=True)
        write_image(images / "000000.png", read_peak_frame(dataset, subject, expression, name))
        plate = read_plate_image(dataset, subject, name)
        if plate is not None:
            (folder / "plates").mkdir(exist_ok=True)
            write_image(folder / "plates" / f"{name}.png", plate)
    write_cameras(folder / "calibration.json", {name: known[name] for name in cameras})
    meta = read_index(dataset, subject).meta | {"subject": subject}
    stated = {key: str(meta[key]) for key in ("subject", "consent_id", "licence") if key in meta}
    # In TOML, a text may be written as in JSON.
    lines = [f"{key} = {json.dumps(text, ensure_ascii=False)}" for key, text in stated.items()]
    (folder / "capture.toml").write_text("\n".join([*lines, "fps = 24", ""]), encoding="utf-8")
    rows = f"expression_id,start_frame,end_frame\n{expression},0,0\n"
    (folder / "cues.csv").write_text(rows)
    return folder


def join_shards(
    whole: Path, given: Path, subject: str, expression: str, cameras: Sequence[str], out: Path
) -> Path:
    """Pack a person's samples of the given cameras with those of the others, all on one track.

    The samples of ``cameras`` and the track are those of ``given``; the others' pictures and
    mattes, with which a fit is compared, are those of ``whole``.
    """
    shutil.rmtree(out, ignore_errors=True)
    own, rest = ShardReader(given), ShardReader(whole).select([subject], [expression])
    numbers = {own.entries[n].camera: n for n in range(len(own))}
    if missing := sorted(set(cameras) - set(numbers)):
        raise SystemExit(f"{given}: {', '.join(missing)} of {subject} could not be packed")
    track = own.meta(0)["track"] | {"registered": False}
    samples = []
    for number, entry in enumerate(rest.entries):
        reader, place = (own, numbers[entry.camera]) if entry.camera in cameras else (rest, number)
        members = dict(reader.members(place))
        meta = json.loads(members["meta.json"]) | {"track": track}
        members["meta.json"] = json.dumps(meta, sort_keys=True).encode()
        samples.append(PackedSample(subject, expression, entry.camera, members))
    writer = ShardWriter(out, SHARD_BYTES)
    writer.add_group("test", samples)
    writer.close()
    if track["offsets"]:
        write_offsets(out, subject, own.offsets(subject))
    write_json(out / "splits.json", {"test": [subject], "chosen_by": "the fit's given views"})
    write_manifest(out, writer.digests)
    return out


def given_shards(
    dataset: Dataset,
    subject: str,
    expression: str,
    cameras: Sequence[str],
    out: Path,
    settings: Path,
) -> Path:
    """Track a person from some cameras' pictures of one frame set; shards to fit and judge on.

    ``dataset`` is the whole, packed; ``settings`` is the TOML that it was made with.

    Raises:
        SystemExit: a stage fails.
    """
    capture = write_given_capture(dataset, subject, expression, cameras, out / "capture")
    own = Dataset(out / "data")
    shutil.rmtree(own.root, ignore_errors=True)
    command = ["run", str(own.root), str(capture), "--config", str(settings), "--workers", "0"]
    if express50([*command, "--set", "pack.test_fraction=0"]) != 0:
        raise SystemExit(f"{subject}: a stage failed on {', '.join(cameras)} alone")
    whole, given = (one.root / "pack" / "shards" for one in (dataset, own))
    return join_shards(whole, given, subject, expression, cameras, out / "shards")


def main() -> None:
    """Track from the given views, and say where the shards are."""
    parser = make_parser("given_views", __doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subject", required=True)
    parser.add_argument("--expression", default="neutral")
    parser.add_argument("--cameras", required=True, help="given, joined by commas")
    settings = Path(__file__).with_name("demo.toml")
    parser.add_argument("--settings", type=Path, default=settings, help="of the whole dataset")
    args = parser.parse_args()
    whole, cameras = Dataset(args.dataset), args.cameras.split(",")
    named = args.subject, args.expression, cameras
    print(given_shards(whole, *named, args.out, args.settings))


if __name__ == "__main__":
    main()
