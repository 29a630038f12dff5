"""Rounds of refinement: find on the current mesh what each camera should see, fit, look again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from express50.head.model import HeadModel
from pipelines.track.appearance import Appearance
from pipelines.track.chart.network import reading_chart
from pipelines.track.config import TrackConfig
from pipelines.track.fit import fit
from pipelines.track.hair import is_bald
from pipelines.track.marks import Eyes, with_marks
from pipelines.track.offsets import ALONG, OFF
from pipelines.track.outline import Outline, outline_regions, outline_vertices
from pipelines.track.pictures import Moment, see, with_photometry, with_relief
from pipelines.track.relief import Relief
from pipelines.track.samples import COVERED, spread
from pipelines.track.shots import root_light
from pipelines.track.slide import Slide, read_slide, with_slides
from pipelines.track.sparse_head import Basis
from pipelines.track.state import State, Target, all_vertices, rotations

# Irises, and jaw lines where they are seen, are found anew at least so often.
MARK_ROUNDS = 2
# Of neck and ears, samples for each of the face's, and how far to trust what is found there.
COVERED_SHARE, COVERED_TRUST = 0.25, 0.3


def refine(
    basis: Basis,
    targets: list[Target],
    state: State,
    moments: list[Moment],
    eyes: Eyes | None,
    config: TrackConfig,
) -> tuple[State, list[Target], Appearance | None]:
    """Alternate between reading the pictures with the current meshes and fitting to what was read.

    First the relief, searched over millimetres, and landmarks on the face laid flat; then colours,
    which are finer and need to be near.
    """
    model = basis.model
    samples = spread(model, config.samples)
    covered = spread(model, round(COVERED_SHARE * config.samples), COVERED)
    appearance: Appearance | None = None
    rounds = config.relief_rounds + config.photo_rounds
    rounds = max(rounds, config.silhouette_rounds, MARK_ROUNDS)
    plain = targets
    bald = _bald(model, moments, all_vertices(model, state))
    chart = reading_chart(model) if config.chart_rounds else None
    slides: list[Slide | None] = [None] * len(targets)
    for index in range(rounds):
        meshes = all_vertices(model, state)
        targets = plain
        looking = config.relief_rounds or config.photo_rounds
        sights = (
            [see(model, samples, *seen) for seen in zip(moments, meshes, strict=True)]
            if looking
            else []
        )
        if rounds - index <= config.silhouette_rounds:
            targets = with_outlines(model, targets, moments, meshes, bald)
        targets = [
            with_marks(model, target, mesh, rotation, eyes)
            for target, mesh, rotation in zip(targets, meshes, rotations(state), strict=True)
        ]
        if config.relief_rounds:
            around = [see(model, covered, *seen) for seen in zip(moments, meshes, strict=True)]
            reach, weight = _search(index, config)
            for places, seen, trust in ((samples, sights, 1.0), (covered, around, COVERED_TRUST)):
                targets = with_relief(
                    model, places, targets, moments, seen, meshes, reach, trust * weight
                )
        if index >= config.relief_rounds and config.photo_rounds:
            targets, appearance = with_photometry(
                samples, targets, moments, sights, meshes, appearance, config
            )
        if chart is not None and index < config.chart_rounds:
            slides = [
                read_slide(model, chart, *seen, config.chart_weight)
                for seen in zip(moments, meshes, strict=True)
            ]
        targets = with_slides(targets, slides)
        state, _ = fit(basis, targets, state, config, config.round_iterations, _told(targets))
    return state, targets, appearance


def _search(index: int, config: TrackConfig) -> tuple[float, float]:
    """How far a round searches for the surface, metres, and how far to trust what it finds."""
    # Far off, whole patches of skin may match wrongly together: little trust at first.
    left = max(config.relief_rounds - 1 - index, 0)
    return config.relief_reach * 0.6 ** min(index, 3), config.relief_weight * 0.3**left


def _told(targets: list[Target]) -> tuple[str, ...]:
    """Kinds of offsets that terms of the targets tell of."""
    kinds = {type(term) for target in targets for term in target.terms}
    return tuple(name for kind, name in ((Relief, OFF), (Slide, ALONG)) if kind in kinds)


def _bald(model: HeadModel, moments: list[Moment], meshes: np.ndarray) -> bool:
    """Whether the first moment that has pictures shows a bare skull."""
    for moment, mesh in zip(moments, meshes, strict=True):
        if moment.shots:
            return is_bald(model, [root_light(shot) for shot in moment.shots], mesh)
    return False


def with_outlines(
    model: HeadModel,
    targets: list[Target],
    moments: list[Moment],
    meshes: np.ndarray,
    bald: bool,
) -> list[Target]:
    """The targets with the outlines of the current meshes (E, V, 3)."""
    allowed, covered = outline_regions(model, bald)
    faces = model.faces.numpy()
    pictures = sum(len(moment.distances) for moment in moments)
    found = []
    for target, moment, mesh in zip(targets, moments, meshes, strict=True):
        outlines, ids, offset = [], [], 68
        for distance in moment.distances:
            chosen = outline_vertices(mesh, faces, distance.camera, allowed)
            if len(chosen) < 8:
                continue
            outlines.append(
                Outline.of(distance, offset, mesh[chosen], covered[chosen], pictures, bald)
            )
            ids.append(chosen)
            offset += len(chosen)
        vertices = np.concatenate(ids) if ids else np.zeros(0, dtype=np.int64)
        found.append(replace(target, outlines=tuple(outlines), vertices=vertices))
    return found
