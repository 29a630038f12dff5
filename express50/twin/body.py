"""Build a subject's geometry (head, hair, shoulders and what is worn), and pose it for a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from express50.geometry.sampling import smoothstep
from express50.geometry.transforms import rigid_fit, transform_points
from express50.head.model import HeadModel, landmarks, pose
from express50.twin.hair import HairMesh, grow_hair
from express50.twin.subjects import TwinPerformance, TwinSubject
from express50.twin.surface import (
    Caster,
    Material,
    StarMap,
    joined_arrays,
    smooth_over_mesh,
    vertex_normals,
)
from express50.twin.worn import WITH_HAND, WornMesh, grow_worn, hold, wear


@dataclass(frozen=True, kw_only=True)
class Extras:
    """Geometry besides the head model, in rest head space."""

    hair: HairMesh  # of scalp and face; may be empty
    cloth_vertices: np.ndarray  # shoulders, rigid with the root
    cloth_faces: np.ndarray
    skull: np.ndarray  # (K,) head vertices that hair follows
    skull_rest: np.ndarray  # (K, 3) their positions at rest
    worn: WornMesh  # may be empty
    hand: np.ndarray  # (F, 4, 4) rest head space from hand space; empty without a hand


@dataclass(frozen=True, kw_only=True)
class Body:
    """One subject's geometry that is the same in all frames."""

    model: HeadModel
    subject: TwinSubject
    faces: np.ndarray  # (F, 3) of the head, hair, shoulders, then what is worn, as one mesh
    material: np.ndarray  # (F,) uint8; lenses are last
    solid: int  # number of faces before the lenses
    rest: np.ndarray  # (V, 3) the subject's neutral head
    template: np.ndarray  # (V, 3) float32, the mean head, where textures live
    scalp: np.ndarray  # (V,) float32 hairiness, soft at the hairline
    centre: np.ndarray  # (3,) of the head, template space
    extras: Extras


def build_body(
    model: HeadModel,
    subject: TwinSubject,
    seed: int,
    hair_detail: float = 1.0,
    kinds: tuple[str, ...] = (),
) -> Body:
    """Build the geometry of a subject, and what it wears of the `config.KINDS`.

    With a hair detail of 0 the scalp is bald.
    """
    template = model.template.double().numpy()
    faces = model.faces.numpy().astype(np.int32)
    centre = head_centre(model)
    scalp = smooth_over_mesh(model.regions["scalp"].numpy().astype(np.float32), faces, 2)
    scalp = np.where(model.regions["scalp"].numpy(), np.clip(2.0 * scalp - 1.0, 0.0, 1.0), 0.0)
    # Hair ends at the nape, even if a model's scalp mask extends further.
    chin = landmarks(model, model.template[None])[0, 8, 1].item()
    scalp = scalp * smoothstep(template[:, 1], chin - 0.005, chin + 0.025)
    rest = rest_vertices(model, subject)
    skin_faces = faces[model_materials(model)[faces].min(1) == Material.SKIN]
    cloth_vertices, cloth_faces = _shoulders(rest, skin_faces, model.regions["boundary"].numpy())
    # Hair lies on skin and on the shirt.
    star = StarMap(
        np.concatenate([rest, cloth_vertices]),
        np.concatenate([skin_faces, cloth_faces + len(rest)]),
        centre,
    )
    rng = np.random.default_rng([seed, subject.number, 7])
    hair = grow_hair(rng, rest, faces, scalp, star, subject.look, hair_detail)
    # Worn hair has its own random numbers, so that it does not change the rest of the person.
    seeds = [seed, subject.number, 13]
    grown = grow_worn(kinds, model, rest, scalp, star, subject.look, hair_detail or 1.0, seeds)
    hair = HairMesh(**joined_arrays([hair, *grown]))
    worn = wear(kinds, model, rest, skin_faces, subject.look, np.random.default_rng(seeds))
    skull = np.flatnonzero(scalp > 0.8)[::7]
    extras = Extras(
        hair=hair, cloth_vertices=cloth_vertices, cloth_faces=cloth_faces,
        skull=skull, skull_rest=rest[skull], worn=worn, hand=np.zeros((0, 4, 4)),
    )  # fmt: skip
    return assemble(model, subject, extras, scalp.astype(np.float32), centre)


def rest_vertices(model: HeadModel, subject: TwinSubject) -> np.ndarray:
    """Return the neutral vertices (V, 3) of a subject's head."""
    template = model.template.double().numpy()
    return template + model.shape_dirs.double().numpy() @ subject.shape + subject.offsets


def with_hand(body: Body, play: TwinPerformance, seed: int) -> Body:
    """Return the body with its hand, if any, in front of a part of the face per cue window."""

    def heads(frame: int) -> tuple[np.ndarray, np.ndarray]:
        _, _, own = _skull_at_rest(body, play, frame)
        return own, vertex_normals(own, body.model.faces.numpy())

    seeds = [seed, body.subject.number, 14]
    worn, cues = body.extras.worn, play.cues
    hand = hold(worn, heads, body.model, cues, play.peaks, play.frames, seeds)
    return replace(body, extras=replace(body.extras, hand=hand))


def assemble(
    model: HeadModel, subject: TwinSubject, extras: Extras, scalp: np.ndarray, centre: np.ndarray
) -> Body:
    """Join head, hair, shoulders and what is worn into one body."""
    faces = model.faces.numpy().astype(np.int32)
    heads, hairs = len(model.template), len(extras.hair.vertices)
    labels = model_materials(model)
    head_material = labels[faces].max(1)
    # A triangle between skin and the inside of the mouth is lip.
    mixed = (labels[faces] == Material.SKIN).any(1) & (head_material == Material.MOUTH)
    head_material[mixed] = Material.SKIN
    shown = head_material != Material.HIDDEN
    cloths, worn = len(extras.cloth_vertices), extras.worn
    joined = np.concatenate(
        [
            faces[shown], extras.hair.faces + heads, extras.cloth_faces + heads + hairs,
            worn.faces + heads + hairs + cloths,
        ]
    ).astype(np.int32)  # fmt: skip
    counts = len(extras.hair.faces), len(extras.cloth_faces)
    others = np.repeat(np.array([Material.HAIR, Material.CLOTH], np.uint8), counts)
    material = np.concatenate([head_material[shown], others, worn.material])
    return Body(
        model=model, subject=subject, faces=joined, material=material,
        solid=int((material != Material.LENS).sum()), rest=rest_vertices(model, subject),
        template=model.template.numpy(), scalp=scalp, centre=centre, extras=extras,
    )  # fmt: skip


def model_materials(model: HeadModel) -> np.ndarray:
    """Return the material (V,) uint8 of each head vertex, from the model's regions."""
    # ICT-FaceKit's opaque lashes and the sockets behind its eyes are in no region.
    named = np.any([mask.numpy() for mask in model.regions.values()], axis=0)
    labels = np.where(named, Material.SKIN, Material.HIDDEN).astype(np.uint8)
    for region, material in (
        ("mouth_interior", Material.MOUTH),
        ("tongue", Material.TONGUE),
        ("teeth", Material.TEETH),
        ("left_eyeball", Material.EYE),
        ("right_eyeball", Material.EYE),
    ):
        labels[model.regions[region].numpy()] = material
    return labels


def head_centre(model: HeadModel) -> np.ndarray:
    """Return a point (3,) inside the skull from which face, scalp and ears are all visible."""
    template = model.template.double().numpy()
    head = template[(model.regions["face"] | model.regions["scalp"]).numpy()]
    joints = model.joint_regressor.double().numpy() @ template
    middle = 0.5 * (head.min(0) + head.max(0))
    return np.array([0.0, joints[3:5, 1].mean() - 0.01, middle[2] - 0.01])


def head_vertices(
    model: HeadModel, subject: TwinSubject, play: TwinPerformance, frame: int
) -> np.ndarray:
    """Return vertices (V, 3) of the posed head model in the world, metres."""
    offsets = subject.offsets
    if subject.own is not None:
        offsets = offsets + own_offsets(model, subject.own, play.expression[frame])

    def row(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float32))[None]

    with torch.no_grad():
        posed = pose(
            model,
            row(subject.shape),
            row(play.expression[frame]),
            neck=row(play.neck[frame]),
            jaw=row(play.jaw[frame]),
            eyes=row(play.eyes[frame]),
            offsets=row(offsets),
        )
    return posed[0].double().numpy() @ play.R[frame].T + play.t[frame]


def own_offsets(model: HeadModel, own: np.ndarray, expression: np.ndarray) -> np.ndarray:
    """Return the rest offsets (V, 3) that own motion (V, 3, 3) adds to an expression (X,)."""
    moved = model.expression_dirs.double().numpy() @ expression
    return np.einsum("vij,vj->vi", own, moved)


@dataclass(frozen=True, kw_only=True)
class Posed:
    """All geometry of one frame in the world: vertices and normals (N, 3), hair's tangents."""

    vertices: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray


def pose_body(body: Body, play: TwinPerformance, frame: int) -> Posed:
    """Pose head, hair, shoulders and what is worn for a frame."""
    extras, hair, worn = body.extras, body.extras.hair, body.extras.worn
    turn, shift, own = _skull_at_rest(body, play, frame)
    head = own @ turn.T + shift

    def moved(vertices: np.ndarray, moves: np.ndarray) -> np.ndarray:
        out = vertices.astype(np.float64)
        skin, held = moves >= 0, moves == WITH_HAND
        out[skin] += (own - body.rest)[moves[skin]]
        if held.any():
            out[held] = transform_points(extras.hand[frame], out[held])
        return out @ turn.T + shift

    cloth = extras.cloth_vertices @ play.R[frame].T + play.t[frame]
    solid = np.concatenate([head, cloth]).astype(np.float32)
    solid_faces = np.concatenate([body.model.faces.numpy(), extras.cloth_faces + len(head)])
    normals = vertex_normals(solid, solid_faces)
    things = moved(worn.vertices, worn.moves)
    bent = [normals[: len(head)], hair.normals @ turn.T, normals[len(head) :]]
    bent.append(vertex_normals(things, worn.faces))
    return Posed(
        vertices=np.concatenate([head, moved(hair.vertices, hair.moves), cloth, things]).astype(
            np.float32
        ),
        normals=np.concatenate(bent).astype(np.float32),
        tangents=(hair.tangents @ turn.T).astype(np.float32),
    )


def _skull_at_rest(
    body: Body, play: TwinPerformance, frame: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the skull's motion R (3, 3) and t (3,), and the head (V, 3) without it."""
    head = head_vertices(body.model, body.subject, play, frame)
    turn, shift = rigid_fit(body.extras.skull_rest, head[body.extras.skull])
    return turn, shift, (head - shift) @ turn


def _shoulders(
    rest: np.ndarray, skin_faces: np.ndarray, boundary: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make a shirt, vertices (N, 3) and faces (M, 3), that widens from a collar around the neck."""
    loop = rest[boundary]
    low, high = loop.min(0), loop.max(0)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    around, s = np.meshgrid(np.linspace(0, 2 * np.pi, 65)[:-1], np.linspace(0.0, 1.0, 24))
    c, z = np.cos(around), np.sin(around)
    flare = np.sin(0.5 * np.pi * np.minimum(1.0, 1.35 * s)) ** 0.8
    width = half[0] * (1 - flare) + max(0.2, half[0] + 0.05) * flare
    depth = half[2] * (1 - flare) + max(0.105, half[2] + 0.02) * flare
    # From an ellipse at the collar to a rounder box at the shoulders.
    power = 2.0 + 0.8 * flare
    scale = (np.abs(c) ** power + np.abs(z) ** power) ** (-1.0 / power)
    # The collar follows the neck's open edge, so that nobody sees into the neck.
    bearing = np.arctan2(loop[:, 2] - centre[2], loop[:, 0] - centre[0])
    edge = np.interp(around, bearing % (2 * np.pi), loop[:, 1] - centre[1], period=2 * np.pi)
    drop = 0.012 + edge * (1 - flare) - 0.10 * flare**2.2 - 0.24 * s**3
    shirt = np.stack([width * scale * c, drop, -0.02 * flare + depth * scale * z], axis=-1)
    shirt = shirt.reshape(-1, 3) + centre
    # It is pushed away from the neck's axis, horizontally, until it clears the skin.
    level = (shirt - centre) * (1.0, 0.0, 1.0)
    radius = np.linalg.norm(level, axis=1, keepdims=True)
    out = level / np.maximum(radius, 1e-6)
    distance, _, _ = Caster(rest, skin_faces).cast(shirt - level + 0.5 * out, -out)
    skin = np.where(distance < 0.5, 0.5 - distance, 0.0)[:, None]
    shirt = shirt + out * np.maximum(skin + 0.0035 - radius, 0.0)
    index = np.arange(shirt.shape[0]).reshape(around.shape)
    a, b = index[:-1], index[1:]
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([c, d, b], -1)]).reshape(-1, 3)
    return shirt.astype(np.float32), faces.astype(np.int32)
