/* Profiles for the tests, and what makes changed bytes intact again. */
#ifndef PIPEFISH_TESTS_PROFILE_SAMPLES_H
#define PIPEFISH_TESTS_PROFILE_SAMPLES_H

#include "pipefish/profile.h"

#include <string.h>

static inline pf_profile sample(void)
{
    pf_profile profile;
    memset(&profile, 0, sizeof profile);
    profile.camera.width = 1280;
    profile.camera.height = 800;
    profile.camera.f_u = 356.25;
    profile.camera.f_v = 355.875;
    profile.camera.skew = 0.125;
    profile.camera.c_u = 647.5;
    profile.camera.c_v = 404.75;
    profile.camera.k2 = -0.03125;
    profile.camera.k3 = 0.00390625;
    profile.camera.k4 = -0.0009765625;
    profile.camera.k5 = 0.00006103515625;
    profile.camera.theta_max = 1.625;
    profile.camera.circle_u = 640.5;
    profile.camera.circle_v = 400.5;
    profile.camera.circle_radius = 560.25;
    strcpy(profile.name, "Golden \xC3\xB6 1");
    strcpy(profile.serial, "SN-42");
    profile.source = PF_SOURCE_TARGET;
    profile.created_unix_s = 1700000000;
    profile.rms_px = 0.25;
    profile.held_out_rms_px = 0.3125;
    profile.theta_covered = 1.5;
    strcpy(profile.lens, "f/2 1.6 mm");
    strcpy(profile.tool, "pipefish");
    strcpy(profile.tool_version, "0.1.0");
    strcpy(profile.model_choice, "p9: least error on held-out views");
    profile.views = 20;
    profile.points = 1760;
    profile.held_out_views = 5;
    profile.free_count = 2;
    profile.free_param[0] = 0;
    profile.free_param[1] = 8;
    profile.covariance[0] = 0.25;
    profile.covariance[1] = -0.0625;
    profile.covariance[2] = 0.5;
    return profile;
}

/* Cameras of the whole family; the n-th. */
static inline pf_camera family(uint32_t n)
{
    static const double unit[4] = {0.5, -0.1, 0.7, 0.5}; /* of norm 1 */
    pf_camera c = sample().camera;
    c.radial = n < 7 ? n : PF_RADIAL_GENERIC;
    if (c.radial != PF_RADIAL_GENERIC)
        c.k2 = c.k3 = c.k4 = c.k5 = 0;
    if (c.radial == PF_RADIAL_UNIFIED)
        c.mirror = 1.25;
    c.theta_max = n == PF_RADIAL_PERSPECTIVE || n == PF_RADIAL_ORTHOGRAPHIC ? 1.25 : c.theta_max;
    for (uint32_t i = 0; (n == 7 || n == 10) && i < 3; i++) {
        c.asym_radial_theta[i] = 0.01 / (i + 1);
        c.asym_tangential_theta[i] = -0.005 / (i + 1);
    }
    if (n == 7 || n == 10) {
        memcpy(c.asym_radial_phi, unit, sizeof unit);
        memcpy(c.asym_tangential_phi, unit, sizeof unit);
    }
    for (uint32_t i = 0; n >= 8 && n != 9 && i < PF_CPOLY_MAX; i++)
        c.cpoly[i] = (i % 2 ? -1e-3 : 1e-3) * (i + 1) / 10;
    if (n >= 9) {
        c.tilt[0] = 0.05;
        c.tilt[1] = -0.03;
        c.pupil_e1 = 2e-3;
    }
    return c;
}

static inline void put_u32(uint8_t *p, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        p[i] = (uint8_t)(value >> (8 * i));
}

static inline void repair(uint8_t *bytes, size_t n)
{
    put_u32(bytes + n - 4, pf_crc32c(0, bytes, n - 4));
}

#endif
