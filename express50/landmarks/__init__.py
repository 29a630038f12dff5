"""Find the 68 landmarks of a face: network, detection in frames, training on rendered heads."""

from __future__ import annotations

from pathlib import Path

from express50.files.text import expanded

EMBEDDED, FAN = "embedded", "fan:"  # sources; anything else is the path of a file of points
WEIGHTS = Path(__file__).with_name(
    "weights.npz"
)  # here, because the network's module imports torch


def source_files(landmarks: str) -> dict[str, Path]:
    """Return the files that a source reads, by name; a stage's output depends on them."""
    if landmarks == EMBEDDED:
        return {"weights": WEIGHTS}
    if landmarks.startswith(FAN):
        return {"weights": WEIGHTS, "fan": expanded(landmarks.removeprefix(FAN))}
    return {"landmarks": expanded(landmarks)}
