/* Batches: blocks of points in structure-of-arrays form, so that the compiler's vectors apply. The polynomial family
 * goes through loops of basic operations; what needs iterations or another radial function goes point by point. */
#include "real.h"

#include <float.h>
#include <string.h>

#define BLOCK 64

/* PF_WIDE (CMake: x86-64 Linux): a second copy of each loop for AVX2, chosen when the program starts. Basic operations
 * without contraction give the same bits in both. */
#ifdef PF_WIDE
#define WIDE __attribute__((target_clones("default", "avx2")))
#else
#define WIDE
#endif

/* theta, cos phi, sin phi and validity of a block. */
WIDE static void angles(const double *restrict xyz, size_t n, double theta_max, double *restrict theta,
                        double *restrict c, double *restrict s, double *restrict valid)
{
    double x[BLOCK], y[BLOCK], z[BLOCK];
    for (size_t i = 0; i < n; i++) {
        x[i] = xyz[3 * i];
        y[i] = xyz[3 * i + 1];
        z[i] = xyz[3 * i + 2];
    }
    for (size_t i = n; i < BLOCK; i++)
        x[i] = y[i] = 0, z[i] = 1;
    for (size_t i = 0; i < BLOCK; i++) {
        double rho = sqrt(x[i] * x[i] + y[i] * y[i]);
        bool on_axis = rho <= AXIS_RHO;
        double inverse = 1 / (on_axis ? 1 : rho);
        double angle = angle_of(rho, z[i]);
        bool ahead = !(on_axis & (z[i] < 0)) & (angle <= theta_max + THETA_SLACK);
        valid[i] = (point_is_sound(x[i], y[i], z[i]) & ahead) ? 1 : 0;
        theta[i] = angle < theta_max ? angle : theta_max;
        c[i] = on_axis ? 1 : x[i] * inverse;
        s[i] = y[i] * (on_axis ? 0 : inverse);
    }
}

WIDE static void generic_block(const pf_camera *camera, camera_kind kind, const double *restrict theta,
                               const double *restrict c, const double *restrict s, double *restrict r,
                               double *restrict t)
{
    double none;
    for (size_t i = 0; i < BLOCK; i++) {
        r[i] = generic_radial(camera, theta[i], &none);
        t[i] = 0;
    }
    if (kind.asymmetric)
        for (size_t i = 0; i < BLOCK; i++)
            add_asymmetry(camera, theta[i], c[i], s[i], &r[i], &t[i]);
    if (kind.cpoly)
        for (size_t i = 0; i < BLOCK; i++)
            add_cpoly(camera, theta[i], c[i], s[i], &r[i], &t[i]);
}

WIDE static void sensor_block(const pf_camera *camera, sensor_tilt tilt, const double *restrict theta,
                              const double *restrict c, const double *restrict s, const double *restrict r,
                              const double *restrict t, double *restrict u, double *restrict v)
{
    for (size_t i = 0; i < BLOCK; i++) {
        double uv[2];
        sensor_value(camera, tilt, theta[i], c[i], s[i], r[i], t[i], uv);
        u[i] = uv[0];
        v[i] = uv[1];
    }
}

static void put_invalid(double *out, size_t n)
{
    for (size_t i = 0; i < n; i++)
        out[i] = (double)NAN;
}

static void project_block(const pf_camera *camera, camera_kind kind, sensor_tilt tilt, size_t n, const double *xyz,
                          double *uv, uint8_t *ok)
{
    double theta[BLOCK], c[BLOCK], s[BLOCK], valid[BLOCK], r[BLOCK], t[BLOCK], u[BLOCK], v[BLOCK];
    angles(xyz, n, camera->theta_max, theta, c, s, valid);
    if (camera->radial == PF_RADIAL_GENERIC)
        generic_block(camera, kind, theta, c, s, r, t);
    else
        for (size_t i = 0; i < BLOCK; i++)
            lens_value(camera, kind, theta[i], c[i], s[i], &r[i], &t[i]);
    sensor_block(camera, tilt, theta, c, s, r, t, u, v);
    for (size_t i = 0; i < n; i++) {
        ok[i] = valid[i] > 0;
        uv[2 * i] = ok[i] ? u[i] : (double)NAN;
        uv[2 * i + 1] = ok[i] ? v[i] : (double)NAN;
    }
}

void pf_camera_project_n(const pf_camera *camera, size_t n, const double *xyz, double *uv, uint8_t *ok)
{
    camera_kind kind = pf_camera_kind(camera);
    sensor_tilt tilt = {0, 0};
    if (kind.tilted)
        tilt = pf_camera_sensor_tilt(camera);
    for (size_t i = 0; i < n && camera->pupil_e1 == 0; i += BLOCK)
        project_block(camera, kind, tilt, n - i < BLOCK ? n - i : BLOCK, xyz + 3 * i, uv + 2 * i, ok + i);
    for (size_t i = 0; i < n && camera->pupil_e1 != 0; i++) {
        ok[i] = pf_camera_project(camera, xyz + 3 * i, uv + 2 * i, NULL, NULL) == PF_OK;
        if (!ok[i])
            put_invalid(uv + 2 * i, 2);
    }
}

/* A start for the inverse of the polynomial: theta / rd as a Chebyshev series in rd^2, interpolated at its nodes. */
#define START_TERMS 12

typedef struct inverse_start {
    double rd_max, to_unit; /* u = to_unit rd^2 - 1 */
    double a[START_TERMS];
} inverse_start;

static inverse_start make_start(const pf_camera *camera)
{
    /* cos((2 j + 1) pi / 24): the nodes; T_k there is cos(k (2 j + 1) pi / 24). */
    inverse_start start = {pf_camera_radius(camera, camera->theta_max, NULL), 0, {0}};
    start.to_unit = 2 / (start.rd_max * start.rd_max);
    for (int j = 0; j < START_TERMS; j++) {
        double sine, u;
        sine_cosine((2 * j + 1) * (PI_ALL / (2 * START_TERMS)), &sine, &u);
        double rd = start.rd_max * sqrt(0.5 * (u + 1));
        double value = pf_camera_radial_solve(camera, rd) / rd;
        double before = 1, now = u;
        start.a[0] += value / START_TERMS;
        for (int k = 1; k < START_TERMS; k++) {
            start.a[k] += 2 * now * value / START_TERMS;
            double next = 2 * u * now - before;
            before = now;
            now = next;
        }
    }
    return start;
}

/* Two Newton steps from the series. settled[i]: the last step was so small that what is left, its square times
 * r'' / 2 r', is below rounding: 1e-9 relative, with r' kept from 0. */
WIDE static void inverse_block(const pf_camera *camera, const inverse_start *start, const double *restrict uv, size_t n,
                               double *restrict ray, double *restrict theta_out, double *restrict settled)
{
    double x[BLOCK], y[BLOCK], rd[BLOCK], theta[BLOCK], sine[BLOCK], cosine[BLOCK];
    for (size_t i = 0; i < BLOCK; i++)
        x[i] = y[i] = 0;
    for (size_t i = 0; i < n; i++) {
        y[i] = (uv[2 * i + 1] - camera->c_v) / camera->f_v;
        x[i] = (uv[2 * i] - camera->c_u - camera->skew * y[i]) / camera->f_u;
    }
    for (size_t i = 0; i < BLOCK; i++) {
        rd[i] = sqrt(x[i] * x[i] + y[i] * y[i]);
        double u = start->to_unit * rd[i] * rd[i] - 1, b1 = 0, b2 = 0;
        for (int k = START_TERMS - 1; k > 0; k--) {
            double b = start->a[k] + 2 * u * b1 - b2;
            b2 = b1;
            b1 = b;
        }
        theta[i] = rd[i] * (start->a[0] + u * b1 - b2);
    }
    for (size_t i = 0; i < BLOCK; i++) {
        double slope, t = theta[i];
        double step = (t * generic_radial(camera, t, &slope) - rd[i]) / slope;
        t -= step;
        step = (t * generic_radial(camera, t, &slope) - rd[i]) / slope;
        t -= step;
        settled[i] = ((fabs(step) <= 1e-9 * t) & (slope > 1e-3) & (rd[i] < start->rd_max)) ? 1 : 0;
        theta[i] = t < camera->theta_max ? t : camera->theta_max;
        sine_cosine(theta[i], &sine[i], &cosine[i]);
    }
    for (size_t i = 0; i < n; i++) {
        double scale = sine[i] / (rd[i] > 0 ? rd[i] : 1);
        ray[3 * i] = scale * x[i];
        ray[3 * i + 1] = scale * y[i];
        ray[3 * i + 2] = cosine[i];
        theta_out[i] = theta[i];
    }
}

void pf_camera_unproject_n(const pf_camera *camera, size_t n, const double *uv, double *ray, double *origin,
                           uint8_t *ok)
{
    camera_kind kind = pf_camera_kind(camera);
    bool polynomial = camera->radial == PF_RADIAL_GENERIC && !kind.asymmetric && !kind.cpoly && !kind.tilted;
    inverse_start start = {0};
    if (polynomial && n >= START_TERMS)
        start = make_start(camera);
    else
        polynomial = false;
    for (size_t from = 0; from < n; from += BLOCK) {
        size_t count = n - from < BLOCK ? n - from : BLOCK;
        double theta[BLOCK], settled[BLOCK];
        if (polynomial)
            inverse_block(camera, &start, uv + 2 * from, count, ray + 3 * from, theta, settled);
        for (size_t j = 0; j < count; j++) {
            size_t i = from + j;
            double at[3];
            ok[i] = polynomial && settled[j] > 0;
            if (ok[i]) {
                at[0] = at[1] = 0;
                at[2] = camera->pupil_e1 * theta[j] * theta[j];
            } else {
                ok[i] = pf_camera_unproject(camera, uv + 2 * i, ray + 3 * i, at, NULL) == PF_OK;
                if (!ok[i]) {
                    put_invalid(ray + 3 * i, 3);
                    put_invalid(at, 3);
                }
            }
            if (origin)
                memcpy(origin + 3 * i, at, sizeof at);
        }
    }
}
