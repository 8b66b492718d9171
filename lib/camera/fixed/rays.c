/* Look-up of rays by pixel. */
#include "rays.h"

pf_ray_q30 pf_fixed_cell_ray(const ray_cell *cell, int32_t s, int32_t t)
{
    const int32_t power[6] = {s, t, s * s >> 16, s * t >> 16, t * t >> 16, 0};
    int32_t out[3];
    for (int i = 0; i < 3; i++) {
        int32_t sum = 0;
        for (int k = 0; k < 6; k++)
            sum += cell->factor[k / 2][i][k % 2] * power[k];
        out[i] = cell->origin[i] + (sum >> (cell->shift & 31));
    }
    return (pf_ray_q30){out[0], out[1], out[2]};
}

pf_ray_q30 pf_camera_rays_at(const pf_camera_rays *rays, pf_point_q16 pixel)
{
    pf_ray_q30 ray = {0, 0, 0};
    const uint32_t x = (uint32_t)pixel.x + 32768u, y = (uint32_t)pixel.y + 32768u; /* left of the image: huge */
    const uint32_t column = x >> (16 + rays->step_bits), row = y >> (16 + rays->step_bits);
    if (column >= rays->columns || row >= rays->rows)
        return ray;
    const ray_cell *cell = rays->cells + row * rays->columns + column;
    if (cell->shift >= MARKS && ((cell->shift & OUTSIDE) || !pf_camera_fixed_in_image(rays->fixed, pixel)))
        return ray;
    if (cell->shift & EXACT) {
        (void)pf_camera_fixed_unproject(rays->fixed, pixel, &ray, NULL);
        return ray;
    }
    return pf_fixed_cell_ray(cell, within_cell(x, rays->step_bits), within_cell(y, rays->step_bits));
}

void pf_camera_rays_lookup(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out)
{
    size_t i = 0;
#ifdef PF_AVX2
    if (__builtin_cpu_supports("avx2"))
        i = pf_fixed_lookup_eights(rays, n, pixels, out);
#endif
#ifdef PF_SIMD
    i += pf_fixed_lookup_fours(rays, n - i, pixels + i, out + i);
#endif
    for (; i < n; i++)
        out[i] = pf_camera_rays_at(rays, pixels[i]);
}
