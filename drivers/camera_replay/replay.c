/* A recording as a camera: which frame is due when, loops, stamps, and the check of the recorded hashes. */
#include "replay.h"

#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>

#define BUFFERS            PF_CAMERA_HELD_MAX
#define DEFAULT_FRAME_RATE 10.0
#define SECOND_NS          1000000000u

typedef struct buffer {
    uint8_t *pixels;
    bool held; /* by the caller */
} buffer;

typedef struct replay {
    pf_camera_info info;
    char *path, *csv_path;
    bool is_folder, has_csv, started;
    pf_y4m y4m;
    pf_folder folder;
    pf_csv csv;
    pf_replay_speed speed;
    uint32_t loops;
    uint64_t frames;        /* of one loop */
    uint64_t period_ns;     /* between frames: nominal, or the mean of the recorded times */
    uint64_t loop_sequence; /* what a loop adds to sequence and time */
    uint64_t loop_ns;
    uint64_t index, loop; /* of the frame to come */
    uint64_t start_ns;    /* monotonic clock at start() */
    uint64_t start_time;  /* recorded time of the frame that was due at start() */
    buffer buffers[BUFFERS];
    pf_failure failure;
} replay;

/* Recorded time of frame `index` of loop `loop`. */
static uint64_t time_of(const replay *r, uint64_t index, uint64_t loop)
{
    uint64_t in_loop =
        r->has_csv ? r->csv.rows[index].time_ns : (uint64_t)llround((double)index * SECOND_NS / r->info.frame_rate);
    return in_loop + loop * r->loop_ns;
}

/* When the frame to come is due. */
static uint64_t due_ns(const replay *r, uint64_t index, uint64_t loop)
{
    return r->start_ns + (time_of(r, index, loop) - r->start_time);
}

static bool is_over(const replay *r)
{
    return r->loops != 0 && r->loop >= r->loops;
}

static void advance(uint64_t frames, uint64_t *index, uint64_t *loop)
{
    if (++*index == frames) {
        *index = 0;
        ++*loop;
    }
}

static const pf_camera_info *replay_info(void *self)
{
    replay *r = self;
    return &r->info;
}

static pf_status replay_start(void *self)
{
    replay *r = self;
    r->started = true;
    r->start_ns = pf_now();
    r->start_time = is_over(r) ? 0 : time_of(r, r->index, r->loop);
    return PF_OK;
}

static pf_status replay_stop(void *self)
{
    replay *r = self;
    r->started = false;
    return PF_OK;
}

/* Waits until the frame to come is due, and skips those a live camera would have dropped: frames more than a period
 * late whose successor is due already. The last frame is never skipped. */
static pf_status wait_until_due(replay *r, uint32_t timeout_ms)
{
    uint64_t now = pf_now(), due = due_ns(r, r->index, r->loop);
    if (now < due) {
        uint64_t until = now + (uint64_t)timeout_ms * 1000000u;
        if (until > due)
            until = due;
        struct timespec t = {(time_t)(until / SECOND_NS), (long)(until % SECOND_NS)};
        (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL); /* a signal ends it early: AGAIN */
        return pf_now() < due ? PF_ERR_AGAIN : PF_OK;
    }
    for (;;) {
        uint64_t index = r->index, loop = r->loop;
        advance(r->frames, &index, &loop);
        if (r->loops != 0 && loop >= r->loops)
            return PF_OK;
        if (now < due_ns(r, index, loop) || now - due_ns(r, r->index, r->loop) <= r->period_ns)
            return PF_OK;
        r->index = index;
        r->loop = loop;
    }
}

static pf_status read_pixels(replay *r, uint64_t index, uint8_t *pixels)
{
    if (r->is_folder)
        return pf_folder_read(&r->folder, index, pixels, &r->failure);
    return pf_y4m_read(&r->y4m, index, pixels, &r->failure);
}

static pf_status check_hash(replay *r, uint64_t index, const pf_image *image)
{
    uint8_t hash[32];
    if (!r->has_csv || !r->csv.rows[index].has_sha256)
        return PF_OK;
    if (pf_sha256_image(image, hash) != PF_OK)
        return pf_fail(&r->failure, PF_ERR_IO, "%s: frame %" PRIu64 ": libcrypto failed", r->path, index);
    if (memcmp(hash, r->csv.rows[index].sha256, sizeof hash) != 0)
        return pf_fail(&r->failure, PF_ERR_CHECKSUM,
                       "%s: frame %" PRIu64 ": its pixels do not have the sha256 of %s:%" PRIu64,
                       r->is_folder ? r->folder.names[index] : r->path, index, r->csv_path, PF_CSV_LINE(index));
    return PF_OK;
}

static pf_status replay_next(void *self, uint32_t timeout_ms, pf_frame *frame)
{
    replay *r = self;
    buffer *free_buffer = NULL;
    if (!r->started)
        return pf_fail(&r->failure, PF_ERR_ARGUMENT, "%s: not started", r->path);
    if (is_over(r))
        return PF_ERR_END;
    for (uint32_t i = 0; i < BUFFERS && free_buffer == NULL; i++)
        if (!r->buffers[i].held)
            free_buffer = &r->buffers[i];
    if (free_buffer == NULL)
        return pf_fail(&r->failure, PF_ERR_ARGUMENT, "%s: %u frames are held already", r->path, BUFFERS);
    if (r->speed == PF_REPLAY_RECORDED) {
        pf_status status = wait_until_due(r, timeout_ms);
        if (status != PF_OK)
            return status;
    }
    uint64_t index = r->index, loop = r->loop;
    advance(r->frames, &r->index, &r->loop);
    pf_image image = {free_buffer->pixels, r->info.width, r->info.height, r->info.width};
    pf_status status = read_pixels(r, index, free_buffer->pixels);
    if (status == PF_OK)
        status = check_hash(r, index, &image);
    if (status != PF_OK)
        return status;
    memset(frame, 0, sizeof *frame);
    frame->image = image;
    frame->sequence = index;
    if (r->has_csv) {
        const pf_csv_row *row = &r->csv.rows[index];
        frame->sequence = row->sequence;
        frame->telemetry = row->telemetry;
        frame->has_sha256 = row->has_sha256;
        memcpy(frame->sha256, row->sha256, sizeof frame->sha256);
    }
    frame->sequence += loop * r->loop_sequence;
    frame->time_ns = due_ns(r, index, loop);
    frame->recorded_ns = time_of(r, index, loop);
    frame->handle = free_buffer;
    free_buffer->held = true;
    return PF_OK;
}

static void replay_release(void *self, pf_frame *frame)
{
    (void)self;
    buffer *b = frame->handle;
    if (b != NULL)
        b->held = false;
    frame->handle = NULL;
    frame->image.data = NULL;
}

static void replay_stats(void *self, pf_camera_stats *stats)
{
    (void)self;
    *stats = (pf_camera_stats){.is_there = true};
}

static const char *replay_error(void *self)
{
    replay *r = self;
    return r->failure.text;
}

static void replay_close(void *self)
{
    replay *r = self;
    if (r->is_folder)
        pf_folder_close(&r->folder);
    else if (r->y4m.offset != NULL)
        pf_y4m_close(&r->y4m);
    pf_csv_free(&r->csv);
    for (uint32_t i = 0; i < BUFFERS; i++)
        free(r->buffers[i].pixels);
    free(r->path);
    free(r->csv_path);
    free(r);
}

static pf_status check_config(const pf_replay_config *config, pf_failure *failure)
{
    if (config->path == NULL || config->path[0] == '\0')
        return pf_fail(failure, PF_ERR_ARGUMENT, "replay: no path");
    if (config->speed != PF_REPLAY_RECORDED && config->speed != PF_REPLAY_FAST)
        return pf_fail(failure, PF_ERR_ARGUMENT, "replay: unknown speed %d", (int)config->speed);
    if (!isfinite(config->frame_rate) || config->frame_rate < 0 || config->frame_rate > 1e6 ||
        (config->frame_rate > 0 && config->frame_rate < 1e-3))
        return pf_fail(failure, PF_ERR_ARGUMENT, "replay: frame rate %g: must be 0 or 0.001..1000000",
                       config->frame_rate);
    return PF_OK;
}

static pf_status open_pictures(replay *r, pf_replay_config config)
{
    struct stat info;
    pf_status status;
    if (stat(config.path, &info) != 0)
        return pf_fail(&r->failure, PF_ERR_IO, "%s: %s", config.path, strerror(errno));
    if (S_ISDIR(info.st_mode)) {
        r->is_folder = true;
        status = pf_folder_open(&r->folder, r->path, &r->failure);
        r->info.width = r->folder.width;
        r->info.height = r->folder.height;
        r->frames = r->folder.frames;
    } else {
        status = pf_y4m_open(&r->y4m, r->path, &r->failure);
        r->info.width = r->y4m.width;
        r->info.height = r->y4m.height;
        r->info.frame_rate = r->y4m.frame_rate;
        r->frames = r->y4m.frames;
    }
    return status;
}

/* The path of the telemetry when the configuration names none. */
static char *default_csv_path(const replay *r)
{
    char *path;
    size_t n = strlen(r->path);
    if (!r->is_folder && n > 4 && strcmp(r->path + n - 4, ".y4m") == 0)
        n -= 4;
    if (asprintf(&path, "%.*s%s", (int)n, r->path, r->is_folder ? "/telemetry.csv" : ".csv") < 0)
        return NULL;
    return path;
}

static pf_status open_csv(replay *r, const char *named)
{
    r->csv_path = named != NULL ? strdup(named) : default_csv_path(r);
    if (r->csv_path == NULL)
        return pf_fail(&r->failure, PF_ERR_SPACE, "%s: no memory", r->path);
    pf_failure failure = {""};
    pf_status status = pf_csv_read(&r->csv, r->csv_path, &failure);
    if (status == PF_ERR_END && named == NULL)
        return PF_OK;
    if (status != PF_OK) {
        r->failure = failure;
        return status == PF_ERR_END ? PF_ERR_IO : status;
    }
    r->has_csv = true;
    if (r->csv.n != r->frames)
        return pf_fail(&r->failure, PF_ERR_FORMAT,
                       "%s:%" PRIu64 ": column sequence: %" PRIu64 " rows for the %" PRIu64 " frames of %s",
                       r->csv_path, PF_CSV_LINE(r->csv.n < r->frames ? r->csv.n : r->frames), r->csv.n, r->frames,
                       r->path);
    return PF_OK;
}

/* Frame rate, period, and what a loop adds. */
static void plan(replay *r, double frame_rate, uint64_t loop_gap)
{
    uint64_t n = r->frames;
    if (r->info.frame_rate <= 0 && r->has_csv && n > 1)
        r->info.frame_rate =
            (double)(n - 1) * SECOND_NS / (double)(r->csv.rows[n - 1].time_ns - r->csv.rows[0].time_ns);
    if (r->info.frame_rate <= 0)
        r->info.frame_rate = frame_rate > 0 ? frame_rate : DEFAULT_FRAME_RATE;
    r->period_ns = (uint64_t)llround(SECOND_NS / r->info.frame_rate);
    if (r->period_ns == 0)
        r->period_ns = 1;
    r->loop_sequence = r->has_csv ? r->csv.rows[n - 1].sequence - r->csv.rows[0].sequence + 1 : n;
    r->loop_sequence += loop_gap;
    r->loop_ns = r->has_csv ? r->csv.rows[n - 1].time_ns - r->csv.rows[0].time_ns + r->period_ns
                            : (uint64_t)llround((double)n * SECOND_NS / r->info.frame_rate);
    if (r->loops != 0)
        r->info.frames = n > UINT64_MAX / r->loops ? 0 : n * r->loops;
}

static pf_status open_parts(replay *r, const pf_replay_config *config)
{
    r->path = strdup(config->path);
    if (r->path == NULL)
        return pf_fail(&r->failure, PF_ERR_SPACE, "%s: no memory", config->path);
    pf_status status = open_pictures(r, *config);
    if (status == PF_OK)
        status = open_csv(r, config->csv);
    if (status != PF_OK)
        return status;
    r->speed = config->speed;
    r->loops = config->loops;
    plan(r, config->frame_rate, config->loop_gap);
    (void)snprintf(r->info.source, sizeof r->info.source, "replay %s", r->path);
    for (uint32_t i = 0; i < BUFFERS; i++) {
        r->buffers[i].pixels = malloc((size_t)r->info.width * r->info.height);
        if (r->buffers[i].pixels == NULL)
            return pf_fail(&r->failure, PF_ERR_SPACE, "%s: no memory for frames of %u x %u", r->path, r->info.width,
                           r->info.height);
    }
    return read_pixels(r, 0, r->buffers[0].pixels);
}

pf_status pf_replay_open(pf_camera_source *source, const pf_replay_config *config, char *error, size_t n)
{
    static const pf_camera_source_ops ops = {
        .info = replay_info,
        .start = replay_start,
        .next = replay_next,
        .release = replay_release,
        .stop = replay_stop,
        .stats = replay_stats,
        .error = replay_error,
        .close = replay_close,
    };
    pf_failure failure = {""};
    pf_status status = check_config(config, &failure);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    replay *r = calloc(1, sizeof *r);
    if (r == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "%s: no memory", config->path), error, n);
    status = open_parts(r, config);
    if (status != PF_OK) {
        pf_failure_copy(&r->failure, status, error, n);
        replay_close(r);
        return status;
    }
    source->self = r;
    source->ops = &ops;
    return PF_OK;
}
