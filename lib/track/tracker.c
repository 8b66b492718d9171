/* The tracker as a whole: configuration, memory, the table, the grid, the order of things in a frame. */
#include <string.h>

#include "tracker_private.h"

#define ALIGN         16u
#define FLAT_FRACTION 8 /* a corner on bare ground fills a part of the window: its mean is so much less */

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
        out->circle_radius_q16 > 16384u << 16 ||
        (out->circle_radius_q16 && out->circle_radius_q16 < out->window << 16) || out->circle.x > reach ||
        out->circle.x < -reach || out->circle.y > reach || out->circle.y < -reach ||
        (out->polar && !out->circle_radius_q16) ||
        (out->mask && (!out->mask->data || out->mask->width != out->width || out->mask->height != out->height ||
                       out->mask->stride < out->width)))
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

/* Puts an array of t into the block, or with t NULL only counts. */
#define PLACE(field, count)                                                                                            \
    do {                                                                                                               \
        void *at = carve(base, &used, (size_t)(count) * sizeof *t->field);                                             \
        if (t)                                                                                                         \
            t->field = at;                                                                                             \
    } while (0)

/* Lays everything out; returns the bytes used. `base` and `t` are NULL when only counting. */
static size_t lay_out(const pf_tracker_config *c, uint8_t *base, pf_tracker *t)
{
    const uint32_t patch_bytes = pf_anchor_bytes(c->window), tracks = c->max_tracks;
    const uint32_t grid_w = (c->width + c->cell - 1u) / c->cell, grid_h = (c->height + c->cell - 1u) / c->cell;
    const uint32_t block_w = (c->width + BLOCK - 1u) / BLOCK, block_h = (c->height + BLOCK - 1u) / BLOCK;
    const size_t bytes = pf_pyramid_workspace_size(c->width, c->height, c->levels);
    size_t used = 0;
    (void)carve(base, &used, sizeof *t);
    PLACE(table, 2u * tracks);
    PLACE(slot_of, 2u * tracks);
    PLACE(cell_of, 2u * tracks);
    PLACE(radial, 2u * tracks);
    PLACE(slots, tracks);
    PLACE(pixels, (size_t)tracks * patch_bytes);
    PLACE(spare, tracks);
    PLACE(head, (size_t)grid_w * grid_h);
    PLACE(next, 2u * tracks);
    PLACE(found, CANDIDATES * tracks);
    PLACE(value, tracks);
    PLACE(block, (size_t)block_w * block_h);
    for (uint32_t i = 0; i < 2u; i++) {
        void *block = carve(base, &used, bytes);
        if (t)
            (void)pf_pyramid_init(&t->pyramid[i], c->width, c->height, c->levels, block, bytes);
    }
    if (t) {
        t->patch_bytes = patch_bytes;
        t->grid_w = grid_w;
        t->grid_h = grid_h;
        t->block_w = block_w;
        t->block_h = block_h;
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
    pf_klt_init(&t->klt, c.window, c.iterations, c.min_eigen / FLAT_FRACTION, c.noise_q8);
    t->klt.lens = c.lens;
    t->klt.circle = c.circle;
    t->klt.radius_q16 = (int32_t)c.circle_radius_q16;
    pf_mask_init(t, c.mask);
    t->config.mask = NULL;
    pf_tracker_reset(t);
    *tracker = t;
    return PF_OK;
}

void pf_tracker_reset(pf_tracker *tracker)
{
    tracker->n = 0;
    tracker->started = false;
    tracker->stats = (pf_tracker_stats){0};
    tracker->frame = 0;
    tracker->drift_q16 = UINT32_MAX;
    pf_tracker_foresee(tracker, PF_WAY_USUAL, NULL);
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

void pf_grid_insert(pf_tracker *t, uint32_t row)
{
    const pf_point_q16 p = t->table[row].pos;
    const uint32_t cx = (uint32_t)(p.x >> 16) / t->config.cell, cy = (uint32_t)(p.y >> 16) / t->config.cell;
    int32_t *head = &t->head[(size_t)cy * t->grid_w + cx];
    t->next[row] = *head;
    *head = (int32_t)row;
}

bool pf_grid_near(const pf_tracker *t, pf_point_q16 at, int64_t reach)
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

pf_status pf_tracker_expect(pf_tracker *tracker, const pf_expected *expected, uint32_t n)
{
    if (!tracker || n != tracker->n || (n && !expected))
        return PF_ERR_ARGUMENT;
    for (uint32_t i = 0; i < n; i++) {
        if (tracker->table[i].status == PF_TRACK_LOST)
            continue;
        pf_expected *e = &tracker->slots[tracker->slot_of[i]].expected;
        *e = expected[i];
        if (e->at.x == PF_NO_GUESS)
            continue;
        e->at.x = pf_guess_clamp(e->at.x, tracker->config.width);
        e->at.y = pf_guess_clamp(e->at.y, tracker->config.height);
        for (uint32_t k = 0; k < 4u; k++)
            e->warp_q16[k] = pf_clamp_i64(e->warp_q16[k], WARP_MOST);
    }
    return PF_OK;
}

/* --- a frame ----------------------------------------------------------------------------------------------------- */

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
        pf_tracks_follow(tracker);
    tracker->started = true;
    pf_scene_measure(tracker);
    pf_mask_learn(tracker);
    at[2] = clock ? clock() : 0;
    pf_tracks_detect(tracker);
    at[3] = clock ? clock() : 0;
    for (uint32_t i = 0; stage_ns && i < PF_STAGES; i++)
        stage_ns[i] = at[i + 1u] - at[i];
    return PF_OK;
}
