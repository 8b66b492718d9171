/* The table of rays, shared by its building and its use. Not for users. */
#ifndef PIPEFISH_CAMERA_FIXED_RAYS_H
#define PIPEFISH_CAMERA_FIXED_RAYS_H

#include "fixed.h"

/* Marks of cells: only part of it in the image; to be computed exactly; nothing in the image. */
#define RIM     256
#define EXACT   512
#define OUTSIDE 1024
#define MARKS   RIM /* the lowest: below it there is none */

/* One cell, one cache line. With (s, t) the way from its centre in half steps, Q15, a coordinate of the ray is
 * origin + (sum of factors times s, t, s^2, s t, t^2, 0) >> shift, in Q30; the squares are in Q14. Next to the shift
 * are the marks above; no mark: the whole cell is in the image. */
typedef struct ray_cell {
    int32_t origin[3], shift;
    int16_t factor[3][4][2]; /* (s, t), (s^2, s t), (t^2, 0): for each coordinate */
} ray_cell;
_Static_assert(sizeof(ray_cell) == 64, "one cache line");

struct pf_camera_rays {
    const pf_camera_fixed *fixed;
    uint32_t step_bits, columns, rows; /* cells begin at (-0.5, -0.5) px */
    pf_camera_rays_stats stats;
    const ray_cell *cells;
};

/* The way from a cell's centre in half steps, Q15, of a coordinate from the image's edge, Q16; rounded down. */
static inline int32_t within_cell(uint32_t at, uint32_t step_bits)
{
    return (int32_t)(at >> step_bits & 65535u) - 32768;
}

pf_ray_q30 pf_fixed_cell_ray(const ray_cell *cell, int32_t s, int32_t t);

#ifdef PF_SIMD
/* Looks up four at a time; returns how many it did, all but up to three. */
size_t pf_fixed_lookup_fours(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out);
#endif

#ifdef PF_AVX2
/* Eight at a time, on processors with AVX2; returns how many it did, all but up to eight. */
size_t pf_fixed_lookup_eights(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out);
#endif

#endif
