"""The matte stage with networks and without plates, as the runner runs it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common import write_peaks
from express50.capture.frames import read_cameras_of, read_peak_frame, write_frame
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.error_model import error_bounds
from express50.errors import ConfigError
from express50.files.images import read_image, write_image
from express50.geometry.cameras import pinhole
from express50.runner.runner import Summary
from express50.twin.rig import make_rig
from pipelines import calibrate, frames
from pipelines.matte import STAGE
from pipelines.matte.stage import body_sides, matte_warnings, rim_figures, wall_noise
from tests.pipelines.bump_dataset import make_dataset as bump_dataset
from tests.pipelines.matte_rig import disc, turned
from tests.pipelines.matte_scenes import make_scene
from tests.pipelines.stand_ins import Bad, Difference, onnx_bright, torchscript
from tests.stages import ingest_captures, metrics_of, notes_of, run_here
from tests.synth import make_capture

pytestmark = pytest.mark.usefixtures("no_faces")
BACKDROP = np.array([77, 128, 102], np.uint8)


def run(dataset: Dataset, **settings) -> Summary:
    """The stage over every item, in this process."""
    return run_here(STAGE, dataset, **settings)


def make_dataset(root: Path, captures: list[Path]) -> Dataset:
    """Captures ingested, with given cameras, and labelled."""
    dataset = ingest_captures(root / "dataset", *captures, preset="standard")
    assert run_here(calibrate.STAGE, dataset, check_frame_sets=0).ok  # a ball has no face to match
    for subject in dataset.subjects():
        cues = read_index(dataset, subject).cues
        write_peaks(dataset, subject, {cue.expression_id: cue.start_frame for cue in cues})
    run_here(frames.STAGE, dataset)
    return dataset


@pytest.fixture(scope="module")
def labelled(tmp_path_factory, capture) -> Dataset:
    """S001 with three cameras, two expressions and plates; only copied."""
    return make_dataset(tmp_path_factory.mktemp("labelled"), [capture])


@pytest.fixture
def aligned(tmp_path, labelled) -> Dataset:
    return Dataset(shutil.copytree(labelled.root, tmp_path / "dataset"))


def unplated(root: Path) -> Path:
    """A capture with one camera and no plate."""
    path = root / "S001"
    make_capture(path, cameras=1, size=128, plates=False)
    rng = np.random.default_rng(0)
    alpha = make_scene(3, size=128).alpha[..., None]
    for frame in sorted((path / "cameras" / "cam00" / "frames").iterdir()):
        image = 200 * alpha + 40 * (1 - alpha) + rng.normal(0, 1, (128, 128, 3))
        write_image(frame, np.rint(image).astype(np.uint8))
    return path


def test_background_matting_sees_frame_and_plate(aligned, tmp_path) -> None:
    weights = torchscript(Difference(), tmp_path / "net.pt")
    assert run(aligned, method="bgmv2", weights=str(weights)).ok
    learned = read_image(aligned.matte_file("S001", "smile", "cam00"))
    figures = metrics_of(aligned, "matte", "S001/smile")
    assert figures["method"] == "bgmv2"
    assert run(aligned).ok
    keyed = read_image(aligned.matte_file("S001", "smile", "cam00"))
    assert ((learned > 127) == (keyed > 127)).mean() > 0.97 and learned.shape == keyed.shape


def test_other_weights_run_again_and_the_same_do_not(aligned, tmp_path) -> None:
    settings = {"method": "bgmv2", "weights": str(tmp_path / "net.pt")}
    torchscript(Difference(), tmp_path / "net.pt")
    first = run(aligned, **settings)
    assert first.ok and run(aligned, **settings).count("skipped") == 2
    path = aligned.matte_file("S001", "neutral", "cam00")
    before = path.read_bytes()
    other = Difference()
    other.gain.data.fill_(2.0)
    torchscript(other, tmp_path / "net.pt")
    assert run(aligned, **settings).count("done") == 2
    assert path.read_bytes() != before


def test_a_salient_network_needs_no_plate(tmp_path) -> None:
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw")])
    settings = {"method": "salient", "weights": str(onnx_bright(tmp_path / "net.onnx", 128))}
    assert run(dataset, **settings).ok
    folder = dataset.item_dir("matte", "S001/smile")
    alpha = read_image(folder / "cam00.png")
    assert alpha[64, 64] == 255 and alpha[2, 2] == 0
    before = {p: p.read_bytes() for p in folder.rglob("*.*")}
    assert run(dataset, **settings, shadow=0.2).count("done") == 2  # run again, the same bytes
    assert {p: p.read_bytes() for p in folder.rglob("*.*")} == before


@pytest.mark.parametrize(("how", "message"), [("nan", "gave NaN"), ("pair", "takes 2")])
def test_a_bad_network_fails_items_in_one_line_each(aligned, tmp_path, how, message) -> None:
    path = tmp_path / "net.pt"
    torchscript(Bad(how) if how == "nan" else Difference(), path)
    summary = run(aligned, method="salient", weights=str(path))
    assert summary.count("failed") == 2
    for outcome in summary.outcomes:
        assert "matte.weights" in outcome.reason and message in outcome.reason


def test_missing_weights_are_reported_before_anything_is_run_again(aligned, tmp_path) -> None:
    assert run(aligned).count("done") == 2
    with pytest.raises(ConfigError, match="matte.weights .*no such file"):
        run(aligned, method="salient", weights=str(tmp_path / "net.pt"))
    assert run(aligned).count("skipped") == 2


def test_a_camera_without_a_plate_or_a_frame_is_dropped(aligned) -> None:
    aligned.plate_file("S001", "cam01").unlink()
    aligned.frame_file("S001", "smile", "cam02").unlink()
    assert run(aligned).ok
    dropped = {e: [*notes_of(aligned, "matte", f"S001/{e}", "dropped")]
               for e in ("neutral", "smile")}  # fmt: skip
    assert dropped == {"neutral": ["cam01"], "smile": ["cam01", "cam02"]}
    assert not aligned.matte_file("S001", "smile", "cam02").exists()


def test_keying_without_a_plate_or_a_face_is_refused(tmp_path) -> None:
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw")])
    summary = run(dataset)
    assert [o.status for o in summary.outcomes] == ["failed"] * 2
    assert "no face found" in summary.outcomes[0].reason
    assert "record plates" in summary.outcomes[0].reason


def test_keyed_mattes_are_8_bit_and_the_same_twice(aligned) -> None:
    assert run(aligned).ok
    folder = aligned.item_dir("matte", "S001/smile")
    figures = metrics_of(aligned, "matte", "S001/smile")
    alpha = read_image(folder / "cam00.png")
    assert alpha.shape == (64, 64) and alpha.dtype == np.uint8
    assert figures["coverage"]["cam00"] == pytest.approx(alpha.mean() / 255, abs=1e-6)
    assert 0.05 < figures["coverage"]["cam00"] < 0.6
    assert figures["border_contact"]["cam00"]["top"] == 0.0
    before = {p: p.read_bytes() for p in folder.rglob("*.*")}
    shutil.rmtree(folder)
    assert run(aligned).ok
    assert {p: p.read_bytes() for p in folder.rglob("*.*")} == before


@pytest.fixture(scope="module")
def shaded(tmp_path_factory) -> Dataset:
    """The bump head before plates of its backdrop, with a shadow patch in one camera."""
    dataset = bump_dataset(tmp_path_factory.mktemp("matte"), cameras=8)
    for expression in ("neutral", "smile"):
        for camera in read_cameras_of(dataset, "S001"):
            frame = read_peak_frame(dataset, "S001", expression, camera)
            true = read_image(dataset.matte_file("S001", expression, camera))
            plate = np.where(true[..., None] == 0, frame, BACKDROP).astype(np.uint8)
            path = dataset.plate_file("S001", camera)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_frame(path, plate)
            if (expression, camera) == ("smile", "cam02"):
                frame = np.where(disc(0.12, 0.3, 0.09)[..., None], 255 - frame, frame)
                write_frame(dataset.frame_file("S001", expression, camera), frame.astype(np.uint8))
    shutil.rmtree(dataset.stage_dir("matte"))
    return dataset


def test_what_one_camera_alone_shows_is_removed(shaded) -> None:
    assert run(shaded).ok
    figures = metrics_of(shaded, "matte", "S001/smile")
    assert figures["views"] == 8 and figures["dropped"] == []
    assert set(figures["removed"]) == {"cam02"}
    assert figures["removed"]["cam02"] == pytest.approx(np.pi * 0.09**2, rel=0.2)
    corrected = read_image(shaded.matte_file("S001", "smile", "cam02"))
    assert run(shaded, agree=False).ok
    figures = metrics_of(shaded, "matte", "S001/smile")
    assert figures["unchanged"] and figures["views"] == 0
    own = read_image(shaded.matte_file("S001", "smile", "cam02"))
    patch = disc(0.12, 0.3, 0.07)
    assert own[patch].mean() > 200 and corrected[patch].mean() < 20


def test_bounds_are_wider_where_the_subject_differs_little_from_the_wall():
    rng = np.random.default_rng(0)
    alpha = np.zeros((128, 128), np.uint8)
    alpha[40:, 40:90] = 255
    bounds = []
    for contrast, noise in ((90, 1), (90, 6), (12, 6)):
        frame = 100 + contrast * (alpha[..., None] > 0) + rng.normal(0, noise, (128, 128, 3))
        frame = frame.astype(np.uint8)
        figures = rim_figures(alpha, frame, wall_noise(alpha, frame), plated=True, views=8)
        bounds.append(float(np.median(error_bounds("matte", figures).bound)))
    assert bounds[0] < bounds[1] < bounds[2]


def test_noise_of_the_wall_is_not_that_of_its_edges_or_of_the_subject():
    rng = np.random.default_rng(0)
    alpha = np.zeros((128, 128), np.uint8)
    alpha[40:, 40:90] = 255
    frame = np.full((128, 128, 3), 100, np.uint8)
    assert wall_noise(alpha, frame) == 0.0
    frame[alpha > 0] = rng.integers(0, 256, (int((alpha > 0).sum()), 3))
    frame[:, 110:] = 180
    assert wall_noise(alpha, frame) < 0.2
    assert wall_noise(np.full_like(alpha, 255), frame) == np.inf


@pytest.mark.parametrize("lying", [(0,), (1, 4), range(8)])
def test_a_body_may_leave_a_camera_on_its_side_where_the_others_say(lying) -> None:
    body = np.zeros((40, 40), np.uint8)
    body[25:, 5:35] = body[10:, 15:25] = 255
    high = np.roll(body, -12, axis=0)  # whose head is cut off
    high[-12:] = body[-1]
    cameras = {name: pinhole(camera) for name, camera in make_rig(8, 40, 40, 0).items()}
    alphas = dict.fromkeys(cameras, body) | {"cam04": high, "cam05": high}
    for k in lying:
        name = f"cam{k:02d}"
        cameras[name], alphas[name] = turned(cameras[name]), np.rot90(alphas[name])
    notes = matte_warnings(alphas, body_sides(cameras, alphas))
    said = {note.what: note.why for note in notes}
    sides = {name: "left" if int(name[3:]) in lying else "top" for name in ("cam04", "cam05")}
    assert said.keys() == sides.keys()
    assert all(f"at the {side} (" in said[name] for name, side in sides.items())


@pytest.mark.parametrize("turns", range(4))
def test_shoulders_may_leave_a_tight_picture(turns: int) -> None:
    alpha = np.zeros((40, 40), np.uint8)
    alpha[5:, 15:25] = alpha[30:] = 255
    body = {"cam00": ("bottom", "right", "top", "left")[turns]}
    assert not matte_warnings({"cam00": np.rot90(alpha, turns)}, body)
    (note,) = matte_warnings({"cam00": np.rot90(np.roll(alpha, 15, axis=1), turns)}, body)
    assert f"at the {('right', 'top', 'left', 'bottom')[turns]} (" in note.why


def test_a_single_camera_is_taken_to_be_upright() -> None:
    alpha = np.zeros((40, 40), np.uint8)
    alpha[10:, :30] = 255
    camera = pinhole(make_rig(1, 40, 40, 0)["cam00"])
    notes = matte_warnings({"cam00": alpha}, body_sides({"cam00": camera}, {"cam00": alpha}))
    assert ["at the left (75%)" in note.why for note in notes] == [True]
