// Images of Gaussians: projection, then the blending of every tile.
#pragma once

#include <cstdint>
#include <type_traits>
#include <vector>

#include "blend.h"

namespace {

constexpr double kLog2E = 1.4426950408889634;

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

// The last three channels are written by `project_scene` if the camera asks for normals.
template <class Real> struct Scene {
    int64_t n;
    int channels;
    const Real *means, *quats, *scales, *opacities;

    // The Gaussians of `count` indices, the last again and again to fill the lanes.
    Gaussians gather(const int64_t* at, int count) const {
        Gaussians g;
        for (int lane = 0; lane < kWide; ++lane) {
            const int64_t i = at[std::min(lane, count - 1)];
            for (int k = 0; k < 3; ++k)
                g.mean[k][lane] = means[3 * i + k], g.scale[k][lane] = scales[3 * i + k];
            for (int k = 0; k < 4; ++k) g.quat[k][lane] = quats[4 * i + k];
            g.opacity[lane] = opacities[i];
        }
        return g;
    }
};

// What comes out of the projection of Gaussian i. A box stays empty when nothing can be seen.
template <class Real> struct ProjectedScene {
    Splat<Real>* splats;
    Real* depths;
    Box* boxes;
    Real* colors;

    int64_t write(const View& view, const Projected& g, const int64_t* at, int count,
                  int channels) const {
        const double half = 0.5 * kLog2E, e = view.cam.eps2d;
        Wide level;
        for (int lane = 0; lane < kWide; ++lane) level[lane] = std::log(g.opacity[lane] / kAlphaMin);
        const Wide reach_x = square_root(2.0 * level * (g.xx + e));
        const Wide reach_y = square_root(2.0 * level * (g.yy + e));
        const Wide l11 = square_root(half * g.A), l21 = half * g.B / l11;
        // 1 / (yy + e) is what remains of C after the first column of the Cholesky factor.
        const Wide l22 = square_root(half / (g.yy + e)), cutoff = kLog2E * level + 1e-3;
        int64_t entries = 0;
        for (int lane = 0; lane < count; ++lane) {
            const int64_t i = at[lane];
            Real* const normal = view.cam.normals ? colors + (i + 1) * channels - 3 : nullptr;
            if (normal) std::fill(normal, normal + 3, Real(0));
            boxes[i] = Box{0, 0, 0, 0}, depths[i] = 0;
            if (!(bits(g.front) >> lane & 1) || g.opacity[lane] < kAlphaMin) continue;
            Box reach;
            pixel_range(g.mean2d[0][lane], reach_x[lane], view.cam.width, reach.x0, reach.x1);
            pixel_range(g.mean2d[1][lane], reach_y[lane], view.cam.height, reach.y0, reach.y1);
            if (reach.empty()) continue;
            boxes[i] = reach, depths[i] = Real(g.p[2][lane]);
            splats[i] = Splat<Real>{
                Real(g.mean2d[0][lane]), Real(g.mean2d[1][lane]), Real(l11[lane]), Real(l21[lane]),
                Real(l22[lane]), Real(g.opacity[lane]), Real(cutoff[lane]), Real(g.length[lane]),
                Real(g.slope[0][lane]), Real(g.slope[1][lane])};
            if (normal)
                for (int k = 0; k < 3; ++k) normal[k] = Real(g.normal[k][lane]);
            entries += reach.tiles();
        }
        return entries;
    }
};

// Projects all Gaussians; returns how many tiles they cover, one by one.
template <class Real>
int64_t project_scene(const Camera& cam, const Scene<Real>& scene,
                      const ProjectedScene<Real>& out) {
    const View view(cam);
    int64_t entries = 0;
#pragma omp parallel for num_threads(cam.threads) schedule(static) reduction(+ : entries)
    for (int64_t first = 0; first < scene.n; first += kWide) {
        int64_t at[kWide];
        const int count = int(std::min<int64_t>(kWide, scene.n - first));
        for (int lane = 0; lane < count; ++lane) at[lane] = first + lane;
        Projected g;
        project(view, scene.gather(at, count), g);
        entries += out.write(view, g, at, count, scene.channels);
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

}  // namespace
