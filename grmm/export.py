"""Export one head: PLY for splat viewers, GLB for everything else that draws, NPZ for arrays."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from express50.files.atomic import write_bytes
from express50.head.model import HeadModel
from grmm.arkit import arkit_targets, with_morph_targets
from grmm.checkpoint import Loaded
from grmm.config import SCALE_RANGE_MM
from grmm.edit import HeadCodes
from grmm.model import PinholeView
from grmm.splat_files import GaussianCloud, ply_bytes, splats_glb, spz_bytes


def write_export(path: Path, loaded: Loaded, head: HeadCodes, view: PinholeView, form: str) -> str:
    """Write a head in a format; returns a description of what was written.

    ``ply`` holds Gaussians in the 3DGS layout, ``spz`` in Niantic's, ``splats`` as GLB with
    KHR_gaussian_splatting; ``glb`` the textured mesh, ``arkit`` with morph targets; ``npz`` the
    arrays of `GaussianCloud`, mesh, codes and parameters.
    """
    gaussians, vertices, texture = decoded(loaded, head, view)
    if form == "ply":
        content = ply_bytes(gaussians)
    elif form in ("spz", "splats"):
        content = spz_bytes(gaussians) if form == "spz" else splats_glb(gaussians)
    elif form == "npz":
        content = arrays_npz(loaded, head, gaussians, vertices)
    else:
        targets = arkit_targets(loaded, head) if form == "arkit" else {}
        write_bytes(path, mesh_glb(loaded.head, vertices, texture, targets))
        return f"mesh of {len(vertices)} vertices, texture {len(texture)} px"
    write_bytes(path, content)
    return f"{len(gaussians.means)} Gaussians"


@torch.no_grad()
def decoded(
    loaded: Loaded, head: HeadCodes, view: PinholeView
) -> tuple[GaussianCloud, np.ndarray, np.ndarray]:
    """Decode a head; colours are those that ``view`` sees, before refinement.

    Returns:
        The Gaussians; the vertices (V, 3), metres, of the deformed mesh v_rec + v_id +
        M_face v_exp; its texture (n_g, n_g, 3) uint8 sRGB, which holds the Gaussians' colours and
        the mean colour where no face covers a texel.
    """
    model, state = loaded.model, head.state(loaded)
    gaussians = model.geometry(head.z_id, head.z_exp, state)
    colours = model.appearance(head.z_id, state, view)[:, :3]
    cloud = GaussianCloud(
        means=gaussians.means.cpu().numpy(),
        quats=torch.nn.functional.normalize(gaussians.quats, dim=1).cpu().numpy(),
        scales=1e-3 * gaussians.scales_mm.clamp(*SCALE_RANGE_MM).cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy(),
        colors=colours.cpu().numpy(),
    )
    side = loaded.config.model.n_g
    texture = colours.mean(0).expand(side * side, 3).clone()
    texture[model.texels] = colours
    texture = (255 * texture.clamp(0, 1)).round().byte().view(side, side, 3)
    return cloud, (state.vertices + gaussians.displacement).cpu().numpy(), texture.cpu().numpy()


def arrays_npz(
    loaded: Loaded, head: HeadCodes, gaussians: GaussianCloud, vertices: np.ndarray
) -> bytes:
    """Encode everything about one head as .npz."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        **vars(gaussians),
        mesh_vertices=vertices,
        mesh_faces=loaded.head.faces.cpu().numpy(),
        z_id=head.z_id.cpu().numpy(),
        z_exp=head.z_exp.cpu().numpy(),
        head=np.array(loaded.head_spec),
        **{f"flame_{name}": value for name, value in vars(head.tracked).items()},
    )
    return buffer.getvalue()


def mesh_glb(
    head: HeadModel, vertices: np.ndarray, texture: np.ndarray, targets: dict[str, np.ndarray]
) -> bytes:
    """Encode the textured mesh as binary glTF; vertices are split at the UV map's seams.

    ``targets`` (V, 3) by name become morph targets.
    """
    corners = np.stack([head.faces.cpu().reshape(-1), head.uv_faces.cpu().reshape(-1)], 1)
    pairs, faces = np.unique(corners, axis=0, return_inverse=True)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(texture), metallicFactor=0.0, roughnessFactor=1.0
    )
    uv = head.uv.cpu().numpy()[pairs[:, 1]]
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(
        vertices[pairs[:, 0]], faces.reshape(-1, 3), visual=visual, process=False
    )
    content = bytes(mesh.export(file_type="glb"))
    return with_morph_targets(content, pairs[:, 0], targets) if targets else content
