"""Export one head: PLY for splat viewers, GLB for everything else that draws, NPZ for arrays."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from express50.errors import ConfigError
from express50.files.atomic import write_bytes
from express50.geometry.shapes import check_finite
from grmm.checkpoint import Loaded
from grmm.edit import HeadCodes
from grmm.scene import PinholeView

OPAQUE = 0.3  # fainter Gaussians are left out of a GLB: its points cannot be translucent
FORMATS = (".ply", ".glb", ".npz")
SH_DC = 0.5 / math.sqrt(math.pi)  # value of the constant spherical harmonic


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianCloud:
    """N Gaussians with one colour each, head space.

    Attributes:
        means: (N, 3) metres.
        quats: (N, 4) wxyz, unit length.
        scales: (N, 3) standard deviations, metres.
        opacities: (N,).
        colors: (N, 3) in [0, 1], sRGB, as the exported view sees them.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedMesh:
    """The deformed mesh M_d with the decoded colours as its texture.

    Attributes:
        vertices: (V, 3) metres, v_rec + v_id + M_face v_exp.
        faces: (F, 3).
        uv: (T, 2) in [0, 1], v up.
        uv_faces: (F, 3) into uv.
        texture: (n_g, n_g, 3) uint8 sRGB; texels that no face covers carry the mean colour.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    texture: np.ndarray


@torch.no_grad()
def cloud(loaded: Loaded, head: HeadCodes, view: PinholeView) -> GaussianCloud:
    """Decode a head's Gaussians; colours are those that ``view`` sees, before refinement."""
    model, state = loaded.model, head.state(loaded)
    gaussians = model.geometry(head.z_id, head.z_exp, state)
    colours = model.appearance(head.z_id, state, view)[:, :3]
    low, high = loaded.config.model.scale_bounds_mm
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    return GaussianCloud(
        means=gaussians.means.cpu().numpy(),
        quats=quats.cpu().numpy(),
        scales=1e-3 * gaussians.scales_mm.clamp(low, high).cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy(),
        colors=colours.cpu().numpy(),
    )


@torch.no_grad()
def surface(loaded: Loaded, head: HeadCodes, view: PinholeView) -> TexturedMesh:
    """Decode a head's mesh; its texture holds the Gaussians' colours as ``view`` sees them."""
    model, state = loaded.model, head.state(loaded)
    vertices = state.vertices + model.geometry(head.z_id, head.z_exp, state).displacement
    colours = model.appearance(head.z_id, state, view)[:, :3]
    side = loaded.config.model.n_g
    texture = colours.mean(0).expand(side * side, 3).clone()
    texture[model.texels] = colours
    return TexturedMesh(
        vertices=vertices.cpu().numpy(),
        faces=loaded.head.faces.cpu().numpy(),
        uv=loaded.head.uv.cpu().numpy(),
        uv_faces=loaded.head.uv_faces.cpu().numpy(),
        texture=(255 * texture.clamp(0, 1)).round().byte().cpu().numpy().reshape(side, side, 3),
    )


def write_export(
    path: Path, loaded: Loaded, head: HeadCodes, view: PinholeView, points: bool = False
) -> str:
    """Write a head in the format of the extension; returns a description of what was written.

    ``.ply`` holds Gaussians in the 3DGS layout; ``.glb`` the textured mesh, or with ``points`` the
    Gaussians' centres; ``.npz`` the arrays of `GaussianCloud`, mesh, codes and parameters.

    Raises:
        ConfigError: another extension.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(
            f"{path}: cannot export to {path.suffix!r}, expected .ply or .npz or .glb"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".glb" and not points:
        mesh = surface(loaded, head, view)
        write_bytes(path, mesh_glb(mesh))
        return f"mesh of {len(mesh.vertices)} vertices, texture {mesh.texture.shape[0]} px"
    gaussians = cloud(loaded, head, view)
    if path.suffix == ".glb":
        write_bytes(path, points_glb(gaussians))
    elif path.suffix == ".ply":
        write_bytes(path, ply_bytes(gaussians))
    else:
        write_bytes(path, arrays_npz(loaded, head, gaussians, surface(loaded, head, view)))
    return f"{len(gaussians.means)} Gaussians"


def ply_bytes(gaussians: GaussianCloud) -> bytes:
    """Encode Gaussians in the layout of 3D Gaussian Splatting (Kerbl et al. 2023), degree 0.

    One ``vertex`` element of floats: x y z, nx ny nz (unused), f_dc_0..2, opacity (logit),
    scale_0..2 (log) and rot_0..3 (wxyz). Opacities are kept within 1e-6 of 0 and 1 and scales over
    1e-30, so that logits and logarithms are finite.

    Raises:
        ValueError: a value is not finite.
    """
    for name, array in vars(gaussians).items():
        check_finite(name, array)
    count = len(gaussians.means)
    alpha = gaussians.opacities.astype(np.float64).clip(1e-6, 1 - 1e-6)
    columns = {
        ("x", "y", "z"): gaussians.means,
        ("nx", "ny", "nz"): np.zeros((count, 3)),
        ("f_dc_0", "f_dc_1", "f_dc_2"): (gaussians.colors.astype(np.float64) - 0.5) / SH_DC,
        ("opacity",): np.log(alpha / (1 - alpha))[:, None],
        ("scale_0", "scale_1", "scale_2"): np.log(
            gaussians.scales.astype(np.float64).clip(min=1e-30)
        ),
        ("rot_0", "rot_1", "rot_2", "rot_3"): gaussians.quats,
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for names in columns for name in names]
    table = np.concatenate(list(columns.values()), 1).astype("<f4")
    return "\n".join([*header, "end_header", ""]).encode("ascii") + table.tobytes()


def arrays_npz(
    loaded: Loaded, head: HeadCodes, gaussians: GaussianCloud, mesh: TexturedMesh
) -> bytes:
    """Encode everything about one head as .npz."""
    tracked = {f"flame_{name}": value for name, value in vars(head.tracked).items()}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        **vars(gaussians),
        mesh_vertices=mesh.vertices,
        mesh_faces=mesh.faces,
        z_id=head.z_id.cpu().numpy(),
        z_exp=head.z_exp.cpu().numpy(),
        head=np.array(loaded.head_spec),
        **tracked,
    )
    return buffer.getvalue()


def mesh_glb(mesh: TexturedMesh) -> bytes:
    """Encode the textured mesh as binary glTF; vertices are split at the UV map's seams."""
    import trimesh
    from PIL import Image

    corners = np.stack([mesh.faces.reshape(-1), mesh.uv_faces.reshape(-1)], 1)
    pairs, faces = np.unique(corners, axis=0, return_inverse=True)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(mesh.texture), metallicFactor=0.0, roughnessFactor=1.0
    )
    visual = trimesh.visual.TextureVisuals(uv=mesh.uv[pairs[:, 1]], material=material)
    whole = trimesh.Trimesh(
        mesh.vertices[pairs[:, 0]], faces.reshape(-1, 3), visual=visual, process=False
    )
    return bytes(whole.export(file_type="glb"))


def points_glb(gaussians: GaussianCloud) -> bytes:
    """Encode as binary glTF the centres of Gaussians whose opacity is over OPAQUE."""
    import trimesh

    shown = gaussians.opacities > OPAQUE
    colours = np.round(255 * gaussians.colors[shown].clip(0, 1)).astype(np.uint8)
    points = trimesh.PointCloud(gaussians.means[shown], colors=colours)
    return bytes(trimesh.Scene(points).export(file_type="glb"))
