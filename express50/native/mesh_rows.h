// Three rows of a face, weighed anew for each of its pixels, and the derivative
// (express50/mesh_rows.py).
#pragma once

#include <cstdint>

namespace {

// out (n, C) = sum over k of coefficients (n, 3) times the three rows (3, C) of each one's group.
template <class Real>
void weigh_rows(int64_t n, int64_t channels, const Real* rows, const Real* coefficients,
                const int64_t* group, Real* out) {
    for (int64_t i = 0; i < n; ++i) {
        const Real *w = coefficients + 3 * i, *row = rows + 3 * channels * group[i];
        for (int64_t c = 0; c < channels; ++c)
            out[i * channels + c] =
                w[0] * row[c] + w[1] * row[channels + c] + w[2] * row[2 * channels + c];
    }
}

// Adds to d_rows (zeros on entry) and writes d_coefficients; either may be null.
template <class Real>
void weigh_rows_gradient(int64_t n, int64_t channels, const Real* rows, const Real* coefficients,
                         const int64_t* group, const Real* gradient, Real* d_rows,
                         Real* d_coefficients) {
    for (int64_t i = 0; i < n; ++i) {
        const Real* g = gradient + i * channels;
        const int64_t start = 3 * channels * group[i];
        for (int k = 0; k < 3; ++k) {
            const Real w = coefficients[3 * i + k];
            Real sum = 0;
            for (int64_t c = 0; c < channels; ++c) {
                sum += g[c] * rows[start + k * channels + c];
                if (d_rows) d_rows[start + k * channels + c] += w * g[c];
            }
            if (d_coefficients) d_coefficients[3 * i + k] = sum;
        }
    }
}

}  // namespace
