"""Hostile and broken captures of other layouts: one clear error, nothing read from elsewhere."""

import json
import os
import shutil
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pytest

from express50.capture.index import read_index
from express50.capture.readers.read import detect, read_any
from express50.contract.layout import Dataset
from express50.errors import CalibrationError, CaptureError
from express50.files.containers import BYTES_LIMIT, inside, read_picture
from express50.files.images import PIXEL_LIMIT, encode_png
from express50.files.text import read_json
from pipelines import ingest
from tests.express50.capture import layouts
from tests.stages import run_here
from tests.synth import make_capture


@pytest.fixture
def renderme(tmp_path):
    return layouts.write_renderme(tmp_path / "set", expressions=1, frames=3)


def rewrite(path, change):
    with h5py.File(path, "a") as file:
        change(file)


def test_a_truncated_smc_is_named(renderme):
    path = renderme / "0026_e0_raw.smc"
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(CaptureError, match="0026_e0_raw.smc: cannot be opened as HDF5"):
        read_any(renderme)


def test_a_picture_that_is_not_bytes_or_lies_elsewhere_is_refused(renderme, tmp_path):
    path, name = renderme / "0026_e0_raw.smc", "Camera/00/color/0"
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["x"] = np.zeros(3, np.uint8)
    layout = h5py.VirtualLayout((3,), np.uint8)
    layout[:] = h5py.VirtualSource(str(secret), "x", (3,))

    def replace(make):
        def change(file):
            del file[name]
            make(file)

        return change

    wrong = {
        "expected encoded bytes": lambda f: f.create_dataset(name, data=np.zeros((2, 2))),
        "expected numbers": lambda f: f.create_virtual_dataset(name, layout),
        "is a link": lambda f: f.__setitem__(name, h5py.ExternalLink(str(secret), "x")),
        "expected at most": lambda f: f.create_dataset(
            name, (BYTES_LIMIT + 1,), np.uint8, chunks=(1 << 20,)
        ),
        "JPEG": lambda f: f.create_dataset(name, data=np.arange(50, dtype=np.uint8)),
        "no array": lambda f: f.create_group(name),
    }
    for number, (message, make) in enumerate(wrong.items()):
        copy = renderme / f"{number}.smc"
        copy.write_bytes(path.read_bytes())
        rewrite(copy, replace(make))
        with pytest.raises(CaptureError, match=message):
            read_picture(renderme, f"{copy.name}!/{name}")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("K", np.zeros((3, 3, 3)), "expected .3, 3."),
        ("RT", np.full((4, 4), np.nan), "finite"),
        ("RT", np.zeros((4, 4)), "cannot be inverted"),
        ("K", np.array([b"x"]), "expected numbers"),
    ],
)
def test_malformed_cameras_are_one_error(renderme, key, value, message):
    def change(file):
        del file[f"Calibration/01/{key}"]
        file[f"Calibration/01/{key}"] = value

    rewrite(renderme.parents[1] / "anno/0026/0026_e0_anno.smc", change)
    with pytest.raises(CalibrationError, match=message):
        read_any(renderme)


@pytest.mark.parametrize("name", ["../x.png", "/etc/hostname", "a/../../x.png", "a\0b"])
def test_names_cannot_lead_out(tmp_path, name):
    with pytest.raises(CaptureError, match="leads out|cannot be shown"):
        inside(tmp_path, name)


def test_a_link_is_followed_out_of_the_folder(tmp_path):
    (tmp_path / "outside.png").write_bytes(encode_png(layouts.picture(0, 0)))
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "a.png").symlink_to(tmp_path / "outside.png")
    np.testing.assert_array_equal(read_picture(folder, "a.png"), layouts.picture(0, 0))


@pytest.mark.parametrize("target", ["a.png", "../.git/annex/objects/K/K.png"])
def test_a_link_to_nothing_says_what_to_do(tmp_path, target):
    (tmp_path / "a.png").symlink_to(target)
    with pytest.raises(CaptureError, match=f"a link to {target}, which is not there.*annex get"):
        read_picture(tmp_path, "a.png")


@pytest.mark.parametrize(
    ("note", "fetch"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"/annex/objects/SHA256E-s1--0.png\n", "git annex get"),
    ],
)
def test_a_note_in_place_of_a_file_says_what_to_do(tmp_path, note, fetch):
    (tmp_path / "a.png").write_bytes(note)
    with pytest.raises(CaptureError, match=fetch):
        read_picture(tmp_path, "a.png")
    (tmp_path / "a.mp4").write_bytes(note)
    with pytest.raises(CaptureError, match=fetch):
        read_any(tmp_path / "a.mp4")


@pytest.mark.parametrize("name", ["capture.toml", "calibration.json", "cues.csv"])
def test_a_lost_link_does_not_pass_for_a_file_nobody_wrote(tmp_path, name):
    make_capture(tmp_path / "S001")
    (tmp_path / "S001" / name).unlink()
    (tmp_path / "S001" / name).symlink_to("gone")
    with pytest.raises(CaptureError, match=f"{name}: is a link to gone"):
        read_any(tmp_path / "S001")


def test_cameras_of_links_are_read_where_the_content_is_there(tmp_path):
    make_capture(tmp_path / "S001")
    cameras = tmp_path / "S001" / "cameras"
    frames = cameras / "cam00" / "frames"
    frames.rename(tmp_path / "objects")
    frames.mkdir()
    for path in (tmp_path / "objects").iterdir():
        (frames / path.name).symlink_to(path)
    (cameras / "cam01" / "frames" / "000002.png").unlink()
    (cameras / "cam01" / "frames" / "000002.png").symlink_to("gone")
    (cameras / "cam02").rename(tmp_path / "cam02")
    (cameras / "cam02").symlink_to("gone")
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001"])
    result = run_here(ingest.STAGE, dataset)
    assert result.ok and list(read_index(dataset, "S001").cameras) == ["cam00"]
    metrics = read_json(dataset.item_dir("ingest", "S001") / "metrics.json", CaptureError)
    lost = {note["what"]: note["why"] for note in metrics["dropped"]}
    assert lost.keys() == {"camera cam01", "camera cam02"}
    assert all("git annex get" in why for why in lost.values())


def test_transforms_with_paths_out_of_the_folder(tmp_path):
    path = layouts.write_transforms(tmp_path)
    table = json.loads((path / "transforms.json").read_text())
    table["frames"][0]["file_path"] = "../../etc/passwd"
    (path / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(CaptureError, match="leads out"):
        read_any(path)


def test_zip_members_that_claim_too_much_or_are_damaged(tmp_path):
    path = layouts.write_ava(tmp_path)
    archive = path / "decoder/image/cam400981.zip"
    data = bytearray(archive.read_bytes())
    data[60:90] = bytes(30)
    archive.write_bytes(bytes(data))
    with pytest.raises(CaptureError, match="cam400981.zip"):
        read_picture(path, "decoder/image/cam400981.zip!/cam400981/000100.avif")
    bomb = zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with bomb, bomb.open("a.avif", "w") as member:
        for _ in range(BYTES_LIMIT >> 24):
            member.write(bytes(1 << 24))
        member.write(b"x")
    with pytest.raises(CaptureError, match="expected at most"):
        read_picture(tmp_path, "bomb.zip!/a.avif")


def test_a_picture_whose_header_claims_too_many_pixels(tmp_path):
    png = bytearray(encode_png(layouts.picture(0, 0)))
    side = int(PIXEL_LIMIT**0.5) + 1
    png[16:24] = side.to_bytes(4, "big") * 2
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("a.png", bytes(png))
    with pytest.raises(CaptureError, match="over|JPEG"):
        read_picture(tmp_path, "a.zip!/a.png")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("cameras = 3", "expected a list"),
        ("metres_per_unit = nan", "line 1 holds nan"),
        ('[expressions]\nphoto = "a b"', "expected a table"),
        ('source = "nowhere"', "source is 'nowhere'"),
        ("fps = -1", "fps is -1"),
        ('subject = "../x"', "subject is"),
        ('layout = "avi"', "expected one of express50"),
        ("= 3", "not TOML"),
    ],
)
def test_wishes_that_cannot_be(tmp_path, line, message):
    path = layouts.write_transforms(tmp_path)
    (path / "capture.toml").write_text(line)
    with pytest.raises(CaptureError, match=message):
        read_any(path)


def test_an_empty_folder_and_a_file_without_ending(tmp_path):
    for path in (tmp_path / "empty", tmp_path / "file"):
        path.mkdir() if path.name == "empty" else path.write_text("x")
        with pytest.raises(CaptureError, match="expected one of"):
            detect(path)


def test_cameras_and_plates_that_must_not_be_read_are_left_out_until_they_can(tmp_path):
    # The superuser may read everything, but not without these rights.
    bound = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]
    bound = bound if os.geteuid() == 0 else []
    if bound and not shutil.which("setpriv"):
        pytest.skip("the superuser may read everything")
    for name in ("S001", "S002", "none"):
        make_capture(tmp_path / name, subject=name, video=name == "S002", calibration=False)
    for camera in (tmp_path / "S001" / "cameras").iterdir():  # another layout
        shutil.copytree(camera / "frames", tmp_path / "rig" / camera.name)
    places = ["S001/cameras/cam01", "S002/cameras/cam01/video.mp4", "rig/cam01"]
    modes = [0o000, 0o000, 0o644]
    shut = {tmp_path / place: mode for place, mode in zip(places, modes, strict=True)}
    shut |= dict.fromkeys((tmp_path / "none/cameras").iterdir(), 0o000)
    plates = ["S001/plates", "S002/plates/cam00.png"]
    shut |= dict.fromkeys((tmp_path / plate for plate in plates), 0o000)

    def ingest(*captures):
        words = [sys.executable, "-m", "express50", "ingest", "data", *captures, "--workers", "0"]
        done = subprocess.run([*bound, *words], cwd=tmp_path, capture_output=True, text=True)
        return done.stdout

    for path, mode in shut.items():
        path.chmod(mode)
    try:
        said = ingest("S001", "S002", "rig", "none")
        for place in places:
            assert f"{tmp_path / place}: cannot be read (Permission denied); check its own" in said
        assert said.count("dropped camera cam01") == 3
        for plate in plates:
            warned = f"warning {plate.replace('/', ': ', 1)}: cannot be read (Permission denied)"
            assert warned in said
        assert "none: no usable camera: camera cam00" in said
        assert "3 done + 0 skipped + 1 failed" in said
        assert "0 done + 3 skipped + 1 failed" in ingest()
    finally:
        for path in shut:
            path.chmod(0o755)
    said = ingest()
    assert "4 done + 0 skipped + 0 failed" in said
    assert "dropped" not in said and "plates" not in said
    for place in ("ledger.sqlite", "ingest/S001"):  # neither damaged nor gone
        (tmp_path / "data" / place).chmod(0o000)
        words = [*bound, sys.executable, "-m", "express50", "calibrate", "data", "--workers", "0"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        (tmp_path / "data" / place).chmod(0o755)
        assert "Permission denied" in done.stderr and "check its owner" in done.stderr


def test_a_cameras_folder_among_those_of_an_expression_is_dropped_alone(tmp_path, monkeypatch):
    path = layouts.write_multiface(tmp_path)
    shut = next(path.glob("images/*/400004"))
    access = os.access
    monkeypatch.setattr(os, "access", lambda place, mode: place != shut and access(place, mode))
    raw = read_any(path)
    assert raw.dropped == {"400004": f"{shut}: cannot be read (Permission denied); check its owner"
                           " and permissions"}  # fmt: skip
    assert len(raw.cameras) == 2
