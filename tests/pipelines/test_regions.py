"""Label parts: occlusion, hair and collars, the head's matte, the stage and its figures."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from express50.contract.segmentation_labels import HEAD, LABELS, label_mask
from express50.errors import ConfigError, StageError
from express50.files.images import read_image, write_image
from express50.head.load import load_head
from express50.head.model import pose
from pipelines.regions import STAGE, RegionsConfig
from pipelines.regions.colour import (
    agreed_mask,
    bare_skin,
    face_colours,
    judge_scalp,
    left_of_middle,
    mask_colour,
    scalp_votes,
)
from pipelines.regions.geometry import (
    SCALP,
    find_hands,
    head_alpha,
    head_geometry,
    head_labels,
    make_head,
    render_head,
)
from pipelines.regions.stage import face_pictures, label_view, read_head
from tests.pipelines.bump_dataset import make_dataset, published
from tests.pipelines.region_scenes import COLOURS, RegionScene, camera_at, make_scene, tracked
from tests.pipelines.stand_ins import Thirds, torchscript

SIDE = RegionsConfig.image_side


def labels_of(scene: RegionScene, bare: bool = False) -> np.ndarray:
    """Labels of a scene's one view."""
    pictures = scene.rgb, scene.alpha, scene.depth
    return label_view(scene.head, scene.camera, *pictures, bare, SIDE).labels


def by_geometry(scene: RegionScene, depth: np.ndarray | None = None) -> np.ndarray:
    """Labels of a scene's one view without its colours."""
    labels = head_geometry(scene.head, scene.camera, scene.alpha, depth).labels()
    labels[labels == SCALP] = LABELS.index("hair")
    return np.where(scene.alpha > 0, labels, 0)


def overlap(labels: np.ndarray, true: np.ndarray, name: str) -> float:
    """Intersection over union of one label."""
    a, b = label_mask(labels, name), label_mask(true, name)
    return float((a & b).sum() / (a | b).sum())


def test_hidden_parts_are_not_seen() -> None:
    head = tracked()
    front = np.unique(render_head(head, camera_at(0))[0])
    names = {LABELS[label] for label in front if label < SCALP}
    assert {"skin", "lips", "eyes", "ears", "neck"} <= names
    assert "tongue" not in names and "mouth" not in names  # the lips are closed before them
    back = {LABELS[k] for k in np.unique(render_head(head, camera_at(180))[0]) if k < SCALP}
    assert not back & {"eyes", "lips", "teeth", "tongue"}
    wide = render_head(tracked(0.35), camera_at(0))[0]
    assert all(label_mask(wide, name).sum() > 5 for name in ("teeth", "tongue", "mouth"))


def test_the_nose_hides_the_cheek_and_lids_hide_the_eyes() -> None:
    model = load_head("procedural")
    labels, depth = render_head(tracked(), camera_at(90))
    assert (
        label_mask(labels, "eyes").sum()
        < 0.5 * label_mask(render_head(tracked(), camera_at(0))[0], "eyes").sum()
    )
    assert (depth[labels > 0] > 0.7).all() and (depth[labels == 0] == 0).all()
    names = list(model.expression_names)
    coefficients = torch.zeros(1, len(names))
    for side in "LR":
        coefficients[0, names.index(f"eyeBlink_{side}")] = 1.0
    shut = pose(model, torch.zeros(1, 1), coefficients)[0].double().numpy()
    closed = render_head(make_head(shut, np.eye(3), head_labels(model)), camera_at(0))[0]
    opened = render_head(tracked(), camera_at(0))[0]
    assert label_mask(closed, "eyes").sum() < 0.3 * label_mask(opened, "eyes").sum()


@pytest.mark.parametrize("azimuth", [0, 60, 180])
def test_colours_separate_collar_and_locks_from_neck_and_shoulders(azimuth: int) -> None:
    scene = make_scene(azimuth)
    labels, plain = labels_of(scene), by_geometry(scene, scene.depth)
    for name, least in (("torso", 0.95), ("neck", 0.95), ("hair", 0.88)):
        assert overlap(labels, scene.labels, name) > least, name
        assert overlap(labels, scene.labels, name) > overlap(plain, scene.labels, name) + 0.03, name
    true_head = scene.alpha * label_mask(scene.labels, *HEAD)
    sad = [np.abs(head_alpha(scene.alpha, found) - true_head).sum() for found in (labels, plain)]
    assert sad[0] < 0.25 * sad[1]


def test_a_piece_of_shirt_in_the_colour_of_hair_is_torso_and_a_hanging_lock_is_hair() -> None:
    scene = make_scene(0)
    shirt = label_mask(scene.labels, "torso")
    piece = shirt & (np.arange(160) < 60) & (np.arange(160)[:, None] < 140)
    assert piece.sum() > 100
    noise = np.random.default_rng(2).normal(0, 4, scene.rgb.shape)
    dark = np.clip(np.array(COLOURS["hair"]) + noise, 0, 255)
    labels = labels_of(
        replace(scene, rgb=np.where(piece[..., None], dark, scene.rgb).astype(np.uint8))
    )
    assert label_mask(labels, "torso")[piece].mean() > 0.95
    lock = label_mask(scene.labels, "hair") & (np.arange(160)[:, None] > 110)
    assert label_mask(labels_of(scene), "hair")[lock].mean() > 0.7


def test_a_speck_of_shirt_in_the_colour_of_skin_is_torso() -> None:
    scene = make_scene(180)
    shirt = label_mask(scene.labels, "torso")
    alone = cv2.erode(shirt.astype(np.uint8), np.ones((9, 9)))  # not beside the neck
    specks = (alone > 0) & (np.arange(160) % 8 < 2) & (np.arange(160)[:, None] % 8 < 2)
    rgb = np.where(specks[..., None], COLOURS["skin"], scene.rgb).astype(np.uint8)
    labels = labels_of(replace(scene, rgb=rgb))
    assert label_mask(labels, "torso")[specks].all()


def test_without_colours_the_necks_end_still_takes_most_of_the_torso_away() -> None:
    scene = make_scene(0)
    true_head = label_mask(scene.labels, *HEAD)
    kept = head_alpha(scene.alpha, by_geometry(scene))
    assert np.abs(kept - true_head).sum() < 0.4 * np.abs(scene.alpha - true_head).sum()


def test_a_shirt_in_the_colour_of_the_skin_is_cut_by_place() -> None:
    scene = make_scene(0, hair=False)
    same = np.where((scene.labels > 0)[..., None], scene.rgb[80, 80], scene.rgb).astype(np.uint8)
    labels = labels_of(replace(scene, rgb=same), bare=True)
    assert overlap(labels, scene.labels, "torso") > 0.6
    assert not label_mask(labels[:115], "torso").any()  # 14 cm under the eyes and higher


def test_the_mesh_alone_labels_itself_exactly() -> None:
    scene = make_scene(0, jaw=0.35)
    labels = labels_of(scene)
    for name in ("eyes", "lips", "teeth", "tongue", "mouth"):
        assert overlap(labels, scene.labels, name) > 0.98, name


def test_a_rim_beyond_the_mesh_is_as_the_mesh_and_what_is_far_off_is_hair(monkeypatch) -> None:
    scene = make_scene(0, hair=False)
    small = make_head(0.93 * scene.head.vertices, np.eye(3), scene.head.labels)
    cheek = np.flatnonzero(scene.labels[92])[0]  # leftmost pixel of the head at the mouth's height
    wide = scene.alpha.copy()
    wide[20:60, 10:15] = 1  # something 10 cm beside the head
    monkeypatch.setattr("pipelines.regions.geometry.RIM_M", 0.008)
    labels = head_geometry(small, scene.camera, wide, None).labels()
    assert LABELS[labels[92, cheek]] in ("skin", "neck") and LABELS[labels[40, 12]] == "hair"
    monkeypatch.setattr("pipelines.regions.geometry.RIM_M", 0.0)
    none = head_geometry(small, scene.camera, wide, None).labels()
    assert LABELS[none[92, cheek]] == "hair"


def test_the_cut_is_a_pixel_wide_and_keeps_strands() -> None:
    labels = np.full((40, 40), LABELS.index("hair"), np.uint8)
    labels[20:] = LABELS.index("torso")
    alpha = np.full((40, 40), 0.3, np.float32)
    head = head_alpha(alpha, labels)
    assert np.array_equal(head[:20], alpha[:20]) and head[20:].max() == 0
    # Labels a quarter of the size: the cut stays at its place, a pixel of the matte wide.
    large = head_alpha(np.ones((160, 160), np.float32), labels)
    assert large[:79].min() == 1 and large[81:].max() == 0
    labels[20:, :20] = 0  # what no label claims goes with the nearer
    assert head_alpha(alpha, labels)[21, 2] > 0 and head_alpha(alpha, labels)[39, 19] == 0


def test_a_bald_scalp_is_recognised_by_its_colours() -> None:
    for hair in (True, False):
        scene = make_scene(0, hair=hair)
        votes = [scalp_votes(scene.rgb, render_head(scene.head, scene.camera)[0], scene.alpha)]
        scalp = judge_scalp(votes)
        assert scalp.is_skin is not hair
        labels = labels_of(scene, bare=scalp.is_skin)
        assert bool(label_mask(labels[:40], "hair").sum() > 100) is hair
    assert judge_scalp([]).skin_coloured is None and not judge_scalp([]).is_skin


def test_headphones_over_a_third_of_a_bald_scalp_are_not_its_hair() -> None:
    scene = make_scene(0, hair=False)
    mesh = render_head(scene.head, scene.camera)[0]
    columns = np.argsort(np.argwhere(mesh == SCALP)[:, 1], kind="stable")
    band = np.argwhere(mesh == SCALP)[columns[: round(0.35 * len(columns))]]
    rgb = scene.rgb.copy()
    rgb[tuple(band.T)] = (150, 150, 155)
    scalp = judge_scalp([scalp_votes(rgb, mesh, scene.alpha)])
    assert scalp.is_skin and 0.6 < scalp.skin_coloured < 0.7


def test_the_beard_of_a_bald_head_in_light_from_one_side_is_hair() -> None:
    """Skin in the shade is as dark as the beard."""
    scene = make_scene(0, size=300, hair=False)
    skin = label_mask(scene.labels, "skin")
    beard = skin & (np.arange(300)[:, None] > np.nonzero(label_mask(scene.labels, "lips"))[0].max())
    columns = np.nonzero(skin)[1]
    light = np.clip((np.arange(300) - columns.min()) / np.ptp(columns), 0.2, 1)
    rgb = scene.rgb * light[:, None]
    rgb[beard] = np.random.default_rng(0).normal(26, 4, (int(beard.sum()), 1))
    dark = replace(scene, rgb=np.rint(np.clip(rgb, 0, 255)).astype(np.uint8))
    hair = label_mask(labels_of(dark, bare=True), "hair")
    assert hair[beard].mean() > 0.95 and hair[~beard].mean() < 0.02


def test_a_fringe_over_most_of_the_face_is_not_taken_for_its_skin() -> None:
    scene = make_scene(0)
    mesh = render_head(scene.head, scene.camera)[0]
    face = label_mask(mesh, "skin") & (scene.alpha > 0)
    fringe = face & (np.cumsum(face).reshape(face.shape) < 0.7 * face.sum())
    hair = fringe | (mesh == SCALP)
    grey = 45 + np.random.default_rng(3).normal(0, 4, scene.rgb.shape)
    rgb = np.where(hair[..., None], grey, scene.rgb).astype(np.uint8)
    scalp = judge_scalp([scalp_votes(rgb, mesh, scene.alpha)])
    assert not scalp.is_skin and scalp.skin_coloured is not None and scalp.skin_coloured < 0.1
    kept = bare_skin(rgb, face, mesh, scene.alpha > 0)
    assert not kept[fringe].any() and kept[face & ~fringe].mean() > 0.95


def test_views_that_may_not_show_skin_do_not_say_whether_the_scalp_is_bare() -> None:
    """In grey, skin and hair differ little; hair over most of a face and a scarf leave no skin."""
    scene = make_scene(0, size=300)
    mesh = render_head(scene.head, scene.camera)[0]
    grey = np.repeat(scene.rgb.max(axis=2, keepdims=True), 3, axis=2)
    assert scalp_votes(grey, mesh, scene.alpha) == (0, 0)
    assert face_colours(grey, scene.alpha, mesh) is None
    striped = np.arange(300)[:, None, None] // 8 % 3 > 0
    hair = np.where(striped | (mesh == SCALP)[..., None], (60, 50, 45), scene.rgb)
    hair[label_mask(mesh, "neck")] = (60, 60, 120)
    assert scalp_votes(hair.astype(np.uint8), mesh, scene.alpha) == (0, 0)
    assert scalp_votes(scene.rgb, mesh, scene.alpha)[0] > 0


@pytest.mark.parametrize("scarf", [False, True])
def test_long_fair_hair_and_a_scarf_are_not_taken_for_skin(scarf: bool) -> None:
    """The hair hides most of the face, in a darker shade of the skin's colour; the scarf is red."""
    scene = make_scene(0, size=300)
    mesh = render_head(scene.head, scene.camera)[0]
    rows, columns = np.nonzero(label_mask(mesh, "eyes", "lips"))
    shown = np.zeros(mesh.shape, bool)
    shown[rows.min() : rows.max(), columns.min() : columns.max()] = True
    hair = (label_mask(mesh, "skin") & ~shown) | (mesh == SCALP)
    rgb = np.where(hair[..., None], scene.rgb * 0.5, scene.rgb)
    rgb[label_mask(mesh, "neck") & scarf] = (170, 20, 30)
    rgb, solid = rgb.astype(np.uint8), scene.alpha > 0
    assert not judge_scalp([scalp_votes(rgb, mesh, scene.alpha)]).is_skin
    skin = label_mask(mesh, "skin") & solid
    kept = bare_skin(rgb, skin, mesh, solid)
    assert not kept[hair].any() and kept[skin & ~hair].mean() > 0.95


@pytest.mark.parametrize("covered", [True, False])
def test_hair_over_the_back_of_a_neck_does_not_teach_what_skin_looks_like(covered: bool) -> None:
    """A bare neck in the shade does, although it is darker than the face."""
    face, behind = make_scene(0), make_scene(180)
    colours = face_colours(face.rgb, face.alpha, render_head(face.head, face.camera)[0])
    neck = label_mask(behind.labels, "neck", "ears")
    hair = behind.rgb[label_mask(behind.labels, "hair")]
    some = hair[np.random.default_rng(0).integers(len(hair), size=neck.sum())]
    rgb = behind.rgb.copy()
    rgb[neck] = (0.8 * some if covered else 0.6 * rgb[neck]).astype(np.uint8)
    pictures = rgb, behind.alpha, behind.depth
    labels = label_view(behind.head, behind.camera, *pictures, False, SIDE, colours).labels
    assert label_mask(labels, *(("hair",) if covered else ("neck", "ears")))[neck].mean() > 0.9


def test_a_face_in_red_light_from_one_side_and_blue_from_the_other_is_skin() -> None:
    scene = make_scene(20, size=300)
    mesh = render_head(scene.head, scene.camera)[0]
    left = left_of_middle(mesh)[..., None]
    rgb = (scene.rgb * np.where(left, (1, 0.7, 0.75), (0.7, 0.75, 1))).astype(np.uint8)
    solid = scene.alpha > 0
    skin = label_mask(mesh, "skin") & solid
    assert bare_skin(rgb, skin, mesh, solid)[skin].mean() > 0.99
    labels = labels_of(replace(scene, rgb=rgb))
    assert label_mask(labels, "skin")[skin & label_mask(scene.labels, "skin")].mean() > 0.95
    # On one side a fringe, which is darker; on both a beard.
    rows = np.arange(300)[:, None] > np.nonzero(label_mask(mesh, "lips"))[0].min()
    for hair, shade in ((left[..., 0] & ~rows, 0.3), (rows & skin, 0.8)):
        grey = (shade * scene.rgb.mean(2, keepdims=True)) * np.ones(3)
        worn = np.where(hair[..., None], grey, scene.rgb).astype(np.uint8)
        kept = bare_skin(worn, skin, mesh, solid)
        assert not kept[hair & skin].any() and kept[skin & ~hair].mean() > 0.95


def over_the_mouth(scene: RegionScene, colour: tuple[int, int, int]) -> tuple[RegionScene, ...]:
    """Cover mouth and chin in a colour; returns the scene and where (H, W) bool it is covered."""
    lips = np.nonzero(label_mask(scene.labels, "lips"))[0]
    row = np.arange(len(scene.rgb))[:, None]
    cloth = label_mask(scene.labels, "skin", "lips") & (row > 2 * lips.min() - lips.max())
    noise = np.random.default_rng(4).normal(0, 4, scene.rgb.shape)
    pleats = np.where(row % 8 < 3, 0.8, 1.0)[..., None]
    shown = np.clip(pleats * np.array(colour) + noise, 0, 255)
    return replace(scene, rgb=np.where(cloth[..., None], shown, scene.rgb).astype(np.uint8)), cloth


@pytest.mark.parametrize("colour", [(120, 180, 215), (110, 170, 130), (245, 245, 240)])
def test_a_mask_over_the_mouth_is_apparel(colour: tuple[int, int, int]) -> None:
    front, cloth = over_the_mouth(make_scene(0, size=300), colour)
    mesh = render_head(front.head, front.camera)[0]
    found = mask_colour(front.rgb, front.alpha, mesh)
    pictures = front.rgb, front.alpha, front.depth
    view = label_view(front.head, front.camera, *pictures, False, SIDE, mask=found)
    apparel, skin = (label_mask(view.labels, name) for name in ("apparel", "skin"))
    assert apparel[cloth].mean() > 0.95 and apparel[~cloth].mean() < 0.005
    assert skin[label_mask(front.labels, "skin") & ~cloth].mean() > 0.9
    assert not label_mask(view.labels, "lips", "mouth", "teeth").any()


def test_most_views_decide_on_a_mask_and_a_bald_heads_white_beard_is_not_one() -> None:
    blue, white, none = np.array([-0.6, -0.3, -0.1]), np.array([-0.3, 0.0, 0.0]), np.full(3, np.nan)
    np.testing.assert_allclose(agreed_mask([blue, none, blue, None], bald=True), blue)
    np.testing.assert_allclose(agreed_mask([white, None], bald=False), white)
    assert agreed_mask([white, white], bald=True) is None
    assert agreed_mask([blue, none], bald=False) is None
    assert agreed_mask([None], bald=False) is None


@pytest.mark.parametrize("colour", [(60, 40, 30), (130, 128, 125), (200, 150, 110)])
def test_a_beard_or_a_bare_face_is_not_a_mask(colour: tuple[int, int, int]) -> None:
    bearded, _ = over_the_mouth(make_scene(0, size=300), colour)
    mesh = render_head(bearded.head, bearded.camera)[0]
    assert np.isnan(mask_colour(bearded.rgb, bearded.alpha, mesh)).all()
    grey = np.repeat(bearded.rgb.max(axis=2, keepdims=True), 3, axis=2)
    assert mask_colour(grey, bearded.alpha, mesh) is None


@pytest.mark.parametrize("shown", [0.0, 0.1])
def test_hair_before_a_face_seen_from_the_side_is_neither_skin_nor_a_hand(shown: float) -> None:
    scene, front = make_scene(75), make_scene(0)
    mesh, depth = render_head(scene.head, scene.camera)
    face = label_mask(mesh, "skin", "lips", "eyes")
    nose = np.quantile(np.nonzero(face)[1], shown)
    hair = (mesh > 0) & (np.arange(mesh.shape[1]) >= nose)
    noise = np.random.default_rng(1).normal(0, 4, scene.rgb.shape)
    locks = np.clip(np.array(COLOURS["hair"]) + noise, 0, 255)
    rgb = np.where(hair[..., None], locks, scene.rgb).astype(np.uint8)
    nearer = np.where(hair, depth - 0.03, scene.depth).astype(np.float32)
    colours = face_colours(front.rgb, front.alpha, render_head(front.head, front.camera)[0])
    pictures = rgb, scene.alpha, nearer
    labels = label_view(scene.head, scene.camera, *pictures, False, SIDE, colours).labels
    assert label_mask(labels, "hair")[hair & face].mean() > 0.9
    assert not label_mask(labels, "hand").any()


def test_from_behind_the_skin_is_that_of_the_face() -> None:
    front, back = make_scene(0), make_scene(180)
    colours = face_colours(front.rgb, front.alpha, render_head(front.head, front.camera)[0])
    assert colours is not None and colours.sum() > 1000
    assert face_colours(back.rgb, back.alpha, render_head(back.head, back.camera)[0]) is None
    # Long hair from nape to collar: the view shows no skin at all.
    bare, neck = label_mask(back.labels, "neck", "skin", "ears"), label_mask(back.labels, "neck")
    noise = np.random.default_rng(1).normal(0, 4, back.rgb.shape)
    locks = np.clip(np.array(COLOURS["hair"]) + noise, 0, 255)
    hair = np.where(bare[..., None], locks, back.rgb).astype(np.uint8)
    share = []
    for skin in (colours, None):
        labels = label_view(
            back.head, back.camera, hair, back.alpha, back.depth, False, SIDE, skin
        ).labels
        share.append(label_mask(labels, "hair")[neck].mean())
    assert share[0] > share[1] + 0.3


def test_a_head_model_without_regions_lists_what_it_lacks() -> None:
    model = load_head("procedural")
    kept = {name: mask for name, mask in model.regions.items() if name in ("face", "scalp")}
    bare = head_labels(replace(model, regions=kept))
    assert set(bare.missing) == {
        "ears", "lips", "eyes", "teeth", "tongue", "mouth", "neck", "torso"
    }  # fmt: skip
    assert head_labels(model).missing == ()
    scene = make_scene(0)
    head = make_head(scene.head.vertices, np.eye(3), bare)
    assert head.end is None
    labels = label_view(head, scene.camera, scene.rgb, scene.alpha, scene.depth, False, SIDE)
    assert not label_mask(labels.labels, "torso", "eyes", "neck").any()
    assert np.array_equal(head_alpha(scene.alpha, labels.labels), scene.alpha)


def test_sheets_in_no_region_are_not_seen() -> None:
    model = load_head("procedural")
    count = len(model.template)
    card = torch.tensor([[-0.1, 0.0, 0.3], [0.1, 0.0, 0.3], [0.0, 0.2, 0.3]])
    cards = torch.cat([model.faces, torch.tensor([[count, count + 1, count + 2]])])
    grown = _Model(model, torch.cat([model.template, card]), cards)
    labels = head_labels(grown)
    assert len(labels.faces) == len(model.faces) and labels.faces.max() < count


class _Model:
    """A head model with more vertices, as far as `head_labels` reads one."""

    def __init__(self, model, template, faces) -> None:
        more = len(template) - len(model.template)
        self.template, self.faces = template, faces
        self.regions = {
            name: torch.cat([mask, torch.zeros(more, dtype=torch.bool)])
            for name, mask in model.regions.items()
        }


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """One subject of two expressions and six cameras, up to track."""
    return make_dataset(tmp_path_factory.mktemp("regions"))


def test_the_stage_writes_labels_and_heads_of_every_camera(dataset, tmp_path) -> None:
    metrics = published(dataset, STAGE, RegionsConfig())
    assert set(metrics) == {"S001/neutral", "S001/smile"}
    folder = dataset.item_dir("regions", "S001/smile")
    names = {path.name for path in folder.glob("*.png")}
    assert names == {f"cam0{k}{end}.png" for k in range(6) for end in ("", "_head")}
    alpha = read_image(dataset.matte_file("S001", "smile", "cam02"))
    labels, head = (read_image(folder / f"cam02{end}.png") for end in ("", "_head"))
    assert labels.dtype == head.dtype == np.uint8 and labels.shape == head.shape == alpha.shape
    assert ((labels > 0) == (alpha > 127)).all() and (head <= alpha).all()
    row = metrics["S001/smile"]["cameras"]["cam02"]
    assert sum(row["labels"].values()) == pytest.approx(1, abs=1e-4)
    assert row["mesh_in_matte"] > 0.85 and metrics["S001/smile"]["warnings"] == []
    assert read_image(folder / "qc" / "regions.jpg").shape[2] == 3
    again = STAGE.run(dataset, "S001/smile", RegionsConfig(), tmp_path)
    assert again.to_json() == metrics["S001/smile"]
    for path in tmp_path.rglob("*.*"):
        assert path.read_bytes() == (folder / path.relative_to(tmp_path)).read_bytes()


def test_a_rig_behind_the_head_shows_no_glasses(dataset) -> None:
    head, _ = read_head(dataset, "S001", "smile")
    before = replace(head, center=head.center + 10 * head.R[:, 2])
    assert face_pictures(dataset, "S001/smile", head) and not face_pictures(
        dataset, "S001/smile", before
    )


def test_smaller_working_sizes_give_labels_of_the_full_size(dataset, tmp_path) -> None:
    fine, coarse = tmp_path / "fine", tmp_path / "coarse"
    for out, side in ((fine, 96), (coarse, 48)):
        out.mkdir()
        STAGE.run(dataset, "S001/smile", RegionsConfig(image_side=side), out)
    a, b = (read_image(out / "cam02.png") for out in (fine, coarse))
    assert a.shape == b.shape == (96, 96) and (a == b).mean() > 0.93 and (a != b).any()


def test_a_track_beside_the_matte_and_missing_mattes_are_reported(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    dataset.matte_file("S001", "smile", "cam01").unlink()
    write_image(dataset.matte_file("S001", "smile", "cam03"), np.zeros((96, 96), np.uint8))
    path = dataset.track_file("S001")
    with np.load(path) as table:
        arrays = dict(table)
    arrays["vertices"] = arrays["vertices"] + np.float32([0.1, 0, 0])
    np.savez(path, **arrays)
    result = STAGE.run(dataset, "S001/smile", RegionsConfig(depth=False), tmp_path)
    assert [note.what for note in result.dropped] == ["cam01"]
    assert {"cam02", "cam03"} <= {note.what for note in result.warnings}
    assert result.metrics["cameras"]["cam03"]["labels"]["background"] == 1
    json.dumps(result.to_json(), allow_nan=False)


def test_the_networks_labels_go_first_and_the_mesh_refines_its_skin(dataset, tmp_path) -> None:
    weights = torchscript(Thirds(), tmp_path / "parts.pt")
    config = RegionsConfig(segmentation=str(weights))
    result = STAGE.run(dataset, "S001/smile", config, tmp_path)
    assert result.metrics["method"] == "network and mesh"
    labels = read_image(tmp_path / "cam02.png")
    # Thirds calls the rows above a quarter hair, those under seven tenths torso, skin between.
    assert label_mask(labels[5:20, 40:56], "hair").all()
    assert label_mask(labels[75:, 40:56], "torso").all()
    middle = {LABELS[k] for k in np.unique(labels[30:60, 30:66])}
    assert {"skin", "eyes"} <= middle and "hair" not in middle
    head = read_image(tmp_path / "cam02_head.png")
    assert head[75:, 40:56].max() == 0 and head[40, 48] == 255


def test_items_without_track_or_mattes_fail_in_one_line(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    shutil.rmtree(dataset.item_dir("matte", "S001/smile"))
    with pytest.raises(StageError, match="express50 matte"):
        STAGE.run(dataset, "S001/smile", RegionsConfig(), tmp_path)
    with pytest.raises(ConfigError, match=r"regions\.segmentation nowhere"):
        STAGE.inputs(dataset, "S001/smile", RegionsConfig(segmentation="nowhere.pt"))
    dataset.track_file("S001").unlink()
    with pytest.raises(StageError, match="S001' is not tracked; run 'express50 track /"):
        STAGE.inputs(dataset, "S001/neutral", RegionsConfig())


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"regions\.image_side"):
        RegionsConfig(image_side=8)


@pytest.mark.parametrize(("off", "is_hand"), [(0.03, True), (0.012, False)])
def test_what_stands_off_the_face_is_a_hand(off: float, is_hand: bool) -> None:
    head, camera = tracked(), camera_at(0)
    mesh, depth = render_head(head, camera)
    y, x = np.nonzero(mesh == LABELS.index("eyes"))
    box = np.s_[y.min() - 3 : y.max() + 4, x.min() - 3 : x.max() + 4]
    thing = np.zeros(mesh.shape, bool)
    thing[box] = mesh[box] > 0
    nearer = np.where(thing, depth - off, depth)
    geometry = head_geometry(head, camera, np.ones(mesh.shape, np.float32), nearer)
    assert (geometry.off[~thing] < 1e-4).all()
    found = find_hands(geometry, geometry.labels(), camera.K[0, 0] / depth[depth > 0].mean())
    assert found.any() == is_hand
    if is_hand:
        assert (found & thing).sum() > 0.6 * (found | thing).sum()


@pytest.mark.parametrize(("rows", "left_out"), [(0, False), (2, False), (12, True)])
def test_a_fringe_is_left_out_of_skin_colours_and_brows_are_not(rows: int, left_out: bool) -> None:
    rng = np.random.default_rng(0)
    rgb = np.clip((205, 160, 140) + rng.normal(0, 6, (40, 40, 3)), 0, 255).astype(np.uint8)
    rgb[:rows] = (60, 40, 30)
    skin = np.ones((40, 40), bool)
    skin[:, 0] = False
    mesh = skin.astype(np.uint8) * LABELS.index("skin")
    kept = bare_skin(rgb, skin, mesh, skin)
    assert kept[rows:].sum() > 0.99 * skin[rows:].sum() and not kept[:, 0].any()
    assert kept[:rows].any() == (rows > 0 and not left_out)
    assert not bare_skin(rgb, ~skin & False, mesh, skin).any()
