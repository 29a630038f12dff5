"""``grmm view``: a head in the browser, with sliders for FLAME's parameters and the codes.

One thread draws. It always takes the newest camera and the newest sliders, so that a slow machine
shows fewer pictures, never old ones. Listens on 127.0.0.1 by default; pictures of people
leave the machine by no other way (the library's sharing service is off). The library's page asks
Google's tag manager to count its visitors, where the browser has a way there.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import viser
from torch import Tensor

from express50.console import stdout_to_stderr
from express50.geometry.transforms import quat_to_matrix
from grmm.checkpoint import Loaded
from grmm.edit import HeadCodes, between, controlled, principal_directions, trained_head
from grmm.render import drawn, frontal, strongest_coefficients, to_uint8
from grmm.scene import Gaussians, HeadState, Maps, PinholeView

REST_SECONDS = 0.35  # without a change, before the still picture is drawn
COEFFICIENTS, DIRECTIONS = 10, 4  # sliders of each kind
QUALITY = {True: 80, False: 95}  # JPEG, while moving and at rest
TURNS = {  # sliders of joints: control, entry, range in radians
    "jaw open": ("jaw", 0, (-0.1, 0.6)),
    "jaw sideways": ("jaw", 1, (-0.2, 0.2)),
    "neck nod": ("neck", 0, (-0.5, 0.5)),
    "neck turn": ("neck", 1, (-0.7, 0.7)),
    "neck tilt": ("neck", 2, (-0.4, 0.4)),
}
GAZE = {"gaze up, down": (0, (-0.4, 0.4)), "gaze sideways": (1, (-0.5, 0.5))}
SLOW_SECONDS = 0.04  # colours that take longer are not decoded while the camera moves
TURN_DEGREES = 1.5  # under this the eye sees no other colours


class Preview:
    """Draws one head again and again, and decodes only what changed since the last picture.

    Maps are decoded when codes change, the mesh is posed when parameters change, colours are
    decoded when the camera has turned. While things move, refinement is off, and colours that take
    longer than a frame may lag. At rest a picture is exactly that of ``grmm render``.

    State: the geometry and colours decoded last, and how long colours took.
    """

    def __init__(self, loaded: Loaded) -> None:
        """Draw heads of this checkpoint."""
        self.loaded = loaded
        self._head: HeadCodes | None = None
        self._state: HeadState | None = None
        self._maps: Maps | None = None
        self._gaussians: Gaussians | None = None
        self._colours: Tensor | None = None
        self._direction: Tensor | None = None
        self._colour_seconds = 0.0

    @torch.no_grad()
    def draw(self, head: HeadCodes, view: PinholeView, moving: bool) -> np.ndarray:
        """Draw (H, W, 3) uint8; ``moving`` trades the refinement for speed."""
        model = self.loaded.model
        if head is not self._head:
            self._take(head)
        if self._needs_colours(view, moving):
            began = time.perf_counter()
            assert self._state is not None
            self._colours = model.appearance(head.z_id, self._state, view)
            self._colour_seconds = time.perf_counter() - began
            self._direction = view.direction()
        assert self._gaussians is not None and self._colours is not None
        out = drawn(self.loaded, self._gaussians, self._colours, view, refine=not moving)
        return to_uint8(out.image)

    def _take(self, head: HeadCodes) -> None:
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
        self._gaussians = model.geometry(head.z_id, head.z_exp, self._state, self._maps)
        self._head = head

    def _needs_colours(self, view: PinholeView, moving: bool) -> bool:
        if self._colours is None or self._direction is None:
            return True
        cosine = float((self._direction * view.direction()).sum())
        if not moving:
            return cosine < 1 - 1e-9
        turned = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
        return turned > TURN_DEGREES and self._colour_seconds < SLOW_SECONDS


@dataclass(kw_only=True)
class Watcher:
    """One browser: the camera it last asked for, and what it was shown."""

    client: Any
    changed: float
    drawn: float = 0.0
    still: bool = False


class _Server(viser.ViserServer):
    """The library's server without its tunnel to a public one."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing: hiding the button instead leaves the whole page blank (viser 0.2.23)."""


class Viewer:
    """The server, its controls and the drawing thread's loop.

    State: browsers that watch, the head that the controls describe, and pictures a second.
    """

    def __init__(
        self, loaded: Loaded, host: str = "127.0.0.1", port: int = 8080, moving: int = 320,
        still: int = 512,
    ) -> None:  # fmt: skip
        """Start to listen; heights in pixels while things move and once they rest."""
        self.loaded, self.heights = loaded, {True: moving, False: still}
        self.preview = Preview(loaded)
        self._stop, self._wake = threading.Event(), threading.Event()
        self._watchers: dict[int, Watcher] = {}
        self._lock = threading.Lock()
        self._head_changed = time.perf_counter()
        self.frames_per_second = 0.0
        with stdout_to_stderr():
            self.server = _Server(host=host, port=port, label="GRMM", verbose=False)
        self.port = int(self.server.get_port())
        self.server.gui.configure_theme(dark_mode=True)
        self.server.scene.set_up_direction("+y")
        self._add_controls()
        self.head = self._described()
        self.server.on_client_connect(self._join)
        self.server.on_client_disconnect(self._leave)

    def run(self) -> None:
        """Draw until `stop` (or Ctrl-C)."""
        try:
            while not self._stop.is_set():
                if not self._draw_due():
                    self._wake.wait(REST_SECONDS / 2)
                    self._wake.clear()
        finally:
            with stdout_to_stderr():
                self.server.stop()

    def stop(self) -> None:
        """Let `run` return."""
        self._stop.set()
        self._wake.set()

    def _draw_due(self) -> bool:
        """Draw for every browser that waits for a picture; False if none does."""
        head_changed, busy = self._head_changed, False
        with self._lock:
            watchers = list(self._watchers.values())
        if any(watcher.drawn < head_changed for watcher in watchers):
            self.head = self._described()
        for watcher in watchers:
            newest = max(watcher.changed, head_changed)
            resting = time.perf_counter() - newest > REST_SECONDS
            if watcher.drawn >= newest and (watcher.still or not resting):
                continue
            self._show(watcher, moving=not resting)
            busy = True
        return busy

    def _show(self, watcher: Watcher, moving: bool) -> None:
        began = time.perf_counter()
        device = self.loaded.model.z_id.device
        view = view_of_camera(watcher.client.camera, self.heights[moving], device)
        picture = self.preview.draw(self.head, view, moving)
        watcher.client.scene.set_background_image(
            picture, format="jpeg", jpeg_quality=QUALITY[moving]
        )
        watcher.drawn, watcher.still = began, not moving
        if moving:
            self.frames_per_second = 1 / (time.perf_counter() - began)
            self._status.content = f"{self.frames_per_second:.0f} frames per second"

    def _join(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._watchers[client.client_id] = Watcher(client=client, changed=time.perf_counter())
        view = frontal(self.loaded)
        matrix = view.cam_from_head.cpu().numpy()
        client.camera.up_direction = (0.0, 1.0, 0.0)
        client.camera.position = tuple(-matrix[:3, :3].T @ matrix[:3, 3])
        client.camera.look_at = tuple(self.loaded.model.head_centre.cpu().numpy())
        client.camera.fov = 2 * np.arctan(view.height / 2 / float(view.K[1, 1]))
        client.camera.on_update(lambda camera: self._camera_moved(client.client_id))
        self._wake.set()

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._watchers.pop(client.client_id, None)

    def _camera_moved(self, client_id: int) -> None:
        with self._lock:
            if client_id in self._watchers:
                self._watchers[client_id].changed = time.perf_counter()
        self._wake.set()

    def _head_moved(self, event: object = None) -> None:
        self._head_changed = time.perf_counter()
        self._wake.set()

    def _add_controls(self) -> None:
        gui, model, frames = self.server.gui, self.loaded.model, self.loaded.gallery.frames.values()
        self._status = gui.add_markdown("")
        self._sliders: dict[str, Any] = {}
        with gui.add_folder("who and what"):
            self._subject = self._choice("subject", model.subjects)
            self._expression = self._choice("FLAME expression of", model.expressions)
            self._code = self._choice("residual code of", ("the same", *model.expressions))
            self._goal = self._choice("blend towards", model.subjects)
            self._slider("blend", (0.0, 1.0), 0.0)
        with gui.add_folder("FLAME"):
            for name, (_, _, reach) in TURNS.items():
                self._slider(name, reach, 0.0)
            for name, (_, reach) in GAZE.items():
                self._slider(name, reach, 0.0)
        with gui.add_folder("expression coefficients, added", expand_by_default=False):
            for number in strongest_coefficients(self.loaded, COEFFICIENTS):
                shown = [f.expression for f in frames if len(f.expression) > number]
                size = 1.5 * max(abs(expression[number]) for expression in shown)
                name = self.loaded.head.expression_names[number]
                self._slider(f"expression {name}", (-max(1.0, size), max(1.0, size)), 0.0)
        with gui.add_folder("residual codes"):
            for code in ("z_id", "z_exp"):
                self._slider(f"{code} scale", (0.0, 2.0), 1.0)
                for number in range(self._directions(code)):
                    self._slider(f"{code} {number}", (-3.0, 3.0), 0.0)
        gui.add_button("reset").on_click(self._reset)

    def _directions(self, code: str) -> int:
        return min(DIRECTIONS, len(principal_directions(getattr(self.loaded.model, code))))

    def _slider(self, name: str, reach: tuple[float, float], value: float) -> None:
        low, high = reach
        slider = self.server.gui.add_slider(
            name, min=low, max=high, step=(high - low) / 200, initial_value=value
        )
        slider.on_update(self._head_moved)
        self._sliders[name] = (slider, value)

    def _choice(self, name: str, options: Sequence[str]) -> Any:
        first = "neutral" if "neutral" in options and options[0] != "the same" else options[0]
        choice = self.server.gui.add_dropdown(name, options=list(options), initial_value=first)
        choice.on_update(self._head_moved)
        return choice

    def _reset(self, event: object = None) -> None:
        for slider, value in self._sliders.values():
            slider.value = value
        self._head_moved()

    def _value(self, name: str) -> float:
        return float(self._sliders[name][0].value)

    def _described(self) -> HeadCodes:
        """Return the head that the controls describe."""
        head = trained_head(self.loaded, self._subject.value, self._expression.value)
        if self._code.value != "the same":
            donor = trained_head(self.loaded, self._subject.value, self._code.value)
            head = replace(head, z_exp=donor.z_exp)
        if self._value("blend"):
            goal = trained_head(self.loaded, self._goal.value, self._expression.value)
            head = between(head, goal, self._value("blend"))
        return controlled(self.loaded, head, self._controls(head))

    def _controls(self, head: HeadCodes) -> dict[str, tuple[float, ...]]:
        """Return the sliders' changes to a head as controls; sliders at rest change nothing."""
        controls: dict[str, tuple[float, ...]] = {}
        for name, (joint, entry, _) in TURNS.items():
            if self._value(name):
                now = float(getattr(head.tracked, joint)[entry])
                controls[f"{joint}.{entry}"] = (now + self._value(name),)
        for name, (entry, _) in GAZE.items():
            for eye in (0, 3) if self._value(name) else ():
                now = float(head.tracked.eyes[eye + entry])
                controls[f"eyes.{eye + entry}"] = (now + self._value(name),)
        names = self.loaded.head.expression_names
        for label in (name for name in self._sliders if name.startswith("expression ")):
            number = names.index(label.removeprefix("expression "))
            if self._value(label):
                known = head.tracked.expression
                now = float(known[number]) if number < len(known) else 0.0
                controls[f"expression.{number}"] = (now + self._value(label),)
        for code in ("z_id", "z_exp"):
            if self._value(f"{code} scale") != 1.0:
                controls[code] = (self._value(f"{code} scale"),)
            for number in range(self._directions(code)):
                if self._value(f"{code} {number}"):
                    controls[f"{code}.{number}"] = (self._value(f"{code} {number}"),)
        return controls


def view_of_camera(camera: Any, height: int, device: torch.device | str = "cpu") -> PinholeView:
    """Convert a browser's camera (OpenCV axes) to a view of this height, at most 2 : 1 wide."""
    width = max(1, round(height * min(2.0, max(0.5, float(camera.aspect)))))
    focal = height / 2 / np.tan(float(camera.fov) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).double()
    cam_from_head = np.eye(4)
    cam_from_head[:3, :3] = quat_to_matrix(np.asarray(camera.wxyz, dtype=np.float64)).T
    cam_from_head[:3, 3] = -cam_from_head[:3, :3] @ np.asarray(camera.position)
    pose = torch.from_numpy(cam_from_head).to(device)
    return PinholeView(K=K.to(device), cam_from_head=pose, width=width, height=height)
