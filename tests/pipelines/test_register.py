"""Register: a mesh on a known surface, hair left out, lips apart, and the stage's files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from express50.contract.layout import Dataset
from express50.contract.stage import NoSettings
from express50.dataset.export import Head, with_registered
from express50.dataset.tracks import read_registration, read_track
from express50.errors import FormatError, StageError
from express50.files.calibration import write_cameras
from express50.geometry.meshes import cotangent_laplacian, read_surface, write_ply
from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import joint_angles, pose, rest_vertices, skin
from pipelines.register import STAGE
from pipelines.register.lay import (
    AGREEING,
    SURFACE_M,
    GivenSurface,
    Plate,
    SurfaceSearch,
    bare_skin,
    lay,
    mesh_normals,
    skin_trust,
    too_fine,
)
from pipelines.register.stage import rest_offsets
from pipelines.register.untangle import crossing_pairs, untangled
from tests.express50.dataset.tracked import track_arrays, write_track
from tests.pipelines.board_rigs import make_rig

DETAIL = 0.010


@pytest.fixture(scope="module")
def model():
    return load_head("procedural")


def posed(model, seed: int, jaw: float = 0.0) -> np.ndarray:
    """A person's mesh (V, 3): the template with random shape coefficients."""
    shape = 0.8 * np.random.default_rng(seed).normal(size=(1, model.shape_dirs.shape[2]))
    angles = torch.tensor([[jaw, 0.0, 0.0]])
    return (
        pose(model, torch.from_numpy(shape).float(), torch.zeros(1, 0), jaw=angles)[0]
        .double()
        .numpy()
    )


def bumped(model, mesh: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A mesh with a smooth rise on its left cheek; also where (V,) it rises by over a half."""
    cheek = mesh[((mesh - [0.045, -0.03, 0.06]) ** 2).sum(1).argmin()]
    share = np.exp(-((mesh - cheek) ** 2).sum(1) / 0.025**2)
    return mesh + height * share[:, None] * mesh_normals(mesh, model.faces), share > 0.5


def surface_of(model, mesh: np.ndarray) -> GivenSurface:
    """A mesh as a surface that is trusted everywhere."""
    return GivenSurface(mesh, model.faces.numpy(), np.ones(len(mesh)))


def test_a_bump_is_followed_and_the_rest_stays(model):
    start = posed(model, 1)
    true, raised = bumped(model, start, 0.004)
    laid = lay(model, start, surface_of(model, true), DETAIL)
    face = model.regions["face"].numpy()
    left = np.linalg.norm(laid.vertices - true, axis=1)
    assert np.median(np.linalg.norm(start - true, axis=1)[face & raised]) > 0.0025
    assert np.percentile(left[face & raised], 95) < 0.0004
    assert np.percentile(left[face], 95) < 0.0002
    fixed = np.any([model.regions[k].numpy() for k in ("left_eyeball", "teeth", "tongue")], axis=0)
    assert np.abs(laid.vertices - start)[fixed].max() < 1e-5
    cheek = face & raised & laid.seen
    assert cheek.sum() > 20
    assert laid.sigma[cheek].max() < 0.5 * np.median(laid.sigma[model.regions["scalp"].numpy()])


def test_a_surface_out_of_reach_or_without_trust_moves_nothing(model):
    start = untangled(model, posed(model, 2))
    true, raised = bumped(model, start, 0.004)
    far = lay(model, start, surface_of(model, true + [0.0, 0.0, 0.5]), DETAIL)
    doubtful = replace(surface_of(model, true), trust=np.zeros(len(true)))
    for laid in (far, lay(model, start, doubtful, DETAIL)):
        assert np.abs(laid.vertices - start).max() < 1e-9
        assert not laid.seen.any() and not laid.residual.any()
        assert laid.sigma[raised].min() > 0.003


def test_heights_point_to_the_nearer_sheet_that_faces_the_same_way():
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.1
    sheets = [square + [0, 0, z] for z in (0.004, -0.006, 0.001)]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    turned = faces[:, ::-1]  # the nearest sheet faces away
    vertices = np.concatenate(sheets)
    surface = GivenSurface(
        vertices, np.concatenate([faces, faces + 4, turned + 8]), np.repeat([0.5, 1.0, 1.0], 4)
    )
    up = np.array([[0.0, 0.0, 1.0]])
    search = SurfaceSearch(replace(surface, faces=surface.faces[:4]))
    height, trust = search.heights(np.array([[0.01, 0.02, 0.0]]), up, 0.01)
    assert height == pytest.approx([0.004], abs=1e-6) and trust == pytest.approx([0.5])
    assert search.heights(np.array([[0.01, 0.02, 0.0]]), up, 0.003)[1] == [0.0]
    assert SurfaceSearch(surface).heights(np.array([[0.01, 0.02, 0.0]]), -up, 0.01)[0] == (
        pytest.approx([-0.001], abs=1e-6)
    )


def test_the_uncertainty_is_the_spread_of_what_fits_the_data(model):
    """The plate's standard deviations are those of fits to data with the stated noise."""
    mesh, rng = posed(model, 3), np.random.default_rng(0)
    laplacian = cotangent_laplacian(mesh, model.faces.numpy())
    plate = Plate(*laplacian, np.ones(len(mesh), bool), DETAIL)
    weight = np.where(rng.uniform(size=len(mesh)) < 0.3, 0.0003**-2.0, 0.0)
    sigma = plate.sigma(weight)
    some = rng.choice(len(mesh), 12, replace=False)
    unit = np.zeros((len(mesh), len(some)))
    unit[some, np.arange(len(some))] = 1.0
    exact = np.sqrt(plate.factor(weight).solve(unit)[some, np.arange(len(some))])
    assert sigma[some] == pytest.approx(exact, rel=0.4)
    assert np.mean(sigma[some] / exact) == pytest.approx(1.0, abs=0.12)


def test_hair_and_doubtful_places_get_no_trust(model):
    mesh = posed(model, 4)
    rng, count = np.random.default_rng(1), len(mesh)
    colors = np.clip(rng.normal((200, 150, 125), 6, (count, 3)), 0, 255).astype(np.uint8)
    hair = mesh[:, 1] > np.percentile(mesh[model.regions["forehead"].numpy(), 1], 40)
    colors[hair] = np.clip(rng.normal((70, 50, 40), 6, (hair.sum(), 3)), 0, 255)
    confidence = np.full(count, 0.8)
    side = mesh[:, 0] < -0.055
    confidence[side] = 0.3
    skin = bare_skin(model, mesh, mesh)
    trust = skin_trust(model, mesh, mesh, colors, confidence, skin)
    nose = model.regions["nose"].numpy()
    assert trust[hair].max() < 0.05 and trust[side].max() < 0.05
    assert np.median(trust[nose]) > 0.75
    lips = model.regions["lips"].numpy() & ~side
    colors[lips] = (190, 80, 90)
    assert np.median(skin_trust(model, mesh, mesh, colors, confidence, skin)[lips]) > 0.5
    nowhere = skin_trust(model, mesh, mesh + 1.0, colors, confidence, np.zeros(0, int))
    assert nowhere == pytest.approx(confidence)
    assert not len(bare_skin(model, mesh, mesh + 1.0))
    disagreeing = skin_trust(model, mesh, mesh, colors, 0.35 * confidence, skin, AGREEING)
    assert disagreeing.max() == 0


def test_lips_eyes_and_the_underside_of_the_nose_are_too_fine_for_depth(model):
    mesh = posed(model, 5)
    face, nose, lips, eye = (
        model.regions[k].numpy() for k in ("face", "nose", "lips", "left_eye_region")
    )
    fine = too_fine(model, mesh, mesh + 0.0005 * mesh_normals(mesh, model.faces))
    low, high = np.percentile(mesh[nose, 1], (20, 90))
    assert fine[nose & (mesh[:, 1] < low)].mean() > 0.7 and fine[lips | eye].mean() > 0.9
    assert not fine[nose & (mesh[:, 1] > high)].any()
    other = face & ~nose & ~lips & ~eye & ~model.regions["right_eye_region"].numpy()
    assert fine[other].mean() < 0.1
    assert not too_fine(replace(model, regions={}), mesh, mesh).any()


@pytest.mark.parametrize(
    ("jaw", "names", "gap_m"),
    [
        (-0.015, (), 3e-4),
        (-0.015, ("mouthSmile_L", "mouthSmile_R"), 3e-4),
        (-0.015, ("mouthPress_L", "jawLeft"), 5e-4),
        (0.0, ("eyeBlink_L", "eyeBlink_R"), 2e-4),
        (0.0, ("eyeBlink_L", "eyeSquint_L"), 7e-4),  # a third of the opening past shut
    ],
)
def test_lips_and_lids_are_parted_and_still_touch(model, jaw, names, gap_m):
    coefficients = torch.zeros(1, len(model.expression_names))
    for name in names:
        coefficients[0, model.expression_names.index(name)] = 1.0
    angles = torch.tensor([[jaw, 0.0, 0.0]])  # below 0 the lower lip goes up through the upper
    mesh = pose(model, torch.zeros(1, 0), coefficients, jaw=angles)[0].double().numpy()
    crossed = crossing_pairs(model, mesh)
    assert len(crossed) > 20
    parted = untangled(model, mesh)
    assert not len(crossing_pairs(model, parted.astype(np.float32).astype(np.float64)))
    moved = np.linalg.norm(parted - mesh, axis=1)
    assert moved.max() < 0.006 and np.percentile(moved[model.regions["face"].numpy()], 90) < 5e-4
    fixed = np.any([model.regions[k].numpy() for k in ("left_eyeball", "teeth", "tongue")], axis=0)
    assert not moved[fixed].any()
    assert np.median(opening(model, parted, crossed)) < gap_m


def opening(model, mesh: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distances in metres from faces to the faces that they crossed."""
    faces = model.faces.numpy()
    samples = np.random.default_rng(0).dirichlet(np.ones(3), 50)
    gaps = []
    for face in np.unique(pairs[:, 0]):
        scene = mesh_scene(mesh, faces[pairs[pairs[:, 0] == face, 1]])
        places = (samples @ mesh[faces[face]]).astype(np.float32)
        gaps.append(float(scene.compute_distance(places).numpy().min()))
    return np.array(gaps)


def test_a_mesh_without_crossings_stays_as_it_is(model):
    mesh = untangled(model, posed(model, 5, jaw=0.1))
    assert untangled(model, mesh) is mesh


def test_offsets_at_rest_give_the_moved_vertices(model, tmp_path):
    arrays = track_arrays("procedural", offsets_mm=0.0)
    track = read_track(write_track(tmp_path / "track.npz", arrays))
    moved = 0.002 * np.random.default_rng(2).normal(size=track.vertices.shape[1:])
    offsets = torch.from_numpy(rest_offsets(model, track, 1, moved))
    exact = model.to(dtype=torch.float64)
    rest = rest_vertices(
        exact, torch.from_numpy(track.shape)[None], torch.from_numpy(track.expression[1:2])
    )
    joints = torch.einsum("jv,bvc->bjc", exact.joint_regressor, rest)
    parts = (torch.from_numpy(x[1:2]) for x in (track.neck, track.jaw, track.eyes))
    turns = axis_angle_to_matrix(joint_angles(rest, None, *parts))
    head = skin(rest + offsets, joints, turns, exact.skinning, exact.pose_dirs)[0].numpy()
    world = head @ track.R[1].T + track.t[1]
    assert np.abs(world - (track.vertices[1] + moved)).max() < 1e-6


@pytest.fixture
def dataset(tmp_path, model) -> Dataset:
    """A tracked subject whose smile has a surface with a bump; its neutral has none."""
    dataset = Dataset(tmp_path)
    dataset.item_dir("track", "S001").mkdir(parents=True)
    arrays = track_arrays("procedural", offsets_mm=0.0)
    arrays["sigma"] = np.full(arrays["vertices"].shape[:2], 6e-4, np.float32)
    write_track(dataset.track_file("S001"), arrays)
    dataset.cameras_file("S001").parent.mkdir(parents=True)
    write_cameras(dataset.cameras_file("S001"), make_rig(2))
    path = dataset.surface_file("S001", "smile")
    path.parent.mkdir(parents=True)
    head = (arrays["vertices"][1] - arrays["t"][1]) @ arrays["R"][1]
    true = bumped(model, head.astype(np.float64), 0.004)[0] @ arrays["R"][1].T + arrays["t"][1]
    write_surface(path, true, model.faces.numpy())
    return dataset


def write_surface(
    path: Path, vertices: np.ndarray, faces: np.ndarray, confidence: float = 0.8
) -> None:
    """Write a skin-coloured surface as depth does."""
    colour = dict(zip(("red", "green", "blue"), (200, 150, 125), strict=True))
    columns = {k: np.full(len(vertices), v, np.uint8) for k, v in colour.items()}
    columns["confidence"] = np.full(len(vertices), confidence, np.float32)
    write_ply(path, vertices, faces, columns)


def test_a_surface_on_which_views_disagree_is_not_followed(dataset, tmp_path):
    path = dataset.surface_file("S001", "smile")
    surface = read_surface(path)
    write_surface(path, surface.vertices, surface.faces, 0.4)
    found = {}
    for views in (1, 4):  # imported surfaces and those of one camera compare none
        (path.parent / "metrics.json").write_text(f'{{"views": {views}}}')
        (tmp_path / str(views)).mkdir()
        found[views] = STAGE.run(dataset, "S001/smile", NoSettings(), tmp_path / str(views))
    assert not found[1].warnings and found[1].metrics["seen_share"] > 0.4
    assert found[1].metrics["skin_agreement"] == pytest.approx(0.4)
    why = found[4].warnings[0].why
    assert "cameras agree on bare skin by 0.40, expected 0.6" in why
    assert "whether the face is dark" in why  # noise has the same effect as a wrong rig
    assert found[4].metrics["moved_mm_p95"] < 0.7 * found[1].metrics["moved_mm_p95"]
    write_surface(path, surface.vertices, surface.faces, 0.599)
    (tmp_path / "nearly").mkdir()
    nearly = STAGE.run(dataset, "S001/smile", NoSettings(), tmp_path / "nearly")
    assert "by 0.59, expected 0.6" in nearly.warnings[0].why  # 0.60 would read like the limit


def test_the_stage_writes_a_mesh_that_later_stages_take(dataset, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    track = read_track(dataset.track_file("S001"))
    head = Head(subject="S001", track=track, model=load_head("procedural"), albedo=None)
    assert np.array_equal(with_registered(dataset, head).track.vertices, track.vertices)
    result = STAGE.run(dataset, "S001/smile", NoSettings(), out)
    assert result.metrics["seen_share"] > 0.4 and not result.warnings
    assert result.metrics["residual_mm_median"] < 0.05
    assert result.metrics["moved_mm_p95"] > 0.1
    assert (out / "qc" / "registration.jpg").is_file()
    path = dataset.registration_file("S001", "smile")
    path.parent.mkdir(parents=True)
    (out / "registration.npz").rename(path)
    found = read_registration(path)
    best = with_registered(dataset, head).track.vertices
    assert np.array_equal(best, [track.vertices[0], found.vertices])
    assert np.abs(best[1] - track.vertices[1]).max() > 0.001
    assert found.seen.any() and np.isfinite(found.sigma).all()
    left = load_head("procedural").regions["lips"].numpy() & ~found.seen  # to tracking
    alone = np.hypot(track.sigma[1], SURFACE_M)[left]
    assert left.sum() > 100 and found.sigma[left] == pytest.approx(alone, rel=1e-4)
    assert np.isfinite(found.bound).all() and (found.bound > 0).all()
    stated = result.expected_error
    assert stated.unit == "mm" and 0 < stated.low <= stated.value <= stated.high
    write_track(dataset.track_file("S001"), track_arrays("procedural", seed=7))
    with pytest.raises(FormatError):  # of another track
        with_registered(dataset, replace(head, track=read_track(dataset.track_file("S001"))))


def test_no_error_is_stated_for_a_head_of_impossible_shape(dataset, tmp_path):
    arrays = track_arrays("procedural", offsets_mm=0.0)
    write_track(dataset.track_file("S001"), arrays | {"shape": np.full_like(arrays["shape"], 2.0)})
    result = STAGE.run(dataset, "S001/smile", NoSettings(), tmp_path)
    assert result.expected_error is None
    assert [note.why for note in result.warnings if "impossible shape" in note.why]


def test_what_is_missing_or_damaged_is_one_clear_error(dataset, tmp_path):
    with pytest.raises(StageError):  # no surface
        STAGE.run(dataset, "S001/neutral", NoSettings(), tmp_path)
    path = dataset.surface_file("S001", "smile")
    whole = path.read_bytes()
    for damaged in (
        b"",
        b"ply\n",
        whole[: len(whole) // 2],
        whole[:-4] + b"\xff\xff\xff\x7f",  # a vertex that is not there
        whole.replace(b"confidence", b"x" * 10),
    ):
        path.write_bytes(damaged)
        with pytest.raises(FormatError):
            read_surface(path)
    with pytest.raises(StageError):
        read_registration(tmp_path / "none.npz")
    np.savez(tmp_path / "bad.npz", schema=np.array("express50.registration/1"))
    with pytest.raises(FormatError):
        read_registration(tmp_path / "bad.npz")
