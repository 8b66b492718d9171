/* Look-up of rays on x86: SSE2 alone, which every x86-64 has. pmaddwd, the sum of two products in a lane, three times
 * is a whole cell. The same bits as rays.c. */
#include "rays.h"

#if defined(__SSE2__)
#include <emmintrin.h>

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

void pf_fixed_lookup_four(const pf_camera_rays *rays, const pf_point_q16 *pixels, pf_ray_q30 *out)
{
    const __m128i edge = _mm_set1_epi32(32768), sign = _mm_set1_epi32(INT32_MIN);
    const __m128i to_cell = _mm_cvtsi32_si128((int)rays->step_bits + 16),
                  to_way = _mm_cvtsi32_si128((int)rays->step_bits);
    const int columns = (int)rays->columns;
    const __m128i a = _mm_add_epi32(_mm_loadu_si128((const __m128i *)(const void *)pixels), edge);
    const __m128i b = _mm_add_epi32(_mm_loadu_si128((const __m128i *)(const void *)(pixels + 2)), edge);

    /* Columns and rows in 16 bits; those of pixels outside the image are too large. */
    const __m128i cells = _mm_packs_epi32(_mm_srl_epi32(a, to_cell), _mm_srl_epi32(b, to_cell));
    const __m128i limits = _mm_set1_epi32(columns | (int)(rays->rows << 16));
    if (_mm_movemask_epi8(_mm_cmpgt_epi16(limits, cells)) != 0xFFFF) {
        for (int i = 0; i < 4; i++)
            out[i] = pf_camera_rays_at(rays, pixels[i]);
        return;
    }
    _Alignas(16) int32_t index[4];
    _mm_store_si128((__m128i *)(void *)index, _mm_madd_epi16(cells, _mm_set1_epi32(1 | columns * 65536)));
    const ray_cell *c0 = rays->cells + index[0], *c1 = rays->cells + index[1], *c2 = rays->cells + index[2],
                   *c3 = rays->cells + index[3];

    /* s, t; s^2, s t; t^2, 0: a pair for each pixel. */
    const __m128i way_a = _mm_srai_epi32(_mm_xor_si128(_mm_slli_epi32(_mm_srl_epi32(a, to_way), 16), sign), 16);
    const __m128i way_b = _mm_srai_epi32(_mm_xor_si128(_mm_slli_epi32(_mm_srl_epi32(b, to_way), 16), sign), 16);
    const __m128i first = _mm_packs_epi32(way_a, way_b);
    const __m128i s_s = _mm_shufflehi_epi16(_mm_shufflelo_epi16(first, 0xA0), 0xA0);
    const __m128i second = _mm_mulhi_epi16(first, s_s);
    const __m128i third = _mm_srli_epi32(_mm_mulhi_epi16(first, first), 16);

    /* Rim cells one by one. */
    const bool whole = (c0->shift | c1->shift | c2->shift | c3->shift) < MARKS;
#define TAKE(lane, cell)                                                                                               \
    if (whole || (cell)->shift < MARKS ||                                                                              \
        ((cell)->shift < EXACT && pf_camera_fixed_in_image(rays->fixed, pixels[lane])))                                \
        put(out + (lane), cell_sum(cell, _mm_shuffle_epi32(first, (lane)*0x55),                                        \
                                   _mm_shuffle_epi32(second, (lane)*0x55), _mm_shuffle_epi32(third, (lane)*0x55)));    \
    else if ((cell)->shift & OUTSIDE)                                                                                  \
        out[lane] = (pf_ray_q30){0, 0, 0};                                                                             \
    else                                                                                                               \
        out[lane] = pf_camera_rays_at(rays, pixels[lane])
    TAKE(0, c0);
    TAKE(1, c1);
    TAKE(2, c2);
    TAKE(3, c3);
#undef TAKE
}

#endif
