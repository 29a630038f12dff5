"""The built-in head model, stored as arrays that `express50.head.generator` makes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch

from express50.errors import HeadModelError
from express50.files.arrays import read_arrays
from express50.head.model import HeadModel, check_head

BUILTIN = Path(__file__).with_name("builtin.npz")


@cache
def load_builtin() -> HeadModel:
    """Load the built-in head (float32, CPU). Callers share it and must not modify it."""
    arrays = read_arrays(BUILTIN, HeadModelError, "the built-in head", mend="reinstall express50")
    counts = arrays.pop("contour_counts")
    contour = np.split(arrays.pop("contour"), np.cumsum(counts)[:-1])
    names, masks = arrays.pop("region_names").tolist(), arrays.pop("regions")
    model = HeadModel(
        name="procedural",
        contour=tuple(torch.from_numpy(line) for line in contour),
        regions={name: torch.from_numpy(mask) for name, mask in zip(names, masks, strict=True)},
        shape_names=tuple(arrays.pop("shape_names").tolist()),
        expression_names=tuple(arrays.pop("expression_names").tolist()),
        **{name: torch.from_numpy(value) for name, value in arrays.items()},
    )
    return check_head(model)
