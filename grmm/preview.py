"""Pictures at the speed of a hand: what did not change since the last picture is not made again.

A head's maps are decoded when its codes change, its mesh is posed when its parameters change, its
colours are decoded when the camera has turned. While things move, refinement is off, and colours
that take longer than a frame may take are those of a little earlier; a picture of a head at rest
is exactly that of ``grmm render``.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from torch import Tensor

from grmm.checkpoint import Loaded
from grmm.edit import Head
from grmm.render import drawn, to_uint8
from grmm.scene import Gaussians, HeadState, Maps, View

SLOW_SECONDS = 0.04  # colours that take longer are not decoded while the camera moves
TURN_DEGREES = 1.5  # under this the eye sees no other colours


class Preview:
    """One head of a checkpoint, drawn again and again.

    State: the geometry and colours decoded last, and how long colours took.
    """

    def __init__(self, loaded: Loaded) -> None:
        """Draw heads of this checkpoint."""
        self.loaded = loaded
        self._head: Head | None = None
        self._state: HeadState | None = None
        self._maps: Maps | None = None
        self._gaussians: Gaussians | None = None
        self._colours: Tensor | None = None
        self._direction: Tensor | None = None
        self._colour_seconds = 0.0

    @torch.no_grad()
    def draw(self, head: Head, view: View, moving: bool) -> np.ndarray:
        """(H, W, 3) uint8; ``moving`` trades the refinement for speed."""
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

    def _take(self, head: Head) -> None:
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

    def _needs_colours(self, view: View, moving: bool) -> bool:
        if self._colours is None or self._direction is None:
            return True
        cosine = float((self._direction * view.direction()).sum())
        if not moving:
            return cosine < 1 - 1e-9
        turned = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
        return turned > TURN_DEGREES and self._colour_seconds < SLOW_SECONDS
