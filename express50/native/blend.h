// Front-to-back blending of one 16 x 16 tile; its derivative is in blend_gradient.h.
//
// Alphas are computed for a vector of neighbouring pixels at a time (see Block). Few channels
// (<= kPlanarMax) are blended in the same layout. Many are blended pixel by pixel, as vectors over
// channels: the pixels that a Gaussian reached are listed first and walked afterwards, because a
// loop over the lanes of each vector would wait for its exponentials and guess its length wrong.
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
// of half the conic, times log2(e), so that alpha = opacity 2^-sigma. A sum of squares neither
// cancels nor turns negative for needles.
template <class Real> struct Splat {
    Real x, y, l11, l21, l22, opacity, cutoff, length, slope_u, slope_v;
};

struct TileFrame {
    int left, top, width, height;  // pixels; width and height are cut at the image's border

    int64_t pixel(const Camera& cam, int x, int y) const {
        return int64_t(top + y) * cam.width + left + x;
    }
};

// The pixels of one vector: a block as square as the width allows, since splats are round. All
// arrays of a tile hold one block after the other.
template <class Real> struct Block {
    static constexpr int N = Lanes<Real>::N, wide = N < 4 ? N : 4, tall = N / wide;
    static constexpr int columns = kTile / wide, rows = kTile / tall;
    static int place(int x, int y) {
        return (y / tall * columns + x / wide) * N + y % tall * wide + x % wide;
    }
};

// Centres of a tile's pixels in pixels of the image, by column and by row of blocks.
template <class Real> struct Centers {
    VecOf<Real> x[Block<Real>::columns], y[Block<Real>::rows];
    explicit Centers(const TileFrame& tile) {
        using B = Block<Real>;
        for (int lane = 0; lane < B::N; ++lane) {
            for (int j = 0; j < B::columns; ++j)
                x[j][lane] = Real(tile.left + j * B::wide + lane % B::wide) + Real(0.5);
            for (int i = 0; i < B::rows; ++i)
                y[i][lane] = Real(tile.top + i * B::tall + lane / B::wide) + Real(0.5);
        }
    }
};

// One block of one Gaussian that received light.
template <class Real> struct Hit {
    VecOf<Real> dx, dy, alpha, before, after;  // transmittance before and after; alpha 0 = miss
    int block;
    unsigned lanes;

    int position() const { return block * Lanes<Real>::N; }
    // Ray length of the Gaussian's plane there.
    VecOf<Real> length(const Splat<Real>& s) const {
        return s.slope_u * dx + (s.slope_v * dy + s.length);
    }
    // Lanes whose transmittance falls through one half here: the Gaussian of the median depth.
    MaskOf<Real> crosses() const {
        const VecOf<Real> half = broadcast(Real(0.5));
        return below(VecOf<Real>{}, alpha) & below(half, before) & at_most(after, half);
    }
};

// Walks one Gaussian over a tile. Updates the transmittance (negative: the pixel is finished),
// calls visit(hit) for every block with a contribution and returns how many pixels finished.
template <class Real, class Visit>
inline int walk(const Splat<Real>& s, const Box& box, const TileFrame& tile,
                const Centers<Real>& centers, Real* transmittance, Visit&& visit) {
    using V = VecOf<Real>;
    using B = Block<Real>;
    const int i0 = std::max(box.y0 - tile.top, 0) / B::tall;
    const int i1 = (std::min(box.y1 - tile.top, tile.height) + B::tall - 1) / B::tall;
    const int j0 = std::max(box.x0 - tile.left, 0) / B::wide;
    const int j1 = (std::min(box.x1 - tile.left, tile.width) + B::wide - 1) / B::wide;
    const V cutoff = broadcast(s.cutoff), zero = V{}, least = broadcast(Real(kAlphaMin));
    const V most = broadcast(Real(kAlphaMax)), opaque = broadcast(Real(kTransmittanceMin));
    int finished = 0;
    for (int i = i0; i < i1; ++i) {
        const V dy = centers.y[i] - s.y;
        const V across = s.l22 * dy, base = across * across, shear = s.l21 * dy;
        for (int j = j0; j < j1; ++j) {
            const int block = i * B::columns + j;
            Real* place = transmittance + block * B::N;
            const V before = load(place), dx = centers.x[j] - s.x;
            const V along = s.l11 * dx + shear;
            const V sigma = along * along + base;
            MaskOf<Real> hit = at_most(sigma, cutoff) & below(zero, before);
            if (!bits(hit)) continue;
            V alpha = s.opacity * exp2_negative<Real>(-sigma);
            alpha = smaller(alpha, most);
            hit &= at_most(least, alpha);
            const V after = before * (Real(1) - alpha);
            const MaskOf<Real> stop = hit & at_most(after, opaque);
            const MaskOf<Real> keep = hit & ~stop;
            store(place, choose(keep, after, before));
            if (const unsigned stopped = bits(stop)) {
                store(place, choose(stop, -before, load(place)));
                finished += __builtin_popcount(stopped);
            }
            if (const unsigned lanes = bits(keep))
                visit(Hit<Real>{dx, dy, choose(keep, alpha, zero), before, after, block, lanes});
        }
    }
    return finished;
}

// Marks pixels outside the image as finished; returns how many are inside.
template <class Real> inline int start_tile(const TileFrame& tile, Real* transmittance) {
    for (int y = 0; y < kTile; ++y)
        for (int x = 0; x < kTile; ++x)
            transmittance[Block<Real>::place(x, y)] =
                x < tile.width && y < tile.height ? Real(1) : Real(-1);
    return tile.width * tile.height;
}

// Channel vectors that C channels fill.
template <class Real> constexpr int channel_vectors(int channels) {
    return (channels + Lanes<Real>::N - 1) / Lanes<Real>::N;
}

// Pixels of a tile that one Gaussian reached, in the order of the walk, with its weight there. The
// way back adds `value`, the product of its colour and the pixel's gradient.
template <class Real> struct PixelList {
    static constexpr int N = Lanes<Real>::N;
    int count = 0;
    alignas(64) int32_t at[kPixels + N];  // whole vectors are written
    alignas(64) Real weight[kPixels + N], value[kPixels + N];

    void add(int position, unsigned lanes, VecOf<Real> weights) {
        pack_places<Real>(lanes, position, at + count);
        pack<Real>(lanes, weights, weight + count);
        count += __builtin_popcount(lanes);
    }
};

// Zeroed memory that starts at a cache line: a vector across two costs twice.
template <class Real> class Lines {
    struct alignas(64) Line {
        Real values[64 / sizeof(Real)];
    };
    std::vector<Line> lines;

  public:
    explicit Lines(size_t size) : lines((size * sizeof(Real) + sizeof(Line) - 1) / sizeof(Line)) {}
    Real* data() { return lines.data()->values; }
    const Real* data() const { return lines.data()->values; }
    void clear() { std::fill(lines.begin(), lines.end(), Line{}); }
};

// Scratch of one thread.
template <class Real> struct Workspace {
    int channels, stride;  // stride: channels padded to whole vectors
    bool wants_median;
    Lines<Real> pixels;  // forward: colours; backward: their gradients
    std::vector<Real> color, color_gradient;
    alignas(64) Real transmittance[kPixels], alpha[kPixels], weighted[kPixels], median[kPixels];
    alignas(64) Real before[kPixels], suffix[kPixels];
    PixelList<Real> list;

    struct Record {  // what the way back needs of a hit
        VecOf<Real> alpha, flow;  // flow: transmittance before * gradient by the weight
    };
    struct Where {
        int block;
        unsigned lanes;
    };
    std::vector<Record> hits;
    std::vector<Where> where;  // of each hit
    std::vector<size_t> hit_start;

    Workspace(int c, bool median_too)
        : channels(c), stride(channel_vectors<Real>(c) * Lanes<Real>::N), wants_median(median_too),
          pixels(kPixels * stride), color(stride), color_gradient(stride) {}
    bool planar() const { return channels <= kPlanarMax; }
};

// CV channel vectors of a colour in registers.
template <class Real, int CV>
inline void load_color(const Real* color, int channels, VecOf<Real>* out) {
    constexpr int N = Lanes<Real>::N;
    for (int k = 0; k < CV - 1; ++k) out[k] = load(color + k * N);
    out[CV - 1] = load_first<Real>(color + (CV - 1) * N, channels - (CV - 1) * N);
}

template <class Real, int CV>
inline void store_color(Real* color, int channels, const VecOf<Real>* in) {
    constexpr int N = Lanes<Real>::N;
    for (int k = 0; k < CV - 1; ++k) store(color + k * N, in[k]);
    store_first<Real>(color + (CV - 1) * N, in[CV - 1], channels - (CV - 1) * N);
}

// Adds weight * colour to the listed pixels; CV channel vectors, 0 = known at run time only.
template <class Real, int CV> inline void add_colors(Workspace<Real>& w, const Real* color) {
    constexpr int N = Lanes<Real>::N;
    using V = VecOf<Real>;
    Real* const pixels = w.pixels.data();
    const int count = w.list.count;
    if constexpr (CV > 0) {
        V c[CV];
        load_color<Real, CV>(color, w.channels, c);
        for (int h = 0; h < count; ++h) {
            const int at = w.list.at[h];
            const V weight = broadcast(w.list.weight[h]);
            Real* const pixel = pixels + at * CV * N;
            for (int k = 0; k < CV; ++k) store(pixel + k * N, load(pixel + k * N) + weight * c[k]);
        }
    } else {
        std::copy(color, color + w.channels, w.color.begin());
        for (int h = 0; h < count; ++h) {
            const int at = w.list.at[h];
            const V weight = broadcast(w.list.weight[h]);
            Real* const pixel = pixels + size_t(at) * w.stride;
            for (int k = 0; k < w.stride; k += N)
                store(pixel + k, load(pixel + k) + weight * load(&w.color[k]));
        }
    }
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
    const Centers<Real> centers(tile);
    int open = start_tile(tile, w.transmittance), used = 0;
    w.pixels.clear();
    for (Real* sums : {w.alpha, w.weighted, w.median}) std::fill(sums, sums + kPixels, Real(0));
    for (int64_t i = 0; i < count && open > 0; ++i) {
        const int32_t id = ids[i];
        prefetch(splats, boxes, colors, w.channels, ids[std::min(i + kAhead, count - 1)]);
        const Splat<Real>& s = splats[id];
        const Real* color = colors + int64_t(id) * w.channels;
        bool contributed = false;
        w.list.count = 0;
        open -= walk(s, boxes[id], tile, centers, w.transmittance, [&](const Hit<Real>& hit) {
            contributed = true;
            const V weight = hit.alpha * hit.before, length = hit.length(s);
            const int at = hit.position();
            Real *alpha = w.alpha + at, *weighted = w.weighted + at;
            store(alpha, load(alpha) + weight);
            store(weighted, load(weighted) + weight * length);
            if (w.wants_median) {
                Real* median = w.median + at;
                store(median, choose(hit.crosses(), length, load(median)));
            }
            if (CV >= 0) {
                w.list.add(at, hit.lanes, weight);
            } else {
                for (int c = 0; c < w.channels; ++c) {
                    Real* pixel = w.pixels.data() + c * kPixels + at;
                    store(pixel, load(pixel) + weight * color[c]);
                }
            }
        });
        if (!contributed) continue;
        if (CV >= 0) add_colors<Real, (CV > 0 ? CV : 0)>(w, color);
        ids[used++] = id;
    }
    return used;
}
