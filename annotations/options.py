"""Options and answers that the ``express50 annotate`` verbs share."""

from __future__ import annotations

import argparse
import getpass
from collections.abc import Callable
from pathlib import Path

from annotations.store import is_person
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

Handler = Callable[[argparse.Namespace], int]


def add_verb(verbs, name: str, words: str, handler: Handler) -> argparse.ArgumentParser:
    """Add a verb with what all have: the dataset and ``--json``."""
    parser = verbs.add_parser(name, help=words, description=words)
    parser.add_argument("dataset", type=existing_dataset, metavar="DATASET")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(handler=handler)
    return parser


def add_clip(parser: argparse.ArgumentParser) -> None:
    """Add the clip that a verb is about, and who speaks."""
    parser.add_argument("subject", metavar="SUBJECT")
    parser.add_argument("expression", metavar="EXPRESSION")
    add_annotator(parser)


def add_annotator(parser: argparse.ArgumentParser) -> None:
    """Add who speaks."""
    parser.add_argument(
        "--annotator", type=person, default=getpass.getuser(), metavar="NAME", help="you by default"
    )


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add a choice of subjects."""
    parser.add_argument("--subject", action="append", metavar="ID", help="only this; repeatable")


def existing_dataset(text: str) -> Dataset:
    """A dataset's folder that is there."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(
            f"{text}: no such dataset; run 'express50 ingest {text} CAPTURE'"
        )
    return Dataset(Path(text))


def person(text: str) -> str:
    """A person's name: not the align stage's, nor a rule's, nor none."""
    if not text.strip() or not is_person(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no person's name; give yours")
    return text


def chosen_subjects(dataset: Dataset, wanted: list[str] | None) -> list[str] | None:
    """The subjects asked for, None for all.

    Raises:
        AnnotationError: one is not ingested.
    """
    for subject in wanted or ():
        if subject not in dataset.subjects():
            raise AnnotationError(
                f"{dataset.root}: no subject {subject!r}; expected one of"
                f" {', '.join(dataset.subjects()) or 'none: run express50 ingest'}"
            )
    return wanted
