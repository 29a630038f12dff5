"""Make and edit heads in the model's space: everything that a picture needs but the camera.

FLAME's parameters (the tracked mesh) and the residual codes are separate inputs of the model, so
each can be changed alone. Examples are one subject's codes with another's expression, a wider jaw
under the same codes, and a code moved along its principal directions under the same jaw.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from express50.console import count
from express50.errors import ConfigError, check_known, few, nearest
from express50.geometry.transforms import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quat,
    quat_to_matrix,
    slerp,
)
from grmm.checkpoint import Checkpoint
from grmm.data import Tracked, padded, pose_state, stacked
from grmm.model import HeadState

ANGLES = {"neck": 3, "jaw": 3, "eyes": 6}  # axis-angles by name, radians
CODES = ("z_id", "z_exp")
LARGEST = 1000.0  # of a control; far beyond any head, and float32 still holds what it makes
POSES = {  # sliders of joints: controls, range in radians
    "jaw open": (("jaw.0",), (-0.1, 0.6)),
    "jaw sideways": (("jaw.1",), (-0.2, 0.2)),
    "neck nod": (("neck.0",), (-0.5, 0.5)),
    "neck turn": (("neck.1",), (-0.7, 0.7)),
    "neck tilt": (("neck.2",), (-0.4, 0.4)),
    "gaze up, down": (("eyes.0", "eyes.3"), (-0.4, 0.4)),
    "gaze sideways": (("eyes.1", "eyes.4"), (-0.5, 0.5)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadCodes:
    """One head: residual codes and head-model parameters."""

    z_id: Tensor  # residual identity code
    z_exp: Tensor  # residual expression code
    tracked: Tracked  # head-model parameters; (R, t) has no effect on pictures in head space

    def state(self, loaded: Checkpoint) -> HeadState:
        """Return the posed mesh in head space."""
        return pose_state(loaded.head, self.tracked)


def trained_head(loaded: Checkpoint, subject: str, expression: str) -> HeadCodes:
    """Return a training subject with a training expression, by transfer if it never showed it.

    Raises:
        ConfigError: the checkpoint has no such subject or expression.
    """
    model, frames = loaded.model, loaded.gallery.frames
    check_known("the checkpoint", "subject", [subject], model.subjects)
    check_known("the checkpoint", "expression", [expression], model.expressions)
    tracked = frames.get((subject, expression))
    if tracked is None:
        donor = next(s for s, e in frames if e == expression)
        own = next(frame for (s, _), frame in frames.items() if s == subject)
        tracked = transfer(own, frames[donor, expression])
    z_id, z_exp = model.codes(*model.rows(subject, expression))
    return HeadCodes(z_id=z_id.detach(), z_exp=z_exp.detach(), tracked=tracked)


def with_expression(identity: HeadCodes, expression: HeadCodes) -> HeadCodes:
    """Transfer an expression: combine one head's identity with another's expression."""
    return HeadCodes(
        z_id=identity.z_id,
        z_exp=expression.z_exp,
        tracked=transfer(identity.tracked, expression.tracked),
    )


def between(a: HeadCodes, b: HeadCodes, t: float) -> HeadCodes:
    """Blend codes and parameters from a (``t`` = 0) to b (1)."""
    return HeadCodes(
        z_id=torch.lerp(a.z_id, b.z_id, t),
        z_exp=torch.lerp(a.z_exp, b.z_exp, t),
        tracked=interpolate_tracked(a.tracked, b.tracked, t),
    )


def transfer(identity: Tracked, expression: Tracked) -> Tracked:
    """Combine one frame's head and place with another's expression, jaw, neck and eyes."""
    own = {name: getattr(identity, name) for name in ("shape", "R", "t", "offsets")}
    return replace(expression, **own)


def interpolate_tracked(a: Tracked, b: Tracked, t: float) -> Tracked:
    """Blend parameters from a (t = 0) to b (1): linear, but jaw, neck and eyes by SLERP.

    Source: the paper's supplement, locality regularisation; place (R, t) stays a's.
    """
    return Tracked(
        shape=_lerp(a.shape, b.shape, t),
        expression=_lerp(a.expression, b.expression, t),
        neck=slerp_axis_angle(a.neck, b.neck, t),
        jaw=slerp_axis_angle(a.jaw, b.jaw, t),
        eyes=np.concatenate(
            [slerp_axis_angle(a.eyes[i : i + 3], b.eyes[i : i + 3], t) for i in (0, 3)]
        ),
        R=a.R,
        t=a.t,
        offsets=_lerp(a.offsets, b.offsets, t),
    )


def slerp_axis_angle(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """Interpolate axis-angle vectors (3,), radians, spherically along the shorter arc."""
    start, end = (matrix_to_quat(axis_angle_to_matrix(np.asarray(x, np.float64))) for x in (a, b))
    return matrix_to_axis_angle(quat_to_matrix(slerp(start, end, t)))


def controlled(
    loaded: Checkpoint, head: HeadCodes, controls: Mapping[str, Sequence[float]]
) -> HeadCodes:
    """Change single parameters of a head; all others stay.

    Names: ``jaw``, ``neck``, ``eyes`` (axis-angles, radians; three numbers turn both eyes),
    ``jaw.0`` for one entry, ``shape.3``, ``expression.NAME`` or ``expression.3`` (coefficients);
    ``z_id`` and ``z_exp`` scale a code about zero, ``z_id.0`` moves it that many standard
    deviations along a principal direction of the training codes.

    Raises:
        ConfigError: no such parameter, a wrong count of numbers, or one beyond `LARGEST`.
    """
    for name, values in controls.items():
        for value in values:
            if not abs(value) <= LARGEST:  # NaN too
                raise ConfigError(
                    f"control {name}: got {value:g}, expected {-LARGEST:g} to {LARGEST:g}"
                )
        table, _, entry = name.partition(".")
        if table in CODES:
            (amount,), code = _numbers(values, 1, name), getattr(head, table)
            moved = amount * code
            if entry:
                codes = getattr(loaded.model, table)
                directions = principal_directions(codes)
                what = f"principal directions of {count(len(codes), 'training code')}"
                number = _entry(entry, len(directions), name, what)
                moved = code + amount * directions[number]
            head = replace(head, **{table: moved})
        elif table in (*ANGLES, "shape", "expression"):
            tracked = _with_parameter(loaded, head.tracked, table, entry, values, name)
            head = replace(head, tracked=tracked)
        else:
            known = (*ANGLES, "shape", "expression", *CODES)
            entries = [f"expression.{one}" for one in loaded.head.expression_names]
            hint = nearest(table, known) or nearest(name, entries) or _joint_hint(name)
            raise ConfigError(
                f"control {name!r} is unknown{hint}; expected {', '.join(known)}, with .NUMBER or"
                " .NAME for one entry"
            )
    return head


@lru_cache(maxsize=4)  # called often by the sliders
def principal_directions(codes: Tensor) -> Tensor:
    """Find the principal directions (K, D) of a checkpoint's codes (S, D), one deviation long."""
    centred = codes.detach().double() - codes.detach().double().mean(0)
    _, spread, directions = torch.linalg.svd(centred, full_matrices=False)
    kept = spread > 1e-9 * spread.max().clamp_min(1e-12)
    scaled = spread[kept, None] / (len(codes) - 1) ** 0.5 * directions[kept]
    # The sign of a singular vector is arbitrary: its largest entry shall be positive.
    largest = scaled.gather(1, scaled.abs().argmax(1, keepdim=True))
    return (scaled * largest.sign()).to(codes.dtype)


def sample_identity(
    loaded: Checkpoint, head: HeadCodes, rng: np.random.Generator, spread: float
) -> HeadCodes:
    """Draw a new person with the given head's expression.

    Codes, shape and offsets are drawn together from the Gaussian that the training subjects
    span (``spread`` 1 has their covariance), so that a face and its skin still belong together.

    Raises:
        ConfigError: the checkpoint has fewer than two subjects.
    """
    model, frames = loaded.model, loaded.gallery.frames
    own = [next(t for (s, _), t in frames.items() if s == subject) for subject in model.subjects]
    weights = _sample_weights(len(own), rng, spread, "subject")
    shape = np.tensordot(weights, stacked([frame.shape for frame in own]), 1)
    offsets = np.tensordot(weights, stacked([frame.offsets for frame in own]), 1)
    z_id = torch.as_tensor(weights).to(model.z_id) @ model.z_id.detach()
    tracked = replace(head.tracked, shape=shape, offsets=offsets.astype(np.float32))
    return replace(head, z_id=z_id, tracked=tracked)


def sample_expression(
    loaded: Checkpoint, head: HeadCodes, rng: np.random.Generator, spread: float
) -> HeadCodes:
    """Draw a new expression for the given person, as `sample_identity` draws people.

    Coefficients and jaw stay within what training showed: activations have bounds.
    """
    model, frames = loaded.model, loaded.gallery.frames
    weights = _sample_weights(len(model.expressions), rng, spread, "expression")
    length = max(len(frame.expression) for frame in frames.values())

    def drawn(name: str, size: int) -> np.ndarray:
        rows = [
            [padded(getattr(f, name), size) for (_, e), f in frames.items() if e == expression]
            for expression in model.expressions
        ]
        every = np.concatenate(rows)
        means = np.tensordot(weights, [np.mean(row, 0) for row in rows], 1)
        return np.clip(means, every.min(0), every.max(0))

    tracked = replace(head.tracked, expression=drawn("expression", length), jaw=drawn("jaw", 3))
    z_exp = torch.as_tensor(weights).to(model.z_exp) @ model.z_exp.detach()
    return replace(head, z_exp=z_exp, tracked=tracked)


def _sample_weights(rows: int, rng: np.random.Generator, spread: float, what: str) -> np.ndarray:
    """Return weights (rows,) that sum to 1; a weighted sum has the rows' mean and covariance."""
    if rows < 2:
        raise ConfigError(f"the checkpoint has {count(rows, what)}, too few to draw new ones from")
    noise = spread * rng.standard_normal(rows) / np.sqrt(rows - 1)
    return 1 / rows + noise - noise.mean()


def _with_parameter(
    loaded: Checkpoint, tracked: Tracked, table: str, entry: str, values: Sequence[float], name: str
) -> Tracked:
    sizes = ANGLES | {
        "shape": loaded.head.shape_dirs.shape[2],
        "expression": len(loaded.head.expression_names),
    }
    changed = padded(np.array(getattr(tracked, table), dtype=np.float64), sizes[table])
    if entry:
        names = loaded.head.expression_names if table == "expression" else ()
        place = _entry(entry, sizes[table], name, f"{table} parameters", names)
        (changed[place],) = _numbers(values, 1, name)
    elif table in ANGLES:
        twice = table == "eyes" and len(values) == 3
        changed[:] = _numbers([*values, *values] if twice else values, sizes[table], name)
    else:
        raise ConfigError(f"control {name!r}: expected one entry, for example {table}.0")
    return replace(tracked, **{table: changed})


def _numbers(values: Sequence[float], size: int, name: str) -> Sequence[float]:
    if len(values) != size:
        many = f" with commas between, or {name}.0 to {name}.{size - 1} with one"
        raise ConfigError(
            f"control {name}: got {count(len(values), 'number')}, expected {size}"
            + (many if size > 1 else "")
        )
    return values


def _entry(text: str, size: int, name: str, what: str, names: Sequence[str] = ()) -> int:
    if text in names:
        return names.index(text)
    if text.isdecimal() and int(text) < size:
        return int(text)
    expected = f"expected 0 to {size - 1}" if size > 1 else "expected 0"
    if not size:
        expected = "one person or expression has none"
    if names:
        alike = [known for known in names if text.casefold() in known.casefold()]
        expected += f", or a name such as {few(alike or names)}"
        expected += nearest(text, names) or _joint_hint(text)
    raise ConfigError(f"control {name!r} is none of the {what} ({size}); {expected}")


def _joint_hint(text: str) -> str:
    """Return a hint at the joint that does what jawOpen or the like names, else nothing."""
    found = (controls for name, (controls, _) in POSES.items() if nearest(text, [name]))
    names = " and ".join(map(repr, next(found, ())))
    return f" (did you mean {names}?)" if names else ""


def _lerp(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """Blend, (1 - t) a + t b; the shorter one is padded with zeros."""
    if a is b:
        return a
    first, last = stacked([a, b])
    return ((1 - t) * first + t * last).astype(a.dtype)
