/* A radially symmetric lens by table, in integers. The table runs over s = sin(theta / 2), in which the radius of any
 * fisheye is nearly straight and which needs no trigonometric function: z = 1 - 2 s^2, sin theta = 2 s sqrt(1 - s^2).
 */
#include "track_private.h"

#define ONE       ((int64_t)1 << 30)
#define INTERVALS ((int64_t)PF_LENS_KNOTS - 1)

bool pf_lens_project(const void *camera, const pf_ray_q30 *ray, pf_point_q16 *at)
{
    const pf_lens *lens = camera;
    const int64_t s = pf_isqrt64((uint64_t)(ONE - ray->z) << 29); /* Q30 */
    const int64_t rho = pf_isqrt64((uint64_t)((int64_t)ray->x * ray->x + (int64_t)ray->y * ray->y));
    if (!pf_ray_valid(ray) || s > lens->reach_q30)
        return false;
    *at = lens->centre;
    if (rho == 0)
        return true;
    const int64_t place = s * (INTERVALS << 16) / lens->reach_q30,
                  i = place >> 16 < INTERVALS ? place >> 16 : INTERVALS - 1;
    const int64_t low = lens->radius_q16[i], step = lens->radius_q16[i + 1] - low;
    const int64_t r = low + ((step * (place - i * 65536)) >> 16);
    const int64_t dx = r * ray->x / rho, dy = r * ray->y / rho;
    at->x += (int32_t)(dx + ((dy * lens->skew_q16) >> 16));
    at->y += (int32_t)((dy * lens->aspect_q16) >> 16);
    return true;
}

static pf_ray_q30 bearing_of(const pf_lens *lens, pf_point_q16 at)
{
    const int64_t dy = ((int64_t)at.y - lens->centre.y) * 65536 / lens->aspect_q16;
    const int64_t dx = (int64_t)at.x - lens->centre.x - ((dy * lens->skew_q16) >> 16);
    const int64_t r = pf_isqrt64((uint64_t)(dx * dx + dy * dy));
    int32_t low = 0, high = (int32_t)INTERVALS;
    if (r > lens->radius_q16[INTERVALS])
        return (pf_ray_q30){0, 0, 0};
    while (high - low > 1) {
        const int32_t middle = (low + high) / 2;
        if (lens->radius_q16[middle] <= r)
            low = middle;
        else
            high = middle;
    }
    const int64_t part = (r - lens->radius_q16[low]) * 65536 / (lens->radius_q16[high] - lens->radius_q16[low]);
    const int64_t s = ((int64_t)low * 65536 + part) * lens->reach_q30 / (INTERVALS << 16), ss = (s * s) >> 30;
    const int64_t rho = (2 * s * pf_isqrt64((uint64_t)(ONE - ss) << 30)) >> 30;
    if (r == 0)
        return (pf_ray_q30){0, 0, (int32_t)ONE};
    return (pf_ray_q30){(int32_t)(rho * dx / r), (int32_t)(rho * dy / r), (int32_t)(ONE - 2 * ss)};
}

void pf_lens_bearings(const pf_lens *lens, const pf_track *tracks, uint32_t n, pf_ray_q30 *rays)
{
    for (uint32_t i = 0; i < n; i++)
        rays[i] = bearing_of(lens, tracks[i].pos);
}
