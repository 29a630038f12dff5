// Visibility of a triangle mesh: a z-buffer.
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

}  // namespace
