"""Run a command line's handler with one-line errors, exit codes 0, 1 and 2, and clean stops."""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import math
import os
import re
import signal
import sys
import textwrap
import traceback
import warnings
from _thread import interrupt_main
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import Timer
from typing import IO, Any

from express50.errors import ConfigError, Express50Error, few, nearest

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
DEBUG = "EXPRESS50_DEBUG"  # environment variable
REMEDY = "check the path, its permissions and the free disk space"
NO_LOCKS = (
    "its file system cannot lock files; mount it with locks (Lustre: -o flock), or use another disk"
)
REMEDIES = {
    errno.ENOENT: "check the path",
    errno.EEXIST: "give another path",
    errno.ENOTDIR: "give another path",
    errno.EISDIR: "give the path of a file",
    errno.ELOOP: "correct the link, which leads back to itself",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EACCES: "check its owner and permissions",
    errno.EPERM: "check its owner and permissions",
    errno.EROFS: "make its disk writable, or use another one",
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space, your quota is used up",
    errno.EFBIG: "its disk or 'ulimit -f' limits the size of files; use another disk or limit",
    **dict.fromkeys((errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP), NO_LOCKS),
}

LATER = 0.05  # seconds, after which a callback of the garbage collection has ended

LOOP = "Symlink loop from '"  # Path.resolve's RuntimeError, which is no OSError until Python 3.13

# torch's error on a CPU is a RuntimeError that only its words tell apart.
OUT_OF_MEMORY = re.compile("out of memory|can't allocate memory", re.IGNORECASE)
AMOUNT = re.compile(r"llocate ([\d.]+ \w+)")

# Words of a figure's name as readers write them; units go to its end.
UNITS = {"db": "dB", "deg": "degrees", "mm": "mm", "m": "m", "px": "px", "gib": "GiB"}
SPELLINGS = {
    "psnr": "PSNR", "ssim": "SSIM", "rmse": "RMSE", "lpips": "LPIPS", "fid": "FID", "iou": "IoU",
    "heldout": "held-out", "mae": "MAE", "rms": "RMS",
}  # fmt: skip


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of descriptions, wraps long ones, and aligns lists of sub-commands."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = text.splitlines()
        return "\n".join(textwrap.fill(line, width, subsequent_indent=indent) for line in lines)

    def add_argument(self, action: argparse.Action) -> None:
        super().add_argument(action)
        for choice in self._iter_indented_subactions(action):  # argparse ignores their indent
            length = self._current_indent + len(self._format_action_invocation(choice))
            self._action_max_length = max(self._action_max_length, length)


class Parser(argparse.ArgumentParser):
    """Parses a command line; suggests the nearest known word for an unknown one."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Read ``-4m`` and ``-1e3`` as values, so that the option they belong to refuses them."""
        super().__init__(*arguments, **options | {"formatter_class": _HelpFormatter})
        self._negative_number_matcher = re.compile(r"-\.?\d\S*")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Refuse values that name nothing; most would read as if the option were not given."""
        empty = [text for text in arg_strings if not text.strip(", ")]
        if empty and action.nargs != argparse.PARSER:  # those belong to a sub-command
            words = f"got {empty[0]!r}, expected a value; is a variable of your shell not set?"
            raise argparse.ArgumentError(action, words)
        home = [text for text in arg_strings if text.startswith("~/")]
        if home and action.type is not None:  # else a folder called ~ would be made
            words = f"got {home[0]!r}, whose ~ no shell has replaced; write $HOME instead of ~"
            raise argparse.ArgumentError(action, words)
        return super()._get_values(action, arg_strings)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            near = nearest(str(value), known)
            words = f"unknown {value!r}{near}; expected {', '.join(known)}"
            raise argparse.ArgumentError(action, words)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse a command's arguments; refuse those left over here, where its options are known.

        Print the whole help if there are none and a sub-command is expected.
        """
        args = sys.argv[1:] if args is None else args
        if not args and self._subparsers is not None:
            self.print_help(sys.stderr)
            self.exit(USAGE)
        for text in args:
            known = text in self._option_string_actions
            if re.match("-[^-]", text) and not known and os.access(text, os.F_OK):
                self.error(f"{text} begins as options do; write ./{text}")
        found, left = super().parse_known_args(args, namespace)
        if left:
            near = nearest(left[0].partition("=")[0], self._option_string_actions)
            self.error(f"unknown argument {left[0]!r}{near}")
        return found, left


def number(low: float, high: float = 1 << 20, kind: type = int) -> Callable[[str], Any]:
    """Make an argument type of numbers from ``low`` to ``high``, by default whole ones."""

    def parse(text: str) -> Any:
        try:
            found = kind(text)
        except ValueError:
            found = math.nan
        if low <= found <= high:
            return found
        wanted = "a whole number" if kind is int else "a number"
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {wanted}, {low} to {high}")

    return parse


def picture_size(text: str) -> tuple[int, int]:
    """Parse ``WIDTHxHEIGHT``, pixels."""
    sides = re.fullmatch(r"0*([1-9]\d{0,5})x0*([1-9]\d{0,5})", text.lower(), re.ASCII)
    if sides is None:
        words = f"got {text!r}, expected WIDTHxHEIGHT, such as 3840x2160"
        raise argparse.ArgumentTypeError(words)
    return int(sides[1]), int(sides[2])


def run_handler(
    program: str, handler: Callable[[argparse.Namespace], int], args: argparse.Namespace
) -> int:
    """Call a command's handler and return its exit code, also when it fails or is stopped.

    Any error becomes one line on standard error; with EXPRESS50_DEBUG=1 the traceback follows.
    """
    _open_standard_streams()
    try:
        with _stop_on_sigterm(), _warnings_on_one_line(program):
            code = handler(args)
        with _naming_output():
            sys.stdout.flush()
        return code
    except Exception as error:  # noqa: BLE001 (a page of a library's files helps no user)
        log(f"{program}: {error_line(error)}")
        if os.environ.get(DEBUG):
            traceback.print_exception(error)
        return USAGE if isinstance(error, ConfigError) else FAILED
    except KeyboardInterrupt:
        again = " without --overwrite" if getattr(args, "overwrite", False) else ""
        log(
            f"{program}: interrupted; finished work is kept, the same command{again} makes the rest"
        )
        return INTERRUPTED


def _open_standard_streams() -> None:
    """Give this process the standard streams that it was started without (``>&-``).

    Otherwise, a file of ours would get their number, and libraries' messages.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open("w" if number else "r")  # noqa: SIM115 (stays)
            setattr(sys, name, stream)


@contextlib.contextmanager
def _warnings_on_one_line(program: str) -> Iterator[None]:
    """Print warnings as lines of the program: a place in a library's code helps no user."""
    former = warnings.formatwarning
    warnings.formatwarning = lambda message, *_args, **_kw: f"{program}: warning: {message}\n"
    try:
        yield
    finally:
        warnings.formatwarning = former


def error_line(error: Exception) -> str:
    """Return one line of what went wrong and what to do, of an error of ours or of any other."""
    name, words = type(error).__name__, " ".join(str(error).split())
    if isinstance(error, Express50Error):
        return f"{name}: {words}"
    if isinstance(error, OSError):  # not a bug: permissions, a missing folder, a full disk
        return system_error_line(error)
    if words.startswith(LOOP):
        return system_error_line(
            OSError(errno.ELOOP, os.strerror(errno.ELOOP), words[len(LOOP) : -1])
        )
    if isinstance(error, MemoryError) or OUT_OF_MEMORY.search(words):
        wanted = AMOUNT.search(words)
        amount = f" for {wanted[1]}" if wanted else ""
        return (
            f"{name}: not enough memory{amount}; end other programs, or ask for less: a smaller "
            "preset, size or number of workers"
        )
    last = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"{name}: {Express50Error(words)} (unexpected, in {Path(last.filename).name} line "
        f"{last.lineno}); set {DEBUG}=1, run the same command again and report what it prints"
    )


def system_error_line(error: OSError) -> str:
    """Return one line of what the system refused, where, and what to do."""
    name = error.filename2 or error.filename  # of a rename, the target: the source is temporary
    if error.errno == errno.EROFS:
        return not_writable(name, error)
    place = f" {name}:" if name is not None else ""
    words = error.strerror or " ".join(str(error).split()) or "no reason given"
    return f"{type(error).__name__}:{place} {words}; {REMEDIES.get(error.errno or 0, REMEDY)}"


def not_writable(place: object, error: OSError) -> str:
    """Return one line on a folder or file that cannot be written to: why, and what to do."""
    return f"{place}: not writable ({error.strerror}); {REMEDIES.get(error.errno or 0, REMEDY)}"


def add_command(
    subparsers: Any,
    name: str,
    handler: Callable[[argparse.Namespace], int],
    help: str,  # noqa: A002  argparse's name
    *,
    dataset: bool = True,
    json: bool = True,
    example: str | None = None,
    **options: Any,
) -> argparse.ArgumentParser:
    """Add a command's parser, for most commands with the arguments DATASET and --json.

    Its description, unless given, is its ``help`` as a sentence.
    """
    options.setdefault("description", help and f"{help[0].upper()}{help[1:]}.")
    if example is not None:
        options |= {"epilog": f"example:\n  {example}"}
    parser = subparsers.add_parser(name, help=help, **options)
    parser.set_defaults(handler=handler)
    if dataset:
        parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the dataset")
    if json:
        parser.add_argument("--json", action="store_true", help="print as JSON")
    return parser


@contextlib.contextmanager
def ignoring_closed_pipe(stream: IO[str]) -> Iterator[None]:
    """Ignore that the reader of a stream has closed it."""
    try:
        yield
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def _stop_on_sigterm() -> Iterator[None]:
    """Handle SIGTERM, which batch systems send, like Ctrl-C.

    Python ignores exceptions in callbacks of its garbage collection: there, both are sent again.
    """

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    def report(ignored: Any) -> None:
        if ignored.exc_type is KeyboardInterrupt:
            Timer(LATER, interrupt_main, [signal.SIGTERM]).start()
        else:
            report_ignored(ignored)

    report_ignored = sys.unraisablehook
    try:
        former = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not the main thread
        yield
        return
    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = report_ignored
        signal.signal(signal.SIGTERM, former)


def say(*lines: str) -> None:
    """Write lines to standard output."""
    with _naming_output():
        for line in lines:
            sys.stdout.write(printable(line) + "\n")


@contextlib.contextmanager
def _naming_output() -> Iterator[None]:
    """Name standard output in errors of writing to it, except where its reader has closed it."""
    try:
        with ignoring_closed_pipe(sys.stdout):
            yield
    except OSError as error:
        error.filename = error.filename or "standard output"
        raise


def log(line: str) -> None:
    """Write a line of progress to standard error; standard output is for results."""
    # Work does not stop because nobody can see it, as after the end of a connection.
    with contextlib.suppress(OSError), ignoring_closed_pipe(sys.stderr):
        sys.stderr.write(printable(line) + "\n")
        sys.stderr.flush()


def printable(text: str) -> str:
    """Return text with control characters escaped, as in names from foreign files.

    They could move a terminal's cursor, change its title or hide a line.
    """
    if text.isprintable():
        return text
    shown = ("\n", "\t")
    return "".join(c if c.isprintable() or c in shown else ascii(c)[1:-1] for c in text)


def say_json(value: object) -> None:
    """Write JSON to standard output."""
    say(json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False))


def answer(args: argparse.Namespace, data: object, *lines: str) -> int:
    """Print data as JSON if ``--json`` was given, else the lines; return the exit code OK."""
    if args.json:
        say_json(data)
    else:
        say(*lines)
    return OK


@contextlib.contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect standard output, also that of native code, to standard error."""
    sys.stdout.flush()
    with contextlib.redirect_stdout(sys.stderr):
        saved = os.dup(1)
        try:
            os.dup2(2, 1)
            yield
        finally:
            os.dup2(saved, 1)
            os.close(saved)


def count(number: float, noun: str) -> str:
    """Return a number with its noun: ``1 file``, ``2 files``, ``0 files``, ``1.5 files``."""
    words = f"{number:,}" if isinstance(number, int) else f"{number:.6g}"
    return f"{words} {noun}" + ("" if number == 1 else "s")


def figure_label(name: str) -> str:
    """Return a figure's name for readers; "train.psnr_db" is "train: PSNR, dB"."""
    parts = []
    for part in name.split("."):
        words = part.split("_")
        units = [UNITS[word] for word in words if word in UNITS]
        text = " ".join(SPELLINGS.get(word, word) for word in words if word not in UNITS)
        parts.append(", ".join([text, *units]))
    return ": ".join(parts)


def format_table(header: list[str], rows: list[list[str]]) -> Iterator[str]:
    """Yield the lines of a table with aligned columns, numbers to the right."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = []  # columns whose cells are numbers, where they are not empty, ``n/a`` or ``-``
    for column in columns:
        filled = [cell for cell in column[1:] if cell not in ("", "n/a", "-")]
        numbers = all(re.fullmatch(r"[+-]?[\d,]*\.?\d+", cell) for cell in filled)
        right.append(bool(filled) and numbers)
    for row in [header, *rows]:
        cells = (
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(row, widths, right, strict=True)
        )
        yield "  ".join(cells).rstrip()


def group_lines(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Make lines of ("stage item", finding); a stage's items with the same finding share one."""
    groups: dict[tuple[str, str], list[str]] = {}
    for place, finding in rows:
        stage, _, item = place.partition(" ")
        groups.setdefault((stage, finding), []).append(item)
    for (stage, finding), items in groups.items():
        yield f"{stage} {few(items)}".rstrip() + f": {finding}"


def format_seconds(seconds: float) -> str:
    """Format a duration for people: ``42 s``, ``3:05 min``, ``2:10 h``, ``3 d 4 h``."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    if whole < 86400:
        return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"
