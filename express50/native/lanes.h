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

// exp(x) for x in [-80, 0]: x = n ln 2 + r with |r| <= ln(2)/2, then a Taylor polynomial in r whose
// remainder is under half a unit in the last place (degree 7 in float, 13 in double).
template <class Real> inline VecOf<Real> exp_negative(VecOf<Real> x) {
    using L = Lanes<Real>;
    constexpr bool single = sizeof(Real) == 4;
    const VecOf<Real> shifted = x * Real(1.4426950408889634) + L::kRound;
    const VecOf<Real> n = shifted - L::kRound;
    // ln 2 in two parts; the high one has trailing zeros, so that n * high is exact.
    const Real high = single ? Real(0.693145751953125) : Real(0.69314718036912382);
    const Real low = single ? Real(1.42860682030941723e-6) : Real(1.90821492927058770e-10);
    const VecOf<Real> r = (x - n * high) - n * low;
    constexpr int degree = single ? 7 : 13;
    constexpr double inverse_factorial[14] = {
        1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320,
        1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800.0};
    VecOf<Real> p = broadcast(Real(inverse_factorial[degree]));
    for (int k = degree - 1; k >= 0; --k) p = p * r + Real(inverse_factorial[k]);
    MaskOf<Real> exponent;
    std::memcpy(&exponent, &shifted, sizeof exponent);
    // The low bits of `shifted` are n in two's complement; the rest is shifted out.
    exponent = (exponent + L::kBias) << L::kMantissa;
    VecOf<Real> scale;
    std::memcpy(&scale, &exponent, sizeof scale);
    return p * scale;
}
