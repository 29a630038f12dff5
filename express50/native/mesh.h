// Visibility of a triangle mesh: a z-buffer, and the pairs of pixels that an outline parts.
//
// Everything is decided by edge functions of rays in camera space (Olano and Greer 1997, "Triangle
// scan conversion using 2D homogeneous coordinates"): nothing is divided before a hit is known, so
// triangles through the plane of the camera need no clipping. One serial call a view; callers run
// views in threads of their own. express50/mesh_raster.py owns all memory.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "projection.h"

// Mirrored by express50/mesh_raster.py.
struct MeshView {
    double fx, fy, cx, cy, near;
    int32_t width, height, cull;
};

namespace {

constexpr int kWalkSteps = 64;  // faces that one pixel step may cross on its way to an outline

struct Ray {
    double x, y;  // z is 1
};

// A triangle as seen from the camera. Functions of a ray r are a.r: edge[k] is positive inside of
// the edge opposite to corner k, plane is such that depth = offset / (plane . r).
struct FacePlanes {
    double edge[3][3], plane[3], offset, z_min, z_max;
    bool usable, front;
};

inline double dot(const double* a, const Ray& r) { return a[0] * r.x + (a[1] * r.y + a[2]); }

// An edge's function is computed from its lower vertex id to its higher one, whichever face asks:
// both faces of an edge then see the same bits with opposite signs, and no ray slips in between.
inline void edge_function(const double* xyz, int32_t i, int32_t j, double sign, double* out) {
    if (i > j) {
        std::swap(i, j);
        sign = -sign;
    }
    cross3(xyz + 3 * int64_t(i), xyz + 3 * int64_t(j), out);
    for (int c = 0; c < 3; ++c) out[c] *= sign;
}

FacePlanes face_planes(const MeshView& view, const double* xyz, const int32_t* face) {
    FacePlanes f;
    const double *a = xyz + 3 * int64_t(face[0]), *b = xyz + 3 * int64_t(face[1]),
                 *c = xyz + 3 * int64_t(face[2]);
    const double ab[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
    const double ac[3] = {c[0] - a[0], c[1] - a[1], c[2] - a[2]};
    cross3(ab, ac, f.plane);
    f.offset = dot3(f.plane, a);
    f.z_min = std::min({a[2], b[2], c[2]});
    f.z_max = std::max({a[2], b[2], c[2]});
    f.front = f.offset < 0;  // counter-clockwise from outside, axes x right, y down, z forward
    f.usable = f.z_max >= view.near && f.offset != 0 && (f.front || !view.cull);
    const double sign = f.front ? -1 : 1;
    for (int k = 0; k < 3; ++k)
        edge_function(xyz, face[(k + 1) % 3], face[(k + 2) % 3], sign, f.edge[k]);
    return f;
}

inline void project_mesh(const MeshView& view, const double* p, double& u, double& v) {
    u = view.fx * p[0] / p[2] + view.cx;
    v = view.fy * p[1] / p[2] + view.cy;
}

struct PixelBox {
    double left = HUGE_VAL, top = HUGE_VAL, right = -HUGE_VAL, bottom = -HUGE_VAL;
    void add(const MeshView& view, const double* p) {
        double u, v;
        project_mesh(view, p, u, v);
        left = std::min(left, u), right = std::max(right, u);
        top = std::min(top, v), bottom = std::max(bottom, v);
    }
};

// Bounds of the part of a triangle that lies beyond the near plane.
PixelBox visible_box(const MeshView& view, const double* xyz, const int32_t* face) {
    PixelBox box;
    for (int k = 0; k < 3; ++k) {
        const double *a = xyz + 3 * int64_t(face[k]), *b = xyz + 3 * int64_t(face[(k + 1) % 3]);
        if (a[2] >= view.near) box.add(view, a);
        if ((a[2] >= view.near) == (b[2] >= view.near)) continue;
        const double s = (view.near - a[2]) / (b[2] - a[2]);
        const double p[3] = {a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), view.near};
        box.add(view, p);
    }
    return box;
}

// Pixels [first, last) whose centres lie in [low, high], with a margin for rounding.
inline void centre_range(double low, double high, int size, int& first, int& last) {
    const double margin = 1e-6 + 1e-9 * std::max(std::abs(low), std::abs(high));
    first = int(std::clamp(std::ceil(low - margin - 0.5), 0.0, double(size)));
    last = int(std::clamp(std::floor(high + margin - 0.5) + 1, 0.0, double(size)));
}

inline bool inside(const FacePlanes& f, const Ray& r) {
    return dot(f.edge[0], r) >= 0 && dot(f.edge[1], r) >= 0 && dot(f.edge[2], r) >= 0;
}

std::vector<double> ray_axis(int size, double focal, double centre) {
    std::vector<double> axis(size);
    for (int i = 0; i < size; ++i) axis[i] = (i + 0.5 - centre) / focal;
    return axis;
}

// Nearest face and depth at every pixel centre; face -1 and depth 0 where there is none. Edges
// belong to both their faces, and of equal depths (in float) the lowest face id wins.
void mesh_zbuffer(const MeshView& view, const double* xyz, int64_t face_count,
                  const int32_t* faces, int32_t* face_id, float* depth) {
    const int64_t pixels = int64_t(view.width) * view.height;
    std::fill(face_id, face_id + pixels, -1);
    std::fill(depth, depth + pixels, 0.0f);
    const std::vector<double> xs = ray_axis(view.width, view.fx, view.cx);
    const std::vector<double> ys = ray_axis(view.height, view.fy, view.cy);
    for (int64_t id = 0; id < face_count; ++id) {
        const FacePlanes f = face_planes(view, xyz, faces + 3 * id);
        if (!f.usable) continue;
        const PixelBox box = visible_box(view, xyz, faces + 3 * id);
        int x0, x1, y0, y1;
        centre_range(box.left, box.right, view.width, x0, x1);
        centre_range(box.top, box.bottom, view.height, y0, y1);
        for (int y = y0; y < y1; ++y) {
            bool entered = false;
            for (int x = x0; x < x1; ++x) {
                const Ray ray{xs[x], ys[y]};
                if (!inside(f, ray)) {
                    if (entered) break;  // triangles are convex
                    continue;
                }
                entered = true;
                // Seen edge on, the plane's depth is noise: a hit lies between the corners.
                const double z = std::clamp(f.offset / dot(f.plane, ray), f.z_min, f.z_max);
                const int64_t at = int64_t(y) * view.width + x;
                if (!(z >= view.near) || (face_id[at] >= 0 && float(z) >= depth[at])) continue;
                face_id[at] = int32_t(id);
                depth[at] = float(z);
            }
        }
    }
}

struct MeshTable {
    const MeshView& view;
    const double* xyz;
    const int32_t *faces, *neighbors;
    std::vector<FacePlanes> planes;
};

// Corner of a face that is on neither end of an edge.
inline int32_t opposite(const int32_t* face, int32_t i, int32_t j) {
    for (int k = 0; k < 3; ++k)
        if (face[k] != i && face[k] != j) return face[k];
    return -1;
}

struct WalkEnd {
    int32_t face, i, j;  // the face where the walk ended; i < 0 when it met no outline
};

// Walks over adjacent faces along the segment between two rays, from a face that is seen at the
// first, until an outline is crossed: the rim of the mesh, or an edge that both of its faces lie on
// the same side of.
WalkEnd walk_to_outline(const MeshTable& mesh, int32_t face, const Ray& from, const Ray& to) {
    for (int step = 0; step < kWalkSteps; ++step) {
        const FacePlanes& f = mesh.planes[face];
        if (f.offset == 0) break;
        double first = 1.0;
        int exit = -1;
        for (int k = 0; k < 3; ++k) {
            const double start = dot(f.edge[k], from), end = dot(f.edge[k], to);
            if (end < 0 && start > end && start <= first * (start - end)) {
                first = start / (start - end);
                exit = k;
            }
        }
        if (exit < 0) break;
        const int32_t* corners = mesh.faces + 3 * int64_t(face);
        const int32_t i = corners[(exit + 1) % 3], j = corners[(exit + 2) % 3];
        const int32_t next = mesh.neighbors[3 * int64_t(face) + exit];
        if (next < 0) return {face, i, j};
        const int32_t third = opposite(mesh.faces + 3 * int64_t(next), i, j);
        if (third < 0) break;
        if (dot3(f.edge[exit], mesh.xyz + 3 * int64_t(third)) > 0) return {face, i, j};
        face = next;
    }
    return {face, -1, -1};
}

// Whether an edge is seen whole and is steep against the pixel step. Each piece of an outline is
// then counted along one axis only, the one along which its crossing is well defined.
bool crosses_steeply(const MeshTable& mesh, int32_t i, int32_t j, bool horizontal) {
    const double *p = mesh.xyz + 3 * int64_t(i), *q = mesh.xyz + 3 * int64_t(j);
    if (p[2] < mesh.view.near || q[2] < mesh.view.near) return false;
    double pu, pv, qu, qv;
    project_mesh(mesh.view, p, pu, pv);
    project_mesh(mesh.view, q, qu, qv);
    const double du = std::abs(qu - pu), dv = std::abs(qv - pv);
    return horizontal ? dv >= du && dv > 0 : du > dv;
}

// Pairs of neighbouring pixels with an outline between them, four numbers each: the pixel on the
// outline's own surface, the other pixel, and the two vertices of the edge. At most two a pixel.
int64_t mesh_outline_pairs(const MeshView& view, const double* xyz, int64_t face_count,
                           const int32_t* faces, const int32_t* neighbors, const int32_t* face_id,
                           const float* depth, int32_t* pairs) {
    MeshTable mesh{view, xyz, faces, neighbors, {}};
    mesh.planes.reserve(face_count);
    for (int64_t id = 0; id < face_count; ++id)
        mesh.planes.push_back(face_planes(view, xyz, faces + 3 * id));
    const std::vector<double> xs = ray_axis(view.width, view.fx, view.cx);
    const std::vector<double> ys = ray_axis(view.height, view.fy, view.cy);
    int64_t count = 0;
    for (int y = 0; y < view.height; ++y)
        for (int x = 0; x < view.width; ++x)
            for (int axis = 0; axis < 2; ++axis) {
                const int x2 = x + (axis == 0), y2 = y + (axis == 1);
                if (x2 >= view.width || y2 >= view.height) continue;
                int64_t at = int64_t(y) * view.width + x, other = int64_t(y2) * view.width + x2;
                if (face_id[at] == face_id[other]) continue;
                Ray from{xs[x], ys[y]}, to{xs[x2], ys[y2]};
                if (face_id[at] < 0 || (face_id[other] >= 0 && depth[other] < depth[at])) {
                    std::swap(at, other);
                    std::swap(from, to);
                }
                WalkEnd end = walk_to_outline(mesh, face_id[at], from, to);
                // A surface that goes on behind the other pixel's is hidden by that one's outline.
                if (end.i < 0 && end.face != face_id[other] && face_id[other] >= 0) {
                    std::swap(at, other);
                    end = walk_to_outline(mesh, face_id[at], to, from);
                }
                if (end.i < 0 || !crosses_steeply(mesh, end.i, end.j, axis == 0)) continue;
                int32_t* pair = pairs + 4 * count++;
                pair[0] = int32_t(at), pair[1] = int32_t(other);
                pair[2] = std::min(end.i, end.j), pair[3] = std::max(end.i, end.j);
            }
    return count;
}

// out (n, C) = sum over k of coefficients (n, 3) times the three rows (3, C) of each one's group.
template <class Real>
void weigh_rows(int64_t n, int64_t channels, const Real* rows, const Real* coefficients,
                const int64_t* group, Real* out) {
    for (int64_t i = 0; i < n; ++i) {
        const Real *w = coefficients + 3 * i, *row = rows + 3 * channels * group[i];
        for (int64_t c = 0; c < channels; ++c)
            out[i * channels + c] =
                w[0] * row[c] + w[1] * row[channels + c] + w[2] * row[2 * channels + c];
    }
}

// Adds to d_rows (zeros on entry) and writes d_coefficients; either may be null.
template <class Real>
void weigh_rows_gradient(int64_t n, int64_t channels, const Real* rows, const Real* coefficients,
                         const int64_t* group, const Real* gradient, Real* d_rows,
                         Real* d_coefficients) {
    for (int64_t i = 0; i < n; ++i) {
        const Real* g = gradient + i * channels;
        const int64_t start = 3 * channels * group[i];
        for (int k = 0; k < 3; ++k) {
            const Real w = coefficients[3 * i + k];
            Real sum = 0;
            for (int64_t c = 0; c < channels; ++c) {
                sum += g[c] * rows[start + k * channels + c];
                if (d_rows) d_rows[start + k * channels + c] += w * g[c];
            }
            if (d_coefficients) d_coefficients[3 * i + k] = sum;
        }
    }
}

}  // namespace
