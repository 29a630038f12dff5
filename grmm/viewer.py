"""``grmm view`` shows a head in the browser, with sliders for its parameters and codes.

One thread draws the newest camera and sliders, so that a slow machine shows fewer pictures, but no
old ones. Pictures leave the machine through this port only: the library's sharing service is off.
The library's page asks Google's tag manager to count visitors if the browser is online.
"""

from __future__ import annotations

import io
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import partial
from http import HTTPStatus
from typing import Any

import numpy as np
import torch
import viser
import websockets.asyncio.server
from torch import Tensor
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from express50.console import stdout_to_stderr
from express50.geometry.transforms import invert_transform, make_transform, quat_to_matrix
from express50.local_server import RequestGuard, check_address
from grmm.checkpoint import Checkpoint
from grmm.edit import POSES, HeadCodes, between, controlled, principal_directions, trained_head
from grmm.head_crop import draw_window, without_neck_end
from grmm.model import Maps, PinholeView
from grmm.render import frontal, strongest_coefficients, to_uint8

REST_SECONDS = 0.35  # without a change, before the still picture is drawn
COEFFICIENTS, DIRECTIONS = 10, 4  # sliders of each kind
QUALITY = {True: 80, False: 95}  # JPEG, while moving and at rest
SAME = "the same"  # residual code as the expression's
SLOW_SECONDS = 0.04  # slower colours are not decoded while the camera moves
TURN_DEGREES = 1.5  # smaller camera turns change the colours invisibly
STOP_SECONDS = 5.0  # to wait for the server's thread, which a busy browser may hold up


class Preview:
    """Draws one head again and again, and decodes only what changed since the last picture.

    While things move, refinement is off, and colours that take longer than a frame may lag. At rest
    a picture is exactly that of ``grmm render``. State: what was decoded last.
    """

    def __init__(self, loaded: Checkpoint) -> None:
        """Draw heads of this checkpoint."""
        self.loaded = loaded
        self._head: HeadCodes | None = None
        self._maps: Maps | None = None
        self._colours: Tensor | None = None
        self._direction: Tensor  # of the camera that the colours are for
        self._colour_seconds = 0.0

    @torch.no_grad()
    def draw(self, head: HeadCodes, view: PinholeView, moving: bool) -> np.ndarray:
        """Draw (H, W, 3) uint8; ``moving`` trades the refinement for speed."""
        model = self.loaded.model
        if head is not self._head:
            self._decode(head)
        stale = self._colours is None
        if not stale:  # colours are reused until the camera has turned too far
            cosine = float((self._direction * view.direction()).sum())
            turned = cosine < math.cos(math.radians(TURN_DEGREES))
            quick = self._colour_seconds < SLOW_SECONDS
            stale = turned and quick if moving else cosine < 1 - 1e-9
        if stale:
            began = time.perf_counter()
            self._colours = model.appearance(head.z_id, self._state, view)
            self._colour_seconds = time.perf_counter() - began
            self._direction = view.direction()
        behind = self.loaded.config.data.background
        out = draw_window(model, self._gaussians, self._colours, view, behind, refine=not moving)
        return to_uint8(out.image)

    def _decode(self, head: HeadCodes) -> None:
        """Decode what differs from the last head: colours by person, maps by both codes."""
        model, last = self.loaded.model, self._head
        self._state = head.state(self.loaded)
        # Without residual codes the decoders see head-model parameters: all may have changed.
        same_person = same_codes = False
        if last is not None and self.loaded.config.model.residual_codes:
            same_person = torch.equal(head.z_id, last.z_id)
            same_codes = same_person and torch.equal(head.z_exp, last.z_exp)
        if not same_person:
            self._colours = None
        if not same_codes:
            known = self._maps.opacities if same_person and self._maps is not None else None
            self._maps = model.decode(head.z_id, head.z_exp, self._state, known)
        gaussians = model.geometry(head.z_id, head.z_exp, self._state, self._maps)
        self._gaussians = without_neck_end(self.loaded.head, self._state.vertices, gaussians)
        self._head = head


@dataclass(kw_only=True)
class Watcher:
    """One browser: the camera it last asked for, and what it was shown."""

    client: Any
    changed: float
    drawn: float = 0.0
    still: bool = False


class _Server(viser.ViserServer):
    """The library's server, behind a `RequestGuard` and without its tunnel to a public server."""

    def __init__(self, guard: RequestGuard, **options: Any) -> None:
        """Start to listen; the library has no setting for what a request must hold."""
        listen, others = websockets.asyncio.server.serve, set(threading.enumerate())
        websockets.asyncio.server.serve = partial(_serve_behind, guard, listen)
        try:
            super().__init__(host=guard.host, **options)
        finally:
            websockets.asyncio.server.serve = listen
        self._own_threads = [t for t in threading.enumerate() if t.daemon and t not in others]

    def stop(self) -> None:
        """Stop, and wait until the library's thread, which prints at its end, has ended."""
        super().stop()
        for thread in self._own_threads:
            thread.join(STOP_SECONDS)

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing: hiding the button instead leaves the whole page blank (viser 0.2.23)."""


@contextmanager
def _silenced() -> Iterator[None]:
    """Drop what the library prints."""
    with stdout_to_stderr(), redirect_stdout(io.StringIO()):
        yield


def _serve_behind(
    guard: RequestGuard,
    listen: Callable[..., Any],
    *args: Any,
    process_request: Any,
    **options: Any,
) -> Any:  # noqa: ANN401
    """Listen as websockets' ``serve`` does, for pages and sockets that `RequestGuard` lets in."""

    def check(connection: ServerConnection, request: Request) -> Response | None:
        refusal = guard.refusal(request.headers.get("Host"), request.headers.get("Origin"))
        if refusal is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, refusal)
        socket = request.headers.get("Upgrade") == "websocket"  # asked for without the last slash
        path = guard.path_after_token(request.path + "/" * socket)
        if path is None or path.startswith("/") or ".." in path.split("/"):
            return connection.respond(HTTPStatus.NOT_FOUND, "no such page\n")
        request.path = f"/{path}"
        return process_request(connection, request)

    return listen(*args, process_request=check, **options)


class Viewer:
    """The server, the browsers that watch, and the head that the controls describe."""

    def __init__(self, loaded: Checkpoint, host: str, port: int, moving: int, still: int) -> None:
        """Start to listen; heights in pixels while things move and once they rest."""
        # The library would wait for an address, and take another port, without a word.
        check_address(host, port)
        self.loaded, self.heights = loaded, {True: moving, False: still}
        self.preview = Preview(loaded)
        self._stop, self._wake = threading.Event(), threading.Event()
        self._watchers: dict[int, Watcher] = {}
        self._head_changed = time.perf_counter()
        guard = RequestGuard(host)
        with _silenced():  # it prints an address without the token
            self.server = _Server(guard, port=port, label="GRMM", verbose=False)
        self.address = guard.address(int(self.server.get_port()))
        self.server.gui.configure_theme(dark_mode=True, show_logo=False)
        self.server.scene.set_up_direction("+y")
        self._add_controls()
        self.head = self._described()
        self.server.on_client_connect(self._join)
        self.server.on_client_disconnect(self._leave)

    def run(self) -> None:
        """Draw until `stop` (or Ctrl-C)."""
        try:
            with suppress(KeyboardInterrupt):
                while not self._stop.is_set():
                    if not self._draw_due():
                        self._wake.wait(REST_SECONDS / 2)
                        self._wake.clear()
        finally:
            with _silenced():
                self.server.stop()

    def stop(self) -> None:
        """Let `run` return."""
        self._stop.set()
        self._wake.set()

    def _draw_due(self) -> bool:
        """Draw for every browser that waits for a picture; False if none does."""
        head_changed, busy = self._head_changed, False
        watchers = list(self._watchers.values())
        if any(watcher.drawn < head_changed for watcher in watchers):
            self.head = self._described()
        for watcher in watchers:
            newest = max(watcher.changed, head_changed)
            resting = time.perf_counter() - newest > REST_SECONDS
            if watcher.drawn < newest or (resting and not watcher.still):
                moving = not resting
                began = time.perf_counter()
                device = self.loaded.model.z_id.device
                view = view_of_camera(watcher.client.camera, self.heights[moving], device)
                picture = self.preview.draw(self.head, view, moving)
                watcher.client.scene.set_background_image(
                    picture, format="jpeg", jpeg_quality=QUALITY[moving]
                )
                watcher.drawn, watcher.still = began, not moving
                if moving:
                    rate = 1 / (time.perf_counter() - began)
                    self._status.content = f"{rate:.0f} frames per second"
                busy = True
        return busy

    def _join(self, client: viser.ClientHandle) -> None:
        watcher = Watcher(client=client, changed=time.perf_counter())
        self._watchers[client.client_id] = watcher
        view = frontal(self.loaded)
        head_from_cam = invert_transform(view.cam_from_head.cpu().numpy())
        client.camera.up_direction = (0.0, 1.0, 0.0)
        client.camera.position = tuple(head_from_cam[:3, 3])
        client.camera.look_at = tuple(self.loaded.model.head_centre.cpu().numpy())
        client.camera.fov = 2 * np.arctan(view.height / 2 / float(view.K[1, 1]))

        def camera_moved(camera: Any) -> None:
            watcher.changed = time.perf_counter()
            self._wake.set()

        client.camera.on_update(camera_moved)
        self._wake.set()

    def _leave(self, client: viser.ClientHandle) -> None:
        self._watchers.pop(client.client_id, None)

    def _head_moved(self, event: object = None) -> None:
        self._head_changed = time.perf_counter()
        self._wake.set()

    def _add_controls(self) -> None:
        gui, model = self.server.gui, self.loaded.model
        self._status = gui.add_markdown("")
        self._sliders: list[tuple[Any, float, tuple[str, ...]]] = []
        with gui.add_folder("who and what"):
            self._subject = self._choice("subject", model.subjects)
            self._expression = self._choice("expression of", model.expressions)
            self._code = self._choice("residual code of", (SAME, *model.expressions))
            self._goal = self._choice("blend towards", model.subjects)
            self._blend = self._slider("blend", (0.0, 1.0), 0.0)
        with gui.add_folder("pose"):
            for name, (controls, reach) in POSES.items():
                self._slider(name, reach, 0.0, *controls)
        with gui.add_folder("expression coefficients, added", expand_by_default=False):
            for number, largest in strongest_coefficients(self.loaded, COEFFICIENTS).items():
                name, size = self.loaded.head.expression_names[number], max(1.0, 1.5 * largest)
                self._slider(f"expression {name}", (-size, size), 0.0, f"expression.{number}")
        with gui.add_folder("residual codes"):
            for code in ("z_id", "z_exp"):
                self._slider(f"{code} scale", (0.0, 2.0), 1.0, code)
                known = len(principal_directions(getattr(model, code)))
                for number in range(min(DIRECTIONS, known)):
                    self._slider(f"{code} {number}", (-3.0, 3.0), 0.0, f"{code}.{number}")

        def reset(event: object) -> None:
            for slider, rest, _ in self._sliders:
                slider.value = rest
            self._head_moved()

        gui.add_button("reset").on_click(reset)

    def _slider(self, name: str, reach: tuple[float, float], rest: float, *controls: str) -> Any:
        """Add a slider for these controls; at ``rest`` it changes nothing."""
        low, high = reach
        slider = self.server.gui.add_slider(
            name, min=low, max=high, step=(high - low) / 200, initial_value=rest
        )
        slider.on_update(self._head_moved)
        self._sliders.append((slider, rest, controls))
        return slider

    def _choice(self, name: str, options: Sequence[str]) -> Any:
        first = "neutral" if "neutral" in options and options[0] != SAME else options[0]
        choice = self.server.gui.add_dropdown(name, options=list(options), initial_value=first)
        choice.on_update(self._head_moved)
        return choice

    def _described(self) -> HeadCodes:
        """Return the head that the controls describe."""
        head = trained_head(self.loaded, self._subject.value, self._expression.value)
        if self._blend.value:
            goal = trained_head(self.loaded, self._goal.value, self._expression.value)
            head = between(head, goal, float(self._blend.value))
        if self._code.value != SAME:
            donor = trained_head(self.loaded, self._subject.value, self._code.value)
            head = replace(head, z_exp=donor.z_exp)
        changes = {}
        for slider, rest, controls in self._sliders:
            for control in controls if slider.value != rest else ():
                changes[control] = (float(slider.value) + own_value(head, control),)
        return controlled(self.loaded, head, changes)


def own_value(head: HeadCodes, control: str) -> float:
    """Return what a head-model parameter is before a slider adds to it; 0 for codes."""
    table, _, entry = control.partition(".")
    values = getattr(head.tracked, table, ())
    return float(values[int(entry)]) if entry and int(entry) < len(values) else 0.0


def view_of_camera(camera: Any, height: int, device: torch.device) -> PinholeView:
    """Convert a browser's camera (OpenCV axes) to a view of this height, at most 2 : 1 wide."""
    width = max(1, round(height * min(2.0, max(0.5, float(camera.aspect)))))
    focal = height / 2 / np.tan(float(camera.fov) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).double()
    head_from_cam = make_transform(quat_to_matrix(camera.wxyz), camera.position)
    pose = torch.from_numpy(invert_transform(head_from_cam)).to(device)
    return PinholeView(K=K.to(device), cam_from_head=pose, width=width, height=height)
