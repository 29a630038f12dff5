import shutil
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from express50.errors import ConfigError
from grmm.checkpoint import load_checkpoint
from grmm.edit import controlled, trained_head
from grmm.render import frontal, orbit, picture
from grmm.train import train
from grmm.viewer import Preview, Viewer
from tests.grmm.browser import Browser
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    train(EllipsoidSource(size=32), ellipsoid_head(), out, tiny_config())
    result = load_checkpoint(out / "checkpoint.pt")
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # codes that show in pictures
        result.model.z_id += torch.randn(result.model.z_id.shape, generator=generator)
        result.model.colour.bias += 0.5
    return result


def test_a_head_at_rest_is_the_rendered_picture_whatever_came_before(loaded):
    preview, view = Preview(loaded), frontal(loaded)
    turned = orbit(view, 40, loaded.model.head_centre)
    a, b = trained_head(loaded, "S000", "e0"), trained_head(loaded, "S001", "e1")
    wide = controlled(loaded, a, {"expression.0": (2.0,)})
    for head, camera in ((a, view), (a, turned), (wide, turned), (b, turned), (a, view)):
        preview.draw(head, camera, moving=True)
        np.testing.assert_array_equal(
            preview.draw(head, camera, moving=False), picture(loaded, head, camera)
        )


def test_moving_pictures_decode_only_what_changed(loaded, monkeypatch):
    calls = []
    for name in ("decode", "appearance"):
        original = getattr(loaded.model, name)
        spy = lambda *a, name=name, original=original: calls.append(name) or original(*a)  # noqa: E731
        monkeypatch.setattr(loaded.model, name, spy)
    preview, view = Preview(loaded), frontal(loaded)
    head = trained_head(loaded, "S000", "e0")
    preview.draw(head, view, moving=True)
    assert calls == ["decode", "appearance"]
    preview.draw(controlled(loaded, head, {"jaw.0": (0.2,)}), view, moving=True)
    assert calls == ["decode", "appearance"]
    preview.draw(head, orbit(view, 0.5, loaded.model.head_centre), moving=True)
    assert calls == ["decode", "appearance"]
    preview.draw(head, orbit(view, 20, loaded.model.head_centre), moving=True)
    assert calls == ["decode", "appearance", "appearance"]
    preview.draw(trained_head(loaded, "S001", "e0"), view, moving=True)
    assert calls[3:] == ["decode", "appearance"]


def test_opacity_is_decoded_once_per_person(loaded, monkeypatch):
    """The saving: another expression of the same person has the same opacities, to the bit."""
    model, calls = loaded.model, []
    original = model.opacity.forward
    monkeypatch.setattr(model.opacity, "forward", lambda *a: calls.append(1) or original(*a))
    preview, view = Preview(loaded), frontal(loaded)
    preview.draw(trained_head(loaded, "S000", "e0"), view, moving=True)
    kept = preview.draw(trained_head(loaded, "S000", "e1"), view, moving=True)
    assert len(calls) == 1
    anew = Preview(loaded).draw(trained_head(loaded, "S000", "e1"), view, moving=True)
    assert len(calls) == 2 and np.array_equal(kept, anew)
    preview.draw(trained_head(loaded, "S001", "e1"), view, moving=True)
    assert len(calls) == 3


@contextmanager
def served(viewer):
    """A viewer that draws in a thread, and stops when it is told to."""
    thread = threading.Thread(target=viewer.run)
    thread.start()
    try:
        yield viewer
    finally:
        viewer.stop()
        thread.join(timeout=10)
    assert not thread.is_alive()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_slider_moved_in_a_browser_changes_the_picture(loaded, monkeypatch):
    monkeypatch.setattr("grmm.viewer.REST_SECONDS", 1.5)  # a busy machine answers late
    with served(Viewer(loaded, "127.0.0.1", free_port(), moving=48, still=64)) as viewer:
        browser = Browser(viewer.address)
        eye = np.array([0.0, 0.05, 0.7])
        browser.look(eye)
        assert browser.listen(1).shape == (48, 48, 3)
        first = browser.settle(64)
        assert first.max() > 60
        labels = set(browser.controls)
        assert {"jaw open", "neck turn", "expression e0", "z_id 0", "z_exp scale"} <= labels
        browser.move("expression e0", 1.4)
        assert np.abs(browser.settle(64) - first).max() > 20
        browser.look(np.array([0.7, 0.05, 0.0]))
        side = browser.settle(64)
        browser.move("subject", "S001")
        assert np.abs(browser.settle(64) - side).max() > 20
        browser.close()


def test_a_residual_code_stays_while_heads_are_blended(loaded):
    """At the end of the blend it was the expression's own again."""
    with served(Viewer(loaded, "127.0.0.1", free_port(), moving=48, still=64)) as viewer:
        viewer._goal.value, viewer._blend.value, viewer._code.value = "S001", 1.0, "e1"
        got, goal = viewer._described(), trained_head(loaded, "S001", "e0")
        assert torch.equal(got.z_id, goal.z_id)
        assert torch.equal(got.z_exp, trained_head(loaded, "S001", "e1").z_exp)


def test_a_browser_shows_the_controls(loaded, tmp_path):
    """Every answer over HTTP and the socket was right while the page itself stayed blank."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("chromium is not installed")
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}",
        "--timeout=8000", "--virtual-time-budget=8000", "--dump-dom",
    ]  # fmt: skip
    with served(Viewer(loaded, "127.0.0.1", free_port(), moving=32, still=32)) as viewer:
        command.append(viewer.address)
        for _ in range(3):  # a busy machine may not answer in the browser's time
            page = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
            if "jaw open" in page.stdout:
                break
    assert "jaw open" in page.stdout


def test_other_sites_and_other_users_do_not_get_in(loaded):
    with served(Viewer(loaded, "127.0.0.1", free_port(), moving=32, still=32)) as viewer:
        ours = viewer.address.replace("http://", "ws://").removesuffix("/")
        root = ours.rsplit("/", 1)[0]
        for address, origin, status in [
            (ours, "http://evil.example", 403),
            (root, None, 404),
            (root + "/guess", None, 404),
        ]:
            with pytest.raises(InvalidStatus) as caught:
                connect(address, origin=origin)
            assert caught.value.response.status_code == status
        for path in ("/etc/passwd", "../../../etc/passwd", "nothing.js"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(viewer.address + path, timeout=5)
        with urllib.request.urlopen(viewer.address, timeout=5) as page:
            assert b"Viser" in page.read()


def test_an_address_of_another_machine_is_one_error(loaded):
    with pytest.raises(ConfigError, match="expected an address of this machine"):
        Viewer(loaded, "192.0.2.1", 0, 64, 128)


def test_a_port_that_is_taken_is_one_error(loaded):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"127.0.0.1:{port}: .*; choose another port"):
            Viewer(loaded, "127.0.0.1", port, 64, 128)


def test_ctrl_c_stops_the_viewer_and_only_its_own_address_is_printed(loaded, monkeypatch, capfd):
    viewer = Viewer(loaded, "127.0.0.1", free_port(), 64, 128)

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "_draw_due", interrupted)
    viewer.run()
    assert capfd.readouterr() == ("", "")
