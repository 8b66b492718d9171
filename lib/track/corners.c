/* Shi-Tomasi corners, one cell at a time: no response image, bounded time whatever the texture. They are sought at half
 * resolution, where noise is a quarter and pixels are a quarter as many, with a tensor over 3 x 3; what is taken is
 * then placed at full resolution. Against a search at full resolution the same share is found again in another view
 * (docs/tracker.md). */
#include "track_private.h"

#define REACH  2 /* the place at full resolution lies so near */
#define AROUND (2 * REACH + 1)
#define SPAN   (AROUND + 2 * REACH)

uint32_t pf_isqrt64(uint64_t n)
{
    if (n < 2)
        return (uint32_t)n;
    /* Newton from above: 2^k >= sqrt n > 2^(k - 1), so the error falls from a factor of 2 at most to 1.25, 1.025, ...
     */
    const int32_t k = (65 - __builtin_clzll(n)) / 2;
    uint64_t root = k < 32 ? (uint64_t)1 << k : UINT32_MAX, next = (root + n / root) / 2;
    while (next < root) {
        root = next;
        next = (root + n / root) / 2;
    }
    return (uint32_t)root;
}

int32_t pf_corner_least(uint32_t min_eigen)
{
    /* doubled gradients: a factor of 4; 9 pixels; twice the eigenvalue */
    return (int32_t)(min_eigen * 4u * 9u * 2u);
}

/* Twice the smaller eigenvalue, or `least` if that is not above it. */
static int32_t strength_above(int32_t least, int32_t trace, int32_t difference, int32_t twice)
{
    if (trace <= least)
        return least;
    const int64_t over = trace - least, square = (int64_t)difference * difference + (int64_t)twice * twice;
    return over * over > square ? trace - (int32_t)pf_isqrt64((uint64_t)square) : least;
}

uint32_t pf_corner_scan(pf_corner_scratch *scratch, const pf_pyramid *pyramid, const int32_t box[4], int32_t least,
                        pf_corner_allowed allowed, const void *context, pf_corner best[4])
{
    const int32_t l = pyramid->levels > 1u ? 1 : 0;
    const pf_image *image = &pyramid->level[l];
    const int32_t x0 = (box[0] + l) >> l, y0 = (box[1] + l) >> l, n = ((box[2] + l) >> l) - x0;
    const int32_t y1 = (box[3] + l) >> l, middle_x = x0 + n / 2, middle_y = (y0 + y1) / 2;
    const pf_tensor_row *row[3] = {&scratch->row[0], &scratch->row[1], &scratch->row[2]};
    for (int32_t q = 0; q < 4; q++)
        best[q].strength = least;
    for (int32_t y = y0 - 1; y <= y1; y++) {
        pf_tensor_row *next = &scratch->row[(y - y0 + 1) % 3];
        PF_KERNEL(tensor)(image->data + (size_t)y * image->stride + (x0 - 1), image->stride, n + 2, next);
        if (y <= y0)
            continue;
        pf_corner *half = best + (y - 1 < middle_y ? 0 : 2);
        const int32_t weakest = half[0].strength < half[1].strength ? half[0].strength : half[1].strength;
        if (PF_KERNEL(corners)(row, n, &scratch->sum) <= weakest)
            continue;
        for (int32_t i = 0; i < n; i++) {
            pf_corner *c = half + (x0 + i >= middle_x);
            const int32_t s =
                strength_above(c->strength, scratch->sum.k[0][i], scratch->sum.k[1][i], scratch->sum.k[2][i]);
            if (s > c->strength && allowed(context, (x0 + i) << l, (y - 1) << l))
                *c = (pf_corner){(x0 + i) << l, (y - 1) << l, s};
        }
    }
    uint32_t found = 0;
    for (int32_t q = 0; q < 4; q++)
        if (best[q].strength > least)
            best[found++] = best[q];
    return found;
}

/* Where the parabola through three strengths has its top, Q16, within half a pixel. */
static int32_t top_of(int32_t before, int32_t at, int32_t after)
{
    const int64_t bend = 2 * (int64_t)at - before - after;
    return bend > 0 ? pf_clamp_i64(((int64_t)after - before) * 32768 / bend, 32768) : 0;
}

/* Structure tensors of Sobel gradients around (x, y), summed over columns of AROUND. */
static void column_tensors(const pf_image *image, int32_t x, int32_t y, int32_t column[AROUND][SPAN][3])
{
    for (int32_t i = 0; i < SPAN; i++) {
        int32_t sum[3] = {0}, row[SPAN][3];
        for (int32_t j = 0; j < SPAN; j++) {
            const uint8_t *b = image->data + (size_t)(y + j - 2 * REACH) * image->stride + (size_t)(x + i - 2 * REACH);
            const uint8_t *a = b - image->stride, *c = b + image->stride;
            const int32_t gx = a[1] - a[-1] + 2 * (b[1] - b[-1]) + c[1] - c[-1];
            const int32_t gy = c[-1] - a[-1] + 2 * (c[0] - a[0]) + c[1] - a[1];
            row[j][0] = gx * gx + gy * gy;
            row[j][1] = gx * gx - gy * gy;
            row[j][2] = 2 * gx * gy;
            for (int32_t k = 0; k < 3; k++) {
                sum[k] += row[j][k] - (j >= AROUND ? row[j - AROUND][k] : 0);
                if (j >= AROUND - 1)
                    column[j - AROUND + 1][i][k] = sum[k];
            }
        }
    }
}

/* The strength, if above `least`, of the tensor over AROUND x AROUND that begins at column i of a row of such. */
static int32_t square_strength(int32_t least, int32_t column[SPAN][3], int32_t i)
{
    int32_t s[3] = {0};
    for (int32_t k = 0; k < AROUND; k++)
        for (int32_t c = 0; c < 3; c++)
            s[c] += column[i + k][c];
    return strength_above(least, s[0], s[1], s[2]);
}

pf_point_q16 pf_corner_place(const pf_image *image, const pf_corner *corner)
{
    int32_t column[AROUND][SPAN][3], most = 0, x = REACH, y = REACH;
    column_tensors(image, corner->x, corner->y, column);
    for (int32_t j = 0; j < AROUND; j++)
        for (int32_t i = 0; i < AROUND; i++) {
            const int32_t s = square_strength(most, column[j], i);
            if (s > most)
                most = s, x = i, y = j;
        }
    pf_point_q16 at = {(corner->x + x - REACH) * 65536, (corner->y + y - REACH) * 65536};
    /* a top at the rim of what was searched has no neighbour there: it stays on its pixel */
    if (x > 0 && x < AROUND - 1)
        at.x += top_of(square_strength(0, column[y], x - 1), most, square_strength(0, column[y], x + 1));
    if (y > 0 && y < AROUND - 1)
        at.y += top_of(square_strength(0, column[y - 1], x), most, square_strength(0, column[y + 1], x));
    return at;
}
