"""Pose a few vertices of the head model with derivatives, and add smooth offsets to it.

The joints are linear in the coefficients, so their regressor is folded into a basis once. Posing a
few hundred vertices then costs milliseconds and their Jacobian some tens of milliseconds.

Offsets express what shape coefficients cannot: a smooth static displacement of the skin, along its
normals and along itself. The prior is a Gaussian field on the surface with a standard deviation and
a correlation length in metres (the Matern field of Lindgren, Rue and Lindstroem 2011, "An explicit
link between Gaussian fields and Gaussian Markov random fields"), so it does not depend on the
mesh's resolution. Its broadest modes, eigenfunctions of the Laplacian, join the head's shape
directions; both are fitted at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import eigsh

from express50.geometry.meshes import cotangent_laplacian
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.model import HeadModel, in_regions, joint_transforms, skin, vertex_normals

POSE_SIZE = 18
# Parts that move as one or are not skin: their shape is the model's.
RIGID = (
    "left_eyeball", "right_eyeball", "teeth", "tongue", "gums", "mouth_interior", "boundary",
)  # fmt: skip
# Names of modes: all, those along the normals and those along the skin.
MODE = "offset_"
OFF, ALONG = f"{MODE}off_", f"{MODE}along_"
OFFSET_SIGMA_M, OFFSET_LENGTH_M = 0.001, 0.02  # standard deviation, correlation length


@dataclass(frozen=True)
class Basis:
    """Joints of a head model as a linear function of its coefficients, float64."""

    model: HeadModel  # the head model in float64
    directions: torch.Tensor  # (V, 3, S + X)
    joints: torch.Tensor  # (J, 3) of the template
    joint_directions: torch.Tensor  # (J, 3, S + X)
    # (68, 3) the known error of the landmark detector on this face, head space
    bias: np.ndarray = field(default_factory=lambda: np.zeros((68, 3)))

    @property
    def shape_size(self) -> int:
        """Return the number of shape coefficients."""
        return self.model.shape_dirs.shape[2]

    @property
    def expression_size(self) -> int:
        """Return the number of expression coefficients."""
        return self.model.expression_dirs.shape[2]


def make_basis(model: HeadModel) -> Basis:
    """Fold the joint regressor into the bases."""
    model = model.to(dtype=torch.float64)
    directions = torch.cat([model.shape_dirs, model.expression_dirs], dim=2)
    return Basis(
        model,
        directions,
        model.joint_regressor @ model.template,
        torch.einsum("jv,vcd->jcd", model.joint_regressor, directions),
    )


class Points:
    """Chosen vertices of the head as a function of the fit's parameters.

    Parameters of one expression, in order: shape (S), expression (X), neck (3), jaw (3), left eye
    (3), right eye (3), turn of the head (3, axis-angle on the world side of R), t (3).
    """

    def __init__(self, basis: Basis, vertices: np.ndarray) -> None:
        model = basis.model
        self.basis = basis
        ids = torch.from_numpy(np.asarray(vertices, dtype=np.int64))
        self.template, self.directions = model.template[ids], basis.directions[ids]
        self.skinning = model.skinning[ids]
        width = model.pose_dirs.shape[0]
        self.pose_dirs = model.pose_dirs.reshape(width, -1, 3)[:, ids].reshape(width, -1)

    def __call__(self, parameters: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Evaluate world positions (M, 3) for parameters (D,) about the rotation (3, 3)."""
        linear, pose = parameters[:-POSE_SIZE], parameters[-POSE_SIZE:]
        rest, joints = self._at_rest(linear)
        turns = _joint_rotations(pose)
        posed = skin(rest[None], joints[None], turns[None], self.skinning, self.pose_dirs)[0]
        return posed @ (axis_angle_to_matrix(pose[12:15]) @ rotation).T + pose[15:]

    def _at_rest(self, linear: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return vertices (M, 3) and joints (J, 3) for shape and expression, before posing."""
        joints = self.basis.joints + self.basis.joint_directions @ linear
        return self.template + self.directions @ linear, joints

    def evaluate(self, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Evaluate positions (M, 3)."""
        with torch.inference_mode():
            return self(torch.from_numpy(parameters), torch.from_numpy(rotation)).numpy()

    def linearise(
        self, parameters: np.ndarray, rotation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate positions (M, 3) and their Jacobian (M, 3, D).

        Vertices are linear in the joints' transforms and in the coefficients.
        """
        values, about = torch.from_numpy(parameters), torch.from_numpy(rotation)
        linear, pose = values[:-POSE_SIZE], values[-POSE_SIZE:]
        rest, joints = self._at_rest(linear)
        turns = _joint_rotations(pose)
        turn, shift = joint_transforms(joints[None], turns[None])
        world = axis_angle_to_matrix(pose[12:15]) @ about
        turn, shift = world @ turn[0], shift[0] @ world.T
        by_turn, by_shift, by_turns = _transform_slopes(pose, joints, about)
        correctives = self.pose_dirs.T @ by_turns.flatten(1).T  # (3 M, 18)
        bent = (turns[1:] - torch.eye(3)).flatten()
        corrected = rest + (self.pose_dirs.T @ bent).view(rest.shape)
        blended = torch.einsum("nj,jrc->nrc", self.skinning, turn)
        points = (blended @ corrected[..., None])[..., 0] + self.skinning @ shift + pose[15:]
        shared = (self.skinning[:, :, None] * corrected[:, None]).flatten(1)  # (M, 5 * 3)
        columns = shared @ by_turn.permute(1, 3, 2, 0).flatten(0, 1).flatten(1)
        columns = columns + self.skinning @ by_shift.permute(1, 2, 0).flatten(1)
        columns = columns.view(len(rest), 3, -1) + blended @ correctives.view(len(rest), 3, -1)
        columns[:, :, 15:] += torch.eye(3)

        moving = self.basis.joint_directions.permute(2, 0, 1)
        every = turns[None].expand(len(moving), -1, -1, -1)
        moved = (joint_transforms(moving, every)[1] @ world.T).permute(1, 2, 0).flatten(1)
        by_coefficient = torch.addmm((blended @ self.directions).flatten(1), self.skinning, moved)
        return points.numpy(), torch.cat(
            [by_coefficient.view(self.directions.shape), columns], dim=2
        ).numpy()


def _transform_slopes(
    pose: torch.Tensor, joints: torch.Tensor, about: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return slopes by the pose: (18, 5, 3, 3), (18, 5, 3) and (18, 4, 3, 3).

    They are those of the joints' turns and shifts to the world, and of the joints' own rotations.
    Transforms are affine in any one joint's rotation: along its slope their difference is exact.
    """
    turns, slopes = _joint_rotations(pose), rotation_slopes(pose[:15].view(5, 3))
    own = torch.zeros(4, 3, 4, 3, 3, dtype=pose.dtype)
    own[range(4), :, range(4)] = slopes[:4]
    own = own.flatten(0, 1)
    moved = turns.expand(13, -1, -1, -1).clone()
    moved[1:, 1:] += own
    turn, shift = joint_transforms(joints.expand(13, -1, -1), moved)
    world = axis_angle_to_matrix(pose[12:15]) @ about
    spin = slopes[4] @ about
    zero = torch.zeros(3, *turn.shape[1:], dtype=pose.dtype)
    by_turn = torch.cat([world @ (turn[1:] - turn[0]), spin[:, None] @ turn[0], zero])
    along = torch.cat([(shift[1:] - shift[0]) @ world.T, shift[0] @ spin.mT, zero[..., 0]])
    return by_turn, along, torch.cat([own, torch.zeros(6, 4, 3, 3, dtype=pose.dtype)])


def rotation_slopes(angles: torch.Tensor) -> torch.Tensor:
    """Return the slopes (N, 3, 3, 3) of rotations by their axis-angles (N, 3).

    Source: Gallego and Yezzi 2015, "A compact formula for the derivative of a 3-D rotation in
    exponential coordinates".
    """
    rotation, unit = axis_angle_to_matrix(angles), torch.eye(3, dtype=angles.dtype)
    square = angles.square().sum(1)[:, None, None]
    turned = torch.linalg.cross(angles[:, None].expand(-1, 3, -1), (unit - rotation).mT)
    axes = (angles[:, :, None] * angles[:, None] + turned) / square.clamp_min(1e-24)
    # Next to no rotation its slopes are turns about the axes.
    axes = torch.where(square > 1e-12, axes, unit)
    # The cross products of an axis with the unit vectors are the columns of its generator.
    columns = torch.linalg.cross(axes[:, :, None].expand(-1, -1, 3, -1), unit.expand(1, 1, 3, 3))
    return columns.mT @ rotation[:, None]


def _joint_rotations(pose: torch.Tensor) -> torch.Tensor:
    """Convert a pose (18,) to rotations (5, 3, 3) of the joints; the root's is the identity."""
    angles = torch.cat([torch.zeros_like(pose[:3]), pose[:12]]).reshape(5, 3)
    return axis_angle_to_matrix(angles)


def movable_vertices(model: HeadModel) -> np.ndarray:
    """Mark the vertices (V,) that may leave the model's shapes: skin, not eyes, teeth and mouth."""
    return ~in_regions(model, RIGID)


def with_modes(model: HeadModel, count: int, along: int = 0) -> HeadModel:
    """Add the field's modes to the head's shape directions, weighted by standard deviations.

    There are `count` modes along the normals, and `along` by which the skin slides along itself,
    each for three axes. Skin is located less finely along itself: these are the broadest modes.
    """
    if count == 0 and along == 0:
        return model
    normals = vertex_normals(model.template[None].double(), model.faces)[0]
    heights = torch.from_numpy(offset_modes(model, max(count, along)))
    flat = torch.eye(3).double() - normals[:, :, None] * normals[:, None, :]
    lifts = normals[:, :, None] * heights[:, None, :count]
    slides = (flat[..., None] * heights[:, None, None, :along]).flatten(2)
    modes = torch.cat([lifts, slides], dim=2)
    names = tuple(f"{OFF}{index}" for index in range(lifts.shape[2]))
    names += tuple(f"{ALONG}{index}" for index in range(slides.shape[2]))
    return replace(
        model,
        shape_dirs=torch.cat([model.shape_dirs, modes.to(model.dtype)], dim=2),
        shape_names=model.shape_names + names,
    )


def freeze_shape(basis: Basis, shape: np.ndarray, bias: np.ndarray) -> Basis:
    """Fold a person's shape (S,) and detector bias (68, 3) into the basis; poses are left."""
    coefficients, size = torch.from_numpy(np.asarray(shape, dtype=np.float64)), basis.shape_size
    model = replace(
        basis.model,
        template=basis.model.template + basis.model.shape_dirs @ coefficients,
        shape_dirs=basis.model.shape_dirs[..., :0],
        shape_names=(),
    )
    return replace(
        basis,
        model=model,
        directions=basis.directions[..., size:],
        joints=basis.joints + basis.joint_directions[..., :size] @ coefficients,
        joint_directions=basis.joint_directions[..., size:],
        bias=bias,
    )


def split_shape(model: HeadModel, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split a fit into the head's shape coefficients (S,) and the modes' offsets (V, 3), metres.

    `model` is as `with_modes` returns it, `shape` (S + modes,) are its coefficients.
    """
    count = sum(not name.startswith(MODE) for name in model.shape_names)
    return shape[:count], model.shape_dirs[..., count:].double().numpy() @ shape[count:]


def offset_modes(
    model: HeadModel, count: int, sigma: float = OFFSET_SIGMA_M, length: float = OFFSET_LENGTH_M
) -> np.ndarray:
    """Compute the field's broadest modes (V, count), metres per standard deviation.

    Eyes, teeth and the inside of the mouth stay where they are.
    """
    vertices = model.template.double().numpy()
    stiffness, mass = cotangent_laplacian(vertices, model.faces.numpy())
    free = np.flatnonzero(movable_vertices(model) & (mass > 1e-11))
    count = min(count, len(free) - 2)
    core = stiffness[free][:, free].tocsc()
    # A fixed start makes the iteration, and so the modes, the same in every run.
    values, modes = eigsh(
        core, count, sparse.diags(mass[free]).tocsc(), sigma=-1.0, v0=np.ones(len(free))
    )
    kappa = 1.0 / length
    root_tau = 1.0 / (np.sqrt(4.0 * np.pi) * kappa * sigma)
    heights = np.zeros((len(vertices), count))
    heights[free] = modes / (root_tau * (kappa**2 + np.maximum(values, 0.0)))
    return heights
