/* The track table: what happens to each track in a frame, and where new ones come from. */
#include <string.h>

#include "track_private.h"

#define ALIGN 16u
/* A template is renewed when its warp has moved this far from identity: the affine model then leaves, at the edge of a
 * 21-pixel window, second-order terms of a few tenths of a pixel on a pipe's wall. */
#define RENEW         (65536 / 5)
#define PULL_MAX      (3 << 15) /* the template may move a track by 1.5 px from where the previous frame put it */
#define DRIFT_SLACK   3277      /* the template may look 0.1 less similar than the previous patch */
#define CERTAIN       (2 << 16) /* a track found this near its guess is next sought from half resolution on */
#define GUESS_MARGIN  (64 << 16)
#define RETRY_APART   32768 /* a second guess closer than 1/2 px to the first is the same guess */
#define NEIGHBOURS    3
#define FLAT_FRACTION 8 /* a corner on bare ground fills a part of the window: its mean is so much less */
#define CANDIDATES    4 /* so many times the tracks there may be: most stand too near a stronger one */

typedef struct pf_slot { /* the hidden part of a live track */
    pf_point_q16 move;   /* its last displacement */
    bool sure;           /* which its guess met within CERTAIN */
    pf_anchor anchor;
} pf_slot;

struct pf_tracker {
    pf_tracker_config config; /* defaults filled in */
    pf_tracker_stats stats;
    pf_pyramid pyramid[2];
    uint32_t now; /* index of the current frame's pyramid */
    bool started;
    uint64_t last_id;
    pf_track *table;
    uint16_t *slot_of; /* of each live row of the table */
    uint32_t n;
    pf_slot *slots;
    uint8_t *pixels; /* templates, patch_bytes each */
    uint32_t patch_bytes;
    uint16_t *spare; /* free slots */
    uint32_t spare_n;
    int32_t *head; /* grid: first table row of each cell, -1 = none */
    int32_t *next; /* grid: next table row in the same cell, by table row */
    uint32_t grid_w, grid_h;
    pf_corner *found; /* heap of candidates, weakest on top */
    uint32_t found_n;
    pf_klt klt;
    pf_corner_scratch corners;
};

/* --- configuration and memory --------------------------------------------------------------------------------- */

static uint32_t or_default(uint32_t value, uint32_t fallback)
{
    return value ? value : fallback;
}

static bool within(uint32_t value, uint32_t least, uint32_t most)
{
    return value >= least && value <= most;
}

/* Side of the cell that gives every track one cell of the lit area. */
static uint32_t default_cell(const pf_tracker_config *c)
{
    const uint64_t r = c->circle_radius_q16 >> 16;
    const uint64_t circle = r * r * 355u / 113u, image = (uint64_t)c->width * c->height;
    const uint32_t side = pf_isqrt64((circle && circle < image ? circle : image) / c->max_tracks);
    return side < 16u ? 16u : side > CELL_MAX ? CELL_MAX : side;
}

/* Fills in defaults and checks every bound. */
static bool resolve(const pf_tracker_config *in, pf_tracker_config *out)
{
    const int32_t reach = 16384 << 16;
    if (!in)
        return false;
    *out = *in;
    out->max_tracks = or_default(in->max_tracks, 400);
    out->levels = or_default(in->levels, 4);
    out->window = or_default(in->window, 21);
    out->iterations = or_default(in->iterations, 10);
    out->min_eigen = or_default(in->min_eigen, 8);
    out->fb_q16 = or_default(in->fb_q16, 32768);
    out->min_zncc_q15 = or_default(in->min_zncc_q15, 26214);
    out->noise_q8 = or_default(in->noise_q8, 512);
    if (!within(out->width, 64, PF_IMAGE_SIZE_MAX) || !within(out->height, 64, PF_IMAGE_SIZE_MAX) ||
        !within(out->max_tracks, 8, PF_TRACKS_MAX) || !within(out->levels, 1, PF_PYRAMID_LEVELS_MAX) ||
        !within(out->window, 7, WINDOW_MAX) || out->window % 2u == 0 || !within(out->iterations, 1, 30) ||
        out->min_eigen > 16384u || out->fb_q16 > 16u << 16 || out->min_zncc_q15 > 32767u || out->noise_q8 > 64u << 8 ||
        out->circle_radius_q16 > 16384u << 16 || out->circle.x > reach || out->circle.x < -reach ||
        out->circle.y > reach || out->circle.y < -reach)
        return false;
    out->cell = in->cell ? in->cell : default_cell(out);
    return within(out->cell, 16, CELL_MAX);
}

/* Hands out aligned pieces of the workspace; with base NULL it only counts. */
static void *carve(uint8_t *base, size_t *used, size_t bytes)
{
    void *at = base ? base + *used : NULL;
    *used += (bytes + ALIGN - 1u) / ALIGN * ALIGN;
    return at;
}

/* Lays everything out; returns the bytes used. `t` is NULL when only counting. */
static size_t lay_out(const pf_tracker_config *c, uint8_t *base, pf_tracker *t)
{
    pf_tracker count;
    size_t used = 0;
    (void)carve(base, &used, sizeof *t);
    if (!t)
        t = &count;
    t->patch_bytes = pf_anchor_bytes(c->window);
    t->grid_w = (c->width + c->cell - 1u) / c->cell;
    t->grid_h = (c->height + c->cell - 1u) / c->cell;
    t->table = carve(base, &used, 2u * c->max_tracks * sizeof *t->table);
    t->slot_of = carve(base, &used, 2u * c->max_tracks * sizeof *t->slot_of);
    t->slots = carve(base, &used, c->max_tracks * sizeof *t->slots);
    t->pixels = carve(base, &used, (size_t)c->max_tracks * t->patch_bytes);
    t->spare = carve(base, &used, c->max_tracks * sizeof *t->spare);
    t->head = carve(base, &used, (size_t)t->grid_w * t->grid_h * sizeof *t->head);
    t->next = carve(base, &used, 2u * c->max_tracks * sizeof *t->next);
    t->found = carve(base, &used, CANDIDATES * c->max_tracks * sizeof *t->found);
    const size_t bytes = pf_pyramid_workspace_size(c->width, c->height, c->levels);
    for (uint32_t i = 0; i < 2u; i++) {
        void *block = carve(base, &used, bytes);
        if (block)
            (void)pf_pyramid_init(&t->pyramid[i], c->width, c->height, c->levels, block, bytes);
    }
    return used;
}

size_t pf_tracker_workspace_size(const pf_tracker_config *config)
{
    pf_tracker_config c;
    return resolve(config, &c) ? lay_out(&c, NULL, NULL) : 0;
}

pf_status pf_tracker_init(pf_tracker **tracker, const pf_tracker_config *config, void *workspace, size_t size)
{
    pf_tracker_config c;
    if (!tracker || !workspace || (uintptr_t)workspace % ALIGN || !resolve(config, &c))
        return PF_ERR_ARGUMENT;
    if (size < lay_out(&c, NULL, NULL))
        return PF_ERR_SPACE;
    pf_tracker *t = workspace;
    memset(t, 0, sizeof *t);
    lay_out(&c, workspace, t);
    t->config = c;
    pf_klt_init(&t->klt, c.window, c.iterations, c.min_eigen / FLAT_FRACTION);
    t->klt.circle = c.circle;
    t->klt.radius_q16 = (int32_t)c.circle_radius_q16;
    pf_tracker_reset(t);
    *tracker = t;
    return PF_OK;
}

void pf_tracker_reset(pf_tracker *tracker)
{
    tracker->n = 0;
    tracker->started = false;
    tracker->stats = (pf_tracker_stats){0};
    tracker->spare_n = tracker->config.max_tracks;
    for (uint32_t i = 0; i < tracker->spare_n; i++)
        tracker->spare[i] = (uint16_t)(tracker->spare_n - 1u - i);
}

const pf_track *pf_tracker_tracks(const pf_tracker *tracker, uint32_t *n)
{
    *n = tracker->n;
    return tracker->table;
}

const pf_tracker_stats *pf_tracker_last_stats(const pf_tracker *tracker)
{
    return &tracker->stats;
}

/* --- the grid ---------------------------------------------------------------------------------------------------- */

static void grid_clear(pf_tracker *t)
{
    for (size_t i = 0; i < (size_t)t->grid_w * t->grid_h; i++)
        t->head[i] = -1;
}

static void grid_insert(pf_tracker *t, uint32_t row)
{
    const pf_point_q16 p = t->table[row].pos;
    const uint32_t cx = (uint32_t)(p.x >> 16) / t->config.cell, cy = (uint32_t)(p.y >> 16) / t->config.cell;
    int32_t *head = &t->head[(size_t)cy * t->grid_w + cx];
    t->next[row] = *head;
    *head = (int32_t)row;
}

/* Whether a track in the grid lies within `reach` (Q16.16 px, at most a cell) of `at`. */
static bool grid_near(const pf_tracker *t, pf_point_q16 at, int64_t reach)
{
    const int64_t cell = (int64_t)t->config.cell << 16, left = at.x - reach, top = at.y - reach;
    const int64_t right = (at.x + reach) / cell, bottom = (at.y + reach) / cell;
    for (int64_t y = top > 0 ? top / cell : 0; y <= bottom && y < (int64_t)t->grid_h; y++)
        for (int64_t x = left > 0 ? left / cell : 0; x <= right && x < (int64_t)t->grid_w; x++)
            for (int32_t i = t->head[(size_t)y * t->grid_w + (size_t)x]; i >= 0; i = t->next[i]) {
                const int64_t dx = (int64_t)t->table[i].pos.x - at.x, dy = (int64_t)t->table[i].pos.y - at.y;
                if (dx * dx + dy * dy < reach * reach)
                    return true;
            }
    return false;
}

/* --- tracking ---------------------------------------------------------------------------------------------------- */

static int32_t median3(int32_t a, int32_t b, int32_t c)
{
    const int32_t low = a < b ? a : b, high = a < b ? b : a;
    return c < low ? low : c > high ? high : c;
}

/* Median displacement of the nearest tracks already found in this frame; false with fewer than three. */
static bool neighbours_move(const pf_tracker *t, pf_point_q16 at, pf_point_q16 *move)
{
    int64_t distance[NEIGHBOURS];
    pf_point_q16 near[NEIGHBOURS];
    uint32_t n = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        if (t->table[i].status != PF_TRACK_TRACKED)
            continue;
        const pf_point_q16 m = t->slots[t->slot_of[i]].move, p = t->table[i].pos;
        const int64_t dx = (int64_t)p.x - m.x - at.x, dy = (int64_t)p.y - m.y - at.y, d = dx * dx + dy * dy;
        uint32_t k = n < NEIGHBOURS ? n++ : NEIGHBOURS;
        if (k == NEIGHBOURS && d >= distance[NEIGHBOURS - 1])
            continue;
        for (k = k == NEIGHBOURS ? NEIGHBOURS - 1 : k; k > 0 && distance[k - 1] > d; k--) {
            distance[k] = distance[k - 1];
            near[k] = near[k - 1];
        }
        distance[k] = d;
        near[k] = m;
    }
    if (n < NEIGHBOURS)
        return false;
    *move = (pf_point_q16){median3(near[0].x, near[1].x, near[2].x), median3(near[0].y, near[1].y, near[2].y)};
    return true;
}

static bool farther(pf_point_q16 a, pf_point_q16 b, int64_t reach)
{
    const int64_t dx = (int64_t)a.x - b.x, dy = (int64_t)a.y - b.y;
    return dx * dx + dy * dy > reach * reach;
}

static int32_t clamp_guess(int64_t v, uint32_t size)
{
    const int64_t most = ((int64_t)size << 16) + GUESS_MARGIN;
    return (int32_t)(v < -GUESS_MARGIN ? -GUESS_MARGIN : v > most ? most : v);
}

/* One attempt at one track from one guess; on success `track` and its slot are up to date. */
static pf_track_reason attempt(pf_tracker *t, pf_track *track, uint16_t slot, pf_point_q16 move, uint32_t top)
{
    const pf_pyramid *from = &t->pyramid[1u - t->now], *to = &t->pyramid[t->now];
    const pf_point_q16 old = track->pos;
    const pf_point_q16 guess = {clamp_guess((int64_t)old.x + move.x, t->config.width),
                                clamp_guess((int64_t)old.y + move.y, t->config.height)};
    pf_point_q16 at = guess;
    const pf_fit coarse = pf_klt_track(&t->klt, from, to, old, &at, top, top ? 1 : 0);
    if (top == 0 && coarse.reason != PF_TRACK_OK)
        return coarse.reason;
    if (!pf_klt_inside(&t->klt, &to->level[0], at))
        return PF_TRACK_LEFT;
    pf_slot *s = &t->slots[slot];
    const pf_anchor saved = s->anchor;
    uint8_t *pixels = t->pixels + (size_t)slot * t->patch_bytes;
    pf_point_q16 fine = at;
    const pf_fit anchored = pf_anchor_fit(&t->klt, &to->level[0], &s->anchor, pixels, &fine);
    pf_track_reason reason = anchored.reason;
    pf_point_q16 back = old;
    pf_fit fit = {PF_TRACK_OK, 0, GAIN_ONE};
    if (reason == PF_TRACK_OK) {
        fit = pf_klt_track(&t->klt, to, from, fine, &back, 0, 0);
        if (fit.reason != PF_TRACK_OK)
            reason = fit.reason;
        else if (fit.zncc_q15 < (int32_t)t->config.min_zncc_q15)
            reason = PF_TRACK_RESIDUAL;
        else if (farther(back, old, t->config.fb_q16))
            reason = PF_TRACK_BACKWARD;
    }
    if (reason == PF_TRACK_OK &&
        (anchored.zncc_q15 < (int32_t)t->config.min_zncc_q15 - DRIFT_SLACK || farther(fine, at, PULL_MAX)))
        reason = PF_TRACK_DRIFT;
    if (reason == PF_TRACK_OK && !pf_klt_inside(&t->klt, &to->level[0], fine))
        reason = PF_TRACK_LEFT;
    if (reason == PF_TRACK_OK && grid_near(t, fine, (int64_t)t->config.cell << 14))
        reason = PF_TRACK_CROWDED;
    if (reason != PF_TRACK_OK) {
        s->anchor = saved;
        return reason;
    }
    s->move = (pf_point_q16){fine.x - old.x, fine.y - old.y};
    s->sure = !farther(fine, guess, CERTAIN);
    track->pos = fine;
    track->quality = (uint16_t)fit.zncc_q15;
    pf_anchor_covariance(&s->anchor, t->config.noise_q8, anchored.gain_q14, track);
    for (int32_t k = 0; k < 4; k++) {
        const int32_t d = s->anchor.a[k] - (k == 0 || k == 3 ? 65536 : 0);
        if (d > RENEW || d < -RENEW) {
            pf_anchor_take(&t->klt, &to->level[0], fine, &s->anchor, pixels);
            break;
        }
    }
    return PF_TRACK_OK;
}

/* Drops the rows lost in the frame before. */
static void compact(pf_tracker *t)
{
    uint32_t kept = 0;
    for (uint32_t i = 0; i < t->n; i++) {
        if (t->table[i].status == PF_TRACK_LOST)
            continue;
        t->table[kept] = t->table[i];
        t->slot_of[kept++] = t->slot_of[i];
    }
    t->n = kept;
}

static void track_all(pf_tracker *t)
{
    for (uint32_t i = 0; i < t->n; i++)
        t->table[i].status = PF_TRACK_NEW; /* not yet found in this frame */
    for (uint32_t i = 0; i < t->n; i++) {
        pf_track *track = &t->table[i];
        const uint16_t slot = t->slot_of[i];
        const bool young = track->age == 0;
        pf_point_q16 near, first = t->slots[slot].move;
        const bool have_near = neighbours_move(t, track->pos, &near);
        if (young && have_near)
            first = near;
        const uint32_t top = t->config.levels - 1u, low = t->slots[slot].sure && top > 1u ? 1u : top;
        pf_track_reason reason = attempt(t, track, slot, first, low);
        if (reason != PF_TRACK_OK && (low != top || (have_near && farther(first, near, RETRY_APART))))
            reason = attempt(t, track, slot, have_near ? near : first, top);
        track->age++;
        track->reason = (uint8_t)reason;
        if (reason == PF_TRACK_OK) {
            track->status = PF_TRACK_TRACKED;
            grid_insert(t, i);
            t->stats.tracked++;
            t->stats.live++;
        } else {
            track->status = PF_TRACK_LOST;
            t->spare[t->spare_n++] = slot;
            t->stats.lost++;
            t->stats.lost_by[reason]++;
        }
    }
}

/* --- detection --------------------------------------------------------------------------------------------------- */

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

/* Corners keep 3/4 of a cell apart: greedy by strength, so spread leaves about one a cell. */
static bool place_allowed(const pf_tracker *t, pf_point_q16 at)
{
    return pf_klt_inside(&t->klt, &t->pyramid[t->now].level[0], at) && !grid_near(t, at, (int64_t)t->config.cell << 15);
}

static bool corner_allowed(const void *context, int32_t x, int32_t y)
{
    return place_allowed(context, (pf_point_q16){x * 65536, y * 65536});
}

static void add_track(pf_tracker *t, pf_point_q16 at)
{
    const pf_image *image = &t->pyramid[t->now].level[0];
    const uint16_t slot = t->spare[--t->spare_n];
    const uint32_t row = t->n++;
    pf_slot *s = &t->slots[slot];
    s->move = (pf_point_q16){0, 0};
    s->sure = false;
    t->slot_of[row] = slot;
    t->table[row] = (pf_track){.id = ++t->last_id, .pos = at, .status = PF_TRACK_NEW, .reason = PF_TRACK_OK};
    pf_anchor_take(&t->klt, image, t->table[row].pos, &s->anchor, t->pixels + (size_t)slot * t->patch_bytes);
    pf_anchor_covariance(&s->anchor, t->config.noise_q8, GAIN_ONE, &t->table[row]);
    grid_insert(t, row);
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
    const int32_t u = t->klt.circle.x >> 16, v = t->klt.circle.y >> 16, r = t->klt.radius_q16 >> 16;
    const int64_t dx = u < box[0] ? box[0] - u : u >= box[2] ? u - box[2] + 1 : 0;
    const int64_t dy = v < box[1] ? box[1] - v : v >= box[3] ? v - box[3] + 1 : 0;
    return dx * dx + dy * dy <= (int64_t)r * r;
}

static void detect_all(pf_tracker *t)
{
    const pf_image *image = &t->pyramid[t->now].level[0];
    const int32_t least = pf_corner_least(t->config.min_eigen);
    t->found_n = 0;
    if (t->spare_n == 0)
        return;
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
        if (place_allowed(t, at))
            add_track(t, at);
    }
}

/* --- a frame ----------------------------------------------------------------------------------------------------- */

pf_status pf_tracker_frame(pf_tracker *tracker, const pf_image *frame, uint64_t (*clock)(void), uint64_t *stage_ns)
{
    uint64_t at[PF_STAGES + 1] = {0};
    if (!tracker || !frame || !frame->data || frame->width != tracker->config.width ||
        frame->height != tracker->config.height || frame->stride < frame->width)
        return PF_ERR_ARGUMENT;
    at[0] = clock ? clock() : 0;
    tracker->now = 1u - tracker->now;
    (void)pf_pyramid_build(&tracker->pyramid[tracker->now], frame);
    at[1] = clock ? clock() : 0;
    tracker->stats = (pf_tracker_stats){0};
    compact(tracker);
    grid_clear(tracker);
    if (tracker->started)
        track_all(tracker);
    tracker->started = true;
    at[2] = clock ? clock() : 0;
    detect_all(tracker);
    at[3] = clock ? clock() : 0;
    for (uint32_t i = 0; stage_ns && i < PF_STAGES; i++)
        stage_ns[i] = at[i + 1u] - at[i];
    return PF_OK;
}
