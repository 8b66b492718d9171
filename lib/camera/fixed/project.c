/* From rays and points to pixels. */
#include "fixed.h"

/* Coordinates with the largest magnitude in 2^30..2^31. */
typedef struct direction {
    int64_t x, y, z;
    uint32_t shift; /* they are 2^shift times the caller's */
} direction;

static bool normalise(int32_t x, int32_t y, int32_t z, direction *d)
{
    uint64_t bits = magnitude(x) | magnitude(y) | magnitude(z);
    if (bits == 0)
        return false;
    d->shift = bit_length(bits) < 31 ? 31 - bit_length(bits) : 0;
    int64_t scale = (int64_t)1 << d->shift;
    d->x = x * scale;
    d->y = y * scale;
    d->z = z * scale;
    return true;
}

/* From theta and phi on: lens, tilt, affine sensor, range. */
static pf_status to_pixel(const pf_camera_fixed *fixed, uint64_t theta, polar across, pf_point_q16 *pixel)
{
    if (theta > fixed->theta_max) {
        if (theta > fixed->theta_max + THETA_SLACK_Q32)
            return PF_ERR_DOMAIN;
        theta = fixed->theta_max;
    }
    plane_point w = pf_fixed_lens(fixed, theta, across.c, across.s, false);
    int64_t plane[2] = {w.x, w.y}, out[2];
    if (fixed->tilt[0] | fixed->tilt[1]) {
        int64_t d = ONE_Q30 + round_shift(fixed->tilt[0] * w.x + fixed->tilt[1] * w.y, fixed->plane_q);
        plane[0] = plane[0] * ONE_Q30 / d;
        plane[1] = plane[1] * ONE_Q30 / d;
    }
    for (int i = 0; i < 2; i++) {
        const affine_row *row = &fixed->to_pixel[i];
        int64_t at = round_shift(row->a * plane[0] + row->b * plane[1], row->shift) + fixed->center[i];
        out[i] = round_shift(at, fixed->pixel_q[i] - 16);
        if (out[i] < INT32_MIN || out[i] > INT32_MAX)
            return PF_ERR_DOMAIN;
    }
    pixel->x = (int32_t)out[0];
    pixel->y = (int32_t)out[1];
    return PF_OK;
}

pf_status pf_camera_fixed_project(const pf_camera_fixed *fixed, pf_ray_q30 ray, pf_point_q16 *pixel)
{
    direction d;
    if (!normalise(ray.x, ray.y, ray.z, &d))
        return PF_ERR_DOMAIN;
    polar across = pf_fixed_polar(d.x, d.y);
    uint64_t theta = pf_fixed_angle(polar_length(across, 16), d.z * 65536);
    return to_pixel(fixed, theta, across, pixel);
}

/* z - e1 theta^2 in units of 2^-16 of the direction's; |e1| theta^2 is less than the point's distance (2^32 units), so
 * with all the bits it has, 2^59 to the metre, it is brought to the units without loss. */
static int64_t seen_from_pupil(const pf_camera_fixed *fixed, const direction *d, uint32_t point_bits, uint64_t theta)
{
    uint64_t square = ((theta >> 2) * (theta >> 2)) >> 31; /* Q29 */
    int64_t off = fixed->pupil_e1 * (int64_t)square;       /* Q59 metres */
    int32_t up = (int32_t)point_bits + 16 - 59;
    off = up >= 0 ? off * ((int64_t)1 << up) : round_shift(off, (uint32_t)-up);
    return d->z * 65536 - off;
}

/* theta = atan2(rho, z - e1 theta^2) by regula falsi (Illinois) between 0 and theta_max: the residual increases with
 * theta where the point is far enough. */
static bool solve_pupil(const pf_camera_fixed *fixed, const direction *d, uint32_t point_bits, uint64_t rho,
                        uint64_t *theta)
{
    int64_t low = 0, high = (int64_t)(fixed->theta_max + THETA_SLACK_Q32);
    int64_t below = -(int64_t)pf_fixed_angle(rho, d->z * 65536);
    int64_t above = high - (int64_t)pf_fixed_angle(rho, seen_from_pupil(fixed, d, point_bits, (uint64_t)high));
    if (above < 0)
        return false;
    for (int i = 0; i < 64 && high - low > 1 && below < 0; i++) {
        int64_t span = high - low, share = -below * (ONE_Q30 / 2) / (above - below); /* Q29, 0..1 */
        int64_t at = low + (span * share >> 29);
        at = i % 4 == 3 ? low + span / 2 : at <= low ? low + 1 : at >= high ? high - 1 : at;
        int64_t rest = at - (int64_t)pf_fixed_angle(rho, seen_from_pupil(fixed, d, point_bits, (uint64_t)at));
        if (rest > 0) {
            high = at;
            above = rest;
            below = below / 2 < 0 ? below / 2 : below;
        } else {
            low = at;
            below = rest;
            above = above / 2 > 0 ? above / 2 : above;
        }
    }
    *theta = (uint64_t)(below < 0 ? high : low);
    return true;
}

pf_status pf_camera_fixed_project_point(const pf_camera_fixed *fixed, const int32_t xyz[3], uint32_t metre_bits,
                                        pf_point_q16 *pixel)
{
    if (metre_bits > 30)
        return PF_ERR_ARGUMENT;
    direction d;
    if (!normalise(xyz[0], xyz[1], xyz[2], &d))
        return PF_ERR_DOMAIN;
    polar across = pf_fixed_polar(d.x, d.y);
    uint64_t rho = polar_length(across, 16), theta;
    if (fixed->pupil_e1 == 0)
        return to_pixel(fixed, pf_fixed_angle(rho, d.z * 65536), across, pixel);

    /* Nearer than pupil_near? In the direction's units the distance is below 2^32, so a limit beyond is farther. */
    uint32_t point_bits = metre_bits + d.shift;
    uint64_t distance2 = (uint64_t)(d.x * d.x) + (uint64_t)(d.y * d.y) + (uint64_t)(d.z * d.z);
    uint64_t near = (uint64_t)fixed->pupil_near;
    if (point_bits > 30 && bit_length(near) + point_bits - 30 > 32)
        return PF_ERR_DOMAIN;
    near = point_bits >= 30 ? near << (point_bits - 30) : near >> (30 - point_bits);
    if (bit_length(near) > 32 || distance2 < near * near)
        return PF_ERR_DOMAIN;
    if (!solve_pupil(fixed, &d, point_bits, rho, &theta))
        return PF_ERR_DOMAIN;
    return to_pixel(fixed, theta, across, pixel);
}

bool pf_camera_fixed_in_image(const pf_camera_fixed *fixed, pf_point_q16 pixel)
{
    if (pixel.x < -32768 || pixel.y < -32768 || pixel.x > (int64_t)fixed->width * 65536 - 32768 ||
        pixel.y > (int64_t)fixed->height * 65536 - 32768)
        return false;
    if (fixed->circle_radius2 < 0)
        return true;
    uint64_t du = magnitude(pixel.x - fixed->circle[0]), dv = magnitude(pixel.y - fixed->circle[1]);
    return du <= UINT32_MAX / 2 + 1u && dv <= UINT32_MAX / 2 + 1u &&
           du * du + dv * dv <= (uint64_t)fixed->circle_radius2;
}
