"""Head models: one type for FLAME, ICT-FaceKit and the built-in head.

This file is light: it names models and their files, without reading them.
"""

from __future__ import annotations

import os
from pathlib import Path

from express50.files.text import expanded

BUILTIN_NAME = "procedural"  # as commands and tracks name it; other head models are named by path
HEADS = "EXPRESS50_HEADS"  # environment variable: folders of head models, listed as in PATH
# FLAME's other files, which lie beside its pickle: the first name that is there counts.
COMPANIONS = {
    "embedding": ("landmark_embedding.npy", "landmark_embedding_with_eyes.npy",
                  "flame_static_embedding_68.pkl"),
    "masks": ("FLAME_masks.pkl",),
    "template": ("head_template_mesh.obj", "head_template.obj"),
}  # fmt: skip


def absolute_head(spec: str) -> str:
    """Return a head model's name or path such that it means the same in every folder."""
    # Links stay: a pickle may be one whose companions lie beside the link.
    return spec if spec == BUILTIN_NAME else os.path.normpath(expanded(spec).absolute())


def head_path(spec: str | Path) -> Path:
    """Return where a head model lies: at its path, or under the same name in ``EXPRESS50_HEADS``.

    Tracks, shards and checkpoints name a model by its path on the machine that made them. Where
    neither place has it, the path is returned.
    """
    path = expanded(spec)
    folders = [path.parent, *map(Path, filter(None, os.environ.get(HEADS, "").split(os.pathsep)))]
    places = (expanded(folder) / path.name for folder in folders)
    return next((place for place in places if place.exists()), path)


def head_files(spec: str) -> dict[str, Path]:
    """Return the files and folders that a head model is read from; none of the built-in head.

    The model's own path may not exist, its companions do.
    """
    if spec == BUILTIN_NAME:
        return {}
    path = head_path(spec)
    beside = companions(path) if path.suffix == ".pkl" else {}
    return {"head": path, **{f"head {kind}": file for kind, file in beside.items()}}


def companions(path: Path) -> dict[str, Path]:
    """Return those of a FLAME pickle's other files that are there."""
    files = {kind: [path.parent / name for name in names] for kind, names in COMPANIONS.items()}
    there = {kind: next(filter(Path.is_file, beside), None) for kind, beside in files.items()}
    return {kind: file for kind, file in there.items() if file is not None}
