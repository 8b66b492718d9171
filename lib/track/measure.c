/* What a frame tells of the scene: light, contrast and motion, from a small level of the pyramid and from the tracks.
 */
#include "tracker_private.h"

#define LEVEL  2u /* of the pyramid: noise of sigma 2 is 0.3 there */
#define BRIGHT 250u
#define LEAST  8u   /* tracks that a median needs */
#define MOVED  8192 /* 1/8 px: less is no direction */
#define ENOUGH 60u  /* tracks, RECONSTRUCTION section 5 */

/* Columns [*first, *last] of row `y` inside the circle at `level`; empty if first > last. */
static void lit_span(const pf_tracker *t, const pf_image *image, uint32_t level, int64_t y, int64_t *first,
                     int64_t *last)
{
    *first = 1;
    *last = (int64_t)image->width - 2;
    if (!t->config.circle_radius_q16)
        return;
    const int64_t r = (int64_t)(t->config.circle_radius_q16 >> level >> 16) - 2;
    const int64_t dy = y - (t->config.circle.y >> level >> 16), cx = t->config.circle.x >> level >> 16;
    const int64_t room = r * r - dy * dy;
    if (r <= 0 || room < 0) {
        *last = 0;
        return;
    }
    const int64_t reach = pf_isqrt64((uint64_t)room);
    *first = cx - reach > *first ? cx - reach : *first;
    *last = cx + reach < *last ? cx + reach : *last;
}

static uint32_t percentile(const uint32_t *histogram, uint32_t n, uint32_t percent)
{
    uint64_t below = 0;
    for (uint32_t v = 0; v < 256u; v++) {
        below += histogram[v];
        if (below * 100u > (uint64_t)n * percent)
            return v;
    }
    return 255;
}

static void measure_light(const pf_tracker *t, pf_scene_measures *m)
{
    const uint32_t level = t->config.levels > LEVEL ? LEVEL : t->config.levels - 1u;
    const pf_image *image = &t->pyramid[t->now].level[level];
    uint32_t histogram[256] = {0};
    uint64_t sum = 0, texture = 0;
    for (uint32_t y = 0; y < image->height; y += 2u) {
        const uint8_t *row = image->data + (size_t)y * image->stride;
        const pf_block *blocks = t->block + (size_t)((y << level) / BLOCK) * t->block_w;
        int64_t first, last;
        lit_span(t, image, level, y, &first, &last);
        for (int64_t x = first; x <= last; x++) {
            if (blocks[(size_t)(x << level) / BLOCK].is_masked)
                continue;
            histogram[row[x]]++;
            texture += (uint32_t)(row[x + 1] > row[x - 1] ? row[x + 1] - row[x - 1] : row[x - 1] - row[x + 1]);
        }
    }
    for (uint32_t v = 0; v < 256u; v++) {
        m->pixels += histogram[v];
        sum += (uint64_t)histogram[v] * v;
        m->saturated_q15 += v >= BRIGHT ? histogram[v] : 0u;
    }
    if (m->pixels == 0)
        return;
    m->mean_q8 = (uint32_t)(sum * 256u / m->pixels);
    m->texture_q8 = (uint32_t)(texture * 256u / m->pixels);
    m->saturated_q15 = (uint32_t)((uint64_t)m->saturated_q15 * 32768u / m->pixels);
    m->low = percentile(histogram, m->pixels, 5);
    m->median = percentile(histogram, m->pixels, 50);
    m->high = percentile(histogram, m->pixels, 95);
}

/* Which sixth of the picture (dx, dy) lies in: sectors of 60 degrees; tan 60 = 1.732. */
static uint32_t sextant_of(int64_t dx, int64_t dy)
{
    const int64_t ax = dx < 0 ? -dx : dx, ay = dy < 0 ? -dy : dy;
    if (1000 * ay < 1732 * ax)
        return dx > 0 ? (dy >= 0 ? 0u : 5u) : (dy >= 0 ? 2u : 3u);
    return dy > 0 ? 1u : 4u;
}

static uint32_t length_q16(int64_t dx, int64_t dy)
{
    return pf_isqrt64((uint64_t)(dx * dx + dy * dy));
}

/* A vote on the direction of the flow: along the radius to within 45 degrees. */
static void vote(pf_scene_measures *m, pf_point_q16 radius, pf_point_q16 move)
{
    const int64_t rx = radius.x >> 8, ry = radius.y >> 8, dot = rx * move.x + ry * move.y;
    const int64_t cross = rx * move.y - ry * move.x, along = dot < 0 ? -dot : dot, across = cross < 0 ? -cross : cross;
    if (length_q16(move.x, move.y) < MOVED)
        return;
    m->moved++;
    m->outward += dot > 0 && along >= across;
    m->inward += dot < 0 && along >= across;
}

static uint32_t median_of(const pf_tracker *t, uint32_t n)
{
    return n ? pf_value_of_rank(t->value, n, n / 2u) : 0u;
}

/* Median displacement since the window began, when it is over; and the beginning of the next. */
static void measure_drift(pf_tracker *t)
{
    uint32_t n = 0;
    if (++t->frame < PF_SCENE_WINDOW)
        return;
    t->frame = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        if (t->table[i].status != PF_TRACK_TRACKED)
            continue;
        pf_slot *s = &t->slots[t->slot_of[i]];
        if (t->table[i].age >= PF_SCENE_WINDOW)
            t->value[n++] = length_q16((int64_t)t->table[i].pos.x - s->from.x, (int64_t)t->table[i].pos.y - s->from.y);
        s->from = t->table[i].pos;
    }
    t->drift_q16 = n < LEAST ? UINT32_MAX : median_of(t, n);
}

static void measure_tracks(pf_tracker *t, pf_scene_measures *m)
{
    const pf_point_q16 centre = pf_flow_centre(t);
    uint32_t n = 0, seen = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        if (t->table[i].status != PF_TRACK_TRACKED)
            continue;
        const pf_point_q16 p = t->table[i].pos, move = t->slots[t->slot_of[i]].move;
        const pf_point_q16 radius = {p.x - centre.x, p.y - centre.y};
        seen |= 1u << sextant_of(radius.x, radius.y);
        vote(m, radius, move);
        t->value[n++] = length_q16(move.x, move.y);
    }
    m->tracked = n;
    m->enough = t->config.max_tracks / 4u < ENOUGH ? t->config.max_tracks / 4u : ENOUGH;
    for (; seen; seen &= seen - 1u)
        m->sextants++;
    m->motion_q16 = n < LEAST ? 0u : median_of(t, n);
    n = 0;
    for (uint32_t i = 0; i < t->n; i++)
        if (t->table[i].status == PF_TRACK_TRACKED)
            t->value[n++] = t->table[i].age;
    t->stats.age_median = median_of(t, n);
    n = 0;
    for (uint32_t i = 0; i < t->n; i++)
        if (t->table[i].status == PF_TRACK_TRACKED)
            t->value[n++] = t->table[i].quality;
    t->stats.quality_median = median_of(t, n);
}

void pf_scene_measure(pf_tracker *t)
{
    pf_scene_measures *m = &t->stats.scene;
    measure_light(t, m);
    measure_tracks(t, m);
    measure_drift(t);
    m->drift_q16 = t->drift_q16;
}
