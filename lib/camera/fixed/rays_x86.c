/* Look-up of rays on x86: SSE2 alone, which every x86-64 has. pmaddwd, the sum of two products in a lane, three times
 * is a whole cell. The same bits as rays.c. */
#include "rays.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#include <string.h>

static inline __m128i cell_sum(const ray_cell *cell, __m128i first, __m128i second, __m128i third)
{
    const __m128i *factor = (const __m128i *)(const void *)cell->factor;
    __m128i sum = _mm_add_epi32(_mm_madd_epi16(factor[0], first), _mm_madd_epi16(factor[1], second));
    sum = _mm_add_epi32(sum, _mm_madd_epi16(factor[2], third));
    sum = _mm_sra_epi32(sum, _mm_cvtsi32_si128(cell->shift & 31));
    return _mm_add_epi32(sum, *(const __m128i *)(const void *)cell->origin);
}

static inline void put(pf_ray_q30 *out, __m128i v)
{
    _mm_storel_epi64((__m128i *)(void *)out, v);
    out->z = _mm_cvtsi128_si32(_mm_unpackhi_epi64(v, v));
}

/* Four pixels: their cells, and in a lane each s and t; s^2 and s t; t^2 and 0. */
typedef struct four {
    const ray_cell *cell[4];
    __m128i first, second, third;
} four;

/* Four pixels in the image, with rim cells among them: one by one. */
static __attribute__((noinline)) void look_up_mixed(const pf_camera_rays *rays, const pf_point_q16 *pixels,
                                                    const four *all, pf_ray_q30 *out)
{
    int32_t first[4], second[4], third[4];
    memcpy(first, &all->first, sizeof first);
    memcpy(second, &all->second, sizeof second);
    memcpy(third, &all->third, sizeof third);
    for (int i = 0; i < 4; i++) {
        const ray_cell *cell = all->cell[i];
        if (cell->shift >= EXACT)
            out[i] = cell->shift & OUTSIDE ? (pf_ray_q30){0, 0, 0} : pf_camera_rays_at(rays, pixels[i]);
        else if (cell->shift < MARKS || pf_camera_fixed_in_image(rays->fixed, pixels[i]))
            put(out + i, cell_sum(cell, _mm_set1_epi32(first[i]), _mm_set1_epi32(second[i]), _mm_set1_epi32(third[i])));
        else
            out[i] = (pf_ray_q30){0, 0, 0};
    }
}

/* s and t of two pixels, 16 bits sign-extended. */
static inline __m128i ways(__m128i pixels, __m128i to_way)
{
    const __m128i sign = _mm_set1_epi32(INT32_MIN);
    return _mm_srai_epi32(_mm_xor_si128(_mm_slli_epi32(_mm_srl_epi32(pixels, to_way), 16), sign), 16);
}

size_t pf_fixed_lookup_fours(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out)
{
    const __m128i edge = _mm_set1_epi32(32768), to_way = _mm_cvtsi32_si128((int)rays->step_bits);
    const __m128i to_cell = _mm_cvtsi32_si128((int)rays->step_bits + 16);
    const __m128i limits = _mm_set1_epi32((int)(rays->columns | rays->rows << 16));
    const __m128i to_index = _mm_set1_epi32((int)(1u | rays->columns << 16));
    const ray_cell *cells = rays->cells;
    size_t i = 0;
    for (; i + 4 <= n; i += 4) {
        const __m128i a = _mm_add_epi32(_mm_loadu_si128((const __m128i *)(const void *)(pixels + i)), edge);
        const __m128i b = _mm_add_epi32(_mm_loadu_si128((const __m128i *)(const void *)(pixels + i + 2)), edge);
        /* Columns and rows in 16 bits; those of pixels outside the image are too large. */
        const __m128i at = _mm_packs_epi32(_mm_srl_epi32(a, to_cell), _mm_srl_epi32(b, to_cell));
        if (_mm_movemask_epi8(_mm_cmpgt_epi16(limits, at)) != 0xFFFF) {
            for (size_t k = i; k < i + 4; k++)
                out[k] = pf_camera_rays_at(rays, pixels[k]);
            continue;
        }
        _Alignas(16) uint32_t index[4];
        _mm_store_si128((__m128i *)(void *)index, _mm_madd_epi16(at, to_index));
        four all = {{cells + index[0], cells + index[1], cells + index[2], cells + index[3]},
                    _mm_packs_epi32(ways(a, to_way), ways(b, to_way)),
                    edge,
                    edge};
        all.second = _mm_mulhi_epi16(all.first, _mm_shufflehi_epi16(_mm_shufflelo_epi16(all.first, 0xA0), 0xA0));
        all.third = _mm_srli_epi32(_mm_mulhi_epi16(all.first, all.first), 16);
        if ((all.cell[0]->shift | all.cell[1]->shift | all.cell[2]->shift | all.cell[3]->shift) >= MARKS) {
            look_up_mixed(rays, pixels + i, &all, out + i);
            continue;
        }
#define TAKE(lane)                                                                                                     \
    put(out + i + (lane),                                                                                              \
        cell_sum(all.cell[lane], _mm_shuffle_epi32(all.first, (lane)*0x55),                                            \
                 _mm_shuffle_epi32(all.second, (lane)*0x55), _mm_shuffle_epi32(all.third, (lane)*0x55)))
        TAKE(0);
        TAKE(1);
        TAKE(2);
        TAKE(3);
#undef TAKE
    }
    return i;
}

#endif
