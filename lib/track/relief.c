/* What comes up under a template as its light changes. The lamp goes with the camera: the light on a wall point comes
 * to stand square on it as its polar angle grows, and the shading of slopes along the pipe, which goes with the
 * cotangent, fades: a pit is a dark and a bright crescent ahead, and a dark spot beside the camera. Against its first
 * sight that spot looks like a shift, of 1.5 px on plastic and clay. Slopes are a derivative along the radius of the
 * picture, so what they leave behind is an integral along it: the template's companion, with which a fit does without
 * gain, bias, its slopes and this. A shift of a single spot keeps two thirds of its weight.
 *
 * The integral is the mean of both ways along the radius, with forgetting over 9 px: so it is nowhere far from ground,
 * and its constant does not matter. */
#include <string.h>

#include "track_private.h"

#define FORGET 27 /* parts of 256 a pixel */
#define MOST   127

/* A walk over the window along its major axis, one of the two, from the side of the centre of the picture or towards
 * it. */
typedef struct pf_walk {
    int32_t along, across; /* strides of the two axes */
    int32_t length;        /* of a step, Q8 px: 1 to the root of 2 */
    int32_t lean;          /* by how much a step goes along the minor axis, Q8, |.| <= 1 */
} pf_walk;

static pf_walk walk_along(int32_t dx, int32_t dy)
{
    const int32_t ax = dx < 0 ? -dx : dx, ay = dy < 0 ? -dy : dy;
    const bool level = ax >= ay;
    const int32_t major = level ? dx : dy, minor = level ? dy : dx;
    pf_walk w = {level ? 1 : PATCH_ROW, level ? PATCH_ROW : 1, 256, 0};
    if (major == 0)
        return w;
    w.lean = minor * 256 / major;
    w.length = (int32_t)pf_isqrt64((uint64_t)(65536 + w.lean * w.lean));
    return w;
}

/* Adds to `out` the sums of `from` along the walk, upwards (sign 1) or downwards (-1, and taken off). */
static void sum_along(const pf_walk *walk, int32_t window, int32_t sign, const int16_t *from, int32_t *out)
{
    const int32_t keep = 256 - ((FORGET * walk->length) >> 8), lean = sign * walk->lean;
    const int32_t side = lean > 0 ? -1 : 1, part = lean > 0 ? lean : -lean;
    int32_t before[WINDOW_MAX] = {0}, here[WINDOW_MAX];
    for (int32_t n = 0; n < window; n++) {
        const int32_t at = (sign > 0 ? n : window - 1 - n) * walk->along;
        for (int32_t j = 0; j < window; j++) {
            const int32_t beside = j + side >= 0 && j + side < window ? before[j + side] : before[j];
            const int32_t came = ((256 - part) * before[j] + part * beside) >> 8;
            here[j] = (from[at + j * walk->across] * walk->length + keep * came) >> 8;
            out[at + j * walk->across] += sign * here[j];
        }
        for (int32_t j = 0; j < window; j++)
            before[j] = here[j];
    }
}

/* The template less its best plane. */
static void flatten(const pf_klt *klt, const int64_t plane[3], int16_t *out)
{
    const int32_t w = klt->window, half = klt->half;
    const int64_t xx = (int64_t)w * half * (half + 1) * w / 3;
    const int32_t mean = (int32_t)(plane[0] / (w * w));
    const int32_t slope_x = (int32_t)(plane[1] * 256 / xx), slope_y = (int32_t)(plane[2] * 256 / xx);
    for (int32_t r = 0; r < w; r++)
        for (int32_t i = 0; i < w; i++)
            out[r * PATCH_ROW + i] =
                (int16_t)(klt->t[r * PATCH_ROW + i] - mean - ((slope_x * (i - half) + slope_y * (r - half)) >> 8));
}

/* Scaled to MOST, whatever the contrast. */
static void store(const pf_klt *klt, const int32_t *sum, int8_t *relief)
{
    int32_t most = 1;
    for (int32_t r = 0; r < klt->window; r++)
        for (int32_t i = 0; i < klt->window; i++) {
            const int32_t v = sum[r * PATCH_ROW + i], size = v < 0 ? -v : v;
            most = size > most ? size : most;
        }
    for (int32_t r = 0; r < klt->window; r++)
        for (int32_t i = 0; i < 8 * klt->groups; i++)
            relief[r * 8 * klt->groups + i] = (int8_t)(i < klt->window ? sum[r * PATCH_ROW + i] * MOST / most : 0);
}

static void measure(const pf_klt *klt, pf_anchor *anchor, const int8_t *relief)
{
    const int32_t w = klt->window, half = klt->half, columns = 8 * klt->groups;
    const int64_t n = w * w, xx = (int64_t)w * half * (half + 1) * w / 3;
    int64_t sum[3] = {0}, square = 0, j[6] = {0};
    for (int32_t r = 0; r < w; r++) {
        const int32_t y = r - half;
        int32_t s = 0, sx = 0, ss = 0, b[4] = {0};
        for (int32_t i = 0; i < w; i++) {
            const int32_t v = relief[r * columns + i], k = r * PATCH_ROW + i;
            s += v, sx += v * (i - half), ss += v * v;
            b[0] += v * klt->gx[k], b[1] += v * klt->gy[k], b[2] += v * klt->xgx[k], b[3] += v * klt->xgy[k];
        }
        sum[0] += s, sum[1] += sx, sum[2] += s * y, square += ss;
        j[0] += b[0], j[1] += b[1], j[2] += b[2], j[3] += b[0] * y, j[4] += b[3], j[5] += b[1] * y;
    }
    for (int32_t k = 0; k < 6; k++) {
        const int32_t *p = anchor->sum_j[k];
        anchor->relief_j[k] = (int32_t)(j[k] - (p[0] * sum[0] / n + p[1] * sum[1] / xx + p[2] * sum[2] / xx));
    }
    for (int32_t k = 0; k < 3; k++)
        anchor->relief_sum[k] = (int32_t)sum[k];
    square -= sum[0] * sum[0] / n + sum[1] * sum[1] / xx + sum[2] * sum[2] / xx;
    anchor->relief_square = square > 0 ? (int32_t)square : 0;
}

void pf_relief_make(pf_klt *klt, pf_anchor *anchor, const int64_t plane[3], int8_t *relief)
{
    anchor->relief_square = 0;
    if (!klt->lens.ray || !klt->radius_q16)
        return;
    const pf_walk walk = walk_along(anchor->x - (klt->circle.x >> 16), anchor->y - (klt->circle.y >> 16));
    flatten(klt, plane, klt->c);
    memset(klt->sum, 0, sizeof klt->sum);
    sum_along(&walk, klt->window, 1, klt->c, klt->sum);
    sum_along(&walk, klt->window, -1, klt->c, klt->sum);
    store(klt, klt->sum, relief);
    measure(klt, anchor, relief);
}
