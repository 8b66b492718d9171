/* The kernels in vectors. A window is walked in strips of eight columns, so that a row's horizontal blend serves the
 * row above and the one below it without leaving the registers. */
#include "../kernels.h"

#include "../../simd.h"

/* Eight pixels between columns, Q6. */
static inline int16x8_t blend(const uint8_t *p, int16x8_t fx)
{
    const int16x8_t a = pf_load8(p), b = pf_load8(p + 1);
    return vaddq_s16(vshlq_n_s16(a, 6), pf_mul_q15(vshlq_n_s16(vsubq_s16(b, a), 6), fx));
}

/* Eight samples between two blended rows, Q4 less PIXEL_MID. */
static inline int16x8_t between(int16x8_t upper, int16x8_t lower, int16x8_t fy)
{
    const int16x8_t v = vaddq_s16(upper, pf_mul_q15(vsubq_s16(lower, upper), fy));
    return vshrq_n_s16(vaddq_s16(v, vdupq_n_s16(2 - 4 * PIXEL_MID)), 2);
}

void pf_neon_sample(const pf_spot *spot, int32_t rows, int32_t groups, int16_t *out)
{
    const int16x8_t fx = vdupq_n_s16(spot->fx), fy = vdupq_n_s16(spot->fy);
    for (int32_t g = 0; g < groups; g++) {
        const uint8_t *p = spot->p + 8 * g;
        int16_t *o = out + 8 * g;
        int16x8_t upper = blend(p, fx);
        for (int32_t r = 0; r < rows; r++, o += PATCH_ROW) {
            p += spot->stride;
            const int16x8_t lower = blend(p, fx);
            vst1q_s16(o, between(upper, lower, fy));
            upper = lower;
        }
    }
}

/* Rows whose products of gradients 32 bits hold: 2 * 4080^2 * 64 < 2^31. */
static inline int32_t rows_at_once(int32_t groups)
{
    return 64 / groups;
}

void pf_neon_template(const int16_t *raw, const int16_t *mask, int32_t rows, int32_t groups, int16_t *t, int16_t *gx,
                      int16_t *gy, pf_template_sums *sums)
{
    const int16x8_t one = vdupq_n_s16(1);
    pf_template_sums s = {0};
    for (int32_t first = 0; first < rows; first += rows_at_once(groups)) {
        const int32_t stop = first + rows_at_once(groups) < rows ? first + rows_at_once(groups) : rows;
        int32x4_t st = vdupq_n_s32(0), tt = st, x = st, y = st, xx = st, xy = st, yy = st, xt = st, yt = st;
        for (int32_t g = 0; g < groups; g++) {
            for (int32_t r = first; r < stop; r++) {
                const int32_t k = r * PATCH_ROW + 8 * g;
                const int16_t *row = raw + k + PATCH_ROW;
                const int16x8_t m = vld1q_s16(mask + k);
                const int16x8_t vt = vandq_s16(vld1q_s16(row + 1), m);
                const int16x8_t vx = vandq_s16(vsubq_s16(vld1q_s16(row + 2), vld1q_s16(row)), m);
                const int16x8_t vy =
                    vandq_s16(vsubq_s16(vld1q_s16(row + 1 + PATCH_ROW), vld1q_s16(row + 1 - PATCH_ROW)), m);
                vst1q_s16(t + k, vt);
                vst1q_s16(gx + k, vx);
                vst1q_s16(gy + k, vy);
                st = pf_dot(st, vt, one);
                tt = pf_dot(tt, vt, vt);
                x = pf_dot(x, vx, one);
                y = pf_dot(y, vy, one);
                xx = pf_dot(xx, vx, vx);
                xy = pf_dot(xy, vx, vy);
                yy = pf_dot(yy, vy, vy);
                xt = pf_dot(xt, vx, vt);
                yt = pf_dot(yt, vy, vt);
            }
        }
        s.t += pf_total(st), s.tt += pf_total(tt), s.x += pf_total(x), s.y += pf_total(y);
        s.xx += pf_total(xx), s.xy += pf_total(xy), s.yy += pf_total(yy), s.xt += pf_total(xt), s.yt += pf_total(yt);
    }
    *sums = s;
}

void pf_neon_step(const pf_spot *spot, const int16_t *mask, int32_t rows, int32_t groups, const int16_t *t,
                  const int16_t *gx, const int16_t *gy, pf_step_sums *sums)
{
    const int16x8_t fx = vdupq_n_s16(spot->fx), fy = vdupq_n_s16(spot->fy), one = vdupq_n_s16(1);
    const size_t stride = spot->stride;
    /* 2 * 2040 * 4080 * 4 groups * 31 rows < 2^31 */
    int32x4_t sc = vdupq_n_s32(0), cc = sc, ct = sc, cx = sc, cy = sc;
    for (int32_t g = 0; g < groups; g++) {
        const uint8_t *p = spot->p + 8 * g;
        int16x8_t upper = blend(p, fx);
        for (int32_t r = 0; r < rows; r++) {
            const int32_t k = r * PATCH_ROW + 8 * g;
            p += stride;
            const int16x8_t lower = blend(p, fx);
            const int16x8_t c = vandq_s16(between(upper, lower, fy), vld1q_s16(mask + k));
            upper = lower;
            sc = pf_dot(sc, c, one);
            cc = pf_dot(cc, c, c);
            ct = pf_dot(ct, c, vld1q_s16(t + k));
            cx = pf_dot(cx, c, vld1q_s16(gx + k));
            cy = pf_dot(cy, c, vld1q_s16(gy + k));
        }
    }
    *sums = (pf_step_sums){pf_total(sc), pf_total(cc), pf_total(ct), pf_total(cx), pf_total(cy)};
}

static inline int16x8_t lanes(void)
{
    static const int16_t index[8] = {0, 1, 2, 3, 4, 5, 6, 7};
    return vld1q_s16(index);
}

/* a + 2 b + c */
static inline int16x8_t sobel(int16x8_t a, int16x8_t b, int16x8_t c)
{
    return vaddq_s16(vaddq_s16(a, c), vaddq_s16(b, b));
}

/* What smoothing adds, Q4. */
static inline int16x8_t bend(int16x8_t before, int16x8_t at, int16x8_t after, int16x8_t smooth)
{
    const int16x8_t v = vsubq_s16(vaddq_s16(before, after), vaddq_s16(at, at));
    return pf_mul_q15(vshlq_n_s16(v, 4), smooth);
}

void pf_neon_unpack(const uint8_t *pixels, const int16_t *mask, int32_t window, int32_t groups, const pf_gradients *out)
{
    const int32_t w = window + 2;
    const int16x8_t along = vdupq_n_s16(out->smooth[0]), down = vdupq_n_s16(out->smooth[1]);
    for (int32_t g = 0; g < groups; g++) {
        const int16x8_t x = vaddq_s16(lanes(), vdupq_n_s16((int16_t)(8 * g - window / 2)));
        const uint8_t *p = pixels + 8 * g;
        int16x8_t a0 = pf_load8(p), a1 = pf_load8(p + 1), a2 = pf_load8(p + 2);
        int16x8_t b0 = pf_load8(p + w), b1 = pf_load8(p + w + 1), b2 = pf_load8(p + w + 2);
        for (int32_t r = 0; r < window; r++) {
            const int32_t k = r * PATCH_ROW + 8 * g;
            const uint8_t *q = p + (r + 2) * w;
            const int16x8_t c0 = pf_load8(q), c1 = pf_load8(q + 1), c2 = pf_load8(q + 2), m = vld1q_s16(mask + k);
            const int16x8_t smoothed = vaddq_s16(bend(b0, b1, b2, along), bend(a1, b1, c1, down));
            const int16x8_t t = vaddq_s16(vsubq_s16(vshlq_n_s16(b1, 4), vdupq_n_s16(PIXEL_MID)), smoothed);
            const int16x8_t gx = vandq_s16(sobel(vsubq_s16(a2, a0), vsubq_s16(b2, b0), vsubq_s16(c2, c0)), m);
            const int16x8_t gy = vandq_s16(sobel(vsubq_s16(c0, a0), vsubq_s16(c1, a1), vsubq_s16(c2, a2)), m);
            vst1q_s16(out->t + k, vandq_s16(t, m));
            vst1q_s16(out->gx + k, gx);
            vst1q_s16(out->gy + k, gy);
            vst1q_s16(out->xgx + k, vmulq_s16(gx, x));
            vst1q_s16(out->xgy + k, vmulq_s16(gy, x));
            a0 = b0, a1 = b1, a2 = b2, b0 = c0, b1 = c1, b2 = c2;
        }
    }
}

void pf_neon_bend(const int32_t bow[6], int32_t window, int32_t groups, const pf_gradients *g)
{
    const int32_t half = window / 2;
    const int16x8_t most = vdupq_n_s16(PIXEL_MID), least = vdupq_n_s16(-PIXEL_MID);
    for (int32_t i = 0; i < groups; i++) {
        const int16x8_t x = vaddq_s16(lanes(), vdupq_n_s16((int16_t)(8 * i - half)));
        int16_t xx[2][8];
        for (int32_t k = 0; k < 8; k++) {
            const int32_t square = (8 * i + k - half) * (8 * i + k - half);
            xx[0][k] = (int16_t)((bow[0] * square) >> 9);
            xx[1][k] = (int16_t)((bow[3] * square) >> 9);
        }
        const int16x8_t ux = vld1q_s16(xx[0]), vx = vld1q_s16(xx[1]);
        for (int32_t r = 0; r < window; r++) {
            const int32_t k = r * PATCH_ROW + 8 * i, y = r - half;
            const int16x8_t uy = vdupq_n_s16((int16_t)((bow[2] * y * y) >> 9)),
                            vy = vdupq_n_s16((int16_t)((bow[5] * y * y) >> 9));
            const int16x8_t uxy = vdupq_n_s16((int16_t)((bow[1] * y) >> 9)),
                            vxy = vdupq_n_s16((int16_t)((bow[4] * y) >> 9));
            const int16x8_t u = vmlaq_s16(vaddq_s16(ux, uy), uxy, x), v = vmlaq_s16(vaddq_s16(vx, vy), vxy, x);
            const int16x8_t gx = vld1q_s16(g->gx + k), gy = vld1q_s16(g->gy + k);
            const int16x8_t less = vaddq_s16(pf_mul_q15(vaddq_s16(gx, gx), u), pf_mul_q15(vaddq_s16(gy, gy), v));
            vst1q_s16(g->t + k, vmaxq_s16(vminq_s16(vsubq_s16(vld1q_s16(g->t + k), less), most), least));
        }
    }
}

/* Whether every group of the window fits the tables of `warp_group` (16 columns, 4 rows) and these the image. */
static int fits_tables(const pf_warp *w, int32_t window, int32_t groups)
{
    const int32_t half = window / 2, *a = w->a, reach = 8 * groups - half;
    if (a[0] <= 0 || a[0] > 2 << 16 || a[2] > 18350 || a[2] < -18350) /* 7 steps: 14 columns, 2 rows */
        return 0;
    const int64_t tilt = (int64_t)half * (a[1] < 0 ? -a[1] : a[1]);
    const int64_t slope = (int64_t)(half > reach ? half : reach) * (a[2] < 0 ? -a[2] : a[2]);
    const int64_t height = (int64_t)half * (a[3] < 0 ? -a[3] : a[3]);
    return w->x - (int64_t)half * a[0] - tilt >= 1 << 16 && w->y - slope - height >= 1 << 16 &&
           w->x + (int64_t)reach * a[0] + tilt < ((int64_t)w->width - 17) << 16 &&
           w->y + slope + height < ((int64_t)w->height - 5) << 16;
}

/* Two neighbouring pixels a lane -> Q6 between them. */
static inline int16x8_t blend_pairs(uint8x16_t pairs, int16x8_t fx)
{
    const uint16x8_t v = vreinterpretq_u16_u8(pairs);
    const int16x8_t a = vreinterpretq_s16_u16(vandq_u16(v, vdupq_n_u16(255)));
    const int16x8_t b = vreinterpretq_s16_u16(vshrq_n_u16(v, 8));
    return vaddq_s16(vshlq_n_s16(a, 6), pf_mul_q15(vshlq_n_s16(vsubq_s16(b, a), 6), fx));
}

/* Eight samples whose first lies at (x, y), Q12, the others (dx, dy) from there: whatever the warp, they lie in 16
 * columns of 4 rows, so that a table lookup in each row and a choice between rows gather them. */
static inline int16x8_t warp_group(const pf_warp *w, int32_t x, int32_t y, int32_t lowest, uint16x8_t dx, uint16x8_t dy)
{
    const int32_t left = x >> 12, top = (y + lowest) >> 12;
    const uint8_t *p = w->data + (size_t)top * w->stride + (size_t)left;
    const uint16x8_t u = vaddq_u16(vdupq_n_u16((uint16_t)(x & 4095)), dx);
    const uint16x8_t v = vaddq_u16(vdupq_n_u16((uint16_t)(y - top * 4096)), dy);
    const uint16x8_t column = vshrq_n_u16(u, 12), row = vshrq_n_u16(v, 12), part = vdupq_n_u16(0x7FF8);
    const int16x8_t fx = vreinterpretq_s16_u16(vandq_u16(vshlq_n_u16(u, 3), part));
    const int16x8_t fy = vreinterpretq_s16_u16(vandq_u16(vshlq_n_u16(v, 3), part));
    const uint8x16_t pair =
        vreinterpretq_u8_u16(vaddq_u16(vorrq_u16(column, vshlq_n_u16(column, 8)), vdupq_n_u16(0x0100)));
    const uint8x16_t r0 = pf_lookup(vld1q_u8(p), pair), r1 = pf_lookup(vld1q_u8(p + w->stride), pair);
    const uint8x16_t r2 = pf_lookup(vld1q_u8(p + 2 * w->stride), pair);
    const uint8x16_t r3 = pf_lookup(vld1q_u8(p + 3 * w->stride), pair);
    const uint16x8_t first = vceqq_u16(row, vdupq_n_u16(0)), third = vceqq_u16(row, vdupq_n_u16(2));
    const uint8x16_t upper = pf_select(first, r0, pf_select(third, r2, r1));
    const uint8x16_t lower = pf_select(first, r1, pf_select(third, r3, r2));
    return between(blend_pairs(upper, fx), blend_pairs(lower, fx), fy);
}

void pf_neon_warp(const pf_warp *warp, const int16_t *mask, int32_t window, int32_t groups, int16_t *out)
{
    if (!fits_tables(warp, window, groups)) {
        pf_c_warp(warp, mask, window, groups, out);
        return;
    }
    const int32_t half = window / 2, *a = warp->a;
    uint16_t step[2][8];
    for (int32_t i = 0; i < 8; i++) {
        step[0][i] = (uint16_t)((i * a[0]) >> 4);
        step[1][i] = (uint16_t)((i * a[2]) >> 4);
    }
    const uint16x8_t dx = vld1q_u16(step[0]), dy = vld1q_u16(step[1]);
    const int32_t lowest = a[2] < 0 ? (7 * a[2]) >> 4 : 0;
    for (int32_t r = 0; r < window; r++) {
        int32_t x = warp->x - half * a[0] + (r - half) * a[1], y = warp->y - half * a[2] + (r - half) * a[3];
        for (int32_t g = 0; g < groups; g++, x += 8 * a[0], y += 8 * a[2]) {
            const int32_t k = r * PATCH_ROW + 8 * g;
            const int16x8_t v = warp_group(warp, x >> 4, y >> 4, lowest, dx, dy);
            vst1q_s16(out + k, vandq_s16(v, vld1q_s16(mask + k)));
        }
    }
}

/* Sums over half the rows, from the edge to the centre: rows * 2040 * 1020 * 15 and the like stay below 2^31, and
 * adding the running sums after each row weighs a row by its distance from the centre. */
typedef struct affine_half {
    int32x4_t c, x, cc, ct, b[4], cy, by[2];
} affine_half;

static inline void affine_row(affine_half *h, const int16_t *c, const pf_gradients *g, int32_t k, int32_t groups,
                              int16x8_t first)
{
    const int16x8_t one = vdupq_n_s16(1);
    for (int32_t i = 0; i < groups; i++, k += 8, first = vaddq_s16(first, vdupq_n_s16(8))) {
        const int16x8_t v = vld1q_s16(c + k);
        h->c = pf_dot(h->c, v, one);
        h->x = pf_dot(h->x, v, first);
        h->cc = pf_dot(h->cc, v, v);
        h->ct = pf_dot(h->ct, v, vld1q_s16(g->t + k));
        h->b[0] = pf_dot(h->b[0], v, vld1q_s16(g->gx + k));
        h->b[1] = pf_dot(h->b[1], v, vld1q_s16(g->gy + k));
        h->b[2] = pf_dot(h->b[2], v, vld1q_s16(g->xgx + k));
        h->b[3] = pf_dot(h->b[3], v, vld1q_s16(g->xgy + k));
    }
}

void pf_neon_affine(const int16_t *c, const pf_gradients *g, int32_t window, int32_t groups, pf_affine_sums *sums)
{
    const int32_t half = window / 2;
    const int16x8_t first = vaddq_s16(lanes(), vdupq_n_s16((int16_t)-half));
    const int32x4_t zero = vdupq_n_s32(0);
    pf_affine_sums s = {{0}, 0, 0, {0}};
    for (int32_t side = -1; side <= 1; side += 2) {
        affine_half h = {zero, zero, zero, zero, {zero, zero, zero, zero}, zero, {zero, zero}};
        for (int32_t d = half; d > 0; d--) {
            affine_row(&h, c, g, (half + side * d) * PATCH_ROW, groups, first);
            h.cy = vaddq_s32(h.cy, h.c);
            h.by[0] = vaddq_s32(h.by[0], h.b[0]);
            h.by[1] = vaddq_s32(h.by[1], h.b[1]);
        }
        if (side > 0)
            affine_row(&h, c, g, half * PATCH_ROW, groups, first);
        s.c[0] += pf_total(h.c), s.c[1] += pf_total(h.x), s.c[2] += side * pf_total(h.cy);
        s.cc += pf_total(h.cc), s.ct += pf_total(h.ct), s.b[0] += pf_total(h.b[0]), s.b[1] += pf_total(h.b[1]);
        s.b[2] += pf_total(h.b[2]), s.b[4] += pf_total(h.b[3]);
        s.b[3] += side * pf_total(h.by[0]), s.b[5] += side * pf_total(h.by[1]);
    }
    *sums = s;
}

/* A row's sums stay below 2^31 in each lane: squares of x gx, 1020^2 (15^2 + 14^2 + 7^2 + ...). */
void pf_neon_normal(const pf_gradients *g, int32_t window, int32_t groups, pf_normal_sums *sums)
{
    const int16x8_t one = vdupq_n_s16(1), first = vaddq_s16(lanes(), vdupq_n_s16((int16_t)(-window / 2)));
    *sums = (pf_normal_sums){0};
    for (int32_t r = 0; r < window; r++) {
        int32x4_t s[ROW_SUMS];
        int64_t v[ROW_SUMS];
        for (int32_t q = 0; q < ROW_SUMS; q++)
            s[q] = vdupq_n_s32(0);
        for (int32_t i = 0; i < groups; i++) {
            const int32_t k = r * PATCH_ROW + 8 * i;
            const int16x8_t x = vaddq_s16(first, vdupq_n_s16((int16_t)(8 * i))), t = vld1q_s16(g->t + k);
            const int16x8_t gx = vld1q_s16(g->gx + k), gy = vld1q_s16(g->gy + k);
            const int16x8_t px = vld1q_s16(g->xgx + k), py = vld1q_s16(g->xgy + k);
            s[ROW_T] = pf_dot(s[ROW_T], t, one);
            s[ROW_XT] = pf_dot(s[ROW_XT], t, x);
            s[ROW_TT] = pf_dot(s[ROW_TT], t, t);
            s[ROW_GX] = pf_dot(s[ROW_GX], gx, one);
            s[ROW_GY] = pf_dot(s[ROW_GY], gy, one);
            s[ROW_PX] = pf_dot(s[ROW_PX], px, one);
            s[ROW_PY] = pf_dot(s[ROW_PY], py, one);
            s[ROW_XPX] = pf_dot(s[ROW_XPX], px, x);
            s[ROW_XPY] = pf_dot(s[ROW_XPY], py, x);
            s[ROW_GX_T] = pf_dot(s[ROW_GX_T], gx, t);
            s[ROW_GY_T] = pf_dot(s[ROW_GY_T], gy, t);
            s[ROW_PX_T] = pf_dot(s[ROW_PX_T], px, t);
            s[ROW_PY_T] = pf_dot(s[ROW_PY_T], py, t);
            s[ROW_GX_GX] = pf_dot(s[ROW_GX_GX], gx, gx);
            s[ROW_GX_GY] = pf_dot(s[ROW_GX_GY], gx, gy);
            s[ROW_GY_GY] = pf_dot(s[ROW_GY_GY], gy, gy);
            s[ROW_GX_PX] = pf_dot(s[ROW_GX_PX], gx, px);
            s[ROW_GX_PY] = pf_dot(s[ROW_GX_PY], gx, py);
            s[ROW_GY_PY] = pf_dot(s[ROW_GY_PY], gy, py);
            s[ROW_PX_PX] = pf_dot(s[ROW_PX_PX], px, px);
            s[ROW_PX_PY] = pf_dot(s[ROW_PX_PY], px, py);
            s[ROW_PY_PY] = pf_dot(s[ROW_PY_PY], py, py);
        }
        for (int32_t q = 0; q < ROW_SUMS; q++)
            v[q] = pf_total(s[q]);
        pf_normal_add(sums, v, r - window / 2);
    }
}

int64_t pf_neon_relief(const int8_t *relief, const int16_t *c, int32_t window, int32_t groups)
{
    int32x4_t sum = vdupq_n_s32(0);
    for (int32_t r = 0; r < window; r++)
        for (int32_t g = 0; g < groups; g++)
            sum = pf_dot(sum, vmovl_s8(vld1_s8(relief + 8 * (r * groups + g))), vld1q_s16(c + r * PATCH_ROW + 8 * g));
    return vaddvq_s32(sum);
}

void pf_neon_tensor(const uint8_t *p, size_t stride, int32_t n, pf_tensor_row *out)
{
    const uint8_t *above = p - stride, *below = p + stride;
    for (int32_t i = 0; i < n; i += 8) {
        const int16x8_t gx = vsubq_s16(pf_load8(p + i + 1), pf_load8(p + i - 1));
        const int16x8_t gy = vsubq_s16(pf_load8(below + i), pf_load8(above + i));
        int32x4_t v[3][2];
        pf_squares(gx, gy, v);
        for (int32_t k = 0; k < 3; k++) {
            vst1q_s32(out->k[k] + i, v[k][0]);
            vst1q_s32(out->k[k] + i + 4, v[k][1]);
        }
    }
}

/* Sums of three neighbours in each of four places, given the places' and the next four numbers. */
static inline int32x4_t three(int32x4_t a, int32x4_t b)
{
    return vaddq_s32(vaddq_s32(a, vextq_s32(a, b, 1)), vextq_s32(a, b, 2));
}

int32_t pf_neon_corners(const pf_tensor_row *const row[3], int32_t n, pf_tensor_row *sum)
{
    int32x4_t most = vdupq_n_s32(0), column[3];
    for (int32_t k = 0; k < 3; k++)
        column[k] = vaddq_s32(vaddq_s32(vld1q_s32(row[0]->k[k]), vld1q_s32(row[1]->k[k])), vld1q_s32(row[2]->k[k]));
    for (int32_t i = 0; i < (n + 7) / 8 * 8; i += 4) {
        int32x4_t v[3];
        for (int32_t k = 0; k < 3; k++) {
            const int32_t *a = row[0]->k[k] + i + 4, *b = row[1]->k[k] + i + 4, *c = row[2]->k[k] + i + 4;
            const int32x4_t next = vaddq_s32(vaddq_s32(vld1q_s32(a), vld1q_s32(b)), vld1q_s32(c));
            v[k] = three(column[k], next);
            vst1q_s32(sum->k[k] + i, v[k]);
            column[k] = next;
        }
        const int32x4_t d = vabsq_s32(v[1]), e = vabsq_s32(v[2]), both = vaddq_s32(d, e);
        const int32x4_t slant = vaddq_s32(vaddq_s32(vshrq_n_s32(both, 1), vshrq_n_s32(both, 3)), vshrq_n_s32(both, 4));
        most = vmaxq_s32(most, vsubq_s32(v[0], vmaxq_s32(slant, vmaxq_s32(d, e))));
    }
    int32_t lane[4];
    vst1q_s32(lane, most);
    const int32_t a = lane[0] > lane[1] ? lane[0] : lane[1], b = lane[2] > lane[3] ? lane[2] : lane[3];
    return a > b ? a : b;
}
