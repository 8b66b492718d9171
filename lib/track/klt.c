/* Pyramidal alignment of two frames, inverse-compositional: I_to(p + x) = gain I_from(q + x + d) + bias. Gain and bias
 * are eliminated in closed form, so a moving lamp costs nothing: the steepest-descent images are made orthogonal to the
 * template and to 1, and a pixel's change of light then has no component along them. */
#include <string.h>

#include "track_private.h"

#define STEP_MAX      (4 << 16) /* Q16.16 px a step: beyond, the linear model says nothing */
#define SETTLED       655       /* 0.01 px */
#define NOT_SETTLED   13107     /* a last step above 0.2 px means it still wanders */
#define LEVEL_TRUSTED 9830      /* ZNCC 0.3: a coarse level that ends below keeps its start */

/* Sums of one patch, exact. */
typedef struct pf_template {
    int64_t n, t, gx, gy; /* plain sums */
    int64_t var;          /* n times the variance */
    int64_t tx, ty;       /* gradients times the centred template */
    int64_t xx, xy, yy;   /* normal matrix with gain and bias eliminated, scaled down by `shift` bits */
    int32_t shift;
} pf_template;

/* What similarity needs of the last patch sampled. */
typedef struct pf_like {
    int64_t cov, var;
} pf_like;

static bool in_circle(const pf_klt *klt, int64_t dx, int64_t dy)
{
    const int64_t r = klt->radius_q16;
    return dx * dx + dy * dy <= r * r;
}

bool pf_klt_inside(const pf_klt *klt, const pf_image *image, pf_point_q16 at)
{
    const int64_t reach = (int64_t)(klt->half + 1) << 16;
    if (at.x < reach || at.y < reach || at.x + reach > ((int64_t)image->width - 2) << 16 ||
        at.y + reach > ((int64_t)image->height - 2) << 16)
        return false;
    if (!klt->radius_q16)
        return true;
    const int64_t dx = (int64_t)at.x - klt->circle.x, dy = (int64_t)at.y - klt->circle.y;
    return in_circle(klt, (dx < 0 ? -dx : dx) + reach, (dy < 0 ? -dy : dy) + reach);
}

/* a b / 2^16, rounded down: one instruction on eight lanes. */
static inline int16_t high_product(int16_t a, int16_t b)
{
    return (int16_t)((a * b) >> 16);
}

/* One row between columns, Q6, at most 1/64 too low; `fx` Q15. Clamped to the image's border where `whole` is false. */
static void blend_row(const pf_image *image, int64_t ix, int64_t iy, bool whole, int32_t cols, int16_t fx,
                      int16_t *restrict out)
{
    uint8_t edge[PATCH_ROW + 1];
    const uint8_t *restrict p = edge;
    if (whole) {
        p = image->data + (size_t)iy * image->stride + (size_t)ix;
    } else {
        const int64_t right = (int64_t)image->width - 1, bottom = (int64_t)image->height - 1;
        const uint8_t *row = image->data + (size_t)(iy < 0 ? 0 : iy > bottom ? bottom : iy) * image->stride;
        for (int32_t i = 0; i <= cols; i++)
            edge[i] = row[ix + i < 0 ? 0 : ix + i > right ? right : ix + i];
    }
    for (int32_t i = 0; i < WHOLE(cols); i++) {
        const int16_t slope = (int16_t)((p[i + 1] - p[i]) * 128);
        out[i] = (int16_t)(p[i] * 64 + high_product(slope, fx));
    }
}

/* Bilinear patch of `rows` rows and `cols` (a multiple of 8) columns whose top-left sample is at (x, y), Q5 - 4080.
 * Coordinates off the image are clamped to its border. `mask` (stride PATCH_ROW) or NULL. */
static void sample_patch(const pf_image *image, int64_t x, int64_t y, int32_t rows, int32_t cols, const int16_t *mask,
                         int16_t *out)
{
    const int16_t fx = (int16_t)((x & 0xFFFF) >> 1), fy = (int16_t)((y & 0xFFFF) >> 1);
    const int64_t ix = x >> 16, iy = y >> 16;
    const bool whole = ix >= 0 && iy >= 0 && ix + cols < (int64_t)image->width && iy + rows < (int64_t)image->height;
    int16_t line[2][PATCH_ROW];
    blend_row(image, ix, iy, whole, cols, fx, line[0]);
    for (int32_t r = 0; r < rows; r++) {
        const int16_t *restrict upper = line[r & 1], *restrict lower = line[~r & 1];
        int16_t *restrict o = out + r * PATCH_ROW;
        blend_row(image, ix, iy + r + 1, whole, cols, fx, line[~r & 1]);
        for (int32_t i = 0; i < WHOLE(cols); i++) {
            const int16_t slope = (int16_t)((lower[i] - upper[i]) * 2);
            o[i] = (int16_t)(((int16_t)(upper[i] + high_product(slope, fy)) >> 1) - 4080);
        }
        if (mask)
            for (int32_t i = 0; i < WHOLE(cols); i++)
                o[i] &= mask[r * PATCH_ROW + i];
    }
}

/* Narrows columns [*lo, *hi] of the window row at absolute `y` to the part of `image` that lies inside the image (with
 * the gradient's border) and the circle at this level. Coarse pixels mix in what lies 2 px away: 2 px of margin. */
static void row_span(const pf_klt *klt, const pf_image *image, uint32_t level, int64_t left, int64_t y, int32_t *lo,
                     int32_t *hi)
{
    int64_t first = 1, last = (int64_t)image->width - 3;
    if (y < 1 || y > (int64_t)image->height - 3)
        last = 0;
    if (klt->radius_q16 && last > 0) {
        const int64_t r = (klt->radius_q16 >> level >> 16) - 2;
        const int64_t dy = y - (klt->circle.y >> level >> 16), cx = klt->circle.x >> level >> 16;
        const int64_t room = r * r - dy * dy;
        if (r <= 0 || room < 0) {
            last = 0;
        } else {
            const int64_t reach = pf_isqrt64((uint64_t)room);
            first = cx - reach > first ? cx - reach : first;
            last = cx + reach < last ? cx + reach : last;
        }
    }
    if (first - left > *lo)
        *lo = (int32_t)(first - left > klt->window ? klt->window : first - left);
    if (last - left < *hi)
        *hi = (int32_t)(last - left < -1 ? -1 : last - left);
}

/* Whether the window at `p`, with border, lies clear of the image's edge and the circle at this level. */
static bool window_clear(const pf_klt *klt, const pf_image *image, uint32_t level, pf_point_q16 p)
{
    const int64_t x = p.x >> 16, y = p.y >> 16, reach = klt->half;
    if (x - reach < 1 || y - reach < 1 || x + reach > (int64_t)image->width - 3 ||
        y + reach > (int64_t)image->height - 3)
        return false;
    if (!klt->radius_q16)
        return true;
    const int64_t dx = x - (klt->circle.x >> level >> 16), dy = y - (klt->circle.y >> level >> 16);
    const int64_t ax = (dx < 0 ? -dx : dx) + reach, ay = (dy < 0 ? -dy : dy) + reach;
    const int64_t r = (klt->radius_q16 >> level >> 16) - 2;
    return r > 0 && ax * ax + ay * ay <= r * r;
}

/* Which pixels of the window count at this level, for a reference at `p` and a start at `q`. Returns how many. */
static int32_t make_mask(pf_klt *klt, const pf_image *image, uint32_t level, pf_point_q16 p, pf_point_q16 q)
{
    const int64_t px = (p.x >> 16) - klt->half, py = (p.y >> 16) - klt->half;
    const int64_t qx = (q.x >> 16) - klt->half, qy = (q.y >> 16) - klt->half;
    const bool clear = window_clear(klt, image, level, p) && window_clear(klt, image, level, q);
    int32_t count = 0;
    for (int32_t r = 0; r < klt->window; r++) {
        int32_t lo = 0, hi = klt->window - 1;
        if (!clear) {
            row_span(klt, image, level, px, py + r, &lo, &hi);
            row_span(klt, image, level, qx, qy + r, &lo, &hi);
        }
        int16_t *m = klt->mask + r * PATCH_ROW;
        for (int32_t i = 0; i < klt->cols; i++)
            m[i] = (int16_t) - (i >= lo && i <= hi);
        count += hi >= lo ? hi - lo + 1 : 0;
    }
    return count;
}

/* Splits the raw patch into template and doubled gradients (Q6), masked, and sums them. */
static void template_sums(pf_klt *klt, int32_t count, pf_template *s)
{
    int64_t t = 0, tt = 0, gx1 = 0, gy1 = 0, xx = 0, xy = 0, yy = 0, xt = 0, yt = 0;
    const int32_t cols = WHOLE(klt->cols);
    for (int32_t r = 0; r < klt->window; r++) {
        const int16_t *restrict above = klt->raw + r * PATCH_ROW + 1;
        const int16_t *restrict row = above + PATCH_ROW, *restrict below = row + PATCH_ROW;
        const int16_t *restrict m = klt->mask + r * PATCH_ROW;
        int16_t *restrict ot = klt->t + r * PATCH_ROW, *restrict ox = klt->gx + r * PATCH_ROW,
                          *restrict oy = klt->gy + r * PATCH_ROW;
        for (int32_t i = 0; i < cols; i++) {
            ot[i] = (int16_t)(row[i] & m[i]);
            ox[i] = (int16_t)((row[i + 1] - row[i - 1]) & m[i]);
            oy[i] = (int16_t)((below[i] - above[i]) & m[i]);
        }
        int32_t a = 0, b = 0, c = 0, d = 0, e = 0, f = 0, g = 0, h = 0, k = 0;
        for (int32_t i = 0; i < cols; i++) {
            a += ot[i];
            b += ot[i] * ot[i];
            c += ox[i];
            d += oy[i];
            h += ox[i] * ot[i];
            k += oy[i] * ot[i];
        }
        for (int32_t i = 0; i < cols; i++) {
            e += ox[i] * ox[i];
            f += ox[i] * oy[i];
            g += oy[i] * oy[i];
        }
        t += a, tt += b, gx1 += c, gy1 += d, xx += e, xy += f, yy += g, xt += h, yt += k;
    }
    const int64_t n = count;
    *s = (pf_template){.n = n, .t = t, .gx = gx1, .gy = gy1};
    s->var = tt - t * t / n;
    s->tx = xt - gx1 * t / n;
    s->ty = yt - gy1 * t / n;
    if (s->var < n << 8) /* standard deviation below half a grey level: nothing there */
        return;
    const int64_t rx = s->tx * 16384 / s->var, ry = s->ty * 16384 / s->var;
    s->xx = xx - gx1 * gx1 / n - ((s->tx * rx) >> 14);
    s->xy = xy - gx1 * gy1 / n - ((s->tx * ry) >> 14);
    s->yy = yy - gy1 * gy1 / n - ((s->ty * ry) >> 14);
}

/* Whether the smaller eigenvalue reaches the threshold; scales the matrix for the solver (entries below 2^30). */
static bool template_usable(const pf_klt *klt, pf_template *s)
{
    if (s->xx <= 0 || s->yy <= 0)
        return false;
    int64_t least = (s->n * klt->min_eigen) << 12; /* doubled gradients of Q5 grey: Q12 */
    int64_t most = s->xx > s->yy ? s->xx : s->yy;
    while (most >> s->shift >= (int64_t)1 << 30)
        s->shift++;
    s->xx >>= s->shift;
    s->xy >>= s->shift;
    s->yy >>= s->shift;
    least >>= s->shift;
    return s->xx > least && s->yy > least && (s->xx - least) * (s->yy - least) > s->xy * s->xy;
}

int32_t pf_zncc(int64_t cov, int64_t var_a, int64_t var_b)
{
    const uint64_t a = (uint64_t)(var_a > 0 ? var_a : 0) >> 5, b = (uint64_t)(var_b > 0 ? var_b : 0) >> 5;
    const uint32_t norm = pf_isqrt64(a * b);
    return norm ? pf_clamp_i64((cov >> 5) * 32768 / norm, 32767) : 0;
}

/* One step at `at`: moves it, and reports gain, similarity and the step's length (larger component). False when the
 * gain is out of range. */
static bool step(pf_klt *klt, const pf_image *to, const pf_template *s, pf_point_q16 *at, pf_fit *fit, pf_like *like,
                 int32_t *moved)
{
    const int32_t cols = WHOLE(klt->cols);
    sample_patch(to, (int64_t)at->x - ((int64_t)klt->half << 16), (int64_t)at->y - ((int64_t)klt->half << 16),
                 klt->window, cols, klt->mask, klt->c);
    int64_t sc = 0, scc = 0, sct = 0, sxc = 0, syc = 0;
    for (int32_t r = 0; r < klt->window; r++) {
        const int16_t *restrict c = klt->c + r * PATCH_ROW, *restrict t = klt->t + r * PATCH_ROW;
        const int16_t *restrict gx = klt->gx + r * PATCH_ROW, *restrict gy = klt->gy + r * PATCH_ROW;
        int32_t a = 0, b = 0, d = 0, e = 0, f = 0;
        for (int32_t i = 0; i < cols; i++) {
            a += c[i];
            b += c[i] * c[i];
            d += c[i] * t[i];
            e += c[i] * gx[i];
            f += c[i] * gy[i];
        }
        sc += a, scc += b, sct += d, sxc += e, syc += f;
    }
    const int64_t cov = sct - s->t * sc / s->n, var = scc - sc * sc / s->n;
    const int64_t gain_q18 = cov * (1 << 18) / s->var, gain = gain_q18 >> 4;
    fit->gain_q14 = pf_clamp_i64(gain, 1 << 30);
    like->cov = cov;
    like->var = var;
    *moved = 0;
    if (gain < GAIN_MIN || gain > GAIN_MAX)
        return false;
    const int64_t bx = (sxc - s->gx * sc / s->n - ((s->tx * gain_q18) >> 18)) >> s->shift;
    const int64_t by = (syc - s->gy * sc / s->n - ((s->ty * gain_q18) >> 18)) >> s->shift;
    const int64_t det = (s->xx * s->yy - s->xy * s->xy) >> 17; /* Q16 result, and 2 for the doubled gradients */
    const int64_t nx = s->yy * bx - s->xy * by, ny = s->xx * by - s->xy * bx;
    if (det <= 0)
        return false;
    const int32_t dx = pf_clamp_i64((int64_t)pf_clamp_i64(nx / det, 1 << 26) * GAIN_ONE / gain, STEP_MAX);
    const int32_t dy = pf_clamp_i64((int64_t)pf_clamp_i64(ny / det, 1 << 26) * GAIN_ONE / gain, STEP_MAX);
    at->x -= dx;
    at->y -= dy;
    const int32_t ax = dx < 0 ? -dx : dx, ay = dy < 0 ? -dy : dy;
    *moved = ax > ay ? ax : ay;
    return true;
}

/* Whether `at` has left the neighbourhood of `start` in which the window still overlaps half. */
static bool strayed(const pf_klt *klt, pf_point_q16 at, pf_point_q16 start)
{
    const int64_t reach = (int64_t)klt->half << 16, dx = (int64_t)at.x - start.x, dy = (int64_t)at.y - start.y;
    return dx > reach || dx < -reach || dy > reach || dy < -reach;
}

/* Aligns one level; *at is in that level's pixels. On failure *at keeps its start. */
static pf_fit align_level(pf_klt *klt, const pf_image *from, const pf_image *to, uint32_t level, pf_point_q16 p,
                          pf_point_q16 *at)
{
    pf_fit fit = {PF_TRACK_FLAT, 0, GAIN_ONE};
    pf_template sums;
    const int32_t count = make_mask(klt, from, level, p, *at);
    if (2 * count < klt->window * klt->window) {
        fit.reason = PF_TRACK_LEFT;
        return fit;
    }
    const int64_t reach = (int64_t)(klt->half + 1) << 16;
    sample_patch(from, p.x - reach, p.y - reach, klt->window + 2, (klt->window + 9) / 8 * 8, NULL, klt->raw);
    template_sums(klt, count, &sums);
    if (!template_usable(klt, &sums))
        return fit;
    const pf_point_q16 start = *at;
    const int32_t settled = level ? 4 * SETTLED : SETTLED;
    pf_like like = {0, 0};
    int32_t moved = 0;
    fit.reason = PF_TRACK_OK;
    for (int32_t i = 0; i < klt->iterations && fit.reason == PF_TRACK_OK; i++) {
        if (!step(klt, to, &sums, at, &fit, &like, &moved))
            fit.reason = PF_TRACK_RESIDUAL;
        else if (strayed(klt, *at, start))
            fit.reason = PF_TRACK_DIVERGED;
        else if (moved < settled)
            break;
    }
    fit.zncc_q15 = pf_zncc(like.cov, sums.var, like.var);
    if (fit.reason == PF_TRACK_OK && moved > NOT_SETTLED && level == 0)
        fit.reason = PF_TRACK_DIVERGED;
    if (fit.reason != PF_TRACK_OK || (level && fit.zncc_q15 < LEVEL_TRUSTED))
        *at = start;
    return fit;
}

pf_fit pf_klt_track(pf_klt *klt, const pf_pyramid *from, const pf_pyramid *to, pf_point_q16 from_pos,
                    pf_point_q16 *to_pos, uint32_t top)
{
    pf_fit fit = {PF_TRACK_FLAT, 0, GAIN_ONE};
    pf_point_q16 at = *to_pos;
    for (uint32_t l = top + 1u; l-- > 0u;) {
        const pf_point_q16 p = {from_pos.x >> l, from_pos.y >> l};
        pf_point_q16 q = {at.x >> l, at.y >> l};
        fit = align_level(klt, &from->level[l], &to->level[l], l, p, &q);
        if (fit.reason == PF_TRACK_OK) {
            at.x = (int32_t)((uint32_t)q.x << l);
            at.y = (int32_t)((uint32_t)q.y << l);
        }
    }
    *to_pos = at;
    if (fit.reason == PF_TRACK_OK && !pf_klt_inside(klt, &to->level[0], at))
        fit.reason = PF_TRACK_LEFT;
    return fit;
}
