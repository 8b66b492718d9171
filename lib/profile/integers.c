/* Integer self-test vectors: pixels, their rays and the pixels of these, by the fixed-point camera. */
#include "pipefish/profile_integers.h"

#include "vectors.h"

#include <string.h>

static bool to_q16(double pixel, int32_t *q16)
{
    double scaled = pixel * 65536;
    if (!(scaled > -2147483647.0 && scaled < 2147483647.0))
        return false;
    *q16 = (int32_t)(scaled < 0 ? scaled - 0.5 : scaled + 0.5);
    return true;
}

/* Ray and second pixel of v->pixel. */
static pf_status compute(const pf_camera_fixed *fixed, pf_profile_integers *v)
{
    pf_status status = pf_camera_fixed_unproject(fixed, v->pixel, &v->ray, NULL);
    return status == PF_OK ? pf_camera_fixed_project(fixed, v->ray, &v->back) : status;
}

pf_status pf_profile_integers_make(pf_profile *profile, void *workspace, size_t size)
{
    const pf_camera_fixed *fixed;
    profile->integers_count = 0;
    memset(profile->integers, 0, sizeof profile->integers);
    pf_status status = pf_camera_fixed_init(&fixed, &profile->camera, workspace, size);
    if (status != PF_OK)
        return status;
    for (uint32_t i = 0; i < PF_PROFILE_VECTORS; i++) {
        double value[8];
        pf_profile_integers v;
        /* A pixel on the rim may fall out of the domain by rounding, far ones out of Q16.16: the others remain. */
        if (pf_vectors_at(&profile->camera, i, value) == PF_OK && to_q16(value[3], &v.pixel.x) &&
            to_q16(value[4], &v.pixel.y) && compute(fixed, &v) == PF_OK)
            profile->integers[profile->integers_count++] = v;
    }
    return PF_OK;
}

static bool same(const pf_profile_integers *a, const pf_profile_integers *b)
{
    return a->ray.x == b->ray.x && a->ray.y == b->ray.y && a->ray.z == b->ray.z && a->back.x == b->back.x &&
           a->back.y == b->back.y;
}

pf_status pf_profile_integers_check(const pf_profile *profile, void *workspace, size_t size, const char **why)
{
    const pf_camera_fixed *fixed;
    const char *ignored;
    why = why ? why : &ignored;
    *why = "ok";
    if (profile->integers_count == 0)
        return PF_OK;
    pf_status status = pf_camera_fixed_init(&fixed, &profile->camera, workspace, size);
    if (status != PF_OK) {
        *why = status == PF_ERR_SPACE ? "integers: no memory for the fixed-point camera"
                                      : "integers: this device cannot build the camera in fixed point";
        return status;
    }
    for (uint32_t i = 0; i < profile->integers_count; i++) {
        pf_profile_integers v = {.pixel = profile->integers[i].pixel};
        if (compute(fixed, &v) != PF_OK || !same(&v, &profile->integers[i])) {
            *why = "self_test: the fixed-point camera of this device does not compute the integers of the profile";
            return PF_ERR_SELF_TEST;
        }
    }
    return PF_OK;
}
