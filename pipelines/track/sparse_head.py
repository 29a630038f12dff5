"""A head model cut down to the few vertices that a fit looks at, with all its derivatives.

The joints are linear in the coefficients, so their regressor is folded into a basis once; posing a
few hundred vertices then costs milliseconds and a full forward-mode Jacobian some tens of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.model import HeadModel, joint_transforms, skin

POSE_SIZE = 18


@dataclass(frozen=True)
class Basis:
    """Joints of a head model as a linear function of its coefficients, float64.

    Attributes:
        model: the head model in float64.
        directions: (V, 3, S + X).
        joints: (J, 3) of the template.
        joint_directions: (J, 3, S + X).
        landmark_vertices: (68, 3) vertex ids.
        bias: (68, 3) what the detector is known to err on this face, head space.
    """

    model: HeadModel
    directions: torch.Tensor
    joints: torch.Tensor
    joint_directions: torch.Tensor
    landmark_vertices: torch.Tensor
    bias: np.ndarray = field(default_factory=lambda: np.zeros((68, 3)))

    @property
    def shape_size(self) -> int:
        """Number of shape coefficients."""
        return self.model.shape_dirs.shape[2]

    @property
    def expression_size(self) -> int:
        """Number of expression coefficients."""
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
        model.faces[model.landmark_faces],
    )


class Points:
    """The 68 landmarks and some chosen vertices as a function of the fit's parameters.

    Parameters of one expression, in order: shape (S), expression (X), neck (3), jaw (3), left eye
    (3), right eye (3), turn of the head (3, axis-angle on the world side of R), t (3).
    """

    def __init__(self, basis: Basis, vertices: np.ndarray) -> None:
        model = basis.model
        self.basis = basis
        corners = basis.landmark_vertices.reshape(-1)
        ids = torch.cat([corners, torch.from_numpy(np.asarray(vertices, dtype=np.int64))])
        self.count = 68 + len(vertices)
        self.template, self.directions = model.template[ids], basis.directions[ids]
        self.skinning = model.skinning[ids]
        width = model.pose_dirs.shape[0]
        self.pose_dirs = model.pose_dirs.reshape(width, -1, 3)[:, ids].reshape(width, -1)

    def __call__(self, parameters: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """World positions (68 + M, 3) for parameters (D,) about the rotation (3, 3)."""
        linear, pose = parameters[:-POSE_SIZE], parameters[-POSE_SIZE:]
        return self._posed(self._rest(linear), self._joints(linear), pose, rotation)

    def _rest(self, linear: torch.Tensor) -> torch.Tensor:
        return self.template + self.directions @ linear

    def _joints(self, linear: torch.Tensor) -> torch.Tensor:
        return self.basis.joints + self.basis.joint_directions @ linear

    def _posed(
        self, rest: torch.Tensor, joints: torch.Tensor, pose: torch.Tensor, rotation: torch.Tensor
    ) -> torch.Tensor:
        posed = skin(
            rest[None],
            joints[None],
            _joint_rotations(pose)[None],
            self.skinning,
            self.pose_dirs,
            self.basis.model.parents,
        )[0]
        return self._gathered(posed) @ (axis_angle_to_matrix(pose[12:15]) @ rotation).T + pose[15:]

    def _gathered(self, posed: torch.Tensor) -> torch.Tensor:
        """Landmarks, then the chosen vertices, of posed vertices (204 + M, 3[, D])."""
        bary = self.basis.model.landmark_bary
        corners = posed[:204].reshape(68, 3, *posed.shape[1:])
        marks = (corners * bary.reshape(68, 3, *[1] * (posed.ndim - 1))).sum(1)
        return torch.cat([marks, posed[204:]])

    def evaluate(self, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Positions (P, 3)."""
        with torch.inference_mode():
            return self(torch.from_numpy(parameters), torch.from_numpy(rotation)).numpy()

    def linearise(
        self, parameters: np.ndarray, rotation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions (P, 3) and their Jacobian (P, 3, D).

        Posed vertices are linear in the coefficients, so only the 18 columns of the pose need
        forward-mode differentiation.
        """
        values, rotation_t = torch.from_numpy(parameters), torch.from_numpy(rotation)
        linear, pose = values[:-POSE_SIZE], values[-POSE_SIZE:]
        rest, joints = self._rest(linear), self._joints(linear)

        def both(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            points = self._posed(rest, joints, pose, rotation_t)
            return points, points

        by_pose, points = torch.func.jacfwd(both, has_aux=True)(pose)
        by_coefficient = self._linear_columns(pose, rotation_t)
        return points.numpy(), torch.cat([by_coefficient, by_pose], dim=2).numpy()

    def turns(self, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Rotations (M, 3, 3) that take a displacement of a chosen vertex at rest to the world."""
        pose = torch.from_numpy(parameters[-POSE_SIZE:])
        turn, _ = self._transforms(pose, self.basis.joints[None])
        blended = torch.einsum("nj,jrc->nrc", self.skinning[204:], turn[0])
        return (torch.from_numpy(rotation) @ blended).numpy()

    def _transforms(
        self, pose: torch.Tensor, joints: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        rotations = _joint_rotations(pose)[None].expand(len(joints), -1, -1, -1)
        return joint_transforms(joints, rotations, self.basis.model.parents)

    def _linear_columns(self, pose: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Jacobian (P, 3, S + X) by the coefficients."""
        turn, shift = self._transforms(pose, self.basis.joint_directions.permute(2, 0, 1))
        world = axis_angle_to_matrix(pose[12:15]) @ rotation
        blended = torch.einsum("nj,jrc->nrc", self.skinning, world @ turn[0])
        moved = (shift @ world.T).permute(1, 2, 0).flatten(1)
        columns = torch.addmm((blended @ self.directions).flatten(1), self.skinning, moved).view(
            self.directions.shape
        )
        return self._gathered(columns)


def _joint_rotations(pose: torch.Tensor) -> torch.Tensor:
    """Rotations (5, 3, 3) of the joints, the root's being the identity, from a pose (18,)."""
    angles = torch.cat([torch.zeros_like(pose[:3]), pose[:12]]).reshape(5, 3)
    return axis_angle_to_matrix(angles)
