"""Smooth displacement fields from which shape and expression directions are put together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.head.generator.field import EYE_CENTER
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray

# How much of the surrounding skin's motion each lid loop takes, from the margin outwards.
_LID_SHARE = (0.0, 0.08, 0.2, 0.38, 0.58, 0.78, 0.92, 1.0)


@dataclass(frozen=True, kw_only=True)
class Pull:
    """A Gaussian-windowed motion (mm): translation `move` and scaling `stretch` about `at`."""

    at: tuple[float, float, float]
    radius: tuple[float, float, float]
    move: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stretch: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sides: str = "both"  # "both" mirrors the pull; "left", "right" or "middle" use it once
    scope: str = "skin"  # "skin", "all" (with teeth and tongue), "upper", "lower" (of the slit)


def window(points: Array, at: Array, radius: Array) -> Array:
    """Return a Gaussian window (N,), 1 at `at` and exp(-1) at one radius, of points (N,3)."""
    return np.exp(-(((points - at) / radius) ** 2).sum(-1))


def displacement(mesh: WholeMesh, pulls: tuple[Pull, ...], scopes: dict[str, Array]) -> Array:
    """Sum (V,3) of pulls in mm; `scopes` maps a scope to its vertex weights (V,)."""
    total = np.zeros_like(mesh.vertices)
    for pull in pulls:
        flips = {"both": (1, -1), "left": (1,), "right": (-1,), "middle": (1,)}[pull.sides]
        for flip in flips:
            mirror = np.array([flip, 1.0, 1.0])
            at = np.array(pull.at) * mirror
            weight = window(mesh.vertices, at, np.array(pull.radius)) * scopes[pull.scope]
            motion = np.array(pull.move) * mirror + np.array(pull.stretch) * (mesh.vertices - at)
            total += weight[:, None] * motion
    return total


def scope_weights(mesh: WholeMesh, regions: dict[str, Array], jaw: Array) -> dict[str, Array]:
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


def settle_eyes(mesh: WholeMesh, motion: Array, ball_motion: str) -> Array:
    """Make lids follow the eyeball. ball_motion: "rigid" (the field at its centre) or "none"."""
    result = motion.copy()
    for side in ("left", "right"):
        ball = mesh.tag("eyeball", side)
        rigid = np.zeros(3)
        if ball_motion == "rigid":
            rigid = motion[ball].mean(0)
        result[ball] = rigid
        for tag in ("lid_edge", "lid_hidden"):
            result[mesh.tag(tag, side)] = rigid
        for k, share in enumerate(_LID_SHARE):
            ring = mesh.tag(f"lid{k}", side)
            result[ring] = rigid + share * (motion[ring] - rigid)
    return result


def eye_center(side: str) -> Array:
    """Return eyeball centre (3,) mm."""
    return EYE_CENTER * [1.0 if side == "left" else -1.0, 1.0, 1.0]
