// Derivative of render.h: tiles write records, a band of them at a time, which are added for each
// Gaussian by ascending tile and taken through the projection.
#pragma once

#include "blend_gradient.h"
#include "render.h"

namespace {

constexpr int64_t kChunk = 256;  // Gaussians whose camera gradients are added up together
constexpr int64_t kBandTiles = 16;  // tiles of a band for each thread, at least
constexpr uint32_t kShare = 64;     // neighbouring Gaussians whose records one thread adds up
constexpr int kMoments = 9;         // numbers in Moments
constexpr int kCameraNumbers = 16;  // numbers in CameraGradient

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

// Gradient by the projected Gaussians from the moments of each.
inline SplatGradient splat_gradient(const Projected& g, const Wide* m) {
    SplatGradient d;
    d.mean2d[0] = -(g.A * m[1] + g.B * m[2]) - g.slope[0] * m[6];
    d.mean2d[1] = -(g.B * m[1] + g.C * m[2]) - g.slope[1] * m[6];
    d.conic[0] = 0.5 * m[3], d.conic[1] = m[4], d.conic[2] = 0.5 * m[5];
    d.opacity = -m[0] / g.opacity;
    d.length = m[6], d.slope[0] = m[7], d.slope[1] = m[8];
    for (Wide& by_normal : d.normal) by_normal = Wide{};
    return d;
}

template <class Real> struct SceneGradient {
    Real *means, *quats, *scales, *opacities, *colors;

    void write(int64_t i, const Gaussians& d, int lane) const {
        for (int k = 0; k < 3; ++k)
            means[3 * i + k] = Real(d.mean[k][lane]), scales[3 * i + k] = Real(d.scale[k][lane]);
        for (int k = 0; k < 4; ++k) quats[4 * i + k] = Real(d.quat[k][lane]);
        opacities[i] = Real(d.opacity[lane]);
    }
    void clear(int64_t i, int channels) const {
        std::fill_n(means + 3 * i, 3, Real(0)), std::fill_n(scales + 3 * i, 3, Real(0));
        std::fill_n(quats + 4 * i, 4, Real(0)), opacities[i] = 0;
        std::fill_n(colors + i * channels, channels, Real(0));
    }
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

// Takes the sums of `count` Gaussians through the projection.
template <class Real>
void finish_gaussians(const View& view, const Scene<Real>& scene, const int64_t* at, int count,
                      const Totals<Real>& totals, const SceneGradient<Real>& out,
                      CameraGradient<Wide>& d_cam) {
    const Gaussians in = scene.gather(at, count);
    Projected g;
    project(view, in, g);
    Wide moments[kMoments] = {};  // 0 in the lanes that no Gaussian is in
    for (int lane = 0; lane < count; ++lane)
        for (int k = 0; k < kMoments; ++k)
            moments[k][lane] = totals.moments[at[lane] * kMoments + k];
    SplatGradient d = splat_gradient(g, moments);
    if (view.cam.normals)
        for (int lane = 0; lane < count; ++lane)
            for (int k = 0; k < 3; ++k)
                d.normal[k][lane] = out.colors[(at[lane] + 1) * scene.channels - 3 + k];
    Gaussians d_in;
    project_gradient(view, in, g, d, d_in, d_cam);
    for (int lane = 0; lane < count; ++lane) out.write(at[lane], d_in, lane);
}

// The Gaussians [begin, end), those that reached a pixel kWide at a time. Returns the gradient by
// the camera.
template <class Real>
CameraGradient<double> finish_chunk(const View& view, const Scene<Real>& scene, int64_t begin,
                                    int64_t end, const Totals<Real>& totals,
                                    const SceneGradient<Real>& out) {
    CameraGradient<Wide> d_cam = {};
    int64_t at[kWide];
    int count = 0;
    for (int64_t i = begin; i < end; ++i) {
        if (totals.reached[i])
            at[count++] = i;
        else
            out.clear(i, scene.channels);
        if (count == kWide || (count && i + 1 == end)) {
            finish_gaussians(view, scene, at, count, totals, out, d_cam);
            count = 0;
        }
    }
    CameraGradient<double> sums;
    for (int k = 0; k < kCameraNumbers; ++k) (&sums.fx)[k] = sum<double>((&d_cam.fx)[k]);
    return sums;
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
              double* moments, const SceneGradient<Real>& out, CameraGradient<double>* d_cam) {
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
    std::vector<CameraGradient<double>> partial(chunks);
#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int64_t chunk = 0; chunk < chunks; ++chunk)
        partial[chunk] = finish_chunk(view, scene, chunk * kChunk,
                                      std::min(n, (chunk + 1) * kChunk), totals, out);
    double* total = &d_cam->fx;
    for (const CameraGradient<double>& part : partial)
        for (int k = 0; k < kCameraNumbers; ++k) total[k] += (&part.fx)[k];
}

}  // namespace
