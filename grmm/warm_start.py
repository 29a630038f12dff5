"""Start training from a sensible head, with texel colours averaged from footage.

The paper trains from scratch for 250,000 iterations. With a small budget, thousands of them would
be spent on colours that projection gives at once (G17).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from express50.geometry.sampling import evenly
from grmm.anchors import tangent_frames
from grmm.data import HeadView, HeadViews
from grmm.model import GRMM, Gaussians

IMAGES_PER_SUBJECT = 96  # more hardly change the mean texture
FACING = 0.25  # cosine of normal and view below which a texel is seen too obliquely
OCCLUSION_M = 0.012  # a texel this far behind the rendered surface is hidden; hair is this thick
ALIKE_COLOUR, ALIKE_M = 0.08, 0.04  # differences up to which texels change alike
SAMPLES = 1024  # of seen texels, from which the changes of the others are predicted
LOGIT_LIMIT = 0.01  # colours are kept this far from 0 and 1 before the logit


@torch.no_grad()
def warm_start(model: GRMM, views: HeadViews, indices: Sequence[int]) -> None:
    """Write the mean texture into the colour decoder's bias, and subjects into modes and codes.

    With ``identity_modes`` the subjects' deviations from the mean texture are decomposed; each
    component becomes one mode, its coefficient the entry of the subject's code.
    """
    textures, known = [], []
    for subject in model.subjects:
        own = [i for i in indices if views.keys[i].subject == subject]
        colours, weight = project_texture(model, views, evenly(own, IMAGES_PER_SUBJECT))
        textures.append(colours)
        known.append(weight > 0)
    stack, seen = torch.stack(textures), torch.stack(known)[..., None]  # (S, N, 3), (S, N, 1)
    mean = (stack * seen).sum(0) / seen.sum(0).clamp_min(1)
    mean = fill_texels(mean, seen.any(0)[:, 0], model.texels, model.config.n_g)
    stack = torch.where(seen, stack, mean)
    logits = torch.logit(stack.clamp(LOGIT_LIMIT, 1 - LOGIT_LIMIT))
    bias = model.colour.bias.flatten(1)
    bias[:3, model.texels] = logits.mean(0).T
    if model.colour.modes is None or len(model.subjects) == 1:
        return
    u, s, v = torch.linalg.svd((logits - logits.mean(0)).flatten(1).double(), full_matrices=False)
    modes = model.colour.modes.flatten(2)
    count = min(len(s) - 1, len(modes))
    # Codes of unit spread: every decoder then distinguishes the subjects from its first step.
    scale = u[:, :count].std(0).clamp_min(1e-8)
    model.z_id[:, :count] = (u[:, :count] / scale).to(model.z_id.dtype)
    basis = (v[:count] * (s[:count] * scale)[:, None]).to(model.z_id.dtype)
    for k in range(count):
        modes[k][:3, model.texels] = basis[k].view(-1, 3).T


@torch.no_grad()
def project_texture(
    model: GRMM,
    views: HeadViews,
    indices: Sequence[int],
    z_id: Tensor | None = None,
    z_exp: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the mean footage colour of each texel over the views that see it.

    Codes are zero by default. Returns colours (N, 3) in [0, 1] and weights (N,), which are 0 where
    no view sees the texel.
    """
    total = model.z_id.new_zeros(len(model.texels), 3)
    weight = model.z_id.new_zeros(len(model.texels))
    z_id = torch.zeros_like(model.z_id[0]) if z_id is None else z_id
    z_exp = torch.zeros_like(model.z_exp[0]) if z_exp is None else z_exp
    heads: dict[tuple[str, str], Gaussians] = {}
    for index in indices:
        item = views.item(index)
        if item.key.frame not in heads:
            heads[item.key.frame] = model.geometry(z_id, z_exp, item.state)
        colours, seen = _seen_colours(model, heads[item.key.frame], item)
        total += seen[:, None] * colours
        weight += seen
    return total / weight.clamp_min(1e-8)[:, None], weight


def _seen_colours(model: GRMM, gaussians: Gaussians, item: HeadView) -> tuple[Tensor, Tensor]:
    """Sample colours (N, 3) under the means; weights (N,) are squared cosines, 0 if hidden."""
    view = item.view
    camera = view.cam_from_head.to(gaussians.means.dtype)
    points = gaussians.means @ camera[:3, :3].T + camera[:3, 3]
    z = points[:, 2].clamp_min(1e-6)
    K = view.K.to(z.dtype)
    x = K[0, 0] * points[:, 0] / z + K[0, 2]
    y = K[1, 1] * points[:, 1] / z + K[1, 2]
    blank = gaussians.means.new_zeros(len(points), 3)
    drawn = model.draw(gaussians, blank, view, refine=False)
    maps = torch.cat([item.target, drawn.depth[None], (drawn.alpha > 0.5)[None], item.mask[None]])
    # grid_sample's -1 and 1 are the image's borders (align_corners off): the corner convention.
    grid = torch.stack([2 * x / view.width - 1, 2 * y / view.height - 1], -1)
    sampled = torch.nn.functional.grid_sample(maps[None], grid[None, None], align_corners=False)
    sampled = sampled[0, :, 0].T  # (N, 6)
    frames, _ = tangent_frames(item.state.vertices, model.corners, model.gradients)
    facing = -((frames[..., 2] @ camera[:3, :3].T) * points).sum(1) / points.norm(dim=1)
    hit = (points[:, 2] > 0) & (points[:, 2] < sampled[:, 3] + OCCLUSION_M)
    seen = hit & (sampled[:, 4:] > 0.99).all(1) & (facing > FACING)
    return sampled[:, :3], seen * facing.square()


def spread_change(change: Tensor, weight: Tensor, colours: Tensor, means: Tensor) -> Tensor:
    """Predict the change of every texel (N, 3) from the changes of seen texels.

    A kernel regression on colour before the change and on place, with the head's left and right
    folded together, from at most SAMPLES evenly chosen seen texels. ``change`` (N, 3) counts where
    ``weight`` (N,) is positive; ``colours`` (N, 3) in [0, 1] are those before it, and ``means``
    (N, 3) the places in head space, metres.
    """
    seen = torch.nonzero(weight > 0.25 * weight.max())[:, 0] if bool((weight > 0).any()) else []
    if not len(seen):
        return torch.zeros_like(change)
    seen = seen[:: max(1, len(seen) // SAMPLES)]
    folded = torch.cat([means[:, :1].abs(), means[:, 1:]], 1)
    traits = torch.cat([colours / ALIKE_COLOUR, folded / ALIKE_M], 1)
    affinity = -0.5 * torch.cdist(traits, traits[seen]).square()
    return torch.softmax(affinity + torch.log(weight[seen]), 1) @ change[seen]


def fill_texels(values: Tensor, known: Tensor, texels: Tensor, n_g: int) -> Tensor:
    """Fill unknown texels (N, C) from near known ones on the UV map; grey if none is known.

    Pull and push: averages over ever larger cells, each unknown texel takes the finest known.
    """
    grid = values.new_zeros(values.shape[1] + 1, n_g * n_g)
    grid[:-1, texels] = (values * known[:, None]).T
    grid[-1, texels] = known.to(values.dtype)
    filled, found = values.clone(), known.clone()
    level = grid.view(1, -1, n_g, n_g)
    while not bool(found.all()) and level.shape[-1] > 1:
        level = torch.nn.functional.avg_pool2d(level, 2, ceil_mode=True)
        fine = torch.nn.functional.interpolate(level, size=(n_g, n_g), mode="nearest")
        flat = fine[0].flatten(1)[:, texels]
        take = ~found & (flat[-1] > 0)
        filled[take] = (flat[:-1, take] / flat[-1, take]).T
        found |= take
    filled[~found] = 0.5
    return filled
