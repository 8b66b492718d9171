/* Prediction through rays. In a tube, driven along its axis, the cotangent of a wall point's polar angle falls by the
 * distance driven over the point's distance from the camera's path: steadily, however the pixels accelerate. So each
 * track carries its own fall a frame, and the encoder says how much of it comes next. */
#include "track_private.h"

#define ONE       ((int64_t)1 << 30)
#define STEEP     (ONE / 16) /* sine of the polar angle below which the cotangent says nothing: 3.6 degrees */
#define COT_MOST  (64 << 16)
#define SIDE      (6 << 16) /* cotangent above which a track is too deep to measure the common fall: 9.5 degrees */
#define LEAST     8u
#define STIRS     65 /* Q16: a thousandth of the radius; from less no ratio is taken */
#define RATIO_MAX (8 << 16)
#define ROLL_JUMP 20000 /* urad: below, the last frame's own rotation is better than an inclinometer */

static int64_t sine_of(const pf_ray_q30 *v)
{
    return pf_isqrt64((uint64_t)((int64_t)v->x * v->x + (int64_t)v->y * v->y));
}

/* Cotangent of the polar angle, Q16; INT32_MAX too near the axis. */
static int32_t cotangent(const pf_ray_q30 *v)
{
    const int64_t rho = sine_of(v);
    return rho < STEEP ? INT32_MAX : pf_clamp_i64((int64_t)v->z * 65536 / rho, COT_MOST);
}

static int32_t median_signed(uint32_t *value, uint32_t n)
{
    return (int32_t)((int64_t)pf_value_of_rank(value, n, n / 2u) - ((int64_t)1 << 31));
}

/* Pairs the rays of this frame with the last one's: p->from, p->to, p->pair; both lists have ascending ids. */
static uint32_t match(pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n)
{
    uint32_t count = 0;
    for (uint32_t i = 0, j = 0; i < p->n && j < n;) {
        if (tracks[j].status == PF_TRACK_LOST || tracks[j].id < p->id[i]) {
            j++;
        } else if (tracks[j].id > p->id[i]) {
            i++;
        } else {
            p->from[count] = p->ray[i++];
            p->to[count] = rays[j];
            p->pair[count++] = (uint16_t)j++;
        }
    }
    return count;
}

static void remember(pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                     const pf_motion_hints *now)
{
    p->n = 0;
    for (uint32_t j = 0; j < n && p->n < PF_TRACKS_MAX; j++)
        if (tracks[j].status != PF_TRACK_LOST) {
            p->id[p->n] = tracks[j].id;
            p->ray[p->n++] = rays[j];
        }
    p->last = *now;
}

void pf_predictor_learn(pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *now)
{
    const uint32_t count = match(p, tracks, rays, n);
    uint32_t measured = 0;
    for (uint32_t j = 0; j < n && j < 2u * PF_TRACKS_MAX; j++)
        p->fall[j] = PF_FALL_UNKNOWN;
    p->is_known = pf_rotation_fit(p->from, p->to, count, p->turn) >= LEAST;
    for (uint32_t k = 0; k < count; k++) {
        pf_ray_q30 turned;
        if (!pf_ray_valid(&p->from[k]) || !pf_ray_valid(&p->to[k]))
            continue;
        pf_ray_rotate(p->turn, &p->from[k], &turned);
        const int32_t before = cotangent(&turned), after = cotangent(&p->to[k]);
        if (before == INT32_MAX || after == INT32_MAX)
            continue;
        p->fall[p->pair[k]] = before - after;
        if (after < SIDE)
            p->value[measured++] = (uint32_t)((int64_t)before - after + ((int64_t)1 << 31));
    }
    p->is_known = p->is_known && measured >= LEAST;
    p->forward = p->is_known ? median_signed(p->value, measured) : 0;
    if (p->is_known && p->last.has_encoder && now->has_encoder && now->encoder != p->last.encoder) {
        const int64_t step = pf_clamp_i64(now->encoder - p->last.encoder, 1 << 24);
        const int64_t per_count = (int64_t)p->forward * 16384 / step;
        /* an eighth each time: counts are coarse, and the median falls by a few per cent from frame to frame */
        p->per_count_q30 = p->has_per_count ? p->per_count_q30 + (per_count - p->per_count_q30) / 8 : per_count;
        p->has_per_count = true;
    }
    remember(p, tracks, rays, n, now);
}

/* The common fall in the next frame. */
static int32_t next_forward(const pf_predictor *p, const pf_motion_hints *next)
{
    if (!p->has_per_count || !p->last.has_encoder || !next->has_encoder)
        return p->forward;
    const int64_t step = pf_clamp_i64(next->encoder - p->last.encoder, 1 << 24);
    return pf_clamp_i64((pf_clamp_i64(p->per_count_q30, INT32_MAX) * step) >> 14, COT_MOST);
}

/* The rotation in the next frame: the last one again, but a jump of the inclinometer's roll is believed. */
static void next_turn(const pf_predictor *p, const pf_motion_hints *next, int32_t r[9])
{
    for (int32_t i = 0; i < 9; i++)
        r[i] = p->is_known ? p->turn[i] : i % 4 ? 0 : (int32_t)ONE;
    if (!p->last.has_roll || !next->has_roll)
        return;
    /* the picture turns against the camera */
    const int64_t rolled = -(int64_t)pf_clamp_i64((int64_t)next->roll_urad - p->last.roll_urad, 500000);
    const int64_t already = ((int64_t)r[3] - r[1]) / 2 * 1000000 / ONE;
    if (rolled - already < ROLL_JUMP && already - rolled < ROLL_JUMP)
        return;
    pf_rotation_turn((const int32_t[3]){0, 0, (int32_t)((rolled - already) * ONE / 1000000)}, r);
}

/* Moves a ray to the cotangent `cot`. */
static pf_ray_q30 with_cotangent(const pf_ray_q30 *v, int64_t cot)
{
    const int64_t rho = sine_of(v), c = pf_clamp_i64(cot, COT_MOST);
    const int64_t norm = pf_isqrt64((uint64_t)(((int64_t)1 << 32) + c * c)); /* Q16 */
    const int64_t sine = ((int64_t)65536 << 30) / norm;
    return (pf_ray_q30){(int32_t)(sine * v->x / rho), (int32_t)(sine * v->y / rho), (int32_t)(c * ONE / norm)};
}

void pf_predictor_guess(const pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *next, pf_ray_project project, const void *camera, pf_point_q16 *at)
{
    const int32_t forward = next_forward(p, next);
    const bool is_moving = p->forward > STIRS || p->forward < -STIRS;
    const int64_t ratio = is_moving ? pf_clamp_i64((int64_t)forward * 65536 / p->forward, RATIO_MAX) : 0;
    int32_t r[9];
    next_turn(p, next, r);
    for (uint32_t i = 0; i < n; i++) {
        pf_ray_q30 turned;
        at[i].x = PF_NO_GUESS;
        if (tracks[i].status == PF_TRACK_LOST || !pf_ray_valid(&rays[i]))
            continue;
        pf_ray_rotate(r, &rays[i], &turned);
        const int32_t cot = cotangent(&turned);
        if (cot != INT32_MAX) {
            const bool has_own = i < 2u * PF_TRACKS_MAX && p->fall[i] != PF_FALL_UNKNOWN && is_moving;
            turned = with_cotangent(&turned, cot - (has_own ? (p->fall[i] * ratio) >> 16 : (int64_t)forward));
        }
        if (!project(camera, &turned, &at[i]))
            at[i].x = PF_NO_GUESS;
    }
}
