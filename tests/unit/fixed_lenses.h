/* Lenses for the tests of the fixed-point camera, and the model in long double by a road of its own: angles, sines and
 * complex numbers, no tables. */
#ifndef PIPEFISH_TESTS_FIXED_LENSES_H
#define PIPEFISH_TESTS_FIXED_LENSES_H

#include "pipefish/camera_fixed.h"

#include <complex.h>
#include <math.h>

typedef struct lens_case {
    const char *name;
    pf_camera camera;
} lens_case;

#define SENSOR .width = 1280, .height = 800, .c_u = 640.3, .c_v = 399.2
#define F300   SENSOR, .f_u = 300, .f_v = 300.5
#define P9     F300, .k2 = -.02, .k3 = .003, .k4 = -.001, .k5 = .00005
#define D_TERMS(scale)                                                                                                 \
    .asym_radial_theta = {.003 * (scale), .002 * (scale), -.001 * (scale)}, .asym_radial_phi = {.5, .5, -.5, .5},      \
    .asym_tangential_theta = {.002 * (scale), -.001 * (scale), .0005 * (scale)},                                       \
    .asym_tangential_phi = {.5, -.5, .5, .5}
#define C_TERMS(s)                                                                                                     \
    .cpoly = {-.004 * (s), 0,           .004 * (s), -.002 * (s), .002 * (s), -.004 * (s), 0,                           \
              .004 * (s),  -.002 * (s), .002 * (s), -.004 * (s), 0,          .004 * (s),  -.002 * (s)}

static const lens_case LENSES[] = {
    {"p9 to 110 degrees", {P9, .theta_max = 1.92}},
    {"p9 to 60 degrees", {P9, .theta_max = 1.0472}},
    {"perspective to 69 degrees", {F300, .radial = PF_RADIAL_PERSPECTIVE, .theta_max = 1.2}},
    {"perspective to 85 degrees", {F300, .radial = PF_RADIAL_PERSPECTIVE, .theta_max = 1.48}},
    {"stereographic to 110 degrees", {F300, .radial = PF_RADIAL_STEREOGRAPHIC, .theta_max = 1.92}},
    {"stereographic to 166 degrees",
     {SENSOR, .f_u = 100, .f_v = 99, .radial = PF_RADIAL_STEREOGRAPHIC, .theta_max = 2.9}},
    {"equidistant to 178 degrees", {F300, .radial = PF_RADIAL_EQUIDISTANT, .theta_max = 3.1}},
    {"equisolid to 110 degrees", {F300, .radial = PF_RADIAL_EQUISOLID, .theta_max = 1.92}},
    {"equisolid to 170 degrees", {F300, .radial = PF_RADIAL_EQUISOLID, .theta_max = 2.967}},
    {"orthographic to 80 degrees", {F300, .radial = PF_RADIAL_ORTHOGRAPHIC, .theta_max = 1.39}},
    {"orthographic to 89.5 degrees", {F300, .radial = PF_RADIAL_ORTHOGRAPHIC, .theta_max = 1.562}},
    {"unified, mirror .8", {F300, .radial = PF_RADIAL_UNIFIED, .mirror = .8, .theta_max = 1.92}},
    {"unified, mirror 1.2", {F300, .radial = PF_RADIAL_UNIFIED, .mirror = 1.2, .theta_max = 2.4}},
    {"r' falls to .004", {F300, .k2 = -1 / (3 * 3.7), .theta_max = 1.92}},
    {"r' dips to 1e-4", {F300, .k2 = -2. / 3, .k3 = 1.0001 / 5, .theta_max = 1.92}},
    {"narrow, f = 1e5", {SENSOR, .f_u = 1e5, .f_v = 1e5, .theta_max = .01}},
    {"narrowest", {SENSOR, .f_u = 1e5, .f_v = 9e4, .theta_max = 1e-6}},
    {"16000 px wide",
     {.width = 16384, .height = 16384, .c_u = 8191, .c_v = 8000.7, .f_u = 5000, .f_v = 5010, .theta_max = 1.62}},
    {"small, f = 20", {.width = 64, .height = 48, .c_u = 31, .c_v = 24, .f_u = 20, .f_v = 19.9, .theta_max = 1.8}},
    {"p23", {P9, D_TERMS(1), .theta_max = 1.92}},
    {"p23, strong", {P9, D_TERMS(10), .theta_max = 1.92}},
    {"cpoly", {P9, C_TERMS(1), .theta_max = 1.92}},
    {"cpoly, strong", {P9, C_TERMS(4), .theta_max = 1.92}},
    {"cpoly and p23, skew, tilt", {P9, D_TERMS(5), C_TERMS(1), .skew = 4, .tilt = {.03, -.05}, .theta_max = 1.92}},
    {"tilt and skew", {P9, .skew = -7, .tilt = {-.08, .06}, .theta_max = 1.7}},
    {"pupil shift forward", {P9, .pupil_e1 = .004, .theta_max = 1.92}},
    {"pupil shift backward, cpoly", {P9, C_TERMS(1), .pupil_e1 = -.003, .theta_max = 1.92}},
};
#define LENSES_COUNT (sizeof LENSES / sizeof LENSES[0])

static inline long double true_radius(const pf_camera *camera, long double theta)
{
    switch (camera->radial) {
    case PF_RADIAL_PERSPECTIVE:
        return tanl(theta);
    case PF_RADIAL_STEREOGRAPHIC:
        return 2 * tanl(theta / 2);
    case PF_RADIAL_EQUIDISTANT:
        return theta;
    case PF_RADIAL_EQUISOLID:
        return 2 * sinl(theta / 2);
    case PF_RADIAL_ORTHOGRAPHIC:
        return sinl(theta);
    case PF_RADIAL_UNIFIED:
        return (camera->mirror + 1) * sinl(theta) / (camera->mirror + cosl(theta));
    default:
        return theta + camera->k2 * powl(theta, 3) + camera->k3 * powl(theta, 5) + camera->k4 * powl(theta, 7) +
               camera->k5 * powl(theta, 9);
    }
}

static inline long double true_term(const double a[3], const double b[4], long double theta, long double phi)
{
    return (a[0] * theta + a[1] * powl(theta, 3) + a[2] * powl(theta, 5)) *
           (b[0] * cosl(phi) + b[1] * sinl(phi) + b[2] * cosl(2 * phi) + b[3] * sinl(2 * phi));
}

/* The plane before the sensor. */
static inline long double complex true_plane(const pf_camera *camera, long double complex z)
{
    static const int m[7] = {0, 2, 1, 0, 3, 1, 0}, n[7] = {1, 0, 1, 2, 0, 2, 3};
    long double theta = cabsl(z), phi = cargl(z);
    long double complex w = true_radius(camera, theta) +
                            true_term(camera->asym_radial_theta, camera->asym_radial_phi, theta, phi) +
                            I * true_term(camera->asym_tangential_theta, camera->asym_tangential_phi, theta, phi);
    w *= cexpl(I * phi);
    for (int k = 0; k < 7; k++) {
        long double complex term = camera->cpoly[2 * k] + I * camera->cpoly[2 * k + 1];
        for (int i = 0; i < m[k]; i++)
            term *= z;
        for (int i = 0; i < n[k]; i++)
            term *= conjl(z);
        w += term;
    }
    return w;
}

static inline void true_pixel(const pf_camera *camera, long double complex z, long double uv[2])
{
    long double complex w = true_plane(camera, z);
    w /= 1 + tanl(camera->tilt[1]) * creall(w) - tanl(camera->tilt[0]) * cimagl(w);
    uv[0] = camera->f_u * creall(w) + camera->skew * cimagl(w) + camera->c_u;
    uv[1] = camera->f_v * cimagl(w) + camera->c_v;
}

/* The Jacobian of the pixel by Z, by central differences good to 1e-9. */
static inline void true_jacobian(const pf_camera *camera, long double complex z, long double j[2][2])
{
    long double h = 1e-6L * (long double)camera->theta_max, a[2], b[2];
    for (int k = 0; k < 2; k++) {
        long double complex step = k ? h * I : h;
        true_pixel(camera, z + step, a);
        true_pixel(camera, z - step, b);
        j[0][k] = (a[0] - b[0]) / (2 * h);
        j[1][k] = (a[1] - b[1]) / (2 * h);
    }
}

/* Z of a pixel by Newton from a start near it. */
static inline long double complex true_inverse(const pf_camera *camera, const long double pixel[2],
                                               long double complex z)
{
    for (int i = 0; i < 8; i++) {
        long double uv[2], j[2][2];
        true_pixel(camera, z, uv);
        true_jacobian(camera, z, j);
        long double det = j[0][0] * j[1][1] - j[0][1] * j[1][0], du = pixel[0] - uv[0], dv = pixel[1] - uv[1];
        z += (j[1][1] * du - j[0][1] * dv + I * (j[0][0] * dv - j[1][0] * du)) / det;
    }
    return z;
}

static inline double as_pixels(int32_t v)
{
    return v / 65536.0;
}

static inline double as_unit(int32_t v)
{
    return v / 1073741824.0;
}

static inline uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 8; /* 24 bits */
}

static inline double random_share(uint32_t *state) /* 0..1 */
{
    return next_random(state) / 16777216.0;
}

static inline double random_sign(uint32_t *state) /* -1..1 */
{
    return 2 * random_share(state) - 1;
}

static inline double random_scale(uint32_t *state, double low, double high)
{
    return low * pow(high / low, random_share(state));
}

/* A camera from all over the legal ranges: most are ordinary in most ways and extreme in some. pf_camera_check decides
 * whether it is one. */
static inline pf_camera random_camera(uint32_t *state)
{
    static const double reach[10] = {1e-6, 1e-3, .05, .3, .9, 1.2, 1.5, 1.92, 2.6, 3.1415};
    pf_camera c = {.width = 1 + next_random(state) % 16384, .height = 1 + next_random(state) % 16384};
    c.radial = next_random(state) % 7;
    c.theta_max = reach[next_random(state) % 10] * (1 - .01 * random_share(state));
    if ((c.radial == PF_RADIAL_PERSPECTIVE || c.radial == PF_RADIAL_ORTHOGRAPHIC) && c.theta_max > 1.5)
        c.theta_max = 1.5 + .07 * random_share(state);
    c.f_u = next_random(state) % 2 ? random_scale(state, 50, 2000) : random_scale(state, .1, 1e5);
    c.f_v = next_random(state) % 2 ? c.f_u * (1 + .02 * random_sign(state)) : random_scale(state, .1, 1e5);
    c.skew = next_random(state) % 4 ? 0 : random_sign(state) * c.f_u;
    c.c_u = next_random(state) % 4 ? c.width * .5 : 1e5 * random_sign(state);
    c.c_v = next_random(state) % 4 ? c.height * .5 : 1e5 * random_sign(state);
    if (next_random(state) % 2) {
        double most = next_random(state) % 2 ? .7 : .1;
        c.tilt[0] = most * random_sign(state);
        c.tilt[1] = most * random_sign(state);
    }
    double square = c.theta_max * c.theta_max, size = random_scale(state, 1e-3, 3), power = square;
    for (int i = 0; i < 4 && c.radial == PF_RADIAL_GENERIC; i++, power *= square)
        *pf_camera_param_at(&c, PF_PARAM_K2 + (uint32_t)i) = size * random_sign(state) / power;
    if (c.radial == PF_RADIAL_UNIFIED)
        c.mirror = random_scale(state, .01, 1000);
    size = random_scale(state, 1e-5, .3);
    for (int k = 0; k < 2; k++) {
        double *a = k ? c.asym_tangential_theta : c.asym_radial_theta,
               *b = k ? c.asym_tangential_phi : c.asym_radial_phi, norm = 0;
        if (next_random(state) % 3)
            continue;
        for (int i = 0; i < 4; i++)
            b[i] = random_sign(state), norm += b[i] * b[i];
        for (int i = 0; i < 4; i++)
            b[i] /= sqrt(norm);
        for (int i = 0; i < 3; i++)
            a[i] = size * random_sign(state) / pow(c.theta_max, 2 * i);
    }
    if (next_random(state) % 3 == 0)
        for (int i = 0; i < PF_CPOLY_MAX; i++)
            c.cpoly[i] = .3 * size * random_sign(state) / pow(c.theta_max, i < 2 ? 0 : i < 8 ? 1 : 2);
    return c;
}

#endif
