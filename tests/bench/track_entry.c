/* Doors into the tracker for Python (ctypes), so that its parts and OpenCV's run in one process in alternation
 * (track_peers.py) and on the same closed-form images (tests/accept_track.py). Pixels and points cross as they are:
 * uint8 images without padding, points as (n, 2) float32. */
#include <stdlib.h>

#include "../../lib/track/track_private.h"
#include "track_scene.h"

#define LEVELS 4u

typedef struct entry {
    pf_pyramid pyramid[2];
    pf_klt klt;
    pf_anchor anchor;
    uint8_t pixels[(WINDOW_MAX + 2) * (WINDOW_MAX + 2) + 8];
    uint32_t width, height;
    pf_tracker *tracker;
    void *block[3];
} entry;

entry *entry_new(uint32_t width, uint32_t height, uint32_t max_tracks, uint32_t cell, uint32_t min_eigen,
                 uint32_t noise_q8);
void entry_free(entry *e);
void entry_scene(uint8_t *out, int width, int height, double zoom, uint32_t seed);
void entry_pyramid(entry *e, uint32_t which, const uint8_t *data);
uint32_t entry_klt(entry *e, const float *from, const float *guess, uint32_t n, int affine, float *to, uint8_t *ok);
uint32_t entry_frame(entry *e, const uint8_t *data);
uint32_t entry_tracks(const entry *e, uint64_t *id, float *xy, float *cov, uint8_t *status, uint32_t room);
void entry_reset(entry *e);
size_t entry_memory(uint32_t width, uint32_t height, uint32_t tracks, uint32_t step);

void entry_free(entry *e)
{
    for (uint32_t i = 0; e && i < 3; i++)
        free(e->block[i]);
    free(e);
}

entry *entry_new(uint32_t width, uint32_t height, uint32_t max_tracks, uint32_t cell, uint32_t min_eigen,
                 uint32_t noise_q8)
{
    const pf_tracker_config config = {.width = width,
                                      .height = height,
                                      .max_tracks = max_tracks,
                                      .cell = cell,
                                      .min_eigen = min_eigen,
                                      .noise_q8 = noise_q8};
    const size_t size[3] = {pf_pyramid_workspace_size(width, height, LEVELS),
                            pf_pyramid_workspace_size(width, height, LEVELS), pf_tracker_workspace_size(&config)};
    entry *e = calloc(1, sizeof *e);
    for (uint32_t i = 0; e && i < 3; i++)
        e->block[i] = aligned_alloc(64, (size[i] + 63u) / 64u * 64u);
    if (!e || pf_pyramid_init(&e->pyramid[0], width, height, LEVELS, e->block[0], size[0]) != PF_OK ||
        pf_pyramid_init(&e->pyramid[1], width, height, LEVELS, e->block[1], size[1]) != PF_OK ||
        pf_tracker_init(&e->tracker, &config, e->block[2], size[2]) != PF_OK) {
        entry_free(e);
        return NULL;
    }
    e->width = width;
    e->height = height;
    pf_klt_init(&e->klt, 21, 10, 1, noise_q8 ? noise_q8 : 512);
    return e;
}

void entry_scene(uint8_t *out, int width, int height, double zoom, uint32_t seed)
{
    track_scene_frame(out, width, height, 0, zoom, seed);
}

void entry_pyramid(entry *e, uint32_t which, const uint8_t *data)
{
    (void)pf_pyramid_build(&e->pyramid[which], &(pf_image){data, e->width, e->height, e->width});
}

/* Every point from pyramid 0 to pyramid 1, from its guess, through all levels; with `affine` the template fit does the
 * finest, as in the tracker. Returns how many are ok. */
uint32_t entry_klt(entry *e, const float *from, const float *guess, uint32_t n, int affine, float *to, uint8_t *ok)
{
    uint32_t good = 0;
    for (uint32_t i = 0; i < n; i++) {
        const pf_point_q16 p = {(int32_t)(from[2 * i] * 65536), (int32_t)(from[2 * i + 1] * 65536)};
        pf_point_q16 at = {(int32_t)(guess[2 * i] * 65536), (int32_t)(guess[2 * i + 1] * 65536)};
        pf_fit fit = pf_klt_track(&e->klt, &e->pyramid[0], &e->pyramid[1], p, &at, LEVELS - 1u, affine ? 1 : 0);
        if (affine) {
            pf_anchor_take(&e->klt, &e->pyramid[0].level[0], p, &e->anchor, e->pixels);
            fit = pf_anchor_fit(&e->klt, &e->pyramid[1].level[0], &e->anchor, e->pixels, &at);
        }
        to[2 * i] = (float)at.x / 65536;
        to[2 * i + 1] = (float)at.y / 65536;
        ok[i] = fit.reason == PF_TRACK_OK;
        good += ok[i];
    }
    return good;
}

void entry_reset(entry *e)
{
    pf_tracker_reset(e->tracker);
}

/* One frame of the tracker; returns the live tracks. */
uint32_t entry_frame(entry *e, const uint8_t *data)
{
    (void)pf_tracker_frame(e->tracker, &(pf_image){data, e->width, e->height, e->width}, NULL, NULL);
    return pf_tracker_last_stats(e->tracker)->live;
}

uint32_t entry_tracks(const entry *e, uint64_t *id, float *xy, float *cov, uint8_t *status, uint32_t room)
{
    uint32_t n;
    const pf_track *t = pf_tracker_tracks(e->tracker, &n);
    n = n < room ? n : room;
    for (uint32_t i = 0; i < n; i++) {
        id[i] = t[i].id;
        xy[2 * i] = (float)t[i].pos.x / 65536;
        xy[2 * i + 1] = (float)t[i].pos.y / 65536;
        cov[3 * i] = (float)t[i].cov_xx_q20 / 1048576;
        cov[3 * i + 1] = (float)t[i].cov_xy_q20 / 1048576;
        cov[3 * i + 2] = (float)t[i].cov_yy_q20 / 1048576;
        status[i] = t[i].status;
    }
    return n;
}

/* Bytes of all that tracking keeps between frames, the frames themselves apart: tracker, prediction, wall, keyframe
 * choice, scene, bearings and guesses of the table, and an equidistant lens of 180 degrees with its table of rays. */
size_t entry_memory(uint32_t width, uint32_t height, uint32_t tracks, uint32_t step)
{
    const pf_tracker_config config = {.width = width, .height = height, .max_tracks = tracks};
    const double f = (double)height / 3.1416;
    const pf_camera lens = {.width = width,
                            .height = height,
                            .radial = PF_RADIAL_EQUIDISTANT,
                            .f_u = f,
                            .f_v = f,
                            .c_u = width / 2.0,
                            .c_v = height / 2.0,
                            .theta_max = 1.57};
    const size_t fixed = pf_camera_fixed_workspace_size(&lens);
    const pf_camera_fixed *camera;
    void *block = aligned_alloc(16, (fixed + 15) / 16 * 16);
    size_t sum = 0;
    if (block && pf_camera_fixed_init(&camera, &lens, block, fixed) == PF_OK)
        sum = fixed + pf_camera_rays_workspace_size(camera, step) + pf_tracker_workspace_size(&config) +
              PF_PREDICTOR_BYTES(tracks) + sizeof(pf_predictor) + PF_KEYFRAME_BYTES(tracks) +
              sizeof(pf_keyframe_state) + sizeof(pf_scene) + PF_WALL_BYTES(tracks) + sizeof(pf_wall) +
              tracks * sizeof(uint16_t) + 2 * (size_t)tracks * (sizeof(pf_ray_q30) + sizeof(pf_expected));
    free(block);
    return sum;
}
