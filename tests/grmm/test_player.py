"""The browser player: what is distilled is the full model's, and the page draws just that."""

import base64
import html
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.player import CHROMIUM, chromium
from express50.contract.segmentation_labels import TORSO
from express50.dataset.tracks import Sequence
from express50.errors import ConfigError
from grmm.checkpoint import load_checkpoint
from grmm.edit import trained_head
from grmm.evaluate import evaluate, mean, training_render
from grmm.metrics import psnr_db
from grmm.model import GRMM
from grmm.player import HERE, _loss, export_player, player_page, stored
from grmm.player.distillation import (
    AvatarPose,
    all_gaussians,
    distil,
    drawn,
    front_view,
    full_rendering,
    person_of,
    posed,
    sampled_poses,
    sampled_views,
    seen_angles,
    with_neck_cut,
)
from grmm.render import orbit
from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture(scope="module", params=["tangent", "head"])
def loaded(request, tmp_path_factory):
    """A model whose decoders do something, on a head whose lower half is its jaw."""
    out, config = tmp_path_factory.mktemp("run"), tiny_config(model={"frame": request.param})
    train(EllipsoidSource(size=32), ellipsoid_head(), out, config)
    result = load_checkpoint(out / "checkpoint.pt")
    head = result.head
    low = (head.template[:, 1] < 0).float()
    head.skinning[:, 0], head.skinning[:, 2] = 1 - low, low
    generator = torch.Generator().manual_seed(0)
    model: GRMM = result.model
    with torch.no_grad():
        for parameter in (model.z_id, model.z_exp, model.colour.bias[:3]):
            parameter += 0.5 * torch.randn(parameter.shape, generator=generator)
        for layer in (model.transform.last.weight, model.mesh.expression[-1].weight):
            layer += 0.02 * torch.randn(layer.shape, generator=generator)
        model.opacity.bias += 2.0
    return result


@pytest.fixture(scope="module")
def person(loaded):
    return person_of(loaded, trained_head(loaded, "S000", "e0"), "S000")


@pytest.fixture(scope="module")
def avatar(person):
    return distil(person)


@pytest.fixture(scope="module")
def whole(person):
    return all_gaussians(person)


@torch.no_grad()
def full_means(person, pose):
    head = person.at(pose)
    state = head.state(person.loaded)
    return person.loaded.model.geometry(head.z_id, head.z_exp, state).means


def test_the_head_itself_and_training_expressions_are_almost_exact(person, whole):
    still = AvatarPose(parameters=person.own, weights=torch.zeros(1))
    shown = AvatarPose(parameters=person.own + person.changes[0], weights=torch.ones(1))
    for pose, most in ((still, 2e-6), (shown, 3e-4)):
        ours, _, _ = posed(whole, pose)
        assert float((ours - full_means(person, pose)).norm(dim=1).max()) < most


def test_unseen_poses_follow_the_decoders(person, whole):
    still = AvatarPose(parameters=person.own, weights=torch.zeros(1))
    errors, changes = [], []
    for pose in sampled_poses(person, 5, torch.Generator().manual_seed(7)):
        truth = full_means(person, pose)
        errors.append(float((posed(whole, pose)[0] - truth).norm(dim=1).mean()))
        changes.append(float((full_means(person, still) - truth).norm(dim=1).mean()))
    assert np.mean(errors) < 0.1 * np.mean(changes)


def test_views_are_sampled_on_the_side_that_cameras_saw(loaded):
    front, centre = front_view(loaded, 32), loaded.model.head_centre
    cameras = {str(turn): orbit(front, turn, centre) for turn in (0, -40, -70)}  # to the left, +x
    one_sided = replace(loaded, gallery=replace(loaded.gallery, cameras=cameras))
    (low, high), _ = seen_angles(one_sided)
    assert low > -20 and high > 60
    views = sampled_views(one_sided, 40, torch.Generator().manual_seed(0))
    x, _, z = torch.stack([view.direction() for view in views]).unbind(1)
    yaw = torch.rad2deg(torch.atan2(x, z))
    assert yaw.min() > low - 5 and high - 20 < yaw.max() < high + 5


def test_stored_arrays_lose_next_to_nothing(person, avatar):
    view = front_view(person.loaded, 96)
    back, _, _ = stored(avatar)
    for pose in sampled_poses(person, 2, torch.Generator().manual_seed(3)):
        ours, exact = (drawn(one, pose, view).colors.permute(2, 0, 1) for one in (back, avatar))
        assert psnr_db(ours.detach(), exact.detach()) > 45
        assert psnr_db(ours.detach(), full_rendering(person, pose, view).image.detach()) > 25


def test_the_page_leaves_the_end_of_the_neck_out(person, avatar):
    head = person.loaded.head
    heights = head.template[:, 1]
    ring = (1e4 * heights).round().unique()[1]  # the one above the pole
    boundary = (1e4 * heights).round() == ring
    with_end = replace(head, regions=head.regions | {"boundary": boundary})
    cut = with_neck_cut(replace(person, loaded=replace(person.loaded, head=with_end)), avatar)
    still = AvatarPose(parameters=person.own, weights=torch.zeros(1))
    assert 0 < len(cut.opacities) < len(avatar.opacities)
    end = float(heights[boundary].mean())
    assert posed(avatar, still)[0][:, 1].min() < end + 0.01 < posed(cut, still)[0][:, 1].min()
    assert len(with_neck_cut(person, avatar).opacities) == len(avatar.opacities)


def test_the_page_is_closed_and_names_are_escaped(person, avatar):
    name = "</title><script>alert(1)</script>"
    page = player_page(person, avatar, name, None, 24.0)[0].decode()
    assert "<script>alert" not in page and html.escape(name) in page
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)[1]
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy
    assert not re.search(r'https?://|src="(?!data:)|href=', page)


class BehindShirts(EllipsoidSource):
    """Samples in which a shirt close to the camera hides the lower half."""

    def read(self, index):
        sample = super().read(index)
        shirt = np.arange(self.size)[:, None] >= self.size // 2
        shirt = np.broadcast_to(shirt, sample.alpha.shape)
        depth = np.where(shirt, 0.1, sample.depth).astype(np.float32)
        return replace(sample, parts=np.where(shirt, TORSO, 0).astype(np.uint8), depth=depth)


def test_the_report_measures_footage_and_foreign_clips_are_refused(loaded, tmp_path):
    head = trained_head(loaded, "S000", "e0")
    views = loaded.views(BehindShirts(size=32))
    report = export_player(tmp_path / "a.html", loaded, head, "S000", views)
    assert report.images == 6 and report.footage == "seen" and report.loss_db < 3
    own = [index for index, key in enumerate(views.keys) if key.subject == "S000"]
    rows = evaluate(views, own, training_render(loaded.model, views))
    assert report.full_db == pytest.approx(mean(rows, "psnr_db"), abs=0.01)
    page = report.full_db - report.loss_db
    assert f" {page:.2f} dB against {report.images} pictures of footage" in str(report)
    assert str(report).endswith(f"the full model {report.full_db:.2f} dB")
    assert "give --shards" in str(replace(report, loss_db=None, footage=None))
    nothing = _loss(person_of(loaded, head, "S000"), None, "S009", views)
    assert "n/a: --shards has no picture of S009" in str(replace(report, loss_db=None, **nothing))
    with pytest.raises(ConfigError, match="track them"):
        export_player(tmp_path / "a.html", loaded, head, "S000", None, clip_of("other"))


def clip_of(head, frames=3):
    zeros = np.zeros((frames, 3))
    return Sequence(
        head=head, cues=("a",) * frames, frames=np.arange(frames), rate=24.0, shape=np.zeros(3),
        expression=np.zeros((frames, 4)), neck=zeros, jaw=zeros + 0.2, eyes=np.zeros((frames, 6)),
        R=np.tile(np.eye(3), (frames, 1, 1)), t=zeros,
    )  # fmt: skip


@pytest.mark.skipif(not any(map(shutil.which, CHROMIUM)), reason="chromium is not installed")
def test_a_browser_draws_what_the_rasteriser_draws(loaded, person, avatar, tmp_path):
    """Sliders, expression codes, camera and clip, against torch's picture of the same arrays."""
    path = tmp_path / "player.html"
    content, back = player_page(person, avatar, "S000", clip_frames(loaded), 24.0)
    path.write_bytes(content)
    view = front_view(loaded, 128)
    jaw = person.own.clone()
    jaw[4 + 3] += 0.3
    smile = person.own + person.changes[0]
    poses = {
        "0": AvatarPose(parameters=person.own, weights=torch.zeros(1)),
        "move('jaw open', 0.3)": AvatarPose(parameters=jaw, weights=torch.zeros(1)),
        "press('reset'); move('e1', 1)": AvatarPose(parameters=smile, weights=torch.ones(1)),
    }
    script = """var move = (name, value) => {
      const input = sliders.find(slider => slider.input.name === name).input;
      input.value = value; input.oninput(); };"""
    with chromium(f"file://{path}#size=128", 600, 500) as page:
        page.value(script)
        for change, pose in poses.items():
            page.value(change)
            page.wait("canvas.dataset.pictures > 0 && restless > 30 && idle.length > 0")
            page.wait("latest === asked")
            url = page.value("canvas.toDataURL('image/png')")
            bytes_ = io.BytesIO(base64.b64decode(url.split(",")[1]))
            shown = np.asarray(Image.open(bytes_).convert("RGBA")).astype(np.float32) / 255
            expected = drawn(back, pose, view)
            ours = torch.from_numpy(shown[..., :3] * shown[..., 3:]).permute(2, 0, 1)
            assert psnr_db(ours, expected.colors.detach().permute(2, 0, 1)) > 38, change
        before = page.value("Number(canvas.dataset.pictures)")
        page.value("press('play')")
        page.wait(f"canvas.dataset.pictures > {before + 3}")
        assert json.loads(page.value("JSON.stringify(clip.frames[0])"))[7] == 0.2
        assert page.value("find('error').hidden")


DRAW = """
const [page, splats, pose, out] = process.argv.slice(1), fs = require("fs");
const text = fs.readFileSync(page, "utf8").match(/id="avatar">([^<]*)</)[1];
const raw = require("zlib").inflateSync(Buffer.from(text, "base64"));
const Drawer = (0, eval)(`{${fs.readFileSync(splats, "utf8")}; Drawer}`);
const {parameters, codes, camera} = JSON.parse(pose), target = new Uint8ClampedArray(65536);
const drawer = new Drawer(raw.buffer.slice(raw.byteOffset, raw.byteOffset + raw.byteLength));
fs.writeFileSync(out, drawer.draw(Float32Array.from(parameters), codes, camera, target));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_script_draws_what_the_rasteriser_draws(person, avatar, tmp_path):
    """As in a browser. Pages of presets with the head's own axes turned every Gaussian."""
    content, back = player_page(person, avatar, "S000", None, 24.0)
    (tmp_path / "page.html").write_bytes(content)
    view = orbit(front_view(person.loaded, 128), 25, person.loaded.model.head_centre)
    pose = AvatarPose(parameters=person.own + person.changes[0], weights=torch.ones(1))
    given = {
        "parameters": pose.parameters.tolist(),
        "codes": back.codes[0].tolist(),
        "camera": {
            "rotation": view.cam_from_head[:3, :3].flatten().tolist(),
            "shift": view.cam_from_head[:3, 3].tolist(),
            "focal": float(view.K[0, 0]),
            "size": 128,
        },
    }
    files = [tmp_path / "page.html", HERE / "splats.js", json.dumps(given), tmp_path / "picture"]
    subprocess.run(["node", "-e", DRAW, *map(str, files)], check=True)
    raw = np.fromfile(tmp_path / "picture", np.uint8).reshape(128, 128, 4) / np.float32(255)
    ours = torch.from_numpy(raw[..., :3] * raw[..., 3:]).permute(2, 0, 1)
    assert psnr_db(ours, drawn(back, pose, view).colors.detach().permute(2, 0, 1)) > 38
    assert psnr_db(ours, full_rendering(person, pose, view).image.detach()) > 25


def clip_frames(loaded):
    clip = clip_of(loaded.head_spec)
    return np.concatenate([clip.expression, clip.neck, clip.jaw, clip.eyes], 1)
