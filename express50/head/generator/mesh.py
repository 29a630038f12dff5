"""Build half a head's mesh, with tagged vertices and faces in UV charts, and mirror it.

Parts are built on the subject's left (x >= 0, millimetres). A face's winding follows its chart:
faces are flipped so that their UV area is positive, and charts are drawn as seen from outside.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from express50.geometry.meshes import edges_of

Array = np.ndarray


@dataclass
class HalfMesh:
    """The left half while it is built. Tags name vertices; uv has a (u, v) per vertex and chart."""

    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    # Azimuth (radians) and latitude (deg) of skin vertices, NaN elsewhere: see `field.rays`.
    labels: Array = field(default_factory=lambda: np.empty((0, 2)))
    tags: dict[str, Array] = field(default_factory=dict)
    faces: dict[str, list[Array]] = field(default_factory=dict)
    uv: dict[str, dict[int, Array]] = field(default_factory=dict)

    def add(self, points: Array, tag: str) -> Array:
        """Add vertices (N,3), append them to a tag, and return their indices."""
        index = len(self.points) + np.arange(len(points))
        self.points = np.concatenate([self.points, points])
        self.labels = np.concatenate([self.labels, np.full((len(points), 2), np.nan)])
        self.tags[tag] = np.concatenate([self.tags.get(tag, index[:0]), index])
        return index

    def set_uv(self, chart: str, index: Array, uv: Array) -> None:
        """Set the chart's coordinates (N,2) of vertices `index`."""
        self.uv.setdefault(chart, {}).update(zip(index.tolist(), uv, strict=True))

    def add_faces(self, chart: str, faces: Array) -> None:
        """Add triangles (N,3) to a chart; `set_uv` must cover their vertices before assembly."""
        self.faces.setdefault(chart, []).append(np.asarray(faces, np.int64).reshape(-1, 3))

    def strip(self, chart: str, inner: Array, outer: Array, closed: bool) -> None:
        """Add quads between two rows of equal length, split along the shorter diagonal."""
        a, b = inner, outer
        if closed:
            a, b = np.append(a, a[0]), np.append(b, b[0])
        p = self.points
        first = np.linalg.norm(p[a[:-1]] - p[b[1:]], axis=1)
        second = np.linalg.norm(p[a[1:]] - p[b[:-1]], axis=1)
        quads = np.stack([a[:-1], a[1:], b[1:], b[:-1]], 1)
        split = np.where(  # the margin decides ties, which rounding would decide otherwise
            (first <= second + 1e-6)[:, None, None],
            quads[:, [[0, 1, 2], [0, 2, 3]]],
            quads[:, [[0, 1, 3], [1, 2, 3]]],
        )
        faces = split.reshape(-1, 3)
        degenerate = (faces == faces[:, [1, 2, 0]]).any(1)
        self.add_faces(chart, faces[~degenerate])

    def fan(self, chart: str, center: Array, ring: Array, closed: bool) -> None:
        """Add triangles between one vertex (1,) and a row."""
        a = np.append(ring, ring[0]) if closed else ring
        self.add_faces(chart, np.stack([np.full(len(a) - 1, center), a[:-1], a[1:]], 1))


@dataclass(frozen=True)
class WholeMesh:
    """Both halves: vertices (V,3) mm, faces (F,3), charts and UV of face corners, mirror map."""

    vertices: Array
    faces: Array
    face_chart: Array  # (F,) names; right-hand charts of paired parts end in "_right"
    corner_uv: Array  # (F,3,2) in the chart's own coordinates
    mirror: Array  # (V,)
    left_tags: dict[str, Array]

    def tag(self, name: str, side: str = "both") -> Array:
        """Return indices of a tag.

        The side is "left" (x >= 0), "right" (mirrored, same order) or "both".
        """
        left = self.left_tags[name]
        if side == "left":
            return left
        right = self.mirror[left]
        return right if side == "right" else np.unique(np.concatenate([left, right]))


def is_skin(mesh: WholeMesh) -> Array:
    """Mark the triangles (F,) bool of the skin and the ears."""
    return np.isin(mesh.face_chart, ("skin", "ear", "ear_right"))


def mirrored(half: HalfMesh) -> WholeMesh:
    """Mirror the half and weld it at x = 0."""
    points = half.points
    on_plane = np.abs(points[:, 0]) < 1e-9
    right = np.where(on_plane, np.arange(len(points)), 0)
    right[~on_plane] = len(points) + np.arange((~on_plane).sum())
    other = points[~on_plane] * [-1, 1, 1]
    vertices = np.concatenate([points, other])
    mirror = np.empty(len(vertices), int)
    mirror[: len(points)] = right
    mirror[right] = np.arange(len(points))
    faces, charts, corners = [], [], []
    for chart, blocks in half.faces.items():
        block = np.concatenate(blocks)
        uv = np.array([[half.uv[chart][i] for i in face] for face in block.tolist()])
        e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        turned = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] < 0
        block[turned] = block[turned][:, ::-1]
        uv[turned] = uv[turned][:, ::-1]
        faces += [block, right[block][:, ::-1]]
        corners += [uv, uv[:, ::-1] * [-1, 1]]
        charts += [chart] * len(block)
        charts += [chart + ("_right" if chart in PAIRED_CHARTS else "")] * len(block)
    return WholeMesh(
        vertices=vertices,
        faces=np.concatenate(faces),
        face_chart=np.array(charts),
        corner_uv=np.concatenate(corners),
        mirror=mirror,
        left_tags=half.tags,
    )


PAIRED_CHARTS = ("ear", "eye_front", "eye_back")  # those with a second island for the right
# Chart -> left, bottom, right, top in the unit square.
RECTANGLES = {
    "skin": (0.005, 0.250, 0.995, 0.995),
    "ear_right": (0.005, 0.010, 0.155, 0.240),
    "ear": (0.162, 0.010, 0.312, 0.240),
    "mouth": (0.320, 0.040, 0.500, 0.240),
    "tongue": (0.508, 0.010, 0.622, 0.240),
    "eye_front_right": (0.630, 0.120, 0.750, 0.240),
    "eye_front": (0.757, 0.120, 0.877, 0.240),
    "eye_back_right": (0.640, 0.010, 0.740, 0.110),
    "eye_back": (0.767, 0.010, 0.867, 0.110),
    "upper_teeth": (0.885, 0.130, 0.995, 0.240),
    "lower_teeth": (0.885, 0.010, 0.995, 0.120),
}


def pack_uv(mesh: WholeMesh) -> tuple[Array, Array]:
    """Scale each chart into its rectangle; return UV coordinates (T,2) in [0,1], faces (F,3)."""
    corner_uv = np.empty_like(mesh.corner_uv)
    for chart, (left, bottom, right, top) in RECTANGLES.items():
        of_chart = mesh.face_chart == chart
        uv = mesh.corner_uv[of_chart]
        low, high = uv.min((0, 1)), uv.max((0, 1))
        size = np.array([right - left, top - bottom])
        corner_uv[of_chart] = [left, bottom] + (uv - low) / (high - low) * size
    # A vertex has one position per chart, or two if the chart is cut at the mid plane.
    chart_id = np.unique(mesh.face_chart, return_inverse=True)[1]
    side = (mesh.corner_uv[..., 0] > 0).astype(np.int64)
    key = (mesh.faces * len(RECTANGLES) + chart_id[:, None]) * 2 + side
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return corner_uv.reshape(-1, 2)[first], inverse.reshape(-1, 3).astype(np.int64)


def neighbour_mean(values: Array, faces: Array) -> Array:
    """Return the means of values (V,...) over neighbours along the edges of faces (F,3)."""
    edges = np.unique(np.sort(edges_of(faces), 1), axis=0)
    total = np.zeros_like(values)
    np.add.at(total, edges[:, 0], values[edges[:, 1]])
    np.add.at(total, edges[:, 1], values[edges[:, 0]])
    degree = np.bincount(edges.ravel(), minlength=len(values))
    degree = degree.reshape((-1,) + (1,) * (values.ndim - 1))
    return np.where(degree > 0, total / degree.clip(1), values)
