"""Write files so that after a crash each is absent or complete: write aside, sync, rename.

A full disk raises one kind of error, which stops a run before it computes what cannot be stored.
"""

from __future__ import annotations

import csv
import ctypes
import errno
import fcntl
import io
import json
import math
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, BinaryIO

from rich.filesize import decimal

from express50.errors import ConfigError, DiskError, DiskFullError, FormatError, NotReadyError

LEAST_FREE = 100e6  # bytes; a disk with less free space counts as full
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # Linux constants
BROKEN = {
    errno.EIO, errno.EROFS, errno.ESTALE, errno.ENXIO, errno.ENODEV, errno.EACCES, errno.EPERM,
}  # fmt: skip
FORMER = ".former"  # suffix of a folder that was moved out of the way


def dump_json(value: object) -> bytes:
    """Encode as deterministic JSON with sorted keys.

    Raises:
        ValueError: a number is not finite.
        FormatError: a text is not Unicode, as names of files may be.
    """
    text = json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)
    try:
        return (text + "\n").encode()
    except UnicodeEncodeError as error:
        line = text[: error.end].count("\n")
        raise FormatError(
            f"{text.splitlines()[line].strip()}: holds a name that is not UTF-8; rename that file"
            " or folder"
        ) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file so that readers, even after a crash, see either the old bytes or the new."""
    write_with(path, lambda file: file.write(data))


def write_with(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file as `write_bytes` does, by calling ``write`` with the open file."""
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    with naming_full_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with aside.open("wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            aside.replace(path)
        except OSError as error:
            if error.filename == str(aside):  # the user knows only the target
                error.filename = str(path)
            raise
        finally:
            with suppress(OSError):  # of a read-only disk: the first error says so
                aside.unlink()
        sync_directory(path.parent)


def write_json(path: Path, value: object) -> None:
    """Write deterministic JSON in one step."""
    write_bytes(path, dump_json(value))


def write_csv(path: Path, names: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a table with these columns in one step; what else a row holds is left out."""
    text = io.StringIO()
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def nearest_existing(path: Path) -> Path:
    """Return a path, or the nearest folder above it that exists."""
    path = path.resolve()
    return next(one for one in (path, *path.parents) if one.exists())


def check_folder_writable(folder: Path) -> None:
    """Refuse, before any work, a folder that cannot be made or written to; nothing is left in it.

    Raises:
        ConfigError: it is a file, or lies below one.
        OSError: the system refuses.
    """
    place = nearest_existing(folder)
    if not place.is_dir():
        raise ConfigError(f"{place}: is a file, expected a folder to write to; name another")
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:  # the user does not know its name
        raise OSError(error.errno, error.strerror, str(folder)) from None


def check_disk(folder: Path, name: Path) -> None:
    """Refuse a disk that broke, or became read-only, after a run began; nothing is left on it.

    A folder that is gone is not the disk's fault. ``name`` is what the error names.

    Raises:
        DiskError: the disk of the folder refuses to be written to.
    """
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"1")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        if error.errno in BROKEN:
            raise DiskError(
                f"{name}: its disk cannot be written to ({error.strerror}); repair that and run the"
                " same command again; finished work is kept"
            ) from error


def free_space(path: Path) -> float:
    """Return the free bytes on a path's disk; infinity for network drives that do not say."""
    usage = shutil.disk_usage(nearest_existing(path))
    return usage.free if usage.total else math.inf


def check_space(folder: Path) -> None:
    """Raise DiskFullError if the disk of a folder has less than `LEAST_FREE` left."""
    if free_space(folder) < LEAST_FREE:
        raise disk_full(folder, f"expected at least {decimal(int(LEAST_FREE))}")


@contextmanager
def naming_full_disk(path: Path, aside: Path | None = None) -> Iterator[None]:
    """Turn any error caused by a full disk, even in a library, into one that names the path.

    ``aside`` is where the files lie until they are complete; errors name ``path`` instead of it.

    Raises:
        DiskFullError: the body raised such an error.
        OSError: the body raised one of a file that became too large, which then names the path.
    """
    try:
        yield
    except DiskFullError as error:
        if aside is None or str(aside) not in str(error):
            raise
        raise DiskFullError(str(error).replace(str(aside), str(path))) from error
    except Exception as error:
        causes: list[BaseException] = [error]
        while cause := causes[-1].__cause__ or causes[-1].__context__:
            causes.append(cause)
        numbers = [getattr(cause, "errno", None) for cause in causes]
        if errno.EFBIG in numbers:  # torch hides it behind an error of its own
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path)) from error
        for number in (errno.ENOSPC, errno.EDQUOT):
            if number in numbers or any(os.strerror(number) in str(cause) for cause in causes):
                raise disk_full(path, os.strerror(number)) from error
        raise


def disk_full(path: Path, why: str) -> DiskFullError:
    """Make the error of a full disk, which names the path and says how much is free now."""
    usage = shutil.disk_usage(nearest_existing(path))
    return DiskFullError(
        f"{path}: the disk is full ({why}; {decimal(int(usage.free))} are free now); free some"
        " space and run the same command again; finished work is kept"
    )


@contextmanager
def folder_in_one_step(
    aside: Path, target: Path, keep: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yield the empty folder ``aside``; on a clean exit it is synced and replaces ``target``.

    ``keep`` may move the replaced folder elsewhere; otherwise it is deleted.

    If the body raises, an existing target stays as it was. A kill at any moment leaves the old
    target or the new one. Only if the file system cannot swap two folders, a kill between two
    renames leaves none until the next call, which first puts the old one back. What a killed run
    left behind is deleted. The parent folder of ``aside`` must exist, or be the target's.
    """
    former = aside.with_name(aside.name + FORMER)
    with naming_full_disk(target, aside):
        target.parent.mkdir(parents=True, exist_ok=True)
        put_back(former, target)
        for left in (aside, former):
            shutil.rmtree(left, ignore_errors=True)
        aside.mkdir()
        try:
            yield aside
            for folder, _, names in os.walk(aside, topdown=False):
                for name in names:
                    _sync(Path(folder) / name, os.O_RDONLY)
                sync_directory(Path(folder))
            _replace(aside, target, former)
            sync_directory(target.parent)
            for replaced in (aside, former):
                if keep is not None and replaced.exists():
                    keep(replaced)
            shutil.rmtree(former, ignore_errors=True)
        finally:
            shutil.rmtree(aside, ignore_errors=True)


def put_back(former: Path, target: Path) -> None:
    """Put the old folder back if a kill between two renames has left no target."""
    if former.is_dir() and not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        former.rename(target)
        sync_directory(target.parent)


def _replace(aside: Path, target: Path, former: Path) -> None:
    """Rename a folder to a target that others may make, replace or move away at the same time.

    Checking first and then renaming would fail if another process came in between.
    """
    met = False
    while True:
        target.parent.mkdir(parents=True, exist_ok=True)
        if _swap(aside, target):
            return
        try:
            aside.rename(target)
            return
        except FileNotFoundError:
            if not aside.exists():  # a later run has removed it
                raise
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            if met:  # second time: the target existed during the swap, which is not supported here
                shutil.rmtree(former, ignore_errors=True)
                with suppress(FileNotFoundError):
                    target.rename(former)
            met = True


def _swap(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; return False if the system cannot.

    Source: renameat2(2), RENAME_EXCHANGE, which Python's standard library lacks.
    """
    exchange = getattr(ctypes.CDLL(None), "renameat2", None)  # glibc 2.28 and later
    return exchange is not None and not exchange(
        AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE
    )


def link_file(source: str | Path, target: str | Path) -> None:
    """Give a file that is only ever replaced a second name; copy it where that is not possible."""
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links
        shutil.copy2(source, target)


def lock_file(file: BinaryIO | IO[str] | int, path: Path, kind: int = fcntl.LOCK_EX) -> None:
    """Lock an open file or folder as `fcntl.flock` does; its errors name no path, these do."""
    try:
        fcntl.flock(file, kind)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Make a folder, and hold it so that no other command writes results into it meanwhile.

    The system releases it however the process ends. File systems without locks hold nothing. What
    a killed command was writing is removed.

    Raises:
        NotReadyError: another process holds it.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for aside in folder.glob(f".*.{32 * '[0-9a-f]'}"):  # of a command that was killed
                aside.unlink(missing_ok=True)
        except BlockingIOError:
            raise NotReadyError(
                f"{folder}: another process writes into this folder; wait until it ends, or name"
                " another folder"
            ) from None
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)
        with suppress(OSError):  # something was written
            if made:
                folder.rmdir()


def sync_directory(path: Path) -> None:
    """Flush a folder's entries to the disk."""
    _sync(path, os.O_RDONLY | os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
