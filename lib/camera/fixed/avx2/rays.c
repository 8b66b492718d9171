/* Look-up of rays, eight pixels at a time in 256-bit vectors: 18 instructions a pixel where the 128-bit loop has 29.
 * SIMDe's NEON has no vectors as wide, so these are x86's own. The same bits as ../rays.c. */
#include "../rays.h"

#include <immintrin.h>

/* The rows of two cells side by side, the first one's in the low half. */
static inline __m256i two_rows(const uint8_t *low, const uint8_t *high, size_t row)
{
    const __m128i *a = (const __m128i *)(const void *)(low + 16 * row);
    const __m128i *b = (const __m128i *)(const void *)(high + 16 * row);
    return _mm256_inserti128_si256(_mm256_castsi128_si256(_mm_load_si128(a)), _mm_load_si128(b), 1);
}

/* Two rays, from the cells' first rows and the powers of s and t, each broadcast in its half. */
static inline __m256i two_rays(__m256i origin, const uint8_t *low, const uint8_t *high, __m256i first, __m256i second,
                               __m256i third)
{
    __m256i sum = _mm256_madd_epi16(two_rows(low, high, 1), first);
    sum = _mm256_add_epi32(sum, _mm256_madd_epi16(two_rows(low, high, 2), second));
    sum = _mm256_add_epi32(sum, _mm256_madd_epi16(two_rows(low, high, 3), third));
    return _mm256_add_epi32(origin, _mm256_srav_epi32(sum, _mm256_shuffle_epi32(origin, 0xFF)));
}

size_t pf_fixed_lookup_eights(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out)
{
    const __m256i edge = _mm256_set1_epi32(32768), centre = _mm256_set1_epi16(INT16_MIN);
    const __m256i limits = _mm256_set1_epi32((int)(rays->columns | rays->rows << 16));
    const __m256i to_index = _mm256_set1_epi32((int)(1u | rays->columns << 16));
    const __m256i marks = _mm256_set1_epi64x((int64_t)((uint64_t)(RIM | EXACT | OUTSIDE) << 32));
    const __m256i marked = _mm256_blend_epi32(_mm256_setzero_si256(), marks, 0x88); /* in the lanes of the shifts */
    /* In each half the low 16 bits of its four numbers, then the high ones. */
    const __m256i apart =
        _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 4, 5, 8, 9, 12, 13, 2, 3, 6, 7, 10, 11, 14, 15));
    const __m128i bits = _mm_cvtsi32_si128((int)rays->step_bits);
    const uint8_t *cells = (const uint8_t *)(const void *)rays->cells;
    size_t i = 0;
    /* The fourth number of a ray is written over by the next one: there must be one. */
    for (; i + 8 < n; i += 8) {
        /* Half steps in Q15 at the bottom, columns and rows at the top; those of pixels outside the image are large. */
        const __m256i *p = (const __m256i *)(const void *)(pixels + i);
        __m256i a = _mm256_srl_epi32(_mm256_add_epi32(_mm256_loadu_si256(p), edge), bits);
        __m256i b = _mm256_srl_epi32(_mm256_add_epi32(_mm256_loadu_si256(p + 1), edge), bits);
        a = _mm256_shuffle_epi8(a, apart);
        b = _mm256_shuffle_epi8(b, apart);
        const __m256i at = _mm256_unpackhi_epi64(a, b); /* of pixels 0 1 4 5, 2 3 6 7 */
        if (_mm256_movemask_epi8(_mm256_cmpgt_epi16(limits, at)) != -1) {
            (void)pf_fixed_lookup_fours(rays, 8, pixels + i, out + i);
            continue;
        }
        _Alignas(32) uint32_t offset[8];
        _mm256_store_si256((__m256i *)(void *)offset, _mm256_slli_epi32(_mm256_madd_epi16(at, to_index), 6));
        const uint8_t *c0 = cells + offset[0], *c1 = cells + offset[1], *c4 = cells + offset[2],
                      *c5 = cells + offset[3], *c2 = cells + offset[4], *c3 = cells + offset[5],
                      *c6 = cells + offset[6], *c7 = cells + offset[7];
        const __m256i o02 = two_rows(c0, c2, 0), o13 = two_rows(c1, c3, 0), o46 = two_rows(c4, c6, 0),
                      o57 = two_rows(c5, c7, 0);
        if (!_mm256_testz_si256(_mm256_or_si256(_mm256_or_si256(o02, o13), _mm256_or_si256(o46, o57)), marked)) {
            (void)pf_fixed_lookup_fours(rays, 8, pixels + i, out + i);
            continue;
        }
        const __m256i first = _mm256_xor_si256(_mm256_unpacklo_epi64(a, b), centre);               /* s, t */
        const __m256i swapped = _mm256_shufflehi_epi16(_mm256_shufflelo_epi16(first, 0xA0), 0xA0); /* s, s */
        const __m256i second = _mm256_mulhi_epi16(first, swapped);                                 /* s^2, s t */
        const __m256i third = _mm256_srli_epi32(_mm256_mulhi_epi16(first, first), 16);             /* t^2, 0 */
#define RAYS(origin, low, high, lane)                                                                                  \
    two_rays(origin, low, high, _mm256_shuffle_epi32(first, 0x55 * (lane)),                                            \
             _mm256_shuffle_epi32(second, 0x55 * (lane)), _mm256_shuffle_epi32(third, 0x55 * (lane)))
        const __m256i r02 = RAYS(o02, c0, c2, 0), r13 = RAYS(o13, c1, c3, 1);
        const __m256i r46 = RAYS(o46, c4, c6, 2), r57 = RAYS(o57, c5, c7, 3);
#undef RAYS
        int32_t *o = (int32_t *)(void *)(out + i);
#define PUT(k, v) _mm_storeu_si128((__m128i *)(void *)(o + 3 * (k)), v)
        PUT(0, _mm256_castsi256_si128(r02));
        PUT(1, _mm256_castsi256_si128(r13));
        PUT(2, _mm256_extracti128_si256(r02, 1));
        PUT(3, _mm256_extracti128_si256(r13, 1));
        PUT(4, _mm256_castsi256_si128(r46));
        PUT(5, _mm256_castsi256_si128(r57));
        PUT(6, _mm256_extracti128_si256(r46, 1));
        PUT(7, _mm256_extracti128_si256(r57, 1));
#undef PUT
    }
    return i;
}
