// Derivative of the blending of one tile.
//
// It replays the blending front to back, which gives every weight without dividing by 1 - alpha,
// and then needs only one number for each hit on the way back: the sum over the Gaussians behind of
// weight * <colour, gradient of the pixel>.
#pragma once

#include "blend.h"

// Sums over the pixels of a tile that the gradient of one Gaussian needs, colours apart.
// s: gradient by sigma; w: gradient by the ray length.
template <class Real> struct Moments {
    Real s, sx, sy, sxx, sxy, syy, w, wx, wy;
};

// Takes the list's value = <colour, pixel gradient>, and writes the gradient of the
// colour, the sum of weight * pixel gradient.
template <class Real, int CV>
inline void gather_colors(Workspace<Real>& w, const Real* color, Real* gradient) {
    constexpr int N = Lanes<Real>::N;
    using V = VecOf<Real>;
    const Real* const pixels = w.pixels.data();
    const int count = w.list.count;
    if constexpr (CV > 0) {
        V c[CV], total[CV] = {};
        load_color<Real, CV>(color, w.channels, c);
        const auto take = [&](int h) {
            const V weight = broadcast(w.list.weight[h]);
            const Real* const pixel = pixels + w.list.at[h] * CV * N;
            V dot = V{};
            for (int k = 0; k < CV; ++k) {
                const V g = load(pixel + k * N);
                dot += g * c[k];
                total[k] += weight * g;
            }
            return dot;
        };
        int h = 0;
        for (; h + 4 <= count; h += 4) {
            const V dots[4] = {take(h), take(h + 1), take(h + 2), take(h + 3)};
            sum_four<Real>(dots, w.list.value + h);
        }
        for (; h < count; ++h) w.list.value[h] = sum<Real>(take(h));
        store_color<Real, CV>(gradient, w.channels, total);
    } else {
        std::copy(color, color + w.channels, w.color.begin());
        std::fill(w.color_gradient.begin(), w.color_gradient.end(), Real(0));
        for (int h = 0; h < count; ++h) {
            const int at = w.list.at[h];
            const V weight = broadcast(w.list.weight[h]);
            const Real* const pixel = pixels + size_t(at) * w.stride;
            V dot = V{};
            for (int k = 0; k < w.stride; k += N) {
                const V g = load(pixel + k);
                dot += g * load(&w.color[k]);
                store(&w.color_gradient[k], load(&w.color_gradient[k]) + weight * g);
            }
            w.list.value[h] = sum<Real>(dot);
        }
        std::copy_n(w.color_gradient.begin(), w.channels, gradient);
    }
}

// The first way: front to back over one Gaussian. Appends its hits to w.hits from `hits` on, writes
// its colour gradient and the moments by ray length, and returns the new number of hits.
template <class Real, int CV>
inline size_t replay(Workspace<Real>& w, const TileFrame& tile, const Centers<Real>& centers,
                     const Splat<Real>& s, const Box& box, const Real* color, size_t hits, Real* color_gradient,
                     Moments<Real>& m) {
    using V = VecOf<Real>;
    V planar[CV < 0 ? kPlanarMax : 1] = {};
    V depth = V{}, depth_x = V{}, depth_y = V{};
    w.list.count = 0;
    const size_t first = hits;
    walk(s, box, tile, centers, w.transmittance, [&](const Hit<Real>& hit) {
        const int at = hit.position();
        const V weight = hit.alpha * hit.before, by_depth = load(w.weighted + at);
        V value = load(w.alpha + at) + by_depth * hit.length(s);
        V by_length = weight * by_depth;
        if (w.wants_median) by_length += choose(hit.crosses(), load(w.median + at), V{});
        depth += by_length, depth_x += by_length * hit.dx, depth_y += by_length * hit.dy;
        if (CV >= 0) {
            store(w.before + at, hit.before);
            w.list.add(at, hit.lanes, weight);
        } else {
            for (int c = 0; c < w.channels; ++c) {
                const V g = load(w.pixels.data() + c * kPixels + at);
                value += color[c] * g;
                planar[c] += weight * g;
            }
            value *= hit.before;
        }
        w.where[hits] = {hit.block, hit.lanes};
        w.hits[hits++] = {hit.alpha, value};
    });
    m.w = sum<Real>(depth), m.wx = sum<Real>(depth_x), m.wy = sum<Real>(depth_y);
    if (CV < 0) {
        for (int c = 0; c < w.channels; ++c) color_gradient[c] = sum<Real>(planar[c]);
        return hits;
    }
    gather_colors<Real, (CV > 0 ? CV : 0)>(w, color, color_gradient);
    const Real* value = w.list.value;
    for (size_t h = first; h < hits; ++h) {
        const auto [block, lanes] = w.where[h];
        Real* const before = w.before + block * Lanes<Real>::N;
        w.hits[h].flow = load(before) * (w.hits[h].flow + unpack<Real>(lanes, value));
        value += __builtin_popcount(lanes);
    }
    return hits;
}

// The second way: back to front over the hits [first, last) of one Gaussian, for its moments by
// sigma. w.suffix holds the sums over the Gaussians behind.
template <class Real>
inline void retreat(Workspace<Real>& w, const Centers<Real>& centers, const Splat<Real>& splat,
                    size_t first, size_t last, Moments<Real>& m) {
    using V = VecOf<Real>;
    using B = Block<Real>;
    V s = V{}, sx = V{}, sy = V{}, sxx = V{}, sxy = V{}, syy = V{};
    for (size_t h = first; h < last; ++h) {
        const auto& hit = w.hits[h];
        const int block = w.where[h].block;
        Real* const suffix = w.suffix + block * B::N;
        const V behind = load(suffix);
        const V by_alpha = hit.flow - behind / (Real(1) - hit.alpha);
        store(suffix, behind + hit.alpha * hit.flow);
        // No gradient flows through an alpha that was capped.
        const V by_sigma = hit.alpha < Real(kAlphaMax) ? -hit.alpha * by_alpha : V{};
        const V dx = centers.x[block % B::columns] - splat.x;
        const V dy = centers.y[block / B::columns] - splat.y;
        const V by_dx = by_sigma * dx, by_dy = by_sigma * dy;
        s += by_sigma, sx += by_dx, sy += by_dy;
        sxx += by_dx * dx, sxy += by_dx * dy, syy += by_dy * dy;
    }
    m.s = sum<Real>(s), m.sx = sum<Real>(sx), m.sy = sum<Real>(sy);
    m.sxx = sum<Real>(sxx), m.sxy = sum<Real>(sxy), m.syy = sum<Real>(syy);
}

// Derivative of blend_tile. w.pixels, w.weighted, w.alpha and w.median hold the gradients of the
// pixels. Writes one record for each Gaussian: its colour gradient and its moments.
template <class Real, int CV>
void blend_tile_gradient(Workspace<Real>& w, const TileFrame& tile, const Splat<Real>* splats,
                         const Box* boxes, const Real* colors, const int32_t* ids, int used,
                         Real* color_records, Moments<Real>* moments) {
    constexpr size_t most = kPixels / Lanes<Real>::N;  // hits of one Gaussian in a tile
    const Centers<Real> centers(tile);
    start_tile(tile, w.transmittance);
    w.hit_start.assign(1, 0);
    size_t hits = 0;
    for (int i = 0; i < used; ++i) {
        if (w.hits.size() < hits + most)
            w.hits.resize(2 * (hits + most)), w.where.resize(2 * (hits + most));
        prefetch(splats, boxes, colors, w.channels, ids[std::min(i + kAhead, used - 1)]);
        hits = replay<Real, CV>(w, tile, centers, splats[ids[i]], boxes[ids[i]],
                                colors + int64_t(ids[i]) * w.channels, hits,
                                color_records + int64_t(i) * w.channels, moments[i]);
        w.hit_start.push_back(hits);
    }
    std::fill(w.suffix, w.suffix + kPixels, Real(0));
    for (int i = used - 1; i >= 0; --i)
        retreat(w, centers, splats[ids[i]], w.hit_start[i], w.hit_start[i + 1], moments[i]);
}
