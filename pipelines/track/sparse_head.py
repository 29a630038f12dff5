"""A head model cut down to the few vertices that a fit looks at, with all its derivatives.

The joints are linear in the coefficients, so their regressor is folded into a basis once; posing a
few hundred vertices then costs milliseconds and a full forward-mode Jacobian some tens of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from express50.head.model import HeadModel, skin
from express50.torch_transforms import axis_angle_to_matrix

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
    """

    model: HeadModel
    directions: torch.Tensor
    joints: torch.Tensor
    joint_directions: torch.Tensor
    landmark_vertices: torch.Tensor

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
        basis = self.basis
        linear, pose = parameters[:-POSE_SIZE], parameters[-POSE_SIZE:].reshape(6, 3)
        rest = self.template + self.directions @ linear
        joints = basis.joints + basis.joint_directions @ linear
        angles = torch.cat([torch.zeros_like(pose[:1]), pose[:4]])
        posed = skin(
            rest[None],
            joints[None],
            axis_angle_to_matrix(angles)[None],
            self.skinning,
            self.pose_dirs,
            basis.model.parents,
        )[0]
        corners = posed[:204].reshape(68, 3, 3)
        marks = (corners * basis.model.landmark_bary[..., None]).sum(1)
        points = torch.cat([marks, posed[204:]])
        return points @ (axis_angle_to_matrix(pose[4]) @ rotation).T + pose[5]

    def evaluate(self, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Positions (P, 3)."""
        with torch.inference_mode():
            return self(torch.from_numpy(parameters), torch.from_numpy(rotation)).numpy()

    def linearise(
        self, parameters: np.ndarray, rotation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions (P, 3) and their Jacobian (P, 3, D)."""
        rotation_t = torch.from_numpy(rotation)

        def both(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            points = self(values, rotation_t)
            return points, points

        jacobian, points = torch.func.jacfwd(both, has_aux=True)(torch.from_numpy(parameters))
        return points.numpy(), jacobian.numpy()
