"""Digest files and folders, and cache what was read from a file until the file changes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

from express50.errors import StageError

T = TypeVar("T")


def cached_by_file(size: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Cache the last `size` results of a function of a path until the file there changes.

    The function's first argument is a path, or has a method `__fspath__`; all arguments are
    hashable. A file counts as changed when its size, time of change or inode differs.

    Raises:
        OSError: when the function is called and the path cannot be examined.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        @lru_cache(maxsize=size)
        def read(version: FileVersion, path: Path, *arguments: Any) -> T:  # noqa: ARG001
            return function(path, *arguments)

        @wraps(function)
        def look(path: Path, *arguments: Any) -> T:
            return read(file_version(path), path, *arguments)

        return look

    return decorate


FileVersion = tuple[int, int, int]


def file_version(path: Path) -> FileVersion:
    """Return size, time of change (ns) and inode: they change whenever the bytes do."""
    stat = Path(path).stat()
    return stat.st_size, stat.st_mtime_ns, stat.st_ino


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_of(folder: Path) -> list[Path]:
    """List every file below a folder, sorted by relative path, without hidden names."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return sorted(
        path
        for path in found
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def path_digest(path: Path, sha256: Callable[[Path], str] = file_sha256) -> str:
    """Digest a file's content, or the names and contents of a folder's files.

    ``sha256`` digests one file; the ledger passes one that remembers.

    Raises:
        StageError: the path does not exist.
    """
    if path.is_file():
        return sha256(path)
    if not path.is_dir():
        raise StageError(f"{path}: input is missing; run the stage that writes it first")
    lines = [f"{file.relative_to(path).as_posix()} {sha256(file)}" for file in files_of(path)]
    return text_digest("\n".join(lines))


def stat_digest(path: Path) -> str:
    """Digest names, sizes and times of a file or a folder's files: cheap for terabytes."""
    root, files = (path.parent, [path]) if path.is_file() else (path, files_of(path))
    lines = []
    for file in files:
        size, time, _ = file_version(file)
        lines.append(f"{file.relative_to(root).as_posix()} {size} {time}")
    return text_digest("\n".join(lines))


def text_digest(text: str) -> str:
    """Return the SHA-256 of a text, hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def value_digest(value: object) -> str:
    """Return the SHA-256 of a value's canonical JSON (tuples are lists, keys are sorted)."""
    return text_digest(json.dumps(value, sort_keys=True, ensure_ascii=False))
