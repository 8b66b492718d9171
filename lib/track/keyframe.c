/* Keyframe choice. Plain IEEE double arithmetic, + - * / only: the same bits wherever doubles are doubles. */
#include "pipefish/track.h"

#define ROTATION_STEPS 8
#define ROBUST_C2      0.0025 /* squared chord (0.05 rad) at which a bearing's weight has halved */
#define CHORD_ONE      1073741824.0

static uint32_t or_default(uint32_t value, uint32_t fallback)
{
    return value ? value : fallback;
}

static void to_unit(const pf_ray_q30 *ray, double v[3])
{
    v[0] = ray->x / CHORD_ONE;
    v[1] = ray->y / CHORD_ONE;
    v[2] = ray->z / CHORD_ONE;
}

static bool ray_valid(const pf_ray_q30 *ray)
{
    return ray->x != 0 || ray->y != 0 || ray->z != 0;
}

static bool alive(const pf_track *track)
{
    return track->status == PF_TRACK_NEW || track->status == PF_TRACK_TRACKED;
}

static void rotate(const double r[9], const double v[3], double out[3])
{
    for (int i = 0; i < 3; i++)
        out[i] = r[3 * i] * v[0] + r[3 * i + 1] * v[1] + r[3 * i + 2] * v[2];
}

static double chord2(const double a[3], const double b[3])
{
    const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return x * x + y * y + z * z;
}

/* r <- C(w) r with Cayley's map C(w) = (1 - [w/2])^-1 (1 + [w/2]): a rotation without a trigonometric function. */
static void turn(const double w[3], double r[9])
{
    const double x = w[0] / 2, y = w[1] / 2, z = w[2] / 2, s = 1 / (1 + x * x + y * y + z * z);
    const double c[9] = {s * (1 + x * x - y * y - z * z), s * 2 * (x * y - z), s * 2 * (x * z + y), s * 2 * (x * y + z),
                         s * (1 - x * x + y * y - z * z), s * 2 * (y * z - x), s * 2 * (x * z - y), s * 2 * (y * z + x),
                         s * (1 - x * x - y * y + z * z)};
    double out[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = c[3 * i] * r[j] + c[3 * i + 1] * r[3 + j] + c[3 * i + 2] * r[6 + j];
    for (int i = 0; i < 9; i++)
        r[i] = out[i];
}

/* Adds one pair to the normal equations of w: b ~ a + w x a, with the weight of a Cauchy loss. */
static void accumulate(const double a[3], const double b[3], double h[6], double g[3])
{
    const double weight = ROBUST_C2 / (ROBUST_C2 + chord2(a, b));
    h[0] += weight * (a[1] * a[1] + a[2] * a[2]);
    h[1] -= weight * a[0] * a[1];
    h[2] -= weight * a[0] * a[2];
    h[3] += weight * (a[0] * a[0] + a[2] * a[2]);
    h[4] -= weight * a[1] * a[2];
    h[5] += weight * (a[0] * a[0] + a[1] * a[1]);
    g[0] += weight * (a[1] * b[2] - a[2] * b[1]);
    g[1] += weight * (a[2] * b[0] - a[0] * b[2]);
    g[2] += weight * (a[0] * b[1] - a[1] * b[0]);
}

static bool solve3(const double h[6], const double g[3], double w[3])
{
    const double c00 = h[3] * h[5] - h[4] * h[4], c01 = h[2] * h[4] - h[1] * h[5], c02 = h[1] * h[4] - h[2] * h[3];
    const double c11 = h[0] * h[5] - h[2] * h[2], c12 = h[1] * h[2] - h[0] * h[4], c22 = h[0] * h[3] - h[1] * h[1];
    const double det = h[0] * c00 + h[1] * c01 + h[2] * c02, trace = h[0] + h[3] + h[5];
    if (!(det > 1e-9 * trace * trace * trace))
        return false;
    w[0] = (c00 * g[0] + c01 * g[1] + c02 * g[2]) / det;
    w[1] = (c01 * g[0] + c11 * g[1] + c12 * g[2]) / det;
    w[2] = (c02 * g[0] + c12 * g[1] + c22 * g[2]) / det;
    return true;
}

/* Walks the pairs of valid rays shared by the reference and the table; both have ascending ids. */
typedef struct pf_pairs {
    const pf_keyframe_state *state;
    const pf_track *tracks;
    const pf_ray_q30 *rays;
    uint32_t n, i, j;
} pf_pairs;

static bool next_common(pf_pairs *p, uint32_t *i, uint32_t *j)
{
    while (p->i < p->state->n && p->j < p->n) {
        if (!alive(&p->tracks[p->j]) || p->tracks[p->j].id < p->state->id[p->i]) {
            p->j++;
        } else if (p->tracks[p->j].id > p->state->id[p->i]) {
            p->i++;
        } else {
            *i = p->i++;
            *j = p->j++;
            return true;
        }
    }
    return false;
}

/* Value of rank k (0 = least) by bisection over the bits: the array stays as it is and no order of ties matters. */
static uint32_t value_of_rank(const uint32_t *value, uint32_t n, uint32_t k)
{
    uint32_t found = 0;
    for (uint32_t bit = (uint32_t)1 << 31; bit; bit >>= 1) {
        uint32_t below = 0;
        for (uint32_t i = 0; i < n; i++)
            below += value[i] < (found | bit);
        if (below <= k)
            found |= bit;
    }
    return found;
}

/* Median squared chord (Q2.30, saturating) between common bearings after the best rotation; false with too few. */
static bool median_chord2(pf_keyframe_state *state, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                          uint32_t *median)
{
    double r[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    uint32_t count = 0, i, j;
    for (int k = 0; k <= ROTATION_STEPS; k++) {
        pf_pairs pairs = {state, tracks, rays, n, 0, 0};
        double h[6] = {0}, g[3] = {0}, w[3];
        count = 0;
        while (next_common(&pairs, &i, &j)) {
            double a0[3], a[3], b[3];
            if (!ray_valid(&state->ray[i]) || !ray_valid(&rays[j]))
                continue;
            to_unit(&state->ray[i], a0);
            to_unit(&rays[j], b);
            rotate(r, a0, a);
            accumulate(a, b, h, g);
            const double q30 = chord2(a, b) * CHORD_ONE;
            state->chord[count++] = q30 < 4294967295.0 ? (uint32_t)q30 : UINT32_MAX;
        }
        if (count < 8)
            return false;
        if (k == ROTATION_STEPS)
            break;
        if (!solve3(h, g, w))
            break;
        turn(w, r);
    }
    *median = value_of_rank(state->chord, count, count / 2u);
    return true;
}

/* 2 - 2 cos(angle) in Q2.30 by its series; the last term is below 1 LSB up to 1 rad, above it angles count as 1 rad. */
static uint32_t chord2_of_angle(uint32_t urad)
{
    const double a = urad < 1000000u ? urad * 1e-6 : 1.0, q = a * a;
    return (uint32_t)(CHORD_ONE * q * (1 - q / 12 * (1 - q / 30 * (1 - q / 56 * (1 - q / 90 * (1 - q / 132))))));
}

static uint32_t count_common(const pf_keyframe_state *state, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n)
{
    pf_pairs pairs = {state, tracks, rays, n, 0, 0};
    uint32_t count = 0, i, j;
    while (next_common(&pairs, &i, &j))
        count++;
    return count;
}

static void take_reference(pf_keyframe_state *state, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                           const int64_t *encoder)
{
    state->n = 0;
    for (uint32_t i = 0; i < n && state->n < PF_TRACKS_MAX; i++)
        if (alive(&tracks[i])) {
            state->id[state->n] = tracks[i].id;
            state->ray[state->n++] = rays[i];
        }
    state->started = true;
    state->frames_since = 0;
    state->have_encoder = encoder != NULL;
    state->encoder = encoder ? *encoder : 0;
}

pf_keyframe_cause pf_keyframe_decide(pf_keyframe_state *state, const pf_keyframe_config *config, const pf_track *tracks,
                                     const pf_ray_q30 *rays, uint32_t n, const int64_t *encoder, uint32_t *common)
{
    const uint32_t wanted = or_default(config->min_common, 100), half = state->n / 2u;
    const uint32_t shared = state->started ? count_common(state, tracks, rays, n) : 0;
    pf_keyframe_cause cause = PF_KEYFRAME_NO;
    if (common)
        *common = shared;
    state->frames_since += state->frames_since < UINT32_MAX;
    if (!state->started) {
        cause = PF_KEYFRAME_FIRST;
    } else if (state->frames_since >= or_default(config->min_interval, 2)) {
        if (config->step_counts && encoder && state->have_encoder) {
            const uint64_t moved = *encoder > state->encoder ? (uint64_t)*encoder - (uint64_t)state->encoder
                                                             : (uint64_t)state->encoder - (uint64_t)*encoder;
            if (moved >= config->step_counts)
                cause = PF_KEYFRAME_ENCODER;
        } else {
            uint32_t median;
            if (median_chord2(state, tracks, rays, n, &median) &&
                median >= chord2_of_angle(or_default(config->parallax_urad, 174533)))
                cause = PF_KEYFRAME_PARALLAX;
        }
        if (cause == PF_KEYFRAME_NO && shared < (wanted < half ? wanted : half))
            cause = PF_KEYFRAME_FEW_COMMON;
    }
    if (cause != PF_KEYFRAME_NO)
        take_reference(state, tracks, rays, n, encoder);
    return cause;
}
