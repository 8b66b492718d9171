/* The portable kernels: what each result is. */
#include "kernels.h"

static int16_t mul_q15(int32_t a, int16_t b)
{
    return (int16_t)((a * b + (1 << 14)) >> 15);
}

/* Between four pixels, Q4 less PIXEL_MID; the steps along x and y round separately, in Q6. */
static int16_t between(int32_t p00, int32_t p01, int32_t p10, int32_t p11, int16_t fx, int16_t fy)
{
    const int32_t top = p00 * 64 + mul_q15((p01 - p00) * 64, fx), bottom = p10 * 64 + mul_q15((p11 - p10) * 64, fx);
    return (int16_t)((top + mul_q15(bottom - top, fy) + 2 - 4 * PIXEL_MID) >> 2);
}

static int16_t sample_at(const pf_spot *s, int32_t r, int32_t i)
{
    const uint8_t *p = s->p + (size_t)r * s->stride + (size_t)i, *q = p + s->stride;
    return between(p[0], p[1], q[0], q[1], s->fx, s->fy);
}

void pf_c_sample(const pf_spot *spot, int32_t rows, int32_t groups, int16_t *out)
{
    for (int32_t r = 0; r < rows; r++)
        for (int32_t i = 0; i < 8 * groups; i++)
            out[r * PATCH_ROW + i] = sample_at(spot, r, i);
}

void pf_c_template(const int16_t *raw, const int16_t *mask, int32_t rows, int32_t groups, int16_t *t, int16_t *gx,
                   int16_t *gy, pf_template_sums *sums)
{
    pf_template_sums s = {0};
    for (int32_t r = 0; r < rows; r++) {
        const int16_t *row = raw + (r + 1) * PATCH_ROW + 1;
        int32_t st = 0, tt = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0, xt = 0, yt = 0;
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i;
            t[k] = (int16_t)(row[i] & mask[k]);
            gx[k] = (int16_t)((row[i + 1] - row[i - 1]) & mask[k]);
            gy[k] = (int16_t)((row[i + PATCH_ROW] - row[i - PATCH_ROW]) & mask[k]);
            st += t[k], tt += t[k] * t[k], x += gx[k], y += gy[k], xx += gx[k] * gx[k], xy += gx[k] * gy[k];
            yy += gy[k] * gy[k], xt += gx[k] * t[k], yt += gy[k] * t[k];
        }
        s.t += st, s.tt += tt, s.x += x, s.y += y, s.xx += xx, s.xy += xy, s.yy += yy, s.xt += xt, s.yt += yt;
    }
    *sums = s;
}

void pf_c_step(const pf_spot *spot, const int16_t *mask, int32_t rows, int32_t groups, const int16_t *t,
               const int16_t *gx, const int16_t *gy, pf_step_sums *sums)
{
    pf_step_sums s = {0};
    for (int32_t r = 0; r < rows; r++) {
        int32_t sc = 0, cc = 0, ct = 0, cx = 0, cy = 0;
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, c = sample_at(spot, r, i) & mask[k];
            sc += c, cc += c * c, ct += c * t[k], cx += c * gx[k], cy += c * gy[k];
        }
        s.c += sc, s.cc += cc, s.ct += ct, s.cx += cx, s.cy += cy;
    }
    *sums = s;
}

void pf_c_unpack(const uint8_t *pixels, const int16_t *mask, int32_t window, int32_t groups, const pf_gradients *out)
{
    const int32_t w = window + 2;
    for (int32_t r = 0; r < window; r++) {
        const uint8_t *a = pixels + r * w, *b = a + w, *c = b + w;
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, x = i - window / 2;
            const int32_t along = a[i + 2] - a[i] + 2 * (b[i + 2] - b[i]) + c[i + 2] - c[i];
            const int32_t down = c[i] - a[i] + 2 * (c[i + 1] - a[i + 1]) + c[i + 2] - a[i + 2];
            const int32_t bend_x = b[i] + b[i + 2] - 2 * b[i + 1], bend_y = a[i + 1] + c[i + 1] - 2 * b[i + 1];
            const int32_t t = b[i + 1] * PIXEL_ONE - PIXEL_MID + mul_q15(bend_x * PIXEL_ONE, out->smooth[0]) +
                              mul_q15(bend_y * PIXEL_ONE, out->smooth[1]);
            out->t[k] = (int16_t)(t & mask[k]);
            out->gx[k] = (int16_t)(along & mask[k]);
            out->gy[k] = (int16_t)(down & mask[k]);
            out->xgx[k] = (int16_t)(out->gx[k] * x);
            out->xgy[k] = (int16_t)(out->gy[k] * x);
        }
    }
}

void pf_c_bend(const int32_t bow[6], int32_t window, int32_t groups, const pf_gradients *g)
{
    const int32_t half = window / 2;
    for (int32_t r = 0; r < window; r++) {
        const int32_t y = r - half;
        const int32_t yy[2] = {(bow[2] * y * y) >> 9, (bow[5] * y * y) >> 9},
                      xy[2] = {(bow[1] * y) >> 9, (bow[4] * y) >> 9};
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, x = i - half;
            /* Q15; wrong beyond the window, where gradients are zero */
            const int16_t u = (int16_t)(((bow[0] * x * x) >> 9) + xy[0] * x + yy[0]),
                          v = (int16_t)(((bow[3] * x * x) >> 9) + xy[1] * x + yy[1]);
            const int32_t t = g->t[k] - mul_q15(2 * g->gx[k], u) - mul_q15(2 * g->gy[k], v); /* Q3 to Q4 */
            g->t[k] = (int16_t)(t > PIXEL_MID ? PIXEL_MID : t < -PIXEL_MID ? -PIXEL_MID : t);
        }
    }
}

void pf_c_warp(const pf_warp *warp, const int16_t *mask, int32_t window, int32_t groups, int16_t *out)
{
    const int32_t half = window / 2, *a = warp->a;
    for (int32_t r = 0; r < window; r++)
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, first = i & ~7, step = i & 7;
            out[k] = 0;
            if (!mask[k])
                continue;
            /* Q12 from where a group of 8 begins: 16 bits hold a group's coordinates */
            const int32_t x = ((warp->x + (first - half) * a[0] + (r - half) * a[1]) >> 4) + ((step * a[0]) >> 4);
            const int32_t y = ((warp->y + (first - half) * a[2] + (r - half) * a[3]) >> 4) + ((step * a[2]) >> 4);
            const uint8_t *p = warp->data + (size_t)(y >> 12) * warp->stride + (size_t)(x >> 12), *q = p + warp->stride;
            out[k] = between(p[0], p[1], q[0], q[1], (int16_t)((x & 4095) << 3), (int16_t)((y & 4095) << 3));
        }
}

void pf_c_affine(const int16_t *c, const pf_gradients *g, int32_t window, int32_t groups, pf_affine_sums *sums)
{
    pf_affine_sums s = {{0}, 0, 0, {0}};
    for (int32_t r = 0; r < window; r++) {
        const int32_t y = r - window / 2;
        int32_t sc = 0, sx = 0, cc = 0, ct = 0, b[4] = {0};
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, v = c[k];
            sc += v, sx += v * (i - window / 2), cc += v * v, ct += v * g->t[k];
            b[0] += v * g->gx[k], b[1] += v * g->gy[k], b[2] += v * g->xgx[k], b[3] += v * g->xgy[k];
        }
        s.c[0] += sc, s.c[1] += sx, s.c[2] += sc * y, s.cc += cc, s.ct += ct;
        s.b[0] += b[0], s.b[1] += b[1], s.b[2] += b[2], s.b[3] += (int64_t)b[0] * y;
        s.b[4] += b[3], s.b[5] += (int64_t)b[1] * y;
    }
    *sums = s;
}

void pf_c_normal(const pf_gradients *g, int32_t window, int32_t groups, pf_normal_sums *sums)
{
    *sums = (pf_normal_sums){0};
    for (int32_t r = 0; r < window; r++) {
        int64_t v[ROW_SUMS] = {0};
        for (int32_t i = 0; i < 8 * groups; i++) {
            const int32_t k = r * PATCH_ROW + i, x = i - window / 2;
            const int32_t t = g->t[k], gx = g->gx[k], gy = g->gy[k], px = g->xgx[k], py = g->xgy[k];
            const int32_t product[ROW_SUMS] = {t,       x * t,   t * t,   gx,      gy,      px,      py,      x * px,
                                               x * py,  gx * t,  gy * t,  px * t,  py * t,  gx * gx, gx * gy, gy * gy,
                                               gx * px, gx * py, gy * py, px * px, px * py, py * py};
            for (int32_t q = 0; q < ROW_SUMS; q++)
                v[q] += product[q];
        }
        pf_normal_add(sums, v, r - window / 2);
    }
}

int64_t pf_c_relief(const int8_t *relief, const int16_t *c, int32_t window, int32_t groups)
{
    int32_t sum = 0; /* 127 * 2040 * 961 at most */
    for (int32_t r = 0; r < window; r++)
        for (int32_t i = 0; i < 8 * groups; i++)
            sum += relief[r * 8 * groups + i] * c[r * PATCH_ROW + i];
    return sum;
}

void pf_c_tensor(const uint8_t *p, size_t stride, int32_t n, pf_tensor_row *out)
{
    const uint8_t *above = p - stride, *below = p + stride;
    for (int32_t i = 0; i < (n + 7) / 8 * 8; i++) {
        const int32_t gx = p[i + 1] - p[i - 1], gy = below[i] - above[i];
        out->k[0][i] = gx * gx + gy * gy;
        out->k[1][i] = gx * gx - gy * gy;
        out->k[2][i] = 2 * gx * gy;
    }
}

int32_t pf_c_corners(const pf_tensor_row *const row[3], int32_t n, pf_tensor_row *sum)
{
    int32_t most = 0;
    for (int32_t i = 0; i < (n + 7) / 8 * 8; i++) {
        int32_t size[3];
        for (int32_t k = 0; k < 3; k++) {
            const int32_t *a = row[0]->k[k] + i, *b = row[1]->k[k] + i, *c = row[2]->k[k] + i;
            const int32_t v = a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + c[0] + c[1] + c[2];
            sum->k[k][i] = v;
            size[k] = v < 0 ? -v : v;
        }
        /* the root of d^2 + e^2 is at least |d|, |e| and (|d| + |e|) / sqrt 2 */
        const int32_t both = size[1] + size[2], larger = size[1] > size[2] ? size[1] : size[2];
        const int32_t slant = (both >> 1) + (both >> 3) + (both >> 4);
        const int32_t bound = size[0] - (slant > larger ? slant : larger);
        most = bound > most ? bound : most;
    }
    return most;
}
