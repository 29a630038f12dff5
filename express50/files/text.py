"""Read text, JSON, TOML, YAML and XML files, with errors that name the file and the line.

Files must be regular and have at most ``TEXT_LIMIT`` bytes. In JSON and TOML, repeated keys and
numbers that are not finite are refused; YAML and XML values stay text, and references that could
grow without bound or name other files are refused.
"""

from __future__ import annotations

import codecs
import csv
import errno
import io
import json
import math
import os
import re
import stat
import struct
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeGuard
from xml.etree import ElementTree

import yaml

from express50.errors import CaptureError, Express50Error

TEXT_LIMIT = 1 << 28  # bytes; the index of 100,000 samples takes 40 MB
TOML_LIMIT = 1 << 20  # bytes; these files are written by hand
YAML_LIMIT, YAML_LEVELS = 1 << 18, 16  # bytes (that many take seconds to parse), levels of nesting
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,199}")
"""Pattern of a name that may become a file or folder."""
ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,119}")
"""Pattern of a subject's or expression's id: a file name without a dot, as shard keys require."""
KEY_LENGTH = 80  # characters of a sample's key, ``subject_expression_camera``
AGAIN = "copy or write it again"
NOT_PERMITTED = "cannot be read (Permission denied); check its owner and permissions"
POINTERS = (
    (b"version https://git-lfs", "Git LFS", "git lfs pull"),
    (b"/annex/objects/", "git-annex", "git annex get FOLDER"),
)

# What code and libraries raise on values of another type or shape than they expect.
MALFORMED = (
    ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError, csv.Error,
    struct.error,
)  # fmt: skip

Kind = type[Express50Error]


def identifier(text: str, other: str = "_-") -> str:
    """Make an id of any text: ``_`` replaces everything but letters, digits and ``other``."""
    clean = re.sub(rf"[^A-Za-z0-9{re.escape(other)}]+", "_", text).strip("_-")
    return clean or "unnamed"


def read_bytes(path: Path, kind: Kind, limit: int = TEXT_LIMIT, fix: str = AGAIN) -> bytes:
    """Read the bytes of a regular file.

    Raises:
        Express50Error: of the given kind: the file is missing, not regular, unreadable, or larger
            than ``limit``.
    """
    path = Path(path)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise kind(f"{path}: {no_file(path)}")
        if status.st_size > limit:
            raise kind(f"{path}: {status.st_size} bytes, expected at most {limit}; {fix}")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        why = NOT_PERMITTED if isinstance(error, PermissionError) else unreadable(path)
        raise kind(f"{path}: {why or f'cannot be read ({reason(error)}); {fix}'}") from None


def no_folder(path: Path) -> str:
    """Say why a path is not a folder: nothing is there, or a file."""
    return "is a file, not a folder" if path.exists() else "no such folder"


def no_file(path: Path) -> str:
    """Say why a path is not a file: nothing is there, or a folder, a pipe or a device."""
    if path.is_dir():
        return "is a folder, not a file"
    return "is a pipe or device, not a file" if path.exists() else "no such file"


def open_file(path: Path) -> io.BufferedReader:
    """Open a file to read it; a pipe or device in its place could keep its readers waiting.

    Raises:
        OSError: it is one, or cannot be opened.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, no_file(path), str(path))
    return path.open("rb")


def expanded(path: str | Path) -> Path:
    """Return a path with the home folder in place of ``~``; unchanged if that user is unknown."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def unreadable(path: Path) -> str:
    """Return why a file or folder that is there cannot be read, and what to do; "" if it can.

    It may need permissions, or a file may lack its content: git-annex keeps links to contents that
    are fetched one by one. It and Git LFS also write small files that only name the content.
    """
    try:
        if path.is_symlink() and not path.exists():
            return (
                f"is a link to {path.readlink()}, which is not there; fetch it (of git-annex or"
                " DataLad: 'git annex get FOLDER'), or copy the file itself"
            )
        if path.is_dir():
            return "" if os.access(path, os.R_OK | os.X_OK) else NOT_PERMITTED
        if path.exists() and not path.is_file():
            return no_file(path)
        with path.open("rb") as file:
            start = file.read(64)
    except PermissionError:
        return NOT_PERMITTED
    except (OSError, ValueError):
        return ""
    for mark, name, fetch in POINTERS:
        if start.startswith(mark):
            return f"is a placeholder of {name}, not the content; fetch it ('{fetch}')"
    return ""


def check_readable(*paths: Path) -> None:
    """Raise CaptureError for paths that are there, but `unreadable`: they would pass for absent."""
    for path in paths:
        if why := unreadable(path):
            raise CaptureError(f"{path}: {why}")


def is_given(path: Path) -> bool:
    """Return whether an optional file is there.

    Raises:
        CaptureError: it is unreadable, a folder or a pipe.
    """
    check_readable(path)
    if path.is_dir():
        raise CaptureError(f"{path}: is a folder, expected a file; put the file in its place")
    return path.exists()


def read_text(path: Path, kind: Kind, limit: int = TEXT_LIMIT, fix: str = AGAIN) -> str:
    """Read a file as UTF-8, dropping a byte order mark; line ends become newlines.

    Raises:
        Express50Error: as for `read_bytes`, or the file is not UTF-8.
    """
    data = read_bytes(path, kind, limit, fix)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise kind(f"{path}: is UTF-16 text; save it as UTF-8") from None
        raise kind(f"{path}: not UTF-8 text ({reason(error)}); {fix}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def csv_table(text: str, **options: Any) -> csv.DictReader:
    """Read CSV text with a header; spreadsheets in many countries write semicolons or tabs."""
    between = max(",;\t", key=text.partition("\n")[0].count)
    return csv.DictReader(io.StringIO(text, newline=""), delimiter=between, **options)


def read_json(path: Path, kind: Kind, fix: str = AGAIN) -> Any:
    """Read a JSON file; errors are those of `read_text` and `parse_json`."""
    return parse_json(read_text(path, kind, fix=fix), str(path), kind, fix)


def read_json_table(path: Path, kind: Kind, fix: str = AGAIN) -> dict[str, Any]:
    """Read a JSON file that must hold a table; other errors are those of `read_json`."""
    table = read_json(path, kind, fix)
    if not isinstance(table, dict):
        raise kind(f"{path}: expected a JSON table, got {type(table).__name__}; {fix}")
    return table


def parse_json(text: str | bytes, where: str, kind: Kind, fix: str = AGAIN) -> Any:
    """Parse JSON text.

    Raises:
        Express50Error: it is not JSON, is nested too deeply, repeats a key, or has a number that is
            NaN, infinite or thousands of digits long.
    """
    try:
        return json.loads(
            text, parse_constant=_finite, parse_float=_finite, object_pairs_hook=_once
        )
    except NotFiniteError as error:
        raise kind(f"{where}: {error.located(text)}; {fix}") from None
    except (ValueError, RecursionError) as error:
        raise kind(f"{where}: not JSON ({reason(error)}); {fix}") from None


def read_toml(path: Path, kind: Kind) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        Express50Error: as for `read_text`, or the file is not TOML, is nested too deeply, or holds
            a number that is NaN or infinite.
    """
    text = read_text(path, kind, TOML_LIMIT)
    try:
        return tomllib.loads(text, parse_float=_finite)
    except NotFiniteError as error:
        raise kind(f"{path}: {error.located(text)}; correct it") from None
    except (ValueError, RecursionError) as error:
        raise kind(f"{path}: not TOML: {reason(error)}; correct it") from None


def read_yaml(path: Path, kind: Kind) -> Any:
    """Read a YAML file whose scalars stay text.

    Raises:
        Express50Error: as for `read_text`, or the file is not YAML, is nested too deeply, or has
            aliases, with which a small file could expand without bound.
    """
    text, level = read_text(path, kind, YAML_LIMIT), 0
    text = text.replace("%YAML:1.0", "%YAML 1.0", 1)  # as OpenCV writes it
    try:
        for event in yaml.parse(text, yaml.BaseLoader):
            level += isinstance(event, yaml.CollectionStartEvent)
            level -= isinstance(event, yaml.CollectionEndEvent)
            if level > YAML_LEVELS or isinstance(event, yaml.AliasEvent):
                raise kind(
                    f"{path}: has aliases (*name) or over {YAML_LEVELS} levels of nesting, expected"
                    f" plain values; {AGAIN}"
                )
        return yaml.load(text, yaml.BaseLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise kind(f"{path}: not YAML ({reason(error)}); {AGAIN}") from None


def read_xml(path: Path, kind: Kind) -> ElementTree.Element:
    """Read the root of an XML file.

    Raises:
        Express50Error: as for `read_text`, or the file is not XML or declares a document type,
            whose entities could grow without bound or name other files.
    """
    text = read_text(path, kind)
    if "<!DOCTYPE" in text:
        raise kind(f"{path}: declares a document type (<!DOCTYPE), expected none; {AGAIN}")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise kind(f"{path}: not XML ({reason(error)}); {AGAIN}") from None


@contextmanager
def refusing(
    kind: Kind, words: str, fix: str = AGAIN, errors: tuple[type[BaseException], ...] = MALFORMED
) -> Iterator[None]:
    """Turn what code raises on a malformed file into one error: what it is not, why, how to fix it.

    Raises:
        Express50Error: of the given kind: the body raised one of the ``errors``.
    """
    try:
        yield
    except errors as error:
        why = f"has no {error}" if isinstance(error, KeyError) else reason(error)
        raise kind(f"{words} ({why}); {fix}") from error


def reason(error: BaseException) -> str:
    """Return an error's message as one line of at most 200 characters."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    words = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(words.split())[:200]


class NotFiniteError(ValueError):
    """Reports a number that is NaN or infinite, as written in the file."""

    def located(self, text: str | bytes) -> str:
        """Return a message that names the first line with this number."""
        lines = (text if isinstance(text, str) else text.decode(errors="replace")).split("\n")
        word = str(self)
        number = next((n for n, line in enumerate(lines, 1) if word in line), 1)
        return f"line {number} holds {word[:40]}, which is NaN or infinite; expected finite numbers"


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise NotFiniteError(text)
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice[:40]!r} appears twice")
    return table


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value that a file holds is a number; true and false are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Format the lines of a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(map(str, line)) + " |" for line in lines]
