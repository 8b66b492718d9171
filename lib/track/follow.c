/* Live tracks in a new frame: where to look, what to believe. */
#include <string.h>

#include "tracker_private.h"

/* A template is renewed when its warp has moved this far from identity: the affine model then leaves, at the edge of a
 * 21-pixel window, second-order terms of a few tenths of a pixel on a pipe's wall. */
#define RENEW       (65536 / 5)
#define PULL_MAX    (3 << 16) /* the template may move a track by 3 px from where half resolution put it */
#define FADED       29491     /* 0.9 */
#define DRIFT_SLACK 3277      /* the template may look 0.1 less similar than the previous patch */
#define WALL_SLACK  6554      /* 0.2 */
#define CERTAIN     (2 << 16) /* a track found this near its start is next sought from half resolution on */
#define GUESS_MOST  (4096 << 16)
#define SAME_START  (4 << 16) /* starts closer than 4 px are the same to the coarse levels */
/* 3/8 px: the two starts of a warped template differ by 0.8 px. A small mark pulls no farther. */
#define WARPED_APART 24576
#define STARTS       3
#define COARSE       2u /* level at which starts are compared: a pixel of it is 4 px */
#define COARSE_HALF  5
#define MARGIN       1638      /* 0.05 of similarity */
#define FLOW_LEAST   8u        /* tracks in a ring before its median is believed */
#define NEAR_LEAST   5u        /* of those within 45 degrees */
#define NEAR_PART    16        /* a sector at less than this part of its ring's pace does not count */
#define FLOW_STIRS   (4 << 16) /* a ring that has moved 4 px */
#define STILL_PART   4         /* a track that has made less than a quarter (half, across) of that way stands still */
#define NEIGHBOURS   3
/* Sums of both variances, px^2 Q20. Beyond 0.4 px a track is no longer known well enough that this is the point first
 * seen. Beyond 0.25 px it is lost where that is 8 times what it was at first sight: its marks have faded, been drawn
 * out, or no longer explain what is seen; with relief in a light that moves errors are then several times what is
 * stated. The ratio tells wrong places from right ones better than the deviation itself: the strongest marks of brick,
 * and beads of water on clay, are relief. */
#define VAGUE       167772u
#define WORN        65536u
#define WORSE       8u
#define CLIP_CHANGE 20u /* a twentieth of the window: with it the worst is at 5 sigma */

static int32_t median3(int32_t a, int32_t b, int32_t c)
{
    const int32_t low = a < b ? a : b, high = a < b ? b : a;
    return c < low ? low : c > high ? high : c;
}

/* Medians over the nearest tracks already found in this frame: of their displacements, and of how far they lay from
 * where they were expected (0, 0 where one of them was not expected anywhere). False with fewer than three. */
static bool look_around(const pf_tracker *t, pf_point_q16 at, pf_point_q16 *move, pf_point_q16 *miss)
{
    int64_t distance[NEIGHBOURS];
    const pf_slot *near[NEIGHBOURS];
    uint32_t n = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        if (t->table[i].status != PF_TRACK_TRACKED)
            continue;
        const pf_slot *s = &t->slots[t->slot_of[i]];
        const pf_point_q16 m = s->move, p = t->table[i].pos;
        const int64_t dx = (int64_t)p.x - m.x - at.x, dy = (int64_t)p.y - m.y - at.y, d = dx * dx + dy * dy;
        uint32_t k = n < NEIGHBOURS ? n++ : NEIGHBOURS;
        if (k == NEIGHBOURS && d >= distance[NEIGHBOURS - 1])
            continue;
        for (k = k == NEIGHBOURS ? NEIGHBOURS - 1 : k; k > 0 && distance[k - 1] > d; k--) {
            distance[k] = distance[k - 1];
            near[k] = near[k - 1];
        }
        distance[k] = d;
        near[k] = s;
    }
    if (n < NEIGHBOURS)
        return false;
    *move = (pf_point_q16){median3(near[0]->move.x, near[1]->move.x, near[2]->move.x),
                           median3(near[0]->move.y, near[1]->move.y, near[2]->move.y)};
    *miss = (pf_point_q16){median3(near[0]->miss.x, near[1]->miss.x, near[2]->miss.x),
                           median3(near[0]->miss.y, near[1]->miss.y, near[2]->miss.y)};
    return true;
}

static bool farther(pf_point_q16 a, pf_point_q16 b, int64_t reach)
{
    const int64_t dx = (int64_t)a.x - b.x, dy = (int64_t)a.y - b.y;
    return dx * dx + dy * dy > reach * reach;
}

int32_t pf_guess_clamp(int64_t v, uint32_t size)
{
    const int64_t margin = 64 << 16, most = ((int64_t)size << 16) + margin;
    return (int32_t)(v < -margin ? -margin : v > most ? most : v);
}

/* --- where to look ----------------------------------------------------------------------------------------------- */

/* How alike the surroundings of `from` in the last frame and of `to` in this one are at a coarse level, Q0.15; -32768
 * where they are not in the picture. Whole pixels: at that level a few pixels of the frame. */
static int32_t coarse_likeness(const pf_tracker *t, pf_point_q16 from, pf_point_q16 to)
{
    const uint32_t level = t->config.levels > COARSE ? COARSE : t->config.levels - 1u;
    const pf_image *a = &t->pyramid[1u - t->now].level[level], *b = &t->pyramid[t->now].level[level];
    const int32_t half_pixel = 1 << (15 + level), shift = 16 + (int32_t)level;
    const int32_t ax = ((from.x + half_pixel) >> shift) - COARSE_HALF,
                  ay = ((from.y + half_pixel) >> shift) - COARSE_HALF;
    const int32_t bx = ax + ((to.x - from.x + half_pixel) >> shift), by = ay + ((to.y - from.y + half_pixel) >> shift);
    const int32_t side = 2 * COARSE_HALF + 1, w = (int32_t)a->width - side, h = (int32_t)a->height - side;
    int64_t sa = 0, sb = 0, saa = 0, sbb = 0, sab = 0;
    if (ax < 0 || ay < 0 || bx < 0 || by < 0 || ax > w || ay > h || bx > w || by > h)
        return -32768;
    for (int32_t y = 0; y < side; y++) {
        const uint8_t *p = a->data + (size_t)(ay + y) * a->stride + (size_t)ax;
        const uint8_t *q = b->data + (size_t)(by + y) * b->stride + (size_t)bx;
        int32_t ra = 0, rb = 0, raa = 0, rbb = 0, rab = 0;
        for (int32_t x = 0; x < side; x++) {
            ra += p[x];
            rb += q[x];
            raa += p[x] * p[x];
            rbb += q[x] * q[x];
            rab += p[x] * q[x];
        }
        sa += ra, sb += rb, saa += raa, sbb += rbb, sab += rab;
    }
    const int64_t n = side * side;
    return pf_zncc(32 * (n * sab - sa * sb), 32 * (n * saa - sa * sa), 32 * (n * sbb - sb * sb));
}

/* The starts for a track, best first: its own last move (`around`, its neighbours', if it is new), what is expected,
 * and none at all. A start must look better by a margin to go before one earlier in this list. Returns how many. */
static uint32_t rank_starts(const pf_tracker *t, const pf_track *track, const pf_slot *slot, pf_point_q16 around,
                            pf_point_q16 start[STARTS])
{
    const pf_point_q16 at = track->pos, none = {0, 0};
    pf_point_q16 move = slot->move, given = {0, 0};
    uint32_t n = 0;
    if (track->age == 0 && slot->expected.at.x == PF_NO_GUESS)
        move = around;
    start[n++] = move;
    if (slot->expected.at.x != PF_NO_GUESS) {
        given = (pf_point_q16){pf_clamp_i64((int64_t)slot->expected.at.x - at.x, GUESS_MOST),
                               pf_clamp_i64((int64_t)slot->expected.at.y - at.y, GUESS_MOST)};
        if (farther(given, move, SAME_START))
            start[n++] = given;
    }
    if (farther(none, start[0], SAME_START) && (n < 2u || farther(none, start[1], SAME_START)))
        start[n++] = none;
    if (n == 1u)
        return n;
    int32_t like[STARTS];
    for (uint32_t i = 0; i < n; i++) {
        const pf_point_q16 to = {pf_guess_clamp((int64_t)at.x + start[i].x, t->config.width),
                                 pf_guess_clamp((int64_t)at.y + start[i].y, t->config.height)};
        like[i] = coarse_likeness(t, at, to) - (int32_t)i * MARGIN;
    }
    for (uint32_t i = 1; i < n; i++)
        for (uint32_t k = i; k > 0 && like[k] > like[k - 1u]; k--) {
            const int32_t l = like[k];
            const pf_point_q16 s = start[k];
            like[k] = like[k - 1u];
            like[k - 1u] = l;
            start[k] = start[k - 1u];
            start[k - 1u] = s;
        }
    return n;
}

/* Whether too much of a window is clipped, or much more or less than of its template: what is clipped in one of them
 * only has a shape of its own, and pulls by up to half a pixel. Where the wall is looked after that is no reason: on
 * PVC a third to a half of what was lost was in its place, beside the glare. */
static bool is_clipped(const pf_tracker *t, uint32_t now, uint32_t before)
{
    const uint32_t area = t->config.window * t->config.window, change = now > before ? now - before : before - now;
    return CLIPPED * now > area || (!t->config.has_wall && CLIP_CHANGE * change > area);
}

/* What a track must pass wherever it was found: `fit` of its template, `clipped` pixels of it clipped, in the new frame
 * at `fine`. */
static pf_track_reason believe(const pf_tracker *t, const pf_fit *fit, pf_point_q16 fine, int32_t least_q15,
                               uint32_t clipped)
{
    const pf_image *image = &t->pyramid[t->now].level[0];
    if (fit->reason != PF_TRACK_OK)
        return fit->reason;
    if (fit->zncc_q15 < least_q15)
        return PF_TRACK_DRIFT;
    if (!pf_klt_inside(&t->klt, image, fine))
        return PF_TRACK_LEFT;
    if (!pf_mask_allows(t, fine))
        return PF_TRACK_MASKED;
    if (is_clipped(t, pf_mask_clipped(t, image, fine), clipped))
        return PF_TRACK_SATURATED;
    if (pf_grid_near(t, fine, (int64_t)t->config.cell << 14))
        return PF_TRACK_CROWDED;
    return PF_TRACK_OK;
}

/* Where the wall is looked after, a patch may look less alike and lie farther from where the way back leads: at the rim
 * of clay and plastic most of what was lost for that was in its place. */
static int32_t least_likeness(const pf_tracker *t)
{
    return (int32_t)t->config.min_zncc_q15 - (t->config.has_wall ? WALL_SLACK : 0);
}

static int64_t most_apart(const pf_tracker *t)
{
    return (int64_t)t->config.fb_q16 * (t->config.has_wall ? 2 : 1);
}

/* Whether the template has had its time: its shape has changed, or, where the wall is looked after, its likeness fades.
 * At the rim of a clay pipe, where the lamp's image comes up under a patch, it is still alike from frame to frame when
 * it is not like its first sight any more. */
static bool is_worn(const pf_tracker *t, const pf_anchor *anchor, int32_t likeness)
{
    for (int32_t k = 0; k < 4; k++) {
        const int32_t d = anchor->a[k] - (k == 0 || k == 3 ? 65536 : 0);
        if (d > RENEW || d < -RENEW)
            return true;
    }
    return t->config.has_wall && likeness < FADED;
}

/* Brings a track and its slot up to date: found at `fine`. */
static void accept(pf_tracker *t, pf_track *track, uint16_t slot, pf_point_q16 fine, const pf_fit *anchored,
                   int32_t quality)
{
    pf_slot *s = &t->slots[slot];
    const pf_image *image = &t->pyramid[t->now].level[0];
    int64_t carried[3];
    s->move = (pf_point_q16){fine.x - track->pos.x, fine.y - track->pos.y};
    track->pos = fine;
    track->quality = (uint16_t)quality;
    pf_anchor_covariance(&s->anchor, t->config.noise_q8, anchored->gain_q14, track);
    if (!is_worn(t, &s->anchor, anchored->zncc_q15))
        return;
    pf_anchor_carry(&s->anchor, t->config.noise_q8, carried);
    pf_anchor_take(&t->klt, image, fine, &s->anchor, t->pixels + (size_t)slot * t->patch_bytes);
    memcpy(s->anchor.carried, carried, sizeof carried);
    s->clipped = pf_mask_clipped(t, image, fine);
}

/* One attempt at one track from one guess; on success `track` and its slot are up to date. *reached gets how far the
 * coarse levels came, from level `top` to level `last`. The template is fitted at full resolution; the way back from
 * there to the last frame is one level, started where it should end. */
static pf_track_reason attempt(pf_tracker *t, pf_track *track, uint16_t slot, pf_point_q16 move, uint32_t top,
                               uint32_t last, pf_point_q16 *reached)
{
    const pf_pyramid *from = &t->pyramid[1u - t->now], *to = &t->pyramid[t->now];
    const pf_point_q16 old = track->pos;
    const pf_point_q16 guess = {pf_guess_clamp((int64_t)old.x + move.x, t->config.width),
                                pf_guess_clamp((int64_t)old.y + move.y, t->config.height)};
    pf_point_q16 at = guess;
    const pf_fit coarse = pf_klt_track(&t->klt, from, to, old, &at, top, last);
    *reached = at;
    if (last == 0 && coarse.reason != PF_TRACK_OK)
        return coarse.reason;
    if (!pf_klt_inside(&t->klt, &to->level[0], at))
        return PF_TRACK_LEFT;
    pf_slot *s = &t->slots[slot];
    const pf_anchor saved = s->anchor;
    pf_point_q16 fine = at, back = old;
    const pf_fit anchored =
        pf_anchor_fit(&t->klt, &to->level[0], &s->anchor, t->pixels + (size_t)slot * t->patch_bytes, &fine);
    pf_fit fit = {anchored.reason, 0, GAIN_ONE};
    if (anchored.reason == PF_TRACK_OK)
        fit = pf_klt_track(&t->klt, to, from, fine, &back, 0, 0);
    pf_track_reason reason = fit.reason;
    if (reason == PF_TRACK_OK && fit.zncc_q15 < least_likeness(t))
        reason = PF_TRACK_RESIDUAL;
    if (reason == PF_TRACK_OK && farther(back, old, most_apart(t)))
        reason = PF_TRACK_BACKWARD;
    if (reason == PF_TRACK_OK && farther(fine, at, PULL_MAX))
        reason = PF_TRACK_DRIFT;
    if (reason == PF_TRACK_OK)
        reason = believe(t, &anchored, fine, least_likeness(t) - DRIFT_SLACK, s->clipped);
    if (reason == PF_TRACK_OK) {
        s->sure = !farther(fine, guess, CERTAIN);
        accept(t, track, slot, fine, &anchored, fit.zncc_q15);
    } else {
        s->anchor = saved;
    }
    return reason;
}

/* The anchor with its warp taken on by `warp`. */
static pf_anchor warped_by(const pf_anchor *before, const int32_t warp[4])
{
    pf_anchor a = *before;
    for (int32_t i = 0; i < 2; i++)
        for (int32_t j = 0; j < 2; j++)
            a.a[2 * i + j] = pf_clamp_i64(
                ((int64_t)warp[2 * i] * before->a[j] + (int64_t)warp[2 * i + 1] * before->a[2 + j]) >> 16, WARP_MOST);
    return a;
}

/* The template's fit from `start` with its warp taken on by `warp`. */
static pf_fit fit_warped(pf_tracker *t, uint16_t slot, const pf_anchor *before, const int32_t warp[4],
                         pf_point_q16 *start)
{
    pf_anchor *a = &t->slots[slot].anchor;
    *a = warped_by(before, warp);
    return pf_anchor_fit(&t->klt, &t->pyramid[t->now].level[0], a, t->pixels + (size_t)slot * t->patch_bytes, start);
}

/* For a patch that has changed too much from frame to frame: its template, with the warp that is expected, from where
 * the coarse levels came to. There is no way back to check: instead it must look like the template as much as a patch
 * must like the last frame's, and be found at the same place from two starts. */
static pf_track_reason attempt_warped(pf_tracker *t, pf_track *track, uint16_t slot, const int32_t warp[4],
                                      pf_point_q16 reached)
{
    const pf_anchor saved = t->slots[slot].anchor;
    pf_point_q16 one = {reached.x + WARPED_APART, reached.y},
                 two = {reached.x - WARPED_APART, reached.y + WARPED_APART};
    const pf_fit first = fit_warped(t, slot, &saved, warp, &one);
    pf_track_reason reason = first.reason;
    if (reason == PF_TRACK_OK) {
        const pf_fit second = fit_warped(t, slot, &saved, warp, &two);
        reason = believe(t, &second, two, least_likeness(t), t->slots[slot].clipped);
        if (reason == PF_TRACK_OK && farther(one, two, most_apart(t)))
            reason = PF_TRACK_DIVERGED;
        if (reason == PF_TRACK_OK) {
            t->slots[slot].sure = false;
            accept(t, track, slot, two, &second, second.zncc_q15);
        }
    }
    if (reason != PF_TRACK_OK)
        t->slots[slot].anchor = saved;
    return reason;
}

/* --- what to believe --------------------------------------------------------------------------------------------- */

pf_point_q16 pf_flow_centre(const pf_tracker *t)
{
    if (t->config.circle_radius_q16)
        return t->config.circle;
    return (pf_point_q16){(int32_t)(t->config.width << 15), (int32_t)(t->config.height << 15)};
}

/* Length along its radius of a track's last move, outward positive, Q16 px; and the polar cell that it is in. */
static int32_t radial_move(const pf_tracker *t, uint32_t row, uint32_t *cell)
{
    const pf_point_q16 centre = pf_flow_centre(t), p = t->table[row].pos, move = t->slots[t->slot_of[row]].move;
    const int64_t x = ((int64_t)p.x - centre.x) >> 8, y = ((int64_t)p.y - centre.y) >> 8;
    const int64_t r = pf_isqrt64((uint64_t)(x * x + y * y)) + 1u; /* Q8 */
    const uint32_t side = t->config.width < t->config.height ? t->config.width : t->config.height;
    const int64_t reach = t->config.circle_radius_q16 ? t->config.circle_radius_q16 >> 8 : (int64_t)side << 7;
    *cell = (r < reach ? (uint32_t)(r * RINGS / reach) : RINGS - 1u) * SECTORS + pf_sector_of(x, y);
    return (int32_t)((x * move.x + y * move.y) / r);
}

/* The median radial move of the tracks in a ring, within `reach` sectors of `sector`; 0 with fewer than `least`. */
static int32_t median_flow(const pf_tracker *t, uint32_t ring, uint32_t sector, uint32_t reach, uint32_t least)
{
    uint32_t n = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        const uint32_t apart = (t->cell_of[i] % SECTORS + SECTORS - sector) % SECTORS;
        if (t->table[i].status == PF_TRACK_TRACKED && t->cell_of[i] / SECTORS == ring &&
            (apart <= reach || apart >= SECTORS - reach))
            t->value[n++] = (uint32_t)((int64_t)t->radial[i] + ((int64_t)1 << 31));
    }
    return n < least ? 0 : (int32_t)((int64_t)pf_value_of_rank(t->value, n, n / 2u) - ((int64_t)1 << 31));
}

/* What tracks in each polar cell should move by along the radius: the median of the ring within 45 degrees. On the
 * tube's axis the azimuth would not matter; low above the invert the crown moves at an eighth of the invert's pace.
 * Where too few tracks are near, or they hardly move (dirt may fill a sector), the whole ring's. */
static void measure_flow(const pf_tracker *t, int32_t flow[RINGS * SECTORS])
{
    for (uint32_t ring = 0; ring < RINGS; ring++) {
        const int32_t whole = median_flow(t, ring, 0, SECTORS, FLOW_LEAST);
        for (uint32_t sector = 0; sector < SECTORS; sector++) {
            const int32_t near = median_flow(t, ring, sector, 1, NEAR_LEAST);
            const int64_t size = near < 0 ? -(int64_t)near : near, most = whole < 0 ? -(int64_t)whole : whole;
            flow[ring * SECTORS + sector] = NEAR_PART * size > most ? near : whole;
        }
    }
}

/* Sums with forgetting, over some 8 frames. */
static int32_t forget_and_add(int32_t sum, int32_t more)
{
    return pf_clamp_i64((int64_t)sum - sum / 8 + more, 1 << 24);
}

/* Whether the track has stood still, or nearly, while those around it have moved on. */
static bool stands_still(pf_slot *s, int32_t radial, int32_t flow)
{
    s->own = (pf_point_q16){forget_and_add(s->own.x, s->move.x), forget_and_add(s->own.y, s->move.y)};
    s->radial = forget_and_add(s->radial, radial);
    s->flow = forget_and_add(s->flow, flow);
    const int64_t whole = s->flow < 0 ? -(int64_t)s->flow : s->flow;
    const int64_t along = s->flow < 0 ? -(int64_t)s->radial : s->radial;
    return whole > FLOW_STIRS && STILL_PART * along < whole && !farther(s->own, (pf_point_q16){0, 0}, whole / 2);
}

static void lose(pf_tracker *t, uint32_t row, pf_track_reason reason)
{
    t->table[row].status = PF_TRACK_LOST;
    t->table[row].reason = (uint8_t)reason;
    t->spare[t->spare_n++] = t->slot_of[row];
    t->stats.lost++;
    t->stats.lost_by[reason]++;
}

/* Tracks that stick to something that goes with the camera are lost; what they stick to is masked. */
static void drop_stuck(pf_tracker *t)
{
    int32_t flow[RINGS * SECTORS];
    for (uint32_t i = 0; i < t->n; i++)
        if (t->table[i].status == PF_TRACK_TRACKED)
            t->radial[i] = radial_move(t, i, &t->cell_of[i]);
    measure_flow(t, flow);
    for (uint32_t i = 0; i < t->n; i++)
        if (t->table[i].status == PF_TRACK_TRACKED &&
            stands_still(&t->slots[t->slot_of[i]], t->radial[i], flow[t->cell_of[i]])) {
            lose(t, i, PF_TRACK_STATIC);
            pf_mask_condemn(t, t->table[i].pos);
            t->stats.tracked--;
            t->stats.live--;
        }
}

void pf_tracker_give_up(pf_tracker *tracker, const uint16_t *rows, uint32_t n)
{
    for (uint32_t i = 0; i < n; i++) {
        if (rows[i] >= tracker->n || tracker->table[rows[i]].status == PF_TRACK_LOST)
            continue;
        tracker->stats.live--;
        if (tracker->table[rows[i]].status == PF_TRACK_TRACKED)
            tracker->stats.tracked--;
        lose(tracker, rows[i], PF_TRACK_DRIFT);
    }
}

/* Whether another start may help: it cannot where the patch itself is the reason. */
static bool worth_another(pf_track_reason reason)
{
    return reason == PF_TRACK_LEFT || reason == PF_TRACK_DIVERGED || reason == PF_TRACK_RESIDUAL ||
           reason == PF_TRACK_BACKWARD || reason == PF_TRACK_DRIFT || reason == PF_TRACK_FLAT;
}

static bool has_warp(const pf_expected *e)
{
    return e->at.x != PF_NO_GUESS &&
           (e->warp_q16[0] != 65536 || e->warp_q16[1] != 0 || e->warp_q16[2] != 0 || e->warp_q16[3] != 65536);
}

/* Takes one of the frame's further attempts; false if there are none left. */
static bool may_try(pf_tracker *t)
{
    if (t->extra == 0)
        return false;
    t->extra--;
    return true;
}

/* The same from where around its expected place the warped template looks most like the picture: a mark of a few pixels
 * on bare plastic pulls from no farther than its own size, and at 40 cm/s in 150 mm every tenth is expected 1.4 px off.
 */
static bool attempt_searched(pf_tracker *t, pf_track *track, uint16_t slot, const pf_expected *expected)
{
    if (!may_try(t))
        return false;
    const pf_anchor warped = warped_by(&t->slots[slot].anchor, expected->warp_q16);
    const pf_point_q16 at = pf_anchor_search(&t->klt, &t->pyramid[t->now].level[0], &warped,
                                             t->pixels + (size_t)slot * t->patch_bytes, expected->at);
    return farther(at, expected->at, 0) && attempt_warped(t, track, slot, expected->warp_q16, at) == PF_TRACK_OK;
}

/* Attempts at one track, each only if those before it failed: by its template, warped as is expected, from where it is
 * expected and from where around it looks most like it; from half resolution or the top of the pyramid, without a warp;
 * by its warped template from where that came to; from the other starts; in a slow drive too by its template where it
 * is expected, if it is not that the way back led elsewhere (at the rim of a brick pipe and beside beads of water a
 * patch changes too much from frame to frame, and is the same still); from where its neighbours went. */
static pf_track_reason seek(pf_tracker *t, pf_track *track, uint16_t slot, const pf_point_q16 *around)
{
    const pf_expected expected = t->slots[slot].expected;
    const bool warped = has_warp(&expected);
    pf_point_q16 start[STARTS], reached, other;
    pf_track_reason reason;
    if (warped && attempt_warped(t, track, slot, expected.warp_q16, expected.at) == PF_TRACK_OK)
        return PF_TRACK_OK;
    if (warped && attempt_searched(t, track, slot, &expected))
        return PF_TRACK_OK;
    const uint32_t n = rank_starts(t, track, &t->slots[slot], around ? *around : (pf_point_q16){0, 0}, start);
    const uint32_t top = t->config.levels - 1u;
    if (t->slots[slot].sure && top > 1u) { /* half resolution will do; if not, from the top as others */
        reason = attempt(t, track, slot, start[0], 1, 1, &reached);
        if (!worth_another(reason))
            return reason;
    }
    reason = attempt(t, track, slot, start[0], top, 0, &reached);
    if (worth_another(reason) && warped && farther(reached, expected.at, SAME_START / 2) && may_try(t) &&
        attempt_warped(t, track, slot, expected.warp_q16, reached) == PF_TRACK_OK)
        return PF_TRACK_OK;
    for (uint32_t i = 1; i < n && worth_another(reason) && may_try(t); i++)
        reason = attempt(t, track, slot, start[i], top, 0, &other);
    if (!warped && expected.at.x != PF_NO_GUESS && worth_another(reason) && reason != PF_TRACK_BACKWARD && may_try(t) &&
        attempt_warped(t, track, slot, expected.warp_q16, expected.at) == PF_TRACK_OK)
        return PF_TRACK_OK;
    pf_point_q16 near = around ? *around : (pf_point_q16){0, 0}, miss;
    if (!worth_another(reason) || (!around && !look_around(t, track->pos, &near, &miss)))
        return reason;
    for (uint32_t i = 0; i < n; i++)
        if (!farther(near, start[i], SAME_START))
            return reason;
    return may_try(t) ? attempt(t, track, slot, near, top, 0, &other) : reason;
}

static bool is_vague(const pf_tracker *t, const pf_track *track, const pf_slot *slot)
{
    const uint64_t now = (uint64_t)track->cov_xx_q20 + track->cov_yy_q20;
    return t->config.has_wall ? now > 2u * VAGUE : now > VAGUE || (now > WORN && now > WORSE * slot->first_cov);
}

/* Finds one track. What is expected of it is first put right by how far its neighbours were from where they were
 * expected: the camera's turning cannot be foreseen, but it is nearly the same for those near one another. */
static pf_track_reason follow(pf_tracker *t, pf_track *track, uint16_t slot)
{
    pf_slot *s = &t->slots[slot];
    pf_expected *e = &s->expected;
    const pf_point_q16 given = e->at;
    const bool is_expected = given.x != PF_NO_GUESS;
    pf_point_q16 around, miss;
    const bool has_near = (is_expected || track->age == 0) && look_around(t, track->pos, &around, &miss);
    if (is_expected && has_near)
        e->at = (pf_point_q16){pf_guess_clamp((int64_t)given.x + miss.x, t->config.width),
                               pf_guess_clamp((int64_t)given.y + miss.y, t->config.height)};
    pf_track_reason reason = seek(t, track, slot, has_near ? &around : NULL);
    if (reason == PF_TRACK_OK && is_vague(t, track, s))
        reason = PF_TRACK_DRIFT;
    e->at.x = PF_NO_GUESS;
    s->miss = (pf_point_q16){0, 0};
    if (is_expected && reason == PF_TRACK_OK)
        s->miss = (pf_point_q16){track->pos.x - given.x, track->pos.y - given.y};
    return reason;
}

void pf_tracks_follow(pf_tracker *t)
{
    t->extra = t->config.max_tracks / 2u;
    for (uint32_t i = 0; i < t->n; i++)
        t->table[i].status = PF_TRACK_NEW; /* not yet found in this frame */
    for (uint32_t i = 0; i < t->n; i++) {
        pf_track *track = &t->table[i];
        const pf_track_reason reason = follow(t, track, t->slot_of[i]);
        track->age++;
        track->reason = (uint8_t)reason;
        if (reason == PF_TRACK_OK) {
            track->status = PF_TRACK_TRACKED;
            pf_grid_insert(t, i);
            t->stats.tracked++;
            t->stats.live++;
        } else {
            lose(t, i, reason);
        }
    }
    drop_stuck(t);
}
