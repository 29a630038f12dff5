"""Write triangle meshes as PLY, OBJ or GLB in their own units, read surfaces, follow edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse

from express50.errors import FormatError

_WORDS = {"<f4": "float", "|u1": "uchar"}
_AGAIN = "run 'express50 depth' again"


def write_ply(
    path: Path, vertices: np.ndarray, faces: np.ndarray, columns: Mapping[str, np.ndarray]
) -> None:
    """Write a little-endian PLY file of vertices (V, 3), as float32, and faces (F, 3).

    ``columns`` holds further vertex properties by name, each (V,), stored as uint8 if they are
    uint8 and otherwise as float32.
    """
    values = dict(zip("xyz", vertices.T, strict=True)) | dict(columns)
    kinds = [(name, "|u1" if v.dtype == np.uint8 else "<f4") for name, v in values.items()]
    table = np.zeros(len(vertices), kinds)
    for name, value in values.items():
        table[name] = value
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {_WORDS[kind]} {name}" for name, kind in kinds]
    header += [f"element face {len(rows)}", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes(("\n".join(header) + "\n").encode() + table.tobytes() + rows.tobytes())


@dataclass(frozen=True)
class Surface:
    """A reconstructed surface, as ``surface.ply`` holds it."""

    vertices: np.ndarray  # (N, 3) metres
    faces: np.ndarray  # (F, 3) indices
    colors: np.ndarray  # (N, 3) uint8 sRGB
    confidence: np.ndarray  # (N,) from 0 to 1


def write_surface(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    confidence: np.ndarray,
) -> None:
    """Write ``surface.ply``: a `Surface` with unit normals (N, 3); world, metres."""
    columns = {f"n{axis}": normals[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: colors[:, k] for k, name in enumerate(("red", "green", "blue"))}
    write_ply(path, vertices, faces, columns | {"confidence": confidence})


def read_surface(path: Path) -> Surface:
    """Read a surface that depth wrote; FormatError unless it has faces and no NaN."""
    import open3d as o3d
    import trimesh

    try:
        mesh = trimesh.load(path, file_type="ply", process=False, force="mesh")
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        check_faces(faces, len(vertices))
        # Only Open3D returns further vertex properties, but it reads what it can of damaged files;
        # trimesh refuses them, so it comes first.
        columns = o3d.t.io.read_point_cloud(str(path), format="ply").point
        colors = columns["colors"].numpy()
        confidence = columns["confidence"].numpy()[:, 0].astype(np.float64)
    except Exception as error:  # noqa: BLE001  # on damage both may raise anything
        raise FormatError(f"{path}: not a surface from depth ({error}); {_AGAIN}") from None
    if not len(faces) or not (np.isfinite(vertices).all() and np.isfinite(confidence).all()):
        raise FormatError(
            f"{path}: {len(faces)} faces, possibly NaN in the vertices; expected faces and finite"
            f" vertices; {_AGAIN}"
        )
    return Surface(vertices, faces, colors, confidence)


def check_faces(faces: np.ndarray, count: int) -> None:
    """Raise ValueError if faces (F, 3) refer to vertices beyond the `count` that a mesh has."""
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise ValueError(f"triangles name vertices {faces.min()} to {faces.max()} of {count}")


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    uv_faces: np.ndarray,
    texture: str | None,
) -> None:
    """Write an OBJ file of vertices (V, 3) and faces (F, 3) with texture coordinates.

    The coordinates are ``uv`` (T, 2) and ``uv_faces`` (F, 3). ``texture`` may be the file
    name of a picture beside the OBJ; an .mtl file with the OBJ's name then refers to it.
    """
    lines = []
    if texture is not None:
        material = path.with_suffix(".mtl")
        material.write_text(f"newmtl head\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd {texture}\n")
        lines = [f"mtllib {material.name}", "usemtl head"]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices.astype(np.float64)]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in uv.astype(np.float64)]
    corners = np.stack([faces, uv_faces], -1).reshape(-1, 6) + 1
    lines += [f"f {a}/{b} {c}/{d} {e}/{f}" for a, b, c, d, e, f in corners.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def split_seams(
    faces: np.ndarray, uv_faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Repeat vertices along a texture's seams: glTF has one texture coordinate per vertex.

    Of faces (F, 3) and their texture coordinates (F, 3), returns the new vertices' old numbers
    (N,), their texture coordinates (N,), and faces (F, 3).
    """
    corners = np.stack([faces, uv_faces], -1).reshape(-1, 2)
    pairs, split = np.unique(corners, axis=0, return_inverse=True)
    return pairs[:, 0], pairs[:, 1], split.reshape(-1, 3)


def encode_glb(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    colours: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    **material: Any,
) -> bytes:
    """Encode as binary glTF one rough, non-metallic mesh: vertices (V, 3) and faces (F, 3).

    Normals (V, 3) have unit length; colours (V, 4) are uint8, linear light, as glTF 2.0 (3.9.2)
    defines COLOR_0; ``uv`` is (V, 2). ``material`` holds further properties of trimesh's
    PBRMaterial, such as its texture.
    """
    import trimesh

    material = {"metallicFactor": 0.0, "roughnessFactor": 0.8} | material
    skin = trimesh.visual.material.PBRMaterial(**material)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=skin)
    if colours is not None:
        visual.vertex_attributes["color"] = colours
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)
    scene = trimesh.Scene({name: mesh})
    return bytes(scene.export(file_type="glb", include_normals=normals is not None))


def cotangent_laplacian(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Return cotangent stiffness (V, V) and lumped mass (V,) of a mesh (V, 3), (F, 3).

    Source: Pinkall and Polthier 1993. Only positive edge weights are kept, so that slivers do no
    harm and the matrix is positive semi-definite.
    """
    count = len(vertices)
    values: list[np.ndarray] = []
    mass = np.full(count, 1e-12)
    for k in range(3):
        i, j, o = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        u, v = vertices[i] - vertices[o], vertices[j] - vertices[o]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        values.append(0.5 * (u * v).sum(1) / np.maximum(area, 1e-14))
        np.add.at(mass, i, area / 6.0)
    edges = (faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel())
    half = sparse.csr_matrix((np.concatenate(values), edges), shape=(count, count))
    weights = (half + half.T).maximum(0.0).minimum(20.0)
    return sparse.diags(np.asarray(weights.sum(1)).ravel()) - weights, mass


def edges_of(faces: np.ndarray) -> np.ndarray:
    """List the edges (3 F, 2) of faces (F, 3), in the sense of the face."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def open_edges(faces: np.ndarray) -> np.ndarray:
    """List the edges (E, 2) that only one of the faces (F, 3) has, in its sense and sorted."""
    edges = edges_of(faces)
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    return edges[first[count == 1]]


def edge_graph(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """Return the symmetric matrix (count, count) that is 1 where an edge of faces (F, 3) is."""
    edges = edges_of(faces)
    half = sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return ((half + half.T) > 0).astype(np.float64)


def mesh_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """Number the connected parts of faces (F, 3); returns that of each of `count` vertices."""
    return sparse.csgraph.connected_components(edge_graph(faces, count), directed=False)[1]
