// Front-to-back blending of one 16 x 16 tile and its derivative.
//
// Alphas are computed for a vector of neighbouring pixels of one row at a time. Few channels
// (<= kPlanarMax) are blended in the same layout; many are blended pixel by pixel, as vectors over
// channels, for the lanes that were hit. The derivative replays the blending front to back, which
// gives every weight without dividing by 1 - alpha, and then needs only one number for each hit on
// the way back: sum over the Gaussians behind of weight * <colour, gradient of the pixel>.
#pragma once

#include <algorithm>
#include <vector>

#include "lanes.h"
#include "projection.h"
#include "tiles.h"

constexpr int kPixels = kTile * kTile;
constexpr int kPlanarMax = 8;
constexpr int kAhead = 6;  // Gaussians of a tile are fetched into the cache this far in advance

// What blending reads of one Gaussian. sigma = (l11 dx + l21 dy)^2 + (l22 dy)^2: the Cholesky factor
// of half the conic. A sum of squares neither cancels nor turns negative for needles.
template <class Real> struct Splat {
    Real x, y, l11, l21, l22, opacity, cutoff, length, slope_u, slope_v;
};

struct TileFrame {
    int left, top, width, height;  // pixels; width and height are cut at the image's border
};

// Pixel vectors of one row that a box needs.
template <class Real> struct Span {
    int y0, y1, j0, j1;
    Span(const Box& box, const TileFrame& tile) {
        constexpr int N = Lanes<Real>::N;
        y0 = std::max(box.y0 - tile.top, 0);
        y1 = std::min(box.y1 - tile.top, tile.height);
        j0 = std::max(box.x0 - tile.left, 0) / N;
        j1 = (std::min(box.x1 - tile.left, tile.width) + N - 1) / N;
    }
};

// Centres, in pixels of the image, of the row y of a tile and of a vector that starts at column x.
template <class Real> inline Real pixel_y(const TileFrame& tile, int y) {
    return Real(tile.top + y) + Real(0.5);
}

template <class Real> inline VecOf<Real> pixel_x(const TileFrame& tile, int x) {
    VecOf<Real> lane;
    for (int i = 0; i < Lanes<Real>::N; ++i) lane[i] = Real(i) + Real(0.5);
    return lane + Real(tile.left + x);
}

// One pixel vector of one Gaussian that received light.
template <class Real> struct Hit {
    VecOf<Real> dx, alpha, before;  // before: transmittance in front of the Gaussian; alpha 0 = miss
    Real dy;
    int position;  // pixel index of the first lane
    unsigned lanes;
};

// Walks one Gaussian over a tile. Updates the transmittance (negative: the pixel is finished),
// calls visit(hit) for every vector with a contribution and returns how many pixels finished.
template <class Real, class Visit>
inline int walk(const Splat<Real>& s, const Box& box, const TileFrame& tile, Real* transmittance,
                Visit&& visit) {
    using V = VecOf<Real>;
    constexpr int N = Lanes<Real>::N;
    const Span<Real> span(box, tile);
    const V cutoff = broadcast(s.cutoff), zero = V{};
    const V capped = broadcast(Real(kAlphaMax)), floor = broadcast(Real(-80));
    int finished = 0;
    for (int y = span.y0; y < span.y1; ++y) {
        const Real dy = pixel_y<Real>(tile, y) - s.y;
        const Real across = s.l22 * dy, base = across * across, shear = s.l21 * dy;
        if (base > s.cutoff) continue;
        for (int j = span.j0; j < span.j1; ++j) {
            Real* place = transmittance + y * kTile + j * N;
            const V before = load(place);
            const V dx = pixel_x<Real>(tile, j * N) - s.x;
            const V along = s.l11 * dx + shear;
            const V sigma = along * along + base;
            MaskOf<Real> hit = (sigma <= cutoff) & (before > zero);
            if (!bits(hit)) continue;
            const V negative = -sigma;
            V alpha = s.opacity * exp_negative<Real>(negative > floor ? negative : floor);
            alpha = alpha < capped ? alpha : capped;
            hit &= alpha >= Real(kAlphaMin);
            const V after = before * (Real(1) - alpha);
            const MaskOf<Real> stop = hit & (after <= Real(kTransmittanceMin));
            const MaskOf<Real> keep = hit & ~stop;
            store(place, stop ? -before : (keep ? after : before));
            finished += __builtin_popcount(bits(stop));
            const unsigned lanes = bits(keep);
            if (lanes)
                visit(Hit<Real>{dx, keep ? alpha : zero, before, dy, y * kTile + j * N, lanes});
        }
    }
    return finished;
}

// Marks pixels outside the image as finished; returns how many are inside.
template <class Real> inline int start_tile(const TileFrame& tile, Real* transmittance) {
    for (int p = 0; p < kPixels; ++p)
        transmittance[p] = p % kTile < tile.width && p / kTile < tile.height ? Real(1) : Real(-1);
    return tile.width * tile.height;
}

// Channel vectors that C channels fill.
template <class Real> constexpr int channel_vectors(int channels) {
    return (channels + Lanes<Real>::N - 1) / Lanes<Real>::N;
}

// Scratch of one thread.
template <class Real> struct Workspace {
    int channels, stride;        // stride: channels padded to whole vectors
    std::vector<Real> pixels;    // forward: colours; backward: their gradients
    std::vector<Real> color, color_gradient;
    alignas(64) Real transmittance[kPixels], alpha[kPixels], weighted[kPixels], suffix[kPixels];

    struct Record {  // what the way back needs of a hit
        VecOf<Real> alpha, before;
        VecOf<Real> value;  // <colour, gradient of the pixel>, depth and alpha included
        int position;
    };
    std::vector<Record> hits;
    std::vector<size_t> hit_start;

    explicit Workspace(int c)
        : channels(c), stride(channel_vectors<Real>(c) * Lanes<Real>::N), pixels(kPixels * stride),
          color(stride), color_gradient(stride) {}
    bool planar() const { return channels <= kPlanarMax; }
};

// Adds weight * colour to the pixels of a hit; CV channel vectors, 0 = known at run time only.
template <class Real, int CV>
inline void add_colors(Workspace<Real>& w, const Hit<Real>& hit, VecOf<Real> weight) {
    constexpr int N = Lanes<Real>::N;
    const int vectors = CV ? CV : w.stride / N;
    Real weights[N];
    store(weights, weight);
    for (unsigned lanes = hit.lanes; lanes; lanes &= lanes - 1) {
        const int lane = __builtin_ctz(lanes);
        Real* pixel = &w.pixels[size_t(hit.position + lane) * w.stride];
        for (int k = 0; k < vectors; ++k)
            store(pixel + k * N, load(pixel + k * N) + weights[lane] * load(&w.color[k * N]));
    }
}

// Returns <colour, pixel gradient> for the lanes of a hit and adds weight * pixel gradient to the
// gradient of the colour.
template <class Real, int CV>
inline VecOf<Real> gather_colors(Workspace<Real>& w, const Hit<Real>& hit, VecOf<Real> weight) {
    constexpr int N = Lanes<Real>::N;
    using V = VecOf<Real>;
    const int vectors = CV ? CV : w.stride / N;
    Real weights[N], dots[N] = {};
    store(weights, weight);
    for (unsigned lanes = hit.lanes; lanes; lanes &= lanes - 1) {
        const int lane = __builtin_ctz(lanes);
        const Real* pixel = &w.pixels[size_t(hit.position + lane) * w.stride];
        V dot = V{};
        for (int k = 0; k < vectors; ++k) {
            const V g = load(pixel + k * N);
            dot += g * load(&w.color[k * N]);
            Real* place = &w.color_gradient[k * N];
            store(place, load(place) + weights[lane] * g);
        }
        dots[lane] = sum<Real>(dot);
    }
    return load(dots);
}

template <class Real>
inline void prefetch(const Splat<Real>* splats, const Box* boxes, const Real* colors, int channels,
                     int32_t id) {
    __builtin_prefetch(&splats[id]);
    __builtin_prefetch(&boxes[id]);
    for (int c = 0; c < channels; c += 64 / int(sizeof(Real)))
        __builtin_prefetch(colors + int64_t(id) * channels + c);
}

// Blends one tile. `ids` holds its Gaussians, nearest first; those that contributed are moved to
// the front and their number is returned.
template <class Real, int CV>
int blend_tile(Workspace<Real>& w, const TileFrame& tile, const Splat<Real>* splats,
               const Box* boxes, const Real* colors, int32_t* ids, int64_t count) {
    using V = VecOf<Real>;
    int open = start_tile(tile, w.transmittance), used = 0;
    std::fill(w.pixels.begin(), w.pixels.end(), Real(0));
    std::fill(w.alpha, w.alpha + kPixels, Real(0));
    std::fill(w.weighted, w.weighted + kPixels, Real(0));
    for (int64_t i = 0; i < count && open > 0; ++i) {
        const int32_t id = ids[i];
        prefetch(splats, boxes, colors, w.channels, ids[std::min(i + kAhead, count - 1)]);
        const Splat<Real>& s = splats[id];
        const Real* color = colors + int64_t(id) * w.channels;
        bool contributed = false;
        open -= walk(s, boxes[id], tile, w.transmittance, [&](const Hit<Real>& hit) {
            if (!contributed) std::copy(color, color + w.channels, w.color.begin());
            contributed = true;
            const V weight = hit.alpha * hit.before;
            Real *alpha = w.alpha + hit.position, *weighted = w.weighted + hit.position;
            store(alpha, load(alpha) + weight);
            const V length = s.slope_u * hit.dx + (s.slope_v * hit.dy + s.length);
            store(weighted, load(weighted) + weight * length);
            if (CV >= 0) {
                add_colors<Real, (CV > 0 ? CV : 0)>(w, hit, weight);
            } else {
                for (int c = 0; c < w.channels; ++c) {
                    Real* pixel = &w.pixels[size_t(c) * kPixels + hit.position];
                    store(pixel, load(pixel) + weight * color[c]);
                }
            }
        });
        if (contributed) ids[used++] = id;
    }
    return used;
}

// Sums over the pixels of a tile that the gradient of one Gaussian needs, colours apart.
// s: gradient by sigma; w: weight * gradient of the depth sum.
template <class Real> struct Moments {
    Real s, sx, sy, sxx, sxy, syy, w, wx, wy;
};

// Derivative of blend_tile. w.pixels, w.weighted and w.alpha hold the gradients of the pixels.
// Writes one record for each Gaussian: its colour gradient and its moments.
template <class Real, int CV>
void blend_tile_gradient(Workspace<Real>& w, const TileFrame& tile, const Splat<Real>* splats,
                         const Box* boxes, const Real* colors, const int32_t* ids, int used,
                         Real* color_records, Moments<Real>* moments) {
    using V = VecOf<Real>;
    start_tile(tile, w.transmittance);
    size_t hits = 0;
    w.hit_start.assign(1, 0);
    V planar_gradient[kPlanarMax];
    for (int i = 0; i < used; ++i) {
        constexpr size_t most = kPixels / Lanes<Real>::N;  // hits of one Gaussian in a tile
        if (w.hits.size() < hits + most) w.hits.resize(2 * (hits + most));
        prefetch(splats, boxes, colors, w.channels, ids[std::min(i + kAhead, used - 1)]);
        const Splat<Real>& s = splats[ids[i]];
        const Real* color = colors + int64_t(ids[i]) * w.channels;
        std::copy(color, color + w.channels, w.color.begin());
        std::fill(w.color_gradient.begin(), w.color_gradient.end(), Real(0));
        if (CV < 0) std::fill(planar_gradient, planar_gradient + kPlanarMax, V{});
        V depth = V{}, depth_x = V{}, depth_y = V{};
        walk(s, boxes[ids[i]], tile, w.transmittance, [&](const Hit<Real>& hit) {
            const V weight = hit.alpha * hit.before;
            const V by_depth = load(w.weighted + hit.position);
            const V length = s.slope_u * hit.dx + (s.slope_v * hit.dy + s.length);
            V value = load(w.alpha + hit.position) + by_depth * length;
            const V flow = weight * by_depth;
            depth += flow, depth_x += flow * hit.dx, depth_y += flow * hit.dy;
            if (CV >= 0) {
                value += gather_colors<Real, (CV > 0 ? CV : 0)>(w, hit, weight);
            } else {
                for (int c = 0; c < w.channels; ++c) {
                    const V g = load(&w.pixels[size_t(c) * kPixels + hit.position]);
                    value += color[c] * g;
                    planar_gradient[c] += weight * g;
                }
            }
            auto& record = w.hits[hits++];
            record.alpha = hit.alpha, record.before = hit.before;
            record.value = value, record.position = hit.position;
        });
        w.hit_start.push_back(hits);
        moments[i].w = sum<Real>(depth);
        moments[i].wx = sum<Real>(depth_x), moments[i].wy = sum<Real>(depth_y);
        Real* record = color_records + int64_t(i) * w.channels;
        for (int c = 0; c < w.channels; ++c)
            record[c] = CV < 0 ? sum<Real>(planar_gradient[c]) : w.color_gradient[c];
    }
    std::fill(w.suffix, w.suffix + kPixels, Real(0));
    for (int i = used - 1; i >= 0; --i) {
        V s = V{}, sx = V{}, sy = V{}, sxx = V{}, sxy = V{}, syy = V{};
        for (size_t h = w.hit_start[i]; h < w.hit_start[i + 1]; ++h) {
            const auto& hit = w.hits[h];
            const V behind = load(w.suffix + hit.position), flow = hit.before * hit.value;
            const V by_alpha = flow - behind / (Real(1) - hit.alpha);
            store(w.suffix + hit.position, behind + hit.alpha * flow);
            // No gradient flows through an alpha that was capped.
            const V by_sigma = hit.alpha < Real(kAlphaMax) ? -hit.alpha * by_alpha : V{};
            const V dx = pixel_x<Real>(tile, hit.position % kTile) - splats[ids[i]].x;
            const Real dy = pixel_y<Real>(tile, hit.position / kTile) - splats[ids[i]].y;
            const V by_dx = by_sigma * dx, by_dy = by_sigma * dy;
            s += by_sigma, sx += by_dx, sy += by_dy;
            sxx += by_dx * dx, sxy += by_dx * dy, syy += by_dy * dy;
        }
        Moments<Real>& m = moments[i];
        m.s = sum<Real>(s), m.sx = sum<Real>(sx), m.sy = sum<Real>(sy);
        m.sxx = sum<Real>(sxx), m.sxy = sum<Real>(sxy), m.syy = sum<Real>(syy);
    }
}
