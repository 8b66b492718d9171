/* Look-up of rays in vectors. The sum of two products in a lane, three times, is a whole cell. The same bits as
 * ../rays.c. */
#include "../rays.h"

#include "../../../simd.h"

static inline int32x4_t cell_sum(const ray_cell *cell, int32x4_t first, int32x4_t second, int32x4_t third)
{
    const void *start = cell, *factors = (const uint8_t *)start + sizeof cell->origin + sizeof cell->shift;
    const int32_t *origin = __builtin_assume_aligned(start, 16);
    const int16_t *factor = __builtin_assume_aligned(factors, 16);
    int32x4_t sum = pf_pairs(vld1q_s16(factor), vreinterpretq_s16_s32(first));
    sum = vaddq_s32(sum, pf_pairs(vld1q_s16(factor + 8), vreinterpretq_s16_s32(second)));
    sum = vaddq_s32(sum, pf_pairs(vld1q_s16(factor + 16), vreinterpretq_s16_s32(third)));
    return vaddq_s32(vld1q_s32(origin), pf_shift_right(sum, cell->shift & 31));
}

static inline void put(pf_ray_q30 *out, int32x4_t v)
{
    vst1_s32(&out->x, vget_low_s32(v));
    vst1q_lane_s32(&out->z, v, 2);
}

/* Four pixels: their cells, and in a lane each s and t; s^2 and s t; t^2 and 0. */
typedef struct four {
    const ray_cell *cell[4];
    int32x4_t first, second, third; /* 16 bits each */
} four;

/* Four pixels in the image, with rim cells among them: one by one. */
static __attribute__((noinline)) void look_up_mixed(const pf_camera_rays *rays, const pf_point_q16 *pixels,
                                                    const four *all, pf_ray_q30 *out)
{
    int32_t first[4], second[4], third[4];
    vst1q_s32(first, all->first);
    vst1q_s32(second, all->second);
    vst1q_s32(third, all->third);
    for (int i = 0; i < 4; i++) {
        const ray_cell *cell = all->cell[i];
        if (cell->shift >= EXACT)
            out[i] = cell->shift & OUTSIDE ? (pf_ray_q30){0, 0, 0} : pf_camera_rays_at(rays, pixels[i]);
        else if (cell->shift < MARKS || pf_camera_fixed_in_image(rays->fixed, pixels[i]))
            put(out + i, cell_sum(cell, vdupq_n_s32(first[i]), vdupq_n_s32(second[i]), vdupq_n_s32(third[i])));
        else
            out[i] = (pf_ray_q30){0, 0, 0};
    }
}

size_t pf_fixed_lookup_fours(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out)
{
    const uint32x4_t edge = vdupq_n_u32(32768);
    const int16x8_t limits = vreinterpretq_s16_u32(vdupq_n_u32(rays->columns | rays->rows << 16));
    const int16x8_t to_index = vreinterpretq_s16_u32(vdupq_n_u32(1u | rays->columns << 16));
    const ray_cell *cells = rays->cells;
    size_t i = 0;
    for (; i + 4 <= n; i += 4) {
        /* Half steps in Q15 at the bottom, columns and rows at the top; those of pixels outside the image are large. */
        const uint32_t *p = (const uint32_t *)(const void *)(pixels + i);
        const uint16x8_t a =
            vreinterpretq_u16_u32(pf_shift_right_u(vaddq_u32(vld1q_u32(p), edge), (int)rays->step_bits));
        const uint16x8_t b =
            vreinterpretq_u16_u32(pf_shift_right_u(vaddq_u32(vld1q_u32(p + 4), edge), (int)rays->step_bits));
        const int16x8_t at = vreinterpretq_s16_u16(pf_odd(a, b));
        if (!pf_all(vcgtq_s16(limits, at))) {
            for (size_t k = i; k < i + 4; k++)
                out[k] = pf_camera_rays_at(rays, pixels[k]);
            continue;
        }
        uint32_t index[4];
        vst1q_u32(index, vreinterpretq_u32_s32(pf_pairs(at, to_index)));
        const ray_cell *c0 = cells + index[0], *c1 = cells + index[1], *c2 = cells + index[2], *c3 = cells + index[3];
        const int16x8_t way = vreinterpretq_s16_u16(veorq_u16(pf_even(a, b), vdupq_n_u16(32768)));
        const int32x4_t first = vreinterpretq_s32_s16(way);
        const int32x4_t second = vreinterpretq_s32_s16(pf_mul_high(way, vtrn1q_s16(way, way)));
        const int32x4_t third = vreinterpretq_s32_u32(vshrq_n_u32(vreinterpretq_u32_s16(pf_mul_high(way, way)), 16));
        if ((c0->shift | c1->shift | c2->shift | c3->shift) >= MARKS) {
            const four all = {{c0, c1, c2, c3}, first, second, third};
            look_up_mixed(rays, pixels + i, &all, out + i);
            continue;
        }
#define RAY(lane)                                                                                                      \
    cell_sum(c##lane, vdupq_laneq_s32(first, lane), vdupq_laneq_s32(second, lane), vdupq_laneq_s32(third, lane))
        /* The fourth number of a ray is written over by the next one. */
        int32_t *o = (int32_t *)(void *)(out + i);
        vst1q_s32(o, RAY(0));
        vst1q_s32(o + 3, RAY(1));
        vst1q_s32(o + 6, RAY(2));
        put(out + i + 3, RAY(3));
#undef RAY
    }
    return i;
}
