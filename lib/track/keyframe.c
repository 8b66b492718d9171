/* Keyframe choice, in integers: the same bits on all targets. */
#include "track_private.h"

/* A reference taken in the dark shares nothing with anything: it goes when there are so many tracks again. */
#define OUTGROWN       2u
#define OUTGROWN_LEAST 16u

#define YOUNG        2u  /* frames: noise of the sensor gives corners by the hundred, none of which lives so long */
#define WAIT_MOST    64u /* frames between keyframes for want of common tracks, where the reference was poor */
#define STATE_FRAMES 30u /* another state than the last keyframe's is a keyframe when it has lasted so long */

#define BLIND (PF_SCENE_DARK | PF_SCENE_COVERED | PF_SCENE_WEAK_TEXTURE)

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

/* Tracks that have lived long enough to be a reference. */
static uint32_t count_grown(const pf_track *tracks, uint32_t n)
{
    uint32_t count = 0;
    for (uint32_t i = 0; i < n; i++)
        count += alive(&tracks[i]) && tracks[i].age >= YOUNG;
    return count;
}

static void take_reference(pf_keyframe_state *state, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                           const int64_t *encoder, uint32_t scene)
{
    state->n = state->young = 0;
    for (uint32_t i = 0; i < n && state->n < state->max_tracks; i++)
        if (alive(&tracks[i])) {
            state->id[state->n] = tracks[i].id;
            state->ray[state->n++] = rays[i];
            state->young += tracks[i].age < YOUNG;
        }
    state->started = true;
    state->frames_since = state->differs = 0;
    state->scene = scene;
    state->have_encoder = encoder != NULL;
    state->encoder = encoder ? *encoder : 0;
}

/* What was young in the reference and is gone by now never was a landmark. Ids ascend, so the young are at the end. */
static void drop_young(pf_keyframe_state *state, const pf_track *tracks, uint32_t n)
{
    uint32_t kept = state->n - state->young;
    for (uint32_t i = kept, j = 0; i < state->n; i++) {
        while (j < n && tracks[j].id < state->id[i])
            j++;
        if (j < n && tracks[j].id == state->id[i] && alive(&tracks[j])) {
            state->id[kept] = state->id[i];
            state->ray[kept++] = state->ray[i];
        }
    }
    state->n = kept;
    state->young = 0;
}

static void watch(pf_keyframe_state *state, const int64_t *encoder, uint32_t scene)
{
    const bool stays = encoder && state->had_encoder && *encoder == state->encoder_before;
    state->still = stays ? state->still + (state->still < UINT32_MAX) : 0;
    state->had_encoder = encoder != NULL;
    state->encoder_before = encoder ? *encoder : 0;
    state->differs = scene != state->scene ? state->differs + (state->differs < UINT32_MAX) : 0;
    state->frames_since += state->frames_since < UINT32_MAX;
}

static uint64_t counts_between(int64_t a, int64_t b)
{
    return a > b ? (uint64_t)a - (uint64_t)b : (uint64_t)b - (uint64_t)a;
}

static bool is_far_enough(pf_keyframe_state *state, const pf_keyframe_config *config, const int64_t *encoder)
{
    return counts_between(*encoder, state->encoder) >= config->step_counts;
}

/* Counts until `counts` of them are reached or passed, `frame` a frame, in `frames` at the earliest. */
static uint64_t in_whole_frames(uint64_t counts, uint64_t frame, uint64_t frames)
{
    const uint64_t needed = frame ? (counts + frame - 1u) / frame : 0;
    return frame ? (needed > frames ? needed : frames) * frame : counts;
}

uint64_t pf_keyframe_third(const pf_keyframe_state *state, const pf_keyframe_config *config, int64_t encoder)
{
    if (!state->started || !state->have_encoder || !state->had_encoder || config->step_counts == 0)
        return 0;
    const uint64_t driven = counts_between(encoder, state->encoder), step = config->step_counts;
    const uint64_t frame = counts_between(encoder, state->encoder_before);
    if (frame > PF_COUNTS_MOST)
        return 0;
    const uint32_t apart = or_default(config->min_interval, 2), since = state->frames_since + 1u;
    return in_whole_frames(driven < step ? step - driven : 0, frame, since < apart ? apart - since : 0) +
           2u * in_whole_frames(step, frame, apart);
}

/* A poor reference is no measure: replaced by another as poor at once, it would be a keyframe every other frame. */
static bool lacks_common(pf_keyframe_state *state, const pf_keyframe_config *config, const pf_track *tracks, uint32_t n,
                         uint32_t shared, uint32_t scene)
{
    const uint32_t wanted = or_default(config->min_common, 100), grown = state->n - state->young, half = grown / 2u;
    const bool is_poor = grown < wanted, stands = state->still >= PF_SCENE_WINDOW;
    if ((scene & BLIND) || (is_poor && (stands || state->frames_since < state->wait)))
        return false;
    if (shared >= (wanted < half ? wanted : half) && count_grown(tracks, n) <= OUTGROWN * grown + OUTGROWN_LEAST)
        return false;
    if (!is_poor)
        state->wait = 0;
    else
        state->wait = state->wait == 0 ? 4u : state->wait < WAIT_MOST ? 2u * state->wait : WAIT_MOST;
    return true;
}

pf_keyframe_cause pf_keyframe_decide(pf_keyframe_state *state, const pf_keyframe_config *config, const pf_track *tracks,
                                     const pf_ray_q30 *rays, uint32_t n, const int64_t *encoder, uint32_t scene,
                                     uint32_t *common)
{
    pf_keyframe_cause cause = PF_KEYFRAME_NO;
    watch(state, encoder, scene);
    if (state->frames_since == YOUNG)
        drop_young(state, tracks, n);
    const uint32_t shared = state->started ? count_common(state, tracks, rays, n) : 0;
    if (common)
        *common = shared;
    if (!state->started) {
        cause = PF_KEYFRAME_FIRST;
    } else if (state->frames_since >= or_default(config->min_interval, 2)) {
        const bool counts = config->step_counts && encoder && state->have_encoder;
        uint32_t median;
        if (counts && is_far_enough(state, config, encoder))
            cause = PF_KEYFRAME_ENCODER;
        /* an encoder that stands while the picture moves is stuck */
        else if ((!counts || state->still >= PF_SCENE_WINDOW) && median_chord2(state, tracks, rays, n, &median) &&
                 median >= chord2_of_angle(or_default(config->parallax_urad, 174533)))
            cause = PF_KEYFRAME_PARALLAX;
        else if (lacks_common(state, config, tracks, n, shared, scene))
            cause = PF_KEYFRAME_FEW_COMMON;
        else if (state->differs >= STATE_FRAMES)
            cause = PF_KEYFRAME_STATE;
    }
    if (cause != PF_KEYFRAME_NO)
        take_reference(state, tracks, rays, n, encoder, scene);
    return cause;
}

pf_status pf_keyframe_init(pf_keyframe_state *state, uint32_t max_tracks, void *workspace, size_t size)
{
    if (max_tracks == 0 || max_tracks > PF_TRACKS_MAX)
        return PF_ERR_ARGUMENT;
    if (size < PF_KEYFRAME_BYTES(max_tracks))
        return PF_ERR_SPACE;
    *state = (pf_keyframe_state){.max_tracks = max_tracks, .id = workspace};
    state->ray = (pf_ray_q30 *)(state->id + max_tracks);
    state->from = state->ray + max_tracks;
    state->to = state->from + max_tracks;
    state->chord = (uint32_t *)(state->to + max_tracks);
    return PF_OK;
}

void pf_keyframe_reset(pf_keyframe_state *state)
{
    state->started = false;
    state->n = state->young = state->still = state->wait = 0;
    state->had_encoder = false;
}
