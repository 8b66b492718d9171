/* A sequence made of integers, replayed through tracker, prediction, states and keyframe choice; its hash must be the
 * same on every target. Shared by test_track_golden (short, everywhere) and golden_replay (as long as asked). */
#ifndef PIPEFISH_TEST_GOLDEN_H
#define PIPEFISH_TEST_GOLDEN_H

#include <string.h>

#include "pipefish/track.h"

#define WIDTH   320
#define HEIGHT  240
#define TEXTURE 512
#define TRACKS  60
#define TURN    60 /* frames after which the sequence runs back, and so on */

static uint8_t texture[TEXTURE * TEXTURE], frame[2][WIDTH * HEIGHT];
static _Alignas(16) uint8_t workspace[400000];
static pf_keyframe_state keyframes;
static _Alignas(16) uint8_t keyframes_block[PF_KEYFRAME_BYTES(TRACKS)];
static pf_ray_q30 rays[PF_TRACKS_MAX];
static pf_expected expected[PF_TRACKS_MAX];
static pf_predictor predictor;
static _Alignas(16) uint8_t predictor_block[PF_PREDICTOR_BYTES(TRACKS)];
static pf_wall wall;
static _Alignas(16) uint8_t wall_block[PF_WALL_BYTES(TRACKS)];
static pf_scene scene;
static _Alignas(16) uint8_t camera_block[4000], rays_block[30000];
static const pf_camera_fixed *camera;
static const pf_camera_rays *table;

static uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 16;
}

/* Random dots, box-filtered twice: corners of a few pixels. */
static void make_texture(void)
{
    uint32_t state = 7;
    for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++)
        texture[i] = next_random(&state) % 5u == 0 ? 255 : 0;
    for (uint32_t pass = 0; pass < 4; pass++) {
        const uint32_t step = pass % 2u ? TEXTURE : 1u;
        for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++) {
            uint32_t sum = 0;
            for (uint32_t k = 0; k < 4u; k++)
                sum += texture[(i + k * step) % (TEXTURE * TEXTURE)];
            texture[i] = (uint8_t)(sum / 4u);
        }
    }
}

/* Frame k: the texture scaled (zooming in), turned and shifted a little more each frame, under light that swells and
 * fades and goes out for a while, with noise. Integers only. */
static void make_frame(uint32_t k, uint8_t *out)
{
    const int32_t i = (int32_t)(k / TURN % 2u ? TURN - k % TURN : k % TURN), scale = 65536 - 350 * i, turn = 150 * i,
                  light = k % 100u >= 92u ? 4 : 200 + 3 * (i % 20);
    uint32_t state = 1000u + k;
    for (int32_t y = 0; y < HEIGHT; y++)
        for (int32_t x = 0; x < WIDTH; x++) {
            const int32_t dx = x - WIDTH / 2, dy = y - HEIGHT / 2;
            const int32_t u = (256 << 16) + dx * scale - dy * turn + i * 12000;
            const int32_t v = (256 << 16) + dx * turn + dy * scale + i * 5000;
            const uint8_t *p = texture + (v >> 16) * TEXTURE + (u >> 16);
            const int32_t a = (u >> 8) & 255, b = (v >> 8) & 255;
            const int32_t top = p[0] * (256 - a) + p[1] * a, bottom = p[TEXTURE] * (256 - a) + p[TEXTURE + 1] * a;
            const int32_t value = (((top * (256 - b) + bottom * b) >> 16) * light >> 7) + 10;
            const int32_t noisy = value + (int32_t)(next_random(&state) % 5u) - 2;
            out[y * WIDTH + x] = (uint8_t)(noisy > 255 ? 255 : noisy < 0 ? 0 : noisy);
        }
}

static uint32_t hash_u32(uint32_t crc, uint32_t v)
{
    const uint8_t bytes[4] = {(uint8_t)v, (uint8_t)(v >> 8), (uint8_t)(v >> 16), (uint8_t)(v >> 24)};
    return pf_crc32c(crc, bytes, 4);
}

static uint32_t hash_track(uint32_t crc, const pf_track *t)
{
    crc = hash_u32(crc, (uint32_t)t->id);
    crc = hash_u32(crc, (uint32_t)t->pos.x);
    crc = hash_u32(crc, (uint32_t)t->pos.y);
    crc = hash_u32(crc, t->cov_xx_q20);
    crc = hash_u32(crc, t->cov_yy_q20);
    crc = hash_u32(crc, (uint32_t)t->cov_xy_q20);
    crc = hash_u32(crc, t->age);
    return hash_u32(crc, (uint32_t)t->status | (uint32_t)t->reason << 8 | (uint32_t)t->quality << 16);
}

/* An equisolid lens of 150 px at 90 degrees. */
static bool make_lens(void)
{
    const pf_camera lens = {.width = WIDTH,
                            .height = HEIGHT,
                            .radial = PF_RADIAL_EQUISOLID,
                            .f_u = 106.066,
                            .f_v = 106.066,
                            .c_u = WIDTH / 2,
                            .c_v = HEIGHT / 2,
                            .theta_max = 1.5707};
    return pf_camera_fixed_init(&camera, &lens, camera_block, sizeof camera_block) == PF_OK &&
           pf_camera_rays_init(&table, camera, 16, rays_block, sizeof rays_block) == PF_OK;
}

/* What came of a replay. */
typedef struct golden {
    uint32_t crc, tracked, keyframes, astray, flags; /* flags: all that were ever set */
} golden;

static uint32_t hash_frame(uint32_t crc, const pf_tracker *tracker, uint32_t flags)
{
    const pf_tracker_stats *s = pf_tracker_last_stats(tracker);
    const pf_scene_measures *m = &s->scene;
    uint32_t n;
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    for (uint32_t i = 0; i < n; i++)
        crc = hash_track(crc, &tracks[i]);
    crc = hash_u32(hash_u32(hash_u32(crc, m->mean_q8), m->texture_q8), m->saturated_q15);
    crc = hash_u32(hash_u32(hash_u32(crc, m->low), m->median), m->high);
    crc = hash_u32(hash_u32(hash_u32(crc, m->motion_q16), m->drift_q16), m->static_blocks);
    crc = hash_u32(hash_u32(hash_u32(crc, m->outward), m->inward), m->moved);
    return hash_u32(hash_u32(hash_u32(crc, s->age_median), s->quality_median), flags);
}

static uint32_t hash_guesses(uint32_t crc, const pf_track *tracks, uint32_t n, const pf_motion_hints *hints)
{
    pf_predictor_guess(&predictor, tracks, rays, n, hints, pf_track_project, camera, expected);
    for (uint32_t i = 0; i < n; i++) {
        crc = hash_u32(hash_u32(crc, (uint32_t)expected[i].at.x), (uint32_t)expected[i].at.y);
        for (uint32_t k = 0; k < 4u; k++)
            crc = hash_u32(crc, (uint32_t)expected[i].warp_q16[k]);
    }
    return crc;
}

static uint32_t hash_settled(uint32_t crc, const pf_track *tracks, uint32_t n)
{
    static pf_track settled[2 * TRACKS];
    memcpy(settled, tracks, n * sizeof *tracks);
    pf_wall_settle(&wall, settled, n, pf_track_project, camera);
    for (uint32_t i = 0; i < n; i++)
        crc = hash_u32(hash_u32(crc, (uint32_t)settled[i].pos.x), (uint32_t)settled[i].pos.y);
    return crc;
}

/* False: the tracker could not be made. */
static bool golden_replay(uint32_t frames, golden *out)
{
    *out = (golden){0, 0, 0, 0, 0};
    if (!make_lens())
        return false;
    const pf_tracker_config config = {.width = WIDTH,
                                      .height = HEIGHT,
                                      .max_tracks = TRACKS,
                                      .window = 15,
                                      .circle = {(WIDTH / 2) << 16, (HEIGHT / 2) << 16},
                                      .circle_radius_q16 = 150u << 16,
                                      .has_wall = true,
                                      .lens = pf_track_lens_of(table, camera)};
    const pf_keyframe_config choice = {.step_counts = 30, .parallax_urad = 60000, .min_common = 40};
    pf_tracker *tracker;
    make_texture();
    if (pf_keyframe_init(&keyframes, TRACKS, keyframes_block, sizeof keyframes_block) != PF_OK ||
        pf_predictor_init(&predictor, TRACKS, predictor_block, sizeof predictor_block) != PF_OK ||
        pf_wall_init(&wall, TRACKS, wall_block, sizeof wall_block) != PF_OK ||
        pf_tracker_init(&tracker, &config, workspace, sizeof workspace) != PF_OK)
        return false;
    for (uint32_t k = 0; k < frames; k++) {
        const pf_image image = {frame[k % 2u], WIDTH, HEIGHT, WIDTH};
        /* for 20 frames in each 40 there is no encoder */
        const pf_motion_hints hints = {k % 40u >= 20u, true, 7 * (int64_t)k, (int32_t)(k % 50u) * 2000, 1};
        const pf_scene_hints light = {false, false, hints.has_encoder, hints.encoder};
        uint32_t n, common;
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        make_frame(k, frame[k % 2u]);
        if (k % 3u) { /* now and then without a prediction */
            const pf_motion_hints leap = {true, false, hints.encoder + 300, 0, 1}; /* so fast that patches grow */
            out->crc = hash_guesses(out->crc, tracks, n, &leap);
            out->crc = hash_guesses(out->crc, tracks, n, &hints);
            if (pf_tracker_expect(tracker, expected, n) != PF_OK)
                return false;
        }
        int64_t axis[4];
        const uint64_t third = hints.has_encoder ? pf_keyframe_third(&keyframes, &choice, hints.encoder) : 0;
        const int64_t way = pf_predictor_way(&predictor, &hints, third);
        const bool is_known = pf_wall_axis_of(&wall, axis);
        out->crc = hash_u32(out->crc, (uint32_t)way);
        pf_tracker_foresee(tracker, way > 0 ? way : PF_WAY_USUAL, is_known ? axis : NULL);
        if (pf_tracker_frame(tracker, &image, NULL, NULL) != PF_OK)
            return false;
        tracks = pf_tracker_tracks(tracker, &n);
        pf_track_bearings(table, tracks, n, rays);
        static uint16_t astray[TRACKS];
        const uint32_t lost = pf_wall_check(&wall, tracks, rays, n, pf_track_project, camera, 20000, astray);
        for (uint32_t i = 0; i < lost; i++)
            out->crc = hash_u32(out->crc, astray[i]);
        out->astray += lost;
        if (k % 2u) /* now and then they stay */
            pf_tracker_give_up(tracker, astray, lost);
        if (k % 4u == 0)
            out->crc = hash_settled(out->crc, tracks, n);
        pf_predictor_learn(&predictor, tracks, rays, n, &hints);
        for (uint32_t i = 0; i < 10u; i++)
            out->crc = hash_u32(out->crc, (uint32_t)wall.motion[i]);
        const uint32_t flags = pf_scene_update(&scene, &pf_tracker_last_stats(tracker)->scene, &light);
        const pf_keyframe_cause cause = pf_keyframe_decide(&keyframes, &choice, tracks, rays, n,
                                                           hints.has_encoder ? &hints.encoder : NULL, flags, &common);
        out->crc = hash_u32(hash_frame(out->crc, tracker, flags), (uint32_t)cause << 16 | common);
        out->keyframes += cause != PF_KEYFRAME_NO;
        out->tracked += pf_tracker_last_stats(tracker)->tracked;
        out->flags |= flags;
    }
    return true;
}

#endif
