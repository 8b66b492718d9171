/* Tracks that walk off the wall. Where relief shines along with the paint, a patch looks shifted, a little farther with
 * every frame: by the patch alone it cannot be told from a wall that is a little nearer. Its neighbours tell. Over
 * a stride the bearings of all tracks determine how the camera moved in its tube; what a track moves beyond that is
 * summed up along its life. A stride is a twelfth of the radius, or a frame where that is more: from frame to frame a
 * slow camera moves too little to tell from the noise, and what was not known of its motion adds up with every frame.
 *
 * The tube is round, its radius the unit. In the camera's frame its axis runs through (o0, o1) + z (o2, o3): where the
 * camera stands off the axis, and its tilt. A stride's motion is a turn w and a way t, in its first frame. These ten
 * are fitted by Gauss and Newton with Cauchy weights; what is known of the axis is kept as a matrix of information that
 * fades as the camera drives on. Q24 unless said. */
#include <string.h>

#include "track_private.h"

_Static_assert(sizeof(pf_track) == 40, "what a track is settled by takes none of the memory");

#define ONE     ((int64_t)1 << 24)
#define UNKNOWN 10 /* w 0..2, t 3..5, o 6..9 */
#define AXIS    6  /* the first of the axis */
#define STEPS   4
#define LEAST   12u                 /* tracks, for a fit */
#define MOST    96u                 /* more tell no more */
#define STEEP   ((int64_t)1 << 28)  /* Q30: sine of the polar angle below which the cotangent says nothing */
#define NOISE   (ONE / 5000)        /* rad: 0.05 px where a pixel is 4 mrad */
#define TURN    (ONE / 50)          /* rad a frame, expected */
#define ASIDE   20                  /* a part of the way: how far the camera strays from the tube's direction */
#define OFFSET  (ONE / 5)           /* of the radius, at the beginning */
#define TILT    (ONE / 25)          /* rad */
#define STRIDE  ((int32_t)ONE / 16) /* of the axis, a step: as far as it is linear */
#define PRIOR   ((int64_t)1 << 37)  /* no prior is stronger: times what v may be off, 62 bits */
#define FAINTLY ((int64_t)1 << 10)  /* a pivot, Q30 */
#define FADE    3                   /* tenths of a radius: on the way what is known of the axis fades to a third */
#define ALIKE   4          /* strides in which the same tracks err alike: each adds such a part of what it says */
#define WELL    (ONE / 32) /* of the radius: so well its place is known, once it is */
#define AFAR    (ONE / 12) /* of the radius: a stride */
#define RIM     (ONE / 4) /* a cotangent, of 76 degrees: beyond it the light moves most, and a track counts a quarter */
#define TURNED  (ONE / 16)          /* rad: with so much of a turn it ends too: its third power, 0.01 px, is left out */
#define OFTEN   3                   /* times the median: where the tube is none, all walk off */
#define AGED    ((int32_t)ONE / 20) /* a fall of the cotangent from which there is something to share */
#define LIGHT   (ONE * 18 / 10000)  /* of a fall: the median of 0.27 % */
#define GLANCE  4
#define BESIDE  7u /* neighbours of whom it is asked whether they walk off alike */

typedef struct pf_pair {
    int64_t c, s, cot;                /* of the ray before: azimuth and cotangent */
    int64_t to[3], out[3], beside[3]; /* the ray after; along growing polar angle there, and across */
} pf_pair;

static int64_t mul(int64_t a, int64_t b)
{
    return (a * b) >> 24;
}

static int64_t dot(const int64_t a[3], const int64_t b[3])
{
    return (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) >> 24;
}

static void cross(const int64_t a[3], const int64_t b[3], int64_t out[3])
{
    out[0] = (a[1] * b[2] - a[2] * b[1]) >> 24;
    out[1] = (a[2] * b[0] - a[0] * b[2]) >> 24;
    out[2] = (a[0] * b[1] - a[1] * b[0]) >> 24;
}

static bool make_pair(const pf_ray_q30 *before, const pf_ray_q30 *after, pf_pair *p)
{
    const int64_t a = pf_ray_sine(before), b = pf_ray_sine(after);
    if (a < STEEP || b < STEEP)
        return false;
    p->c = before->x * ONE / a;
    p->s = before->y * ONE / a;
    p->cot = before->z * ONE / a;
    p->to[0] = after->x >> 6;
    p->to[1] = after->y >> 6;
    p->to[2] = after->z >> 6;
    const int64_t c = after->x * ONE / b, s = after->y * ONE / b;
    p->out[0] = mul(c, p->to[2]);
    p->out[1] = mul(s, p->to[2]);
    p->out[2] = -(b >> 6);
    p->beside[0] = -s;
    p->beside[1] = c;
    p->beside[2] = 0;
    return true;
}

int64_t pf_tube_reach(int64_t c, int64_t s, int64_t z, const int64_t o[4])
{
    const int64_t x = o[0] + mul(o[2], z), y = o[1] + mul(o[3], z), off = mul(x, s) - mul(y, c);
    const int64_t square = ONE * ONE - off * off;
    const int64_t rho = mul(x, c) + mul(y, s) + (square > 0 ? (int64_t)pf_isqrt64((uint64_t)square) : 0);
    return rho < ONE / 8 ? ONE / 8 : rho > 4 * ONE ? 4 * ONE : rho;
}

int64_t pf_tube_wall(int64_t c, int64_t s, int64_t cot, const int64_t o[4], int64_t *z)
{
    int64_t rho = ONE;
    for (int32_t i = 0; i < 3; i++) {
        *z = mul(cot, rho);
        *z = *z < -ONE ? -ONE : *z > 4 * ONE ? 4 * ONE : *z;
        rho = pf_tube_reach(c, s, *z, o);
    }
    return rho;
}

/* How far the pair's second ray lies from where the parameters put it, rad: outwards and across; and what the
 * parameters change of that, Q14 (NULL: not asked). */
static void residual(const pf_pair *p, const int64_t v[UNKNOWN], int64_t r[2], int32_t j[2][UNKNOWN])
{
    int64_t z, turn[3], more[3], at[3];
    const int64_t rho = pf_tube_wall(p->c, p->s, p->cot, v + AXIS, &z), way[3] = {p->c, p->s, p->cot};
    for (int32_t k = 0; k < 3; k++)
        at[k] = mul(way[k], rho) - v[3 + k];
    cross(v, at, turn);
    cross(v, turn, more);
    for (int32_t k = 0; k < 3; k++)
        at[k] += turn[k] + more[k] / 2;
    int64_t norm = (int64_t)pf_isqrt64((uint64_t)(at[0] * at[0] + at[1] * at[1] + at[2] * at[2]));
    norm = norm < ONE / 16 ? ONE / 16 : norm;
    const int64_t *side[2] = {p->out, p->beside};
    for (int32_t k = 0; k < 3; k++)
        at[k] = at[k] * ONE / norm;
    for (int32_t i = 0; i < 2; i++) {
        r[i] = dot(p->to, side[i]) - dot(at, side[i]);
        if (!j)
            continue;
        cross(at, side[i], turn);
        const int64_t along = dot(way, side[i]) * ONE / norm;
        const int64_t axis[4] = {mul(along, p->c), mul(along, p->s), mul(mul(along, p->c), z),
                                 mul(mul(along, p->s), z)};
        for (int32_t k = 0; k < 3; k++) {
            j[i][k] = (int32_t)(turn[k] >> 10);
            j[i][3 + k] = (int32_t)((-side[i][k] * ONE / norm) >> 10);
        }
        for (int32_t k = 0; k < 4; k++)
            j[i][AXIS + k] = (int32_t)(axis[k] >> 10);
    }
}

static int64_t shifted(int64_t v, int32_t by)
{
    return by >= 0 ? v * ((int64_t)1 << by) : v >> -by;
}

/* Solves a x = g (a: Q28, symmetric, positive; g: Q24 of its unit) into x, Q24; and leaves in `axis` what a says of the
 * last four unknowns alone, Q28. By elimination, a scaled to a unit diagonal. */
static void solve(int64_t a[UNKNOWN][UNKNOWN], const int64_t g[UNKNOWN], int64_t x[UNKNOWN], int64_t axis[4][4])
{
    int64_t m[UNKNOWN][UNKNOWN], b[UNKNOWN];
    int32_t e[UNKNOWN];
    for (int32_t i = 0; i < UNKNOWN; i++) {
        for (e[i] = 14; e[i] > -14 && shifted(a[i][i], -2 * e[i]) < (int64_t)1 << 26; e[i]--)
            continue;
        b[i] = shifted(g[i], -e[i]);
    }
    for (int32_t i = 0; i < UNKNOWN; i++)
        for (int32_t k = 0; k < UNKNOWN; k++)
            m[i][k] = shifted(a[i][k], 2 - e[i] - e[k]);
    for (int32_t k = 0; k < UNKNOWN; k++) {
        for (int32_t i = 0; k == AXIS && i < 4; i++)
            for (int32_t n = 0; n < 4; n++)
                axis[i][n] = shifted(m[AXIS + i][AXIS + n], e[AXIS + i] + e[AXIS + n] - 2);
        if (m[k][k] < FAINTLY)
            m[k][k] = FAINTLY;
        for (int32_t i = k + 1; i < UNKNOWN; i++) {
            const int64_t f = m[i][k] * ((int64_t)1 << 30) / m[k][k];
            for (int32_t n = k; n < UNKNOWN; n++)
                m[i][n] -= (f * m[k][n]) >> 30;
            b[i] -= (f * b[k]) >> 30;
        }
    }
    for (int32_t k = UNKNOWN; k-- > 0;) {
        int64_t v = b[k];
        for (int32_t n = k + 1; n < UNKNOWN; n++)
            v -= (m[k][n] * x[n]) >> 30;
        x[k] = pf_clamp_i64(v, 1 << 28) * ((int64_t)1 << 30) / m[k][k];
        x[k] = pf_clamp_i64(x[k], 1 << 30);
    }
    for (int32_t k = 0; k < UNKNOWN; k++)
        x[k] = shifted(x[k], -e[k]);
}

/* variance / sigma^2, Q28. */
static int64_t prior_of(int64_t variance_q48, int64_t sigma)
{
    const int64_t square = sigma * sigma >> 28;
    const int64_t p = variance_q48 / (square > 0 ? square : 1);
    return p > PRIOR ? PRIOR : p;
}

/* The median size of the residuals' larger part, times 1.5, and the noise. */
static int64_t scale_of(pf_wall *wall, const pf_pair *pair, uint32_t n, const int64_t v[UNKNOWN])
{
    for (uint32_t i = 0; i < n; i++) {
        int64_t r[2];
        residual(&pair[i], v, r, NULL);
        const int64_t a = r[0] < 0 ? -r[0] : r[0], b = r[1] < 0 ? -r[1] : r[1];
        wall->value[i] = (uint32_t)(a > b ? a : b);
    }
    return (int64_t)pf_value_of_rank(wall->value, n, n / 2u) + NOISE;
}

/* Adds the pairs to the normal equations. */
static void gather(const pf_pair *pair, uint32_t n, const int64_t v[UNKNOWN], int64_t variance_q48,
                   int64_t a[UNKNOWN][UNKNOWN], int64_t g[UNKNOWN])
{
    for (uint32_t i = 0; i < n; i++) {
        int64_t r[2];
        int32_t j[2][UNKNOWN];
        const int64_t part = pair[i].cot < RIM ? 1 : 4;
        residual(&pair[i], v, r, j);
        for (int32_t q = 0; q < 2; q++) {
            const int64_t far = r[q] > ONE ? ONE : r[q] < -ONE ? -ONE : r[q];
            const int64_t weight = part * variance_q48 / ((4 * variance_q48 + far * far) >> 14);
            for (int32_t k = 0; k < UNKNOWN; k++) {
                const int64_t wj = (weight * j[q][k]) >> 14;
                g[k] += (wj * far) >> 14;
                for (int32_t m = k; m < UNKNOWN; m++)
                    a[k][m] += wj * j[q][m];
            }
        }
    }
}

/* What is known of the axis for residuals of this variance: by what factor, Q16. No prior becomes stronger than PRIOR.
 */
static int64_t ratio_to(const pf_wall_axis *before, int64_t variance_q48)
{
    const int64_t ratio = before->variance > 0 ? variance_q48 / ((before->variance >> 16) + 1) : 0;
    int64_t most = 1, bound;
    for (int32_t i = 0; i < 4; i++)
        most = before->known[i][i] > most ? before->known[i][i] : most;
    bound = PRIOR * 65536 / most;
    bound = bound < 1 << 22 ? bound : 1 << 22;
    return ratio < bound ? ratio : bound;
}

/* Fits the stride's motion so far; v begins at what is expected. */
static void fit_motion(pf_wall *wall, const pf_pair *pair, uint32_t n, int64_t v[UNKNOWN])
{
    const pf_wall_axis *before = &wall->before;
    const int64_t expected = v[5];
    int64_t axis[4][4], prior[4][4], variance = 0;
    for (int32_t step = 0; step < STEPS; step++) {
        int64_t a[UNKNOWN][UNKNOWN] = {{0}}, g[UNKNOWN] = {0}, x[UNKNOWN];
        const int64_t scale = scale_of(wall, pair, n, v), way = expected < 0 ? -expected : expected;
        variance = scale * scale;
        gather(pair, n, v, variance, a, g);
        const int64_t ratio_q16 = ratio_to(before, variance);
        for (int32_t k = 0; k < AXIS; k++) {
            const int64_t aim = k < 3 ? 0 : k < 5 ? mul(v[AXIS + 2 + k - 3], v[5]) : 0;
            const int64_t p = prior_of(variance / 2, k < 3 ? TURN : k < 5 ? way / ASIDE + 200 : ONE);
            a[k][k] += p;
            g[k] -= (p * (v[k] - aim)) >> 28;
        }
        for (int32_t i = 0; i < 4; i++)
            for (int32_t k = 0; k < 4; k++) {
                const int64_t least = i == k ? prior_of(variance / 2, i < 2 ? OFFSET : TILT) : 0;
                const int64_t told = (before->known[i][k] * ratio_q16) >> 16;
                const int64_t p = i == k && told < least ? least : told;
                prior[i][k] = p;
                if (k >= i)
                    a[AXIS + i][AXIS + k] += p;
                g[AXIS + i] -= (p * (v[AXIS + k] - before->at[k])) >> 28;
            }
        for (int32_t i = 0; i < UNKNOWN; i++)
            for (int32_t k = 0; k < i; k++)
                a[i][k] = a[k][i];
        solve(a, g, x, axis);
        for (int32_t k = 0; k < UNKNOWN; k++)
            v[k] = k < AXIS ? pf_clamp_i64(v[k] + x[k], (int32_t)ONE)
                            : pf_clamp_i64(v[k] + pf_clamp_i64(x[k], STRIDE), PF_TUBE_FARTHEST);
    }
    const int64_t way = v[5] < 0 ? -v[5] : v[5], fades = 10 * way / FADE;
    const int64_t keep = fades < ONE / 2 ? ONE - fades : ONE / 2;
    for (int32_t i = 0; i < 4; i++)
        for (int32_t k = 0; k < 4; k++)
            wall->axis.known[i][k] = ((prior[i][k] + (axis[i][k] - prior[i][k]) / ALIKE) * (keep >> 8)) >> 16;
    memcpy(wall->axis.at, v + AXIS, sizeof wall->axis.at);
    wall->axis.variance = variance;
}

pf_status pf_wall_init(pf_wall *wall, uint32_t max_tracks, void *workspace, size_t size)
{
    if (max_tracks == 0 || max_tracks > PF_TRACKS_MAX)
        return PF_ERR_ARGUMENT;
    if (size < PF_WALL_BYTES(max_tracks))
        return PF_ERR_SPACE;
    *wall = (pf_wall){.max_tracks = max_tracks, .ends = true, .now.id = workspace};
    wall->motion[5] = ONE / 64; /* somewhere to begin */
    wall->from.id = wall->now.id + max_tracks;
    wall->scratch = (int64_t *)(wall->from.id + max_tracks);
    wall->now.off = (int32_t *)(wall->scratch + MOST * sizeof(pf_pair) / sizeof(int64_t));
    wall->from.off = wall->now.off + 3u * max_tracks;
    wall->now.ray = (pf_ray_q30 *)(wall->from.off + 3u * max_tracks);
    wall->from.ray = wall->now.ray + max_tracks;
    wall->value = (uint32_t *)(wall->from.ray + max_tracks);
    wall->pair = (uint16_t *)(wall->value + max_tracks);
    return PF_OK;
}

/* Begins a stride with the last frame; its motion is taken to go on as it was. */
static void begin_stride(pf_wall *wall)
{
    const pf_wall_list from = wall->from;
    wall->from = wall->now;
    wall->now = from;
    wall->before = wall->axis;
    for (int32_t k = 0; k < AXIS && wall->frames > 1; k++)
        wall->motion[k] /= wall->frames;
    wall->frames = 0;
}

/* Whether the stride ends here. */
static bool has_strode(const pf_wall *wall)
{
    const int64_t *v = wall->motion;
    for (int32_t k = 0; k < 3; k++)
        if (v[k] > TURNED || v[k] < -TURNED)
            return true;
    return v[5] > AFAR || v[5] < -AFAR;
}

/* Row by row, where each track was in the list with which the stride began: wall->pair, UINT16_MAX = nowhere. Both have
 * ascending ids. */
static uint32_t match(pf_wall *wall, const pf_track *tracks, uint32_t n)
{
    const pf_wall_list *from = &wall->from;
    uint32_t i = 0, count = 0;
    for (uint32_t j = 0; j < n; j++) {
        while (i < from->n && from->id[i] < tracks[j].id)
            i++;
        const bool is_known = tracks[j].status == PF_TRACK_TRACKED && i < from->n && from->id[i] == tracks[j].id;
        wall->pair[j] = is_known ? (uint16_t)i : UINT16_MAX;
        count += is_known;
    }
    return count;
}

/* Fits the motion to at most MOST of the tracks seen here and where the stride began. False with too few. */
static bool learn_motion(pf_wall *wall, const pf_ray_q30 *rays, uint32_t n, uint32_t known)
{
    pf_pair *pair = (pf_pair *)wall->scratch;
    const uint32_t every = (known + MOST - 1u) / MOST;
    uint32_t count = 0, seen = 0;
    for (uint32_t j = 0; j < n; j++)
        if (wall->pair[j] != UINT16_MAX && seen++ % every == 0 &&
            make_pair(&wall->from.ray[wall->pair[j]], &rays[j], &pair[count]))
            count++;
    if (count < LEAST)
        return false;
    for (int32_t k = 0; k < AXIS && wall->frames > 0; k++)
        wall->motion[k] += wall->motion[k] / wall->frames;
    fit_motion(wall, pair, count, wall->motion);
    return true;
}

/* Takes a track into the list as its k-th, with what it has walked off: before the stride and in it. */
static void move_on(pf_wall *wall, uint32_t k, uint64_t id, const pf_ray_q30 *ray, uint32_t before, bool has_motion)
{
    int32_t *off = wall->now.off + 3u * k;
    pf_pair pair;
    if (before == UINT16_MAX) {
        off[0] = off[1] = off[2] = 0;
    } else {
        const int32_t *was = wall->from.off + 3u * before;
        int64_t now[3] = {was[0], was[1], was[2]}, r[2];
        if (has_motion && make_pair(&wall->from.ray[before], ray, &pair)) {
            const int64_t sine = -pair.out[2];
            residual(&pair, wall->motion, r, NULL);
            now[0] += r[0] * ONE / sine * ONE / sine;
            now[1] += r[1] * ONE / sine;
            now[2] += pair.cot - pair.to[2] * ONE / sine;
        }
        for (uint32_t i = 0; i < 3u; i++)
            off[i] = pf_clamp_i64(now[i], 1 << 30);
    }
    wall->now.id[k] = id;
    wall->now.ray[k] = *ray;
}

/* The BESIDE tracks of some age nearest to the k-th. Returns how many there are. */
static uint32_t find_neighbours(const pf_wall *wall, uint32_t k, uint32_t at[BESIDE])
{
    uint32_t near[BESIDE], n = 0;
    for (uint32_t i = 0; i < wall->now.n; i++) {
        const int32_t *off = wall->now.off + 3u * i;
        if (i == k || (off[2] < AGED && off[2] > -AGED))
            continue;
        const uint32_t chord = pf_ray_chord2(&wall->now.ray[k], &wall->now.ray[i]);
        uint32_t m = n < BESIDE ? n++ : BESIDE;
        if (m == BESIDE && chord >= near[BESIDE - 1u])
            continue;
        for (m = m == BESIDE ? BESIDE - 1u : m; m > 0 && near[m - 1u] > chord; m--) {
            near[m] = near[m - 1u];
            at[m] = at[m - 1u];
        }
        near[m] = chord;
        at[m] = i;
    }
    return n;
}

/* Sorts v[BESIDE]; returns the middle. */
static int64_t median_of(int64_t v[BESIDE])
{
    for (uint32_t i = 1; i < BESIDE; i++)
        for (uint32_t k = i; k > 0 && v[k] < v[k - 1u]; k--) {
            const int64_t swap = v[k];
            v[k] = v[k - 1u];
            v[k - 1u] = swap;
        }
    return v[BESIDE / 2u];
}

/* What the k-th track has walked off, of its cotangent and its azimuth, less what its neighbours walk off for as much
 * of a fall, in the median: where they go alike, there the wall is, or it is not well known how the camera moved. With
 * fewer neighbours, all of it. */
static void walked_alone(const pf_wall *wall, uint32_t k, int64_t walked[2])
{
    const int32_t *own = wall->now.off + 3u * k;
    uint32_t at[BESIDE];
    const bool has_neighbours = find_neighbours(wall, k, at) == BESIDE;
    for (uint32_t i = 0; i < 2u; i++) {
        int64_t part[BESIDE];
        walked[i] = own[i];
        if (!has_neighbours)
            continue;
        for (uint32_t m = 0; m < BESIDE; m++)
            part[m] = wall->now.off[3u * at[m] + i] * ONE / wall->now.off[3u * at[m] + 2u];
        walked[i] -= mul(own[2], pf_clamp_i64(median_of(part), (int32_t)ONE));
    }
}

/* The way in the picture, Q16 px, that the k-th track has walked off by so much of its cotangent and its azimuth; 0, 0
 * where the camera does not see. */
static pf_point_q16 way_of(const pf_wall *wall, uint32_t k, const int64_t walked[2], pf_ray_project project,
                           const void *camera)
{
    const pf_ray_q30 *v = &wall->now.ray[k];
    const int64_t sine = pf_ray_sine(v);
    pf_point_q16 a, b;
    if (sine < STEEP || !project(camera, v, &a))
        return (pf_point_q16){0, 0};
    const int64_t c = v->x * ONE / sine, s = v->y * ONE / sine, cosine = v->z >> 6, q = sine >> 6;
    const int64_t along = mul(mul(q, q), walked[0]), across = mul(q, walked[1]);
    const int64_t from[3] = {(v->x >> 6) - mul(mul(c, cosine), along) + mul(s, across),
                             (v->y >> 6) - mul(mul(s, cosine), along) - mul(c, across), cosine + mul(q, along)};
    const pf_ray_q30 start = {pf_clamp_i64(from[0] * 32, (int32_t)1 << 30),
                              pf_clamp_i64(from[1] * 32, (int32_t)1 << 30),
                              pf_clamp_i64(from[2] * 32, (int32_t)1 << 30)};
    if (!project(camera, &start, &b))
        return (pf_point_q16){0, 0};
    return (pf_point_q16){pf_clamp_i64((int64_t)a.x - b.x, INT32_MAX), pf_clamp_i64((int64_t)a.y - b.y, INT32_MAX)};
}

static uint32_t length_of(pf_point_q16 way)
{
    return pf_isqrt64((uint64_t)((int64_t)way.x * way.x + (int64_t)way.y * way.y));
}

/* Whether it is known where the camera stands: what tracks walk off before that is not held against them. */
static bool knows_axis(const pf_wall *wall)
{
    const int64_t enough = prior_of(wall->axis.variance / 2, WELL);
    return wall->axis.known[0][0] >= enough && wall->axis.known[1][1] >= enough;
}

bool pf_wall_axis_of(const pf_wall *wall, int64_t axis[4])
{
    if (!knows_axis(wall))
        return false;
    memcpy(axis, wall->axis.at, sizeof wall->axis.at);
    return true;
}

/* The part, Q16, of what a track walks off alone that is the light's doing. On brick, clay and plastic that is 0.27 %
 * of the fall (standard deviation): what all walk off beyond that, in the median, is the shape of the wall (a bend, an
 * oval tube) or what is not known of the motion. At most half: a wall may well be as rough as that. */
static uint32_t part_of_light(pf_wall *wall)
{
    uint32_t n = 0;
    for (uint32_t k = 0; k < wall->now.n; k++) {
        const int64_t off = wall->now.off[3u * k], fall = wall->now.off[3u * k + 2u];
        if (fall >= AGED || fall <= -AGED)
            wall->value[n++] =
                (uint32_t)pf_clamp_i64((off < 0 ? -off : off) * ONE / (fall < 0 ? -fall : fall), (int32_t)ONE / 4);
    }
    if (n <= BESIDE)
        return 0;
    const int64_t median = pf_value_of_rank(wall->value, n, n / 2u);
    return 65536 * LIGHT * LIGHT < 32768 * median * median ? (uint32_t)(65536 * LIGHT * LIGHT / (median * median))
                                                           : 32768u;
}

/* The same for the k-th track, Q16. As the light comes to stand square on the wall it does more: from a cotangent of a
 * half to none the odds that it was the light rise to GLANCE + 1 times as much. Measured against the truth, what is
 * best taken back is 0.5 inside 60 degrees, 0.65 to 75, 0.75 to 82 and 0.8 beyond, on brick, clay and plastic alike. */
static int64_t part_of(const pf_wall *wall, uint32_t k)
{
    const pf_ray_q30 *v = &wall->now.ray[k];
    const int64_t sine = pf_ray_sine(v), z = v->z < 0 ? -(int64_t)v->z : v->z, p = wall->light_q16;
    const int64_t cot = z < sine / 2 ? z * 65536 / sine : 32768;
    const int64_t odds = 65536 + GLANCE * (65536 - 2 * cot);
    return p * odds / (65536 + ((p * (odds - 65536)) >> 16));
}

/* How far, Q16 px, the k-th track has walked off by `walked` of its cotangent and its azimuth, less what is taken back
 * of it. */
static uint32_t stray_of(const pf_wall *wall, uint32_t k, const int64_t walked[2], pf_ray_project project,
                         const void *camera)
{
    const int64_t length = length_of(way_of(wall, k, walked, project, camera));
    return (uint32_t)(length * (65536 - part_of(wall, k)) >> 16);
}

uint32_t pf_wall_check(pf_wall *wall, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                       pf_ray_project project, const void *camera, uint32_t most_q16, uint16_t *astray)
{
    const uint32_t rows = n < 2u * wall->max_tracks ? n : 2u * wall->max_tracks;
    if (wall->ends)
        begin_stride(wall);
    const uint32_t known = match(wall, tracks, rows);
    const bool is_fitted = known >= LEAST && learn_motion(wall, rays, rows, known);
    const bool has_motion = is_fitted && knows_axis(wall);
    uint32_t kept = 0, found = 0;
    wall->frames++;
    wall->ends = !is_fitted || has_strode(wall);
    for (uint32_t j = 0; j < rows && kept < wall->max_tracks; j++)
        if (tracks[j].status != PF_TRACK_LOST) {
            const uint32_t before = wall->pair[j];
            wall->pair[kept] = (uint16_t)j;
            move_on(wall, kept++, tracks[j].id, &rays[j], before, has_motion);
        }
    wall->now.n = kept;
    wall->light_q16 = part_of_light(wall);
    for (uint32_t k = 0; k < kept; k++) {
        const int64_t walked[2] = {wall->now.off[3u * k], wall->now.off[3u * k + 1u]};
        wall->value[k] = stray_of(wall, k, walked, project, camera);
    }
    const uint64_t median = kept ? pf_value_of_rank(wall->value, kept, kept / 2u) : 0;
    const uint64_t most = most_q16 > OFTEN * median ? most_q16 : OFTEN * median;
    for (uint32_t k = 0; k < kept; k++) {
        int64_t walked[2];
        if (wall->value[k] <= most)
            continue;
        walked_alone(wall, k, walked);
        if (stray_of(wall, k, walked, project, camera) > most)
            astray[found++] = wall->pair[k];
    }
    return found;
}

void pf_wall_settle(const pf_wall *wall, pf_track *tracks, uint32_t n, pf_ray_project project, const void *camera)
{
    for (uint32_t j = 0, k = 0; j < n; j++) {
        int64_t walked[2];
        while (k < wall->now.n && wall->now.id[k] < tracks[j].id)
            k++;
        if (k == wall->now.n || wall->now.id[k] != tracks[j].id || tracks[j].status != PF_TRACK_TRACKED)
            continue;
        walked_alone(wall, k, walked);
        const pf_point_q16 way = way_of(wall, k, walked, project, camera);
        const int64_t part = part_of(wall, k);
        tracks[j].settled_x_q8 = (int16_t)pf_clamp_i64(-way.x * part / (65536 * 256), INT16_MAX);
        tracks[j].settled_y_q8 = (int16_t)pf_clamp_i64(-way.y * part / (65536 * 256), INT16_MAX);
        tracks[j].pos.x = pf_clamp_i64((int64_t)tracks[j].pos.x + 256 * tracks[j].settled_x_q8, INT32_MAX);
        tracks[j].pos.y = pf_clamp_i64((int64_t)tracks[j].pos.y + 256 * tracks[j].settled_y_q8, INT32_MAX);
    }
}
