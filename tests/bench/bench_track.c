/* Time of the tracker's stages at 1280x800 with 400 tracks: median over 60 frames of a synthetic drive (a textured disc
 * that grows by 1.5 % a frame, noise of 2 grey levels), processor time of one thread. `bench_track N`: N frames; run
 * under callgrind, its clock marks the stages. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "pipefish/track.h"
#include "track_scene.h"

#define WIDTH  1280
#define HEIGHT 800
#define RADIUS 395
#define FRAMES 60

static uint8_t frame[2][WIDTH * HEIGHT];

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
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

int main(int argc, char **argv)
{
    const uint32_t frames = argc > 1 ? (uint32_t)strtoul(argv[1], NULL, 10) : FRAMES;
    static double time_ms[PF_STAGES + 1][FRAMES];
    const pf_tracker_config config = {.width = WIDTH,
                                      .height = HEIGHT,
                                      .circle = {(WIDTH / 2) << 16, (HEIGHT / 2) << 16},
                                      .circle_radius_q16 = (uint32_t)RADIUS << 16};
    const size_t need = (pf_tracker_workspace_size(&config) + 15u) / 16u * 16u;
    void *workspace = aligned_alloc(16, need);
    pf_tracker *tracker;
    uint64_t tracked = 0;
    if (frames > FRAMES || !workspace || pf_tracker_init(&tracker, &config, workspace, need) != PF_OK) {
        fprintf(stderr, "bench_track: bad number of frames, or no memory for the tracker\n");
        free(workspace);
        return 1;
    }
    double zoom = 1;
    for (uint32_t k = 0; k <= frames; k++, zoom *= 1.015) {
        uint64_t stage[PF_STAGES];
        track_scene_frame(frame[k % 2u], WIDTH, HEIGHT, RADIUS, zoom, k);
        (void)pf_tracker_frame(tracker, &(pf_image){frame[k % 2u], WIDTH, HEIGHT, WIDTH}, now_ns, stage);
        if (k == 0)
            continue; /* nothing to track yet */
        for (uint32_t s = 0; s < PF_STAGES; s++) {
            time_ms[s][k - 1u] = (double)stage[s] * 1e-6;
            time_ms[PF_STAGES][k - 1u] += time_ms[s][k - 1u];
        }
        tracked += pf_tracker_last_stats(tracker)->tracked;
    }
    if (frames < FRAMES) { /* counting instructions: no times */
        free(workspace);
        return 0;
    }
    report("track.stage_pyramid", time_ms[PF_STAGE_PYRAMID]);
    report("track.stage_track", time_ms[PF_STAGE_TRACK]);
    report("track.stage_detect", time_ms[PF_STAGE_DETECT]);
    report("track.stage_frame", time_ms[PF_STAGES]);
    printf("{\"name\": \"track.tracked_per_frame\", \"value\": %.1f, \"unit\": \"tracks\"}\n",
           (double)tracked / FRAMES);
    free(workspace);
    return 0;
}
