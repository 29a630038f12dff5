// Vectors of pixels: GCC vector extensions whose width follows the instruction set that this
// translation unit is compiled for. Wider vectors than the hardware has are several times slower.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX2__) || defined(__AVX512F__) || defined(__SSE2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <class Real> struct Lanes;

template <> struct Lanes<float> {
    typedef float V __attribute__((vector_size(kVectorBytes)));
    typedef int32_t I __attribute__((vector_size(kVectorBytes)));
    static constexpr int N = kVectorBytes / 4;
    static constexpr float kRound = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
    static constexpr int kBias = 127, kMantissa = 23;
};

template <> struct Lanes<double> {
    typedef double V __attribute__((vector_size(kVectorBytes)));
    typedef int64_t I __attribute__((vector_size(kVectorBytes)));
    static constexpr int N = kVectorBytes / 8;
    static constexpr double kRound = 6755399441055744.0;  // 1.5 * 2^52
    static constexpr int kBias = 1023, kMantissa = 52;
};

template <class Real> using VecOf = typename Lanes<Real>::V;
template <class Real> using MaskOf = typename Lanes<Real>::I;

template <class Real> inline VecOf<Real> load(const Real* p) {
    VecOf<Real> v;
    std::memcpy(&v, p, sizeof v);
    return v;
}

template <class Real> inline void store(Real* p, VecOf<Real> v) { std::memcpy(p, &v, sizeof v); }

// The first `count` <= N numbers, the other lanes 0; and the same for writing. They touch no memory
// beyond: rows of channels lie without a gap, and the next may belong to another thread.
template <class Real> inline VecOf<Real> load_first(const Real* p, int count) {
    VecOf<Real> v = {};
    for (int i = 0; i < count; ++i) v[i] = p[i];
    return v;
}

template <class Real> inline void store_first(Real* p, VecOf<Real> v, int count) {
    for (int i = 0; i < count; ++i) p[i] = v[i];
}

#if defined(__AVX512F__)
template <> inline VecOf<float> load_first<float>(const float* p, int count) {
    return (VecOf<float>)_mm512_maskz_loadu_ps(__mmask16((1u << count) - 1), p);
}

template <> inline void store_first<float>(float* p, VecOf<float> v, int count) {
    _mm512_mask_storeu_ps(p, __mmask16((1u << count) - 1), (__m512)v);
}
#elif defined(__AVX2__)
inline __m256i first_lanes(int count) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(count), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
}

template <> inline VecOf<float> load_first<float>(const float* p, int count) {
    return (VecOf<float>)_mm256_maskload_ps(p, first_lanes(count));
}

template <> inline void store_first<float>(float* p, VecOf<float> v, int count) {
    _mm256_maskstore_ps(p, first_lanes(count), (__m256)v);
}
#endif

template <class Real> inline VecOf<Real> broadcast(Real x) { return x - VecOf<Real>{}; }

// One bit a lane, set where the mask is.
inline unsigned bits(MaskOf<float> mask) {
#if defined(__AVX512F__)
    return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
    return unsigned(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
    return unsigned(_mm_movemask_ps((__m128)mask));
#else
    unsigned r = 0;
    for (int i = 0; i < Lanes<float>::N; ++i) r |= unsigned(mask[i] != 0) << i;
    return r;
#endif
}

inline unsigned bits(MaskOf<double> mask) {
#if defined(__AVX512F__)
    return _mm512_movepi64_mask((__m512i)mask);
#elif defined(__AVX2__)
    return unsigned(_mm256_movemask_pd((__m256d)mask));
#elif defined(__SSE2__)
    return unsigned(_mm_movemask_pd((__m128d)mask));
#else
    unsigned r = 0;
    for (int i = 0; i < Lanes<double>::N; ++i) r |= unsigned(mask[i] != 0) << i;
    return r;
#endif
}

// Sum of all lanes, halves first, so that the order of additions is fixed.
template <class Real> inline Real sum(VecOf<Real> v) {
    Real parts[Lanes<Real>::N];
    store(parts, v);
    for (int half = Lanes<Real>::N / 2; half > 0; half /= 2)
        for (int i = 0; i < half; ++i) parts[i] += parts[i + half];
    return parts[0];
}

#if defined(__AVX2__) && !defined(__AVX512F__)
template <> inline float sum<float>(VecOf<float> v) {
    __m128 a = _mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
    a = _mm_add_ps(a, _mm_movehl_ps(a, a));
    return _mm_cvtss_f32(_mm_add_ss(a, _mm_movehdup_ps(a)));
}
#endif

#if defined(__AVX512F__)
template <> inline float sum<float>(VecOf<float> v) { return _mm512_reduce_add_ps((__m512)v); }
#endif

// 2^x for x in [-120, 0]; anything else gives garbage, which the caller masks. x = n + r with |r| <=
// 1/2 exactly, then the series of e^(r ln 2), whose remainder is under half a unit in the last place
// (degree 7 in float, 13 in double).
template <class Real> inline VecOf<Real> exp2_negative(VecOf<Real> x) {
    using L = Lanes<Real>;
    const VecOf<Real> shifted = x + L::kRound;
    const VecOf<Real> r = x - (shifted - L::kRound);
    constexpr int degree = sizeof(Real) == 4 ? 7 : 13;
    constexpr double coefficient[14] = {  // ln(2)^k / k!
        1.0, 0.6931471805599453, 0.2402265069591007, 0.05550410866482158, 0.009618129107628477,
        0.0013333558146428443, 0.0001540353039338161, 1.5252733804059841e-05,
        1.3215486790144309e-06, 1.0178086009239699e-07, 7.054911620801123e-09,
        4.44553827187081e-10, 2.5678435993488204e-11, 1.3691488853904128e-12};
    VecOf<Real> p = broadcast(Real(coefficient[degree]));
    for (int k = degree - 1; k >= 0; --k) p = p * r + Real(coefficient[k]);
    MaskOf<Real> exponent;
    std::memcpy(&exponent, &shifted, sizeof exponent);
    // The low bits of `shifted` are n in two's complement; the rest is shifted out.
    exponent = (exponent + L::kBias) << L::kMantissa;
    VecOf<Real> scale;
    std::memcpy(&scale, &exponent, sizeof scale);
    return p * scale;
}
