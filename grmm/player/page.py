"""Write an avatar as one HTML page that plays it offline; docs/FORMAT.md says how it is stored."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from grmm.edit import POSES
from grmm.player.distillation import Avatar, Person, front_view, seen_angles

HERE = Path(__file__).parent
# How the arrays of an `Avatar` are stored. Whole numbers are multiples of the largest value of
# their row and channel over the kind's largest.
KINDS = {
    "rest": "int16", "shapes": "int8", "skinning": "int16", "joints": "float32",
    "corners": "uint32", "weights": "int16", "gradient": "int16", "maps": "int16",
    "blends": "int8", "opacities": "int16", "colours": "int8",
}  # fmt: skip
PARTS = {"style": "page.css", "script": "player.js", "splats": "splats.js"}
STARTS = {"neck": 0, "jaw": 3, "eyes": 6}  # of the angles that follow the coefficients
NOISE_M = 2e-5  # smaller displacements are zeros: they would only fill the file


def stored(avatar: Avatar) -> tuple[Avatar, dict, bytes]:
    """Quantise an avatar: what a player reads back, the header of its arrays, and their bytes."""
    unit = torch.nn.functional.normalize(avatar.gradient, dim=1)
    shapes = torch.where(avatar.shapes.abs() > NOISE_M, avatar.shapes, 0.0)
    used, corners = torch.unique(avatar.corners, return_inverse=True)
    arrays = {
        "rest": avatar.rest[used], "shapes": shapes[:, used], "skinning": avatar.skinning[used],
        "joints": avatar.joints, "corners": corners, "weights": avatar.weights[:, 1:],
        "gradient": unit, "maps": avatar.maps[0], "blends": avatar.maps[1:],
        "opacities": avatar.opacities[:, None], "colours": avatar.colours,
    }  # fmt: skip
    header, parts, read, offset = {}, [], {}, 0
    # Large items first: each array then starts at a multiple of its items' size.
    for name in sorted(arrays, key=lambda name: -np.dtype(KINDS[name]).itemsize):
        array, kind = arrays[name].cpu().numpy(), KINDS[name]
        entry: dict[str, object] = {"kind": kind, "shape": list(array.shape), "offset": offset}
        if kind.startswith("int"):
            largest = np.abs(array).max(-2, keepdims=True, initial=0.0)
            scales = (largest / np.iinfo(kind).max).astype(np.float32)
            whole = np.rint(np.divide(array, scales, where=scales > 0, out=np.zeros(array.shape)))
            entry["scales"] = scales.ravel().tolist()
            read[name] = torch.from_numpy((whole * scales).astype(np.float32))
            array = whole
        content = array.astype(kind).astype(np.dtype(kind).newbyteorder("<")).tobytes()
        header[name] = entry
        parts.append(content)
        offset += len(content)
    weights = read["weights"]
    back = replace(
        avatar,
        rest=read["rest"],
        shapes=read["shapes"],
        skinning=read["skinning"],
        corners=corners,
        weights=torch.cat([1 - weights.sum(1, keepdim=True), weights], 1),
        gradient=read["gradient"],
        maps=torch.cat([read["maps"][None], read["blends"]]),
        opacities=read["opacities"][:, 0],
        colours=read["colours"],
    )
    return back, header, b"".join(parts)


def player_page(
    person: Person, avatar: Avatar, title: str, clip: np.ndarray | None, rate: float
) -> tuple[bytes, Avatar]:
    """Return the page, and the avatar as the page holds it.

    ``clip`` (T, X + 12) are parameters laid out as `Avatar.own`; ``rate`` in frames per second.
    """
    back, arrays, content = stored(avatar)
    mesh, view = person.loaded.head, front_view(person.loaded, 1)
    camera = view.cam_from_head.double().cpu()
    centre = -camera[:3, :3].T @ camera[:3, 3]
    distance = float(camera[2, :3] @ (_target(person) - centre))
    yaw, pitch = (np.deg2rad(limits).tolist() for limits in seen_angles(person.loaded))
    header: dict[str, object] = {
        "arrays": arrays,
        "codes": avatar.codes.shape[1],
        "coefficients": list(mesh.expression_names),
        "range": [0, 1] if mesh.unit_expressions else [-2, 2],
        "expressions": list(person.expressions),
        "own": _rounded(avatar.own),
        "changes": _rounded(avatar.changes),
        "shares": _rounded(avatar.codes),
        "poses": [
            [name, [STARTS[c[:-2]] + int(c[-1]) for c in controls], reach]
            for name, (controls, reach) in POSES.items()
        ],
        "camera": {
            "target": _rounded(_target(person)), "distance": distance, "focal": float(view.K[0, 0]),
        },
        "limits": {"yaw": yaw, "pitch": pitch},
        "clip": None if clip is None else {"rate": rate, "frames": np.round(clip, 4).tolist()},
    }  # fmt: skip
    text = json.dumps(header).encode("ascii")
    text += b" " * (-(len(text) + 4) % 8)
    packed = zlib.compress(struct.pack("<I", len(text)) + text + content, 9)
    parts = {name: (HERE / file).read_text(encoding="utf-8") for name, file in PARTS.items()}
    parts |= {"title": html.escape(title), "avatar": base64.b64encode(packed).decode()}
    for name in ("script", "style"):
        digest = hashlib.sha256(parts[name].encode()).digest()
        parts[f"{name}_hash"] = base64.b64encode(digest).decode()
    page = (HERE / "page.html").read_text(encoding="utf-8")
    # In one pass: what is filled in is not looked at again.
    return re.sub(r"{{(\w+)}}", lambda found: parts[found[1]], page).encode(), back


def _target(person: Person) -> Tensor:
    """Return the point (3,) that the player's camera turns about."""
    template, centre = person.loaded.head.template, person.loaded.model.head_centre
    middle = (template[:, 1].amax() + template[:, 1].amin()) / 2
    return torch.stack([torch.zeros_like(middle), middle, centre[2]]).double().cpu()


def _rounded(values: Tensor) -> list:
    return np.round(values.double().cpu().numpy(), 6).tolist()
