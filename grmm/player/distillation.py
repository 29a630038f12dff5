"""Distil one person into arrays that a browser can pose and draw without a GPU.

The tracked mesh is a linear model already. The mesh decoder becomes linear in the same features, by
least squares over poses sampled between those of training; the transform decoder becomes a few
per-Gaussian blend shapes; the colour decoder becomes quadratic in the view direction. The
refinement is left out. Footage is not used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from express50.geometry.transforms import look_at
from express50.geometry.transforms_torch import axis_angle_to_matrix, matrix_to_quat
from express50.head.model import joint_transforms
from grmm.anchors import interpolate, tangent_frames
from grmm.checkpoint import Checkpoint
from grmm.config import SCALE_RANGE_MM
from grmm.data import Tracked, padded
from grmm.edit import HeadCodes, trained_head
from grmm.head_crop import draw_window, neck_cut
from grmm.model import PinholeView, Rendering, quat_multiply
from grmm.networks import DISPLACEMENT_M
from grmm.rasterize import RenderOutput, rasterize
from grmm.render import frontal, orbit

POSES, PICTURES = 200, 48  # sampled for the mesh decoder, and to see which Gaussians show
ANGLES = 12  # last entries of a pose's parameters: neck, jaw, left and right eye
CODES = 12  # directions of residual expression codes that are kept, at most
RIDGE = 1e-3  # of the least squares, in deviations of the features
SPREAD = {"jaw": 0.15, "neck": 0.12, "eyes": 0.2, "coefficients": 0.2}  # of samples about training
BEYOND_DEGREES = 15.0  # the player may turn so far beyond the training cameras
PICTURE_PX = 320  # of sampled views
FAINT_PX = 0.1  # a Gaussian that colours fewer pixels in every sampled picture is left out
MOST_GAUSSIANS = 60_000  # most Gaussians kept: those that colour the most pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Avatar:
    """One person as the player holds it: V vertices, N Gaussians, X coefficients, K codes.

    The features of a pose are its coefficients, the entries of R - I of neck, jaw, left and right
    eye, and its codes: F = X + 36 + K. They shape the mesh at rest, which is then skinned as the
    head model's is.
    """

    rest: Tensor  # (V, 3) metres; every feature zero
    shapes: Tensor  # (F, V, 3) metres per unit of a feature
    skinning: Tensor  # (V, 5)
    joints: Tensor  # (1 + X, 5, 3) metres: at rest, then per unit of a coefficient
    own: Tensor  # (X + 12,) the head's coefficients, then neck, jaw and both eyes, radians
    changes: Tensor  # (E, X + 12) what a training expression adds to them
    codes: Tensor  # (E, K) and what it adds to the codes, which are zero for the head itself
    corners: Tensor  # (N, 3) vertices of each Gaussian's face
    weights: Tensor  # (N, 3) barycentrics
    # (N, 2) of the face: its tangent is [P1 - P0, P2 - P0] @ gradient; 0: the axes are the head's
    gradient: Tensor
    # (1 + K, N, 10) the head's, then per unit of a code: shift in the tangent frame, metres;
    # quaternion, wxyz, of any length; standard deviations, metres
    maps: Tensor
    opacities: Tensor  # (N,)
    # (9, N, 3) sRGB: per unit of 1, x, y, z, xy, yz, zx, xx - zz, yy of the direction from the head
    # to the camera
    colours: Tensor

    def kept(self, which: Tensor) -> Avatar:
        """Return the avatar with the Gaussians of a mask (N,)."""
        return replace(
            self,
            maps=self.maps[:, which],
            colours=self.colours[:, which],
            **{n: getattr(self, n)[which] for n in ("corners", "weights", "gradient", "opacities")},
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class AvatarPose:
    """Parameters (X + 12,) laid out as `Avatar.own`, and weights (E,) of training expressions."""

    parameters: Tensor
    weights: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Person:
    """The full model of a head, which decodes any pose."""

    loaded: Checkpoint
    head: HeadCodes  # at rest
    expressions: tuple[str, ...]  # E names of training expressions that differ from the head
    own: Tensor  # (X + 12,) as `Avatar.own`
    changes: Tensor  # (E, X + 12) as `Avatar.changes`
    z_changes: Tensor  # (E, Z) what an expression adds to z_exp

    def at(self, pose: AvatarPose) -> HeadCodes:
        """Return the head in a pose, for the full model."""
        values = pose.parameters.double().cpu().numpy()
        expression, neck, jaw, eyes = np.split(values, [-ANGLES, -9, -6])
        own = self.head.tracked
        tracked = replace(own, expression=expression, neck=neck, jaw=jaw, eyes=eyes)
        z_exp = self.head.z_exp + pose.weights.to(self.z_changes) @ self.z_changes
        return replace(self.head, tracked=tracked, z_exp=z_exp)

    def pose(self, tracked: Tracked, expression: str | None = None) -> AvatarPose:
        """Return the pose of tracked parameters, with a training expression's code if named."""
        weights = [float(name == expression) for name in self.expressions]
        parameters = _parameters(tracked, len(self.own) - ANGLES).to(self.own)
        return AvatarPose(parameters=parameters, weights=self.own.new_tensor(weights))


def person_of(loaded: Checkpoint, head: HeadCodes, subject: str) -> Person:
    """Collect the changes that a training subject's expressions make to a head."""
    count = len(loaded.head.expression_names)
    others = {name: trained_head(loaded, subject, name) for name in loaded.model.expressions}
    own = _parameters(head.tracked, count).to(loaded.head.template)
    rows = {name: _parameters(o.tracked, count).to(own) - own for name, o in others.items()}
    codes = {name: o.z_exp - head.z_exp for name, o in others.items()}
    names = tuple(n for n in others if bool(rows[n].any()) or bool(codes[n].any()))
    return Person(
        loaded=loaded,
        head=head,
        expressions=names,
        own=own,
        changes=torch.stack([rows[n] for n in names]) if names else own.new_zeros(0, len(own)),
        z_changes=torch.stack([codes[n] for n in names]) if names else head.z_exp[None, :][:0],
    )


def _parameters(tracked: Tracked, count: int) -> Tensor:
    angles = (tracked.neck, tracked.jaw, tracked.eyes)
    return torch.from_numpy(np.concatenate([padded(tracked.expression, count), *angles]))


@torch.no_grad()
def distil(person: Person) -> Avatar:
    """Distil a person (twenty seconds at the demo's size), without Gaussians that never show.

    A picture is linear in the colours: its derivative by them says how many pixels each fills.
    """
    generator = torch.Generator().manual_seed(2)
    poses = sampled_poses(person, PICTURES, generator)
    views = sampled_views(person.loaded, PICTURES, generator)
    avatar = all_gaussians(person)
    most = torch.zeros_like(avatar.opacities)
    for pose, view in zip(poses, views, strict=True):
        colours = torch.full_like(avatar.colours, 0.5)
        colours[1:] = 0
        grey = replace(avatar, colours=colours.requires_grad_())
        with torch.enable_grad():
            drawn(grey, pose, view).colors[..., 0].sum().backward()
        assert colours.grad is not None
        most = torch.maximum(most, colours.grad[0, :, 0])
    least = max(FAINT_PX, float(most.topk(min(MOST_GAUSSIANS, len(most))).values[-1]))
    return avatar.kept(most >= least)


@torch.no_grad()
def all_gaussians(person: Person) -> Avatar:
    """Distil a person with every Gaussian of the model.

    The mesh decoder's displacements are fitted by least squares and added to the shapes; the head's
    own pose stays exact.
    """
    loaded, avatar = person.loaded, _exact_parts(person)
    if loaded.model.mesh is None:
        return avatar
    poses = sampled_poses(person, POSES, torch.Generator().manual_seed(0))
    rows, targets = [], []
    for pose in [person.pose(person.head.tracked), *poses]:
        head = person.at(pose)
        gaussians = loaded.model.geometry(head.z_id, head.z_exp, head.state(loaded))
        features, turn, _ = _skinning(avatar, pose)
        rows.append(features)
        targets.append(torch.linalg.solve(turn, gaussians.displacement.to(turn)))
    first, start = rows[0], targets[0]
    moved = torch.stack(rows[1:]) - first
    wanted = torch.stack(targets[1:]) - start
    deviation = moved.square().mean(0).sqrt().clamp_min(1e-6)
    moved = moved / deviation
    gram = moved.T @ moved + RIDGE * len(moved) * torch.eye(moved.shape[1]).to(moved)
    solution = torch.linalg.solve(gram, moved.T @ wanted.flatten(1)) / deviation[:, None]
    added = solution.view_as(avatar.shapes)
    rest = avatar.rest + start - torch.einsum("f,fvc->vc", first, added)
    return replace(avatar, rest=rest, shapes=avatar.shapes + added)


@torch.no_grad()
def with_neck_cut(person: Person, avatar: Avatar) -> Avatar:
    """Apply `neck_cut` in the head's own pose."""
    loaded, head = person.loaded, person.head
    pose = person.pose(head.tracked)
    state = head.state(loaded)
    moved = loaded.model.geometry(head.z_id, head.z_exp, state).displacement
    share = neck_cut(loaded.head, state.vertices + moved, *posed(avatar, pose))
    maps = torch.cat([avatar.maps[..., :7], avatar.maps[..., 7:] * share[:, None]], -1)
    return replace(avatar, maps=maps).kept(share > 0)


def sampled_poses(person: Person, count: int, generator: torch.Generator) -> list[AvatarPose]:
    """Draw poses between two training expressions each, with jaw, neck, eyes and more moved."""
    changes, poses = person.changes[:, :-ANGLES], []
    used = changes.abs().amax(0) if len(changes) else 0 * person.own[:-ANGLES]
    spread = torch.cat(
        [SPREAD["coefficients"] * used]
        + [used.new_full((n,), SPREAD[name]) for name, n in (("neck", 3), ("jaw", 3), ("eyes", 6))]
    )
    for _ in range(count):
        weights = torch.zeros(len(person.expressions)).to(person.own)
        for share in torch.rand(2, generator=generator).sort().values.diff(prepend=torch.zeros(1)):
            if len(weights):
                weights[int(torch.randint(len(weights), (), generator=generator))] += share
        noise = torch.randn(len(spread), generator=generator).to(person.own)
        noise[-3:] = noise[-6:-3]  # both eyes look the same way
        moved = person.own + weights @ person.changes + spread * noise
        poses.append(AvatarPose(parameters=moved, weights=weights))
    return poses


def front_view(loaded: Checkpoint, size: int) -> PinholeView:
    """Return a square view from straight ahead, as far away as the training's frontal camera.

    The focal length lets the head model's template fill three quarters of the height.
    """
    template, centre = loaded.head.template, loaded.model.head_centre.double().cpu()
    camera = frontal(loaded).cam_from_head.double().cpu()
    distance = float((camera[:3, :3] @ centre + camera[:3, 3]).norm())
    height = float(template[:, 1].max() - template[:, 1].min())
    pose = look_at(centre.numpy() + [0.0, 0.0, distance], centre.numpy())
    focal = 0.75 * size * distance / height
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    K, cam_from_head = K.to(template.device), torch.from_numpy(pose).to(template.device)
    return PinholeView(K=K, cam_from_head=cam_from_head, width=size, height=size)


def seen_angles(loaded: Checkpoint) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of yaw and pitch, degrees, of the training cameras and a little beyond."""
    directions = torch.stack([view.direction() for view in loaded.gallery.cameras.values()])
    x, y, z = directions.double().cpu().unbind(1)
    yaw, pitch = torch.rad2deg(torch.atan2(x, z)), torch.rad2deg(torch.asin(y.clamp(-1, 1)))
    limits = []
    for angle, most in ((yaw, 180.0), (pitch, 60.0)):
        reach = BEYOND_DEGREES + torch.stack([-angle.min(), angle.max()]).clamp_min(0)
        low, high = reach.clamp_max(most).tolist()
        limits.append((-low, high))
    return limits[0], limits[1]


def sampled_views(loaded: Checkpoint, count: int, generator: torch.Generator) -> list[PinholeView]:
    """Draw views in the range that `seen_angles` gives, denser ahead than behind."""
    front, centre = front_view(loaded, PICTURE_PX), loaded.model.head_centre
    yaws, pitches = seen_angles(loaded)
    views = []
    for _ in range(count):
        a, b, c = torch.rand(3, generator=generator).tolist()
        yaw = (2 * a - 1) * max(b, 0.3)
        turn = yaw * yaws[1] if yaw > 0 else -yaw * yaws[0]
        pitch = pitches[0] + c * (pitches[1] - pitches[0])
        views.append(orbit(front, -turn, centre, pitch))  # yaw is towards +x, an orbit towards -x
    return views


def _exact_parts(person: Person) -> Avatar:
    """Collect the mesh, its skinning and the Gaussians' places, and fit codes and colours."""
    loaded, head = person.loaded, person.head
    model, mesh, tracked = loaded.model, loaded.head, head.tracked
    shape = torch.as_tensor(tracked.shape).to(mesh.template)
    rest = mesh.template + mesh.shape_dirs[..., : len(shape)] @ shape
    if len(tracked.offsets):
        rest = rest + torch.as_tensor(tracked.offsets).to(rest)
    directions = mesh.expression_dirs.permute(2, 0, 1)
    shapes = directions, mesh.pose_dirs.view(36, -1, 3)
    meshes = torch.cat([rest[None], directions])
    # Coordinates (E, K) of the residual codes along principal directions, each at most 1.
    u, s, _ = torch.linalg.svd(person.z_changes, full_matrices=False)
    kept = min(CODES, int((s > 1e-3 * s.amax()).sum())) if len(s) else 0
    codes = u[:, :kept] * s[:kept]
    codes = codes / codes.abs().amax(0) if kept else codes
    maps, opacities = _maps(person, person.pose(tracked))
    changes = [
        _maps(person, AvatarPose(parameters=person.own + change, weights=one))[0] - maps
        for change, one in zip(person.changes, torch.eye(len(codes)).to(rest), strict=True)
    ]
    blends = maps.new_zeros(kept, *maps.shape)
    if codes.numel():
        blends = torch.linalg.lstsq(codes, torch.stack(changes).flatten(1)).solution.view_as(blends)
    return Avatar(
        rest=rest,
        shapes=torch.cat([*shapes, rest.new_zeros(kept, *rest.shape)]),
        skinning=mesh.skinning,
        joints=torch.einsum("jv,fvc->fjc", mesh.joint_regressor, meshes),
        own=person.own,
        changes=person.changes,
        codes=codes,
        corners=model.corners,
        weights=model.barycentrics,
        gradient=model.gradients[:, :, 0] * (model.config.frame != "head"),
        maps=torch.cat([maps[None], blends]),
        opacities=opacities,
        colours=_colours(person),
    )


def _maps(person: Person, pose: AvatarPose) -> tuple[Tensor, Tensor]:
    """Decode what `Avatar.maps` and ``opacities`` hold, (N, 10) and (N,), in one pose."""
    head = person.at(pose)
    model = person.loaded.model
    maps = model.decode(head.z_id, head.z_exp, head.state(person.loaded))
    unit = maps.offsets.new_tensor([1.0, 0.0, 0.0, 0.0])
    quats = torch.nn.functional.normalize(maps.offsets[:, 3:] + unit, dim=1)
    scales = 1e-3 * maps.scales_mm.clamp(*SCALE_RANGE_MM)
    return torch.cat([DISPLACEMENT_M * maps.offsets[:, :3], quats, scales], 1), maps.opacities


def _colours(person: Person) -> Tensor:
    """Fit `Avatar.colours` to the colours that the training cameras and sampled views see."""
    loaded, head = person.loaded, person.head
    generator = torch.Generator().manual_seed(0)
    views = [*loaded.gallery.cameras.values(), *sampled_views(loaded, 24, generator)]
    state = head.state(loaded)
    shown = [loaded.model.appearance(head.z_id, state, view)[:, :3] for view in views]
    rows = torch.stack([_direction_features(view) for view in views]).to(shown[0])
    ridge = RIDGE * len(views) * torch.eye(rows.shape[1]).to(rows)
    ridge[0, 0] = 0
    solution = torch.linalg.solve(rows.T @ rows + ridge, rows.T @ torch.stack(shown).flatten(1))
    return solution.view(rows.shape[1], -1, 3)


def _direction_features(view: PinholeView) -> Tensor:
    x, y, z = view.direction()
    one = torch.ones_like(x)
    return torch.stack([one, x, y, z, x * y, y * z, z * x, x * x - z * z, y * y])


def _skinning(avatar: Avatar, pose: AvatarPose) -> tuple[Tensor, Tensor, Tensor]:
    """Return the features (F,), and each vertex's turn (V, 3, 3) and shift (V, 3)."""
    coefficients, angles = pose.parameters[:-ANGLES], pose.parameters[-ANGLES:].view(4, 3)
    turns = axis_angle_to_matrix(torch.cat([torch.zeros_like(angles[:1]), angles]))
    bent = (turns[1:] - torch.eye(3).to(turns)).flatten()
    features = torch.cat([coefficients, bent, pose.weights @ avatar.codes])
    joints = avatar.joints[0] + torch.einsum("x,xjc->jc", coefficients, avatar.joints[1:])
    turn, shift = (part[0] for part in joint_transforms(joints[None], turns[None]))
    blended = torch.einsum("vj,jrc->vrc", avatar.skinning, turn)
    return features, blended, avatar.skinning @ shift


def posed(avatar: Avatar, pose: AvatarPose) -> tuple[Tensor, Tensor, Tensor]:
    """Return means (N, 3), quaternions (N, 4) and scales (N, 3), metres, in head space.

    The player computes the same.
    """
    features, turn, shift = _skinning(avatar, pose)
    rest = avatar.rest + torch.einsum("f,fvc->vc", features, avatar.shapes)
    vertices = (turn @ rest[..., None])[..., 0] + shift
    gradients = torch.stack([avatar.gradient, torch.zeros_like(avatar.gradient)], 2)
    gradients[:, 1, 1] = 1.0  # the bitangent follows from tangent and normal
    frames, _ = tangent_frames(vertices, avatar.corners, gradients)
    blend = torch.cat([features.new_ones(1), features[len(features) - avatar.codes.shape[1] :]])
    maps = torch.einsum("k,knc->nc", blend, avatar.maps)
    base = interpolate(vertices, avatar.corners, avatar.weights)
    quats = quat_multiply(matrix_to_quat(frames), maps[:, 3:7])
    means = base + (frames * maps[:, None, :3]).sum(2)
    return means, quats, maps[:, 7:].clamp_min(1e-4)


def drawn(avatar: Avatar, pose: AvatarPose, view: PinholeView, grey: float = 0.0) -> RenderOutput:
    """Draw the avatar as the player does."""
    means, quats, scales = posed(avatar, pose)
    colours = torch.einsum(
        "k,knc->nc", _direction_features(view).to(avatar.colours), avatar.colours
    )
    behind = colours.new_full((3,), grey)
    return rasterize(
        means, quats, scales, avatar.opacities, colours.clamp(0, 1), view.K, view.cam_from_head,
        view.width, view.height, background=behind,
    )  # fmt: skip


def full_rendering(person: Person, pose: AvatarPose, view: PinholeView) -> Rendering:
    """Draw the full model."""
    loaded, head = person.loaded, person.at(pose)
    state = head.state(loaded)
    gaussians = loaded.model.geometry(head.z_id, head.z_exp, state)
    colours = loaded.model.appearance(head.z_id, state, view)
    behind = loaded.config.data.background
    return draw_window(loaded.model, gaussians, colours, view, behind)
