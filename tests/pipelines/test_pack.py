"""Packing: crops keep geometry, depth never blends surfaces, splits and shards are right."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import minimum_filter

from express50.capture.demographics import people_lines
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import LABELS
from express50.dataset.depth_files import read_depth
from express50.errors import StageError
from express50.files.atomic import write_json
from express50.files.images import read_image, write_image
from express50.geometry.cameras import pinhole_camera, project, unproject
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.transforms import look_at
from express50.shards.reader import ShardReader
from express50.shards.writer import verify
from pipelines.depth import STAGE as DEPTH
from pipelines.depth import DepthConfig
from pipelines.pack import ENCODE, EncodeConfig, PackConfig
from pipelines.pack import STAGE as PACK
from pipelines.pack.sample import (
    Crop,
    crop_pinhole,
    cut_depth,
    cut_image,
    cut_labels,
    head_crop,
    nameless,
    occluded,
    read_subject,
)
from pipelines.pack.stage import split_subjects, warn_of_gaps, warn_of_temporary_test_subjects
from tests.pipelines.bump_dataset import make_dataset, published

SMALL = EncodeConfig(size=64)
SPLIT = PackConfig(test_subjects=("S002",))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    """Two subjects with depth."""
    made = make_dataset(tmp_path_factory.mktemp("pack"), ("S001", "S002"))
    published(made, DEPTH, DepthConfig(voxel_mm=6))
    return made


@pytest.fixture(scope="module")
def packed(dataset):
    """(folder, metrics) of the packed dataset."""
    encoded = published(dataset, ENCODE, SMALL)
    metrics = published(dataset, PACK, SPLIT)["shards"]
    return dataset.item_dir("pack", "shards"), metrics | {"encoded": encoded}


def pack_into(dataset, out, config=SMALL):
    """Encode all subjects, and gather their shards in a folder; returns the stages' results."""
    encoded = published(dataset, ENCODE, config)
    out.mkdir(exist_ok=True)
    return encoded, PACK.run(dataset, "shards", SPLIT, out)


coordinates = st.floats(-0.15, 0.15)


@settings(deadline=None, max_examples=50)
@given(
    point=st.tuples(coordinates, coordinates, coordinates),
    corner=st.tuples(st.integers(-200, 300), st.integers(-200, 300)),
    side=st.integers(1, 500),
    size=st.sampled_from([16, 100, 256, 512]),
)
def test_projection_commutes_with_crop_and_resize(point, corner, side, size):
    K = np.array([[900.0, 0, 311.7], [0, 880.0, 250.2], [0, 0, 1]])
    pose = look_at(np.array([0.2, 0.1, 1.1]), np.zeros(3))
    camera = pinhole_camera("c", K, 640, 480, pose)
    crop = Crop(*corner, side)
    pixels, depth = project(camera, np.array([point]))
    moved, same = project(crop_pinhole(camera, crop, size), np.array([point]))
    np.testing.assert_allclose(moved, (pixels - corner) * size / side, atol=1e-6)
    assert depth == same


def test_cut_image_and_its_camera_agree_on_where_a_dot_is():
    image = np.zeros((120, 160), np.uint8)
    image[60:64, 90:94] = 255  # centre at corner-origin pixel (92, 62)
    for crop, size in ((Crop(50, 30, 64), 32), (Crop(60, 40, 40), 100), (Crop(70, -10, 100), 50)):
        small = cut_image(image, crop, size).astype(float)
        y, x = np.mgrid[:size, :size] + 0.5
        found = np.array([(small * x).sum(), (small * y).sum()]) / small.sum()
        expected = (np.array([92.0, 62.0]) - (crop.x0, crop.y0)) * size / crop.side
        np.testing.assert_allclose(found, expected, atol=0.05)


@settings(deadline=None, max_examples=30)
@given(
    corner=st.tuples(st.integers(-20, 60), st.integers(-20, 60)),
    side=st.integers(8, 90),
    size=st.sampled_from([16, 37, 64]),
)
def test_depth_of_a_slanted_plane_stays_on_the_plane(corner, side, size):
    K = np.array([[300.0, 0, 40], [0, 300.0, 40], [0, 0, 1]])
    camera = pinhole_camera("c", K, 80, 80, np.eye(4))
    normal = np.array([0.3, -0.4, 1.0])

    def plane(K, count):
        v, u = np.mgrid[:count, :count] + 0.5
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
        return 1.0 / (ray @ normal)

    crop = Crop(*corner, side)
    depth, valid = cut_depth(plane(K, 80), np.ones((80, 80), bool), crop, size)
    place = (np.arange(size) + 0.5) * side / size
    inside = [(place + c > 0.5) & (place + c < 79.5) for c in (corner[1], corner[0])]
    inner = (place > 0.5) & (place < side - 0.5)  # a window's border has no neighbour to lean on
    inside = (inside[0] & inner)[:, None] & (inside[1] & inner)[None]
    assert valid[inside].all()
    expected = plane(crop_pinhole(camera, crop, size).K, size)
    np.testing.assert_allclose(depth[inside], expected[inside], rtol=1e-9)


@settings(deadline=None, max_examples=30)
@given(size=st.integers(8, 90), seed=st.integers(0, 99))
def test_depth_never_blends_two_surfaces_or_the_unknown(size, seed):
    rng = np.random.default_rng(seed)
    near = rng.uniform(size=(40, 40)) > 0.5
    depth = np.where(near, 0.9, 1.3)
    valid = rng.uniform(size=(40, 40)) > 0.2
    cut, known = cut_depth(depth, valid, Crop(-3, 2, 44), size)
    assert set(np.unique(np.round(cut[known], 9))) <= {0.9, 1.3}
    assert (cut[~known] == 0).all()


def test_crop_follows_head_and_hair_but_not_shoulders():
    K = np.array([[500.0, 0, 160], [0, 500.0, 160], [0, 0, 1]])
    pose = look_at(np.array([0, 0, 1.0]), np.zeros(3))
    camera = pinhole_camera("c", K, 320, 320, pose)
    vertices = np.random.default_rng(0).uniform(-0.1, 0.1, (500, 3)) * [1, 1, 0.1]
    alpha = np.zeros((320, 320), np.uint8)
    alpha[100:320, 20:300] = 255  # shoulders
    alpha[80:120, 120:200] = 255  # hair
    crop = head_crop(camera, vertices, alpha)
    assert crop.x0 > 60 and crop.y0 <= 85 and 100 < crop.side < 200
    for moved, matte in (([0, 0, 0], alpha * 0), ([5, 0, 0], alpha), ([0, 0, 3], alpha)):
        with pytest.raises(StageError):
            head_crop(camera, vertices + moved, matte)


def test_split_is_disjoint_and_stable():
    names = [f"S{k:03d}" for k in range(40)]
    split = split_subjects(names, (), 0.2)
    assert sorted(split["train"] + split["test"]) == names
    assert 2 <= len(split["test"]) <= 16
    grown = split_subjects([*names, "S999"], (), 0.2)
    assert set(split["test"]) <= set(grown["test"])
    lent = split_subjects(["A", "B"], (), 0.01)["test"]
    warned = warn_of_temporary_test_subjects(lent, 0.01)
    assert [note.what for note in warned] == lent != []
    assert warn_of_temporary_test_subjects(split["test"], 0.2) == []

    assert split_subjects(["A"], (), 0.5) == {"train": ["A"], "test": []}
    assert split_subjects(["A", "B"], ("B",), 0.5) == {"train": ["A"], "test": ["B"]}
    with pytest.raises(StageError, match="A, B"):
        split_subjects(["A", "B"], ("C",), 0.1)
    with pytest.raises(StageError):
        split_subjects(["A"], ("A",), 0.1)


def test_every_view_is_packed_and_the_account_balances(packed):
    root, metrics = packed
    assert metrics["read"] == metrics["kept"] == 2 * 2 * 6 and metrics["dropped"] == []
    assert verify(root) == []
    reader = ShardReader(root)
    assert {e.subject for e in reader.select(split="test").entries} == {"S002"}
    assert json.loads((root / "splits.json").read_text())["test"] == ["S002"]
    card = (root / "card.md").read_text()
    assert "CC0-1.0" in card and "C-S001" in card and "| smile | 6 | 6 |" in card


def test_people_are_told_who_is_kept_out_of_training(dataset, packed):
    wanted = ["  train: 12 samples of S001", "  test: 12 samples of S002"]
    assert list(PACK.account(dataset, ["shards"])) == wanted


def test_gender_and_age_of_a_few_people_stay_out_of_card_and_shards(packed):
    root, _ = packed
    assert "only for groups of 5 people or more" in (root / "card.md").read_text()
    for path in (p for p in root.rglob("*") if p.is_file()):
        words = (b"feminine", b"47.11", b'gender"', b"tester")
        assert not {word for word in words if word in path.read_bytes()}, path


def test_samples_carry_consent_and_licence_and_lack_of_them_is_a_warning(packed):
    root, metrics = packed
    reader = ShardReader(root)
    metas = [reader.meta(number) for number in range(len(reader))]
    assert {(m["subject"], m["consent"], m["licence"]) for m in metas} == {
        (name, f"C-{name}", "CC0-1.0") for name in ("S001", "S002")
    }
    warnings = [row for one in metrics["encoded"].values() for row in one["warnings"]]
    assert not [row for row in warnings if "consent" in row["why"]]
    whole = [meta | {"parts": True} for meta in metas]
    (note,) = warn_of_gaps([whole[0] | {"consent": None, "licence": None}])
    assert note.what == "capture.toml" and "consent_id" in note.why and "licence" in note.why
    assert warn_of_gaps(whole) == []


def test_names_of_annotators_stay_in_the_label_store():
    for kept in ("auto", "rule:last-frame"):
        assert nameless({"annotator": kept, "frame": 3}) == {"annotator": kept, "frame": 3}
    assert nameless({"annotator": "Jane Roe", "frame": 3}) == {"annotator": "person", "frame": 3}


def test_gender_and_age_of_many_people_are_counted_on_the_card():
    people = [{"age": 20 + 7 * n, "gender": "female" if n % 3 else "male"} for n in range(6)]
    assert people_lines(people) == ["Age: 37.5 years in the mean of 6 people."]
    lines = people_lines(people * 3)
    assert lines[2:4] == [f"| female | 12 | {'█' * 12} |", f"| male | 6 | {'█' * 6} |"]
    assert [line for line in lines if "-" in line[:6]][-3:] == [
        f"| {band} | 6 | {'█' * 6} |" for band in ("18-29", "30-44", "45-59")
    ]
    ages_only = people_lines([{"age": n} for n in (20, 30, 40, 50, 60, -1, True, "x")])
    assert ages_only == ["Age: 40 years in the mean of 5 people."]
    (few,) = people_lines([{"age": 30, "gender": "male"}] * 4)
    assert "5 people or more" in few and "30" not in few and "male" not in few
    hundred = people_lines([{"gender": "a|b\nc"}] * 100)
    assert hundred == ["| gender | subjects | |", "|---|---|---|", f"| a/b c | 100 | {'█' * 40} |"]


def test_samples_of_two_cameras_agree_on_the_surface(packed):
    """Depth, K and pose of a packed sample put points where other packed samples see them."""
    reader = ShardReader(packed[0]).select(subjects=["S001"], expressions=["smile"])
    first, second = reader.sample(2), reader.sample(3)

    def camera(sample):
        m = sample["meta"]
        return pinhole_camera("c", np.array(m["K"]), m["width"], m["height"],
                              np.array(m["cam_from_world"]))  # fmt: skip

    y, x = np.nonzero(first["valid"])
    points = unproject(camera(first), np.stack([x, y], 1) + 0.5, first["depth"][y, x])
    pixels, depth = project(camera(second), points)
    column, row = np.floor(pixels).astype(int).T
    ok = (column >= 0) & (row >= 0) & (column < 64) & (row < 64)
    # the nearest of 3 x 3 pixels: at an occluding edge half a pixel decides between two surfaces
    near = minimum_filter(np.where(second["depth"] > 0, second["depth"], np.inf), 3)
    seen, nearest = second["depth"][row[ok], column[ok]], near[row[ok], column[ok]]
    gap = (depth[ok] - seen)[seen > 0]
    in_front = depth[ok] - nearest < -0.01
    assert in_front[seen > 0].mean() < 0.002  # nothing stands before what the other camera sees
    assert (np.abs(gap) < 0.004).mean() > 0.3  # the rest is hidden from it
    assert first["alpha"][first["valid"]].mean() > 0.9
    assert first["meta"]["track"]["R"] == np.eye(3).tolist()
    assert first["meta"]["label"]["annotator"] == "person" and first["meta"]["fps"] == 24


def test_a_subject_without_peak_frames_is_an_error_that_names_align(ingested):
    with pytest.raises(StageError, match="not aligned; run 'express50 align"):
        read_subject(ingested, "S001")


def test_packing_without_samples_says_why_in_words(ingested, tmp_path):
    with pytest.raises(StageError, match=r"no subject can be packed \(S001: not encoded; run") as e:
        PACK.run(ingested, "shards", SPLIT, tmp_path)
    assert "Note(" not in str(e.value)


def test_packing_twice_gives_the_same_bytes(dataset, packed, tmp_path):
    for stage, item, config in ((ENCODE, "S001", SMALL), (PACK, "shards", SPLIT)):
        out = tmp_path / stage.name
        out.mkdir()
        stage.run(dataset, item, config, out)
        for path in sorted(p for p in out.rglob("*") if p.is_file()):
            before = dataset.item_dir(stage.name, item) / path.relative_to(out)
            assert path.read_bytes() == before.read_bytes(), path


def test_packing_gathers_the_encoded_shards_and_stores_no_sample_twice(dataset, packed):
    for split, subject in (("train", "S001"), ("test", "S002")):
        source = dataset.item_dir("encode", subject) / "subject-000000.tar"
        assert verify(source.parent) == []
        assert source.samefile(packed[0] / f"{split}-000000.tar")


def test_what_is_missing_is_dropped_with_its_reason(dataset, tmp_path):
    depth = dataset.item_dir("depth", "S001/smile") / "cam01.png"
    matte = dataset.matte_file("S001", "neutral", "cam02")
    kept = {path: path.read_bytes() for path in (depth, matte)}
    depth.unlink()
    write_image(matte, np.zeros((96, 96), np.uint8))
    try:
        encoded, result = pack_into(dataset, tmp_path)
    finally:
        for path, data in kept.items():
            path.write_bytes(data)
    dropped = encoded["S001"]["dropped"]
    assert result.metrics["read"] == result.metrics["kept"] + len(dropped) == 24
    why = {row["what"]: row["why"] for row in dropped}
    assert why.keys() == {"S001/neutral/cam02", "S001/smile/cam01"}
    assert f"1 x {why['S001/smile/cam01']}" in (tmp_path / "card.md").read_text()


def test_unsure_depth_can_be_left_out(dataset, packed, tmp_path):
    pack_into(dataset, tmp_path, EncodeConfig(size=64, min_confidence=0.6))
    strict = ShardReader(tmp_path).select(subjects=["S001"])
    loose = ShardReader(packed[0]).select(subjects=["S001"])
    assert strict.sample(0)["valid"].sum() < loose.sample(0)["valid"].sum()


def test_samples_without_any_depth_are_named(dataset, tmp_path):
    encoded, _ = pack_into(dataset, tmp_path, EncodeConfig(size=64, min_confidence=1.0))
    why = {row["what"]: row["why"] for row in encoded["S001"]["warnings"]}
    words = "have no depth; lower encode.min_confidence, which is 1"
    assert why["depth"].endswith(words)


def test_lossless_profile_keeps_pixels(dataset, tmp_path):
    pack_into(dataset, tmp_path, EncodeConfig(size=64, profile="lossless"))
    reader = ShardReader(tmp_path)
    assert "rgb.png" in reader.entries[0].members
    assert reader.sample(0)["rgb"].shape == (64, 64, 3)


def test_what_cameras_make_differently_of_light_is_divided_out(dataset, packed, tmp_path):
    name = ShardReader(packed[0]).select(subjects=["S001"]).sample(0)["meta"]["camera"]
    gains = dataset.gains_file("S001")
    write_json(gains, {name: [1.25, 1.0, 1.0]})
    try:
        for even in (True, False):
            config = EncodeConfig(size=64, profile="lossless", even_colour=even)
            pack_into(dataset, tmp_path / str(even), config)
    finally:
        gains.unlink()
    evened, raw = (
        ShardReader(tmp_path / str(even)).select(subjects=["S001"], cameras=[name]).sample(0)
        for even in (True, False)
    )
    assert evened["meta"]["colour_gain"] == [1.25, 1, 1] and raw["meta"]["colour_gain"] == [1, 1, 1]
    assert (evened["rgb"][..., 1:] == raw["rgb"][..., 1:]).all()
    red = raw["rgb"][..., 0].astype(np.float64)
    ratio = (
        srgb_to_linear(evened["rgb"][..., 0] / 255.0)[red > 60]
        / srgb_to_linear(red / 255)[red > 60]
    )
    assert abs(np.median(ratio) - 0.8) < 0.02


def test_depth_stage_drops_a_bad_camera_and_reports_it(tmp_path):
    dataset = make_dataset(tmp_path)
    empty = dataset.matte_file("S001", "smile", "cam01")
    write_image(empty, np.zeros((96, 96), np.uint8))
    dataset.matte_file("S001", "smile", "cam04").unlink()
    metrics = published(dataset, DEPTH, DepthConfig(voxel_mm=6))
    row = metrics["S001/smile"]
    assert {d["what"] for d in row["dropped"]} == {"cam01", "cam04"} and row["views"] == 4
    assert "empty" in row["dropped"][0]["why"]
    assert metrics["S001/neutral"]["views"] == 6
    folder = dataset.item_dir("depth", "S001/smile")
    depth, valid = read_depth(folder / "cam00.png")
    assert 1.0 < depth[valid].mean() < 1.2 and valid.sum() > 500
    assert not (folder / "cam01.png").exists() and (folder / "qc" / "surface.jpg").exists()
    assert 0 < row["voxels_allocated"] < row["voxel_limit"] and row["grid_bytes"] < 2e6
    assert row["voxel_share"] == round(row["voxels_allocated"] / row["voxels_dense"], 5)
    assert row["coverage"] > 0.9


def test_an_excluded_subject_is_left_out_with_its_reason(dataset, tmp_path):
    file = dataset.labels_file("S002")
    before = file.read_text() if file.exists() else ""
    file.parent.mkdir(exist_ok=True)
    event = {"subject": "S002", "expression": "", "action": "exclude", "annotator": "ann"}
    file.write_text(before + json.dumps(event | {"time": 1.0, "reason": "heavy makeup"}) + "\n")
    try:
        assert PACK.inputs(dataset, "shards", SPLIT)["S002 excluded"] == "heavy makeup"
        assert ENCODE.items(dataset) == ["S001"]
        result = PACK.run(dataset, "shards", PackConfig(), tmp_path)
    finally:
        file.write_text(before)
    assert [note.what for note in result.dropped] == ["S002"]
    assert "heavy makeup" in result.dropped[0].why
    assert {e.subject for e in ShardReader(tmp_path).entries} == {"S001"}
    assert "12 samples of 1 subject x 2 expressions" in (tmp_path / "card.md").read_text()


def cut_regions(
    dataset: Dataset, item: str, camera: str, rows: int, missing: tuple[str, ...] = ()
) -> None:
    """Regions of one view: all under some rows is torso."""
    alpha = read_image(dataset.matte_file(*item.split("/"), camera))
    labels = np.where(alpha > 127, np.uint8(LABELS.index("skin")), np.uint8(0))
    labels[rows:] = np.where(labels[rows:] > 0, np.uint8(LABELS.index("torso")), 0)
    head = alpha.copy()
    head[rows:] = 0
    folder = dataset.item_dir("regions", item)
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{camera}.png", labels)
    write_image(folder / f"{camera}_head.png", head)
    write_json(folder / "metrics.json", {"missing": list(missing), "method": "mesh"})


def test_a_torso_that_was_not_separated_is_not_called_removed(dataset, tmp_path):
    try:
        cut_regions(dataset, "S001/neutral", "cam02", 60, missing=("torso",))
        metrics = pack_into(dataset, tmp_path)[1].metrics
    finally:
        shutil.rmtree(dataset.stage_dir("regions"))
    assert metrics["with_parts"] == 1 and metrics["torso_removed"] == 0


def test_the_torso_leaves_alpha_but_its_labels_and_depth_are_packed(dataset, packed, tmp_path):
    assert packed[1]["with_parts"] == packed[1]["torso_removed"] == 0
    assert packed[1]["encoded"]["S001"]["warnings"][0]["what"] == "regions"
    before = ShardReader(packed[0]).select(subjects=["S001"], cameras=["cam02"])
    assert before.sample(0)["parts"] is None and before.meta(0)["torso"] == "kept"
    try:
        for expression in ("neutral", "smile"):
            cut_regions(dataset, f"S001/{expression}", "cam02", 60)
        encoded, result = pack_into(dataset, tmp_path / "remove")
        pack_into(dataset, tmp_path / "keep", replace(SMALL, torso="keep"))
        assert "regions" in ENCODE.inputs(dataset, "S001", SMALL)
    finally:
        shutil.rmtree(dataset.stage_dir("regions"))
    assert result.metrics["with_parts"] == result.metrics["torso_removed"] == 2
    (warning,) = encoded["S001"]["warnings"]
    assert warning["what"] == "regions" and "10 of 12" in warning["why"]
    assert "| torso removed | 2 of 24 samples |" in (tmp_path / "remove" / "card.md").read_text()
    removed, kept = (
        ShardReader(tmp_path / how).select(subjects=["S001"], cameras=["cam02"]).sample(0)
        for how in ("remove", "keep")
    )
    assert removed["meta"]["torso"] == "removed" and kept["meta"]["torso"] == "kept"
    torso = kept["parts"] == LABELS.index("torso")
    assert torso.any() and set(np.unique(kept["parts"])) <= {0, LABELS.index("skin"), 10}
    assert kept["alpha"][torso].mean() > 0.9 and kept["valid"][torso].any()
    # The crop follows what is left, so that the pixels of the two need not be the same.
    gone = removed["parts"] == LABELS.index("torso")
    assert removed["alpha"][gone].mean() < 0.05 and removed["valid"][gone].mean() > 0.9
    beside = (removed["alpha"] < 0.4) & ~gone
    assert beside.any() and removed["valid"][beside].mean() < 0.1  # borders, in another size


def test_labels_are_cut_by_the_nearest_pixel():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:20, 30:50] = 7
    small = cut_labels(labels, Crop(20, 0, 40), 80)
    assert set(np.unique(small)) == {0, 7} and (small == 7).sum() == 4 * 200
    assert (cut_labels(labels, Crop(50, 30, 40), 10) == 0).all()
    assert cut_labels(labels, Crop(0, 0, 1), 16).shape == (16, 16)


def test_what_hides_the_face_is_measured():
    parts = np.array([["skin", "lips", "hand", "hand", "hair", "torso", "apparel", "eyes"]])
    labels = np.vectorize(LABELS.index)(parts).astype(np.uint8)
    assert occluded(labels) == {"hand": 0.3333, "apparel": 0.1667}
    assert occluded(labels[:, :2]) == {}
