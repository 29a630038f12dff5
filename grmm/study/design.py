"""Make a study: choose examples, assign A and B, copy pictures under names that say nothing.

Counterbalanced twice: A is the first method in half of the examples, and every second participant
sees the mirrored assignment, so that over two participants each example shows each method once on
each side. The order of examples is another one for every participant.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.errors import ConfigError, FormatError
from express50.files.atomic import write_bytes, write_json
from express50.files.images import encode_png, read_image

FORMAT = "grmm.study/1"
QUESTIONS = {
    "expression": "Which of the two keeps the expression better?",
    "identity": "Which of the two keeps the identity better?",
}
ANSWERS = ("A++", "A+", "=", "B+", "B++")
SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, kw_only=True)
class Method:
    """One of the two methods: the name the table gives it, and its folder of pictures."""

    name: str
    folder: Path


def make_study(
    out: Path,
    reference: Path,
    methods: tuple[Method, Method],
    examples: int = 15,
    participants: int = 20,
    seed: int = 0,
) -> dict:
    """Write OUT/study.json, which holds the assignment, and OUT/pictures/.

    Pictures of one example have one name in all three folders: the reference (a frontal view of
    the truth) and the two renderings of a novel view. Defaults are the paper's: 20 participants,
    15 examples, two questions each.

    Raises:
        ConfigError: too few common pictures, or OUT holds answers already.
        FormatError: a picture cannot be read.
    """
    if (out / "answers.jsonl").exists():
        raise ConfigError(f"{out}: people have answered this study; make another in another folder")
    if examples < 1 or participants < 1:
        raise ConfigError(f"got {examples} examples and {participants} participants, expected >= 1")
    if methods[0].name == methods[1].name:
        raise ConfigError(
            f"both methods are called {methods[0].name!r}; give two names with --names"
        )
    folders = [reference, *(method.folder for method in methods)]
    names = common_pictures(folders)
    if len(names) < examples:
        raise ConfigError(
            f"{', '.join(map(str, folders))}: {len(names)} pictures of one name in all three, "
            f"expected {examples}; lower --examples or render more"
        )
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(names, size=examples, replace=False).tolist())
    first_is_a = np.arange(examples) < (examples + int(rng.integers(2))) // 2
    rng.shuffle(first_is_a)
    entries = []
    for number, name in enumerate(chosen):
        pictures = [_copy(folder, name, out, seed) for folder in folders]
        entries.append(
            {
                "example": name,
                "reference": pictures[0],
                "pictures": {m.name: p for m, p in zip(methods, pictures[1:], strict=True)},
                "A": methods[0 if first_is_a[number] else 1].name,
            }
        )
    study = {
        "format": FORMAT,
        "methods": [method.name for method in methods],
        "questions": QUESTIONS,
        "participants": participants,
        "seed": seed,
        "examples": entries,
    }
    write_json(out / "study.json", study)
    return study


def common_pictures(folders: Sequence[Path]) -> list[str]:
    """List the stems of the pictures that all folders hold.

    Raises:
        ConfigError: a folder does not exist.
    """
    stems = []
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder}: no such folder; expected pictures named alike")
        stems.append({p.stem for p in folder.iterdir() if p.suffix.lower() in SUFFIXES})
    return sorted(set.intersection(*stems))


def _copy(folder: Path, name: str, out: Path, seed: int) -> str:
    """Write a picture as PNG under a digest; returns that name, relative to OUT.

    The digest is of what the picture shows and where it came from: two methods that made the same
    picture must not be recognised by a shared address either.
    """
    found = (p for p in sorted(folder.iterdir()) if p.stem == name)
    path = next(p for p in found if p.suffix.lower() in SUFFIXES)
    pixels = read_image(path)
    if pixels.dtype != np.uint8:
        raise FormatError(f"{path}: {pixels.dtype} pixels, expected 8 bits per channel")
    data = encode_png(pixels if pixels.ndim == 2 else pixels[..., :3])
    digest = hashlib.sha256(f"{seed} {folder} {name} ".encode() + data).hexdigest()[:24]
    write_bytes(out / "pictures" / f"{digest}.png", data)
    return f"pictures/{digest}.png"


def trials(study: dict, participant: int) -> list[dict]:
    """List what one participant sees, in order: example, and pictures of reference, A and B."""
    entries = study["examples"]
    order = np.random.default_rng([study["seed"], 1, participant]).permutation(len(entries))
    seen = []
    for number in order.tolist():
        entry = entries[number]
        a = method_of(study, participant, number, "A")
        b = method_of(study, participant, number, "B")
        seen.append(
            {
                "example": number,
                "reference": entry["reference"],
                "A": entry["pictures"][a],
                "B": entry["pictures"][b],
            }
        )
    return seen


def method_of(study: dict, participant: int, example: int, side: str) -> str:
    """Return the method that a participant saw on a side; odd participants see it mirrored."""
    first, second = study["methods"]
    a = study["examples"][example]["A"]
    if participant % 2:
        a = second if a == first else first
    return a if side == "A" else (second if a == first else first)
