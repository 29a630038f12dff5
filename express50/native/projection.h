// Projection of one 3D Gaussian and its derivative, in double whatever the dtype of the scene.
// It follows grmm/rasterize/projection.py line by line; look there for the reasons.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

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

struct CameraGradient {
    double fx, fy, cx, cy, R[9], t[3];
};

struct Projected {
    bool front;
    double p[3], length;      // mean in camera coordinates, its distance
    double tan_raw[2], tan[2];  // x/z and y/z before and after the clamp
    double q[4], inverse_norm;  // unit quaternion, 1 / its length (0 for the zero quaternion)
    double Rq[9], W[9], M[9];   // rotation of the quaternion, R Rq, W diag(scales)
    double J[9];                // d(u, v, ray length) / d(camera coordinates)
    double rows[9];             // J M: square root of the covariance over (u, v, ray length)
    double xx, xy, yy, tu, tv;  // that covariance, before dilation
    double cross[3], det_sharp, det, ratio;
    double A, B, C;  // conic
    double mean2d[2], slope[2], opacity;
    double normal[3], inverse_steepness;  // see project_normal
};

inline double dot3(const double* a, const double* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline void cross3(const double* a, const double* b, double* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

inline void multiply3(const double* a, const double* b, double* out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

inline void quaternion_to_matrix(const double* q, double* m) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = 1 - 2 * (y * y + z * z), m[1] = 2 * (x * y - w * z), m[2] = 2 * (x * z + w * y);
    m[3] = 2 * (x * y + w * z), m[4] = 1 - 2 * (x * x + z * z), m[5] = 2 * (y * z - w * x);
    m[6] = 2 * (x * z - w * y), m[7] = 2 * (y * z + w * x), m[8] = 1 - 2 * (x * x + y * y);
}

// Unit normal, towards the camera, of the plane ray length = l + slope . (pixel - mean2d): minus the
// derivative of (ray length - slope . pixel) by camera coordinates.
inline void project_normal(Projected& g) {
    for (int k = 0; k < 3; ++k)
        g.normal[k] = g.slope[0] * g.J[k] + g.slope[1] * g.J[3 + k] - g.J[6 + k];
    const double steepness = std::sqrt(dot3(g.normal, g.normal));
    g.inverse_steepness = steepness > 0 ? 1 / steepness : 0;
    for (int k = 0; k < 3; ++k) g.normal[k] *= g.inverse_steepness;
}

template <class Real>
inline void project_one(const View& view, const Real* mean, const Real* quat, const Real* scale,
                        Real opacity, Projected& g) {
    const Camera& cam = view.cam;
    for (int i = 0; i < 3; ++i)
        g.p[i] = cam.R[3 * i] * mean[0] + cam.R[3 * i + 1] * mean[1] + cam.R[3 * i + 2] * mean[2] +
                 cam.t[i];
    g.front = g.p[2] > cam.near;
    if (!g.front) return;
    const double inverse_z = 1 / g.p[2];
    g.length = std::sqrt(dot3(g.p, g.p));
    for (int i = 0; i < 9; ++i) g.J[i] = 0;
    for (int i = 0; i < 2; ++i) {
        const double raw = g.p[i] * inverse_z, low = view.low[i], high = view.high[i];
        g.tan_raw[i] = raw;
        g.tan[i] = raw < low ? low : (raw > high ? high : raw);
        g.J[3 * i + i] = view.focal[i] * inverse_z;
        g.J[3 * i + 2] = -g.J[3 * i + i] * g.tan[i];
        g.mean2d[i] = view.focal[i] * raw + view.center[i];
    }
    const double inverse_length = 1 / g.length;
    for (int i = 0; i < 3; ++i) g.J[6 + i] = g.p[i] * inverse_length;

    const double q[4] = {double(quat[0]), double(quat[1]), double(quat[2]), double(quat[3])};
    const double norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    g.inverse_norm = norm2 == 0 ? 0 : 1 / std::sqrt(norm2);
    for (int i = 0; i < 4; ++i) g.q[i] = norm2 == 0 ? double(i == 0) : q[i] * g.inverse_norm;
    quaternion_to_matrix(g.q, g.Rq);
    multiply3(cam.R, g.Rq, g.W);
    for (int i = 0; i < 9; ++i) g.M[i] = g.W[i] * scale[i % 3];
    multiply3(g.J, g.M, g.rows);

    const double *u = g.rows, *v = g.rows + 3, *t = g.rows + 6, e = cam.eps2d;
    g.xx = dot3(u, u), g.xy = dot3(u, v), g.yy = dot3(v, v);
    g.tu = dot3(t, u), g.tv = dot3(t, v);
    cross3(u, v, g.cross);
    g.det_sharp = dot3(g.cross, g.cross);
    g.det = g.det_sharp + e * (g.xx + g.yy) + e * e;
    const double inverse_det = 1 / g.det;
    g.A = (g.yy + e) * inverse_det, g.B = -g.xy * inverse_det, g.C = (g.xx + e) * inverse_det;
    double t_v[3], u_t[3];
    cross3(t, v, t_v), cross3(u, t, u_t);
    g.slope[0] = (e * g.tu + dot3(g.cross, t_v)) * inverse_det;
    g.slope[1] = (e * g.tv + dot3(g.cross, u_t)) * inverse_det;
    g.opacity = double(opacity);
    g.ratio = g.det_sharp * inverse_det;
    if (cam.antialiased)
        g.opacity *= std::sqrt(std::max(g.ratio, kCompensationMin * kCompensationMin));
    if (cam.normals) project_normal(g);
}

// Gradient of a loss by what the blending reads of one Gaussian.
struct SplatGradient {
    double mean2d[2], conic[3], opacity, length, slope[2], normal[3];
};

// Derivative by the quaternion (before normalisation) of sum(G * Rq).
inline void quaternion_gradient(const Projected& g, const double* G, double* out) {
    const double w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    const double d[4] = {
        2 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1])),
        2 * (-2 * x * (G[4] + G[8]) + y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5])),
        2 * (x * (G[1] + G[3]) - 2 * y * (G[0] + G[8]) + z * (G[5] + G[7]) + w * (G[2] - G[6])),
        2 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) - 2 * z * (G[0] + G[4]) + w * (G[3] - G[1]))};
    const double along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    for (int i = 0; i < 4; ++i) out[i] = (d[i] - g.q[i] * along) * g.inverse_norm;
}

// Writes gradients by mean, quaternion, scale and opacity; adds those by the camera.
template <class Real>
inline void project_gradient(const View& view, const Real* mean, const Real* scale, Real opacity,
                             const Projected& g, SplatGradient d, double* d_mean, double* d_quat,
                             double* d_scale, double* d_opacity, CameraGradient& d_cam) {
    const Camera& cam = view.cam;
    const double *u = g.rows, *v = g.rows + 3, *t = g.rows + 6, e = cam.eps2d;
    double d_steep[3] = {0, 0, 0};  // by the normal before it gets length 1
    if (cam.normals) {
        const double along = dot3(g.normal, d.normal);
        for (int k = 0; k < 3; ++k)
            d_steep[k] = (d.normal[k] - g.normal[k] * along) * g.inverse_steepness;
        d.slope[0] += dot3(d_steep, g.J), d.slope[1] += dot3(d_steep, g.J + 3);
    }
    const double inverse_det = 1 / g.det;
    const double n_u = d.slope[0] * inverse_det, n_v = d.slope[1] * inverse_det;  // by numerators
    double d_det = -(d.conic[0] * g.A + d.conic[1] * g.B + d.conic[2] * g.C) * inverse_det -
                   n_u * g.slope[0] - n_v * g.slope[1];
    double d_sharp = 0;
    *d_opacity = d.opacity;
    if (cam.antialiased) {
        const double root = std::sqrt(std::max(g.ratio, kCompensationMin * kCompensationMin));
        *d_opacity = d.opacity * root;
        if (g.ratio > kCompensationMin * kCompensationMin) {
            const double d_ratio = d.opacity * double(opacity) * 0.5 / root;
            d_sharp = d_ratio * inverse_det;
            d_det -= d_ratio * g.ratio * inverse_det;
        }
    }
    d_sharp += d_det;
    const double d_xx = d.conic[2] * inverse_det + e * d_det;
    const double d_yy = d.conic[0] * inverse_det + e * d_det;
    const double d_xy = -d.conic[1] * inverse_det, d_tu = e * n_u, d_tv = e * n_v;
    double t_v[3], u_t[3], v_c[3], c_t[3], t_c[3], c_u[3], d_c[3], v_dc[3], dc_u[3];
    cross3(t, v, t_v), cross3(u, t, u_t), cross3(v, g.cross, v_c), cross3(g.cross, t, c_t);
    cross3(t, g.cross, t_c), cross3(g.cross, u, c_u);
    for (int k = 0; k < 3; ++k) d_c[k] = 2 * d_sharp * g.cross[k] + n_u * t_v[k] + n_v * u_t[k];
    cross3(v, d_c, v_dc), cross3(d_c, u, dc_u);
    double d_rows[9];
    for (int k = 0; k < 3; ++k) {
        d_rows[k] = 2 * d_xx * u[k] + d_xy * v[k] + d_tu * t[k] + n_v * t_c[k] + v_dc[k];
        d_rows[3 + k] = d_xy * u[k] + 2 * d_yy * v[k] + d_tv * t[k] + n_u * c_t[k] + dc_u[k];
        d_rows[6 + k] = d_tu * u[k] + d_tv * v[k] + n_u * v_c[k] + n_v * c_u[k];
    }
    double d_J[9], d_W[9], d_Rq[9];
    for (int k = 0; k < 3; ++k) d_scale[k] = 0;
    for (int i = 0; i < 3; ++i)
        for (int m = 0; m < 3; ++m) d_J[3 * i + m] = dot3(d_rows + 3 * i, g.M + 3 * m);
    for (int m = 0; m < 3; ++m) {
        d_J[m] += g.slope[0] * d_steep[m], d_J[3 + m] += g.slope[1] * d_steep[m];
        d_J[6 + m] -= d_steep[m];
    }
    for (int m = 0; m < 3; ++m)
        for (int k = 0; k < 3; ++k) {
            const double d_M =
                g.J[m] * d_rows[k] + g.J[3 + m] * d_rows[3 + k] + g.J[6 + m] * d_rows[6 + k];
            d_scale[k] += d_M * g.W[3 * m + k];
            d_W[3 * m + k] = d_M * scale[k];
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            d_Rq[3 * i + j] = cam.R[i] * d_W[j] + cam.R[3 + i] * d_W[3 + j] + cam.R[6 + i] * d_W[6 + j];
            d_cam.R[3 * i + j] += dot3(d_W + 3 * i, g.Rq + 3 * j);
        }
    quaternion_gradient(g, d_Rq, d_quat);

    const double* focal = view.focal;
    const double inverse_z = 1 / g.p[2];
    double d_p[3] = {0, 0, 0}, d_focal[2], d_center[2];
    for (int i = 0; i < 2; ++i) {
        const double d_diagonal = d_J[3 * i + i], d_third = d_J[3 * i + 2];
        const double d_tan = -focal[i] * inverse_z * d_third;
        double d_raw = focal[i] * d.mean2d[i];
        d_focal[i] = (d_diagonal - g.tan[i] * d_third) * inverse_z + g.tan_raw[i] * d.mean2d[i];
        d_center[i] = d.mean2d[i];
        d_p[2] += focal[i] * (g.tan[i] * d_third - d_diagonal) * (inverse_z * inverse_z);
        if (g.tan[i] == g.tan_raw[i]) {
            d_raw += d_tan;
        } else {  // the bound itself moves with the intrinsics
            d_center[i] -= d_tan / focal[i];
            d_focal[i] -= d_tan * g.tan[i] / focal[i];
        }
        d_p[i] += d_raw * inverse_z;
        d_p[2] -= d_raw * g.tan_raw[i] * inverse_z;
    }
    const double* ray = g.J + 6;
    const double along = dot3(ray, d_J + 6);
    for (int i = 0; i < 3; ++i)
        d_p[i] += (d_J[6 + i] - ray[i] * along) / g.length + d.length * ray[i];

    d_cam.fx += d_focal[0], d_cam.fy += d_focal[1];
    d_cam.cx += d_center[0], d_cam.cy += d_center[1];
    for (int i = 0; i < 3; ++i) {
        d_cam.t[i] += d_p[i];
        for (int j = 0; j < 3; ++j) d_cam.R[3 * i + j] += d_p[i] * double(mean[j]);
        d_mean[i] = cam.R[i] * d_p[0] + cam.R[3 + i] * d_p[1] + cam.R[6 + i] * d_p[2];
    }
}
