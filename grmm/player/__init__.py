"""Export an avatar as one HTML page that plays it offline in any browser, without a GPU.

docs/FORMAT.md says how the page stores it.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import struct
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from express50.dataset.tracks import RIG_RATE, Sequence
from express50.files.atomic import write_bytes
from express50.geometry.sampling import evenly
from grmm.checkpoint import Checkpoint
from grmm.data import HeadViews
from grmm.edit import POSES, HeadCodes
from grmm.evaluate import SEEN, kind_of
from grmm.metrics import psnr_db
from grmm.player.distillation import (
    ANGLES,
    Avatar,
    Person,
    distil,
    drawn,
    front_view,
    full_rendering,
    person_of,
    sampled_poses,
    sampled_views,
    seen_angles,
    with_neck_cut,
)
from grmm.render import check_clips

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
PICTURES, FOOTAGE = 12, 24  # that agreement and loss are measured on


@dataclass(frozen=True, kw_only=True)
class PlayerReport:
    """What an exported page is like."""

    gaussians: int  # drawn
    megabytes: float  # of the page
    agreement_db: float  # PSNR between its pictures and the full model's, in poses not fitted to
    full_db: float | None = None  # PSNR of the full model's pictures against footage
    loss_db: float | None = None  # how much lower the page's PSNR is
    footage: str | None = None  # ``held out``, or ``seen`` where training saw all; or why none
    images: int = 0  # how many

    def __str__(self) -> str:
        loss = f"loss against footage n/a: {self.footage or 'give --shards'}"
        if self.full_db is not None and self.loss_db is not None:
            loss = (
                f"{self.full_db - self.loss_db:.2f} dB against {self.images} pictures of footage"
                f" ({self.footage}), the full model {self.full_db:.2f} dB"
            )
        return (
            f"{self.gaussians} Gaussians, {self.megabytes:.1f} MB; {self.agreement_db:.1f} dB from "
            f"the full model's pictures; {loss}"
        )


def export_player(
    path: Path,
    loaded: Checkpoint,
    head: HeadCodes,
    subject: str,
    views: HeadViews | None = None,
    clips: Sequence | None = None,
) -> PlayerReport:
    """Write the page; the loss is measured on footage of the subject in ``views``, if given.

    Loss and agreement include the end of the neck, which the page leaves out.

    Raises:
        ConfigError: the clips were tracked with another head model.
    """
    person, frames = person_of(loaded, head, subject), None
    if clips is not None:
        check_clips(loaded, clips)
        gap = len(person.own) - ANGLES - clips.expression.shape[1]
        coefficients = np.pad(clips.expression, ((0, 0), (0, gap)))
        frames = np.concatenate([coefficients, clips.neck, clips.jaw, clips.eyes], 1)
    rate = RIG_RATE if clips is None else clips.rate
    avatar = distil(person)
    content, page = player_page(person, with_neck_cut(person, avatar), subject, frames, rate)
    write_bytes(path, content)
    shown, _, _ = stored(avatar)
    report = PlayerReport(
        gaussians=len(page.opacities),
        megabytes=len(content) / 1e6,
        agreement_db=_agreement(person, shown),
    )
    if views is None:
        return report
    return PlayerReport(**asdict(report) | _loss(person, shown, subject, views))


@torch.no_grad()
def _agreement(person: Person, avatar: Avatar) -> float:
    """Compare pictures of the page's arrays with the full model's; return the mean PSNR."""
    generator = torch.Generator().manual_seed(1)
    poses = sampled_poses(person, PICTURES, generator)
    rows = []
    for pose, view in zip(poses, sampled_views(person.loaded, PICTURES, generator), strict=True):
        ours = drawn(avatar, pose, view, person.loaded.config.data.background)
        full = full_rendering(person, pose, view).image
        rows.append(psnr_db(ours.colors.permute(2, 0, 1), full))
    return float(np.mean(rows))


@torch.no_grad()
def _loss(person: Person, avatar: Avatar, subject: str, views: HeadViews) -> dict[str, object]:
    """Compare both with footage that training did not see, or with all if it saw all.

    The torso hides what it hides in `evaluate`.
    """
    loaded, keys = person.loaded, views.keys
    own = [
        i for i, key in enumerate(keys)
        if key.subject == subject and key.expression in loaded.model.expressions
    ]  # fmt: skip
    unseen = [i for i in own if kind_of(loaded, keys[i]) != SEEN]
    chosen = evenly(unseen or own, FOOTAGE)
    full, ours = [], []
    for index in chosen:
        item = views.item(index)
        pose = person.pose(views.place(index).tracked, keys[index].expression)
        page = drawn(avatar, pose, item.view, views.background)
        colours = page.colors.permute(2, 0, 1)
        picture = item.fill_behind_torso(colours, page.depth, item.background)
        ours.append(psnr_db(picture, item.target, ~item.hidden))
        picture = item.hide_behind_torso(full_rendering(person, pose, item.view)).image
        full.append(psnr_db(picture, item.target, ~item.hidden))
    if not chosen:
        return {"footage": f"--shards has no picture of {subject}"}
    before, after = float(np.mean(full)), float(np.mean(ours))
    footage = "held out" if unseen else "seen"
    return {"full_db": before, "loss_db": before - after, "footage": footage, "images": len(chosen)}


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
    target = person.loaded.model.head_centre.double().cpu()
    centre = -camera[:3, :3].T @ camera[:3, 3]
    distance = float(camera[2, :3] @ (target - centre))
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
            "target": _rounded(target), "distance": distance, "focal": float(view.K[0, 0]),
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
    # In one pass, so that inserted text is not searched again.
    return re.sub(r"{{(\w+)}}", lambda found: parts[found[1]], page).encode(), back


def _rounded(values: Tensor) -> list:
    return np.round(values.double().cpu().numpy(), 6).tolist()
