/* One row of a pyramid level from five rows of the level above: the portable version, and the one in vectors, which
 * gives the same bits (tests/unit/test_pyramid, test_kernels). Not for users. */
#ifndef PIPEFISH_IMAGE_REDUCE_H
#define PIPEFISH_IMAGE_REDUCE_H

#include <stddef.h>
#include <stdint.h>

/* Sums of the binomial 1 4 6 4 1 along both axes, divided by 256 and rounded; mirrored at both ends.
 * in : r[5]   rows of `width` pixels
 * io : row    scratch of PF_REDUCE_ROW(width) numbers
 * out: out    (width + 1) / 2 pixels */
#define PF_REDUCE_ROW(width) ((size_t)(width) + 24u)
void pf_c_reduce(const uint8_t *const r[5], uint32_t width, uint16_t *row, uint8_t *out);
void pf_neon_reduce(const uint8_t *const r[5], uint32_t width, uint16_t *row, uint8_t *out);

/* Mirrors an index about the first and last sample, neither repeated: ... 2 1 | 0 1 2. */
static inline uint32_t pf_mirror(int32_t i, uint32_t n)
{
    if (n == 1u)
        return 0;
    const int32_t last = (int32_t)n - 1;
    while (i < 0 || i > last)
        i = i < 0 ? -i : 2 * last - i;
    return (uint32_t)i;
}

#if PF_SIMD
#define pf_reduce pf_neon_reduce
#else
#define pf_reduce pf_c_reduce
#endif

#endif
