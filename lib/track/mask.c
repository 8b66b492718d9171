/* Where nothing may be tracked: the user's mask, and parts that stand still in the picture while it moves (the robot,
 * dirt on the lens, overlaid text; RECONSTRUCTION section 3). The latter are learned from one pixel a block, a quarter
 * of the blocks at a time, each time the picture has moved by 2 px. A block is static when that pixel has hardly
 * changed over some 45 lessons and there is something in the block to hold on to: bare ground needs no mask. */
#include "tracker_private.h"

#define SLICES       4u
#define TRAVEL       (2u << 16)
#define RATE         16        /* of both running means */
#define DEVIATION_Q6 (16 * 64) /* a block's first: it takes 37 quiet lessons to come below 1.5 */
#define UNSEEN       UINT16_MAX
#define STILL_Q6     96 /* 1.5 grey: noise of sigma 2 leaves 0.5 at this level */
#define MOVES_Q6     192
/* Where a wall goes by, its pixel deviates by about a fifth of the block's range: weakly textured ones are known by
 * that, with a margin either way. */
#define STILL_PART  8
#define MOVES_PART  6
#define CONTRAST_Q6 (8 * 64) /* range of the block about its plane: less is no corner; less than half, bare ground */
#define MOST_STATIC 3u       /* no more is learned once a third of the picture is masked: it would be no picture */
#define SENTENCE    40 /* lessons for which a block where a track got stuck stays closed, whatever its own pixel does */
#define BRIGHT      250 /* from here on, and */
#define BLACK       2   /* down from here, a pixel is clipped, or its noise is */

/* New tracks keep a block's distance from static ones: a window reaches further than the pixel it is centred on. */
static void close_blocks(pf_tracker *t)
{
    const int32_t w = (int32_t)t->block_w, h = (int32_t)t->block_h;
    t->static_blocks = 0;
    t->is_mask_stale = false;
    for (int32_t i = 0; i < w * h; i++) {
        t->block[i].is_closed = t->block[i].is_masked;
        t->static_blocks += t->block[i].is_static;
    }
    for (int32_t i = 0; i < w * h; i++) {
        if (!t->block[i].is_static)
            continue;
        for (int32_t y = i / w - 1; y <= i / w + 1; y++)
            for (int32_t x = i % w - 1; x <= i % w + 1; x++)
                if (x >= 0 && y >= 0 && x < w && y < h)
                    t->block[y * w + x].is_closed = 1;
    }
}

/* Whether no window centred in the block fits into the circle: there its rim would be learned. */
static bool is_outside(const pf_tracker *t, uint32_t i)
{
    const int64_t x = (int64_t)(i % t->block_w * BLOCK + BLOCK / 2u) - (t->config.circle.x >> 16);
    const int64_t y = (int64_t)(i / t->block_w * BLOCK + BLOCK / 2u) - (t->config.circle.y >> 16);
    const int64_t reach = (int64_t)(t->config.circle_radius_q16 >> 16) - t->klt.half;
    return t->config.circle_radius_q16 && (reach <= 0 || x * x + y * y > reach * reach);
}

void pf_mask_init(pf_tracker *t, const pf_image *mask)
{
    for (uint32_t i = 0; i < t->block_w * t->block_h; i++)
        t->block[i] = (pf_block){.mean_q6 = UNSEEN, .deviation_q6 = DEVIATION_Q6, .is_outside = is_outside(t, i)};
    for (uint32_t y = 0; mask && y < mask->height; y++)
        for (uint32_t x = 0; x < mask->width; x++)
            if (mask->data[(size_t)y * mask->stride + x] == 0)
                t->block[y / BLOCK * t->block_w + x / BLOCK].is_masked = 1;
    t->usable_blocks = 0;
    for (uint32_t i = 0; i < t->block_w * t->block_h; i++)
        t->usable_blocks += !t->block[i].is_outside;
    close_blocks(t);
}

static const pf_block *block_at(const pf_tracker *t, int32_t x, int32_t y)
{
    return &t->block[(uint32_t)y / BLOCK * t->block_w + (uint32_t)x / BLOCK];
}

bool pf_mask_allows(const pf_tracker *t, pf_point_q16 at)
{
    const pf_block *b = block_at(t, at.x >> 16, at.y >> 16);
    return !b->is_masked && !b->is_static;
}

bool pf_mask_allows_new(const pf_tracker *t, int32_t x, int32_t y)
{
    return !block_at(t, x, y)->is_closed;
}

void pf_mask_condemn(pf_tracker *t, pf_point_q16 at)
{
    pf_block *b = &t->block[(uint32_t)(at.y >> 16) / BLOCK * t->block_w + (uint32_t)(at.x >> 16) / BLOCK];
    if (t->config.no_static_mask)
        return;
    b->is_static = 1;
    b->sentence = SENTENCE;
    t->is_mask_stale = true;
}

/* Range of the block's pixels at level 1 about their best plane, Q6 grey: the lamp's light slides over a bare wall, and
 * that is nothing to hold on to. */
static int32_t contrast(const pf_image *image, uint32_t x, uint32_t y, uint32_t side)
{
    const int32_t n = (int32_t)(side * side), most = (int32_t)side - 1; /* coordinates: -most .. most, by 2 */
    const int32_t xx = n * ((int32_t)side * (int32_t)side - 1) / 3;
    int32_t v[BLOCK * BLOCK], sum = 0, sx = 0, sy = 0, low = INT32_MAX, high = INT32_MIN;
    for (int32_t i = 0; i < n; i++) {
        const uint32_t px = x + (uint32_t)i % side, py = y + (uint32_t)i / side;
        const int32_t u = 2 * (i % (int32_t)side) - most, w = 2 * (i / (int32_t)side) - most;
        v[i] = image->data[(size_t)(py < image->height ? py : image->height - 1u) * image->stride +
                           (px < image->width ? px : image->width - 1u)];
        sum += v[i], sx += v[i] * u, sy += v[i] * w;
    }
    for (int32_t i = 0; i < n; i++) {
        const int32_t u = 2 * (i % (int32_t)side) - most, w = 2 * (i / (int32_t)side) - most;
        const int32_t off = 64 * v[i] - 64 * sum / n - (64 * sx * u + 64 * sy * w) / xx;
        low = off < low ? off : low;
        high = off > high ? off : high;
    }
    return high - low;
}

/* True if the block has become static (if it `may`), or ceased to be. */
static bool learn_block(pf_block *b, const pf_image *image, uint32_t x, uint32_t y, uint32_t side, bool may)
{
    const uint32_t px = x + side / 2u < image->width ? x + side / 2u : image->width - 1u;
    const uint32_t py = y + side / 2u < image->height ? y + side / 2u : image->height - 1u;
    const int32_t v = image->data[(size_t)py * image->stride + px] * 64, mean = b->mean_q6 == UNSEEN ? v : b->mean_q6;
    const int32_t off = v > mean ? v - mean : mean - v, deviation = b->deviation_q6;
    b->mean_q6 = (uint16_t)(mean + (v - mean) / RATE);
    b->deviation_q6 = (uint16_t)(deviation + (off - deviation) / RATE);
    if (b->sentence > 0) {
        b->sentence--;
        return false;
    }
    const int32_t range = contrast(image, x, y, side);
    const bool is_still = b->deviation_q6 < STILL_Q6 && STILL_PART * b->deviation_q6 < range && range >= CONTRAST_Q6;
    const bool moves = b->deviation_q6 > MOVES_Q6 || MOVES_PART * b->deviation_q6 > range || 2 * range < CONTRAST_Q6;
    if (b->is_static ? !moves : !is_still || !may)
        return false;
    b->is_static ^= 1u;
    return true;
}

/* Where nothing is learned only a sentence closes a block, and its end opens it. */
static bool serve_outside(pf_block *b)
{
    if (!b->is_static || --b->sentence > 0)
        return false;
    b->is_static = 0;
    return true;
}

void pf_mask_learn(pf_tracker *t)
{
    if (t->config.no_static_mask)
        return;
    t->travel_q16 += t->stats.scene.motion_q16 < 16u << 16 ? t->stats.scene.motion_q16 : 16u << 16;
    if (t->travel_q16 >= TRAVEL) {
        const uint32_t level = t->config.levels > 1u ? 1u : 0u, side = BLOCK >> level;
        const pf_image *image = &t->pyramid[t->now].level[level];
        t->travel_q16 = 0;
        for (uint32_t y = t->slice; y < t->block_h; y += SLICES)
            for (uint32_t x = 0; x < t->block_w; x++)
                t->is_mask_stale |= t->block[y * t->block_w + x].is_outside
                                        ? serve_outside(&t->block[y * t->block_w + x])
                                        : learn_block(&t->block[y * t->block_w + x], image, x * side, y * side, side,
                                                      MOST_STATIC * t->static_blocks < t->usable_blocks);
        t->slice = (t->slice + 1u) % SLICES;
    }
    if (t->is_mask_stale)
        close_blocks(t);
    t->stats.scene.static_blocks = t->static_blocks;
}

uint32_t pf_mask_clipped(const pf_tracker *t, const pf_image *image, pf_point_q16 at)
{
    const int32_t half = t->klt.half, x = (at.x >> 16) - half, y = (at.y >> 16) - half;
    uint32_t count = 0;
    if (x < 0 || y < 0 || x + t->klt.window > (int32_t)image->width || y + t->klt.window > (int32_t)image->height)
        return 0;
    for (int32_t j = 0; j < t->klt.window; j++) {
        const uint8_t *row = image->data + (size_t)(y + j) * image->stride + (size_t)x;
        for (int32_t i = 0; i < t->klt.window; i++)
            count += row[i] >= BRIGHT || row[i] <= BLACK;
    }
    return count;
}
