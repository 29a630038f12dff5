"""Say why outputs are not what the present inputs, settings and stages would give."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from express50.contract.config import config_texts, resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.errors import Express50Error, few
from express50.files.digests import path_digest, text_digest
from express50.runner.ledger import Ledger, Made
from express50.runner.worker import fingerprint, input_digests

# Damaged inputs may fail in any of these ways before a stage has checked them.
BAD_INPUT = (Express50Error, OSError, ValueError, KeyError, TypeError)

NAMED = 3  # inputs or settings that are named


def why_outdated(
    stage: Stage, item: str, config: Any, made: Made, inputs: Mapping[str, str]
) -> str:
    """Say which of version, settings and inputs changed since an item's output was made.

    ``inputs`` are digests of the present inputs by name.
    """
    words = []
    if changed := differing(made.inputs, inputs):
        # An input's name may hold the item's expression; without it, items share their reason.
        own = item.split("/")
        short = [" ".join(w for w in name.split(" ") if w not in own) or name for name in changed]
        words.append(f"inputs changed: {few(short, NAMED)}")
    then, now = made.settings, config_texts(config)
    if then and (names := differing(then, now)):
        changes = [f"{n} was {then.get(n, 'unknown')}, is {now.get(n, 'gone')}" for n in names]
        words.append(f"settings changed: {few(changes, NAMED)}")
    if made.version not in (0, stage.version):
        words.append(f"stage version changed: it was {made.version}, is {stage.version}")
    return "; ".join(words) or "settings or stage version changed"


def differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """List the keys whose values differ between two tables, or that one of them lacks."""
    return [n for n in sorted(one.keys() | other.keys()) if one.get(n) != other.get(n)]


def outdated(
    dataset: Dataset, stages: Sequence[Stage], ledger: Ledger
) -> Iterator[tuple[str, str, str]]:
    """Yield stage, item and reason of each output that the next run would make again.

    The settings are those of each stage's last run. Outputs whose inputs cannot be read are left
    out: `express50 check` finds these; so are those of items that no longer exist, which the next
    run sets aside. For published files the ledger's digests are used.
    """
    made = {stage.name: ledger.made(stage.name) for stage in stages}
    digest = published_digest(dataset, made, ledger.sha256)
    for stage in stages:
        with suppress(*BAD_INPUT):  # such as a setting that no longer exists; the next run says so
            path = dataset.config_file(stage.name)
            config = resolve_config(stage, "standard", path, (), [s.name for s in stages])
            present = made[stage.name].keys() & set(stage.items(dataset))
            for item, receipt in ledger.read(stage.name).items():
                if item in present and not receipt.imported:
                    with suppress(*BAD_INPUT):
                        now = input_digests(stage, dataset, item, config, digest)
                        if fingerprint(stage, config, now) != receipt.fingerprint:
                            row = made[stage.name][item]
                            yield stage.name, item, why_outdated(stage, item, config, row, now)


def published_digest(
    dataset: Dataset, made: Mapping[str, Mapping[str, Made]], sha256: Callable[[Path], str]
) -> Callable[[Path], str]:
    """Return a function that digests paths as `path_digest` does, with files as published.

    A damaged file will be made again with the same bytes, so that outputs made from the good one
    stay valid. Paths that no stage published are digested as they are now.
    """
    known: dict[Path, str] = {}
    below: dict[Path, list[Path]] = {}
    for stage, items in made.items():
        for item, row in items.items():
            for name, mark in row.files.items():
                path = dataset.item_dir(stage, item) / name
                known[path] = mark.sha256
                for parent in path.parents[: len(path.relative_to(dataset.root).parts) - 1]:
                    below.setdefault(parent, []).append(path)

    def digest(path: Path) -> str:
        if path not in known and path not in below:
            known[path] = path_digest(path, sha256)
        elif path not in known:
            files = sorted(below[path])
            rows = (f"{file.relative_to(path).as_posix()} {known[file]}" for file in files)
            known[path] = text_digest("\n".join(rows))
        return known[path]

    return digest
