"""The pack stage: one item, the shards of the whole dataset with splits, checksums and card."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from express50.cameras import Camera
from express50.errors import CaptureError, FormatError, StageError
from express50.exclusions import exclusion_reason
from express50.frames import read_cameras_of, read_frame, read_gains, read_peaks, read_plate
from express50.images import (
    DEPTH_UNIT_M,
    contact_sheet,
    depth_to_uint16,
    encode_jpeg,
    encode_png,
    read_depth_png,
    read_image,
    scale_light,
    write_image,
)
from express50.index import index_path, read_index
from express50.layout import Dataset
from express50.publish import write_json
from express50.shards import ShardReader
from express50.shards_write import PackedSample, ShardWriter, sample_key, write_manifest
from express50.stage import Stage
from pipelines.matte.foreground import own_colours
from pipelines.matte.plate import exposed, exposure_gain
from pipelines.pack.card import split_subjects, write_card
from pipelines.pack.config import PRESETS, PackConfig
from pipelines.pack.crop import Crop, crop_pinhole, cut_depth, cut_image, head_crop

PARAMETERS = ("expression", "neck", "jaw", "eyes", "R", "t")
QC_SAMPLES = 12


@dataclass(frozen=True)
class Subject:
    """What a subject's samples share: cameras, gains, peaks, tracks by expression, and meta."""

    name: str
    cameras: dict[str, Camera]
    gains: dict[str, np.ndarray]
    peaks: dict[str, int]
    labels: dict[str, dict]
    tracked: dict[str, dict]
    vertices: dict[str, np.ndarray]
    meta: dict


def items(dataset: Dataset) -> list[str]:
    """One item: everything."""
    return ["shards"] if dataset.subjects() else []


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Index, cameras, peaks, mattes, track and depth of every subject, as far as there."""
    found: dict[str, Path | str] = {}
    for subject in dataset.subjects():
        if (reason := exclusion_reason(dataset, subject)) is not None:
            found[f"{subject} excluded"] = reason
            continue
        found[f"{subject} index"] = index_path(dataset, subject)
        if config.foreground:
            index = read_index(dataset, subject)
            found |= {f"{subject} {c} plate": index.capture / p for c, p in index.plates.items()}
        parts = {
            "calibrate": dataset.item_dir("calibrate", subject) / "cameras.json",
            "gains": dataset.item_dir("calibrate", subject) / "gains.json",
            "align": dataset.item_dir("align", subject) / "peaks.json",
            "track": dataset.item_dir("track", subject) / "track.npz",
            "matte": dataset.item_dir("matte", subject),
            "depth": dataset.item_dir("depth", subject),
        }
        found |= {f"{subject} {name}": path for name, path in parts.items() if path.exists()}
    return found


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> dict:
    """Write shards, index, manifest, splits and card; returns what was read, kept and dropped."""
    cv2.setNumThreads(1)
    dropped: list[dict[str, str]] = []
    subjects = _read_subjects(dataset, dropped)
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
    people = [read_index(dataset, name).meta for name in packed]
    return _finish(out, splits, metas, people, read, dropped, config)


def _read_subjects(dataset: Dataset, dropped: list[dict[str, str]]) -> list[Subject]:
    subjects = []
    for name in dataset.subjects():
        if (reason := exclusion_reason(dataset, name)) is not None:
            dropped.append({"what": name, "why": f"excluded: {reason}"})
            continue
        try:
            subjects.append(_read_subject(dataset, name))
        except (StageError, FormatError, CaptureError) as error:
            dropped.append({"what": name, "why": str(error)})
    return subjects


def _read_subject(dataset: Dataset, name: str) -> Subject:
    """Everything that a subject's samples share.

    Raises:
        StageError: it is not calibrated, aligned or tracked.
        FormatError: one of these files is malformed.
    """
    index = read_index(dataset, name)
    peaks = read_peaks(dataset, name)
    labels = json.loads((dataset.item_dir("align", name) / "peaks.json").read_text("utf-8"))
    path = dataset.item_dir("track", name) / "track.npz"
    if not path.is_file():
        raise StageError(f"subject {name!r} is not tracked; run 'express50 track'")
    tracked, vertices, head = {}, {}, ""
    try:
        with np.load(path, allow_pickle=False) as table:
            head = str(table["head"])
            for row, expression in enumerate(table["expressions"].tolist()):
                arrays = {key: table[key][row].tolist() for key in PARAMETERS}
                tracked[expression] = arrays | {"shape": table["shape"].tolist()}
                vertices[expression] = table["vertices"][row].astype(np.float64)
    except (ValueError, KeyError, IndexError, OSError) as error:
        raise FormatError(f"{path}: not a track ({error}); run 'express50 track' again") from None
    bad = [one for one, points in vertices.items() if not np.isfinite(points).all()]
    if bad:
        raise FormatError(f"{path}: vertices of {', '.join(bad)} are not finite; track again")
    meta = {
        "subject": name,
        "head": head,
        "fps": index.fps,
        "consent": index.meta.get("consent_id", index.meta.get("consent")),
        "licence": index.meta.get("licence", index.meta.get("license")),
        "session": index.meta.get("session"),
    }
    cameras = read_cameras_of(dataset, name)
    gains = read_gains(dataset, name)
    return Subject(name, cameras, gains, peaks, labels, tracked, vertices, meta)


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
    camera, frame = subject.cameras[camera_id], subject.peaks[expression]
    matte_path = dataset.matte_file(subject.name, expression, camera_id)
    folder = dataset.item_dir("depth", f"{subject.name}/{expression}")
    if not matte_path.is_file():
        return "it has no matte"
    if not (folder / f"{camera_id}.png").is_file():
        return "it has no depth"
    rgb = read_frame(dataset, subject.name, camera_id, frame)
    alpha = read_image(matte_path)
    depth, valid = read_depth_png(folder / f"{camera_id}.png")
    if not rgb.shape[:2] == alpha.shape == depth.shape == (camera.height, camera.width):
        return f"frame {rgb.shape}, matte {alpha.shape} and depth {depth.shape} differ in size"
    if config.min_confidence > 0:
        sure = read_image(folder / f"{camera_id}_confidence.png")
        valid = valid & (sure >= round(255 * config.min_confidence))
    crop = head_crop(camera, subject.vertices[expression], alpha, config.margin, config.hair)
    if isinstance(crop, str):
        return crop
    picture, matte = cut_image(rgb, crop, config.size), cut_image(alpha, crop, config.size)
    if config.foreground:
        picture = own_colours(
            picture, matte, _behind(dataset, subject.name, camera_id, rgb, crop, config.size)
        )
    gain = subject.gains.get(camera_id, np.ones(3)) if config.even_colour else np.ones(3)
    if (gain != 1).any():
        picture = scale_light(picture, 1.0 / gain)
    small, known = cut_depth(depth, valid, crop, config.size)
    members = _encode_rgb(picture, config.profile)
    members["alpha.png"] = encode_png(matte)
    members["depth.png"] = encode_png(depth_to_uint16(small, known))
    view = crop_pinhole(camera, crop, config.size)
    meta = subject.meta | {
        "K": view.K.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "camera": camera_id,
        "colour_gain": gain.tolist(),
        "crop": {"x0": crop.x0, "y0": crop.y0, "side": crop.side},
        "depth_scale_m": DEPTH_UNIT_M,
        "expression": expression,
        "frame": frame,
        "height": config.size,
        "label": subject.labels[expression],
        "source_size": [camera.width, camera.height],
        "track": subject.tracked[expression],
        "width": config.size,
    }
    text = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False)
    members["meta.json"] = text.encode()
    return PackedSample(subject.name, expression, camera_id, members), meta


def _behind(
    dataset: Dataset, subject: str, camera_id: str, frame: np.ndarray, crop: Crop, size: int
) -> np.ndarray | None:
    """The crop of the camera's own plate as the frame exposes it, in 8-bit steps; None without."""
    plate = _plate(dataset, subject, camera_id)
    if plate is None:
        return None
    return exposed(cut_image(plate, crop, size), exposure_gain(frame, plate))


@lru_cache(maxsize=32)  # 25 MB each at 4K; every expression asks for those of all cameras
def _plate(dataset: Dataset, subject: str, camera_id: str) -> np.ndarray | None:
    return read_plate(dataset, subject, camera_id)


def _encode_rgb(image: np.ndarray, profile: str) -> dict[str, bytes]:
    if profile == "lossless":
        return {"rgb.png": encode_png(image)}
    return {"rgb.jpg": encode_jpeg(image, 90 if profile == "compact" else 95)}


def _finish(
    out: Path,
    splits: dict[str, list[str]],
    metas: list[dict],
    people: list[dict],
    read: int,
    dropped: list[dict[str, str]],
    config: PackConfig,
) -> dict:
    """Write splits, card, picture and manifest; returns the metrics."""
    reader = ShardReader(out)
    how = "named" if config.test_subjects else f"hash of seed {config.seed}"
    write_json(out / "splits.json", splits | {"chosen_by": how})
    shards = sorted({entry.shard for entry in reader.entries})
    size = sum((out / shard).stat().st_size for shard in shards)
    statistics = {
        "picture size": f"{config.size} x {config.size}",
        "profile": config.profile,
        "shards": f"{len(shards)}, {size / 1e6:.1f} MB",
    }
    card = write_card(splits, metas, dropped, statistics, people)
    (out / "card.md").write_text(card, encoding="utf-8")
    covered = _write_picture(out, reader)
    write_manifest(out)
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
        "dropped": dropped,
    }


def _write_picture(out: Path, reader: ShardReader) -> float:
    """Contact sheet of evenly chosen samples; returns the share of their mattes with depth."""
    rows: list[list[np.ndarray]] = [[], [], []]
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
    reader.close()
    (out / "qc").mkdir(exist_ok=True)
    sheet = contact_sheet(rows, ["rgb", "alpha", "depth"], tile=(160, 160))
    write_image(out / "qc" / "samples.jpg", sheet, quality=90)
    return round(float(np.mean(covered)), 4)


STAGE = Stage(
    name="pack",
    version=4,
    config=PackConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
)
