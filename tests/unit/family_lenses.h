/* A lens of each family, and the model in long double from its definition in camera.h: with explicit angles and complex
 * numbers, which the code has not. */
#ifndef PIPEFISH_TESTS_FAMILY_LENSES_H
#define PIPEFISH_TESTS_FAMILY_LENSES_H

#include "pipefish/camera.h"

#include <complex.h>
#include <math.h>
#include <string.h>

#define DEGREES (3.14159265358979323846 / 180)

static inline pf_camera plain(uint32_t radial, double theta_max_degrees)
{
    pf_camera camera = {.width = 1280, .height = 960, .f_u = 301.5, .f_v = 299.1, .c_u = 641.3, .c_v = 478.8};
    camera.radial = radial;
    camera.theta_max = theta_max_degrees * DEGREES;
    return camera;
}

static inline void add_polynomial(pf_camera *camera)
{
    camera->k2 = -0.031;
    camera->k3 = 0.0042;
    camera->k4 = -0.0011;
    camera->k5 = 0.00006;
}

static inline void add_p23(pf_camera *camera, double size)
{
    const double l[3] = {0.002, -0.0015, 0.0007}, m[3] = {-0.001, 0.0012, -0.0004};
    const double i[4] = {0.5, -0.7, 0.1, 0.5}, j[4] = {0.1, 0.7, -0.7, 0.1}; /* unit norm */
    for (int k = 0; k < 3; k++) {
        camera->asym_radial_theta[k] = size * l[k];
        camera->asym_tangential_theta[k] = size * m[k];
    }
    memcpy(camera->asym_radial_phi, i, sizeof i);
    memcpy(camera->asym_tangential_phi, j, sizeof j);
}

static inline void add_cpoly(pf_camera *camera, double size)
{
    for (int i = 0; i < PF_CPOLY_MAX; i++)
        camera->cpoly[i] = size * 1e-3 * (i % 3 == 0 ? 1.1 : i % 3 == 1 ? -0.8 : 0.6) / (1 + i / 6);
}

#define LENSES 15
static inline pf_camera lens(int number)
{
    pf_camera camera = plain(PF_RADIAL_GENERIC, 110);
    add_polynomial(&camera);
    switch (number) {
    case 0: /* asymmetry as of a real lens: about 1 px */
        add_p23(&camera, 1);
        return camera;
    case 1: /* 10 px */
        add_p23(&camera, 8);
        return camera;
    case 2:
        add_cpoly(&camera, 1);
        return camera;
    case 3:
        add_cpoly(&camera, 20);
        camera.skew = 3;
        return camera;
    case 4:
        camera.tilt[0] = 0.05;
        camera.tilt[1] = -0.08;
        return camera;
    case 5:
        camera.pupil_e1 = 0.0027;
        return camera;
    case 6: /* everything at once, the pupil moving backwards */
        add_p23(&camera, 5);
        add_cpoly(&camera, 3);
        camera.tilt[0] = -0.03;
        camera.skew = -1.5;
        camera.pupil_e1 = -0.0011;
        return camera;
    case 7:
        return plain(PF_RADIAL_PERSPECTIVE, 75);
    case 8:
        return plain(PF_RADIAL_STEREOGRAPHIC, 120);
    case 9:
        return plain(PF_RADIAL_EQUIDISTANT, 170);
    case 10:
        return plain(PF_RADIAL_EQUISOLID, 150);
    case 11:
        return plain(PF_RADIAL_ORTHOGRAPHIC, 80);
    case 12:
        camera = plain(PF_RADIAL_UNIFIED, 130);
        camera.mirror = 0.96;
        return camera;
    case 13:
        camera = plain(PF_RADIAL_UNIFIED, 105);
        camera.mirror = 1.7;
        add_cpoly(&camera, 2);
        return camera;
    default:
        camera = plain(PF_RADIAL_STEREOGRAPHIC, 100);
        add_p23(&camera, 2);
        camera.pupil_e1 = 0.0009;
        return camera;
    }
}

static inline long double radial_truth(const pf_camera *camera, long double t)
{
    switch (camera->radial) {
    case PF_RADIAL_PERSPECTIVE:
        return tanl(t);
    case PF_RADIAL_STEREOGRAPHIC:
        return 2 * tanl(t / 2);
    case PF_RADIAL_EQUISOLID:
        return 2 * sinl(t / 2);
    case PF_RADIAL_ORTHOGRAPHIC:
        return sinl(t);
    case PF_RADIAL_UNIFIED:
        return (camera->mirror + 1) * sinl(t) / (camera->mirror + cosl(t));
    default:
        return t + camera->k2 * powl(t, 3) + camera->k3 * powl(t, 5) + camera->k4 * powl(t, 7) +
               camera->k5 * powl(t, 9);
    }
}

static inline long double factors(const double a[3], const double b[4], long double t, long double phi)
{
    return (a[0] * t + a[1] * powl(t, 3) + a[2] * powl(t, 5)) *
           (b[0] * cosl(phi) + b[1] * sinl(phi) + b[2] * cosl(2 * phi) + b[3] * sinl(2 * phi));
}

/* The pixel of the ray (theta, phi). */
static inline void pixel_truth(const pf_camera *camera, long double theta, long double phi, double uv[2])
{
    static const int m[7] = {0, 2, 1, 0, 3, 1, 0}, n[7] = {1, 0, 1, 2, 0, 2, 3};
    long double radial =
        radial_truth(camera, theta) + factors(camera->asym_radial_theta, camera->asym_radial_phi, theta, phi);
    long double tangential = factors(camera->asym_tangential_theta, camera->asym_tangential_phi, theta, phi);
    long double x = radial * cosl(phi) - tangential * sinl(phi), y = radial * sinl(phi) + tangential * cosl(phi);
    long double complex z = theta * cosl(phi) + theta * sinl(phi) * (long double complex)I;
    for (int k = 0; k < 7; k++) {
        long double complex term = camera->cpoly[2 * k] + camera->cpoly[2 * k + 1] * (long double complex)I;
        for (int i = 0; i < m[k]; i++)
            term *= z;
        for (int i = 0; i < n[k]; i++)
            term *= conjl(z);
        x += creall(term);
        y += cimagl(term);
    }
    long double d = 1 + tanl(camera->tilt[1]) * x - tanl(camera->tilt[0]) * y;
    uv[0] = (double)(camera->f_u * x / d + camera->skew * y / d + camera->c_u);
    uv[1] = (double)(camera->f_v * y / d + camera->c_v);
}

#endif
