// Differentiable rasterisation of 3D Gaussians on the CPU, behind a plain C ABI; the z-buffer of
// meshes (mesh*.h) is exported here too, so that one library holds all that is native.
//
// forward:  gaussians_project -> gaussians_bin -> gaussians_forward
// backward: gaussians_backward
// The caller owns all memory (grmm/rasterize/cpu.py). Every sum is taken in an order that does not
// depend on the number of threads: tiles write records of their own, which are then added for each
// Gaussian by ascending tile, so images and gradients are the same bits on any number of threads.
// That is done for a band of tiles at a time: all records of a large image would fill the cache.
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <cstdint>
#include <type_traits>
#include <vector>

#include "blend_gradient.h"
#include "mesh_outlines.h"
#include "mesh_rows.h"

namespace {

constexpr double kLog2E = 1.4426950408889634;
constexpr int64_t kChunk = 256;  // Gaussians whose camera gradients are added up together
constexpr int64_t kBandTiles = 16;  // tiles of a band for each thread, at least
constexpr uint32_t kShare = 64;     // neighbouring Gaussians whose records one thread adds up
constexpr int kMoments = 9;         // numbers in Moments

int tile_columns(const Camera& cam) { return (cam.width + kTile - 1) / kTile; }
int tile_rows(const Camera& cam) { return (cam.height + kTile - 1) / kTile; }

TileFrame tile_frame(const Camera& cam, int64_t tile) {
    TileFrame f;
    f.left = int(tile % tile_columns(cam)) * kTile;
    f.top = int(tile / tile_columns(cam)) * kTile;
    f.width = std::min(kTile, cam.width - f.left);
    f.height = std::min(kTile, cam.height - f.top);
    return f;
}

// Pixels [first, last) of one axis whose centres lie within `extent` of `mean`, with a margin for
// the rounding of the mean to Real.
void pixel_range(double mean, double extent, int size, int32_t& first, int32_t& last) {
    const double reach = extent + 0.01 + 1e-6 * std::abs(mean);
    first = int32_t(std::clamp(std::ceil(mean - reach - 0.5), 0.0, double(size)));
    last = int32_t(std::clamp(std::floor(mean + reach - 0.5) + 1, 0.0, double(size)));
}

// The last three channels are written by `project` if the camera asks for normals.
template <class Real> struct Scene {
    int64_t n;
    int channels;
    const Real *means, *quats, *scales, *opacities;
};

// Projects one Gaussian for the blending; its box stays empty when it cannot be seen.
template <class Real>
void project_splat(const View& view, const Scene<Real>& scene, int64_t i, Splat<Real>& splat,
                   Real& depth, Box& box, Real* normal) {
    Projected g;
    project_one(view, scene.means + 3 * i, scene.quats + 4 * i, scene.scales + 3 * i,
                scene.opacities[i], g);
    if (!g.front || g.opacity < kAlphaMin) return;
    const double level = std::log(g.opacity / kAlphaMin), e = view.cam.eps2d;
    Box reach;
    pixel_range(g.mean2d[0], std::sqrt(2 * level * (g.xx + e)), view.cam.width, reach.x0, reach.x1);
    pixel_range(g.mean2d[1], std::sqrt(2 * level * (g.yy + e)), view.cam.height, reach.y0,
                reach.y1);
    if (reach.empty()) return;
    box = reach;
    depth = Real(g.p[2]);
    const double half = 0.5 * kLog2E, root = std::sqrt(half * g.A);
    // 1 / (yy + e) is what remains of C after the first column of the Cholesky factor.
    splat = Splat<Real>{Real(g.mean2d[0]), Real(g.mean2d[1]), Real(root),
                        Real(half * g.B / root), Real(std::sqrt(half / (g.yy + e))),
                        Real(g.opacity), Real(kLog2E * level + 1e-3), Real(g.length),
                        Real(g.slope[0]), Real(g.slope[1])};
    if (normal) std::copy_n(g.normal, 3, normal);
}

template <class Real>
int64_t project(const Camera& cam, const Scene<Real>& scene, Splat<Real>* splats, Real* depths,
                Box* boxes, Real* colors) {
    const View view(cam);
    int64_t entries = 0;
#pragma omp parallel for num_threads(cam.threads) schedule(static) reduction(+ : entries)
    for (int64_t i = 0; i < scene.n; ++i) {
        Real* normal = cam.normals ? colors + (i + 1) * scene.channels - 3 : nullptr;
        if (normal) std::fill(normal, normal + 3, Real(0));
        boxes[i] = Box{0, 0, 0, 0};
        depths[i] = 0;
        project_splat(view, scene, i, splats[i], depths[i], boxes[i], normal);
        entries += boxes[i].tiles();
    }
    return entries;
}

// Calls f(std::integral_constant<int, CV>) with the layout that fits the number of channels:
// -1 planar, 1..6 channel vectors known to the compiler, 0 any number.
template <class Real, class F> void with_layout(int channels, F&& f) {
    if (channels <= kPlanarMax) return f(std::integral_constant<int, -1>{});
    if (sizeof(Real) == 8) return f(std::integral_constant<int, 0>{});  // for tests: compile less
    switch (channel_vectors<Real>(channels)) {
        case 1: return f(std::integral_constant<int, 1>{});
        case 2: return f(std::integral_constant<int, 2>{});
        case 3: return f(std::integral_constant<int, 3>{});
        case 4: return f(std::integral_constant<int, 4>{});
        case 5: return f(std::integral_constant<int, 5>{});
        case 6: return f(std::integral_constant<int, 6>{});
        default: return f(std::integral_constant<int, 0>{});
    }
}

// Takes the colours of the pixels of a tile to the image; CV as for with_layout.
template <class Real, int CV>
void store_colors(const Workspace<Real>& w, const Camera& cam, const TileFrame& tile,
                  const Real* background, Real* image) {
    const int channels = w.channels;
    const std::vector<Real> black(channels, Real(0));
    const Real* behind = background ? background : black.data();
    VecOf<Real> color[std::max(CV, 1)], backdrop[std::max(CV, 1)];
    if constexpr (CV > 0) load_color<Real, CV>(behind, channels, backdrop);
    for (int y = 0; y < tile.height; ++y)
        for (int x = 0; x < tile.width; ++x) {
            const int at = Block<Real>::place(x, y);
            const Real through = Real(1) - w.alpha[at];
            Real* to = image + tile.pixel(cam, x, y) * channels;
            const Real* from = w.pixels.data() + (CV < 0 ? at : at * w.stride);
            if constexpr (CV > 0) {
                for (int k = 0; k < CV; ++k)
                    color[k] = load(from + k * Lanes<Real>::N) + through * backdrop[k];
                store_color<Real, CV>(to, channels, color);
            } else {
                for (int c = 0; c < channels; ++c)
                    to[c] = from[CV < 0 ? c * kPixels : c] + through * behind[c];
            }
        }
}

// Takes the gradient of the colours of the pixels of a tile to the workspace. The background is
// seen through 1 - alpha, so its part joins the gradient of alpha.
template <class Real, int CV>
void load_color_gradients(Workspace<Real>& w, const Camera& cam, const TileFrame& tile,
                          const Real* background, const Real* d_image) {
    const int channels = w.channels;
    VecOf<Real> color[std::max(CV, 1)];
    for (int y = 0; y < tile.height; ++y)
        for (int x = 0; x < tile.width; ++x) {
            const int at = Block<Real>::place(x, y);
            const Real* from = d_image + tile.pixel(cam, x, y) * channels;
            Real* to = w.pixels.data() + (CV < 0 ? at : at * w.stride);
            if constexpr (CV > 0) {
                load_color<Real, CV>(from, channels, color);
                for (int k = 0; k < CV; ++k) store(to + k * Lanes<Real>::N, color[k]);
            } else {
                for (int c = 0; c < channels; ++c) to[CV < 0 ? c * kPixels : c] = from[c];
            }
            if (background)
                for (int c = 0; c < channels; ++c) w.alpha[at] -= from[c] * background[c];
        }
}

template <class Real>
void forward(const Camera& cam, int channels, const Splat<Real>* splats, const Box* boxes,
                const Real* colors, const Real* background, const int64_t* starts, int32_t* ids,
                int32_t* used, Real* image, Real* weighted, Real* alpha, Real* median) {
    const int64_t tiles = int64_t(tile_columns(cam)) * tile_rows(cam);
#pragma omp parallel num_threads(cam.threads)
    {
        Workspace<Real> w(channels, median != nullptr);
#pragma omp for schedule(dynamic)
        for (int64_t i = 0; i < tiles; ++i) {
            const TileFrame tile = tile_frame(cam, i);
            with_layout<Real>(channels, [&](auto layout) {
                constexpr int CV = decltype(layout)::value;
                used[i] = blend_tile<Real, CV>(w, tile, splats, boxes, colors, ids + starts[i],
                                               starts[i + 1] - starts[i]);
                store_colors<Real, CV>(w, cam, tile, background, image);
            });
            for (int y = 0; y < tile.height; ++y)
                for (int x = 0; x < tile.width; ++x) {
                    const int at = Block<Real>::place(x, y);
                    const int64_t to = tile.pixel(cam, x, y);
                    alpha[to] = w.alpha[at], weighted[to] = w.weighted[at];
                    if (median) median[to] = w.median[at];
                }
        }
    }
}

// Gradients of the pixels of one tile, in the layout of the workspace.
template <class Real, int CV>
void load_gradients(Workspace<Real>& w, const Camera& cam, const TileFrame& tile,
                    const Real* background, const Real* d_image, const Real* d_weighted,
                    const Real* d_alpha, const Real* d_median) {
    if (!d_image) w.pixels.clear();
    std::fill(w.alpha, w.alpha + kPixels, Real(0));
    std::fill(w.weighted, w.weighted + kPixels, Real(0));
    std::fill(w.median, w.median + kPixels, Real(0));
    for (int y = 0; y < tile.height; ++y)
        for (int x = 0; x < tile.width; ++x) {
            const int64_t from = tile.pixel(cam, x, y);
            const int at = Block<Real>::place(x, y);
            if (d_alpha) w.alpha[at] = d_alpha[from];
            if (d_weighted) w.weighted[at] = d_weighted[from];
            if (d_median) w.median[at] = d_median[from];
        }
    if (d_image) load_color_gradients<Real, CV>(w, cam, tile, background, d_image);
}

// Gradient by the projected Gaussian from its summed moments.
template <class Real>
SplatGradient splat_gradient(const Projected& g, const double* m) {
    SplatGradient d;
    d.mean2d[0] = -(g.A * m[1] + g.B * m[2]) - g.slope[0] * m[6];
    d.mean2d[1] = -(g.B * m[1] + g.C * m[2]) - g.slope[1] * m[6];
    d.conic[0] = 0.5 * m[3], d.conic[1] = m[4], d.conic[2] = 0.5 * m[5];
    d.opacity = -m[0] / g.opacity;
    d.length = m[6], d.slope[0] = m[7], d.slope[1] = m[8];
    return d;
}

template <class Real> struct SceneGradient {
    Real *means, *quats, *scales, *opacities, *colors;
};

// Sums over the tiles of what the gradient of each Gaussian needs.
template <class Real> struct Totals {
    Real* colors;     // (n, channels)
    double* moments;  // (n, kMoments)
    std::vector<uint8_t> reached;  // whether anything was added

    template <int CV>
    void add(int64_t i, const Real* color, int channels, const Moments<Real>& record) {
        Real* const to = colors + i * channels;
        double* const total = moments + i * kMoments;
        const Real* const values = &record.s;
        const bool first = !reached[i];
        reached[i] = 1;
        if (first) std::fill(total, total + kMoments, 0.0);
        for (int k = 0; k < kMoments; ++k) total[k] += values[k];
        if constexpr (CV > 0) {
            VecOf<Real> a[CV], b[CV];
            load_color<Real, CV>(color, channels, a);
            if (!first) {
                load_color<Real, CV>(to, channels, b);
                for (int k = 0; k < CV; ++k) a[k] += b[k];
            }
            store_color<Real, CV>(to, channels, a);
        } else {
            for (int c = 0; c < channels; ++c) to[c] = first ? color[c] : to[c] + color[c];
        }
    }
};

// Takes the sums of one Gaussian through the projection.
template <class Real>
void finish_gaussian(const View& view, const Scene<Real>& scene, int64_t i,
                     const Totals<Real>& totals, const SceneGradient<Real>& out,
                     CameraGradient& d_cam) {
    const int channels = scene.channels;
    Real* const color = out.colors + i * channels;
    double mean[3] = {}, quat[4] = {}, scale[3] = {}, opacity = 0;
    if (totals.reached[i]) {
        Projected g;
        project_one(view, scene.means + 3 * i, scene.quats + 4 * i, scene.scales + 3 * i,
                    scene.opacities[i], g);
        SplatGradient d = splat_gradient<Real>(g, totals.moments + i * kMoments);
        if (view.cam.normals) std::copy_n(color + channels - 3, 3, d.normal);
        project_gradient(view, scene.means + 3 * i, scene.scales + 3 * i, scene.opacities[i], g, d,
                         mean, quat, scale, &opacity, d_cam);
    } else {
        std::fill(color, color + channels, Real(0));
    }
    std::copy_n(mean, 3, out.means + 3 * i);
    std::copy_n(quat, 4, out.quats + 4 * i);
    std::copy_n(scale, 3, out.scales + 3 * i);
    out.opacities[i] = Real(opacity);
}

// Tiles [begin, end) whose records are written, then added up, before the next are begun: few
// enough for the cache, enough for all threads.
struct Bands {
    int64_t tiles, step;
    std::vector<int64_t> first;  // record of each tile

    Bands(const Camera& cam, const int32_t* used)
        : tiles(int64_t(tile_columns(cam)) * tile_rows(cam)),
          step(std::max<int64_t>(tile_columns(cam), kBandTiles * cam.threads)),
          first(tiles + 1, 0) {
        for (int64_t i = 0; i < tiles; ++i) first[i + 1] = first[i] + used[i];
    }
    int64_t end(int64_t begin) const { return std::min(begin + step, tiles); }
    int64_t most_records() const {
        int64_t most = 0;
        for (int64_t i = 0; i < tiles; i += step) most = std::max(most, first[end(i)] - first[i]);
        return most;
    }
};

template <class Real>
void backward(const Camera& cam, const Scene<Real>& scene, const Splat<Real>* splats,
              const Box* boxes, const Real* colors, const Real* background, const int64_t* starts,
              const int32_t* ids, const int32_t* used, const Real* d_image,
              const Real* d_weighted, const Real* d_alpha, const Real* d_median,
              double* moments, const SceneGradient<Real>& out, CameraGradient* d_cam) {
    const int64_t n = scene.n;
    const int channels = scene.channels;
    const uint32_t threads = cam.threads;
    const Bands bands(cam, used);
    Lines<Real> color_records(bands.most_records() * channels);
    std::vector<Moments<Real>> records(bands.most_records());
    Totals<Real> totals{out.colors, moments, std::vector<uint8_t>(n, 0)};
#pragma omp parallel num_threads(threads)
    {
        Workspace<Real> w(channels, d_median != nullptr);
        for (int64_t begin = 0; begin < bands.tiles; begin += bands.step) {
            const int64_t end = bands.end(begin), *first = bands.first.data();
#pragma omp for schedule(dynamic)
            for (int64_t i = begin; i < end; ++i) {
                if (!used[i]) continue;
                const TileFrame tile = tile_frame(cam, i);
                const int64_t at = first[i] - first[begin];
                with_layout<Real>(channels, [&](auto layout) {
                    constexpr int CV = decltype(layout)::value;
                    load_gradients<Real, CV>(w, cam, tile, background, d_image, d_weighted, d_alpha,
                                             d_median);
                    blend_tile_gradient<Real, CV>(
                        w, tile, splats, boxes, colors, ids + starts[i], used[i],
                        color_records.data() + at * channels, records.data() + at);
                });
            }
            // Each Gaussian's by one thread and in the order of the tiles.
#pragma omp for schedule(static, 1)
            for (uint32_t part = 0; part < threads; ++part)
                with_layout<Real>(channels, [&](auto layout) {
                    int64_t at = 0;
                    for (int64_t i = begin; i < end; ++i)
                        for (int32_t k = 0; k < used[i]; ++k, ++at)
                            if (const uint32_t id = ids[starts[i] + k];
                                id / kShare % threads == part)
                                totals.template add<decltype(layout)::value>(
                                    id, color_records.data() + at * channels, channels,
                                    records[at]);
                });
        }
    }
    const View view(cam);
    const int64_t chunks = (n + kChunk - 1) / kChunk;
    std::vector<CameraGradient> partial(chunks, CameraGradient{});
#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int64_t chunk = 0; chunk < chunks; ++chunk)
        for (int64_t i = chunk * kChunk; i < std::min(n, (chunk + 1) * kChunk); ++i)
            finish_gaussian(view, scene, i, totals, out, partial[chunk]);
    double* total = &d_cam->fx;
    for (const CameraGradient& part : partial)
        for (int k = 0; k < 16; ++k) total[k] += (&part.fx)[k];
}

}  // namespace

#define EXPRESS50_EXPORT extern "C" __attribute__((visibility("default")))

#define EXPRESS50_GAUSSIANS(Real, suffix)                                                         \
    EXPRESS50_EXPORT int64_t gaussians_project_##suffix(                                          \
        const Camera* cam, int64_t n, int64_t channels, const Real* means, const Real* quats,     \
        const Real* scales, const Real* opacities, Splat<Real>* splats, Real* depths, Box* boxes, \
        Real* colors) {                                                                           \
        return project<Real>(*cam, {n, int(channels), means, quats, scales, opacities}, splats,   \
                             depths, boxes, colors);                                              \
    }                                                                                             \
    EXPRESS50_EXPORT void gaussians_bin_##suffix(const Camera* cam, int64_t n,                    \
                                                 const Real* depths, const Box* boxes,            \
                                                 int64_t* starts, int32_t* ids) {                 \
        bin_into_tiles<Real>(n, depths, boxes, tile_columns(*cam), tile_rows(*cam), starts, ids); \
    }                                                                                             \
    EXPRESS50_EXPORT void gaussians_forward_##suffix(                                             \
        const Camera* cam, int64_t channels, const Splat<Real>* splats, const Box* boxes,         \
        const Real* colors, const Real* background, const int64_t* starts, int32_t* ids,          \
        int32_t* used, Real* image, Real* weighted, Real* alpha, Real* median) {                  \
        forward<Real>(*cam, int(channels), splats, boxes, colors, background, starts, ids, used,  \
                      image, weighted, alpha, median);                                            \
    }                                                                                             \
    EXPRESS50_EXPORT void gaussians_backward_##suffix(                                            \
        const Camera* cam, int64_t n, int64_t channels, const Real* means, const Real* quats,     \
        const Real* scales, const Real* opacities, const Splat<Real>* splats, const Box* boxes,   \
        const Real* colors, const Real* background, const int64_t* starts, const int32_t* ids,    \
        const int32_t* used, const Real* d_image, const Real* d_weighted, const Real* d_alpha,    \
        const Real* d_median, double* moments, Real* d_means, Real* d_quats, Real* d_scales,      \
        Real* d_opacities, Real* d_colors, CameraGradient* d_cam) {                               \
        backward<Real>(*cam, {n, int(channels), means, quats, scales, opacities}, splats, boxes,  \
                       colors, background, starts, ids, used, d_image, d_weighted, d_alpha,       \
                       d_median, moments,                                                         \
                       {d_means, d_quats, d_scales, d_opacities, d_colors}, d_cam);               \
    }

EXPRESS50_GAUSSIANS(float, f32)
EXPRESS50_GAUSSIANS(double, f64)

EXPRESS50_EXPORT void mesh_rasterize(const MeshView* view, const double* xyz, int64_t face_count,
                                     const int32_t* faces, int32_t* face_id, float* depth) {
    mesh_zbuffer(*view, xyz, face_count, faces, face_id, depth);
}

EXPRESS50_EXPORT int64_t mesh_pairs(const MeshView* view, const double* xyz, int64_t face_count,
                                    const int32_t* faces, const int32_t* neighbors,
                                    const int32_t* face_id, const float* depth, int32_t* pairs) {
    return mesh_outline_pairs(*view, xyz, face_count, faces, neighbors, face_id, depth, pairs);
}

#define EXPRESS50_MESH_ROWS(Real, suffix)                                                         \
    EXPRESS50_EXPORT void mesh_weigh_##suffix(int64_t n, int64_t channels, const Real* rows,      \
                                              const Real* coefficients, const int64_t* group,     \
                                              Real* out) {                                        \
        weigh_rows<Real>(n, channels, rows, coefficients, group, out);                            \
    }                                                                                             \
    EXPRESS50_EXPORT void mesh_weigh_gradient_##suffix(                                           \
        int64_t n, int64_t channels, const Real* rows, const Real* coefficients,                  \
        const int64_t* group, const Real* gradient, Real* d_rows, Real* d_coefficients) {         \
        weigh_rows_gradient<Real>(n, channels, rows, coefficients, group, gradient, d_rows,       \
                                  d_coefficients);                                                \
    }

EXPRESS50_MESH_ROWS(float, f32)
EXPRESS50_MESH_ROWS(double, f64)

// Asks for huge pages inside [start, start + bytes); where there are none nothing happens.
EXPRESS50_EXPORT void native_huge_pages(void* start, int64_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    constexpr uintptr_t kPage = 4096;
    const uintptr_t from = (uintptr_t(start) + kPage - 1) / kPage * kPage;
    const uintptr_t to = (uintptr_t(start) + uintptr_t(bytes)) / kPage * kPage;
    if (to > from) madvise(reinterpret_cast<void*>(from), to - from, MADV_HUGEPAGE);
#else
    (void)start, (void)bytes;
#endif
}

// Which source this library was compiled from, so that a stale one is noticed.
EXPRESS50_EXPORT const char* native_digest() { return EXPRESS50_DIGEST; }

// Instruction sets of this processor that a variant exists for: 2 AVX-512, 1 AVX2 with FMA, 0 none.
EXPRESS50_EXPORT int native_level() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
        return 2;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return 1;
#endif
    return 0;
}
