"""The pack stage: one item, the shards of the whole dataset with splits, checksums and card."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import read_peak_frame
from express50.capture.index import index_path
from express50.capture.readers.read import read_people
from express50.contract.exclusions import exclusion_reason
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import COLOURS
from express50.dataset.depth_files import depth_file, read_depth
from express50.errors import CaptureError, FormatError, StageError
from express50.files.atomic import write_json
from express50.files.images import (
    DEPTH_LIMIT_M,
    DEPTH_UNIT_M,
    contact_sheet,
    depth_to_uint16,
    read_alpha,
    read_image,
    write_image,
)
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera
from express50.shards.codecs import encode_pictures
from express50.shards.reader import ShardReader, write_offsets
from express50.shards.writer import PackedSample, ShardWriter, sample_key, write_manifest
from pipelines.pack.card import people_lines, split_subjects, write_card
from pipelines.pack.colour import evened, own_picture
from pipelines.pack.config import PackConfig
from pipelines.pack.crop import Crop, crop_pinhole, cut_depth, cut_image, cut_labels, head_crop
from pipelines.pack.subject import Subject, read_subjects

QC_SAMPLES = 12


def items(dataset: Dataset) -> list[str]:
    """One item: everything."""
    return ["shards"] if dataset.subjects() else []


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Index, cameras, peaks, mattes, track, depth and regions of every subject, as far as there."""
    found: dict[str, Path | str] = {}
    for subject in dataset.subjects():
        if (reason := exclusion_reason(dataset, subject)) is not None:
            found[f"{subject} excluded"] = reason
            continue
        found[f"{subject} index"] = index_path(dataset, subject)
        parts = {
            "frames": dataset.item_dir("frames", subject),
            "calibrate": dataset.item_dir("calibrate", subject) / "cameras.json",
            "gains": dataset.item_dir("calibrate", subject) / "gains.json",
            "align": dataset.item_dir("align", subject) / "peaks.json",
            "track": dataset.item_dir("track", subject) / "track.npz",
            "matte": dataset.item_dir("matte", subject),
            "depth": dataset.item_dir("depth", subject),
            "regions": dataset.item_dir("regions", subject),
        }
        found |= {f"{subject} {name}": path for name, path in parts.items() if path.exists()}
    # As they would stand on the card: of fewer people than may be counted nothing is kept.
    included = [s for s in dataset.subjects() if f"{s} index" in found]
    return found | {"people": "\n".join(people_lines(read_people(dataset, included)))}


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> dict:
    """Write shards, index, manifest, splits and card; returns what was read, kept and dropped."""
    cv2.setNumThreads(1)
    dropped: list[dict[str, str]] = []
    subjects = read_subjects(dataset, dropped)
    read = len(dropped)
    if not subjects:
        why = "; ".join(f"{row['what']}: {row['why']}" for row in dropped[:3])
        raise StageError(f"{item}: no subject can be packed ({why}); run the earlier stages")
    splits = split_subjects(
        [subject.name for subject in subjects],
        config.test_subjects,
        config.test_fraction,
        config.seed,
    )
    writer = ShardWriter(out, config.shard_mb * 10**6)
    metas: list[dict] = []
    for split, names in splits.items():
        for subject in (one for one in subjects if one.name in names):
            for expression in sorted(subject.peaks):
                before = len(dropped)
                group = _pack_group(dataset, subject, expression, config, dropped)
                read += len(group) + len(dropped) - before
                if group:
                    writer.add_group(split, [sample for sample, _ in group])
                metas += [meta | {"split": split} for _, meta in group]
    writer.close()
    if not metas:
        why = "; ".join(sorted({row["why"] for row in dropped})[:3])
        raise StageError(f"{item}: none of {read} samples can be packed ({why})")
    packed = sorted({meta["subject"] for meta in metas})
    for subject in subjects:
        if subject.offsets is not None and subject.name in packed:
            write_offsets(out, subject.name, subject.offsets)
    people = read_people(dataset, packed)
    metrics = _finish(out, splits, metas, people, read, dropped, config)
    write_manifest(out, writer.digests)
    return metrics


def _pack_group(
    dataset: Dataset,
    subject: Subject,
    expression: str,
    config: PackConfig,
    dropped: list[dict[str, str]],
) -> list[tuple[PackedSample, dict]]:
    """Samples of all cameras of one expression; those that cannot be packed go to ``dropped``."""
    group = []
    for camera_id in sorted(subject.cameras):
        try:
            sample_key(subject.name, expression, camera_id)
            sample = _pack_sample(dataset, subject, expression, camera_id, config)
        except (CaptureError, FormatError, StageError) as error:
            sample = str(error)
        if isinstance(sample, str):
            dropped.append({"what": f"{subject.name}/{expression}/{camera_id}", "why": sample})
        else:
            group.append(sample)
    return group


def _pack_sample(
    dataset: Dataset, subject: Subject, expression: str, camera_id: str, config: PackConfig
) -> tuple[PackedSample, dict] | str:
    """One encoded sample and its meta, or the reason why there is none."""
    if expression not in subject.tracked:
        return "it is not tracked"
    camera = subject.cameras[camera_id]
    matte_path = dataset.matte_file(subject.name, expression, camera_id)
    folder = dataset.item_dir("depth", f"{subject.name}/{expression}")
    if not matte_path.is_file():
        return "it has no matte"
    if (depth_path := depth_file(folder, camera_id)) is None:
        return "it has no depth"
    rgb = read_peak_frame(dataset, subject.name, expression, camera_id)
    matte = alpha = read_alpha(matte_path)
    depth, valid = read_depth(depth_path)
    regions = _read_regions(dataset, f"{subject.name}/{expression}", camera_id)
    parts, head = regions or (None, None)
    sizes = [image.shape[:2] for image in (rgb, alpha, depth, parts, head) if image is not None]
    if set(sizes) != {(camera.height, camera.width)}:
        return f"frame, matte, depth and regions differ in size: {', '.join(map(str, sizes))}"
    if head is not None and config.torso == "remove":
        # No depth where no colour counts: what is left of the torso would bend the head.
        alpha, valid = head, valid & (head > 127)
    if config.min_confidence > 0:
        sure = read_image(folder / f"{camera_id}_confidence.png")
        valid = valid & (sure >= round(255 * config.min_confidence))
    crop = head_crop(camera, subject.vertices[expression], alpha, config.margin, config.hair)
    if isinstance(crop, str):
        return crop
    small, known = cut_depth(depth, valid, crop, config.size)
    if (farthest := small[known].max(initial=0)) >= DEPTH_LIMIT_M:
        return f"its depth reaches {farthest:.2f} m; shards hold less than {DEPTH_LIMIT_M:.2f} m"
    if config.foreground:
        place = (subject.name, camera_id)
        picture = own_picture(dataset, place, rgb, matte, crop, config.size)
    else:
        picture = cut_image(rgb, crop, config.size)
    gain = subject.gains.get(camera_id, np.ones(3)) if config.even_colour else np.ones(3)
    members = encode_pictures(
        evened(picture, gain),
        cut_image(alpha, crop, config.size),
        depth_to_uint16(small, known),
        None if parts is None else cut_labels(parts, crop, config.size),
        config.profile,
    )
    meta = _meta(subject, expression, camera, crop, config.size) | {
        "colour_gain": gain.tolist(),
        "parts": parts is not None,
        "torso": "removed" if head is not None and config.torso == "remove" else "kept",
    }
    text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    members["meta.json"] = text.encode()
    return PackedSample(subject.name, expression, camera_id, members), meta


def _meta(subject: Subject, expression: str, camera: Camera, crop: Crop, size: int) -> dict:
    """What a sample of this size says of its subject, its camera and its crop."""
    return subject.meta | {
        "K": crop_pinhole(camera, crop, size).K.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "camera": camera.id,
        "crop": {"x0": crop.x0, "y0": crop.y0, "side": crop.side},
        "depth_scale_m": DEPTH_UNIT_M,
        "expression": expression,
        "frame": subject.peaks[expression],
        "height": size,
        "label": subject.labels[expression],
        "source_size": [camera.width, camera.height],
        "track": subject.tracked[expression],
        "width": size,
    }


def _read_regions(
    dataset: Dataset, item: str, camera_id: str
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Labels (H, W) uint8 of the parts and the head's own alpha (H, W) uint8, if there are any.

    The head's is None where nothing told it from the torso.

    Raises:
        FormatError: one of them is no 8-bit grey image.
    """
    folder = dataset.item_dir("regions", item)
    paths = folder / f"{camera_id}.png", folder / f"{camera_id}_head.png"
    if not all(path.is_file() for path in paths):
        return None
    facts = read_json_table(folder / "metrics.json", FormatError)
    kept = "torso" in facts["missing"] and facts["method"] == "mesh"
    return read_alpha(paths[0]), None if kept else read_alpha(paths[1])


def _finish(
    out: Path,
    splits: dict[str, list[str]],
    metas: list[dict],
    people: list[dict],
    read: int,
    dropped: list[dict[str, str]],
    config: PackConfig,
) -> dict:
    """Write splits, card and picture; returns the metrics."""
    reader = ShardReader(out)
    bare = sum(meta["torso"] == "removed" for meta in metas)
    lacking = [meta for meta in metas if not meta["parts"]]
    how = "named" if config.test_subjects else f"hash of seed {config.seed}"
    write_json(out / "splits.json", splits | {"chosen_by": how})
    shards = sorted({entry.shard for entry in reader.entries})
    size = sum((out / shard).stat().st_size for shard in shards)
    statistics = {
        "picture size": f"{config.size} x {config.size}",
        "profile": config.profile,
        "labels of parts": f"{sum(meta['parts'] for meta in metas)} of {len(metas)} samples",
        "torso removed": f"{bare} of {len(metas)} samples",
        "shards": f"{len(shards)}, {size / 1e6:.1f} MB",
    }
    card = write_card(splits, metas, dropped, statistics, people)
    (out / "card.md").write_text(card, encoding="utf-8")
    covered = _write_picture(out, reader)
    return {
        "read": read,
        "kept": len(metas),
        "shards": len(shards),
        "bytes": size,
        "bytes_a_sample": round(size / len(metas)),
        "samples_by_split": {
            split: sum(meta["split"] == split for meta in metas) for split in splits
        },
        "depth_coverage": covered,
        "with_parts": len(metas) - len(lacking),
        "torso_removed": bare,
        "warnings": [*_lacking_warning(lacking, len(metas)), *_unstated(metas)],
        "dropped": dropped,
    }


def _lacking_warning(lacking: list[dict], count: int) -> list[dict[str, str]]:
    """A warning of samples that the regions stage knows nothing of."""
    if not lacking:
        return []
    why = (
        f"{len(lacking)} of {count} samples have no labels of parts, and their alpha holds the"
        " torso; run 'express50 regions', then pack again"
    )
    return [{"what": "regions", "why": why}]


def _unstated(metas: list[dict]) -> list[dict[str, str]]:
    """A warning for each subject whose samples carry no consent id or no licence."""
    keys = {"consent": "consent_id", "licence": "licence"}
    lacking = {
        name: [keys[key] for key in keys if meta[key] is None]
        for name, meta in ((meta["subject"], meta) for meta in metas)
    }
    return [
        {"what": name, "why": f"capture.toml gives no {' and no '.join(what)}; its samples lack it"}
        for name, what in sorted(lacking.items())
        if what
    ]


def _write_picture(out: Path, reader: ShardReader) -> float:
    """Contact sheet of evenly chosen samples; returns the share of their mattes with depth."""
    rows: list[list[np.ndarray]] = [[], [], [], []]
    covered = []
    for number in np.unique(np.linspace(0, len(reader) - 1, QC_SAMPLES).astype(int)):
        sample = reader.sample(int(number))
        inside = sample["alpha"] > 0.5
        covered.append(float(sample["valid"][inside].mean()) if inside.any() else 0.0)
        depth, valid = sample["depth"], sample["valid"]
        low, high = np.percentile(depth[valid], [1, 99]) if valid.any() else (0.0, 1.0)
        near = np.clip((high - depth) / max(float(high - low), 1e-6), 0, 1)
        rows[0].append(sample["rgb"])
        rows[1].append((sample["alpha"] * 255).astype(np.uint8))
        rows[2].append(np.where(valid, 55 + 200 * near, 0).astype(np.uint8))
        blank = np.zeros(valid.shape, np.uint8)
        rows[3].append(COLOURS[blank if sample["parts"] is None else sample["parts"]])
    reader.close()
    (out / "qc").mkdir(exist_ok=True)
    sheet = contact_sheet(rows, ["rgb", "alpha", "depth", "parts"], tile=(160, 160))
    write_image(out / "qc" / "samples.jpg", sheet, quality=90)
    return round(float(np.mean(covered)), 4)
