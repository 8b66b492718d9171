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

void pf_klt_init(pf_klt *klt, uint32_t window, uint32_t iterations, uint32_t min_eigen, uint32_t noise_q8)
{
    klt->window = (int32_t)window;
    klt->half = klt->window / 2;
    klt->groups = (klt->window + 7) / 8;
    klt->iterations = (int32_t)iterations;
    klt->min_eigen = (int32_t)min_eigen;
    klt->noise_var_q8 = (int32_t)((noise_q8 * noise_q8) >> 8);
    for (int32_t r = 0; r < klt->window; r++)
        for (int32_t i = 0; i < 8 * klt->groups; i++)
            klt->whole[r * PATCH_ROW + i] = (int16_t) - (i < klt->window);
}

/* Where the kernels read a patch of `rows` rows and `groups` groups whose top-left sample is at (x, y): the image, or,
 * where it would run out of the image, a copy with the border repeated. */
static pf_spot spot_at(pf_klt *klt, const pf_image *image, int64_t x, int64_t y, int32_t rows, int32_t groups)
{
    const int64_t ix = x >> 16, iy = y >> 16, right = (int64_t)image->width - 1, bottom = (int64_t)image->height - 1;
    const int32_t columns = 8 * groups + 1;
    pf_spot spot = {NULL, image->stride, (int16_t)((x & 0xFFFF) >> 1), (int16_t)((y & 0xFFFF) >> 1)};
    if (ix >= 0 && iy >= 0 && ix + columns <= right + 1 && iy + rows <= bottom) {
        spot.p = image->data + (size_t)iy * image->stride + (size_t)ix;
        return spot;
    }
    for (int32_t r = 0; r <= rows; r++) {
        const int64_t v = iy + r < 0 ? 0 : iy + r > bottom ? bottom : iy + r;
        const uint8_t *row = image->data + (size_t)v * image->stride;
        for (int32_t i = 0; i < columns; i++)
            klt->edge[r * EDGE_ROW + i] = row[ix + i < 0 ? 0 : ix + i > right ? right : ix + i];
    }
    spot.p = klt->edge;
    spot.stride = EDGE_ROW;
    return spot;
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

/* Which pixels of the window count at this level, for a reference at `p` and a start at `q`: klt->counted. Returns how
 * many. */
static int32_t make_mask(pf_klt *klt, const pf_image *image, uint32_t level, pf_point_q16 p, pf_point_q16 q)
{
    if (window_clear(klt, image, level, p) && window_clear(klt, image, level, q)) {
        klt->counted = klt->whole;
        return klt->window * klt->window;
    }
    const int64_t px = (p.x >> 16) - klt->half, py = (p.y >> 16) - klt->half;
    const int64_t qx = (q.x >> 16) - klt->half, qy = (q.y >> 16) - klt->half;
    int32_t count = 0;
    for (int32_t r = 0; r < klt->window; r++) {
        int32_t lo = 0, hi = klt->window - 1;
        row_span(klt, image, level, px, py + r, &lo, &hi);
        row_span(klt, image, level, qx, qy + r, &lo, &hi);
        int16_t *m = klt->mask + r * PATCH_ROW;
        for (int32_t i = 0; i < 8 * klt->groups; i++)
            m[i] = (int16_t) - (i >= lo && i <= hi);
        count += hi >= lo ? hi - lo + 1 : 0;
    }
    klt->counted = klt->mask;
    return count;
}

/* The template of `count` pixels whose window's corner, less the border, is at (x, y). */
static void take_template(pf_klt *klt, const pf_image *from, int64_t x, int64_t y, int32_t count, pf_template *s)
{
    const int32_t rows = klt->window + 2, groups = (klt->window + 9) / 8;
    const pf_spot spot = spot_at(klt, from, x, y, rows, groups);
    pf_template_sums k;
    PF_KERNEL(sample)(&spot, rows, groups, klt->raw);
    PF_KERNEL(template)(klt->raw, klt->counted, klt->window, klt->groups, klt->t, klt->gx, klt->gy, &k);
    const int64_t n = count;
    *s = (pf_template){.n = n, .t = k.t, .gx = k.x, .gy = k.y};
    s->var = k.tt - k.t * k.t / n;
    s->tx = k.xt - k.x * k.t / n;
    s->ty = k.yt - k.y * k.t / n;
    if (s->var < n << 6) /* standard deviation below half a grey level: nothing there */
        return;
    const int64_t rx = s->tx * 16384 / s->var, ry = s->ty * 16384 / s->var;
    s->xx = k.xx - k.x * k.x / n - ((s->tx * rx) >> 14);
    s->xy = k.xy - k.x * k.y / n - ((s->tx * ry) >> 14);
    s->yy = k.yy - k.y * k.y / n - ((s->ty * ry) >> 14);
}

/* Whether the smaller eigenvalue reaches the threshold; scales the matrix for the solver (entries below 2^30). */
static bool template_usable(const pf_klt *klt, pf_template *s)
{
    if (s->xx <= 0 || s->yy <= 0)
        return false;
    int64_t least = (s->n * klt->min_eigen) << 10; /* doubled gradients of Q4 grey: Q10 */
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

int32_t pf_likeness(const pf_klt *klt, int64_t cov, int64_t var_a, int64_t var_b, int64_t count)
{
    const int64_t noise = count * klt->noise_var_q8, a = var_a - noise, b = var_b - noise;
    return pf_zncc(cov, a > var_a / 8 ? a : var_a / 8, b > var_b / 8 ? b : var_b / 8);
}

/* One step at `at`: moves it, and reports gain, similarity and the step's length (larger component). False when the
 * gain is out of range. */
static bool step(pf_klt *klt, const pf_image *to, const pf_template *s, pf_point_q16 *at, pf_fit *fit, pf_like *like,
                 int32_t *moved)
{
    const int64_t reach = (int64_t)klt->half << 16;
    const pf_spot spot = spot_at(klt, to, at->x - reach, at->y - reach, klt->window, klt->groups);
    pf_step_sums k;
    PF_KERNEL(step)(&spot, klt->counted, klt->window, klt->groups, klt->t, klt->gx, klt->gy, &k);
    const int64_t cov = k.ct - s->t * k.c / s->n, var = k.cc - k.c * k.c / s->n;
    const int64_t gain_q18 = cov * (1 << 18) / s->var, gain = gain_q18 >> 4;
    fit->gain_q14 = pf_clamp_i64(gain, 1 << 30);
    like->cov = cov;
    like->var = var;
    *moved = 0;
    if (gain < GAIN_MIN || gain > GAIN_MAX)
        return false;
    const int64_t bx = (k.cx - s->gx * k.c / s->n - ((s->tx * gain_q18) >> 18)) >> s->shift;
    const int64_t by = (k.cy - s->gy * k.c / s->n - ((s->ty * gain_q18) >> 18)) >> s->shift;
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
    take_template(klt, from, p.x - reach, p.y - reach, count, &sums);
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
    fit.zncc_q15 =
        level ? pf_zncc(like.cov, sums.var, like.var) : pf_likeness(klt, like.cov, sums.var, like.var, count);
    if (fit.reason == PF_TRACK_OK && moved > NOT_SETTLED && level == 0)
        fit.reason = PF_TRACK_DIVERGED;
    if (fit.reason != PF_TRACK_OK || (level && fit.zncc_q15 < LEVEL_TRUSTED))
        *at = start;
    return fit;
}

pf_fit pf_klt_track(pf_klt *klt, const pf_pyramid *from, const pf_pyramid *to, pf_point_q16 from_pos,
                    pf_point_q16 *to_pos, uint32_t top, uint32_t last)
{
    pf_fit fit = {PF_TRACK_FLAT, 0, GAIN_ONE};
    pf_point_q16 at = *to_pos;
    for (uint32_t l = top + 1u; l-- > last;) {
        const pf_point_q16 p = {from_pos.x >> l, from_pos.y >> l};
        pf_point_q16 q = {at.x >> l, at.y >> l};
        fit = align_level(klt, &from->level[l], &to->level[l], l, p, &q);
        if (fit.reason == PF_TRACK_OK) {
            at.x = (int32_t)((uint32_t)q.x << l);
            at.y = (int32_t)((uint32_t)q.y << l);
        }
    }
    *to_pos = at;
    if (last == 0 && fit.reason == PF_TRACK_OK && !pf_klt_inside(klt, &to->level[0], at))
        fit.reason = PF_TRACK_LEFT;
    return fit;
}
