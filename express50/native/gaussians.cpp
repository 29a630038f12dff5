// Differentiable rasterisation of 3D Gaussians on the CPU, behind a plain C ABI.
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

#include "render_gradient.h"

#define EXPRESS50_EXPORT extern "C" __attribute__((visibility("default")))

#define EXPRESS50_GAUSSIANS(Real, suffix)                                                         \
    EXPRESS50_EXPORT int64_t gaussians_project_##suffix(                                          \
        const Camera* cam, int64_t n, int64_t channels, const Real* means, const Real* quats,     \
        const Real* scales, const Real* opacities, Splat<Real>* splats, Real* depths, Box* boxes, \
        Real* colors) {                                                                           \
        return project_scene<Real>(*cam, {n, int(channels), means, quats, scales, opacities},     \
                                   {splats, depths, boxes, colors});                              \
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
        Real* d_opacities, Real* d_colors, CameraGradient<double>* d_cam) {                               \
        backward<Real>(*cam, {n, int(channels), means, quats, scales, opacities}, splats, boxes,  \
                       colors, background, starts, ids, used, d_image, d_weighted, d_alpha,       \
                       d_median, moments,                                                         \
                       {d_means, d_quats, d_scales, d_opacities, d_colors}, d_cam);               \
    }

EXPRESS50_GAUSSIANS(float, f32)
EXPRESS50_GAUSSIANS(double, f64)

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
