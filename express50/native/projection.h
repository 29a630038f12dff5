// Projection of 3D Gaussians and its derivative, in double whatever the dtype of the scene, kWide
// Gaussians at once. It follows grmm/rasterize/projection.py line by line; look there for the reasons.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "lanes.h"

using Wide = VecOf<double>;  // one number of each Gaussian
constexpr int kWide = Lanes<double>::N;

constexpr double kAlphaMin = 1.0 / 255.0, kAlphaMax = 0.99, kTransmittanceMin = 1e-4;
constexpr double kCompensationMin = 0.005, kFovMargin = 0.15;

// Mirrored by grmm/rasterize/cpu.py.
struct Camera {
    double fx, fy, cx, cy;
    double R[9], t[3];
    double near, eps2d;
    int32_t width, height, antialiased, normals, threads;
};

// A camera and what is the same for all Gaussians in it: divisions are most of a projection's time.
struct View {
    const Camera& cam;
    double focal[2], center[2], low[2], high[2];  // bounds of x/z and y/z in the Jacobian
    explicit View(const Camera& c) : cam(c), focal{c.fx, c.fy}, center{c.cx, c.cy} {
        const double size[2] = {double(c.width), double(c.height)};
        for (int i = 0; i < 2; ++i) {
            low[i] = -(center[i] + kFovMargin * size[i]) / focal[i];
            high[i] = (size[i] - center[i] + kFovMargin * size[i]) / focal[i];
        }
    }
};

// T: double, or Wide while sums are taken over many Gaussians.
template <class T> struct CameraGradient {
    T fx, fy, cx, cy, R[9], t[3];
};

struct Gaussians {
    Wide mean[3], quat[4], scale[3], opacity;
};

struct Projected {
    MaskOf<double> front;  // of the others nothing below means anything
    Wide p[3], length;      // mean in camera coordinates, its distance
    Wide tan_raw[2], tan[2];  // x/z and y/z before and after the clamp
    Wide q[4], inverse_norm;  // unit quaternion, 1 / its length (0 for the zero quaternion)
    Wide Rq[9], W[9], M[9];   // rotation of the quaternion, R Rq, W diag(scales)
    Wide J[9];                // d(u, v, ray length) / d(camera coordinates)
    Wide rows[9];             // J M: square root of the covariance over (u, v, ray length)
    Wide xx, xy, yy, tu, tv;  // that covariance, before dilation
    Wide cross[3], det_sharp, det, ratio;
    Wide A, B, C;  // conic
    Wide mean2d[2], slope[2], opacity;
    Wide normal[3], inverse_steepness;  // see project_normal
};

template <class T> inline T dot3(const T* a, const T* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class T> inline void cross3(const T* a, const T* b, T* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

template <class T> inline void multiply3(const T* a, const Wide* b, Wide* out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

inline void quaternion_to_matrix(const Wide* q, Wide* m) {
    const Wide w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = 1.0 - 2.0 * (y * y + z * z), m[1] = 2.0 * (x * y - w * z), m[2] = 2.0 * (x * z + w * y);
    m[3] = 2.0 * (x * y + w * z), m[4] = 1.0 - 2.0 * (x * x + z * z), m[5] = 2.0 * (y * z - w * x);
    m[6] = 2.0 * (x * z - w * y), m[7] = 2.0 * (y * z + w * x), m[8] = 1.0 - 2.0 * (x * x + y * y);
}

// Unit normal, towards the camera, of the plane ray length = l + slope . (pixel - mean2d): minus the
// derivative of (ray length - slope . pixel) by camera coordinates.
inline void project_normal(Projected& g) {
    const Wide zero = Wide{};
    for (int k = 0; k < 3; ++k)
        g.normal[k] = g.slope[0] * g.J[k] + g.slope[1] * g.J[3 + k] - g.J[6 + k];
    const Wide steepness = square_root(dot3(g.normal, g.normal));
    g.inverse_steepness = choose(below(zero, steepness), 1.0 / steepness, zero);
    for (int k = 0; k < 3; ++k) g.normal[k] *= g.inverse_steepness;
}

// The part of the antialiased opacity that dilation leaves: the root of a ratio that is kept from 0.
inline Wide compensation(Wide ratio) {
    const Wide least = broadcast(kCompensationMin * kCompensationMin);
    return square_root(choose(below(ratio, least), least, ratio));
}

inline void project(const View& view, const Gaussians& in, Projected& g) {
    const Camera& cam = view.cam;
    const Wide zero = Wide{}, one = broadcast(1.0);
    for (int i = 0; i < 3; ++i)
        g.p[i] = cam.R[3 * i] * in.mean[0] + cam.R[3 * i + 1] * in.mean[1] +
                 cam.R[3 * i + 2] * in.mean[2] + cam.t[i];
    g.front = below(broadcast(cam.near), g.p[2]);
    const Wide inverse_z = 1.0 / g.p[2];
    g.length = square_root(dot3(g.p, g.p));
    for (int i = 0; i < 9; ++i) g.J[i] = zero;
    for (int i = 0; i < 2; ++i) {
        const Wide raw = g.p[i] * inverse_z, low = broadcast(view.low[i]),
                   high = broadcast(view.high[i]);
        g.tan_raw[i] = raw;
        g.tan[i] = choose(below(raw, low), low, choose(below(high, raw), high, raw));
        g.J[3 * i + i] = view.focal[i] * inverse_z;
        g.J[3 * i + 2] = -g.J[3 * i + i] * g.tan[i];
        g.mean2d[i] = view.focal[i] * raw + view.center[i];
    }
    const Wide inverse_length = 1.0 / g.length;
    for (int i = 0; i < 3; ++i) g.J[6 + i] = g.p[i] * inverse_length;

    const Wide* q = in.quat;
    const Wide norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const MaskOf<double> none = at_most(norm2, zero);
    g.inverse_norm = choose(none, zero, 1.0 / square_root(norm2));
    for (int i = 0; i < 4; ++i) g.q[i] = choose(none, i == 0 ? one : zero, q[i] * g.inverse_norm);
    quaternion_to_matrix(g.q, g.Rq);
    multiply3(cam.R, g.Rq, g.W);
    for (int i = 0; i < 9; ++i) g.M[i] = g.W[i] * in.scale[i % 3];
    multiply3(g.J, g.M, g.rows);

    const Wide *u = g.rows, *v = g.rows + 3, *t = g.rows + 6;
    const double e = cam.eps2d;
    g.xx = dot3(u, u), g.xy = dot3(u, v), g.yy = dot3(v, v);
    g.tu = dot3(t, u), g.tv = dot3(t, v);
    cross3(u, v, g.cross);
    g.det_sharp = dot3(g.cross, g.cross);
    g.det = g.det_sharp + e * (g.xx + g.yy) + e * e;
    const Wide inverse_det = 1.0 / g.det;
    g.A = (g.yy + e) * inverse_det, g.B = -g.xy * inverse_det, g.C = (g.xx + e) * inverse_det;
    Wide t_v[3], u_t[3];
    cross3(t, v, t_v), cross3(u, t, u_t);
    g.slope[0] = (e * g.tu + dot3(g.cross, t_v)) * inverse_det;
    g.slope[1] = (e * g.tv + dot3(g.cross, u_t)) * inverse_det;
    g.opacity = in.opacity;
    g.ratio = g.det_sharp * inverse_det;
    if (cam.antialiased) g.opacity *= compensation(g.ratio);
    if (cam.normals) project_normal(g);
}

// Gradient of a loss by what the blending reads of the Gaussians.
struct SplatGradient {
    Wide mean2d[2], conic[3], opacity, length, slope[2], normal[3];
};

// Derivative by the quaternion (before normalisation) of sum(G * Rq).
inline void quaternion_gradient(const Projected& g, const Wide* G, Wide* out) {
    const Wide w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    const Wide d[4] = {
        2.0 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1])),
        2.0 * (-2.0 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6]) +
               w * (G[7] - G[5])),
        2.0 * (x * (G[1] + G[3]) - 2.0 * y * (G[0] + G[8]) + z * (G[5] + G[7]) +
               w * (G[2] - G[6])),
        2.0 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2.0 * z * (G[0] + G[4]) +
               w * (G[3] - G[1]))};
    const Wide along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    for (int i = 0; i < 4; ++i) out[i] = (d[i] - g.q[i] * along) * g.inverse_norm;
}

// Writes gradients by the Gaussians; adds those by the camera. All are exactly 0 where `d` is.
inline void project_gradient(const View& view, const Gaussians& in, const Projected& g,
                             SplatGradient d, Gaussians& out, CameraGradient<Wide>& d_cam) {
    const Camera& cam = view.cam;
    const Wide zero = Wide{};
    const Wide *u = g.rows, *v = g.rows + 3, *t = g.rows + 6;
    const double e = cam.eps2d;
    Wide d_steep[3] = {zero, zero, zero};  // by the normal before it gets length 1
    if (cam.normals) {
        const Wide along = dot3(g.normal, d.normal);
        for (int k = 0; k < 3; ++k)
            d_steep[k] = (d.normal[k] - g.normal[k] * along) * g.inverse_steepness;
        d.slope[0] += dot3(d_steep, g.J), d.slope[1] += dot3(d_steep, g.J + 3);
    }
    const Wide inverse_det = 1.0 / g.det;
    const Wide n_u = d.slope[0] * inverse_det, n_v = d.slope[1] * inverse_det;  // by numerators
    Wide d_det = -(d.conic[0] * g.A + d.conic[1] * g.B + d.conic[2] * g.C) * inverse_det -
                 n_u * g.slope[0] - n_v * g.slope[1];
    Wide d_sharp = zero;
    out.opacity = d.opacity;
    if (cam.antialiased) {
        const Wide root = compensation(g.ratio);
        out.opacity = d.opacity * root;
        const MaskOf<double> sharp = below(broadcast(kCompensationMin * kCompensationMin), g.ratio);
        const Wide d_ratio = choose(sharp, d.opacity * in.opacity * 0.5 / root, zero);
        d_sharp = d_ratio * inverse_det;
        d_det -= d_ratio * g.ratio * inverse_det;
    }
    d_sharp += d_det;
    const Wide d_xx = d.conic[2] * inverse_det + e * d_det;
    const Wide d_yy = d.conic[0] * inverse_det + e * d_det;
    const Wide d_xy = -d.conic[1] * inverse_det, d_tu = e * n_u, d_tv = e * n_v;
    Wide t_v[3], u_t[3], v_c[3], c_t[3], t_c[3], c_u[3], d_c[3], v_dc[3], dc_u[3];
    cross3(t, v, t_v), cross3(u, t, u_t), cross3(v, g.cross, v_c), cross3(g.cross, t, c_t);
    cross3(t, g.cross, t_c), cross3(g.cross, u, c_u);
    for (int k = 0; k < 3; ++k) d_c[k] = 2.0 * d_sharp * g.cross[k] + n_u * t_v[k] + n_v * u_t[k];
    cross3(v, d_c, v_dc), cross3(d_c, u, dc_u);
    Wide d_rows[9];
    for (int k = 0; k < 3; ++k) {
        d_rows[k] = 2.0 * d_xx * u[k] + d_xy * v[k] + d_tu * t[k] + n_v * t_c[k] + v_dc[k];
        d_rows[3 + k] = d_xy * u[k] + 2.0 * d_yy * v[k] + d_tv * t[k] + n_u * c_t[k] + dc_u[k];
        d_rows[6 + k] = d_tu * u[k] + d_tv * v[k] + n_u * v_c[k] + n_v * c_u[k];
    }
    Wide d_J[9], d_W[9], d_Rq[9];
    for (int k = 0; k < 3; ++k) out.scale[k] = zero;
    for (int i = 0; i < 3; ++i)
        for (int m = 0; m < 3; ++m) d_J[3 * i + m] = dot3(d_rows + 3 * i, g.M + 3 * m);
    for (int m = 0; m < 3; ++m) {
        d_J[m] += g.slope[0] * d_steep[m], d_J[3 + m] += g.slope[1] * d_steep[m];
        d_J[6 + m] -= d_steep[m];
    }
    for (int m = 0; m < 3; ++m)
        for (int k = 0; k < 3; ++k) {
            const Wide d_M =
                g.J[m] * d_rows[k] + g.J[3 + m] * d_rows[3 + k] + g.J[6 + m] * d_rows[6 + k];
            out.scale[k] += d_M * g.W[3 * m + k];
            d_W[3 * m + k] = d_M * in.scale[k];
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            d_Rq[3 * i + j] =
                cam.R[i] * d_W[j] + cam.R[3 + i] * d_W[3 + j] + cam.R[6 + i] * d_W[6 + j];
            d_cam.R[3 * i + j] += dot3(d_W + 3 * i, g.Rq + 3 * j);
        }
    quaternion_gradient(g, d_Rq, out.quat);

    const double* focal = view.focal;
    const Wide inverse_z = 1.0 / g.p[2];
    Wide d_p[3] = {zero, zero, zero}, d_focal[2], d_center[2];
    for (int i = 0; i < 2; ++i) {
        const Wide d_diagonal = d_J[3 * i + i], d_third = d_J[3 * i + 2];
        const Wide d_tan = -focal[i] * inverse_z * d_third;
        // Where the tangent is clamped, the bound itself moves with the intrinsics.
        const MaskOf<double> free = at_most(g.tan[i], g.tan_raw[i]) & at_most(g.tan_raw[i], g.tan[i]);
        const Wide d_bound = choose(free, zero, d_tan);
        const Wide d_raw = focal[i] * d.mean2d[i] + choose(free, d_tan, zero);
        d_focal[i] = (d_diagonal - g.tan[i] * d_third) * inverse_z + g.tan_raw[i] * d.mean2d[i] -
                     d_bound * g.tan[i] / focal[i];
        d_center[i] = d.mean2d[i] - d_bound / focal[i];
        d_p[2] += focal[i] * (g.tan[i] * d_third - d_diagonal) * (inverse_z * inverse_z);
        d_p[i] += d_raw * inverse_z;
        d_p[2] -= d_raw * g.tan_raw[i] * inverse_z;
    }
    const Wide* ray = g.J + 6;
    const Wide along = dot3(ray, d_J + 6), inverse_length = 1.0 / g.length;
    for (int i = 0; i < 3; ++i)
        d_p[i] += (d_J[6 + i] - ray[i] * along) * inverse_length + d.length * ray[i];

    d_cam.fx += d_focal[0], d_cam.fy += d_focal[1];
    d_cam.cx += d_center[0], d_cam.cy += d_center[1];
    for (int i = 0; i < 3; ++i) {
        d_cam.t[i] += d_p[i];
        for (int j = 0; j < 3; ++j) d_cam.R[3 * i + j] += d_p[i] * in.mean[j];
        out.mean[i] = cam.R[i] * d_p[0] + cam.R[3 + i] * d_p[1] + cam.R[6 + i] * d_p[2];
    }
}
