/* Fitting the table of rays to the exact back-projection, in integers. */
#include "rays.h"

#define CELL_ERROR_Q30 8590 /* 8e-6 */

static bool lay_out(const pf_camera_fixed *fixed, uint32_t step, pf_camera_rays *rays)
{
    if (step < 4 || step > 64 || (step & (step - 1)) != 0)
        return false;
    *rays = (pf_camera_rays){.fixed = fixed,
                             .step_bits = bit_length(step) - 1,
                             .columns = fixed->width / step + 1, /* the coordinate width - 0.5 is inside */
                             .rows = fixed->height / step + 1};
    rays->stats.cells = rays->columns * rays->rows;
    return true;
}

size_t pf_camera_rays_workspace_size(const pf_camera_fixed *fixed, uint32_t step)
{
    pf_camera_rays rays;
    return lay_out(fixed, step, &rays) ? 64 + sizeof rays + rays.stats.cells * sizeof(ray_cell) : 0;
}

typedef struct square {
    int64_t x, y, half; /* centre and half side, Q16.16 pixels */
} square;

/* The ray at (s, t), Q15; false outside the domain. */
static bool ray_at(const pf_camera_fixed *fixed, const square *q, int32_t s, int32_t t, pf_ray_q30 *ray)
{
    const pf_point_q16 pixel = {(int32_t)(q->x + q->half * s / 32768), (int32_t)(q->y + q->half * t / 32768)};
    return pf_camera_fixed_unproject(fixed, pixel, ray, NULL) == PF_OK;
}

static int32_t coordinate(const pf_ray_q30 *ray, int i)
{
    return i == 0 ? ray->x : i == 1 ? ray->y : ray->z;
}

/* The quadratic a[0] + a[1] s + a[2] t + a[3] s^2 + a[4] s t + a[5] t^2, Q30, through the values at the nine Chebyshev
 * nodes so far as its six terms reach: the rest is dropped as Chebyshev polynomials, not as powers, which spreads the
 * error evenly. */
static void fit(int32_t v[3][3], int64_t a[6])
{
    const int64_t third = 357913941, root_third = 619925131; /* 1/3, 1/sqrt 3, Q30 */
    int64_t mean[3], bend_t[3], slope_t[3];                  /* along t, for each s */
    for (int i = 0; i < 3; i++) {
        mean[i] = round_shift(((int64_t)v[i][0] + v[i][1] + v[i][2]) * third, 30);
        slope_t[i] = round_shift(((int64_t)v[i][2] - v[i][0]) * root_third, 30);
        bend_t[i] = round_shift(((int64_t)v[i][2] - 2 * (int64_t)v[i][1] + v[i][0]) * third, 30);
    }
    int64_t bend_s = round_shift((mean[2] - 2 * mean[1] + mean[0]) * third, 30);
    int64_t bend = round_shift((bend_t[0] + bend_t[1] + bend_t[2]) * third, 30);
    a[0] = round_shift((mean[0] + mean[1] + mean[2]) * third, 30) - bend_s - bend;
    a[1] = round_shift((mean[2] - mean[0]) * root_third, 30);
    a[2] = round_shift((slope_t[0] + slope_t[1] + slope_t[2]) * third, 30);
    a[3] = 2 * bend_s;
    a[4] = round_shift((slope_t[2] - slope_t[0]) * root_third, 30);
    a[5] = 2 * bend;
}

/* Packs the three quadratics with the finest common shift at which the sums stay within 31 bits; false if there is
 * none. A factor is in Q30 times 2^(shift - 15), of a square 2^(shift - 14). */
static bool pack(int64_t a[3][6], ray_cell *cell)
{
    for (int32_t shift = 15; shift >= 0; shift--) {
        uint64_t largest = 0;
        for (int i = 0; i < 3; i++) {
            uint64_t sum = 0;
            cell->origin[i] = (int32_t)(a[i][0] + round_shift(a[i][1] + a[i][2], 16)); /* s, t: half a unit low */
            for (int k = 1; k < 6; k++) {
                int64_t factor = round_shift(a[i][k] * ((int64_t)1 << shift), k < 3 ? 15 : 14);
                sum += magnitude(factor);
                cell->factor[(k - 1) / 2][i][(k - 1) % 2] = (int16_t)factor;
            }
            largest = sum > largest ? sum : largest;
        }
        cell->shift = shift;
        if (largest < 32768)
            return true;
    }
    return false;
}

/* Largest error of the packed cell on a grid of 5 x 5 with its corners, Q30. */
static int64_t cell_error(const pf_camera_fixed *fixed, const square *q, const ray_cell *cell)
{
    int64_t worst = 0;
    for (int32_t i = -2; i <= 2; i++)
        for (int32_t j = -2; j <= 2; j++) {
            int32_t s = i * 16383, t = j * 16383;
            pf_ray_q30 exact, ray = pf_fixed_cell_ray(cell, s, t);
            if (!ray_at(fixed, q, s, t, &exact))
                return INT64_MAX;
            int64_t error = 0;
            for (int k = 0; k < 3; k++) {
                int64_t d = (int64_t)coordinate(&ray, k) - coordinate(&exact, k);
                error += d * d;
            }
            worst = error > worst ? error : worst;
        }
    return worst;
}

/* Whether the model is defined all over the cell, and a quarter of a cell beyond its corners so that no bulge of the
 * domain's rim goes unseen; then v gets the rays at the nine nodes. */
static bool sample_cell(const pf_camera_fixed *fixed, const square *q, int32_t v[3][3][3])
{
    const int32_t node = 28378; /* sqrt(3) / 2 */
    pf_ray_q30 ray;
    for (int32_t i = -1; i <= 1; i += 2)
        for (int32_t j = -1; j <= 1; j += 2)
            if (!ray_at(fixed, q, i * 49152, j * 49152, &ray))
                return false;
    for (int32_t i = 0; i < 3; i++)
        for (int32_t j = 0; j < 3; j++) {
            if (!ray_at(fixed, q, (i - 1) * node, (j - 1) * node, &ray))
                return false;
            for (int k = 0; k < 3; k++)
                v[k][i][j] = coordinate(&ray, k);
        }
    return true;
}

/* The quadratics of a cell from the rays at its nodes; false where they are not good enough. */
static bool fit_cell(const pf_camera_fixed *fixed, const square *q, int32_t v[3][3][3], ray_cell *cell)
{
    int64_t a[3][6];
    for (int k = 0; k < 3; k++)
        fit(v[k], a[k]);
    return pack(a, cell) && cell_error(fixed, q, cell) <= (int64_t)CELL_ERROR_Q30 * CELL_ERROR_Q30;
}

static ray_cell make_cell(const pf_camera_fixed *fixed, const square *q)
{
    const ray_cell exact = {{0, 0, 0}, EXACT, {{{0, 0}}}};
    ray_cell cell = exact;
    int32_t v[3][3][3];
    return sample_cell(fixed, q, v) && fit_cell(fixed, q, v, &cell) ? cell : exact;
}

uint32_t pf_camera_rays_step(const pf_camera_fixed *fixed)
{
    enum { TRIALS = 12, SHARE = 16 };
    bool any = false;
    for (uint32_t step = 64; step > 4; step /= 2) {
        uint32_t tried = 0, failed = 0;
        for (uint32_t i = 0; i < TRIALS * TRIALS; i++) {
            square q = {(int64_t)fixed->width * 65536 * (2 * (i % TRIALS) + 1) / (2 * TRIALS),
                        (int64_t)fixed->height * 65536 * (2 * (i / TRIALS) + 1) / (2 * TRIALS), (int64_t)step * 32768};
            int32_t v[3][3][3];
            ray_cell cell;
            if (sample_cell(fixed, &q, v)) {
                tried++;
                failed += !fit_cell(fixed, &q, v, &cell);
            }
        }
        any = any || tried > 0;
        if (tried > 0 && failed * SHARE <= tried)
            return step;
    }
    return any ? 4 : 64;
}

static int64_t clamped(int64_t v, int64_t low, int64_t high)
{
    return v < low ? low : v > high ? high : v;
}

/* 0: all of the cell is in the image; RIM: some of it; OUTSIDE: nothing. Image and circle are convex: corners decide
 * what is inside, and the point nearest to the circle's centre what is outside. */
static int32_t place(const pf_camera_fixed *fixed, const square *q)
{
    bool all = true;
    for (int i = -1; i <= 1; i += 2)
        for (int j = -1; j <= 1; j += 2) {
            pf_point_q16 corner = {(int32_t)(q->x + i * q->half), (int32_t)(q->y + j * q->half)};
            all = all && pf_camera_fixed_in_image(fixed, corner);
        }
    if (all)
        return 0;
    int64_t right = (int64_t)fixed->width * 65536 - 32768, bottom = (int64_t)fixed->height * 65536 - 32768;
    int64_t x_max = q->x + q->half < right ? q->x + q->half : right;
    int64_t y_max = q->y + q->half < bottom ? q->y + q->half : bottom;
    pf_point_q16 nearest = {(int32_t)clamped(fixed->circle[0], q->x - q->half, x_max),
                            (int32_t)clamped(fixed->circle[1], q->y - q->half, y_max)};
    return pf_camera_fixed_in_image(fixed, nearest) ? RIM : OUTSIDE;
}

pf_status pf_camera_rays_init(const pf_camera_rays **rays, const pf_camera_fixed *fixed, uint32_t step, void *workspace,
                              size_t size)
{
    pf_camera_rays plan;
    if (!lay_out(fixed, step, &plan))
        return PF_ERR_ARGUMENT;
    if (!workspace || size < pf_camera_rays_workspace_size(fixed, step))
        return PF_ERR_SPACE;
    pf_camera_rays *out = workspace;
    ray_cell *cell = (ray_cell *)(((uintptr_t)(out + 1) + 63) & ~(uintptr_t)63);
    plan.cells = cell;
    const int64_t half = (int64_t)step * 32768;
    for (uint32_t row = 0; row < plan.rows; row++)
        for (uint32_t column = 0; column < plan.columns; column++, cell++) {
            square q = {((int64_t)column * 2 + 1) * half - 32768, ((int64_t)row * 2 + 1) * half - 32768, half};
            int32_t where = place(fixed, &q);
            *cell = where == OUTSIDE ? (ray_cell){{0, 0, 0}, OUTSIDE, {{{0, 0}}}} : make_cell(fixed, &q);
            cell->shift |= where;
            plan.stats.outside += (cell->shift & OUTSIDE) != 0;
            plan.stats.exact += (cell->shift & EXACT) != 0;
            plan.stats.rim += (cell->shift & (RIM | EXACT)) == RIM;
        }
    *out = plan;
    *rays = out;
    return PF_OK;
}

pf_camera_rays_stats pf_camera_rays_count(const pf_camera_rays *rays)
{
    return rays->stats;
}
