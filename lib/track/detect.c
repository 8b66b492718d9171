/* Where new tracks come from. */
#include "tracker_private.h"

#define INNER 8 /* polar cells: nothing new in this fraction of the radius */
/* px^2, Q20: a place known to no better than 0.11 px along some direction at first sight (a line, a faint mark) makes
 * no track. In narrow plastic pipes these were 3 to 6 % of the sightings, 14 to 17 % of the wrong and up to 20 % of the
 * lost ones. */
#define FAINT 12583

/* Nor, in a tube (with a lens), does one of whose window more than a fortieth is clipped: it stands at the edge of the
 * glare, which goes with the camera. On PVC two thirds of what was lost to the glare had begun there. Elsewhere,
 * clipped corners are as good as others. */
#define GLARE 40u

static bool weaker(const pf_corner *a, const pf_corner *b)
{
    if (a->strength != b->strength)
        return a->strength < b->strength;
    return a->y != b->y ? a->y > b->y : a->x > b->x;
}

static void sift_down(pf_corner *heap, uint32_t i, uint32_t n)
{
    for (;;) {
        uint32_t child = 2u * i + 1u;
        if (child >= n)
            return;
        if (child + 1u < n && weaker(&heap[child + 1u], &heap[child]))
            child++;
        if (!weaker(&heap[child], &heap[i]))
            return;
        const pf_corner swap = heap[i];
        heap[i] = heap[child];
        heap[child] = swap;
        i = child;
    }
}

/* Keeps the strongest candidates, CANDIDATES times as many as there is room for tracks. */
static void remember(pf_tracker *t, const pf_corner *corner)
{
    if (t->found_n < CANDIDATES * t->spare_n) {
        uint32_t i = t->found_n++;
        for (; i > 0 && weaker(corner, &t->found[(i - 1u) / 2u]); i = (i - 1u) / 2u)
            t->found[i] = t->found[(i - 1u) / 2u];
        t->found[i] = *corner;
    } else if (weaker(&t->found[0], corner)) {
        t->found[0] = *corner;
        sift_down(t->found, 0, t->found_n);
    }
}

/* Corners keep half a cell apart: greedy by strength, so spread leaves about one a cell. */
static bool place_allowed(const pf_tracker *t, pf_point_q16 at)
{
    return pf_rim_allows(t, at) && pf_mask_allows_new(t, at.x >> 16, at.y >> 16) &&
           pf_klt_inside(&t->klt, &t->pyramid[t->now].level[0], at) &&
           !pf_grid_near(t, at, (int64_t)t->config.cell << 15);
}

static bool corner_allowed(const void *context, int32_t x, int32_t y)
{
    return place_allowed(context, (pf_point_q16){x * 65536, y * 65536});
}

uint32_t pf_sector_of(int64_t dx, int64_t dy)
{
    /* turned into the first quadrant; tan 30 = 0.577, tan 60 = 1.732 */
    const uint32_t quadrant = dy < 0 ? (dx < 0 ? 2u : 3u) : dx < 0 ? 1u : 0u;
    const int64_t ax = dx < 0 ? -dx : dx, ay = dy < 0 ? -dy : dy;
    const int64_t along = quadrant % 2u ? ay : ax, across = quadrant % 2u ? ax : ay;
    return quadrant * 3u + (1000 * across < 577 * along ? 0u : 1000 * across < 1732 * along ? 1u : 2u);
}

/* The polar cell of a point; -1 in the circle's inner part. */
static int32_t bin_of(const pf_tracker *t, pf_point_q16 at)
{
    const int64_t dx = ((int64_t)at.x - t->config.circle.x) >> 8, dy = ((int64_t)at.y - t->config.circle.y) >> 8;
    const int64_t r = t->config.circle_radius_q16 >> 8, square = dx * dx + dy * dy;
    uint32_t ring = 0;
    if (INNER * INNER * square < r * r)
        return -1;
    while (ring < RINGS - 1u && RINGS * RINGS * square >= (int64_t)((ring + 1u) * (ring + 1u)) * r * r)
        ring++;
    return (int32_t)(ring * SECTORS + pf_sector_of(dx, dy));
}

/* Whether a candidate may become a track: neither in the glare nor in the dark, and with room in its polar cell. */
static bool has_room(const pf_tracker *t, pf_point_q16 at)
{
    const uint32_t most = (3u * t->config.max_tracks + 2u * SECTORS * RINGS - 1u) / (2u * SECTORS * RINGS);
    const uint32_t part = t->config.lens.ray ? GLARE : CLIPPED;
    if (part * pf_mask_clipped(t, &t->pyramid[t->now].level[0], at) > t->config.window * t->config.window)
        return false;
    if (!t->config.polar)
        return true;
    const int32_t bin = bin_of(t, at);
    return bin >= 0 && t->bin[bin] < most;
}

/* Whether the place is known to FAINT or worse in some direction: the larger eigenvalue. */
static bool is_faint(const pf_track *track)
{
    const int64_t xx = (int64_t)FAINT - track->cov_xx_q20, yy = (int64_t)FAINT - track->cov_yy_q20;
    const int64_t xy = pf_clamp_i64(track->cov_xy_q20, FAINT);
    return xx <= 0 || yy <= 0 || xx * yy <= xy * xy;
}

static void add_track(pf_tracker *t, pf_point_q16 at)
{
    const pf_image *image = &t->pyramid[t->now].level[0];
    const uint16_t slot = t->spare[t->spare_n - 1u];
    const uint32_t row = t->n;
    pf_slot *s = &t->slots[slot];
    pf_track *track = &t->table[row];
    *track = (pf_track){.pos = at, .status = PF_TRACK_NEW, .reason = PF_TRACK_OK};
    pf_anchor_take(&t->klt, image, at, &s->anchor, t->pixels + (size_t)slot * t->patch_bytes);
    s->anchor.carried[0] = s->anchor.carried[1] = s->anchor.carried[2] = 0;
    pf_anchor_covariance(&s->anchor, t->config.noise_q8, GAIN_ONE, track);
    if (is_faint(track))
        return;
    s->move = s->own = (pf_point_q16){0, 0};
    s->radial = s->flow = 0;
    s->expected.at.x = PF_NO_GUESS;
    s->sure = false;
    s->from = at;
    s->clipped = pf_mask_clipped(t, image, at);
    s->first_cov = (uint64_t)track->cov_xx_q20 + track->cov_yy_q20;
    track->id = ++t->last_id;
    t->slot_of[row] = slot;
    t->spare_n--;
    t->n++;
    if (t->config.polar)
        t->bin[bin_of(t, at)]++;
    pf_grid_insert(t, row);
    t->stats.detected++;
    t->stats.live++;
}

/* The part of a cell in which a window fits into the image; false if there is none, or none in the circle. */
static bool cell_box(const pf_tracker *t, int32_t cx, int32_t cy, int32_t box[4])
{
    const int32_t cell = (int32_t)t->config.cell;
    const int32_t margin = t->klt.half + 2 > CORNER_REACH ? t->klt.half + 2 : CORNER_REACH;
    const int32_t right = (int32_t)t->config.width - margin - 1, bottom = (int32_t)t->config.height - margin - 1;
    box[0] = cx * cell < margin ? margin : cx * cell;
    box[1] = cy * cell < margin ? margin : cy * cell;
    box[2] = (cx + 1) * cell > right ? right : (cx + 1) * cell;
    box[3] = (cy + 1) * cell > bottom ? bottom : (cy + 1) * cell;
    if (box[0] >= box[2] || box[1] >= box[3])
        return false;
    if (!t->klt.radius_q16)
        return true;
    const int32_t u = t->klt.circle.x >> 16, v = t->klt.circle.y >> 16, r = (int32_t)(t->rim_most_q8 >> 8) + 1;
    const int64_t dx = u < box[0] ? box[0] - u : u >= box[2] ? u - box[2] + 1 : 0;
    const int64_t dy = v < box[1] ? box[1] - v : v >= box[3] ? v - box[3] + 1 : 0;
    return dx * dx + dy * dy <= (int64_t)r * r;
}

void pf_tracks_detect(pf_tracker *t)
{
    const pf_image *image = &t->pyramid[t->now].level[0];
    const int32_t least = pf_corner_least(t->config.min_eigen);
    t->found_n = 0;
    if (t->spare_n == 0)
        return;
    pf_rim_set(t);
    for (uint32_t i = 0; i < SECTORS * RINGS; i++)
        t->bin[i] = 0;
    for (uint32_t i = 0; t->config.polar && i < t->n; i++)
        if (t->table[i].status == PF_TRACK_TRACKED) {
            const int32_t bin = bin_of(t, t->table[i].pos);
            if (bin >= 0)
                t->bin[bin]++;
        }
    for (uint32_t cy = 0; cy < t->grid_h; cy++)
        for (uint32_t cx = 0; cx < t->grid_w; cx++) {
            int32_t box[4];
            pf_corner best[4];
            if (t->head[(size_t)cy * t->grid_w + cx] >= 0 || !cell_box(t, (int32_t)cx, (int32_t)cy, box))
                continue;
            const uint32_t n = pf_corner_scan(&t->corners, &t->pyramid[t->now], box, least, corner_allowed, t, best);
            for (uint32_t i = 0; i < n; i++)
                remember(t, &best[i]);
        }
    /* heap sort: weakest to the back, so the strongest gets its place first */
    for (uint32_t n = t->found_n; n > 1u; n--) {
        const pf_corner swap = t->found[0];
        t->found[0] = t->found[n - 1u];
        t->found[n - 1u] = swap;
        sift_down(t->found, 0, n - 1u);
    }
    for (uint32_t i = 0; i < t->found_n && t->spare_n > 0; i++) {
        if (!corner_allowed(t, t->found[i].x, t->found[i].y))
            continue;
        const pf_point_q16 at = pf_corner_place(image, &t->found[i]);
        if (place_allowed(t, at) && has_room(t, at))
            add_track(t, at);
    }
}
