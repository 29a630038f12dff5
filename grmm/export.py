"""Export one head: PLY for splat viewers, GLB for other 3D software, NPZ for arrays.

A textured mesh may get the 52 blend shapes that ARKit names, as glTF morph targets. Each is one or
two coefficients of a head model that has them by name (the built-in head, ICT-FaceKit), the jaw's
turn, or an eye's; the mesh decoder answers too.
"""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from express50.errors import ConfigError
from express50.files.atomic import write_bytes
from express50.head.model import HeadModel
from grmm.checkpoint import Loaded
from grmm.config import SCALE_RANGE_MM
from grmm.edit import HeadCodes, controlled
from grmm.model import PinholeView
from grmm.splat_files import FLOAT, GaussianCloud, glb_bytes, ply_bytes, splats_glb, spz_bytes

SIDED = (
    "eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide",
    "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthPress", "mouthLowerDown",
    "mouthUpperUp", "browDown", "browOuterUp", "cheekSquint", "noseSneer",
)  # fmt: skip
SINGLE = (
    "jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker",
    "mouthLeft", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower",
    "mouthShrugUpper", "browInnerUp", "cheekPuff", "tongueOut",
)  # fmt: skip
JAW, EYE = 0.35, 0.4  # radians of jawOpen and of eyeLook...
TURNS = {  # joint controls: entry of an axis-angle, and its sign; the left is +x
    "jawOpen": ("jaw.0", 1), "eyeLookDownLeft": ("eyes.0", 1), "eyeLookDownRight": ("eyes.3", 1),
    "eyeLookUpLeft": ("eyes.0", -1), "eyeLookUpRight": ("eyes.3", -1),
    "eyeLookOutLeft": ("eyes.1", 1), "eyeLookInLeft": ("eyes.1", -1),
    "eyeLookInRight": ("eyes.4", 1), "eyeLookOutRight": ("eyes.4", -1),
}  # fmt: skip


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


def arkit_controls(names: tuple[str, ...]) -> dict[str, list[tuple[str, float]]]:
    """Return the controls that each of the 52 shapes moves, and by how much.

    Raises:
        ConfigError: the head model lacks a shape's coefficients, as FLAME does.
    """
    table: dict[str, tuple[str, ...]]
    table = {name: (name, f"{name}_L", f"{name}_R") for name in SINGLE}
    for name in SIDED:
        table |= {f"{name}Left": (f"{name}_L",), f"{name}Right": (f"{name}_R",)}
    controls = {}
    for shape, candidates in table.items():
        known = [name for name in candidates if name in names]
        moves = [(f"expression.{name}", 1.0) for name in known]
        if shape in TURNS:
            entry, sign = TURNS[shape]
            moves.append((entry, sign * (JAW if shape == "jawOpen" else EYE)))
        if not moves:
            raise ConfigError(
                f"--format arkit: the head model has no coefficient for {shape}; expected one with "
                "named expressions: the built-in head or ICT-FaceKit"
            )
        controls[shape] = moves
    return controls


@torch.no_grad()
def arkit_targets(loaded: Loaded, head: HeadCodes) -> dict[str, np.ndarray]:
    """Return what each shape adds to the head's vertices, (V, 3) metres."""

    def vertices(codes: HeadCodes) -> np.ndarray:
        state = codes.state(loaded)
        moved = loaded.model.geometry(codes.z_id, codes.z_exp, state).displacement
        return np.asarray((state.vertices + moved).cpu())

    rest, tracked, targets = vertices(head), head.tracked, {}
    for shape, moves in arkit_controls(loaded.head.expression_names).items():
        changes = {}
        for name, amount in moves:
            table, _, entry = name.partition(".")
            # A coefficient goes to 1 whatever its rest value; a joint turns on from its rest pose.
            own = 0.0 if table == "expression" else float(getattr(tracked, table)[int(entry)])
            changes[name] = (own + amount,)
        targets[shape] = vertices(controlled(loaded, head, changes)) - rest
    return targets


def with_morph_targets(glb: bytes, positions: np.ndarray, targets: dict[str, np.ndarray]) -> bytes:
    """Add morph targets to a GLB of one mesh, whose P POSITIONs are vertices ``positions``."""
    size = struct.unpack("<I", glb[12:16])[0]
    document, body = json.loads(glb[20 : 20 + size]), glb[28 + size :]
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    primitive["targets"] = []
    for moved in targets.values():
        table = np.ascontiguousarray(moved[positions], "<f4")
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": table.nbytes}
        accessor = {
            "bufferView": len(document["bufferViews"]), "componentType": FLOAT, "type": "VEC3",
            "count": len(table), "min": table.min(0).tolist(), "max": table.max(0).tolist(),
        }  # fmt: skip
        primitive["targets"].append({"POSITION": len(document["accessors"])})
        document["bufferViews"].append(view)
        document["accessors"].append(accessor)
        body += table.tobytes()
    mesh["weights"] = [0.0] * len(targets)
    mesh["extras"] = {"targetNames": list(targets)}
    document["buffers"][0]["byteLength"] = len(body)
    return glb_bytes(document, body)
