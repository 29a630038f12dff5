"""Beards and fringes: colours unlike the face's, and landmarks that are not trusted in them."""

import numpy as np

from express50.head.load import load_head
from pipelines.track.schedule import IN_HAIR, doubted
from pipelines.track.surface import like_skin
from pipelines.track.terms import landmark_anchors


def test_shading_is_like_skin_and_hair_is_not():
    rng = np.random.default_rng(0)
    skin = np.log([0.8, 0.6, 0.5]) + rng.normal(0, 0.15, (400, 1)) + rng.normal(0, 0.01, (400, 3))
    hair = np.log([0.2, 0.15, 0.12]) + rng.normal(0, 0.1, (100, 1))
    face = np.concatenate([skin, hair])
    assert like_skin(skin, face).mean() > 0.95 and not like_skin(hair, face).any()


def test_landmarks_in_a_beard_are_vague_and_its_rim_is_no_jaw():
    model = load_head("procedural")
    hidden = np.zeros(len(model.template), bool)
    sigma = np.full((2, 68), 2.0)
    assert np.array_equal(doubted(model, sigma, hidden), sigma)
    anchors = landmark_anchors(model).vertices
    hidden[anchors[[8, 57]]] = True
    found = doubted(model, sigma, hidden)
    assert np.isinf(found[:, 8]).all() and (found[:, 57] == 2.0 * IN_HAIR).all()
    assert (found[:, 36] == 2.0).all()
