"""Define motions of the skin as sums of smooth, windowed pulls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from express50.head.generator.field import window
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray
Triple = tuple[float, float, float]

# How much of the surrounding skin's motion each lid loop takes, from the margin outwards.
LID_SHARE = (0.0, 0.08, 0.2, 0.38, 0.58, 0.78, 0.92, 1.0)


@dataclass(frozen=True)
class Pull:
    """A Gaussian-windowed motion (mm): translation `move` and scaling `stretch` about `at`."""

    at: Triple
    radius: Triple
    move: Triple = (0.0, 0.0, 0.0)
    stretch: Triple = (0.0, 0.0, 0.0)
    sides: str = "both"  # "both" mirrors the pull; "left", "right" or "middle" use it once
    scope: str = "skin"  # "skin", "all" (with teeth and tongue), "upper", "lower" (of the slit)


def displacement(mesh: WholeMesh, pulls: tuple[Pull, ...], scopes: dict[str, Array]) -> Array:
    """Sum (V,3) of pulls in mm; `scopes` maps a scope to its vertex weights (V,)."""
    total = np.zeros_like(mesh.vertices)
    for pull in pulls:
        flips = {"both": (1, -1), "left": (1,), "right": (-1,), "middle": (1,)}[pull.sides]
        for flip in flips:
            mirror = np.array([flip, 1.0, 1.0])
            at = np.array(pull.at) * mirror
            weight = window(mesh.vertices, at, pull.radius) * scopes[pull.scope]
            motion = np.array(pull.move) * mirror + np.array(pull.stretch) * (mesh.vertices - at)
            total += weight[:, None] * motion
    return total


def scope_weights(regions: dict[str, Array], jaw: Array) -> dict[str, Array]:
    """Return vertex weights (V,) of each scope. `jaw` separates the lower lip from the upper."""
    hard = regions["teeth"] | regions["gums"] | regions["tongue"]
    balls = regions["left_eyeball"] | regions["right_eyeball"]
    skin = (~hard & ~balls).astype(float)
    return {
        "all": np.ones(len(skin)),
        "skin": skin,
        "upper": skin * (1 - jaw),
        "lower": skin * jaw,
    }


def settle_eyes(mesh: WholeMesh, motion: Array) -> Array:
    """Hold the eyeballs and the lids' margins still; lids give way the more, the further out."""
    result = motion.copy()
    for tag in ("eyeball", "lid_edge", "lid_hidden"):
        result[mesh.tag(tag)] = 0.0
    for k, share in enumerate(LID_SHARE):
        result[mesh.tag(f"lid{k}")] *= share
    return result


# How much of a motion that would push shut lips through each other is held back, from the slit on.
SHUT_SHARE = (1.0, 0.7, 0.3)


def part_lips(mesh: WholeMesh, motion: Array) -> Array:
    """Return the motion (V, 3) with shut lips moving up and down as one where they would close.

    No sum of such motions then pushes shut lips through each other.
    """
    result = motion.copy()
    for k, share in enumerate(SHUT_SHARE):
        for side in ("left", "right"):
            ring = mesh.tag(f"lip{k}", side)  # from the middle of the upper lip to the lower's
            upper, lower = ring[: len(ring) // 2], ring[: len(ring) // 2 : -1]
            held = 0.5 * share * np.maximum(motion[lower, 1] - motion[upper, 1], 0.0)
            result[upper, 1] = motion[upper, 1] + held
            result[lower, 1] = motion[lower, 1] - held
    return result


middle = partial(Pull, sides="middle")
