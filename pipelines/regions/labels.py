"""The labels of a head model's vertices, from its regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from express50.contract.segmentation_labels import LABELS
from express50.head.model import HeadModel

SCALP = len(LABELS)
"""Skin that may bear hair: a label of the mesh alone, never written."""

# Later rows win: lids and lips are skin to some models, teeth are mouth to others.
_REGIONS = (
    ("neck", ("neck", "boundary")),
    ("skin", ("face", "forehead", "nose", "left_eye_region", "right_eye_region")),
    ("ears", ("left_ear", "right_ear")),
    ("lips", ("lips",)),
    ("mouth", ("mouth_interior",)),
    ("tongue", ("tongue",)),
    ("teeth", ("teeth", "upper_teeth", "lower_teeth")),
    ("eyes", ("left_eyeball", "right_eyeball")),
)


@dataclass(frozen=True)
class HeadLabels:
    """A head model as labels.

    Attributes:
        faces: (F, 3) that are seen; sheets that belong to no region (lash cards) are left out.
        vertices: (V,) uint8 indices into LABELS, or SCALP.
        end: (n,) indices of the vertices around the neck's lower end; none where unknown.
        missing: names of LABELS that the model cannot give.
    """

    faces: np.ndarray
    vertices: np.ndarray
    end: np.ndarray
    missing: tuple[str, ...]


def head_labels(model: HeadModel) -> HeadLabels:
    """Labels of a model's vertices, from its regions; what lacks one is skin."""
    masks = {name: mask.cpu().numpy() for name, mask in model.regions.items()}
    none = np.zeros(len(model.template), bool)
    scalp = masks.get("scalp", none)
    labels = np.where(scalp, SCALP, LABELS.index("skin")).astype(np.uint8)
    for label, names in _REGIONS:
        for name in names:
            labels[masks.get(name, none)] = LABELS.index(label)
    faces = model.faces.cpu().numpy()
    there = set(np.unique(labels[faces]).tolist()) | {LABELS.index("background")}
    by_mesh = [label for label, _ in _REGIONS if LABELS.index(label) not in there]
    end = np.flatnonzero(masks.get("boundary", none))
    missing = [*by_mesh, *(["torso"] if len(end) < 3 else [])]
    named = np.any(list(masks.values()), axis=0) if masks else ~none
    return HeadLabels(faces[_named_sheets(faces, named)], labels, end, tuple(missing))


def _named_sheets(faces: np.ndarray, named: np.ndarray) -> np.ndarray:
    """Faces (F,) bool of the connected sheets that hold a vertex of a region."""
    count = len(named)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), np.int8), edges.T), shape=(count, count))
    _, sheet = connected_components(graph, directed=False)
    kept = np.zeros(sheet.max() + 1, bool)
    kept[sheet[named]] = True
    return kept[sheet[faces[:, 0]]]
