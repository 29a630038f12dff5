"""Run the rounds of tracking: read evidence from pictures on the current mesh, fit, again.

Every round makes the terms of every expression again, as outlines, visibility and patches depend on
the mesh. The schedule is a table, made once from the settings and written to metrics.json.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

import numpy as np

from express50.capture.frames import reduced
from express50.contract.layout import Dataset
from express50.head.model import HeadModel
from pipelines.regions.colour import judge_scalp, scalp_votes
from pipelines.regions.geometry import head_labels, make_head, render_head
from pipelines.regions.things import Picture, face_views, find_glasses
from pipelines.track.basis import ALONG, OFF, Basis, freeze_shape
from pipelines.track.config import TrackConfig
from pipelines.track.eyes_and_jaw import EyeOffsets, measure_eyes, with_irises_and_jaw
from pipelines.track.face_uv import (
    FINE,
    FaceUvMap,
    make_uv_map,
    reading_map,
    skin_flows,
    slide_term,
    with_slide,
)
from pipelines.track.fit import fit
from pipelines.track.outline import outline_terms
from pipelines.track.photo_consistency import SkinSamples, patch_terms, skin_samples, under_hair
from pipelines.track.read_inputs import peak_pictures
from pipelines.track.state import State, Target, all_vertices, rotations
from pipelines.track.surface import FrameSetCrops, mask_things, near_things
from pipelines.track.terms import NormalTerm, SlideTerm, Term, landmark_anchors

LANDMARK_STEPS = 14  # in the first fit, to landmarks alone; 6 steps measure the same on the twin
ROUND_STEPS = 4  # in the fit of each round
EYE_ROUNDS = 2  # least number of rounds, as irises and visible jaw lines are found in each
PATCH_REACH_M = 0.008  # to either side of the mesh, in the first search
NARROWING, NARROWINGS = 0.6, 3  # factor on the reach from round to round, and in how many rounds
HAIR_FACTOR = 30.0  # on the standard deviation of a landmark in hair
NEAR_THING_M, NEAR_THING_FACTOR = 0.02, 6.0  # the same for a landmark this close to a thing
THING_SIDE = 320  # pixels, about a millimetre each, of crops in which things are searched for
THING_SPACING_M = 0.003  # between the places on a thing that are kept
THING_ROUNDS = (0, 2)  # rounds in which things are searched for; more find the same
SKIN_ROUNDS = 3  # rounds in which the skin's texture is followed
# Trust in patches grows by this factor per round: far from the surface whole groups of them may
# match wrongly.
TRUST_GROWTH = 1 / 0.3


@dataclass(frozen=True)
class Round:
    """The evidence of one round; landmarks, irises and the jaw line are always in."""

    outlines: bool  # fit the outlines of the mattes
    patch_reach_m: float  # how far along the normals the surface is searched for; 0 for no search
    patch_weight: float  # trust in what the search finds
    read_uv: bool  # find landmarks on the face UV map again; otherwise the last reading stays
    # follow the skin's texture from the resting face to the other expressions. The shape is held:
    # the texture shows how a face moves, not what it is.
    follow_skin: bool = False


Schedule = tuple[Round, ...]


def make_schedule(outline_rounds: int, patch_rounds: int, uv_rounds: int) -> Schedule:
    """Lay out the rounds: outlines in the last ones, UV landmarks in the first.

    The search narrows over the first rounds and gains trust towards the last. With both patches and
    UV landmarks, more rounds follow the skin.
    """
    count = max(outline_rounds, patch_rounds, EYE_ROUNDS)
    rounds = tuple(
        Round(
            outlines=count - index <= outline_rounds,
            patch_reach_m=PATCH_REACH_M * NARROWING ** min(index, NARROWINGS) * (patch_rounds > 0),
            patch_weight=TRUST_GROWTH ** -max(patch_rounds - 1 - index, 0),
            read_uv=index < uv_rounds,
        )
        for index in range(count)
    )
    if not (patch_rounds and uv_rounds):
        return rounds
    return rounds + SKIN_ROUNDS * (replace(rounds[-1], read_uv=False, follow_skin=True),)


def schedule_table(schedule: Schedule) -> list[dict[str, object]]:
    """Write the schedule for metrics.json: one row per round."""
    return [
        {"round": number} | {
            key: float(f"{value:.4g}") if isinstance(value, float) else value
            for key, value in asdict(one).items()
        }
        for number, one in enumerate(schedule, 1)
    ]  # fmt: skip


@dataclass(frozen=True)
class SubjectEvidence:
    """Inputs that all rounds of a subject share."""

    pictures: list[FrameSetCrops]  # of every expression's frame set
    skin: SkinSamples  # where the surface is searched for
    uv_map: FaceUvMap | None  # of the face; None if no round reads it
    fine_map: FaceUvMap | None  # of the face, to follow the skin on; None if no round does
    eyes: EyeOffsets | None  # from `measure_eyes`
    bald: bool  # the skull is bare

    @property
    def outlines(self) -> int:
        """Return the number of mattes that have an outline."""
        return sum(len(pictures.distances) for pictures in self.pictures)


def read_evidence(
    dataset: Dataset,
    subject: str,
    config: TrackConfig,
    model: HeadModel,
    targets: list[Target],
    state: State,
    schedule: Schedule,
) -> SubjectEvidence:
    """Read the pictures about the meshes of the fit to landmarks, and what the rounds share."""
    meshes = all_vertices(model, state)
    pictures = [
        peak_pictures(dataset, subject, config.photo_side, target.observation.expression, mesh)
        for target, mesh in zip(targets, meshes, strict=True)
    ]
    turns = rotations(state)
    first = next((k for k, one in enumerate(pictures) if one.crops), None)
    return SubjectEvidence(
        pictures,
        skin_samples(model, config.samples),
        reading_map(model) if any(one.read_uv for one in schedule) else None,
        make_uv_map(model, FINE) if any(one.follow_skin for one in schedule) else None,
        measure_eyes(model, targets, meshes, turns),
        first is not None and is_bald(model, pictures[first], meshes[first], turns[first]),
    )


def is_bald(
    model: HeadModel, pictures: FrameSetCrops, mesh: np.ndarray, rotation: np.ndarray
) -> bool:
    """Return whether the skull is bare; under hair it can be centimetres inside the outline.

    The mesh (V, 3) is fitted roughly; `rotation` is world from head.
    """
    head = make_head(mesh, rotation, head_labels(model))
    votes = [
        scalp_votes(rgb, render_head(head, camera)[0], alpha)
        for camera, rgb, alpha in matted_pictures(pictures)
    ]
    # A single picture cannot distinguish fair hair from skin.
    return sum(count > 0 for count, _ in votes) > 1 and judge_scalp(votes).is_skin


@dataclass(frozen=True)
class FoundInRounds:
    """What the rounds keep of one expression."""

    # places (n, 3) on things in front of the face, mostly hands
    things: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    glasses: np.ndarray | None = None  # places (n, 3) on glasses, which are found once; None before
    slide: SlideTerm | None = None  # the last reading of the face UV map

    @property
    def hiding(self) -> np.ndarray:
        """Return the places (n, 3) on everything that hides the face."""
        return self.things if self.glasses is None else np.concatenate([self.things, self.glasses])


def refine(
    basis: Basis, targets: list[Target], state: State, evidence: SubjectEvidence, schedule: Schedule
) -> tuple[State, list[Target], list[np.ndarray]]:
    """Run the rounds; also return the targets with their last terms, and places on glasses."""
    model, fitted = basis.model, targets
    found = [FoundInRounds() for _ in targets]
    rest = next((k for k, target in enumerate(targets) if target.neutral), None)
    for number, current in enumerate(schedule):
        meshes, turns = all_vertices(model, state), rotations(state)
        flows = {}
        if current.follow_skin and evidence.fine_map is not None:
            pairs = zip(evidence.pictures, found, strict=True)
            clear = [mask_things(pictures, own.hiding) for pictures, own in pairs]
            flows = skin_flows(model, evidence.fine_map, clear, meshes, rest)
        if current.patch_reach_m and number in THING_ROUNDS:
            rows = zip(found, evidence.pictures, meshes, turns, strict=True)
            found = [with_things(model, *row) for row in rows]
        fitted = []
        for index, (target, mesh) in enumerate(zip(targets, meshes, strict=True)):
            hidden = under_hair(model, evidence.skin, evidence.pictures[index], mesh)
            pictures = mask_things(evidence.pictures[index], found[index].hiding)
            if current.read_uv and evidence.uv_map is not None:
                slide = slide_term(model, evidence.uv_map, pictures, mesh, hidden)
                found[index] = replace(found[index], slide=slide)
            own = found[index]
            terms = round_terms(model, current, evidence, pictures, mesh, hidden, own.hiding)
            sigma = widened_sigma(model, target, hidden, own.things)
            terms = (*target.terms, *terms, *flows.get(index, ()))
            target = replace(target, terms=terms, sigma=sigma)
            target = with_irises_and_jaw(model, target, mesh, turns[index], evidence.eyes)
            fitted.append(with_slide(target, own.slide))
        if current.follow_skin:
            person = freeze_shape(basis, state.shape, state.bias)
            moved, _ = fit(person, fitted, State(np.zeros(0), state.poses), ROUND_STEPS)
            state = replace(state, poses=moved.poses)
        else:
            state, _ = fit(basis, fitted, state, ROUND_STEPS, free_modes(fitted))
    return state, fitted, final_glasses(model, found, evidence.pictures, state)


def round_terms(
    model: HeadModel,
    current: Round,
    evidence: SubjectEvidence,
    pictures: FrameSetCrops,
    mesh: np.ndarray,
    hidden: np.ndarray,
    hiding: np.ndarray,
) -> tuple[Term, ...]:
    """Make a round's terms of outlines and patches on the current mesh (V, 3).

    `hidden` (V,) are vertices in hair, `hiding` are places (n, 3) on what hides the face, which
    the mattes of the pictures leave out.
    """
    terms: list[Term] = []
    if current.outlines:
        count, bald = evidence.outlines, evidence.bald
        terms += outline_terms(model, pictures.distances, mesh, count, bald, hidden, hiding)
    if current.patch_reach_m:
        reach, weight = current.patch_reach_m, current.patch_weight
        terms += patch_terms(model, evidence.skin, pictures, mesh, reach, weight, hidden)
    return tuple(terms)


def with_things(
    model: HeadModel,
    found: FoundInRounds,
    pictures: FrameSetCrops,
    mesh: np.ndarray,
    rotation: np.ndarray,
) -> FoundInRounds:
    """Look for things in front of a mesh (V, 3) again, and for glasses if that was not done yet."""
    things, glasses = find_things(model, pictures, mesh, rotation), found.glasses
    if glasses is None:
        glasses = find_worn_glasses(model, pictures, mesh, rotation)
    return replace(found, things=things, glasses=glasses)


def final_glasses(
    model: HeadModel, found: list[FoundInRounds], pictures: list[FrameSetCrops], state: State
) -> list[np.ndarray]:
    """Find the glasses (n, 3) of the expressions that have some again, on the final meshes.

    The list is empty if no round looked for glasses.
    """
    worn = [one.glasses for one in found if one.glasses is not None]  # of all expressions, or none
    meshes, turns = all_vertices(model, state), rotations(state)
    for index, places in enumerate(worn):
        if len(places):
            worn[index] = find_worn_glasses(model, pictures[index], meshes[index], turns[index])
    return worn


def find_worn_glasses(
    model: HeadModel, pictures: FrameSetCrops, mesh: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Find places (n, 3) on glasses in front of a mesh (V, 3); `rotation` is world from head.

    Landmarks on them keep their weight, because detectors know glasses.
    """
    head, seen = make_head(mesh, rotation, head_labels(model)), matted_pictures(pictures)
    return find_glasses(head, [picture for picture in seen if head.faces_camera(picture[0])])


def find_things(
    model: HeadModel, pictures: FrameSetCrops, mesh: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Find places (n, 3) on other things in front of a mesh (V, 3), mostly hands."""
    head = make_head(mesh, rotation, head_labels(model))
    views = face_views(head, matted_pictures(pictures))
    places = np.concatenate([np.zeros((0, 3)), *(view.things for view in views)])
    cells = np.floor((places - head.center) / THING_SPACING_M)
    return places[np.unique(cells, axis=0, return_index=True)[1]]


def matted_pictures(pictures: FrameSetCrops) -> list[Picture]:
    """Return the crops that have mattes, reduced to THING_SIDE pixels."""
    found = []
    for crop in pictures.crops:
        if crop.alpha is not None:
            camera, rgb, alpha = reduced(crop.camera, crop.image, crop.alpha, THING_SIDE)
            found.append((camera, rgb, alpha.astype(np.float32) / 255))
    return found


def free_modes(targets: list[Target]) -> tuple[str, ...]:
    """Name the offset modes that the targets' terms can determine."""
    kinds = {type(term) for target in targets for term in target.terms}
    return tuple(name for kind, name in ((NormalTerm, OFF), (SlideTerm, ALONG)) if kind in kinds)


def widened_sigma(
    model: HeadModel, target: Target, hidden: np.ndarray, things: np.ndarray
) -> np.ndarray:
    """Return landmarks' sigma (views, 68), larger where hair or a thing hides or may shift them.

    `hidden` (V,) are vertices in hair, `things` are places (n, 3) on other things in front of the
    face. Detectors take a beard's rim for the jaw, and shift the mouth within a beard.
    """
    marks = np.tile(hidden[landmark_anchors(model).vertices].any(1), (len(target.sigma), 1))
    near = np.zeros_like(marks)
    for row, beside, view in zip(marks, near, target.observation.views, strict=True):
        row |= near_things(things, view.camera, view.points)
        beside |= near_things(things, view.camera, view.points, NEAR_THING_M)
    factor = np.where(marks, HAIR_FACTOR, np.where(near, NEAR_THING_FACTOR, 1.0))
    factor[:, :17][marks[:, :17]] = np.inf
    return target.sigma * factor
