/* Keyframe choice, in integers: the same bits on all targets. */
#include "track_private.h"

/* A reference taken in the dark shares nothing with anything: it goes when there are so many tracks again. */
#define OUTGROWN       2u
#define OUTGROWN_LEAST 16u

static uint32_t or_default(uint32_t value, uint32_t fallback)
{
    return value ? value : fallback;
}

static bool alive(const pf_track *track)
{
    return track->status == PF_TRACK_NEW || track->status == PF_TRACK_TRACKED;
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

uint32_t pf_value_of_rank(const uint32_t *value, uint32_t n, uint32_t k)
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
    pf_pairs pairs = {state, tracks, rays, n, 0, 0};
    uint32_t count = 0, i, j;
    int32_t r[9];
    while (next_common(&pairs, &i, &j))
        if (pf_ray_valid(&state->ray[i]) && pf_ray_valid(&rays[j])) {
            state->from[count] = state->ray[i];
            state->to[count++] = rays[j];
        }
    if (pf_rotation_fit(state->from, state->to, count, r) < PF_ROTATION_LEAST)
        return false;
    for (i = 0; i < count; i++) {
        pf_ray_q30 turned;
        pf_ray_rotate(r, &state->from[i], &turned);
        state->chord[i] = pf_ray_chord2(&turned, &state->to[i]);
    }
    *median = pf_value_of_rank(state->chord, count, count / 2u);
    return true;
}

/* 2 - 2 cos(angle) in Q2.30 by its series, within 3 LSB up to 1 rad; larger angles count as 1 rad. */
static uint32_t chord2_of_angle(uint32_t urad)
{
    const int64_t one = 1 << 30, a = (urad < 1000000u ? urad : 1000000u) * one / 1000000, q = (a * a) >> 30;
    int64_t v = one;
    for (int64_t k = 5; k >= 1; k--) /* the divisors 132, 90, 56, 30, 12 */
        v = one - ((q / ((2 * k + 1) * (2 * k + 2)) * v) >> 30);
    return (uint32_t)((q * v) >> 30);
}

static uint32_t count_common(const pf_keyframe_state *state, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n)
{
    pf_pairs pairs = {state, tracks, rays, n, 0, 0};
    uint32_t count = 0, i, j;
    while (next_common(&pairs, &i, &j))
        count++;
    return count;
}

static uint32_t count_alive(const pf_track *tracks, uint32_t n)
{
    uint32_t count = 0;
    for (uint32_t i = 0; i < n; i++)
        count += alive(&tracks[i]);
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
        if (cause == PF_KEYFRAME_NO &&
            (shared < (wanted < half ? wanted : half) || count_alive(tracks, n) > OUTGROWN * state->n + OUTGROWN_LEAST))
            cause = PF_KEYFRAME_FEW_COMMON;
    }
    if (cause != PF_KEYFRAME_NO)
        take_reference(state, tracks, rays, n, encoder);
    return cause;
}
