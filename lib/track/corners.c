/* Shi-Tomasi corners, one cell at a time: no response image, bounded time whatever the texture. */
#include <string.h>

#include "track_private.h"

#define TAPS (2 * CORNER_HALF + 1)

uint32_t pf_isqrt64(uint64_t n)
{
    uint64_t root = 0, bit = (uint64_t)1 << 62;
    while (bit > n)
        bit >>= 2;
    for (; bit; bit >>= 2) {
        if (n >= root + bit) {
            n -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return (uint32_t)root;
}

int32_t pf_corner_least(uint32_t min_eigen)
{
    /* doubled gradients: a factor of 4; the strongest possible sum is 121 * 255^2 < 2^23 */
    return (int32_t)(min_eigen * 4u * TAPS * TAPS);
}

/* Doubled central differences of row y, columns x0 - CORNER_HALF on; `n` of them. */
static void gradient_row(const pf_image *image, int32_t x, int32_t y, int32_t n, int16_t *restrict gx,
                         int16_t *restrict gy)
{
    const uint8_t *row = image->data + (size_t)y * image->stride + x;
    const uint8_t *above = row - image->stride, *below = row + image->stride;
    for (int32_t i = 0; i < n; i++) {
        gx[i] = (int16_t)(row[i + 1] - row[i - 1]);
        gy[i] = (int16_t)(below[i] - above[i]);
    }
}

/* Adds (sign 1) or removes (sign -1) one row of gradients from the column sums. */
static void column_sums(pf_corner_scratch *restrict s, int32_t slot, int32_t n, int32_t sign)
{
    const int16_t *restrict gx = s->gx[slot], *restrict gy = s->gy[slot];
    if (sign > 0) {
        for (int32_t i = 0; i < n; i++) {
            s->xx[i] += gx[i] * gx[i];
            s->xy[i] += gx[i] * gy[i];
            s->yy[i] += gy[i] * gy[i];
        }
    } else {
        for (int32_t i = 0; i < n; i++) {
            s->xx[i] -= gx[i] * gx[i];
            s->xy[i] -= gx[i] * gy[i];
            s->yy[i] -= gy[i] * gy[i];
        }
    }
}

bool pf_corner_best(pf_corner_scratch *scratch, const pf_image *image, const int32_t box[4], int32_t least,
                    pf_corner_allowed allowed, const void *context, pf_corner *best)
{
    const int32_t x0 = box[0], y0 = box[1], x1 = box[2], y1 = box[3];
    const int32_t n = x1 - x0 + 2 * CORNER_HALF;
    bool found = false;
    memset(scratch->xx, 0, sizeof scratch->xx);
    memset(scratch->xy, 0, sizeof scratch->xy);
    memset(scratch->yy, 0, sizeof scratch->yy);
    for (int32_t y = y0 - CORNER_HALF; y < y1 + CORNER_HALF; y++) {
        const int32_t slot = (y - y0 + CORNER_HALF) % TAPS;
        if (y - y0 > CORNER_HALF)
            column_sums(scratch, slot, n, -1);
        gradient_row(image, x0 - CORNER_HALF, y, n, scratch->gx[slot], scratch->gy[slot]);
        column_sums(scratch, slot, n, 1);
        if (y - y0 < CORNER_HALF)
            continue;
        int32_t a = 0, b = 0, c = 0;
        for (int32_t i = 0; i < TAPS - 1; i++) {
            a += scratch->xx[i];
            b += scratch->xy[i];
            c += scratch->yy[i];
        }
        for (int32_t i = 0; i < x1 - x0; i++) {
            a += scratch->xx[i + TAPS - 1];
            b += scratch->xy[i + TAPS - 1];
            c += scratch->yy[i + TAPS - 1];
            /* smaller eigenvalue > least, without a root: both diagonal terms and the determinant of M - least I */
            if (a > least && c > least && (int64_t)(a - least) * (c - least) > (int64_t)b * b &&
                allowed(context, x0 + i, y - CORNER_HALF)) {
                const int64_t d = a - c;
                const int32_t root = (int32_t)pf_isqrt64((uint64_t)(d * d + 4 * (int64_t)b * b));
                least = (a + c - root) / 2;
                *best = (pf_corner){x0 + i, y - CORNER_HALF, least};
                found = true;
            }
            a -= scratch->xx[i];
            b -= scratch->xy[i];
            c -= scratch->yy[i];
        }
    }
    return found;
}
