/* The lens table of a camera. Its own library: the only part of the tracker that needs the camera model in doubles. */
#include <math.h>

#include "pipefish/track.h"

static int32_t to_fixed(double v, double one)
{
    return (int32_t)floor(v * one + 0.5);
}

pf_status pf_lens_make(pf_lens *lens, const pf_camera *camera)
{
    const double axis[3] = {0, 0, 1};
    /* sin(theta_max / 2), a little less: the rim itself may fall to either side of rounding */
    const double reach = sin(camera->theta_max / 2) * (1 - 1e-9);
    double centre[2], uv[2];
    if (pf_camera_project(camera, axis, centre, NULL, NULL) != PF_OK || fabs(centre[0]) > 16384 ||
        fabs(centre[1]) > 16384)
        return PF_ERR_DOMAIN;
    lens->centre = (pf_point_q16){to_fixed(centre[0], 65536), to_fixed(centre[1], 65536)};
    lens->reach_q30 = to_fixed(reach, 1073741824);
    lens->skew_q16 = to_fixed(camera->skew / camera->f_u, 65536);
    lens->aspect_q16 = to_fixed(camera->f_v / camera->f_u, 65536);
    for (uint32_t i = 0; i < PF_LENS_KNOTS; i++) {
        /* along +x and -x: what asymmetry there is averages out */
        const double s = reach * i / (PF_LENS_KNOTS - 1u), rho = 2 * s * sqrt(1 - s * s), z = 1 - 2 * s * s;
        double radius = 0;
        for (int side = -1; side <= 1; side += 2) {
            const double ray[3] = {side * rho, 0, z};
            if (pf_camera_project(camera, ray, uv, NULL, NULL) != PF_OK)
                return PF_ERR_DOMAIN;
            radius += side * (uv[0] - centre[0]) / 2;
        }
        if (!(radius <= 16384) || (i > 0 && to_fixed(radius, 65536) <= lens->radius_q16[i - 1u]))
            return PF_ERR_DOMAIN;
        lens->radius_q16[i] = to_fixed(radius, 65536);
    }
    return PF_OK;
}
