/* Tracker, bearings and keyframes by parallax on a small drive: a texture that grows by 1/64 a frame. A long one with
 * all that happens to tracks is tests/unit/test_track_golden.c. */
#include "pipefish/track.h"
#include "cameras.h"
#include "hashes.h"

enum { WIDTH = 160, HEIGHT = 120, TEXTURE = 128, FRAMES = 12, TRACKS = 40 };

static uint8_t texture[TEXTURE * TEXTURE], frame[2][WIDTH * HEIGHT];
static _Alignas(16) uint8_t workspace[160000], camera_block[2000], rays_block[20000];
static pf_keyframe_state keyframes;
static _Alignas(16) uint8_t keyframes_block[PF_KEYFRAME_BYTES(TRACKS)];
static pf_ray_q30 rays[2 * TRACKS];

static void make_frame(uint32_t k, uint8_t *out)
{
    const int32_t scale = 65536 - 1024 * (int32_t)k;
    for (int32_t y = 0; y < HEIGHT; y++)
        for (int32_t x = 0; x < WIDTH; x++) {
            const int32_t u = (1000 << 16) + (x - WIDTH / 2) * scale, v = (1000 << 16) + (y - HEIGHT / 2) * scale;
            const int32_t a = (u >> 8) & 255, b = (v >> 8) & 255;
            const uint8_t *row = texture + (v >> 16) % TEXTURE * TEXTURE,
                          *below = texture + ((v >> 16) + 1) % TEXTURE * TEXTURE;
            const int32_t left = (u >> 16) % TEXTURE, right = ((u >> 16) + 1) % TEXTURE;
            out[y * WIDTH + x] = (uint8_t)(((row[left] * (256 - a) + row[right] * a) * (256 - b) +
                                            (below[left] * (256 - a) + below[right] * a) * b) >>
                                           16);
        }
}

uint32_t hash_track(size_t *ram)
{
    pf_tracker_config config = {.width = WIDTH, .height = HEIGHT, .max_tracks = TRACKS, .levels = 3, .window = 11};
    const pf_keyframe_config choice = {.parallax_urad = 30000, .min_common = 10};
    const pf_camera_fixed *fixed;
    const pf_camera_rays *bearings;
    pf_tracker *tracker;
    uint32_t crc = 0, state = 6, tracked = 0;
    for (uint32_t i = 0; i < sizeof texture; i++) /* blocks of 4 x 4 in grey */
        texture[i] = (uint8_t)((i / 4 % 32 * 2654435761u + i / 512 * 2246822519u) >> 24);
    for (uint32_t i = 0; i < sizeof texture; i++)
        texture[i] = (uint8_t)(texture[i] - hash_random(&state) % 3u);
    *ram = pf_tracker_workspace_size(&config);
    if (pf_camera_fixed_init(&fixed, &CAMERAS[0], camera_block, sizeof camera_block) != PF_OK ||
        pf_camera_rays_init(&bearings, fixed, 16, rays_block, sizeof rays_block) != PF_OK)
        return 0;
    config.lens = pf_track_lens_of(bearings, fixed);
    if (pf_tracker_init(&tracker, &config, workspace, sizeof workspace) != PF_OK ||
        pf_keyframe_init(&keyframes, TRACKS, keyframes_block, sizeof keyframes_block) != PF_OK)
        return 0;
    for (uint32_t k = 0; k < FRAMES; k++) {
        const pf_image image = {frame[k % 2u], WIDTH, HEIGHT, WIDTH};
        uint32_t n, common;
        make_frame(k, frame[k % 2u]);
        if (pf_tracker_frame(tracker, &image, NULL, NULL) != PF_OK)
            return 0;
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        pf_track_bearings(bearings, tracks, n, rays);
        for (uint32_t i = 0; i < n; i++) {
            crc = hash_u32(hash_u32(crc, (uint32_t)tracks[i].pos.x), (uint32_t)tracks[i].pos.y);
            crc = hash_u32(hash_u32(hash_u32(crc, (uint32_t)rays[i].x), (uint32_t)rays[i].y), (uint32_t)rays[i].z);
        }
        crc = hash_u32(crc, (uint32_t)pf_keyframe_decide(&keyframes, &choice, tracks, rays, n, NULL, 0, &common));
        tracked += pf_tracker_last_stats(tracker)->tracked;
    }
    return tracked > FRAMES * TRACKS / 4 ? crc : 0;
}
