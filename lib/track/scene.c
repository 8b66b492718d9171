/* States of the scene: each flag has a condition to rise, a stricter or opposite one to fall, and a number of frames
 * for which either must hold. */
#include "pipefish/track.h"

#define HALF_PIXEL 32768u
#define FEW        12u /* tracks: fewer cannot tell a direction */
#define DARK       16u /* grey, 95th percentile */
#define LIT        28u
#define FLAT_RANGE 20u  /* grey, 5th to 95th percentile: a pipe's wall near and far differs by more */
#define FLAT_Q8    256u /* 1 grey between a pixel's neighbours at a quarter of the size; a PVC wall has 2 */
#define QUARTER    8192u
#define TENTH      3277u

typedef enum pf_vote { KEEP, RISE, FALL } pf_vote;

/* Frames that must agree, by flag: to rise, to fall. */
static const uint8_t patience[PF_SCENE_FLAGS][2] = {{5, 2}, {3, 3}, {2, 2}, {5, 3}, {3, 5}, {5, 5}, {10, 10}};

static pf_vote vote_on(bool rise, bool fall)
{
    return rise ? RISE : fall ? FALL : KEEP;
}

static uint32_t range(const pf_scene_measures *m)
{
    return m->high - m->low;
}

/* Since the last frame; a wheel's register may wrap. */
static int64_t counted(const pf_scene *s, const pf_scene_hints *h)
{
    return (int64_t)((uint64_t)h->encoder - (uint64_t)s->encoder);
}

/* Only where the flow has a direction along the radius: a roll has none. */
static pf_vote vote_encoder(const pf_scene *s, const pf_scene_measures *m, const pf_scene_hints *h)
{
    if (!h->has_encoder)
        return FALL;
    const bool ahead = 10u * m->outward >= 6u * m->moved, back = 10u * m->inward >= 6u * m->moved;
    const int64_t step = counted(s, h);
    if (!s->have_encoder || m->moved < FEW || ahead == back || m->motion_q16 < HALF_PIXEL)
        return KEEP;
    return vote_on(step == 0 ? s->still >= PF_SCENE_WINDOW : (step > 0) == back, step != 0 && (step > 0) == ahead);
}

static pf_vote vote_standing(const pf_scene *s, const pf_scene_measures *m, const pf_scene_hints *h)
{
    if (m->tracked < FEW)
        return h->has_encoder ? vote_on(s->still >= PF_SCENE_WINDOW, s->still == 0) : FALL;
    /* The window tells slow motion from none; a single frame tells that motion has begun. */
    return vote_on(m->motion_q16 < HALF_PIXEL && m->drift_q16 < HALF_PIXEL,
                   m->motion_q16 >= HALF_PIXEL || (m->drift_q16 >= HALF_PIXEL && m->drift_q16 != UINT32_MAX));
}

static pf_vote vote_reversing(const pf_scene *s, const pf_scene_measures *m, const pf_scene_hints *h)
{
    if (m->tracked < FEW) {
        if (!h->has_encoder || !s->have_encoder)
            return FALL;
        return vote_on(counted(s, h) < 0, counted(s, h) > 0 || s->still >= PF_SCENE_WINDOW);
    }
    if (m->moved < FEW)
        return s->flags & PF_SCENE_STANDING ? FALL : KEEP;
    return vote_on(10u * m->inward >= 6u * m->moved, 10u * m->inward < 4u * m->moved);
}

static pf_vote vote_weak(const pf_scene *s, const pf_scene_measures *m)
{
    if (s->flags & (PF_SCENE_DARK | PF_SCENE_COVERED | PF_SCENE_OVEREXPOSED))
        return FALL;
    return vote_on(m->tracked < m->enough || m->sextants < 4u, 4u * m->tracked >= 5u * m->enough && m->sextants >= 4u);
}

static void settle(pf_scene *s, uint32_t i, pf_vote vote)
{
    const uint32_t flag = 1u << i;
    const bool is_set = (s->flags & flag) != 0;
    if (vote == KEEP || (vote == RISE) == is_set) {
        s->count[i] = 0;
        return;
    }
    if (++s->count[i] < patience[i][is_set ? 1 : 0])
        return;
    s->flags ^= flag;
    s->count[i] = 0;
}

uint32_t pf_scene_update(pf_scene *s, const pf_scene_measures *m, const pf_scene_hints *h)
{
    const bool lamp_on = h->has_lamp && h->lamp_on;
    const bool is_dark = m->high < DARK, is_lit = m->high >= LIT;
    /* the noise of a high gain is texture too, but none that a track could follow */
    const bool is_flat =
        range(m) < FLAT_RANGE && m->saturated_q15 < TENTH && (m->texture_q8 < FLAT_Q8 || m->tracked < FEW);
    if (h->has_encoder && s->have_encoder)
        s->still = h->encoder == s->encoder ? s->still + (s->still < UINT32_MAX) : 0;
    settle(s, 2, vote_on(is_dark && !lamp_on, is_lit || lamp_on));
    settle(s, 3,
           vote_on(is_dark ? lamp_on : is_flat && is_lit,
                   is_dark
                       ? !lamp_on
                       : range(m) > FLAT_RANGE * 3u / 2u || (m->texture_q8 > FLAT_Q8 * 3u / 2u && m->tracked >= FEW)));
    settle(s, 4, vote_on(m->saturated_q15 >= QUARTER, m->saturated_q15 < QUARTER / 2u));
    settle(s, 0, vote_standing(s, m, h));
    settle(s, 1, vote_reversing(s, m, h));
    settle(s, 5, vote_weak(s, m));
    settle(s, 6, vote_encoder(s, m, h));
    s->have_encoder = h->has_encoder;
    s->encoder = h->encoder;
    return s->flags;
}
