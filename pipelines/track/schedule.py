"""Run the rounds of tracking: read evidence from pictures on the current mesh, fit, again.

Every round makes the terms of every expression again, as outlines, visibility and patches depend on
the mesh. The schedule is a table, made once from the settings and written to metrics.json.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from express50.files.images import shrink
from express50.geometry.cameras import resized
from express50.head.model import HeadModel
from pipelines.regions.geometry import head_labels, make_head
from pipelines.regions.things import Picture, face_views, find_glasses
from pipelines.track.basis import ALONG, OFF, Basis, freeze_shape
from pipelines.track.eyes_and_jaw import EyeOffsets, with_irises_and_jaw
from pipelines.track.face_uv import FaceUvMap, make_uv_map, reading_map, slide_term, with_slide
from pipelines.track.fit import fit
from pipelines.track.outline import BALD_SHARE, bare_share, outline_terms
from pipelines.track.photo_consistency import (
    SkinSamples,
    patch_terms,
    skin_samples,
    under_hair,
)
from pipelines.track.skin_flow import FINE, flow_term, skin_map
from pipelines.track.state import State, Target, all_vertices, rotations
from pipelines.track.surface import FrameSetCrops, mask_things, near_things
from pipelines.track.terms import NormalTerm, SlideTerm, landmark_anchors

LANDMARK_STEPS = 14  # of the first fit, to landmarks alone; 6 measure the same on the twin
ROUND_STEPS = 4  # of the fit in each round
EYE_ROUNDS = 2  # least number of rounds, as irises and visible jaw lines are found in each
PATCH_REACH_M = 0.008  # of the first search, to either side of the mesh
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
    """The evidence of one round; landmarks, irises and the jaw line are always in.

    Attributes:
        outlines: fit the outlines of the mattes.
        patch_reach_m: how far along the normals the surface is searched for; 0 for no search.
        patch_weight: trust in what the search finds.
        read_uv: find landmarks on the face UV map again; otherwise the last reading stays.
        follow_skin: follow the skin's texture from the resting face to the other expressions. The
            shape is held: the texture shows how a face moves, not what it is.
    """

    outlines: bool
    patch_reach_m: float
    patch_weight: float
    read_uv: bool
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
    """Inputs that all rounds of a subject share.

    Attributes:
        pictures: of every expression's frame set.
        skin: where the surface is searched for.
        uv_map: of the face; None if no round reads it.
        fine_map: of the face, to follow the skin on; None if no round does.
        eyes: from `measure_eyes`.
        bald: the skull is bare.
    """

    pictures: list[FrameSetCrops]
    skin: SkinSamples
    uv_map: FaceUvMap | None
    fine_map: FaceUvMap | None
    eyes: EyeOffsets | None
    bald: bool


def gather(
    model: HeadModel,
    pictures: list[FrameSetCrops],
    meshes: np.ndarray,
    eyes: EyeOffsets | None,
    samples: int,
    schedule: Schedule,
) -> SubjectEvidence:
    """Prepare what the rounds share; `meshes` (E, V, 3) are of the fit to landmarks."""
    shown = next((k for k, one in enumerate(pictures) if one.crops), None)
    bald = False
    if shown is not None:
        images = pictures[shown].images()
        # A single picture cannot distinguish fair hair from skin.
        bald = len(images) > 1 and bare_share(model, images, meshes[shown]) > BALD_SHARE
    uv_map = reading_map(model) if any(one.read_uv for one in schedule) else None
    fine_map = make_uv_map(model, FINE) if any(one.follow_skin for one in schedule) else None
    skin = skin_samples(model, samples)
    return SubjectEvidence(pictures, skin, uv_map, fine_map, eyes, bald)


def refine(
    basis: Basis, targets: list[Target], state: State, evidence: SubjectEvidence, schedule: Schedule
) -> tuple[State, list[Target], list[np.ndarray]]:
    """Run the rounds; also return the targets with their last terms, and places on glasses."""
    model, found = basis.model, targets
    slides: list[SlideTerm | None] = [None] * len(targets)
    things = [np.zeros((0, 3)) for _ in targets]
    hiding = list(things)  # the things and glasses, by expression
    glasses: dict[int, np.ndarray] = {}  # by expression, found once
    outlines = sum(len(pictures.distances) for pictures in evidence.pictures)
    for number, current in enumerate(schedule):
        meshes, turns, found = all_vertices(model, state), rotations(state), []
        clear = [mask_things(*pair) for pair in zip(evidence.pictures, hiding, strict=True)]
        flows = skin_flows(model, targets, evidence, clear, meshes) if current.follow_skin else {}
        for index, (target, pictures) in enumerate(zip(targets, evidence.pictures, strict=True)):
            mesh, terms = meshes[index], [*target.terms]
            hidden = under_hair(model, evidence.skin, pictures, mesh)
            if current.patch_reach_m and number in THING_ROUNDS:
                things[index] = find_things(model, pictures, mesh, turns[index])
                if index not in glasses:
                    glasses[index] = find_worn_glasses(model, pictures, mesh, turns[index])
                hiding[index] = np.concatenate([things[index], glasses[index]])
            pictures = mask_things(pictures, hiding[index])
            if current.outlines:
                terms += outline_terms(
                    model, pictures.distances, mesh, outlines, evidence.bald, hidden, hiding[index]
                )
            if current.patch_reach_m:
                reach, weight = current.patch_reach_m, current.patch_weight
                terms += patch_terms(model, evidence.skin, pictures, mesh, reach, weight, hidden)
            if current.read_uv and evidence.uv_map is not None:
                slides[index] = slide_term(model, evidence.uv_map, pictures, mesh, hidden)
            terms += flows.get(index, [])
            sigma = widened_sigma(model, target, hidden, things[index])
            target = replace(target, terms=tuple(terms), sigma=sigma)
            target = with_irises_and_jaw(model, target, mesh, turns[index], evidence.eyes)
            found.append(with_slide(target, slides[index]))
        if current.follow_skin:
            person = freeze_shape(basis, state.shape, state.bias)
            moved, _ = fit(person, found, State(np.zeros(0), state.poses), ROUND_STEPS)
            state = replace(state, poses=moved.poses)
        else:
            state, _ = fit(basis, found, state, ROUND_STEPS, free_modes(found))
    meshes, turns = all_vertices(model, state), rotations(state)
    worn = [glasses[index] for index in sorted(glasses)]  # of all expressions, or never looked for
    for index, places in enumerate(worn):
        if len(places):
            worn[index] = find_worn_glasses(
                model, evidence.pictures[index], meshes[index], turns[index]
            )
    return state, found, worn


def find_worn_glasses(
    model: HeadModel, pictures: FrameSetCrops, mesh: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Find places (n, 3) on glasses in front of a mesh (V, 3); `rotation` is world from head.

    Landmarks on them keep their weight, because detectors know glasses.
    """
    head, seen = make_head(mesh, rotation, head_labels(model)), matted_pictures(pictures)
    return find_glasses(head, [s for s in seen if (s[0].center - head.center) @ head.R[:, 2] > 0])


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
            rgb = shrink(crop.image, THING_SIDE)
            camera = resized(crop.camera, rgb.shape[1], rgb.shape[0])
            alpha = shrink(crop.alpha, THING_SIDE)
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


def skin_flows(
    model: HeadModel,
    targets: list[Target],
    evidence: SubjectEvidence,
    pictures: list[FrameSetCrops],
    meshes: np.ndarray,
) -> dict[int, list[SlideTerm]]:
    """Follow the skin from the resting face to the other expressions, by their index."""
    rest = next((k for k, target in enumerate(targets) if target.neutral), None)
    uv_map = evidence.fine_map
    if rest is None or uv_map is None:
        return {}
    still = skin_map(model, uv_map, pictures[rest], meshes[rest])
    found = {}
    for index, (own, mesh) in enumerate(zip(pictures, meshes, strict=True)):
        if index != rest:
            moved = skin_map(model, uv_map, own, mesh)
            term = flow_term(uv_map, still, moved, mesh)
            found[index] = [] if term is None else [term]
    return found
