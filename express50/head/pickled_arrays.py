"""Dense arrays of numbers out of what a pickle held."""

from __future__ import annotations

import numpy as np

from express50.errors import HeadModelError
from express50.files.pickles import VALUES_LIMIT, ChumpyArray, CscMatrix, SparseMatrix
from express50.files.text import reason


def to_array(value: object, name: str, where: str) -> np.ndarray:
    """A dense numeric array of what a pickle held: array, chumpy, sparse matrix or list."""
    for _ in range(8):  # one may hold another; a loop of them holds nothing
        if isinstance(value, ChumpyArray):
            value = next((value.state[key] for key in ("x", "a", "v") if key in value.state), None)
    if isinstance(value, SparseMatrix):
        return _densify(value, name, where)
    if _count(value, 0) > VALUES_LIMIT:
        raise HeadModelError(f"{where}: {name} holds over {VALUES_LIMIT} numbers in lists")
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise HeadModelError(f"{where}: {name} is not an array: {reason(error)}") from error
    if array.dtype.kind not in "fiub":
        raise HeadModelError(f"{where}: {name} holds {array.dtype}, expected numbers")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise HeadModelError(f"{where}: {name} holds NaN or Inf, expected finite numbers")
    return array


def _densify(matrix: SparseMatrix, name: str, where: str) -> np.ndarray:
    """Dense (rows, columns) of a compressed sparse matrix, bounds checked."""
    state = matrix.state
    shape = state.get("_shape", state.get("shape"))
    if not isinstance(shape, tuple) or any(
        key not in state for key in ("data", "indices", "indptr")
    ):
        raise HeadModelError(f"{where}: {name} is a sparse matrix without its parts")
    data, indices, pointers = (
        to_array(state[key], f"{name}.{key}", where) for key in ("data", "indices", "indptr")
    )
    if len(shape) != 2 or not all(type(n) is int and n >= 0 for n in shape):
        raise HeadModelError(f"{where}: {name} is a sparse matrix of shape {shape}")
    if {indices.dtype.kind, pointers.dtype.kind} - set("iu"):
        raise HeadModelError(f"{where}: {name} is a sparse matrix with indices that are none")
    rows, columns = shape
    pointers = pointers.astype(np.int64)
    major = columns if isinstance(matrix, CscMatrix) else rows
    minor = rows if isinstance(matrix, CscMatrix) else columns
    damaged = rows * columns > VALUES_LIMIT or pointers.shape != (major + 1,)
    if damaged or (np.diff(pointers) < 0).any() or pointers[-1] - pointers[0] != data.size:
        raise HeadModelError(f"{where}: {name} is a damaged sparse matrix of shape {shape}")
    owner = np.repeat(np.arange(major), np.diff(pointers))
    if (
        owner.size != data.size
        or indices.shape != data.shape
        or (data.size and not 0 <= indices.min() <= indices.max() < minor)
    ):
        raise HeadModelError(f"{where}: {name} is a damaged sparse matrix of shape {shape}")
    dense = np.zeros((major, minor))
    np.add.at(dense, (owner, indices), data)
    return dense.T if isinstance(matrix, CscMatrix) else dense


def _count(value: object, depth: int) -> int:
    """Numbers in lists within lists; one list in many places counts as many times."""
    if not isinstance(value, list | tuple) or not value:
        return 1
    if depth > 4:
        return VALUES_LIMIT + 1
    if not any(isinstance(one, list | tuple) for one in value):
        return len(value)
    total = 0
    for one in value:
        total += _count(one, depth + 1)
        if total > VALUES_LIMIT:
            break
    return total
