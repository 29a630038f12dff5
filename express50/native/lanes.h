// Vectors of pixels: GCC vector extensions whose width follows the instruction set that this
// translation unit is compiled for. Wider vectors than the hardware has are several times slower.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

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
template <class Real> using IntOf = typename Lanes<Real>::I;

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

// Lanes for which a comparison holds: a mask register with AVX-512, where compilers take generic
// masks to vectors and back at every step; elsewhere a vector with all bits of those lanes set.
#if defined(__AVX512F__)
template <class Real>
using MaskOf = std::conditional_t<sizeof(Real) == 4, __mmask16, __mmask8>;

inline __mmask16 at_most(VecOf<float> a, VecOf<float> b) {
    return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ);
}
inline __mmask8 at_most(VecOf<double> a, VecOf<double> b) {
    return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LE_OQ);
}
inline __mmask16 below(VecOf<float> a, VecOf<float> b) {
    return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ);
}
inline __mmask8 below(VecOf<double> a, VecOf<double> b) {
    return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ);
}
inline VecOf<float> choose(__mmask16 mask, VecOf<float> a, VecOf<float> b) {
    return (VecOf<float>)_mm512_mask_blend_ps(mask, (__m512)b, (__m512)a);
}
inline VecOf<double> choose(__mmask8 mask, VecOf<double> a, VecOf<double> b) {
    return (VecOf<double>)_mm512_mask_blend_pd(mask, (__m512d)b, (__m512d)a);
}
inline VecOf<float> smaller(VecOf<float> a, VecOf<float> b) {
    return (VecOf<float>)_mm512_min_ps((__m512)a, (__m512)b);
}
inline VecOf<double> smaller(VecOf<double> a, VecOf<double> b) {
    return (VecOf<double>)_mm512_min_pd((__m512d)a, (__m512d)b);
}
inline unsigned bits(unsigned mask) { return mask; }
#else
template <class Real> using MaskOf = IntOf<Real>;

template <class V> inline auto at_most(V a, V b) { return a <= b; }
template <class V> inline auto below(V a, V b) { return a < b; }
template <class V, class M> inline V choose(M mask, V a, V b) { return mask ? a : b; }
template <class V> inline V smaller(V a, V b) { return a < b ? a : b; }

// One bit a lane, set where the mask is.
inline unsigned bits(MaskOf<float> mask) {
#if defined(__AVX2__)
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
#if defined(__AVX2__)
    return unsigned(_mm256_movemask_pd((__m256d)mask));
#elif defined(__SSE2__)
    return unsigned(_mm_movemask_pd((__m128d)mask));
#else
    unsigned r = 0;
    for (int i = 0; i < Lanes<double>::N; ++i) r |= unsigned(mask[i] != 0) << i;
    return r;
#endif
}
#endif

// For each byte the places of its set bits, lowest first, and for each place the number of set bits
// before it.
struct BitPlaces {
    uint8_t at[256][8] = {}, rank[256][8] = {};
    constexpr BitPlaces() {
        for (int byte = 0; byte < 256; ++byte)
            for (int bit = 0, n = 0; bit < 8; ++bit) {
                rank[byte][bit] = uint8_t(n);
                if (byte >> bit & 1) at[byte][n++] = uint8_t(bit);
            }
    }
};
inline constexpr BitPlaces kBitPlaces;

// Writes the lanes whose bits are set, one after the other; a whole vector is written.
template <class Real> inline void pack(unsigned lanes, VecOf<Real> v, Real* to) {
    for (int i = 0; i < Lanes<Real>::N; ++i) to[i] = v[kBitPlaces.at[lanes][i]];
}

// The same of the numbers first, first + 1, ...
template <class Real> inline void pack_places(unsigned lanes, int first, int32_t* to) {
    for (int i = 0; i < Lanes<Real>::N; ++i) to[i] = first + kBitPlaces.at[lanes][i];
}

// The inverse: numbers that lie one after the other go to the lanes whose bits are set; the other
// lanes are 0.
template <class Real> inline VecOf<Real> unpack(unsigned lanes, const Real* from) {
    VecOf<Real> v;
    for (int i = 0; i < Lanes<Real>::N; ++i)
        v[i] = lanes >> i & 1 ? from[kBitPlaces.rank[lanes][i]] : Real(0);
    return v;
}

#if defined(__AVX512F__)
template <> inline void pack<float>(unsigned lanes, VecOf<float> v, float* to) {
    _mm512_storeu_ps(to, _mm512_maskz_compress_ps(__mmask16(lanes), (__m512)v));
}
template <> inline void pack_places<float>(unsigned lanes, int first, int32_t* to) {
    const __m512i count = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const __m512i places = _mm512_add_epi32(count, _mm512_set1_epi32(first));
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(lanes), places));
}
template <> inline VecOf<float> unpack<float>(unsigned lanes, const float* from) {
    return (VecOf<float>)_mm512_maskz_expand_ps(__mmask16(lanes), _mm512_loadu_ps(from));
}
#elif defined(__AVX2__)
inline __m256i eight_places(const uint8_t* places) {
    return _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(places)));
}
template <> inline void pack<float>(unsigned lanes, VecOf<float> v, float* to) {
    _mm256_storeu_ps(to, _mm256_permutevar8x32_ps((__m256)v, eight_places(kBitPlaces.at[lanes])));
}
template <> inline void pack_places<float>(unsigned lanes, int first, int32_t* to) {
    const __m256i places = eight_places(kBitPlaces.at[lanes]);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(to),
                        _mm256_add_epi32(places, _mm256_set1_epi32(first)));
}
template <> inline VecOf<float> unpack<float>(unsigned lanes, const float* from) {
    const __m256i bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i set = _mm256_and_si256(_mm256_set1_epi32(int(lanes)), bits);
    const __m256 v =
        _mm256_permutevar8x32_ps(_mm256_loadu_ps(from), eight_places(kBitPlaces.rank[lanes]));
    return (VecOf<float>)_mm256_and_ps(v, _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, bits)));
}
#endif

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

inline VecOf<double> square_root(VecOf<double> v) {
#if defined(__AVX512F__)
    return (VecOf<double>)_mm512_sqrt_pd((__m512d)v);
#elif defined(__AVX2__)
    return (VecOf<double>)_mm256_sqrt_pd((__m256d)v);
#elif defined(__SSE2__)
    return (VecOf<double>)_mm_sqrt_pd((__m128d)v);
#else
    for (int i = 0; i < Lanes<double>::N; ++i) v[i] = std::sqrt(v[i]);
    return v;
#endif
}

// Sums of four vectors, of use together: their halves are added two vectors at a time.
template <class Real> inline void sum_four(const VecOf<Real>* v, Real* sums) {
    for (int i = 0; i < 4; ++i) sums[i] = sum<Real>(v[i]);
}

#if defined(__AVX512F__)
template <> inline void sum_four<float>(const VecOf<float>* v, float* sums) {
    const auto halves = [](__m512 a, __m512 b) {  // quarters of a, then those of b
        return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
    };
    const __m512 a = halves((__m512)v[0], (__m512)v[1]), b = halves((__m512)v[2], (__m512)v[3]);
    __m512 c = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
    c = _mm512_add_ps(c, _mm512_permute_ps(c, 0x4e));
    c = _mm512_add_ps(c, _mm512_permute_ps(c, 0xb1));
    _mm_storeu_ps(sums, _mm512_castps512_ps128(_mm512_maskz_compress_ps(0x1111, c)));
}
#elif defined(__AVX2__)
template <> inline void sum_four<float>(const VecOf<float>* v, float* sums) {
    const __m256 a = _mm256_hadd_ps((__m256)v[0], (__m256)v[1]);
    const __m256 b = _mm256_hadd_ps((__m256)v[2], (__m256)v[3]);
    const __m256 c = _mm256_hadd_ps(a, b);
    _mm_storeu_ps(sums, _mm_add_ps(_mm256_castps256_ps128(c), _mm256_extractf128_ps(c, 1)));
}
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
    IntOf<Real> exponent;
    std::memcpy(&exponent, &shifted, sizeof exponent);
    // The low bits of `shifted` are n in two's complement; the rest is shifted out.
    exponent = (exponent + L::kBias) << L::kMantissa;
    VecOf<Real> scale;
    std::memcpy(&scale, &exponent, sizeof scale);
    return p * scale;
}
