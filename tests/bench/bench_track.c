/* Time of the tracker's stages at 1280x800 with 400 tracks: median over 60 frames of a synthetic drive (a textured disc
 * that grows by 1.5 % a frame, noise of 2 grey levels), one thread. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "pipefish/track.h"

#define WIDTH   1280
#define HEIGHT  800
#define RADIUS  395
#define FRAMES  60
#define TEXTURE 1024u

static uint8_t texture[TEXTURE * TEXTURE], frame[2][WIDTH * HEIGHT];

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

static uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 16;
}

/* Random dots, box-filtered along both directions. */
static void make_texture(void)
{
    uint32_t state = 7;
    for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++)
        texture[i] = next_random(&state) % 6u == 0 ? 255 : 0;
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

static void make_frame(uint8_t *out, double zoom, uint32_t seed)
{
    uint32_t state = seed;
    for (int y = 0; y < HEIGHT; y++)
        for (int x = 0; x < WIDTH; x++) {
            const int dx = x - WIDTH / 2, dy = y - HEIGHT / 2;
            int v = 10;
            if (dx * dx + dy * dy <= RADIUS * RADIUS) {
                const int32_t u = (int32_t)((5000 + dx / zoom) * 256), w = (int32_t)((5000 + dy / zoom) * 256);
                const int a = u & 255, b = w & 255;
                const uint32_t x0 = (uint32_t)(u >> 8) % TEXTURE, y0 = (uint32_t)(w >> 8) % TEXTURE;
                const uint32_t x1 = (x0 + 1u) % TEXTURE, y1 = (y0 + 1u) % TEXTURE;
                const int top = texture[y0 * TEXTURE + x0] * (256 - a) + texture[y0 * TEXTURE + x1] * a;
                const int bottom = texture[y1 * TEXTURE + x0] * (256 - a) + texture[y1 * TEXTURE + x1] * a;
                v = 60 + (((top * (256 - b) + bottom * b) >> 16) * 3 / 2);
            }
            v += (int)(next_random(&state) % 7u) - 3;
            out[y * WIDTH + x] = (uint8_t)(v < 0 ? 0 : v > 255 ? 255 : v);
        }
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void report(const char *name, double *ms)
{
    qsort(ms, FRAMES, sizeof *ms, by_value);
    printf("{\"name\": \"%s\", \"value\": %.3f, \"unit\": \"ms\"}\n", name, ms[FRAMES / 2]);
}

int main(void)
{
    static double time_ms[PF_STAGES + 1][FRAMES];
    const pf_tracker_config config = {.width = WIDTH,
                                      .height = HEIGHT,
                                      .circle = {(WIDTH / 2) << 16, (HEIGHT / 2) << 16},
                                      .circle_radius_q16 = (uint32_t)RADIUS << 16};
    const size_t need = (pf_tracker_workspace_size(&config) + 15u) / 16u * 16u;
    void *workspace = aligned_alloc(16, need);
    pf_tracker *tracker;
    uint64_t tracked = 0;
    if (!workspace || pf_tracker_init(&tracker, &config, workspace, need) != PF_OK) {
        fprintf(stderr, "bench_track: no memory for the tracker\n");
        free(workspace);
        return 1;
    }
    make_texture();
    double zoom = 1;
    for (uint32_t k = 0; k <= FRAMES; k++, zoom *= 1.015) {
        uint64_t stage[PF_STAGES];
        make_frame(frame[k % 2u], zoom, k);
        (void)pf_tracker_frame(tracker, &(pf_image){frame[k % 2u], WIDTH, HEIGHT, WIDTH}, now_ns, stage);
        if (k == 0)
            continue; /* nothing to track yet */
        for (uint32_t s = 0; s < PF_STAGES; s++) {
            time_ms[s][k - 1u] = (double)stage[s] * 1e-6;
            time_ms[PF_STAGES][k - 1u] += time_ms[s][k - 1u];
        }
        tracked += pf_tracker_last_stats(tracker)->tracked;
    }
    report("track.pyramid", time_ms[PF_STAGE_PYRAMID]);
    report("track.klt_light", time_ms[PF_STAGE_TRACK]);
    report("track.detect", time_ms[PF_STAGE_DETECT]);
    report("track.frame", time_ms[PF_STAGES]);
    printf("{\"name\": \"track.tracked_per_frame\", \"value\": %.1f, \"unit\": \"tracks\"}\n",
           (double)tracked / FRAMES);
    free(workspace);
    return 0;
}
