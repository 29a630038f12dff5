import dataclasses

import numpy as np
import pytest

from express50.capture.expressions import load_script, select
from express50.errors import HeadModelError
from express50.head.load import load_head
from express50.twin.body import build_body, head_vertices, model_materials, pose_body
from express50.twin.rig import TARGET, make_rig
from express50.twin.subjects import OFFSET_RMS_M, gaze_rotation, make_subject, perform, soft_mask
from express50.twin.surface import fractal, make_lattice, noise


@pytest.fixture(scope="module")
def model():
    return load_head("procedural")


def test_displacement_is_outside_the_shape_space(model):
    subject = make_subject(model, "S001", 1, 0)
    basis = model.shape_dirs.double().numpy().reshape(-1, len(model.shape_names))
    offsets = subject.offsets.astype(float).ravel()
    explained, *_ = np.linalg.lstsq(basis, offsets, rcond=None)
    assert np.linalg.norm(basis @ explained) < 0.02 * np.linalg.norm(offsets)
    size = np.linalg.norm(subject.offsets, axis=1)[soft_mask(model) > 0.5]
    assert np.sqrt((size**2).mean()) == pytest.approx(OFFSET_RMS_M, rel=1e-3)


def test_subjects_differ_and_depend_on_their_number_only(model):
    first, again, other = (make_subject(model, f"S{n:03d}", n, 0) for n in (1, 1, 2))
    assert np.array_equal(first.shape, again.shape)
    assert np.array_equal(first.offsets, again.offsets)
    assert np.abs(first.shape - other.shape).max() > 0.5
    tones = [make_subject(model, "S", n, 0).look.skin.mean() for n in range(1, 7)]
    assert max(tones) > 3 * min(tones)


def test_every_expression_is_played_once_with_one_peak(model):
    script = load_script()
    for count in (6, 8, 72):
        play = perform(model, script, count, 24.0, 1, 0)
        assert play.frames == 60 * count
        offsets = []
        for name, first, last in play.cues:
            window = play.strength[first : last + 1]
            peak = play.peaks[name]
            assert first < peak < last and play.strength[peak] == 1.0
            assert (np.delete(window, peak - first) < 1.0).all()
            assert window[0] < 0.75 and window[-1] < 0.75
            offsets.append((peak - first) / count)
        assert np.ptp(offsets) > 0.25


def test_leaving_expressions_out_does_not_change_the_others(model):
    ids = ["neutral", "smile", "anger"]
    all_three = perform(model, select(ids), 8, 24.0, 1, 0)
    two = perform(model, select(["neutral", "anger"]), 8, 24.0, 1, 0)
    assert all_three.peaks["anger"] - 8 == two.peaks["anger"]
    assert np.allclose(all_three.jaw[16:], two.jaw[8:])


def test_a_head_without_the_scripts_controls_is_refused(model):
    nameless = dataclasses.replace(
        model, expression_names=tuple(f"e{k}" for k in range(len(model.expression_names)))
    )
    with pytest.raises(HeadModelError, match="named expressions"):
        perform(nameless, load_script(), 8, 24.0, 1, 0)


def test_gaze_turns_left_and_up():
    forward = np.array([0.0, 0.0, 1.0])
    left, up = gaze_rotation(np.array([[0.5, 0.0], [0.0, 0.4]])) @ forward
    assert np.allclose(left, [np.sin(0.5), 0, np.cos(0.5)])
    assert np.allclose(up, [0, np.sin(0.4), np.cos(0.4)])


def test_heads_stay_in_the_rig_and_face_forward(model):
    subject = make_subject(model, "S001", 1, 0)
    play = perform(model, select(["neutral", "smile"]), 6, 24.0, 1, 0)
    skin = (model.regions["face"] | model.regions["scalp"]).numpy()
    for frame in (0, 11):
        head = head_vertices(model, subject, play, frame)[skin]
        assert np.abs(0.5 * (head.min(0) + head.max(0)) - TARGET).max() < 0.04
    assert (play.R @ [0.0, 0.0, 1.0])[:, 2].min() > 0.95


def test_hair_lies_outside_the_skin_and_turns_with_the_skull(model):
    subject = make_subject(model, "S001", 1, 0)
    body = build_body(model, subject, 0)
    hair = body.extras.hair
    assert 1000 < len(hair.faces) < 400_000
    assert np.allclose(np.linalg.norm(hair.tangents, axis=1), 1.0, atol=1e-5)
    bald = build_body(model, subject, 0, hair_detail=0.0)
    assert len(bald.extras.hair.faces) == 0 and len(bald.faces) < len(body.faces)
    play = perform(model, select(["neutral"]), 6, 24.0, 1, 0)
    posed = pose_body(body, play, 0)
    start = len(model.template)
    moved = posed.vertices[start : start + len(hair.vertices)]
    assert np.ptp(moved, axis=0) == pytest.approx(np.ptp(hair.vertices, axis=0), abs=0.03)
    lengths = np.linalg.norm(posed.normals[:start][model_materials(model) == 0], axis=1)
    assert np.median(lengths) == pytest.approx(1.0, abs=1e-4)


def test_rig_spans_the_arc_and_frames_the_head():
    cameras = make_rig(24, 3840, 2160, 0)
    towards = np.array([c.center - TARGET for c in cameras.values()])
    azimuth = np.degrees(np.arctan2(-towards[:, 0], towards[:, 2]))
    assert 270 < np.ptp(azimuth) < 300 and (np.abs(azimuth) < 75).sum() > 12
    assert (np.abs(np.linalg.norm(towards, axis=1) - 1.05) < 0.06).all()
    assert all(c.dist[0] != 0 for c in cameras.values())


def test_noise_is_smooth_bounded_and_periodic():
    rng = np.random.default_rng(0)
    lattice, points = make_lattice(rng), rng.uniform(-40, 40, (500, 3))
    values = noise(points, lattice)
    assert np.abs(values).max() <= 1.0 and values.std() > 0.2
    assert np.allclose(noise(points + 32, lattice), values, atol=1e-4)
    assert np.abs(noise(points + 1e-3, lattice) - values).max() < 0.02
    assert fractal(points, lattice, 0.5, 3).shape == (500,)
