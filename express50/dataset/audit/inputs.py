"""Whether outputs were made from the inputs that are there now.

Inputs that a stage published count with the bytes it published, not with what lies there: a damaged
file is made again to the same bytes, and does not make wrong what was made of the good one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.dataset.audit.outputs import StageState
from express50.errors import Express50Error
from express50.files.digests import files_of, path_digest, text_digest
from express50.runner.worker import fingerprint, input_digests


class Published:
    """Digests of files and folders as they were published; of others as they are."""

    def __init__(
        self, dataset: Dataset, states: Mapping[str, StageState], sha256: Callable[[Path], str]
    ) -> None:
        self._sha256 = sha256
        self._folders: set[Path] = set()
        self._files: dict[Path, str] = {}
        self._below: dict[Path, list[Path]] = {}
        self._digests: dict[Path, str] = {}
        for stage, state in states.items():
            for item, made in state.made.items():
                folder = dataset.item_dir(stage, item)
                self._folders.add(folder)
                for name, mark in made.files.items():
                    self._add(folder / name, mark.sha256, dataset.root)

    def _add(self, path: Path, sha256: str, root: Path) -> None:
        self._files[path] = sha256
        folder = path.parent
        while folder != root:
            self._below.setdefault(folder, []).append(path)
            folder = folder.parent

    def digest(self, path: Path) -> str:
        """Digest of a file or folder, as `path_digest` has it."""
        if path not in self._digests:
            self._digests[path] = self._files.get(path) or self._of_folder(path)
        return self._digests[path]

    def _of_folder(self, path: Path) -> str:
        if path not in self._below:
            return path_digest(path, self._sha256)
        table = {file: self._files[file] for file in self._below[path]}
        for file in files_of(path) if path.is_dir() else ():
            if self._folders.isdisjoint(file.parents):  # made before digests were kept
                table[file] = self._sha256(file)
        rows = (f"{file.relative_to(path).as_posix()} {table[file]}" for file in sorted(table))
        return text_digest("\n".join(rows))


class Judgement:
    """What became of a stage's items: made from other inputs, with other settings, not readable."""

    def __init__(self) -> None:
        self.outdated: dict[str, list[str]] = {}
        self.settings: list[str] = []
        self.unsaid: list[str] = []
        self.unreadable: dict[str, list[str]] = {}
        self.fresh: dict[str, dict[str, str]] = {}


def judge(
    stage: Stage, dataset: Dataset, config: Any, state: StageState, published: Published
) -> Judgement:
    """Compare every receipt of a stage with the present inputs, settings and version.

    ``outdated`` has the names of the inputs that are others now; ``settings`` what was made with
    other settings or by another version; ``unsaid`` what differs in one of these, the ledger is too
    old to say which; ``unreadable`` the items by the reason; ``fresh`` the inputs of those that are
    as they should be.
    """
    found = Judgement()
    for item, receipt in state.receipts.items():
        if receipt.status != "done":
            continue
        try:
            now = input_digests(stage, dataset, item, config, published.digest)
        except (Express50Error, OSError, ValueError, KeyError, TypeError) as error:
            # Damaged inputs may fail in any way before a stage has looked at them.
            found.unreadable.setdefault(f"{type(error).__name__}: {error}", []).append(item)
            continue
        if fingerprint(stage, config, now) == receipt.fingerprint:
            found.fresh[item] = now
        elif item not in state.made:
            found.unsaid.append(item)
        elif changed := list(_differing(state.made[item].inputs, now)):
            found.outdated[item] = changed
        else:
            found.settings.append(item)
    return found


def _differing(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            yield name


def items_of(stage: Stage, dataset: Dataset) -> list[str] | None:
    """Items that a stage has now; None where what tells them is damaged."""
    try:
        return stage.items(dataset)
    except (Express50Error, OSError, ValueError, KeyError, TypeError):
        return None
