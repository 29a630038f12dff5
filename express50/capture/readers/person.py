"""What captures say of the people in them, for counts; it is read here and kept nowhere."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from express50.capture.raw import read_meta
from express50.capture.readers.read import is_ours, read_any
from express50.contract.layout import Dataset
from express50.errors import Express50Error


def read_person(capture: Path) -> dict:
    """Gender and age of a capture of any layout; empty where it is not there or says nothing."""
    try:
        meta = read_meta(capture) if is_ours(capture) else read_any(capture).meta
    except (Express50Error, OSError):
        return {}
    return {key: meta[key] for key in ("gender", "age") if key in meta}


def read_people(dataset: Dataset, subjects: Iterable[str]) -> list[dict]:
    """The same of a dataset's subjects, in order."""
    captures = dataset.captures()
    return [read_person(captures[subject]) if subject in captures else {} for subject in subjects]
