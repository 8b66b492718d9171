/* Prediction through rays. In a tube, driven along its axis, the cotangent of a wall point's polar angle falls by the
 * distance driven over the point's distance from the camera's path: steadily, however the pixels accelerate. So each
 * track carries its own fall a frame, and the encoder says how much of it comes next. */
#include "track_private.h"

#define ONE          ((int64_t)1 << 30)
#define STEEP        (ONE / 16) /* sine of the polar angle below which the cotangent says nothing: 3.6 degrees */
#define COT_MOST     (64 << 16)
#define SIDE         (6 << 16) /* cotangent above which a track is too deep to measure the common fall: 9.5 degrees */
#define LEAST        8u
#define BESIDE_LEAST 5u
#define STIRS        65 /* Q16: a thousandth of the radius; from less no ratio is taken */
#define RATIO_MAX    (8 << 16)
#define FAST         (65536 / 25) /* of the radius a frame: patches then grow by 4 % and more */
#define TILT         64           /* 1/64 rad */
#define FRAMES       16           /* after more dropped frames nothing is found again anyway */
#define LEAP         (4 << 16)    /* radii a frame: no crawler drives so, a reading that says so is wrong */
#define ROLL_JUMP    20000        /* urad: below, the last frame's own rotation is better than an inclinometer */

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
    for (uint32_t j = 0; j < n && p->n < p->max_tracks; j++)
        if (tracks[j].status != PF_TRACK_LOST) {
            p->id[p->n] = tracks[j].id;
            p->ray[p->n++] = rays[j];
        }
    p->last = *now;
}

pf_status pf_predictor_init(pf_predictor *p, uint32_t max_tracks, void *workspace, size_t size)
{
    if (max_tracks == 0 || max_tracks > PF_TRACKS_MAX)
        return PF_ERR_ARGUMENT;
    if (size < PF_PREDICTOR_BYTES(max_tracks))
        return PF_ERR_SPACE;
    *p = (pf_predictor){.max_tracks = max_tracks, .id = workspace};
    p->ray = (pf_ray_q30 *)(p->id + max_tracks);
    p->from = p->ray + max_tracks;
    p->to = p->from + max_tracks;
    p->driven = p->to + max_tracks;
    p->fall = (int32_t *)(p->driven + max_tracks);
    p->value = (uint32_t *)(p->fall + 2u * max_tracks);
    p->pair = (uint16_t *)(p->value + max_tracks);
    for (uint32_t i = 0; i < 2u * max_tracks; i++)
        p->fall[i] = PF_FALL_UNKNOWN;
    return PF_OK;
}

void pf_predictor_assume(pf_predictor *p, int32_t radii_per_count_q27)
{
    p->per_count_q30 = (int64_t)radii_per_count_q27 * 8;
    p->has_per_count = true;
}

/* Moves a ray to the cotangent `cot`. */
static pf_ray_q30 with_cotangent(const pf_ray_q30 *v, int64_t cot)
{
    const int64_t rho = sine_of(v), c = pf_clamp_i64(cot, COT_MOST);
    const int64_t norm = pf_isqrt64((uint64_t)(((int64_t)1 << 32) + c * c)); /* Q16 */
    const int64_t sine = ((int64_t)65536 << 30) / norm;
    return (pf_ray_q30){(int32_t)(sine * v->x / rho), (int32_t)(sine * v->y / rho), (int32_t)(c * ONE / norm)};
}

static int32_t frames_of(const pf_motion_hints *h)
{
    return h->frames == 0 ? 1 : h->frames < FRAMES ? (int32_t)h->frames : FRAMES;
}

/* Counts since the last frame; false if there is no encoder, or a jump that is none of its making. A register may wrap.
 */
static bool counted(const pf_predictor *p, const pf_motion_hints *next, int64_t *step)
{
    *step = (int64_t)((uint64_t)next->encoder - (uint64_t)p->last.encoder);
    if (!p->last.has_encoder || !next->has_encoder || *step > PF_COUNTS_MOST || *step < -PF_COUNTS_MOST)
        return false;
    const int64_t fall = (pf_clamp_i64(p->per_count_q30, INT32_MAX) * *step) >> 14;
    const int64_t most = (int64_t)LEAP * frames_of(next);
    return !p->has_per_count || (fall <= most && fall >= -most);
}

int64_t pf_predictor_way(const pf_predictor *p, const pf_motion_hints *next, uint64_t counts)
{
    const int64_t each = p->has_per_count ? pf_clamp_i64(p->per_count_q30, INT32_MAX) : 0;
    int64_t step;
    if (!counted(p, next, &step))
        return 0;
    return (int64_t)(counts < PF_COUNTS_MOST ? counts : PF_COUNTS_MOST) * (each < 0 ? -each : each) >> 6;
}

/* The common fall until the next frame. */
static int32_t next_forward(const pf_predictor *p, const pf_motion_hints *next)
{
    int64_t step;
    if (!p->has_per_count || !counted(p, next, &step))
        return pf_clamp_i64((int64_t)p->forward * frames_of(next), COT_MOST);
    return pf_clamp_i64((pf_clamp_i64(p->per_count_q30, INT32_MAX) * step) >> 14, COT_MOST);
}

/* The rotation that is left when the rays of the last frame have been driven on by `fall`, and then each track's own
 * fall and the median. Under a large fall a rotation fitted to the bare rays would be that of whichever side has more.
 */
static void separate(pf_predictor *p, uint32_t count, int32_t fall, uint32_t *measured)
{
    for (uint32_t k = 0; k < count; k++) {
        const int32_t cot = cotangent(&p->from[k]);
        p->driven[k] = cot == INT32_MAX ? (pf_ray_q30){0, 0, 0} : with_cotangent(&p->from[k], (int64_t)cot - fall);
    }
    p->is_known = pf_rotation_fit(p->driven, p->to, count, p->turn) >= LEAST;
    const int32_t *r = p->turn, back[9] = {r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]};
    *measured = 0;
    for (uint32_t k = 0; k < count; k++) {
        pf_ray_q30 turned;
        if (!pf_ray_valid(&p->driven[k]) || !pf_ray_valid(&p->to[k]))
            continue;
        pf_ray_rotate(back, &p->to[k], &turned);
        const int32_t before = cotangent(&p->from[k]), after = cotangent(&turned);
        if (after == INT32_MAX)
            continue;
        p->fall[p->pair[k]] = before - after;
        if (after < SIDE)
            p->value[(*measured)++] = (uint32_t)((int64_t)before - after + ((int64_t)1 << 31));
    }
    p->is_known = p->is_known && *measured >= LEAST;
    p->forward = p->is_known ? median_signed(p->value, *measured) : 0;
}

/* What was learned over several frames, for one. The turn by its Cayley vector, 2 sin a / (1 + cos a) long. */
static void share_out(pf_predictor *p, uint32_t n, int32_t frames)
{
    const int32_t *r = p->turn;
    const int64_t d = (ONE + r[0] + r[4] + (int64_t)r[8]) / 2 + 1; /* 1 + cos a */
    const int64_t v[3] = {(int64_t)r[7] - r[5], (int64_t)r[2] - r[6], (int64_t)r[3] - r[1]};
    int32_t w[3];
    if (frames == 1)
        return;
    p->forward /= frames;
    for (uint32_t j = 0; j < n; j++)
        if (p->fall[j] != PF_FALL_UNKNOWN)
            p->fall[j] /= frames;
    for (int32_t i = 0; i < 3; i++)
        w[i] = d > ONE / 4 ? pf_clamp_i64(v[i] * ONE / d / frames, (int32_t)ONE / 2) : 0;
    for (int32_t i = 0; i < 9; i++)
        p->turn[i] = i % 4 ? 0 : (int32_t)ONE;
    pf_rotation_turn(w, p->turn);
}

void pf_predictor_learn(pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *now)
{
    const uint32_t rows = n < 2u * p->max_tracks ? n : 2u * p->max_tracks;
    const uint32_t count = match(p, tracks, rays, rows);
    int64_t step;
    uint32_t measured;
    for (uint32_t j = 0; j < rows; j++)
        p->fall[j] = PF_FALL_UNKNOWN;
    separate(p, count, next_forward(p, now), &measured);
    separate(p, count, p->forward, &measured);
    /* Of a few survivors the slow ones are too many: then what a count means stays as it is. */
    if (p->is_known && 3u * measured >= n && counted(p, now, &step) && step != 0) {
        const int64_t per_count = (int64_t)p->forward * 16384 / step;
        /* an eighth each time: counts are coarse, and the median falls by a few per cent from frame to frame */
        p->per_count_q30 = p->has_per_count ? p->per_count_q30 + (per_count - p->per_count_q30) / 8 : per_count;
        p->has_per_count = true;
    }
    share_out(p, rows, frames_of(now));
    remember(p, tracks, rays, rows, now);
}

/* out <- a b */
static void multiply(const int32_t a[9], const int32_t b[9], int32_t out[9])
{
    for (int32_t i = 0; i < 9; i++) {
        int64_t sum = ONE / 2;
        for (int32_t k = 0; k < 3; k++)
            sum += (int64_t)a[i / 3 * 3 + k] * b[3 * k + i % 3];
        out[i] = pf_clamp_i64(sum >> 30, (int32_t)ONE);
    }
}

/* The difference of two angles, within half a turn. */
static int32_t angle_between(int32_t from_urad, int32_t to_urad)
{
    const int64_t turn = 6283185, d = ((int64_t)to_urad - from_urad) % turn;
    return (int32_t)(d > turn / 2 ? d - turn : d < -turn / 2 ? d + turn : d);
}

/* The rotation until the next frame: the last one again, for each, but a jump of the inclinometer's roll is believed.
 */
static void next_turn(const pf_predictor *p, const pf_motion_hints *next, int32_t r[9])
{
    for (int32_t i = 0; i < 9; i++)
        r[i] = p->is_known ? p->turn[i] : i % 4 ? 0 : (int32_t)ONE;
    for (int32_t k = 1; p->is_known && k < frames_of(next); k++) {
        const int32_t so_far[9] = {r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8]};
        multiply(p->turn, so_far, r);
    }
    if (!p->last.has_roll || !next->has_roll)
        return;
    /* the picture turns against the camera */
    const int64_t rolled = -(int64_t)pf_clamp_i64(angle_between(p->last.roll_urad, next->roll_urad), 500000);
    const int64_t already = ((int64_t)r[3] - r[1]) / 2 * 1000000 / ONE;
    if (rolled - already < ROLL_JUMP && already - rolled < ROLL_JUMP)
        return;
    pf_rotation_turn((const int32_t[3]){0, 0, (int32_t)((rolled - already) * ONE / 1000000)}, r);
}

/* What the next frame does to a ray. */
typedef struct pf_drive {
    int32_t turn[9];
    int64_t fall; /* of the cotangent */
} pf_drive;

static pf_ray_q30 drive(const pf_drive *d, const pf_ray_q30 *ray)
{
    const int32_t cot = cotangent(ray);
    const pf_ray_q30 driven = cot == INT32_MAX ? *ray : with_cotangent(ray, cot - d->fall);
    pf_ray_q30 turned;
    pf_ray_rotate(d->turn, &driven, &turned);
    return turned;
}

static pf_ray_q30 tilted(const pf_ray_q30 *v, const int64_t by[3])
{
    /* by is of length TILT and normal to v: the sum is longer than 1 by TILT^2 / 2 = 1e-4, which projection ignores */
    return (pf_ray_q30){pf_clamp_i64(v->x + by[0], (int32_t)ONE), pf_clamp_i64(v->y + by[1], (int32_t)ONE),
                        pf_clamp_i64(v->z + by[2], (int32_t)ONE)};
}

/* How the surroundings of a ray are distorted: the derivatives of the new pixel along the radius and across, times the
 * inverse of the old ones. Leaves the identity where a neighbour cannot be seen. */
static void warp_of(const pf_drive *d, const pf_ray_q30 *ray, pf_ray_project project, const void *camera,
                    int32_t warp[4])
{
    const int64_t rho = sine_of(ray);
    pf_point_q16 old[3], new[3];
    if (rho < STEEP)
        return;
    const int64_t radial[3] = {(int64_t)ray->z * ray->x / rho / TILT, (int64_t)ray->z * ray->y / rho / TILT,
                               -rho / TILT};
    const int64_t across[3] = {-ONE * ray->y / rho / TILT, ONE * ray->x / rho / TILT, 0};
    const pf_ray_q30 near[3] = {*ray, tilted(ray, radial), tilted(ray, across)};
    for (int32_t k = 0; k < 3; k++) {
        const pf_ray_q30 driven = drive(d, &near[k]);
        if (!project(camera, &near[k], &old[k]) || !project(camera, &driven, &new[k]))
            return;
    }
    const int64_t ox1 = old[1].x - old[0].x, oy1 = old[1].y - old[0].y, ox2 = old[2].x - old[0].x,
                  oy2 = old[2].y - old[0].y;
    const int64_t nx1 = new[1].x - new[0].x, ny1 = new[1].y - new[0].y, nx2 = new[2].x - new[0].x,
                  ny2 = new[2].y - new[0].y;
    const int64_t det = (ox1 * oy2 - ox2 * oy1) >> 16;
    if (det < 4096 && det > -4096) /* a sixteenth of a square pixel */
        return;
    warp[0] = pf_clamp_i64((nx1 * oy2 - nx2 * oy1) / det, 2 << 16);
    warp[1] = pf_clamp_i64((nx2 * ox1 - nx1 * ox2) / det, 2 << 16);
    warp[2] = pf_clamp_i64((ny1 * oy2 - ny2 * oy1) / det, 2 << 16);
    warp[3] = pf_clamp_i64((ny2 * ox1 - ny1 * ox2) / det, 2 << 16);
}

/* The fall of a track that has none of its own yet: the median of those on its side of the pipe, within 30 degrees. Low
 * above the invert the crown's is much less. */
static int32_t fall_beside(const pf_predictor *p, const pf_ray_q30 *rays, uint32_t n, const pf_ray_q30 *at)
{
    const int64_t x = at->x >> 15, y = at->y >> 15;
    uint32_t count = 0;
    for (uint32_t i = 0; i < n && i < 2u * p->max_tracks && count < p->max_tracks; i++) {
        const int64_t along = x * (rays[i].x >> 15) + y * (rays[i].y >> 15);
        if (p->fall[i] == PF_FALL_UNKNOWN || along <= 0)
            continue;
        const int64_t across = x * (rays[i].y >> 15) - y * (rays[i].x >> 15);
        if (across * 7 < along * 4 && -across * 7 < along * 4) /* tan 30 degrees = 0.577 */
            p->value[count++] = (uint32_t)((int64_t)p->fall[i] + ((int64_t)1 << 31));
    }
    return count < BESIDE_LEAST ? p->forward : median_signed(p->value, count);
}

void pf_predictor_guess(const pf_predictor *p, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *next, pf_ray_project project, const void *camera, pf_expected *expected)
{
    const int32_t forward = next_forward(p, next);
    const bool is_moving = p->forward > STIRS || p->forward<-STIRS, is_fast = forward> FAST || forward < -FAST;
    const int64_t ratio = is_moving ? pf_clamp_i64((int64_t)forward * 65536 / p->forward, RATIO_MAX) : 0;
    pf_drive d;
    next_turn(p, next, d.turn);
    for (uint32_t i = 0; i < n; i++) {
        pf_expected *e = &expected[i];
        *e = (pf_expected){{PF_NO_GUESS, 0}, {65536, 0, 0, 65536}};
        if (tracks[i].status == PF_TRACK_LOST || !pf_ray_valid(&rays[i]))
            continue;
        const bool has_own = i < 2u * p->max_tracks && p->fall[i] != PF_FALL_UNKNOWN && is_moving;
        d.fall = !is_moving ? forward : ((has_own ? p->fall[i] : fall_beside(p, rays, n, &rays[i])) * ratio) >> 16;
        const pf_ray_q30 driven = drive(&d, &rays[i]);
        if (!project(camera, &driven, &e->at))
            e->at.x = PF_NO_GUESS;
        else if (is_fast)
            warp_of(&d, &rays[i], project, camera, e->warp_q16);
    }
}
