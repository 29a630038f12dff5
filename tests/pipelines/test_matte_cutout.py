"""Alpha without plates or weights: a photograph, a rig, their edges, and what has no face."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.common import recorded, write_peaks
from benchmarks.truth import Truth
from express50.__main__ import main
from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.errors import ConfigError, StageError
from express50.files.images import read_alpha, write_image
from express50.geometry.cameras import Camera, pinhole
from express50.head.load import load_head
from express50.landmarks import detector
from express50.shards.reader import ShardReader
from express50.twin import TwinConfig
from express50.twin.record import record
from pipelines import calibrate, frames, ingest
from pipelines.matte import STAGE as MATTE
from pipelines.matte import MatteConfig, stage
from pipelines.matte.cutout import (
    CutView,
    HeadPlace,
    _with_own_colours,
    cut_out,
    find_head,
    find_neighbours,
    make_cut_view,
    parts_of_a_person,
)
from pipelines.matte.key import key_alpha
from pipelines.matte.stage import (
    LIKE_THE_WALL,
    SOMETHING_ELSE,
    CameraMatte,
    Shots,
    camera_mattes,
)
from pipelines.matte.wall import soft_alpha, valid_pixels
from pipelines.photo.capture import make_photo_capture, open_picture, single_camera
from pipelines.track.config import TrackConfig
from tests.pipelines.matte_rig import turned
from tests.stages import metrics_of, run_here
from tests.synth import write_video

data = pytest.importorskip("skimage.data")
HEAD = [(225, 30), (160, 80), (290, 90), (220, 100), (225, 165), (225, 182)]  # hair, face, neck
BEHIND = [(350, 40), (100, 60), (480, 60), (310, 130), (130, 120), (225, 5)]
# Which parts of the suit are found depends on GrabCut's start: its collar is as black as the table.
ABOVE_THE_SUIT = np.s_[:150, 120:330]


def view_of(image: np.ndarray) -> CutView:
    height, width = image.shape[:2]
    camera = single_camera("photo", width, height, 1.6 * max(width, height))
    return make_cut_view(camera, image, np.ones((height, width), bool))


def alpha_of(image: np.ndarray) -> np.ndarray:
    cuts = cut_out([view_of(image)], None)
    alpha = soft_alpha(image, np.ones(image.shape[:2], bool), cuts["photo"])
    assert alpha.shape == image.shape[:2] and alpha.dtype == np.float32
    assert np.isfinite(alpha).all() and alpha.min() >= 0 and alpha.max() <= 1
    return alpha


@pytest.fixture(scope="module")
def alpha() -> np.ndarray:
    return alpha_of(data.astronaut())


def test_hair_and_face_are_distinguished_from_the_wall(alpha: np.ndarray) -> None:
    assert all(alpha[y, x] > 0.95 for x, y in HEAD), [alpha[y, x] for x, y in HEAD]
    assert all(alpha[y, x] < 0.05 for x, y in BEHIND), [alpha[y, x] for x, y in BEHIND]
    soft = (alpha[:140] > 0.05) & (alpha[:140] < 0.95)
    assert 200 < soft.sum() < 6000, "hair has soft edges, and nothing else is in doubt"


def test_the_same_picture_gives_the_same_alpha(alpha: np.ndarray) -> None:
    np.testing.assert_array_equal(alpha, alpha_of(data.astronaut()))


@pytest.mark.parametrize("turns", [1, 3])
def test_a_picture_on_its_side_is_cut_alike(alpha: np.ndarray, turns: int) -> None:
    turned = np.rot90(alpha_of(np.ascontiguousarray(np.rot90(data.astronaut(), turns))), -turns)
    assert np.abs(turned - alpha)[ABOVE_THE_SUIT].mean() < 0.003


@pytest.mark.parametrize(
    "crop", [np.s_[60:190, 170:280], np.s_[:200, 225:], np.s_[70:175, 180:270], np.s_[:, 60:400]]
)
def test_cut_and_filling_faces_stay_finite(crop: tuple[slice, slice]) -> None:
    """A face that fills the picture, half a face, one without its hair, one with its torso."""
    image = np.ascontiguousarray(data.astronaut()[crop])
    try:
        found = alpha_of(image)
    except StageError as error:
        assert "no face found" in str(error)
    else:
        assert found.max() > 0.9


@pytest.mark.parametrize("scale", [0.35, 3.0])
def test_small_and_large_pictures_are_cut_alike(alpha: np.ndarray, scale: float) -> None:
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = cv2.resize(
        data.astronaut()[:256], None, fx=scale, fy=scale, interpolation=interpolation
    )
    found = cv2.resize(alpha_of(image), (512, 256), interpolation=cv2.INTER_AREA)
    assert np.abs(found - alpha[:256])[ABOVE_THE_SUIT].mean() < 0.02


def test_a_ponytail_belongs_to_the_person() -> None:
    """Seen from the side, it hangs where the head's shape makes wall more likely."""
    camera = single_camera("photo", 360, 360, 500.0)
    turn = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])  # the face looks to the right
    world = np.linalg.inv(camera.cam_from_world)
    place = HeadPlace(1.0, world[:3, :3] @ turn, world[:3] @ [0, 0, 0.8, 1])
    image = np.full((360, 360, 3), 150.0)
    shapes = {  # heights and depths on the head, metres
        (160, 160, 160): [(-0.08, -0.06), (-0.3, -0.12), (-0.5, -0.12), (-0.5, 0.1), (-0.3, 0.1)],
        (200, 150, 120): [(0.05, 0.1), (-0.08, 0.09), (-0.15, 0.0), (-0.15, -0.06), (0.05, 0.0)],
        (90, 50, 25): [(0.13, 0.03), (0.08, 0.09), (-0.04, 0.0), (-0.04, -0.1), (0.1, -0.1)],
        (150, 85, 40): [(0.11, 0.03), (0.08, 0.04), (-0.03, 0.0), (-0.03, -0.03), (0.1, -0.05)],
        (25, 20, 20): [(0.06, -0.09), (0.05, -0.09), (0.02, -0.13), (0.03, -0.13)],
        (110, 60, 30): [
            (0.04, -0.115),
            (0.04, -0.14),
            (-0.08, -0.2),
            (-0.22, -0.19),
            (-0.22, -0.15),
            (-0.08, -0.12),
        ],
    }
    for colour, places in shapes.items():
        pixels = place.pixels(np.array([(0, *p) for p in places]), camera)
        cv2.fillPoly(image, [pixels.round().astype(np.int32)], colour)
    image += np.random.default_rng(0).normal(0, 4, image.shape)
    view = make_cut_view(camera, image.clip(0, 255).astype(np.uint8), np.ones((360, 360), bool))
    mask = cut_out([view], None, place)["photo"].mask
    ((x, y),) = place.pixels(np.array([[0, -0.12, -0.17]]), camera) * mask.shape[0] / 360
    assert mask[int(y), int(x)] and mask.mean() < 0.4


@pytest.mark.parametrize("turns", range(4))
def test_what_looks_like_the_person_and_leaves_the_picture_beside_them_is_not_a_ponytail(
    turns: int,
) -> None:
    guess = np.full((120, 120), cv2.GC_PR_BGD, np.uint8)
    guess[:20], guess[80:, 40:80], guess[30:80, 45:75] = cv2.GC_BGD, cv2.GC_PR_FGD, cv2.GC_FGD
    image = np.full((120, 120, 3), 150, np.uint8)
    ponytail, floor = np.s_[40:80, 30:42], np.s_[95:, :35]
    for place in (np.s_[30:80, 45:75], ponytail, floor):
        image[place] = 110, 60, 30
    turned, start = (np.ascontiguousarray(np.rot90(i, turns)) for i in (image, guess))
    camera = single_camera("photo", 120, 120, 200.0)
    labels = _with_own_colours(CutView(camera, turned, np.ones((120, 120), bool)), start)
    found = np.rot90(labels, -turns)
    assert (found[ponytail][2:-2, 2:-2] == cv2.GC_PR_FGD).all()
    assert (found[floor] == cv2.GC_PR_BGD).all()


def test_a_neighbour_is_wall() -> None:
    one = data.astronaut()[:200, 145:305]
    alone, pair = view_of(one), view_of(np.hstack([one, one]))
    assert not find_neighbours(alone, find_head([alone]))
    place = find_head([pair])
    (other,) = find_neighbours(pair, place)
    mine, theirs = (
        int(p.pixels(np.zeros((1, 3)), pair.camera)[0, 0] > 160) for p in (place, other)
    )
    assert theirs == 1 - mine
    alpha = alpha_of(np.hstack([one, one]))
    for x, y in HEAD:
        assert alpha[y, x - 145 + 160 * mine] > 0.95
        assert alpha[y, x - 145 + 160 * theirs] < 0.05


def test_what_counts_as_certain_lies_inside_the_head_model() -> None:
    vertices = load_head("procedural").template.double().numpy()
    for part in parts_of_a_person()[cv2.GC_FGD]:
        for point in part[part[:, 1] > vertices[:, 1].min()]:
            near = vertices[np.abs(vertices[:, 1] - point[1]) < 0.01]
            inside = (near.min(0) <= point) & (point <= near.max(0))
            assert inside[0] and inside[2], point


def test_what_shows_no_face_is_refused() -> None:
    with pytest.raises(StageError, match="no face found.*matte.method=salient"):
        alpha_of(np.repeat(data.brick()[..., None], 3, axis=2))
    with pytest.raises(ConfigError, match="key and grabcut take no weights"):
        MatteConfig(method="grabcut", weights="net.pt")


def test_a_photograph_becomes_a_sample_of_shards_without_plate_or_weights(tmp_path: Path) -> None:
    write_image(tmp_path / "eva.png", data.astronaut())
    assert main(["photo", str(tmp_path / "eva.png"), str(tmp_path / "out"), "--matte",
                 "--preset", "draft"]) == 0  # fmt: skip
    dataset = Dataset(tmp_path / "out")
    figures = metrics_of(dataset, "matte", "eva/photo")
    assert figures["method"] == "grabcut"
    matte = read_alpha(dataset.matte_file("eva", "photo", "photo"))
    assert all(matte[y, x] > 240 for x, y in HEAD) and all(matte[y, x] < 12 for x, y in BEHIND)

    for step in ("depth", "regions", "pack"):
        assert main([step, str(dataset.root), "--preset", "draft"]) == 0
    reader = ShardReader(dataset.stage_dir("pack") / "shards")
    assert [entry.key for entry in reader.entries] == ["eva_photo_photo"]
    sample = reader.sample(0)
    known, head = sample["valid"], sample["alpha"] > 0.5
    assert 0.3 < (known & head).sum() / head.sum() < 1
    assert 0.5 < np.median(sample["depth"][known]) < 3.0


def test_a_frame_without_a_face_fails_alone(tmp_path: Path) -> None:
    """Of a video whose second half shows a wall, the first half is matted."""
    face, wall = data.astronaut()[:256, 100:356], np.repeat(data.brick()[:256, :256, None], 3, 2)
    write_video(tmp_path / "eva.mp4", [np.ascontiguousarray(i) for i in (face, wall)])
    config = TrackConfig()
    dataset = Dataset(tmp_path / "out")
    folder = dataset.root / "photos" / "eva"
    make_photo_capture(open_picture(tmp_path / "eva.mp4"), folder, "eva", config, windows=2)
    ingest.add_captures(dataset, [folder])
    for step in (ingest.STAGE, calibrate.STAGE):
        assert run_here(step, dataset).ok
    write_peaks(dataset, "eva", {"clip_00": 0, "clip_01": 1})
    assert run_here(frames.STAGE, dataset).ok
    run = run_here(MATTE, dataset, method="grabcut")
    assert {o.item: o.status for o in run.outcomes} == {
        "eva/clip_00": "done", "eva/clip_01": "failed",
    }  # fmt: skip
    assert dataset.matte_file("eva", "clip_00", "photo").is_file()


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> tuple[Dataset, Truth]:
    """A made-up person before eight cameras, two of them behind; peaks are written."""
    twin = TwinConfig(
        subjects=1, first_subject=61, cameras=8, width=256, height=256, expressions=("neutral",),
        frames_per_expression=4, footage="jpg", board_frames=0, give_calibration=True,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("twin")
    record(twin, folder, workers=1)  # processes would cost more than gain
    dataset, truth = recorded(twin, folder)
    subject = dataset.subjects()[0]
    assert run_here(calibrate.STAGE, dataset).ok
    write_peaks(dataset, subject, {"neutral": 0})
    assert run_here(frames.STAGE, dataset).ok
    return dataset, truth


def mean_errors(dataset: Dataset, truth: Truth) -> dict[str, float]:
    """Mean absolute errors of the mattes of the only peak, by camera."""
    subject = dataset.subjects()[0]
    cameras = read_cameras_of(dataset, subject)
    used = {name: truth.cameras(subject)[name] for name in cameras}
    return {
        name: float(np.abs(
            read_alpha(dataset.matte_file(subject, "neutral", name)) / 255
            - truth.render_alpha(subject, 0, pinhole(camera)) * valid_pixels(camera)
        ).mean())
        for name, camera in used.items()
    }  # fmt: skip


def test_plates_of_cameras_on_their_side_are_used(rig, monkeypatch) -> None:
    """The person's body leaves their pictures at a side, where plates are compared first."""
    dataset, _ = rig
    subject = dataset.subjects()[0]
    cameras = list(read_cameras_of(dataset, subject).items())[:4]
    upright = {name: pinhole(camera) for name, camera in cameras}
    keyed = lambda frame, plate, valid: key_alpha(frame, plate, valid, 0.25)  # noqa: E731

    def mattes(cameras: dict[str, Camera]) -> dict[str, CameraMatte]:
        item = f"{subject}/neutral"
        found, dropped, warnings = camera_mattes(Shots(dataset, item, "key", keyed, cameras), None)
        assert not dropped and not warnings
        return found

    right = mattes(upright)
    for reader in ("read_peak_frame", "read_plate_image"):
        read = getattr(stage, reader)
        monkeypatch.setattr(
            stage, reader, lambda *a, read=read: np.ascontiguousarray(np.rot90(read(*a)))
        )
    lying = mattes({name: turned(camera) for name, camera in upright.items()})
    for name, matte in lying.items():
        assert matte.plated, name
        difference = cv2.absdiff(np.ascontiguousarray(np.rot90(matte.alpha, -1)), right[name].alpha)
        assert difference.mean() / 255 < 0.01, name


def test_another_person_is_taken_out_of_mattes_with_plates(rig, monkeypatch) -> None:
    dataset, truth = rig
    subject = dataset.subjects()[0]
    assert run_here(MATTE, dataset).ok
    alone = mean_errors(dataset, truth)
    name = list(alone)[0]
    alpha = truth.render_alpha(subject, 0, pinhole(truth.cameras(subject)[name]))
    read = stage.read_peak_frame

    def joined(dataset: Dataset, subject: str, expression: str, camera: str) -> np.ndarray:
        frame = read(dataset, subject, expression, camera)
        if camera != name:
            return frame
        behind = frame.copy()
        behind[60:160, 16:96] = cv2.resize(data.astronaut()[:200, 145:305], (80, 100))
        share = alpha[..., None]
        return np.rint(share * frame + (1 - share) * behind).astype(np.uint8)

    monkeypatch.setattr(stage, "read_peak_frame", joined)
    assert run_here(MATTE, dataset, tile=1024).ok  # another configuration, so it runs again
    warned = metrics_of(dataset, "matte", f"{subject}/neutral")["warnings"]
    assert {"what": name, "why": SOMETHING_ELSE} in warned
    assert mean_errors(dataset, truth)[name] < alone[name] + 0.01


def test_a_part_that_looks_like_the_wall_is_added_as_other_cameras_see_it(rig, monkeypatch) -> None:
    dataset, truth = rig
    subject = dataset.subjects()[0]
    name = list(read_cameras_of(dataset, subject))[2]
    alpha = truth.render_alpha(subject, 0, pinhole(truth.cameras(subject)[name]))
    rows = np.nonzero(alpha.any(1))[0]
    alike = (alpha > 0) & (np.arange(len(alpha))[:, None] > np.quantile(rows, 0.6))
    read = stage.read_plate_image

    def like_the_shirt(dataset: Dataset, subject: str, camera: str) -> np.ndarray:
        plate = read(dataset, subject, camera)
        if camera != name:
            return plate
        frame = read_peak_frame(dataset, subject, "neutral", camera)
        noisy = frame + np.random.default_rng(0).normal(0, 1.5, frame.shape)
        return np.where(alike[..., None], noisy.clip(0, 255).round(), plate).astype(np.uint8)

    monkeypatch.setattr(stage, "read_plate_image", like_the_shirt)
    assert run_here(MATTE, dataset, tile=960).ok  # another configuration, so it runs again
    warned = metrics_of(dataset, "matte", f"{subject}/neutral")["warnings"]
    assert warned == [{"what": name, "why": LIKE_THE_WALL}]
    assert mean_errors(dataset, truth)[name] < 0.2 * alike.mean()


def test_a_rig_without_plates_is_matted_from_all_sides(rig, monkeypatch) -> None:
    dataset, truth = rig
    subject = dataset.subjects()[0]
    faces, detect_many = {}, detector.detect_many

    def detect_once(net, images, *given, **named):  # both runs look at the same pictures
        key = *(image.tobytes() for image in images), given, str(named)
        if key not in faces:
            faces[key] = detect_many(net, images, *given, **named)
        return faces[key]

    monkeypatch.setattr(detector, "detect_many", detect_once)
    metrics = dataset.item_dir("matte", f"{subject}/neutral") / "metrics.json"

    names = list(read_cameras_of(dataset, subject))
    dataset.plate_file(subject, names[3]).unlink()
    assert run_here(MATTE, dataset).ok
    assert json.loads(metrics.read_text())["without_plate"] == [names[3]]
    beside_plates = mean_errors(dataset, truth)
    assert beside_plates[names[3]] < 0.015

    for name in names:
        dataset.plate_file(subject, name).unlink(missing_ok=True)
    assert run_here(MATTE, dataset).ok
    figures = json.loads(metrics.read_text())
    assert figures["without_plate"] == names and not figures["dropped"]
    without = mean_errors(dataset, truth)
    assert max(without.values()) < 0.026 and np.mean(list(without.values())) < 0.018
