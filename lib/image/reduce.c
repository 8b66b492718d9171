#include "reduce.h"

/* Sums stay below 255 * 256, so 16 bits hold them until the one rounding. */
void pf_c_reduce(const uint8_t *const r[5], uint32_t width, uint16_t *row, uint8_t *out)
{
    uint16_t *v = row + 2;
    for (uint32_t x = 0; x < width; x++)
        v[x] = (uint16_t)(r[0][x] + r[4][x] + 4 * (r[1][x] + r[3][x]) + 6 * r[2][x]);
    for (int32_t k = 1; k <= 2; k++) {
        v[-k] = v[pf_mirror(-k, width)];
        v[(int32_t)width - 1 + k] = v[pf_mirror((int32_t)width - 1 + k, width)];
    }
    for (uint32_t x = 0; x < (width + 1u) / 2u; x++) {
        const uint16_t *p = row + 2u * x;
        out[x] = (uint8_t)((p[0] + p[4] + 4 * (p[1] + p[3]) + 6 * p[2] + 128) >> 8);
    }
}
