"""Choose tracked heads to export, write them as OBJ, PLY or GLB, and publish each subject's folder.

Meshes are in the user's world frame, in metres. OBJ keeps the head model's vertices and their
order, with texture coordinates per corner; PLY keeps them with a colour per vertex; GLB repeats
vertices along the texture's seams, as glTF requires.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from express50.contract.layout import Dataset, exclusion_reason, included_subjects
from express50.dataset.tracks import (
    OF_FRAMES,
    HeadPoses,
    Track,
    existing_track,
    read_sequence,
    read_track,
    registration_of,
)
from express50.errors import FormatError, StageError, advised, check_known
from express50.files.atomic import dump_json, folder_in_one_step
from express50.files.digests import file_sha256
from express50.files.images import encode_png, read_image
from express50.geometry.conventions import corner_to_cell
from express50.geometry.meshes import encode_glb, split_seams, write_obj, write_ply
from express50.head.load import load_head
from express50.head.model import HeadModel, normals_of, pose

META = "export.json"
TEXTURE = "albedo.png"


@dataclass(frozen=True, kw_only=True, eq=False)
class Head:
    """Holds a subject's tracked head."""

    subject: str
    track: Track  # the chosen rows of the subject's track
    model: HeadModel  # the head model it was tracked with
    albedo: np.ndarray | None  # (H, W, 3) uint8 sRGB texture, if any, first row at v = 1

    def meta(self, kind: str) -> dict:
        """Make the part of ``export.json`` that all formats share."""
        return {
            "schema": "express50.export/1",
            "format": kind,
            "subject": self.subject,
            "head": self.model.name,
            "units": "metres",
        }


def tracked_subjects(dataset: Dataset, wanted: Sequence[str]) -> list[str]:
    """List the wanted subjects, or by default all that are tracked and not excluded.

    Raises:
        UnknownNameError: a wanted subject is not ingested.
        StageError: a wanted subject is excluded or not tracked, or no subject is tracked.
    """
    check_known(str(dataset.root), "subject", wanted, dataset.subjects())
    for name in wanted:
        if (reason := exclusion_reason(dataset, name)) is not None:
            raise StageError(f"{name}: excluded ({reason}), so it cannot be exported")
        existing_track(dataset, name)
    if wanted:
        return list(dict.fromkeys(wanted))
    found = [s for s in included_subjects(dataset) if dataset.track_file(s).is_file()]
    if not found:
        track = advised("express50 track", dataset.root)
        raise StageError(f"{dataset.root}: nothing is tracked; run {track} first")
    return found


def read_tracked(dataset: Dataset, subject: str, expressions: Sequence[str]) -> Head:
    """Read a subject's head with the wanted (by default all) expressions, in the track's order.

    Raises:
        UnknownNameError: a wanted expression is not tracked.
        StageError: the subject is not tracked.
        FormatError: the track is damaged or does not fit its head model.
        HeadModelError: the head model cannot be loaded.
    """
    path = existing_track(dataset, subject)
    track = read_track(path)
    check_known(subject, "tracked expression", expressions, track.expressions)
    model = load_head(track.head)
    counts = {
        "vertices": (track.vertices.shape[1], len(model.template)),
        "shape": (len(track.shape), model.shape_dirs.shape[2]),
        "expression": (track.expression.shape[1], model.expression_dirs.shape[2]),
    }
    for name, (got, there) in counts.items():
        if got > there or (name == "vertices" and got != there):
            raise FormatError(
                f"{path}: {got} {name}, its head model {model.name!r} has {there};"
                f" run {advised('express50 track', dataset.root)} again"
            )
    if expressions:
        names = tuple(name for name in track.expressions if name in expressions)
        rows = [track.row(name) for name in names]
        parts = {name: getattr(track, name)[rows] for name in (*OF_FRAMES, "vertices")}
        track = replace(track, expressions=names, **parts)
    return Head(subject=subject, track=track, model=model, albedo=read_albedo(path.parent))


def with_registered(dataset: Dataset, head: Head) -> Head:
    """Replace tracked meshes with registered ones where they exist.

    Raises:
        FormatError: a registration is damaged, or belongs to another track.
    """
    vertices, digest = head.track.vertices.copy(), file_sha256(dataset.track_file(head.subject))
    for row, expression in enumerate(head.track.expressions):
        path = dataset.registration_file(head.subject, expression)
        found = registration_of(path, head.track, digest)
        if found is not None:
            vertices[row] = found.vertices
    return replace(head, track=replace(head.track, vertices=vertices))


def with_clips(dataset: Dataset, head: Head, wanted: Sequence[str]) -> Head:
    """Replace a head's peaks with every tracked frame of its clips.

    Frames are named after their clip and number, such as ``smile_000123``; if clip ids are wanted,
    other clips are left out.

    Raises:
        StageError: no clip, or none of the wanted ones, is tracked.
        FormatError: the file is damaged, or its clips were tracked with another head model.
    """
    path = existing_track(dataset, head.subject).with_name("sequence.npz")
    clips, track = read_sequence(path), head.track
    if clips.head != track.head or len(clips.shape) != len(track.shape):
        raise FormatError(
            f"{path}: does not belong to the track beside it; run"
            f" {advised('express50 track', dataset.root)} again"
        )
    rows = [i for i, cue in enumerate(clips.cues) if not wanted or cue in wanted]
    if not rows:
        raise StageError(f"{path}: holds no frames of {', '.join(wanted) or 'any clip'}")
    own = {name: getattr(clips, name)[rows] for name in OF_FRAMES}
    names = tuple(f"{clips.cues[i]}_{clips.frames[i]:06d}" for i in rows)
    chosen = replace(clips, cues=tuple(clips.cues[i] for i in rows), **own)
    vertices = [v.astype(np.float32) for v in clip_vertices(head.model, track, chosen)]
    track = replace(track, expressions=names, vertices=np.stack(vertices), **own)
    return replace(head, track=track)


def clip_vertices(model: HeadModel, track: Track, clips: HeadPoses) -> Iterator[np.ndarray]:
    """Yield world vertices (V, 3) of each frame of clips, with the shape and offsets of a track.

    All frames together may not fit in memory.
    """
    model = model.to(dtype=torch.float64)

    def row(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float64))[None]

    shape, offsets = row(track.shape), row(track.offsets)
    for i, (R, t) in enumerate(zip(clips.R, clips.t, strict=True)):
        angles = {name: row(getattr(clips, name)[i]) for name in ("neck", "jaw", "eyes")}
        posed = pose(model, shape, row(clips.expression[i]), offsets=offsets, **angles)[0]
        yield posed.numpy() @ R.T + t


def read_albedo(folder: Path) -> np.ndarray | None:
    """Read the texture beside a track, if any; FormatError if it is not an 8-bit colour image."""
    path = folder / TEXTURE
    if not path.is_file():
        return None
    image = read_image(path)
    if image.ndim != 3 or image.dtype != np.uint8:
        raise FormatError(f"{path}: {image.dtype} {image.shape}, expected 8-bit RGB; track again")
    return np.ascontiguousarray(image[..., :3])


@contextmanager
def exporting(out: Path, subject: str) -> Iterator[Path]:
    """Yield an empty temporary folder; on a clean exit it becomes ``out/subject`` in one rename.

    An earlier export of the subject is replaced; what a killed run left behind is deleted.

    Raises:
        StageError: ``out/subject`` exists and is not an export.
    """
    target, aside = out / subject, out / f".{subject}.part"
    if target.exists() and not (target / META).is_file():
        raise StageError(
            f"{target}: exists but has no {META}, so it is not an export; choose another folder"
        )
    with folder_in_one_step(aside, target):
        yield aside


def export_meshes(head: Head, kind: str, out: Path) -> dict:
    """Write ``<expression>.<kind>`` for every expression to an empty folder; return the meta."""
    model, faces = head.model, head.model.faces.numpy()
    texture = None if head.albedo is None else TEXTURE
    if head.albedo is not None and kind == "obj":
        (out / TEXTURE).write_bytes(encode_png(head.albedo))
    for name, vertices in zip(head.track.expressions, head.track.vertices, strict=True):
        path = out / f"{name}.{kind}"
        if kind == "obj":
            write_head_obj(path, vertices, model, texture)
        elif kind == "ply":
            columns = {} if head.albedo is None else _vertex_colours(model, head.albedo)
            write_ply(path, vertices, faces, columns)
        else:
            places, uv_places, corners = split_seams(faces, model.uv_faces.numpy())
            glb = encode_glb(
                "head",
                vertices[places],
                corners,
                normals=normals_of(vertices, faces)[places],  # viewers show flat facets without
                uv=model.uv.numpy()[uv_places],
                baseColorTexture=None if head.albedo is None else Image.fromarray(head.albedo),
                baseColorFactor=[190 if head.albedo is None else 255] * 3 + [255],
            )
            path.write_bytes(glb)
    meta = head.meta(kind) | {
        "expressions": list(head.track.expressions),
        "frames": head.track.frames.tolist(),
        "textured": head.albedo is not None,
        "world_from_export": np.eye(4).tolist(),
    }
    (out / META).write_bytes(dump_json(meta))
    return meta


def write_head_obj(
    path: Path, vertices: np.ndarray, model: HeadModel, texture: str | None = None
) -> None:
    """Write vertices (V, 3) with the head model's faces and texture coordinates as OBJ."""
    faces, uv_faces = model.faces.numpy(), model.uv_faces.numpy()
    write_obj(path, vertices, faces, model.uv.double().numpy(), uv_faces, texture)


def _vertex_colours(model: HeadModel, albedo: np.ndarray) -> dict[str, np.ndarray]:
    """Sample the texture (H, W, 3) uint8 at the vertices: (V,) uint8 by channel name."""
    height, width = albedo.shape[:2]
    uv = np.zeros((len(model.template), 2))
    uv[model.faces.numpy().ravel()] = model.uv.numpy()[model.uv_faces.numpy().ravel()]
    places = corner_to_cell(np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], -1))
    column, row = np.rint(places).astype(int).T
    colours = albedo[row.clip(0, height - 1), column.clip(0, width - 1)]
    return {name: colours[:, k] for k, name in enumerate(("red", "green", "blue"))}
