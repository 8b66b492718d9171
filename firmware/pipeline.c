#include "pipeline.h"

#include <stdlib.h>
#include <string.h>

#include "index.h"
#include "log.h"
#include "objects.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/jpeg.h"
#include "pipefish/drivers/sha256.h"
#include "pulse.h"
#include "tracking.h"
#include "utf8.h"
#include "worker.h"

#define PREVIEW_OVERHEAD 128u /* most bytes of a preview message without its JPEG: six numbers and their tags */
#define NEXT_TIMEOUT_MS  100u /* how long a stop may go unnoticed while the camera is silent */
#define UNCOUNTED_MAX    30u  /* frames without an encoder count after which that is said */

#define SHOTS PF_CAMERA_HELD_MAX /* the tracker's reference, the frame being tracked, the one that is being taken */

struct pf_pipeline {
    pf_daemon *daemon;
    pf_courier *courier;
    pthread_t thread;
    bool is_started;
    _Atomic bool is_done;
    pf_shot shot[SHOTS];
    bool has_failed;
    pf_worker *worker; /* who tracks; NULL = the capture thread */
    pf_tracking *tracking;
    pf_jpeg *jpeg;
    uint8_t preview[PF_PREVIEW_MAX];
    uint64_t preview_due;
    bool is_stretched;                        /* ... or they are the same */
    bool is_gone;                             /* the camera */
    pf_index *index;                          /* of frames; NULL = none */
    uint8_t stretched[256];                   /* grey levels of the camera -> 0..255 */
    uint32_t preview_quality, preview_shrink; /* of the last preview */
    uint32_t next_index;
    uint32_t uncounted; /* frames from the start on that came without an encoder count */
    uint32_t boots;
    char break_reason[PF_BREAK_REASON_MAX]; /* "" = tracks go on */
};

/* ---- opening */

static bool open_shots(pf_pipeline *p, char *error, size_t n)
{
    const pf_camera_info *info = p->daemon->camera.ops->info(p->daemon->camera.self);
    const bool is_copied = p->is_stretched || !p->daemon->config.camera.zero_copy;
    for (uint32_t i = 0; i < SHOTS; i++) {
        pf_shot *shot = &p->shot[i];
        if (is_copied)
            shot->pixels = malloc((size_t)info->width * info->height);
        shot->tracks = calloc(2 * (size_t)p->daemon->config.tracker.max_tracks, sizeof *shot->tracks);
        if (shot->tracks == NULL || (is_copied && shot->pixels == NULL)) {
            (void)snprintf(error, n, "no memory for frames");
            return false;
        }
    }
    return true;
}

/* A camera of limited range would never be dark, nor saturated, to any of the tracker's limits. */
static void open_levels(pf_pipeline *p)
{
    const uint32_t black = p->daemon->config.camera.black_level, range = p->daemon->config.camera.white_level - black;
    for (uint32_t v = 0; v < 256; v++) {
        const uint32_t above = v > black ? v - black : 0;
        p->stretched[v] = (uint8_t)(above >= range ? 255u : (255u * above + range / 2) / range);
    }
    p->is_stretched = black != 0 || range != 255;
}

static bool open_jpeg(pf_pipeline *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    pf_jpeg_config j = {.width = info->width,
                        .height = info->height,
                        .quality = d->config.keyframe.jpeg_quality,
                        .preview_quality = d->config.status.preview_quality};
    j.circle_radius = pf_tracking_circle(d, &j.circle_u, &j.circle_v);
    return pf_jpeg_open(&p->jpeg, &j, error, n) == PF_OK;
}

static void release(pf_pipeline *p)
{
    pf_worker_close(p->worker);
    pf_jpeg_close(p->jpeg);
    for (uint32_t i = 0; i < SHOTS; i++) {
        free(p->shot[i].pixels);
        free(p->shot[i].tracks);
    }
    pf_index_close(p->index);
    pf_tracking_close(p->tracking);
    free(p);
}

static bool open_parts(pf_pipeline *p, char *error, size_t n)
{
    return pf_tracking_open(&p->tracking, p->daemon, error, n) && open_shots(p, error, n) && open_jpeg(p, error, n) &&
           (p->daemon->config.daemon.threads <= 1 ||
            pf_worker_open(&p->worker, pf_tracking_shot, p->tracking, error, n));
}

bool pf_pipeline_can_open(pf_daemon *daemon, char *error, size_t n)
{
    pf_pipeline *p = calloc(1, sizeof *p);
    if (p == NULL) {
        (void)snprintf(error, n, "no memory");
        return false;
    }
    p->daemon = daemon;
    open_levels(p);
    bool can = open_parts(p, error, n);
    release(p);
    return can;
}

bool pf_pipeline_open(pf_pipeline **pipeline, pf_daemon *daemon, pf_courier *courier, const pf_survey *survey,
                      const pf_survey *before, char *error, size_t n)
{
    pf_pipeline *p = calloc(1, sizeof *p);
    if (p == NULL) {
        (void)snprintf(error, n, "no memory");
        return false;
    }
    p->daemon = daemon;
    p->courier = courier;
    p->preview_quality = daemon->config.status.preview_quality;
    p->preview_shrink = PF_JPEG_PREVIEW_SHRINK;
    p->next_index = survey->next_index;
    p->boots = survey->boots;
    if (survey->next_index > 0) /* else no boot before came to make a keyframe */
        (void)snprintf(p->break_reason, sizeof p->break_reason, "restart");
    open_levels(p);
    if (!open_parts(p, error, n) ||
        (daemon->config.camera.index[0] != '\0' &&
         !pf_index_open(&p->index, daemon->config.camera.index, survey->id, survey->boots, error, n)) ||
        (before->boots > 0 && !pf_object_interrupted(daemon, before, error, n)) || !pf_object_start(daemon, error, n)) {
        release(p);
        return false;
    }
    *pipeline = p;
    return true;
}

/* ---- one frame */

/* An encoder that is in the settings, and not in the recording or on the board, costs the survey its scale. */
static void warn_of_silence(pf_pipeline *p, bool has_encoder)
{
    if (has_encoder || p->uncounted >= UNCOUNTED_MAX || p->daemon->config.encoder.metres_per_count == 0)
        p->uncounted = UNCOUNTED_MAX; /* it was told, or there is nothing to tell */
    else if (++p->uncounted == UNCOUNTED_MAX)
        pf_log(PF_LOG_WARNING,
               "encoder.metres_per_count is set, but %u frames came without an encoder count: keyframes by common "
               "tracks only, and the survey has no scale of its own",
               UNCOUNTED_MAX);
}

static pf_msg_telemetry read_telemetry(pf_pipeline *p, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    const pf_telemetry *t = &frame->telemetry;
    pf_msg_telemetry m = {.time = {d->boot_id, frame->time_ns},
                          .has_encoder = t->has_encoder,
                          .has_attitude = t->has_attitude,
                          .has_exposure = t->has_exposure,
                          .has_gain = t->has_gain,
                          .has_lamp = t->has_lamp,
                          .encoder_count = t->encoder_count,
                          .roll_rad = (float)t->roll_rad,
                          .pitch_rad = (float)t->pitch_rad,
                          .attitude_sigma_rad = (float)t->attitude_sigma_rad,
                          .exposure_us = t->exposure_us,
                          .gain = (float)t->gain,
                          .lamp = (float)t->lamp};
    double lamp;
    if (!m.has_encoder)
        m.has_encoder =
            d->gpio.ops->encoder(d->gpio.self, frame->time_ns, &m.encoder_count, &m.encoder_missed) == PF_OK;
    warn_of_silence(p, m.has_encoder);
    if (!m.has_lamp && d->gpio.ops->lamp(d->gpio.self, &lamp) == PF_OK) {
        m.has_lamp = true;
        m.lamp = (float)lamp;
    }
    pf_gpio_state gpio;
    d->gpio.ops->state(d->gpio.self, &gpio);
    m.emergency_stop = gpio.is_stopped;
    m.limit_front = gpio.limits & PF_LIMIT_FRONT;
    m.limit_rear = gpio.limits & PF_LIMIT_REAR;
    return m;
}

static void make_preview(pf_pipeline *p, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    uint64_t now = pf_now();
    bool is_wanted;
    size_t n;
    pf_msg_preview preview = {.time = {d->boot_id, frame->time_ns}, .frame_sequence = frame->sequence};
    pf_jpeg_preview made;
    if (d->config.status.preview_interval_ms == 0 || now < p->preview_due)
        return;
    pthread_mutex_lock(&d->counters.mutex);
    is_wanted = d->counters.link_up;
    pthread_mutex_unlock(&d->counters.mutex);
    if (!is_wanted)
        return;
    p->preview_due = now + (uint64_t)d->config.status.preview_interval_ms * 1000000u;
    if (pf_jpeg_encode_preview(p->jpeg, &frame->image, sizeof p->preview - PREVIEW_OVERHEAD, &made) != PF_OK) {
        pf_log(PF_LOG_WARNING, "preview: %s", pf_jpeg_error(p->jpeg));
        return;
    }
    if (made.quality != p->preview_quality || made.shrink != p->preview_shrink)
        pf_log(PF_LOG_WARNING, "previews are too large: from now on 1/%u of the size, quality %u", made.shrink,
               made.quality);
    p->preview_quality = made.quality;
    p->preview_shrink = made.shrink;
    preview.width = made.width;
    preview.height = made.height;
    preview.jpeg = made.bytes;
    preview.jpeg_size = made.n;
    if (pf_msg_encode_preview(&preview, p->preview, sizeof p->preview, &n) == PF_OK)
        pf_courier_preview(p->courier, p->preview, n);
}

/* ---- before and after: by the capture thread */

static void give_still(pf_pipeline *p, const pf_shot *shot, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    const pf_msg_raw_frame raw = {.time = {d->boot_id, frame->time_ns},
                                  .frame_sequence = frame->sequence,
                                  .image = frame->image,
                                  .telemetry = shot->telemetry};
    if (pf_still_take(d->still, &raw))
        pf_courier_wake(p->courier);
}

/* Gives back what a slot holds of the driver's. */
static void drop_shot(pf_pipeline *p, pf_shot *shot)
{
    if (shot->frame.handle != NULL)
        p->daemon->camera.ops->release(p->daemon->camera.self, &shot->frame);
    shot->frame.handle = NULL;
}

/* Copies the pixels, with their levels stretched, and gives the driver's buffer back at once. */
static void copy_pixels(pf_pipeline *p, pf_shot *shot, pf_frame *frame)
{
    const pf_image *image = &frame->image;
    for (uint32_t y = 0; y < image->height; y++) {
        const uint8_t *from = image->data + (size_t)y * image->stride;
        uint8_t *to = shot->pixels + (size_t)y * image->width;
        if (!p->is_stretched)
            memcpy(to, from, image->width);
        else
            for (uint32_t x = 0; x < image->width; x++)
                to[x] = p->stretched[from[x]];
    }
    shot->frame.image = (pf_image){shot->pixels, image->width, image->height, image->width};
    shot->frame.handle = NULL;
    p->daemon->camera.ops->release(p->daemon->camera.self, frame);
}

/* Takes the driver's frame over. */
static void take_shot(pf_pipeline *p, pf_shot *shot, pf_frame *frame)
{
    shot->telemetry = read_telemetry(p, frame);
    give_still(p, shot, frame);
    if (p->index != NULL && !frame->has_sha256)
        frame->has_sha256 = pf_sha256_image(&frame->image, frame->sha256) == PF_OK;
    shot->frame = *frame;
    if (shot->pixels != NULL)
        copy_pixels(p, shot, frame);
    if (p->index != NULL)
        pf_index_add(p->index, shot);
}

static void count_shot(pf_pipeline *p, const pf_shot *shot, uint64_t keyframe_ns)
{
    pf_counters *c = &p->daemon->counters;
    pthread_mutex_lock(&c->mutex);
    c->frames_dropped += shot->missing;
    c->frames_tracked++;
    c->tracks_live = shot->stats.live;
    c->tracks_new = shot->stats.detected;
    c->tracks_lost = shot->stats.lost;
    pf_tracking_count(&c->tracking, &shot->stats, shot->tracking.scene);
    for (int i = 0; i < PF_STAGES; i++)
        c->stage_ns[i] += shot->stage_ns[i];
    if (shot->track_ns + keyframe_ns > c->frame_max_ns)
        c->frame_max_ns = shot->track_ns + keyframe_ns;
    if (shot->cause != PF_KEYFRAME_NO) {
        c->keyframes++;
        c->keyframe_ns += keyframe_ns;
    }
    c->last_ns = pf_now();
    c->telemetry = shot->telemetry;
    pthread_mutex_unlock(&c->mutex);
}

/* Makes a keyframe of a tracked frame if it is one, counts it and shows it. */
static void finish_shot(pf_pipeline *p, const pf_shot *shot)
{
    const uint64_t start = pf_now();
    if (shot->break_reason[0] != '\0')
        memcpy(p->break_reason, shot->break_reason, sizeof p->break_reason);
    if (shot->cause != PF_KEYFRAME_NO) {
        if (pf_object_keyframe(p->daemon, p->jpeg, shot, p->next_index, p->break_reason))
            p->break_reason[0] = '\0';
        else
            pf_store_lose(p->daemon->store, p->next_index);
        p->next_index++;
    }
    count_shot(p, shot, pf_now() - start);
    make_preview(p, &shot->frame);
}

/* ---- the survey */

/* Counts what the camera has been through, and says when it goes and comes. */
static void watch_camera(pf_pipeline *p, pf_status status)
{
    pf_daemon *d = p->daemon;
    pf_camera_stats stats;
    if (status == PF_ERR_CLOSED && !p->is_gone)
        pf_log(PF_LOG_WARNING, "no camera: %s", d->camera.ops->error(d->camera.self));
    else if (status == PF_OK && p->is_gone)
        pf_log(PF_LOG_INFO, "the camera is there");
    if (status == PF_OK || status == PF_ERR_CLOSED)
        p->is_gone = status == PF_ERR_CLOSED;
    d->gpio.ops->indicate(d->gpio.self, p->is_gone ? PF_INDICATE_TROUBLE : PF_INDICATE_WORK);
    d->camera.ops->stats(d->camera.self, &stats);
    pthread_mutex_lock(&d->counters.mutex);
    d->counters.camera = stats;
    pthread_mutex_unlock(&d->counters.mutex);
}

/* Two steps overlap: while shot k is tracked, k - 1 is finished and k + 1 taken; one waits for the other before the
 * next step, so nothing queues up. Without a worker the same steps come one after the other. */
static void capture(pf_pipeline *p, char *reason, size_t reason_n)
{
    pf_daemon *d = p->daemon;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    pf_counters *c = &d->counters;
    uint64_t waited = pf_now();
    pf_shot *pending = NULL; /* being tracked */
    uint32_t next = 0;
    pf_status status = d->camera.ops->start(d->camera.self);

    pthread_mutex_lock(&c->mutex);
    c->first_ns = c->last_ns = waited;
    pthread_mutex_unlock(&c->mutex);
    (void)snprintf(reason, reason_n, "end of recording");
    while (status == PF_OK || status == PF_ERR_AGAIN || status == PF_ERR_CLOSED) {
        pf_frame frame;
        pf_pulse_work(); /* next() waits for NEXT_TIMEOUT_MS at most */
        if (atomic_load(&d->stop) != PF_STOP_NO) {
            (void)snprintf(reason, reason_n, "%s",
                           atomic_load(&d->stop) == PF_STOP_TERMINATED ? "terminated" : "stopped by the operator");
            break;
        }
        pf_shot *shot = &p->shot[next], *tracked = pending;
        drop_shot(p, shot);
        status = d->camera.ops->next(d->camera.self, NEXT_TIMEOUT_MS, &frame);
        watch_camera(p, status);
        if (status == PF_OK) {
            pthread_mutex_lock(&c->mutex);
            c->frames++;
            c->capture_ns += pf_now() - waited;
            pthread_mutex_unlock(&c->mutex);
            if (frame.image.width != info->width || frame.image.height != info->height) {
                d->camera.ops->release(d->camera.self, &frame);
                (void)snprintf(reason, reason_n, "camera failed: a frame of another size");
                p->has_failed = true;
                break;
            }
            take_shot(p, shot, &frame);
        }
        if (tracked && p->worker)
            pf_worker_wait(p->worker);
        pending = NULL;
        if (status == PF_OK) {
            next = (next + 1) % SHOTS;
            if (p->worker) {
                pf_worker_give(p->worker, shot);
                pending = shot;
            } else {
                pf_tracking_shot(p->tracking, shot);
                tracked = shot;
            }
        }
        if (tracked)
            finish_shot(p, tracked);
        waited = pf_now();
    }
    if (pending) {
        pf_worker_wait(p->worker);
        finish_shot(p, pending);
    }
    for (uint32_t i = 0; i < SHOTS; i++)
        drop_shot(p, &p->shot[i]);
    if (status != PF_OK && status != PF_ERR_AGAIN && status != PF_ERR_CLOSED && status != PF_ERR_END) {
        p->has_failed = true;
        (void)snprintf(reason, reason_n, "camera failed: %s", d->camera.ops->error(d->camera.self));
    }
}

static void *run(void *argument)
{
    pf_pipeline *p = argument;
    pf_daemon *d = p->daemon;
    char reason[512];

    pf_pulse_begin(PF_PULSE_CAPTURE);
    capture(p, reason, sizeof reason);
    (void)d->camera.ops->stop(d->camera.self);
    pf_utf8_clean(reason);
    atomic_store(&d->state, PF_STATE_DRAINING);
    d->gpio.ops->indicate(d->gpio.self, PF_INDICATE_SEND);
    pf_log(p->has_failed ? PF_LOG_ERROR : PF_LOG_INFO, "survey ends: %s; %u keyframes", reason, p->next_index);
    pf_object_end(d, p->next_index, p->boots, reason);
    pf_pulse_rest();
    atomic_store(&p->is_done, true);
    return NULL;
}

bool pf_pipeline_start(pf_pipeline *p, char *error, size_t n)
{
    p->is_started = pthread_create(&p->thread, NULL, run, p) == 0;
    if (!p->is_started)
        (void)snprintf(error, n, "cannot start the capture thread");
    return p->is_started;
}

bool pf_pipeline_is_done(pf_pipeline *p)
{
    return atomic_load(&p->is_done);
}

bool pf_pipeline_close(pf_pipeline *p)
{
    bool has_failed;
    if (p->is_started)
        (void)pthread_join(p->thread, NULL);
    has_failed = p->has_failed;
    release(p);
    return !has_failed;
}
