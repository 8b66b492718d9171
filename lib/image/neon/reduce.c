#include "../reduce.h"

#include "../../simd.h"

/* 1 4 6 4 1, as a + e + 4 (b + c + d) + 2 c. */
static inline uint16x8_t binomial(uint16x8_t a, uint16x8_t b, uint16x8_t c, uint16x8_t d, uint16x8_t e)
{
    const uint16x8_t inner = vshlq_n_u16(vaddq_u16(vaddq_u16(b, d), c), 2);
    return vaddq_u16(vaddq_u16(inner, vaddq_u16(c, c)), vaddq_u16(a, e));
}

static inline uint16x8_t column(const uint8_t *const r[5], uint32_t x)
{
    return binomial(vreinterpretq_u16_s16(pf_load8(r[0] + x)), vreinterpretq_u16_s16(pf_load8(r[1] + x)),
                    vreinterpretq_u16_s16(pf_load8(r[2] + x)), vreinterpretq_u16_s16(pf_load8(r[3] + x)),
                    vreinterpretq_u16_s16(pf_load8(r[4] + x)));
}

static uint16_t one_column(const uint8_t *const r[5], uint32_t x)
{
    return (uint16_t)(r[0][x] + r[4][x] + 4 * (r[1][x] + r[3][x]) + 6 * r[2][x]);
}

/* The vertical sums go to two rows, even columns and odd ones, so that the horizontal sums need no shuffles. */
void pf_neon_reduce(const uint8_t *const r[5], uint32_t width, uint16_t *row, uint8_t *out)
{
    const uint32_t outs = (width + 1u) / 2u;
    uint16_t *even = row + 1, *odd = even + outs + 2u; /* even[k] is column 2 k, k from -1 to outs; odd[k] 2 k + 1 */
    uint32_t x = 0;
    for (; x + 16u <= width; x += 16u) {
        const uint16x8_t a = column(r, x), b = column(r, x + 8u);
        vst1q_u16(even + x / 2u, pf_even(a, b));
        vst1q_u16(odd + x / 2u, pf_odd(a, b));
    }
    for (; x < width; x++)
        (x % 2u ? odd : even)[x / 2u] = one_column(r, x);
    even[-1] = one_column(r, pf_mirror(-2, width));
    odd[-1] = one_column(r, pf_mirror(-1, width));
    for (x = width; x < width + 2u; x++)
        (x % 2u ? odd : even)[x / 2u] = one_column(r, pf_mirror((int32_t)x, width));
    for (x = 0; x + 8u <= outs; x += 8u) {
        const uint16_t *e = even + x, *o = odd + x;
        const uint16x8_t sum =
            binomial(vld1q_u16(e - 1), vld1q_u16(o - 1), vld1q_u16(e), vld1q_u16(o), vld1q_u16(e + 1));
        pf_store8(out + x, vshrq_n_u16(vaddq_u16(sum, vdupq_n_u16(128)), 8));
    }
    for (; x < outs; x++) {
        const uint16_t *e = even + x, *o = odd + x;
        out[x] = (uint8_t)((e[-1] + e[1] + 4 * (o[-1] + o[0]) + 6 * e[0] + 128) >> 8);
    }
}
