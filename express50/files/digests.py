"""Content digests of files and folders; a file is hashed again only when size or time changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from express50.errors import StageError

CHUNK = 1 << 20


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def files_of(folder: Path) -> list[Path]:
    """Every file below a folder, sorted by relative path; hidden names are left out."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return sorted(
        path
        for path in found
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def path_digest(path: Path, sha256: Callable[[Path], str] = file_sha256) -> str:
    """Digest of a file's content, or of the names and contents of a folder's files.

    Args:
        path: file or folder.
        sha256: digest of one file; the ledger passes a cached one.

    Raises:
        StageError: there is nothing at the path.
    """
    if path.is_file():
        return sha256(path)
    if not path.is_dir():
        raise StageError(f"{path}: input is not there; run the stage that writes it first")
    lines = [f"{file.relative_to(path).as_posix()} {sha256(file)}" for file in files_of(path)]
    return text_digest("\n".join(lines))


def stat_digest(path: Path) -> str:
    """Digest of names, sizes and times of a file or a folder's files: cheap for terabytes."""
    if path.is_file():
        stat = path.stat()
        return text_digest(f"{path.name} {stat.st_size} {stat.st_mtime_ns}")
    lines = []
    for file in files_of(path):
        stat = file.stat()
        lines.append(f"{file.relative_to(path).as_posix()} {stat.st_size} {stat.st_mtime_ns}")
    return text_digest("\n".join(lines))


def text_digest(text: str) -> str:
    """SHA-256 of a text, hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def value_digest(value: object) -> str:
    """SHA-256 of a value's canonical JSON (tuples are lists, keys are sorted)."""
    return text_digest(json.dumps(value, sort_keys=True, ensure_ascii=False))
