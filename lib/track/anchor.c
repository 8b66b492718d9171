/* The anchor of a track: the patch in which it was first seen, aligned with every new frame by an affine warp, gain and
 * bias. Frame-to-frame errors add up along a track; against one template they do not. Inverse-compositional, all six
 * parameters at once; gain and bias eliminated as in klt.c, and here also the two slopes of the bias: over a track's
 * life the lamp's light slides over the patch, and its slope, not the noise, would be the largest error.
 *
 * Parameters d = (dx, dy, axx, axy, ayx, ayy): template coordinate x moves to x + (dx, dy) + [axx axy; ayx ayy] x. */
#include <string.h>

#include "track_private.h"

#define SETTLED       1311  /* 0.02 px: the next step would be a tenth of it */
#define SETTLED_WARP  8000  /* Q16, times half the window: 0.12 px at the window's edge */
#define NOT_SETTLED   13107 /* a last step above 0.2 px means it still wanders */
#define STEP_MAX      (2 << 16)
#define WARP_STEP_MAX (1 << 14)
/* Added to the unit diagonal, Q20. It changes no fixed point (there the right-hand side is zero); it keeps directions
 * that the texture does not determine where they were, and every entry of the inverse below 2^10. */
#define RIDGE      1024
#define RIDGE_WARP 16384
/* The warp is expected to be that of a tube's wall (with a lens) or that at which a fit begins, but for 2 % each (0.02
 * of slope): (2 sigma^2 / 0.02^2) in the unit of the normal matrix, Q6, with noise of sigma 2 in both patches. Texture
 * that determines the warp has a hundred times that; where there is little of it, an arbitrary warp would move the
 * point by tenths of a pixel a frame. */
#define PRIOR        1280000
#define SEARCH_REACH 2 /* steps */
#define SEARCH_STEP  (2 << 16)
#define EXCESS_MOST  (16 << 8)
#define COV_MOST     ((int64_t)1 << 40)
#define LEAST_VAR    512 /* of a template: less is nothing */
#define TURNED_LEAST 8
/* For the normal matrix, which is made once for all that comes: steps are then neither much too long nor too short. */
#define TURNED_HALF  128
#define RELIEF_LEAST 8192 /* of a companion's square: so the ratios below stay below 2^26 */

static int32_t magnitude(int32_t v)
{
    return v < 0 ? -v : v;
}

static int32_t row_bytes(const pf_klt *klt)
{
    return klt->window + 2;
}

static pf_gradients gradients(pf_klt *klt)
{
    return (pf_gradients){klt->t, klt->gx, klt->gy, klt->xgx, klt->xgy, {0, 0}};
}

/* Inverts the symmetric positive matrix m (Q20, diagonal about 1) in place: Gauss-Jordan without pivoting. With the
 * ridges no entry ever exceeds 2^10, so products of two stay below 2^62. */
static void invert6(int64_t m[6][6])
{
    for (int32_t k = 0; k < 6; k++) {
        const int64_t inverse = ((int64_t)1 << 40) / (m[k][k] > 512 ? m[k][k] : 512);
        m[k][k] = (int64_t)1 << 20;
        for (int32_t j = 0; j < 6; j++)
            m[k][j] = (m[k][j] * inverse) >> 20;
        for (int32_t i = 0; i < 6; i++) {
            if (i == k)
                continue;
            const int64_t f = m[i][k];
            m[i][k] = 0;
            for (int32_t j = 0; j < 6; j++)
                m[i][j] -= (f * m[k][j]) >> 20;
        }
    }
}

/* Where the inverse's (i, j) is kept, j <= i. */
static int32_t *entry(pf_anchor *anchor, int32_t i, int32_t j)
{
    return &anchor->inverse[i * (i + 1) / 2 + j];
}

static int32_t inverse_at(const pf_anchor *anchor, int32_t i, int32_t j)
{
    return anchor->inverse[i > j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i];
}

/* Scales the normal matrix to a diagonal in [1/4, 1) and stores its inverse and the scales. */
static void factor(pf_anchor *anchor, int64_t h[6][6])
{
    int64_t m[6][6];
    for (int32_t i = 0; i < 6; i++) {
        anchor->scale[i] = 0;
        while (anchor->scale[i] < 30 && h[i][i] >> (2 * anchor->scale[i]) > 0)
            anchor->scale[i]++;
    }
    for (int32_t i = 0; i < 6; i++)
        for (int32_t j = 0; j < 6; j++)
            m[i][j] = (h[i][j] * (1 << 20)) >> (anchor->scale[i] + anchor->scale[j]);
    for (int32_t i = 0; i < 6; i++)
        m[i][i] += i < 2 ? RIDGE : RIDGE_WARP;
    invert6(m);
    for (int32_t i = 0; i < 6; i++)
        for (int32_t j = 0; j <= i; j++)
            *entry(anchor, i, j) = pf_clamp_i64(m[i][j], 1 << 30);
}

/* Product of the parts of two images that lie in the space of planes, given their sums times 1, x, y: over the
 * symmetric window these three are orthogonal. */
static int64_t plane_part(const pf_klt *klt, const int64_t a[3], const int64_t b[3])
{
    const int64_t w = klt->window, n = w * w;
    const int64_t xx = w * klt->half * (klt->half + 1) * w / 3; /* sum of x^2 over the window */
    return a[0] * b[0] / n + a[1] * b[1] / xx + a[2] * b[2] / xx;
}

/* How much of the companion is in a fit. */
typedef struct pf_relief {
    const int8_t *image; /* NULL: none */
    int64_t ratio_q16;   /* of the template in it */
    int64_t square;      /* of what is off the template too; with what holds it back */
    int64_t j[6];        /* that times the images */
} pf_relief;

/* Takes the template (`st` its product with the companion, `var` and `jt` its sums, off the plane) out of it. What
 * holds it back is half its square over that of how far the light has turned: until it has, nothing comes up, and a fit
 * with the companion in it would only be the less certain. */
static void pare_relief(const pf_anchor *anchor, int32_t turned_q8, int64_t st, int64_t var, const int64_t jt[6],
                        pf_relief *out)
{
    const int64_t turned = turned_q8 > TURNED_LEAST ? turned_q8 : TURNED_LEAST;
    out->ratio_q16 = st * 65536 / (var > LEAST_VAR ? var : LEAST_VAR);
    out->square = anchor->relief_square - ((st * out->ratio_q16) >> 16) +
                  (int64_t)anchor->relief_square * 32768 / (turned * turned) + RELIEF_LEAST;
    for (int32_t i = 0; i < 6; i++)
        out->j[i] = anchor->relief_j[i] - ((jt[i] * out->ratio_q16) >> 16);
}

static int64_t relief_part(const pf_klt *klt, const pf_anchor *anchor, const int64_t sum[3])
{
    const int64_t own[3] = {anchor->relief_sum[0], anchor->relief_sum[1], anchor->relief_sum[2]};
    return plane_part(klt, own, sum);
}

/* The normal matrix once the companion is eliminated as well. */
static void without_relief(const pf_klt *klt, const pf_anchor *anchor, const int8_t *image, pf_normal_sums *s,
                           int64_t var)
{
    pf_relief relief;
    const int64_t st = PF_KERNEL(relief)(image, klt->t, klt->window, klt->groups) - relief_part(klt, anchor, s->t);
    pare_relief(anchor, TURNED_HALF, st, var, s->jt, &relief);
    for (int32_t a = 0; a < 6; a++)
        for (int32_t b = a; b < 6; b++) {
            s->h[a][b] -= (relief.j[a] * (relief.j[b] * 256 / relief.square)) >> 8;
            s->h[b][a] = s->h[a][b];
        }
}

void pf_anchor_take(pf_klt *klt, const pf_image *image, pf_point_q16 at, pf_anchor *anchor, uint8_t *pixels)
{
    const int32_t ix = (at.x + 32768) >> 16, iy = (at.y + 32768) >> 16, w = row_bytes(klt), half = klt->half;
    anchor->x = ix;
    anchor->y = iy;
    anchor->offset = (pf_point_q16){at.x - ix * 65536, at.y - iy * 65536};
    anchor->a[0] = anchor->a[3] = 65536;
    anchor->a[1] = anchor->a[2] = 0;
    anchor->excess_q8 = 256;
    for (int32_t r = 0; r < w; r++)
        memcpy(pixels + r * w, image->data + (size_t)(iy - half - 1 + r) * image->stride + (ix - half - 1), (size_t)w);
    const pf_gradients images = gradients(klt);
    PF_KERNEL(unpack)(pixels, klt->whole, klt->window, klt->groups, &images);
    pf_normal_sums s;
    PF_KERNEL(normal)(&images, klt->window, klt->groups, &s);
    int64_t var_t = s.tt - plane_part(klt, s.t, s.t);
    if (var_t < 1)
        var_t = 1;
    for (int32_t a = 0; a < 6; a++)
        for (int32_t b = 0; b < 3; b++)
            anchor->sum_j[a][b] = (int32_t)s.j[a][b];
    for (int32_t a = 0; a < 6; a++)
        s.jt[a] -= plane_part(klt, s.j[a], s.t);
    int8_t *relief = (int8_t *)(pixels + pf_relief_at((uint32_t)klt->window));
    pf_relief_make(klt, anchor, s.t, relief);
    for (int32_t a = 0; a < 6; a++)
        for (int32_t b = a; b < 6; b++) {
            /* Q8 of the ratio: it times dot_jt stays below 2^62 */
            const int64_t ratio = s.jt[b] * 256 / var_t;
            s.h[a][b] -= plane_part(klt, s.j[a], s.j[b]) + ((s.jt[a] * ratio) >> 8);
            s.h[b][a] = s.h[a][b];
        }
    if (anchor->relief_square > 0)
        without_relief(klt, anchor, relief, &s, var_t);
    for (int32_t a = 0; a < 6; a++)
        if (s.h[a][a] < 0)
            s.h[a][a] = 0;
    for (int32_t a = 2; a < 6; a++)
        s.h[a][a] += PRIOR;
    factor(anchor, s.h);
}

/* Samples `image` on the warped window around `centre` into klt->c. False if it would come within a pixel of the
 * image's edge. */
static bool sample_warped(pf_klt *klt, const pf_image *image, pf_point_q16 centre, const int32_t a[4])
{
    const int64_t half = klt->half, margin = 1 << 16;
    const int64_t rx = (int64_t)(magnitude(a[0]) + magnitude(a[1])) * half + margin,
                  ry = (int64_t)(magnitude(a[2]) + magnitude(a[3])) * half + margin;
    if (centre.x - rx < 0 || centre.y - ry < 0 || centre.x + rx >= ((int64_t)image->width - 1) << 16 ||
        centre.y + ry >= ((int64_t)image->height - 1) << 16)
        return false;
    const pf_warp warp = {image->data, image->stride,           image->width, image->height, centre.x,
                          centre.y,    {a[0], a[1], a[2], a[3]}};
    PF_KERNEL(warp)(&warp, klt->whole, klt->window, klt->groups, klt->c);
    return true;
}

/* Sums of a patch with the steepest-descent images, all less their best plane. */
typedef struct pf_rhs {
    int64_t b[6], gain_q14;
    int64_t cov, var; /* with the template, and of the patch */
    int64_t relief;   /* what of var is the companion's */
} pf_rhs;

/* What of the template changes with the smoothing. */
typedef struct pf_reference {
    int64_t sum[3], var, b[6];
    pf_relief relief;
    bool has_warp; /* the wall's: with a lens */
    int32_t warp[4];
} pf_reference;

/* Sums of the patch c and their parts off the plane. */
static void off_plane(const pf_klt *klt, const pf_anchor *anchor, const pf_affine_sums *s, pf_rhs *out)
{
    out->var = s->cc - plane_part(klt, s->c, s->c);
    for (int32_t i = 0; i < 6; i++) {
        const int64_t j[3] = {anchor->sum_j[i][0], anchor->sum_j[i][1], anchor->sum_j[i][2]};
        out->b[i] = s->b[i] - plane_part(klt, j, s->c);
    }
}

/* A half f (1 - f) at a coordinate, Q15. */
static int32_t smoothing_at(int64_t v)
{
    const int32_t f = (int32_t)(v & 0xFFFF) >> 1;
    return (f * (32768 - f)) >> 16;
}

/* Unpacks the template, smoothed as sampling will smooth the image: by the mean over the window's centre and corners,
 * for where the warp turns or scales, the fraction differs from pixel to pixel. Unsmoothed, fine texture would pull by
 * a hundredth of a pixel. With a lens, bent as the wall will be seen to bend around `centre`. */
static void take_reference(pf_klt *klt, const pf_anchor *anchor, const uint8_t *pixels, pf_point_q16 centre,
                           pf_reference *out)
{
    pf_gradients images = gradients(klt);
    const int32_t *a = anchor->a;
    int32_t x = 0, y = 0;
    for (int32_t v = -1; v <= 1; v++)
        for (int32_t u = -1; u <= 1; u++) {
            const int32_t reach = klt->half / 2 + 1;
            x += smoothing_at((int64_t)centre.x + (int64_t)reach * (u * (int64_t)a[0] + v * (int64_t)a[1]));
            y += smoothing_at((int64_t)centre.y + (int64_t)reach * (u * (int64_t)a[2] + v * (int64_t)a[3]));
        }
    images.smooth[0] = (int16_t)(x / 9);
    images.smooth[1] = (int16_t)(y / 9);
    PF_KERNEL(unpack)(pixels, klt->whole, klt->window, klt->groups, &images);
    pf_bow bow;
    out->has_warp = klt->lens.ray && pf_bow_between(&klt->lens, klt->half, anchor->x, anchor->y, centre, &bow);
    if (out->has_warp) {
        PF_KERNEL(bend)(bow.c, klt->window, klt->groups, &images);
        memcpy(out->warp, bow.warp, sizeof bow.warp);
    }
    pf_affine_sums s;
    pf_rhs rhs;
    PF_KERNEL(affine)(klt->t, &images, klt->window, klt->groups, &s);
    off_plane(klt, anchor, &s, &rhs);
    out->var = rhs.var < 1 ? 1 : rhs.var;
    for (int32_t i = 0; i < 6; i++)
        out->b[i] = rhs.b[i];
    for (int32_t i = 0; i < 3; i++)
        out->sum[i] = s.c[i];
    out->relief.image = NULL;
    if (anchor->relief_square == 0)
        return;
    out->relief.image = (const int8_t *)(pixels + pf_relief_at((uint32_t)klt->window));
    const int64_t st = PF_KERNEL(relief)(out->relief.image, klt->t, klt->window, klt->groups);
    pare_relief(anchor, out->has_warp ? bow.turned_q8 : 0, st - relief_part(klt, anchor, s.c), out->var, out->b,
                &out->relief);
}

static void right_hand_side(pf_klt *klt, const pf_anchor *anchor, const pf_reference *t, pf_rhs *out)
{
    const pf_gradients g = gradients(klt);
    pf_affine_sums s;
    PF_KERNEL(affine)(klt->c, &g, klt->window, klt->groups, &s);
    off_plane(klt, anchor, &s, out);
    out->cov = s.ct - plane_part(klt, t->sum, s.c);
    out->gain_q14 = out->cov * GAIN_ONE / t->var;
    const int64_t gain_q16 = out->cov * 65536 / t->var;
    for (int32_t i = 0; i < 6; i++)
        out->b[i] -= (t->b[i] * gain_q16) >> 16;
    out->relief = 0;
    if (!t->relief.image)
        return;
    const int64_t of = PF_KERNEL(relief)(t->relief.image, klt->c, klt->window, klt->groups) -
                       relief_part(klt, anchor, s.c) - ((out->cov * t->relief.ratio_q16) >> 16);
    const int64_t share_q16 = of * 65536 / t->relief.square;
    for (int32_t i = 0; i < 6; i++)
        out->b[i] -= (t->relief.j[i] * share_q16) >> 16;
    out->relief = (of * share_q16) >> 16;
}

/* The step d: Q16 pixels, Q16 warp. */
static void solve(const pf_anchor *anchor, const pf_rhs *rhs, int32_t d[6])
{
    int64_t scaled[6];
    for (int32_t i = 0; i < 6; i++)
        scaled[i] = (rhs->b[i] * 4096) >> anchor->scale[i];
    for (int32_t i = 0; i < 6; i++) {
        int64_t v = 0;
        for (int32_t j = 0; j < 6; j++)
            v += (int64_t)inverse_at(anchor, i, j) * scaled[j];
        /* v is Q32 in Q7 over Q6: to Q16 pixels */
        v >>= 17 + anchor->scale[i];
        d[i] = pf_clamp_i64((int64_t)pf_clamp_i64(v, 1 << 26) * GAIN_ONE / rhs->gain_q14,
                            i < 2 ? STEP_MAX : WARP_STEP_MAX);
    }
}

/* a <- a (1 - D), centre <- centre - a d. */
static void compose(pf_anchor *anchor, const int32_t d[6], pf_point_q16 *centre)
{
    int32_t *a = anchor->a;
    const int64_t a0 = a[0], a1 = a[1], a2 = a[2], a3 = a[3];
    a[0] -= (int32_t)((a0 * d[2] + a1 * d[4]) >> 16);
    a[1] -= (int32_t)((a0 * d[3] + a1 * d[5]) >> 16);
    a[2] -= (int32_t)((a2 * d[2] + a3 * d[4]) >> 16);
    a[3] -= (int32_t)((a2 * d[3] + a3 * d[5]) >> 16);
    centre->x -= (int32_t)(((int64_t)a[0] * d[0] + (int64_t)a[1] * d[1]) >> 16);
    centre->y -= (int32_t)(((int64_t)a[2] * d[0] + (int64_t)a[3] * d[1]) >> 16);
}

/* The track's point relative to the template's centre, in the current frame. */
static pf_point_q16 warped_offset(const pf_anchor *anchor)
{
    const int64_t x = anchor->offset.x, y = anchor->offset.y;
    return (pf_point_q16){(int32_t)((anchor->a[0] * x + anchor->a[1] * y) >> 16),
                          (int32_t)((anchor->a[2] * x + anchor->a[3] * y) >> 16)};
}

/* How much more is left than the noise of both patches would leave, Q8, at least 1: relief in another light, an edge in
 * front of something. */
static int32_t excess(const pf_klt *klt, const pf_rhs *rhs)
{
    const int64_t left = rhs->var - rhs->relief - rhs->cov * rhs->gain_q14 / GAIN_ONE;
    const int64_t gain2 = rhs->gain_q14 * rhs->gain_q14 / GAIN_ONE;
    const int64_t noise = (int64_t)klt->window * klt->window * klt->noise_var_q8 * (GAIN_ONE + gain2) / GAIN_ONE;
    const int64_t ratio = noise > 0 ? left * 256 / noise : EXCESS_MOST;
    return ratio < 256 ? 256 : ratio > EXCESS_MOST ? EXCESS_MOST : (int32_t)ratio;
}

/* How far warp a is from g, in g's coordinates: gone[2..5]. Unchanged where g has no inverse of use. */
static void warp_between(const int32_t g[4], const int32_t a[4], int32_t gone[6])
{
    const int64_t det = ((int64_t)g[0] * g[3] - (int64_t)g[1] * g[2]) >> 16;
    if (det < 4096)
        return;
    for (int32_t k = 0; k < 2; k++) {
        gone[2 + k] = pf_clamp_i64(((int64_t)g[3] * a[k] - (int64_t)g[1] * a[2 + k]) / det - (k ? 0 : 65536), 65536);
        gone[4 + k] = pf_clamp_i64(((int64_t)g[0] * a[2 + k] - (int64_t)g[2] * a[k]) / det - (k ? 65536 : 0), 65536);
    }
}

pf_fit pf_anchor_fit(pf_klt *klt, const pf_image *image, pf_anchor *anchor, const uint8_t *pixels, pf_point_q16 *at)
{
    pf_fit fit = {PF_TRACK_OK, 0, GAIN_ONE};
    const pf_point_q16 before = warped_offset(anchor);
    pf_point_q16 centre = {at->x - before.x, at->y - before.y};
    pf_rhs rhs = {{0}, GAIN_ONE, 0, 0, 0};
    pf_reference reference;
    take_reference(klt, anchor, pixels, centre, &reference);
    int32_t moved = 0, gone[6] = {0}; /* from the wall's warp; without a lens from that at the beginning */
    if (reference.has_warp)
        warp_between(reference.warp, anchor->a, gone);
    for (int32_t i = 0; i < klt->iterations; i++) {
        if (!sample_warped(klt, image, centre, anchor->a)) {
            fit.reason = PF_TRACK_LEFT;
            return fit;
        }
        right_hand_side(klt, anchor, &reference, &rhs);
        if (rhs.gain_q14 < GAIN_MIN || rhs.gain_q14 > GAIN_MAX) {
            fit.reason = PF_TRACK_DRIFT;
            return fit;
        }
        int32_t d[6], warp = 0;
        for (int32_t k = 2; k < 6; k++)
            rhs.b[k] += (((int64_t)PRIOR * gone[k]) >> 15) * rhs.gain_q14 / GAIN_ONE;
        solve(anchor, &rhs, d);
        compose(anchor, d, &centre);
        for (int32_t k = 2; k < 6; k++)
            gone[k] -= d[k];
        for (int32_t k = 2; k < 6; k++)
            warp = magnitude(d[k]) > warp ? magnitude(d[k]) : warp;
        for (int32_t k = 0; k < 4; k++)
            if (magnitude(anchor->a[k]) > WARP_MOST)
                fit.reason = PF_TRACK_DRIFT;
        if (fit.reason != PF_TRACK_OK)
            return fit;
        moved = magnitude(d[0]) > magnitude(d[1]) ? magnitude(d[0]) : magnitude(d[1]);
        if (moved < SETTLED && warp * klt->half < SETTLED_WARP)
            break;
    }
    const pf_point_q16 after = warped_offset(anchor);
    *at = (pf_point_q16){centre.x + after.x, centre.y + after.y};
    fit.zncc_q15 = pf_likeness(klt, rhs.cov, reference.var, rhs.var - rhs.relief, (int64_t)klt->window * klt->window);
    fit.gain_q14 = (int32_t)rhs.gain_q14;
    anchor->excess_q8 = excess(klt, &rhs);
    if (moved > NOT_SETTLED)
        fit.reason = PF_TRACK_DIVERGED;
    return fit;
}

pf_point_q16 pf_anchor_search(pf_klt *klt, const pf_image *image, const pf_anchor *anchor, const uint8_t *pixels,
                              pf_point_q16 at)
{
    const pf_point_q16 offset = warped_offset(anchor), centre = {at.x - offset.x, at.y - offset.y};
    pf_point_q16 best = at;
    int32_t most = -32768;
    pf_reference reference;
    take_reference(klt, anchor, pixels, centre, &reference);
    for (int32_t y = -SEARCH_REACH; y <= SEARCH_REACH; y++)
        for (int32_t x = -SEARCH_REACH; x <= SEARCH_REACH; x++) {
            const pf_point_q16 moved = {centre.x + x * SEARCH_STEP, centre.y + y * SEARCH_STEP};
            pf_rhs rhs;
            if (!sample_warped(klt, image, moved, anchor->a))
                continue;
            right_hand_side(klt, anchor, &reference, &rhs);
            const int32_t like = pf_zncc(rhs.cov, reference.var, rhs.var);
            if (like > most) {
                most = like;
                best = (pf_point_q16){at.x + x * SEARCH_STEP, at.y + y * SEARCH_STEP};
            }
        }
    return best;
}

/* Entry (i, j) of the template's covariance times `factor_q8` (below 2^15), Q20 px^2, to nearest. */
static int64_t template_covariance(const pf_anchor *anchor, int32_t i, int32_t j, uint32_t noise_q8, int64_t factor_q8)
{
    int64_t m = inverse_at(anchor, i, j) * ((int64_t)noise_q8 * noise_q8);
    int32_t shift = 18 + anchor->scale[i] + anchor->scale[j];
    while (m >= (int64_t)1 << 46 || m <= -((int64_t)1 << 46)) { /* 2^58 at most; the factor needs its room */
        m /= 2;
        shift--;
    }
    m = (m * factor_q8 + ((int64_t)1 << (shift - 1))) >> shift;
    return m > COV_MOST ? COV_MOST : m < -COV_MOST ? -COV_MOST : m;
}

/* r C s for rows r, s of a warp and C (xx, xy, yy), to nearest. */
static int64_t turned(const int32_t r[2], const int32_t s[2], const int64_t cov[3])
{
    const int64_t x = (cov[0] * s[0] + cov[1] * s[1] + 32768) >> 16, y = (cov[1] * s[0] + cov[2] * s[1] + 32768) >> 16;
    return (r[0] * x + r[1] * y + 32768) >> 16;
}

/* What is carried and what the fit adds at `factor_q8`, in the picture's axes: xx, xy, yy. */
static void whole_covariance(const pf_anchor *anchor, uint32_t noise_q8, int64_t factor_q8, int64_t out[3])
{
    const int32_t *x = anchor->a, *y = anchor->a + 2;
    const int64_t cov[3] = {anchor->carried[0] + template_covariance(anchor, 0, 0, noise_q8, factor_q8),
                            anchor->carried[1] + template_covariance(anchor, 1, 0, noise_q8, factor_q8),
                            anchor->carried[2] + template_covariance(anchor, 1, 1, noise_q8, factor_q8)};
    out[0] = turned(x, x, cov);
    out[1] = turned(x, y, cov);
    out[2] = turned(y, y, cov);
}

void pf_anchor_carry(const pf_anchor *anchor, uint32_t noise_q8, int64_t carried[3])
{
    whole_covariance(anchor, noise_q8, anchor->excess_q8, carried);
    for (int32_t i = 0; i < 3; i++)
        carried[i] = carried[i] > COV_MOST ? COV_MOST : carried[i] < -COV_MOST ? -COV_MOST : carried[i];
}

void pf_anchor_covariance(const pf_anchor *anchor, uint32_t noise_q8, int32_t gain_q14, pf_track *track)
{
    const int64_t gain2 = ((int64_t)gain_q14 * gain_q14) >> 14; /* Q14 */
    int64_t cov[3];
    whole_covariance(anchor, noise_q8, ((256 + ((int64_t)256 << 14) / gain2) * anchor->excess_q8) >> 8, cov);
    const int64_t xx = cov[0] + PF_TRACK_COV_FLOOR_Q20, xy = cov[1], yy = cov[2] + PF_TRACK_COV_FLOOR_Q20;
    track->cov_xx_q20 = xx > UINT32_MAX ? UINT32_MAX : (uint32_t)xx;
    track->cov_yy_q20 = yy > UINT32_MAX ? UINT32_MAX : (uint32_t)yy;
    /* rounding and saturation must not make it indefinite */
    const uint32_t most = pf_isqrt64((uint64_t)track->cov_xx_q20 * track->cov_yy_q20) - 1u;
    track->cov_xy_q20 = pf_clamp_i64(xy, most > INT32_MAX ? INT32_MAX : (int32_t)most);
}
