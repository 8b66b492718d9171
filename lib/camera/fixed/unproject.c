/* From pixels to rays: back through the sensor, then the exact inverse of the table. */
#include "fixed.h"

/* theta of r (plane, with 8 more bits), r <= r(theta_max): bisection for the interval, safeguarded Newton in it. The
 * residual carries 16 bits more than the table, so the answer is as fine as the table's unit over r'. */
static uint64_t solve_radius(const pf_camera_fixed *fixed, uint64_t r_q8)
{
    const knot *knots = fixed->knots;
    uint32_t stride = fixed->channels, low = 0, high = fixed->intervals;
    int64_t r = (int64_t)r_q8;
    while (high - low > 1) {
        uint32_t middle = (low + high) / 2;
        if ((int64_t)knots[middle * stride].value * 256 <= r)
            low = middle;
        else
            high = middle;
    }
    const knot *a = knots + low * stride, *b = a + stride;
    int64_t rise = (int64_t)b->value - a->value, target = (r - (int64_t)a->value * 256) * 256;
    int64_t c3 = (int64_t)a->slope + b->slope - 2 * rise, c2 = rise - a->slope - c3;
    int64_t from = 0, to = ONE_Q31, t = rise > 0 ? target * 32768 / rise : 0;
    for (int i = 0; i < 40; i++) {
        t = t < from ? from : t > to ? to : t;
        int64_t inner = a->slope + round_shift((c2 + round_shift(c3 * t, 31)) * t, 31);
        int64_t rest = round_shift(inner * t, 15) - target;
        int64_t slope = a->slope + round_shift((2 * c2 + round_shift(3 * c3 * t, 31)) * t, 31);
        if (rest > 0)
            to = t;
        else
            from = t;
        int64_t next = slope > 0 ? t - rest * 32768 / slope : from + (to - from) / 2;
        if (next <= from || next >= to) /* Newton that ends at a bracket's end has arrived */
            next = magnitude(next - t) <= 2 ? t : from + (to - from) / 2;
        if (magnitude(next - t) <= 2) {
            t = next;
            break;
        }
        t = next;
    }
    uint64_t whole = (uint64_t)low * fixed->step, part = ((uint64_t)t * fixed->step) >> 31;
    return (uint64_t)round_shift((int64_t)(whole + part), fixed->step_shift - 31);
}

/* Z = theta e^(i phi), Q30, with what follows from it. */
typedef struct guess {
    int64_t x, y;
    uint64_t theta; /* Q32 */
    polar across;
} guess;

static guess at_angle(const pf_camera_fixed *fixed, int64_t x, int64_t y)
{
    /* Newton may look a little past theta_max, where the map goes on straight; at most one interval. */
    uint64_t limit = fixed->theta_max + (fixed->theta_max / fixed->intervals);
    guess g = {x, y, 0, pf_fixed_polar(x, y)};
    g.theta = polar_length(g.across, 2);
    if (g.theta > limit) {
        g.theta = limit;
        g.x = round_shift((int64_t)(limit / 4) * g.across.c, 30);
        g.y = round_shift((int64_t)(limit / 4) * g.across.s, 30);
    }
    return g;
}

static guess at_polar(uint64_t theta, polar across)
{
    int64_t length = (int64_t)(theta / 4);
    return (guess){round_shift(length * across.c, 30), round_shift(length * across.s, 30), theta, across};
}

typedef struct residual {
    int64_t x, y;
    uint64_t size;
} residual;

static residual miss(const plane_point *w, int64_t x, int64_t y)
{
    residual e = {x - w->x, y - w->y, 0};
    e.size = magnitude(e.x) + magnitude(e.y);
    return e;
}

static int64_t scaled(int64_t v, int32_t shift) /* v 2^-shift */
{
    return shift >= 0 ? round_shift(v, (uint32_t)shift) : v * ((int64_t)1 << -shift);
}

/* One Newton step from g: solves the 2 x 2 system with mantissas of 20 bits, so each step gains up to 20 bits.
 * False where the Jacobian has no inverse. */
static bool newton_step(const pf_camera_fixed *fixed, const guess *g, const plane_point *w, residual e, int64_t step[2])
{
    uint64_t largest = magnitude(w->theta_x) | magnitude(w->theta_y) | magnitude(w->phi_x) | magnitude(w->phi_y);
    int32_t sj = (int32_t)bit_length(largest) - 20, se = (int32_t)bit_length(magnitude(e.x) | magnitude(e.y)) - 20;
    int64_t ax = scaled(w->theta_x, sj), ay = scaled(w->theta_y, sj), bx = scaled(w->phi_x, sj),
            by = scaled(w->phi_y, sj), ex = scaled(e.x, se), ey = scaled(e.y, se);
    int64_t det = ax * by - ay * bx;
    if (det <= 0)
        return false;
    int64_t along = (ex * by - ey * bx) * ((int64_t)1 << 20) / det,
            turn = (ax * ey - ay * ex) * ((int64_t)1 << 20) / det;
    if (magnitude(along) >= (uint64_t)1 << 31 || magnitude(turn) >= (uint64_t)1 << 31)
        return false;
    /* Positions to Q30 radians: theta_q30 = position * step 2^(31 - step_shift - 2). */
    int32_t shift = 20 + sj - se + (int32_t)fixed->step_shift + 2 - 31;
    along *= fixed->step;
    turn *= fixed->step;
    if (shift < 0 || shift > 62)
        return false;
    along = round_shift(along, (uint32_t)shift);
    turn = round_shift(turn, (uint32_t)shift);
    while (magnitude(along) > (uint64_t)ONE_Q30 / 2 || magnitude(turn) > (uint64_t)ONE_Q30 / 2) { /* half a radian */
        along /= 2;
        turn /= 2;
    }
    step[0] = round_shift(along * g->across.c - turn * g->across.s, 30);
    step[1] = round_shift(along * g->across.s + turn * g->across.c, 30);
    return true;
}

/* Solves W(Z) = (x, y) by Newton, halving steps that do not help, from the symmetric lens's solution. */
static bool solve_plane(const pf_camera_fixed *fixed, int64_t x, int64_t y, guess *g)
{
    enum { STEPS = 24, HALVINGS = 6, ROUNDING = 3 };
    plane_point w = pf_fixed_lens(fixed, g->theta, g->across.c, g->across.s, true);
    residual e = miss(&w, x, y);
    for (int i = 0; i < STEPS && e.size > 0; i++) {
        int64_t step[2];
        if (!newton_step(fixed, g, &w, e, step))
            return false;
        bool better = false;
        for (int k = 0; k <= HALVINGS && !better; k++) {
            guess next = at_angle(fixed, g->x + step[0], g->y + step[1]);
            plane_point there = pf_fixed_lens(fixed, next.theta, next.across.c, next.across.s, true);
            residual rest = miss(&there, x, y);
            better = rest.size < e.size;
            if (better) {
                *g = next;
                w = there;
                e = rest;
            } else if (e.size <= (uint64_t)fixed->rounding) {
                return true;
            }
            step[0] /= 2;
            step[1] /= 2;
        }
        if (!better)
            break;
    }
    return e.size <= (uint64_t)fixed->rounding;
}

/* The plane point of a pixel; false where it is out of all bounds. */
static bool to_plane(const pf_camera_fixed *fixed, pf_point_q16 pixel, int64_t plane[2])
{
    int64_t at[2] = {pixel.x * ((int64_t)1 << (fixed->pixel_q[0] - 16)) - fixed->center[0],
                     pixel.y * ((int64_t)1 << (fixed->pixel_q[1] - 16)) - fixed->center[1]};
    if (magnitude(at[0]) > (uint64_t)ONE_Q31 || magnitude(at[1]) > (uint64_t)ONE_Q31)
        return false;
    for (int i = 0; i < 2; i++)
        plane[i] =
            round_shift(fixed->from_pixel[i].a * at[0] + fixed->from_pixel[i].b * at[1], fixed->from_pixel[i].shift);
    if (magnitude(plane[0]) > (uint64_t)ONE_Q31 || magnitude(plane[1]) > (uint64_t)ONE_Q31)
        return false;
    if (fixed->tilt[0] | fixed->tilt[1]) {
        /* (X, Y) = (x_d, y_d) d and d = 1 + tilt . (X, Y), so 1 / d = 1 - tilt . (x_d, y_d). */
        int64_t inverse = ONE_Q30 - round_shift(fixed->tilt[0] * plane[0] + fixed->tilt[1] * plane[1], fixed->plane_q);
        if (inverse <= 0)
            return false;
        plane[0] = plane[0] * ONE_Q30 / inverse;
        plane[1] = plane[1] * ONE_Q30 / inverse;
    }
    const uint64_t bound = (uint64_t)(fixed->plane_max + fixed->rim_slack);
    return magnitude(plane[0]) <= bound && magnitude(plane[1]) <= bound;
}

/* Whether a plane point beyond the rim is within rim_slack of the rim's tangent where the straight continuation of the
 * lens leaves it: however the lens shears there, the distance across the rim counts. A point so far out that Newton may
 * not follow it (narrow fields, whose pixels are coarser than the table) must be near the place itself. */
static bool is_near_rim(const pf_camera_fixed *fixed, const int64_t plane[2], polar across, bool is_solved)
{
    plane_point rim = pf_fixed_lens(fixed, fixed->theta_max, across.c, across.s, true);
    residual e = miss(&rim, plane[0], plane[1]);
    polar along = pf_fixed_polar(rim.phi_x, rim.phi_y);
    if (e.size > (is_solved ? (uint64_t)ONE_Q30 : 4 * (uint64_t)fixed->rim_slack))
        return false;
    return magnitude(round_shift(e.x * along.s - e.y * along.c, 30)) <= (uint64_t)fixed->rim_slack;
}

/* theta and phi of a plane point. */
static bool from_plane(const pf_camera_fixed *fixed, const int64_t plane[2], uint64_t *theta, polar *across)
{
    *across = pf_fixed_polar(plane[0], plane[1]);
    uint64_t r = polar_length(*across, 8);
    uint64_t r_max = (uint64_t)fixed->knots[fixed->intervals * fixed->channels].value;
    if (fixed->channels == 1) {
        if (r > (r_max + (uint64_t)fixed->rim_slack) * 256)
            return false;
        *theta = r >= r_max * 256 ? fixed->theta_max : solve_radius(fixed, r);
        return true;
    }
    guess g = at_polar(r >= r_max * 256 ? fixed->theta_max : solve_radius(fixed, r), *across);
    const bool is_solved = solve_plane(fixed, plane[0], plane[1], &g);
    if (!is_solved && g.theta <= fixed->theta_max)
        return false;
    *theta = g.theta;
    *across = g.across;
    if (*theta > fixed->theta_max) {
        *theta = fixed->theta_max;
        return is_near_rim(fixed, plane, *across, is_solved);
    }
    return true;
}

pf_status pf_camera_fixed_unproject(const pf_camera_fixed *fixed, pf_point_q16 pixel, pf_ray_q30 *ray,
                                    int32_t *origin_z_q27)
{
    int64_t plane[2];
    uint64_t theta;
    polar across;
    if (!to_plane(fixed, pixel, plane) || !from_plane(fixed, plane, &theta, &across))
        return PF_ERR_DOMAIN;
    int32_t sine, cosine;
    pf_fixed_sine_cosine(theta, &sine, &cosine);
    ray->x = (int32_t)round_shift((int64_t)sine * across.c, 30);
    ray->y = (int32_t)round_shift((int64_t)sine * across.s, 30);
    ray->z = cosine;
    if (origin_z_q27) {
        uint64_t square = ((theta >> 2) * (theta >> 2)) >> 31;                       /* Q29 */
        *origin_z_q27 = (int32_t)round_shift(fixed->pupil_e1 * (int64_t)square, 32); /* Q59 to Q27 */
    }
    return PF_OK;
}
