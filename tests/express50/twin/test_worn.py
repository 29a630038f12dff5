import dataclasses

import numpy as np
import pytest

from benchmarks.truth import Truth
from express50.errors import ConfigError
from express50.geometry.raycast import mesh_scene
from express50.twin import KINDS, TwinConfig
from express50.twin.body import pose_body
from express50.twin.record import record
from express50.twin.rig import make_rig
from express50.twin.shade import build_scene, find_eyes, make_lighting, shade
from express50.twin.skin import paint_skin
from express50.twin.studio import cast_subject
from express50.twin.surface import Material
from express50.twin.worn import WITH_HAND


@pytest.fixture(scope="module")
def dressed(tiny_config):
    """A subject that wears and holds everything, and its performance."""
    script = ("neutral", "jaw_open")
    return cast_subject(dataclasses.replace(tiny_config, wear=KINDS, expressions=script), "S001")


def test_what_is_worn_leaves_the_person_as_it_is(dressed, tiny_config):
    body, _ = dressed
    bare, _ = cast_subject(tiny_config, "S001")
    assert np.array_equal(body.rest, bare.rest)
    hairs = len(bare.extras.hair.vertices)
    assert np.array_equal(body.extras.hair.vertices[:hairs], bare.extras.hair.vertices)
    assert len(body.extras.hair.vertices) > hairs and (bare.extras.hair.moves == -1).all()
    assert bare.solid == len(bare.faces)
    lenses = body.material == Material.LENS
    assert lenses.any() and lenses[body.solid :].all() and not lenses[: body.solid].any()


def test_a_hand_comes_near_the_face_but_not_into_it(dressed):
    body, play = dressed
    assert len(body.extras.hand) == play.frames
    for frame in play.peaks.values():
        posed = pose_body(body, play, frame)
        things = posed.vertices[-len(body.extras.worn.vertices) :]
        hand = things[body.extras.worn.moves == WITH_HAND]
        head = posed.vertices[: len(body.rest)]
        face = body.model.regions["face"].numpy()
        gap = np.linalg.norm(hand[:, None] - head[face][None, ::4], axis=-1)
        assert 0.0005 < gap.min() < 0.025
    first, second = (body.extras.hand[frame] for frame in play.peaks.values())
    assert not np.allclose(first, second)  # every cue has its own place


def test_a_beard_follows_the_jaw_and_glasses_the_skull(dressed):
    body, play = dressed
    rest, wide = (pose_body(body, play, frame) for frame in play.peaks.values())
    turn = play.R[play.peaks["jaw_open"]] @ play.R[play.peaks["neutral"]].T
    heads, hairs = len(body.rest), body.extras.hair
    moves = hairs.moves
    down = (wide.vertices - wide.vertices[:heads].mean(0)) @ turn
    shift = down - (rest.vertices - rest.vertices[:heads].mean(0))
    moved = np.linalg.norm(shift[heads : heads + len(moves)], axis=1)
    lowest = moves == moves[moves >= 0][body.rest[moves[moves >= 0], 1].argmin()]
    assert moved[lowest].min() > 0.008 > np.median(moved[moves == -1])


def test_lenses_refract_mirror_and_let_the_backdrop_through(dressed, tiny_config):
    body, play = dressed
    posed = pose_body(body, play, 0)
    scene = build_scene(
        body, paint_skin(body, 0, 256), find_eyes(body.model), make_lighting(1, 0), posed, 0
    )
    lens = np.flatnonzero(body.material == Material.LENS)
    middle = posed.vertices[body.faces[lens]].mean(1)
    alphas = []
    for camera in make_rig(9, 48, 48, 0).values():
        towards = (middle - camera.center).astype(np.float32)
        _, face, bary = scene.caster.cast(camera.center, towards)
        hit = body.material[np.minimum(face, len(body.material) - 1)] == Material.LENS
        seen = shade(scene, towards[hit], face[hit], bary[hit])
        assert np.isfinite(seen).all() and (seen >= 0).all() and (seen[:, 3] <= 1).all()
        alphas.append(seen[:, 3])
    every = np.concatenate(alphas)
    # The face is behind most lenses; from the side one sees the backdrop through them.
    assert (every == 1).mean() > 0.5 and (every < 0.3).any()


def test_truth_looks_through_lenses_and_knows_what_hides_the_face(tmp_path, tiny_config):
    config = dataclasses.replace(tiny_config, wear=("glasses", "hand"), plates=False)
    record(config, tmp_path, workers=1)
    truth = Truth(tmp_path / "truth")
    material = np.stack([
        truth.surface("S001", 0, camera)[0] for camera in truth.cameras("S001").values()
    ])  # fmt: skip
    assert {Material.HAND, Material.APPAREL, Material.LENS} <= set(np.unique(material))
    vertices, faces = truth.mesh("S001", 0)
    assert mesh_scene(vertices, faces) is not None and faces.max() < len(vertices)
    for camera, kinds in zip(truth.cameras("S001").values(), material, strict=True):
        assert not truth.skin("S001", 0, camera)[kinds == Material.HAND].any()
        assert truth.render_alpha("S001", 0, camera).max() == 1


def test_unknown_things_are_refused():
    with pytest.raises(ConfigError, match=r"hat, expected some of glasses"):
        TwinConfig(wear=("hat",))
