"""``grmm export --format html``: an avatar that plays in any browser, offline and without a GPU."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from express50.dataset.tracks import Sequence
from express50.files.atomic import write_bytes
from grmm.checkpoint import Loaded
from grmm.data import HeadViews, spread
from grmm.edit import HeadCodes
from grmm.evaluate import SEEN, kind_of
from grmm.metrics import psnr_db
from grmm.player.distillation import (
    Avatar,
    Person,
    distil,
    drawn,
    full_picture,
    person_of,
    sampled_poses,
    sampled_views,
)
from grmm.player.page import player_page
from grmm.render import VIDEO_RATE, check_clips

PICTURES, FOOTAGE = 12, 24  # that agreement and loss are measured on


@dataclass(frozen=True, kw_only=True)
class PlayerReport:
    """What an exported page is like.

    Attributes:
        gaussians: drawn.
        megabytes: of the page.
        agreement_db: PSNR between its pictures and the full model's, in poses not fitted to.
        full_db: PSNR of the full model's pictures against footage; None without footage.
        loss_db: how much less the page's is.
        footage: which samples: ``held out``, or ``seen`` where training saw all.
        images: how many.
    """

    gaussians: int
    megabytes: float
    agreement_db: float
    full_db: float | None = None
    loss_db: float | None = None
    footage: str | None = None
    images: int = 0

    def __str__(self) -> str:
        loss = "loss against footage n/a: give --shards"
        if self.loss_db is not None:
            loss = (
                f"{self.loss_db:.2f} dB lost of the {self.full_db:.2f} dB against {self.images} "
                f"pictures of footage ({self.footage})"
            )
        return (
            f"{self.gaussians} Gaussians, {self.megabytes:.1f} MB; {self.agreement_db:.1f} dB from "
            f"the full model's pictures; {loss}"
        )


def export_player(
    path: Path,
    loaded: Loaded,
    head: HeadCodes,
    subject: str,
    views: HeadViews | None = None,
    clips: Sequence | None = None,
) -> PlayerReport:
    """Write the page; footage of the subject in ``views``, if given, tells the loss.

    Raises:
        ConfigError: the clips were tracked with another head model.
    """
    person, frames = person_of(loaded, head, subject), None
    if clips is not None:
        check_clips(loaded, clips)
        gap = len(person.own) - 12 - clips.expression.shape[1]
        coefficients = np.pad(clips.expression, ((0, 0), (0, gap)))
        frames = np.concatenate([coefficients, clips.neck, clips.jaw, clips.eyes], 1)
    content, shown = player_page(person, distil(person), subject, frames, VIDEO_RATE)
    write_bytes(path, content)
    report = PlayerReport(
        gaussians=len(shown.opacities),
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
        rows.append(psnr_db(ours.colors.permute(2, 0, 1), full_picture(person, pose, view)))
    return float(np.mean(rows))


@torch.no_grad()
def _loss(person: Person, avatar: Avatar, subject: str, views: HeadViews) -> dict[str, object]:
    """Compare both with footage that training did not see, or with all if it saw all."""
    loaded, keys = person.loaded, views.keys
    own = [
        i for i, key in enumerate(keys)
        if key.subject == subject and key.expression in loaded.model.expressions
    ]  # fmt: skip
    unseen = [i for i in own if kind_of(loaded, keys[i]) != SEEN]
    chosen = spread(unseen or own, FOOTAGE)
    full, ours = [], []
    for index in chosen:
        item = views.item(index)
        pose = person.pose(views.sample(index).tracked, keys[index].expression)
        picture = drawn(avatar, pose, item.view, views.background).colors.permute(2, 0, 1)
        ours.append(psnr_db(picture, item.target))
        full.append(psnr_db(full_picture(person, pose, item.view), item.target))
    if not chosen:
        return {}
    before, after = float(np.mean(full)), float(np.mean(ours))
    footage = "held out" if unseen else "seen"
    return {"full_db": before, "loss_db": before - after, "footage": footage, "images": len(chosen)}
