"""Load a head model by name or path."""

from __future__ import annotations

from pathlib import Path

from express50.errors import HeadModelError
from express50.head.model import HeadModel

_KINDS = (
    '"procedural", a FLAME .pkl, an ICT-FaceKit checkout, an .npz of its arrays, or a stored head'
    " model"
)


def load_head(spec: str | Path) -> HeadModel:
    """Load a head model.

    Args:
        spec: "procedural" for the built-in head, else a path: `*.pkl` is the user's FLAME model
            (its landmark embedding and masks are looked for beside it), a folder is a checkout of
            ICT-FaceKit, `*.npz` holds ICT-FaceKit's arrays or a head model of your own
            (docs/RECIPES.md).

    Raises:
        HeadModelError: unknown name, missing file or damaged content.
    """
    if str(spec) == "procedural":
        from express50.head.builtin import load_builtin

        return load_builtin()
    path = Path(spec).expanduser()
    if not path.exists():
        raise HeadModelError(f"head model {str(spec)!r}: no such file or folder; expected {_KINDS}")
    if path.suffix == ".npz":
        from express50.head.builtin import is_stored, load_stored

        if is_stored(path):
            return load_stored(path, path.stem)
    if path.is_dir() or path.suffix == ".npz":
        from express50.head.ict import load_ict

        return load_ict(path)
    if path.suffix == ".pkl":
        from express50.head.flame import load_flame

        return load_flame(path)
    raise HeadModelError(f"head model {str(spec)!r}: unknown kind of file; expected {_KINDS}")
