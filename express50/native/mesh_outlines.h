// Pairs of neighbouring pixels that an outline of a mesh parts, for antialiasing with derivatives.
//
// Against the background the edges of the outline are drawn, because of several surfaces that end
// between two pixels the last one counts. Inside the picture the nearer surface's own outline is
// sought from its pixel, because only that one hides what is behind it.
#pragma once

#include "mesh.h"

namespace {

constexpr int kWalkSteps = 64;  // faces that one pixel step may cross on its way to an outline

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

// An edge of the mesh's outline that crosses the step from one pixel to its right or lower
// neighbour; `place` runs from the first centre (0) to the second (1).
struct Crossing {
    int64_t pixel;
    int32_t axis, i, j;
    double place;
};

// Adds the steps along one axis that an edge crosses. p and q are its ends, along first.
void add_crossings(const MeshView& view, const double* p, const double* q, int axis, int32_t i,
                   int32_t j, std::vector<Crossing>& out) {
    const int length = axis == 0 ? view.width : view.height;
    const int lines = axis == 0 ? view.height : view.width;
    if (p[1] > q[1]) std::swap(p, q);
    // half open, so that of two edges in a chain just one crosses the line through their vertex
    const int first = int(std::clamp(std::ceil(p[1] - 0.5), 0.0, double(lines)));
    const int last = int(std::clamp(std::ceil(q[1] - 0.5), 0.0, double(lines)));
    for (int line = first; line < last; ++line) {
        const double s = (line + 0.5 - p[1]) / (q[1] - p[1]);
        const double at = p[0] + s * (q[0] - p[0]) - 0.5;
        if (!(at >= 0 && at < length - 1)) continue;
        const int start = int(at);
        const int64_t pixel = axis == 0 ? int64_t(line) * view.width + start
                                        : int64_t(start) * view.width + line;
        out.push_back({pixel, axis, i, j, at - start});
    }
}

// Where the edges that part the mesh from what is beside it cross steps between pixels: the rim of
// the mesh, and edges that both of their faces lie on the same side of.
std::vector<Crossing> rim_crossings(const MeshTable& mesh, int64_t face_count) {
    std::vector<Crossing> out;
    for (int64_t id = 0; id < face_count; ++id) {
        const int32_t* face = mesh.faces + 3 * id;
        if (mesh.planes[id].offset == 0) continue;
        for (int k = 0; k < 3; ++k) {
            const int32_t next = mesh.neighbors[3 * id + k];
            const int32_t i = face[(k + 1) % 3], j = face[(k + 2) % 3];
            if (next >= 0) {
                if (next < id) continue;  // the other face has had its turn
                const int32_t third = opposite(mesh.faces + 3 * int64_t(next), i, j);
                if (third < 0 || !(dot3(mesh.planes[id].edge[k], mesh.xyz + 3 * int64_t(third)) > 0))
                    continue;
            }
            const double *a = mesh.xyz + 3 * int64_t(i), *b = mesh.xyz + 3 * int64_t(j);
            if (a[2] < mesh.view.near || b[2] < mesh.view.near) continue;
            double p[2], q[2];
            project_mesh(mesh.view, a, p[0], p[1]);
            project_mesh(mesh.view, b, q[0], q[1]);
            add_crossings(mesh.view, p, q, 0, i, j, out);
            std::swap(p[0], p[1]), std::swap(q[0], q[1]);
            add_crossings(mesh.view, p, q, 1, i, j, out);
        }
    }
    return out;
}

inline void write_pair(int32_t* pair, int64_t near, int64_t far, int32_t i, int32_t j) {
    pair[0] = int32_t(near), pair[1] = int32_t(far);
    pair[2] = std::min(i, j), pair[3] = std::max(i, j);
}

// Pairs of a covered and an empty pixel. Several surfaces may end between them; the one that ends
// last is seen.
int64_t rim_pairs(const MeshTable& mesh, int64_t face_count, const int32_t* face_id,
                  int32_t* pairs) {
    std::vector<Crossing> all = rim_crossings(mesh, face_count);
    const auto outer = [&](const Crossing& c) {  // from the covered pixel on
        return face_id[c.pixel] >= 0 ? c.place : 1 - c.place;
    };
    std::sort(all.begin(), all.end(), [&](const Crossing& a, const Crossing& b) {
        if (a.pixel != b.pixel) return a.pixel < b.pixel;
        if (a.axis != b.axis) return a.axis < b.axis;
        if (outer(a) != outer(b)) return outer(a) > outer(b);
        return std::pair(a.i, a.j) < std::pair(b.i, b.j);
    });
    int64_t count = 0;
    for (size_t k = 0; k < all.size(); ++k) {
        const Crossing& c = all[k];
        if (k > 0 && all[k - 1].pixel == c.pixel && all[k - 1].axis == c.axis) continue;
        int64_t near = c.pixel, far = c.pixel + (c.axis == 0 ? 1 : mesh.view.width);
        if ((face_id[near] >= 0) == (face_id[far] >= 0)) continue;
        if (face_id[near] < 0) std::swap(near, far);
        if (crosses_steeply(mesh, c.i, c.j, c.axis == 0))
            write_pair(pairs + 4 * count++, near, far, c.i, c.j);
    }
    return count;
}

// Pairs of two covered pixels with an outline of the nearer surface between them.
int64_t inner_pairs(const MeshTable& mesh, const int32_t* face_id, const float* depth,
                    int32_t* pairs) {
    const MeshView& view = mesh.view;
    const std::vector<double> xs = ray_axis(view.width, view.fx, view.cx);
    const std::vector<double> ys = ray_axis(view.height, view.fy, view.cy);
    int64_t count = 0;
    for (int y = 0; y < view.height; ++y)
        for (int x = 0; x < view.width; ++x)
            for (int axis = 0; axis < 2; ++axis) {
                const int x2 = x + (axis == 0), y2 = y + (axis == 1);
                if (x2 >= view.width || y2 >= view.height) continue;
                int64_t at = int64_t(y) * view.width + x, other = int64_t(y2) * view.width + x2;
                if (face_id[at] == face_id[other] || face_id[at] < 0 || face_id[other] < 0)
                    continue;
                Ray from{xs[x], ys[y]}, to{xs[x2], ys[y2]};
                if (depth[other] < depth[at]) {
                    std::swap(at, other);
                    std::swap(from, to);
                }
                WalkEnd end = walk_to_outline(mesh, face_id[at], from, to);
                // A surface that goes on behind the other pixel's is hidden by that one's outline.
                if (end.i < 0 && end.face != face_id[other]) {
                    std::swap(at, other);
                    end = walk_to_outline(mesh, face_id[at], to, from);
                }
                if (end.i >= 0 && crosses_steeply(mesh, end.i, end.j, axis == 0))
                    write_pair(pairs + 4 * count++, at, other, end.i, end.j);
            }
    return count;
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
    const int64_t rim = rim_pairs(mesh, face_count, face_id, pairs);
    return rim + inner_pairs(mesh, face_id, depth, pairs + 4 * rim);
}

}  // namespace
