"""Define the type of all head models: a linear shape space posed by linear blend skinning.

The layout is FLAME's (Li et al. 2017, "Learning a model of facial shape and expression from 4D
scans"): five joints (root, neck, jaw, left eye, right eye), joints regressed from the shaped
vertices, pose correctives linear in the entries of R - I of every joint but the root.
Head space: metres, y up, the face looks along +z, the subject's left is +x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch

from express50.errors import HeadModelError
from express50.geometry.transforms_torch import axis_angle_to_matrix

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")
PARENTS = (-1, 0, 1, 1, 1)  # of each joint; -1 for the root
REGIONS = (
    "face", "neck", "scalp", "forehead", "nose", "lips", "left_ear", "right_ear",
    "left_eye_region", "right_eye_region", "left_eyeball", "right_eyeball", "left_iris",
    "right_iris", "teeth", "upper_teeth", "lower_teeth", "tongue", "mouth_interior", "boundary",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadModel:
    """Arrays of a head model. V vertices, F faces, S shape and X expression directions, J joints.

    All tensors share one device, all float tensors one dtype; `to` changes them. Shapes are checked
    on construction (HeadModelError), values by `check_head`, which the loaders call.
    """

    name: str  # "procedural", "flame2023", ...
    template: torch.Tensor  # (V, 3) metres
    shape_dirs: torch.Tensor  # (V, 3, S) metres per unit coefficient
    expression_dirs: torch.Tensor  # (V, 3, X) metres per unit coefficient
    pose_dirs: torch.Tensor  # (9 * (J - 1), V * 3) metres per unit of R - I, row-major
    joint_regressor: torch.Tensor  # (J, V) rows sum to 1
    skinning: torch.Tensor  # (V, J) rows sum to 1
    faces: torch.Tensor  # (F, 3) int64
    uv: torch.Tensor  # (T, 2) in [0, 1], v up
    uv_faces: torch.Tensor  # (F, 3) int64 into uv
    landmark_faces: torch.Tensor  # (68,) int64, iBUG-68 order (subject's right to left)
    landmark_bary: torch.Tensor  # (68, 3)
    shape_names: tuple[str, ...]  # S names
    expression_names: tuple[str, ...]  # X names
    # per landmark 0..16 the vertices that may form the visible jaw line, or None
    contour: tuple[torch.Tensor, ...] | None = None
    regions: dict[str, torch.Tensor] = field(default_factory=dict)  # region name -> (V,) bool
    # True if coefficients are activations in 0..1 (procedural, ICT), False if they are standard
    # deviations (FLAME)
    unit_expressions: bool = True

    def __post_init__(self) -> None:
        vertices, joints = self.template.shape[0], len(PARENTS)
        shapes, expressions = len(self.shape_names), len(self.expression_names)
        expected = {
            "template": (vertices, 3),
            "shape_dirs": (vertices, 3, shapes),
            "expression_dirs": (vertices, 3, expressions),
            "pose_dirs": (9 * (joints - 1), vertices * 3),
            "joint_regressor": (joints, vertices),
            "skinning": (vertices, joints),
            "faces": (self.faces.shape[0], 3),
            "uv": (self.uv.shape[0], 2),
            "uv_faces": (self.faces.shape[0], 3),
            "landmark_faces": (68,),
            "landmark_bary": (68, 3),
        }
        for key, shape in expected.items():
            got = tuple(getattr(self, key).shape)
            if got != shape:
                raise HeadModelError(
                    f"head model {self.name!r}: {key} has shape {got}, expected {shape}"
                )
        for region, mask in self.regions.items():
            if tuple(mask.shape) != (vertices,):
                raise HeadModelError(
                    f"head model {self.name!r}: region {region!r} has shape {tuple(mask.shape)}, "
                    f"expected ({vertices},)"
                )

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of the float tensors."""
        return self.template.dtype

    @property
    def device(self) -> torch.device:
        """Return the device of all tensors."""
        return self.template.device

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> HeadModel:
        """Return the model on a device and with a float dtype (integers and masks keep theirs)."""
        changes: dict[str, object] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, torch.Tensor):
                changes[item.name] = value.to(device, dtype if value.is_floating_point() else None)
        if self.contour is not None:
            changes["contour"] = tuple(line.to(device) for line in self.contour)
        changes["regions"] = {name: mask.to(device) for name, mask in self.regions.items()}
        return replace(self, **changes)  # type: ignore[arg-type]


def check_head(model: HeadModel) -> HeadModel:
    """Return the model if its values are usable, else raise HeadModelError.

    Arrays must be finite, indices in range, and rows of skinning and regressor sum to one.
    """
    where = f"head model {model.name!r}"
    for item in fields(model):
        value = getattr(model, item.name)
        # True of all integers and booleans, so no dtype is left out.
        if isinstance(value, torch.Tensor) and not bool(torch.isfinite(value).all()):
            raise HeadModelError(f"{where}: {item.name} holds NaN or infinite values")
    vertices = model.template.shape[0]
    ranges = {
        "faces": (model.faces, vertices),
        "uv_faces": (model.uv_faces, model.uv.shape[0]),
        "landmark_faces": (model.landmark_faces, model.faces.shape[0]),
    }
    if model.contour is not None:
        ranges["contour"] = (torch.cat(model.contour), vertices)
        if len(model.contour) != 17:
            raise HeadModelError(f"{where}: contour has {len(model.contour)} lists, expected 17")
    for key, (index, count) in ranges.items():
        if index.numel() and (int(index.min()) < 0 or int(index.max()) >= count):
            raise HeadModelError(
                f"{where}: {key} holds indices {int(index.min())}..{int(index.max())}, "
                f"expected 0..{count - 1}"
            )
    for key, rows in {"skinning": model.skinning, "joint_regressor": model.joint_regressor}.items():
        error = float((rows.sum(1) - 1).abs().max())
        if error > 1e-2:
            raise HeadModelError(
                f"{where}: rows of {key} sum to 1 within {error:.3g}, expected 0.01"
            )
    return model


def pose(
    model: HeadModel,
    shape: torch.Tensor,
    expression: torch.Tensor,
    neck: torch.Tensor | None = None,
    jaw: torch.Tensor | None = None,
    eyes: torch.Tensor | None = None,
    root: torch.Tensor | None = None,
    translation: torch.Tensor | None = None,
    offsets: torch.Tensor | None = None,
) -> torch.Tensor:
    """Pose the head. Missing arguments and coefficients are zero.

    Args:
        model: The head model.
        shape: (B, <= S).
        expression: (B, <= X).
        neck: (B, 3) axis-angle, radians.
        jaw: (B, 3) axis-angle; opening is +x.
        eyes: (B, 6) axis-angle of the left, then the right eye.
        root: (B, 3) axis-angle about the root joint (not about the origin, as in FLAME).
        translation: (B, 3) metres, added last.
        offsets: (B, V, 3) or (1, V, 3) metres, added to the rest shape, which also moves joints.

    Returns:
        (B, V, 3) vertices, metres.

    Raises:
        ValueError: a tensor's shape does not fit.
    """
    rest = rest_vertices(model, shape, expression, offsets)
    joints = torch.einsum("jv,bvc->bjc", model.joint_regressor, rest)
    angles = joint_angles(rest, root, neck, jaw, eyes)
    rotations = axis_angle_to_matrix(angles)
    posed = skin(rest, joints, rotations, model.skinning, model.pose_dirs)
    return posed if translation is None else posed + translation[:, None]


def rest_vertices(
    model: HeadModel,
    shape: torch.Tensor,
    expression: torch.Tensor,
    offsets: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return unposed vertices (B, V, 3): template + shape + expression directions + offsets."""
    for name, value, count in (
        ("shape", shape, model.shape_dirs.shape[2]),
        ("expression", expression, model.expression_dirs.shape[2]),
    ):
        if value.ndim != 2 or value.shape[1] > count:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected (B, at most {count})"
            )
    if shape.shape[0] != expression.shape[0] and 1 not in (shape.shape[0], expression.shape[0]):
        raise ValueError(
            f"expression has {expression.shape[0]} rows, expected {shape.shape[0]}, those of shape"
        )
    rest = (
        model.template
        + torch.einsum("vcs,bs->bvc", model.shape_dirs[..., : shape.shape[1]], shape)
        + torch.einsum("vcx,bx->bvc", model.expression_dirs[..., : expression.shape[1]], expression)
    )
    if offsets is None:
        return rest
    if offsets.shape not in (rest.shape, (1, *rest.shape[1:])):
        raise ValueError(
            f"offsets has shape {tuple(offsets.shape)}, expected {tuple(rest.shape)} or (1, ...)"
        )
    return rest + offsets


def joint_angles(
    like: torch.Tensor,
    root: torch.Tensor | None,
    neck: torch.Tensor | None,
    jaw: torch.Tensor | None,
    eyes: torch.Tensor | None,
) -> torch.Tensor:
    """Return axis-angles (B, 5, 3) in joint order from optional parts; B and dtype are `like`'s."""
    batch = like.shape[0]
    blocks = []
    for name, part, width in (
        ("root", root, 3),
        ("neck", neck, 3),
        ("jaw", jaw, 3),
        ("eyes", eyes, 6),
    ):
        if part is None:
            part = like.new_zeros(batch, width)
        if part.ndim != 2 or part.shape[1] != width or part.shape[0] not in (1, batch):
            raise ValueError(f"{name} has shape {tuple(part.shape)}, expected ({batch}, {width})")
        blocks.append(part.expand(batch, width).reshape(batch, width // 3, 3))
    return torch.cat(blocks, dim=1)


def skin(
    rest: torch.Tensor,
    joints: torch.Tensor,
    rotations: torch.Tensor,
    skinning: torch.Tensor,
    pose_dirs: torch.Tensor,
) -> torch.Tensor:
    """Apply linear blend skinning and pose correctives (SMPL, Loper et al. 2015, equations 2 to 4).

    Works on any subset of vertices, so that a landmark fit poses only those it needs.

    Args:
        rest: (B, N, 3) shaped vertices.
        joints: (B, J, 3) rest joints.
        rotations: (B, J, 3, 3), each relative to its parent.
        skinning: (N, J).
        pose_dirs: (9 * (J - 1), N * 3).

    Returns:
        (B, N, 3).
    """
    identity = torch.eye(3, dtype=rest.dtype, device=rest.device)
    feature = (rotations[:, 1:] - identity).flatten(1)
    corrected = rest + (feature @ pose_dirs).reshape(rest.shape)
    turn, shift = joint_transforms(joints, rotations)
    blended_turn = torch.einsum("nj,bjrc->bnrc", skinning, turn)
    blended_shift = torch.einsum("nj,bjc->bnc", skinning, shift)
    return (blended_turn @ corrected[..., None])[..., 0] + blended_shift


def joint_transforms(
    joints: torch.Tensor, rotations: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return each joint's turn (B, J, 3, 3) and shift (B, J, 3): rest x moves to turn @ x + shift.

    The shift is linear in the rest joints (B, J, 3); rotations (B, J, 3, 3) are to the parents.
    """
    world_rotations, world_joints = [rotations[:, 0]], [joints[:, 0]]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        bone = (joints[:, joint] - joints[:, parent])[..., None]
        world_joints.append(world_joints[parent] + (world_rotations[parent] @ bone)[..., 0])
        world_rotations.append(world_rotations[parent] @ rotations[:, joint])
    turn = torch.stack(world_rotations, dim=1)
    # x -> turn (x - joint) + world joint, written as turn x + shift so that blending is one matmul.
    return turn, torch.stack(world_joints, dim=1) - (turn @ joints[..., None])[..., 0]


def in_regions(model: HeadModel, names: Sequence[str]) -> np.ndarray:
    """Mark the vertices (V,) in any of the named regions that a model has."""
    masks = [model.regions[name].numpy() for name in names if name in model.regions]
    return np.any([np.zeros(len(model.template), dtype=bool), *masks], axis=0)


def landmarks(model: HeadModel, vertices: torch.Tensor) -> torch.Tensor:
    """Return the 68 landmarks (B, 68, 3) on posed vertices (B, V, 3), iBUG-68 order."""
    corners = vertices[:, model.faces[model.landmark_faces]]
    return (corners * model.landmark_bary[None, :, :, None]).sum(2)


def landmarks_of(model: HeadModel, points: np.ndarray | None = None) -> np.ndarray:
    """Return the `landmarks` (68, 3) of a single mesh (V, 3); by default of the head at rest."""
    mesh = model.template if points is None else torch.from_numpy(points)
    return landmarks(model, mesh[None])[0].numpy()


def vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Return unit normals (B, V, 3) of vertices, weighted by area; 0 where no face has area."""
    a, b, c = (vertices[:, faces[:, corner]] for corner in range(3))
    face_normals = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals = normals.index_add(1, faces[:, corner], face_normals)
    # Scaled by the largest entry: squares of tiny normals (faces of a few microns) would underflow.
    scale = normals.abs().amax(-1, keepdim=True)
    safe = torch.where(scale > 0, normals / scale.clamp_min(torch.finfo(scale.dtype).tiny), 0.0)
    length = torch.where(scale > 0, safe.square().sum(-1, keepdim=True), 1.0).sqrt()
    return safe / length


def normals_of(points: np.ndarray, faces: np.ndarray | torch.Tensor) -> np.ndarray:
    """Return the `vertex_normals` (V, 3) of a single mesh of points (V, 3) and faces (F, 3)."""
    return vertex_normals(torch.from_numpy(points)[None], torch.as_tensor(faces))[0].numpy()
