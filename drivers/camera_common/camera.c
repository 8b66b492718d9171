/* The driver of every camera that is not a recording: waits for frames, sets the exposure, and brings the camera back
 * when it stalls or is unplugged. What the system itself does is its session's affair. */
#include "camera_common/session.h"
#include "camera_common/timing.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <turbojpeg.h>

#define SPARE_BUFFERS 3u /* left to be filled while all that may be held are; with fewer, frames are copied */

#define DEFAULT_BUFFERS (PF_CAMERA_HELD_MAX + SPARE_BUFFERS)

/* A frame that the daemon has: a buffer of the camera's, or a copy. */
typedef struct held {
    bool is_used, is_copy, is_kept; /* is_kept: the camera has gone, its memory is ours */
    uint32_t buffer;
    uint8_t *pixels, *copy;
} held;

typedef struct driver {
    pf_camera_info info;
    pf_session_io io;
    pf_session_wish wish;
    pf_session_info session; /* of the camera as it was opened last */
    char *device;
    pf_exposure_mode mode;
    uint32_t exposure_us, exposure_max_us;
    double gain;
    bool is_started, is_open, is_streaming;
    held held[PF_CAMERA_HELD_MAX];
    void *turbo;
    pf_exposure exposure;
    bool has_exposure; /* values were set before: a camera that comes back gets them again */
    pf_numbering numbering;
    pf_recovery recovery;
    uint64_t damaged, left_ns; /* when next() returned last */
    pf_failure failure;
} driver;

static uint64_t now_ns(const driver *c)
{
    return c->io.now(c->io.self);
}

static void detach(driver *c)
{
    if (!c->is_open)
        return;
    if (c->is_streaming)
        c->io.stop(c->io.self);
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        held *h = &c->held[i];
        if (h->is_used && !h->is_copy && !h->is_kept) {
            c->io.keep(c->io.self, h->buffer);
            h->is_kept = true;
        }
    }
    c->io.close(c->io.self);
    c->is_open = c->is_streaming = false;
}

/* Whether a control is ours to set: what is fixed without a value stays as others set it. */
static bool is_ours(const driver *c, double fixed)
{
    return c->mode != PF_EXPOSURE_DEVICE && (c->mode != PF_EXPOSURE_FIXED || fixed > 0);
}

static bool sets_time(const driver *c)
{
    return c->session.has_time && is_ours(c, c->exposure_us);
}

static bool sets_gain(const driver *c)
{
    return c->session.has_gain && is_ours(c, c->gain);
}

static void set_exposure(driver *c)
{
    const bool is_automatic = c->mode == PF_EXPOSURE_DEVICE;
    if (is_automatic || sets_time(c) || sets_gain(c))
        c->io.set(c->io.self, is_automatic, is_ours(c, c->exposure_us) ? c->exposure.time_now : PF_SESSION_AS_IS,
                  is_ours(c, c->gain) ? c->exposure.gain_now : PF_SESSION_AS_IS);
}

static pf_status begin_exposure(driver *c)
{
    const pf_session_info *s = &c->session;
    pf_exposure *e = &c->exposure;
    const bool can_time = s->has_time && s->time_unit_us > 0, is_fixed = c->mode == PF_EXPOSURE_FIXED;
    e->time = s->has_time ? s->time : (pf_exposure_range){1, 1, 1};
    e->gain = s->has_gain ? s->gain : (pf_exposure_range){1, 1, 1};
    if (can_time && !is_fixed && c->exposure_max_us > 0) {
        int64_t most = (int64_t)((double)c->exposure_max_us / s->time_unit_us);
        if (most < e->time.max)
            e->time.max = most > e->time.min ? most : e->time.min;
    }
    if (is_fixed && ((c->exposure_us > 0 && !can_time) || (c->gain > 0 && !s->has_gain)))
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: has no control for the %s that is to be fixed", s->id,
                       c->exposure_us > 0 && !can_time ? "exposure" : "gain");
    if (!c->has_exposure) {
        int64_t time = s->has_time ? s->time_now : 1, gain = s->has_gain ? s->gain_now : 1;
        if (is_fixed && c->exposure_us > 0)
            time = llround((double)c->exposure_us / s->time_unit_us);
        if (is_fixed && c->gain > 0)
            gain = llround(c->gain * s->gain_unit);
        e->holds = c->mode == PF_EXPOSURE_HOLD;
        pf_exposure_init(e, time, gain);
        c->has_exposure = true;
    }
    set_exposure(c);
    return PF_OK;
}

/* A camera that has come back must give what the tracker was opened for. */
static pf_status check_size(driver *c)
{
    const pf_session_info *s = &c->session;
    if (c->info.width != 0 && (s->width != c->info.width || s->height != c->info.height))
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: gives %u x %u now, before it gave %u x %u", s->id,
                       s->width, s->height, c->info.width, c->info.height);
    if (s->width < 1 || s->height < 1 || s->width > PF_IMAGE_SIZE_MAX || s->height > PF_IMAGE_SIZE_MAX)
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: frames of %u x %u: must be 1..%u", s->id, s->width,
                       s->height, PF_IMAGE_SIZE_MAX);
    if (s->buffers < PF_SESSION_BUFFERS_MIN)
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: gives %u buffers; %u are needed", s->id, s->buffers,
                       PF_SESSION_BUFFERS_MIN);
    return PF_OK;
}

static pf_status attach(driver *c)
{
    pf_status status = c->io.open(c->io.self, &c->wish, &c->session, &c->failure);
    if (status != PF_OK)
        return status;
    c->is_open = true;
    status = check_size(c);
    if (status == PF_OK)
        status = begin_exposure(c);
    if (status != PF_OK) {
        detach(c);
        return status;
    }
    c->info.width = c->wish.width = c->session.width; /* one that is plugged in again may be set otherwise */
    c->info.height = c->wish.height = c->session.height;
    c->info.frame_rate = c->session.frame_rate > 0 ? c->session.frame_rate : c->wish.frame_rate;
    if (c->info.frame_rate > 0)
        c->numbering.period_ns = c->recovery.period_ns = (uint64_t)(1e9 / c->info.frame_rate);
    return PF_OK;
}

static pf_status begin_stream(driver *c)
{
    pf_status status = c->io.start(c->io.self, &c->failure);
    c->is_streaming = status == PF_OK;
    if (c->is_streaming)
        pf_numbering_restart(&c->numbering);
    return status;
}

static bool bring_up(driver *c)
{
    pf_status status = c->is_open ? PF_OK : attach(c);
    if (status == PF_OK)
        status = begin_stream(c);
    if (status != PF_OK)
        detach(c);
    return status == PF_OK;
}

static bool restart(driver *c)
{
    c->io.stop(c->io.self);
    return begin_stream(c) == PF_OK;
}

/* Does what the recovery asks for. True: there is a stream to wait on. */
static bool recover(driver *c)
{
    switch (pf_recovery_next(&c->recovery, now_ns(c))) {
    case PF_RECOVERY_WAIT:
        break;
    case PF_RECOVERY_OPEN:
        (bring_up(c) ? pf_recovery_opened : pf_recovery_closed)(&c->recovery, now_ns(c));
        break;
    case PF_RECOVERY_RESTART:
        if (restart(c)) {
            pf_recovery_restarted(&c->recovery, now_ns(c));
            break;
        }
        /* fall through */
    case PF_RECOVERY_REOPEN:
        detach(c);
        pf_recovery_closed(&c->recovery, now_ns(c));
        break;
    }
    return c->is_streaming;
}

/* Grey pixels in a buffer of ours. */
static pf_status copy_frame(driver *c, const pf_session_frame *f, uint8_t *to)
{
    const pf_session_info *s = &c->session;
    if (s->format->layout == PF_LAYOUT_JPEG)
        return pf_jpeg_to_grey(c->turbo, f->pixels, f->n, s->width, s->height, to, &c->failure);
    pf_pixels_to_grey(s->format, f->pixels, s->width, s->height, s->stride, to);
    return PF_OK;
}

static void report_exposure(const driver *c, const pf_session_frame *f, pf_telemetry *t)
{
    const pf_session_info *s = &c->session;
    t->has_exposure = f->exposure_us > 0 || (sets_time(c) && s->time_unit_us > 0);
    t->has_gain = f->gain > 0 || sets_gain(c);
    t->exposure_us = f->exposure_us;
    t->gain = f->gain;
    if (t->has_exposure && f->exposure_us == 0)
        t->exposure_us = (uint32_t)llround((double)c->exposure.time_now * s->time_unit_us);
    if (t->has_gain && !(f->gain > 0))
        t->gain = (double)c->exposure.gain_now / s->gain_unit;
}

/* The middle of the exposure, as far as the session tells. */
static uint64_t middle_of(const pf_session_frame *f, const pf_telemetry *t)
{
    uint64_t half = t->has_exposure ? (uint64_t)t->exposure_us * 500u : 0;
    if (f->stamp_ns == 0 || f->is_stamp_first)
        return f->stamp_ns == 0 ? 0 : f->stamp_ns + half;
    return f->stamp_ns > half ? f->stamp_ns - half : f->stamp_ns;
}

/* Makes a frame of a filled buffer. PF_ERR_CHECKSUM: it is damaged, and the camera has it back. */
static pf_status make_frame(driver *c, const pf_session_frame *f, held *h, pf_frame *frame)
{
    const pf_session_info *s = &c->session;
    pf_status status = PF_OK;
    memset(frame, 0, sizeof *frame);
    if (f->is_damaged || !pf_pixel_format_fits(s->format, s->width, s->height, s->stride, f->n))
        status =
            pf_fail(&c->failure, PF_ERR_CHECKSUM, "%s: frame %u of %zu bytes is damaged", s->id, f->sequence, f->n);
    h->is_copy = s->format->layout != PF_LAYOUT_LUMA || s->buffers < PF_CAMERA_HELD_MAX + SPARE_BUFFERS;
    if (status == PF_OK && h->is_copy)
        status = copy_frame(c, f, h->copy);
    if (h->is_copy || status != PF_OK)
        c->io.give(c->io.self, f->buffer);
    if (status != PF_OK)
        return status;
    h->is_used = true;
    h->is_kept = false;
    h->buffer = f->buffer;
    h->pixels = f->pixels;
    frame->handle = h;
    frame->image = h->is_copy ? (pf_image){h->copy, s->width, s->height, s->width}
                              : (pf_image){h->pixels, s->width, s->height, s->stride};
    report_exposure(c, f, &frame->telemetry);
    pf_numbering_take(&c->numbering, f->sequence, middle_of(f, &frame->telemetry), now_ns(c), &frame->sequence,
                      &frame->time_ns);
    return PF_OK;
}

static pf_status wait_for_frame(driver *c, uint64_t end, held *h, pf_frame *frame)
{
    for (;;) {
        pf_session_frame f = {0};
        bool is_streaming = recover(c);
        uint64_t now = now_ns(c);
        uint32_t left_ms = now < end ? (uint32_t)((end - now + 999999u) / 1000000u) : 0;
        if (!is_streaming) {
            if (left_ms == 0)
                return PF_ERR_CLOSED;
            c->io.sleep(c->io.self, left_ms < 20 ? left_ms : 20);
            continue;
        }
        pf_status status = c->io.take(c->io.self, left_ms, &f, &c->failure);
        if (status == PF_OK)
            status = make_frame(c, &f, h, frame);
        now = now_ns(c);
        if (status == PF_OK) {
            pf_recovery_frame(&c->recovery, now);
            bool is_led = c->mode != PF_EXPOSURE_FIXED && (sets_time(c) || sets_gain(c));
            if (is_led && pf_exposure_judge(&c->exposure, &frame->image))
                set_exposure(c);
            return PF_OK;
        }
        if (status == PF_ERR_CHECKSUM) {
            c->damaged++;
            pf_recovery_damaged(&c->recovery, now);
        } else if (status == PF_ERR_CLOSED) {
            pf_recovery_unplug(&c->recovery);
        } else if (status == PF_ERR_IO) {
            pf_recovery_error(&c->recovery);
        }
        if (now >= end)
            return PF_ERR_AGAIN;
    }
}

static pf_status camera_next(void *self, uint32_t timeout_ms, pf_frame *frame)
{
    driver *c = self;
    const uint64_t now = now_ns(c);
    held *h = NULL;
    if (!c->is_started)
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: not started", c->info.source);
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX && h == NULL; i++)
        h = c->held[i].is_used ? NULL : &c->held[i];
    if (h == NULL)
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: %u frames are held already", c->info.source,
                       PF_CAMERA_HELD_MAX);
    if (c->is_streaming)
        pf_recovery_pause(&c->recovery, now - c->left_ns);
    pf_status status = wait_for_frame(c, now + (uint64_t)timeout_ms * 1000000u, h, frame);
    c->left_ns = now_ns(c);
    return status;
}

static void camera_release(void *self, pf_frame *frame)
{
    driver *c = self;
    held *h = frame->handle;
    if (h == NULL)
        return;
    if (h->is_kept)
        c->io.drop(c->io.self, h->pixels);
    else if (!h->is_copy)
        c->io.give(c->io.self, h->buffer);
    h->is_used = h->is_kept = false;
    frame->handle = NULL;
    frame->image.data = NULL;
}

static const pf_camera_info *camera_info(void *self)
{
    return &((driver *)self)->info;
}

static pf_status camera_start(void *self)
{
    driver *c = self;
    c->recovery.is_open = false;
    c->recovery.retry_ns = now_ns(c);
    c->is_started = true;
    return PF_OK; /* next() opens it, now or once it is there */
}

static pf_status camera_stop(void *self)
{
    driver *c = self;
    c->is_started = false;
    detach(c);
    return PF_OK;
}

static void camera_stats(void *self, pf_camera_stats *stats)
{
    const driver *c = self;
    *stats = (pf_camera_stats){.is_there = c->is_streaming,
                               .damaged = c->damaged,
                               .restarts = c->recovery.restarts,
                               .reopens = c->recovery.reopens,
                               .bad_stamps = c->numbering.bad_times + c->numbering.bad_counts};
}

static const char *camera_error(void *self)
{
    return ((driver *)self)->failure.text;
}

static void camera_close(void *self)
{
    driver *c = self;
    detach(c);
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        if (c->held[i].is_used && c->held[i].is_kept)
            c->io.drop(c->io.self, c->held[i].pixels);
        free(c->held[i].copy);
    }
    c->io.end(c->io.self);
    if (c->turbo != NULL)
        (void)tjDestroy(c->turbo);
    free(c->device);
    free(c);
}

static pf_status check(driver *c, const pf_camera_config *config)
{
    const char *name = c->info.source;
    if ((config->width == 0) != (config->height == 0))
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: width and height go together", name);
    if (config->buffers != 0 && (config->buffers < PF_SESSION_BUFFERS_MIN || config->buffers > PF_SESSION_BUFFERS_MAX))
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: %u buffers: must be %u..%u", name, config->buffers,
                       PF_SESSION_BUFFERS_MIN, PF_SESSION_BUFFERS_MAX);
    if (config->format != NULL && config->format[0] != '\0') {
        c->wish.format = pf_pixel_format_named(config->format);
        if (c->wish.format == NULL)
            return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: format %s is not read", name, config->format);
    }
    return PF_OK;
}

static pf_status open_parts(driver *c, const pf_camera_config *config, const char *kind)
{
    const char *device = config->device != NULL ? config->device : "";
    /* Not the camera's own name: a survey goes on over restarts, whether the camera is there at the start or not. */
    (void)snprintf(c->info.source, sizeof c->info.source, "%s%s%s", kind, device[0] ? " " : "", device);
    pf_status status = check(c, config);
    if (status != PF_OK)
        return status;
    c->device = strdup(device);
    c->turbo = tjInitDecompress();
    if (c->device == NULL || c->turbo == NULL)
        return pf_fail(&c->failure, PF_ERR_SPACE, "%s: no memory", kind);
    c->wish.device = c->device;
    pf_recovery_init(&c->recovery, 0, now_ns(c));
    pf_numbering_init(&c->numbering, 0);
    status = attach(c);
    if (status != PF_OK && !(status == PF_ERR_AGAIN && config->width != 0))
        return status == PF_ERR_AGAIN ? PF_ERR_IO : status;
    if (status != PF_OK) {
        c->info.width = config->width;
        c->info.height = config->height;
        c->info.frame_rate = config->frame_rate;
    }
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        c->held[i].copy = malloc((size_t)c->info.width * c->info.height);
        if (c->held[i].copy == NULL)
            return pf_fail(&c->failure, PF_ERR_SPACE, "%s: no memory for frames", kind);
    }
    return PF_OK;
}

pf_status pf_camera_open(pf_camera_source *source, const pf_camera_config *config, const pf_session_io *io,
                         const char *kind, char *error, size_t n)
{
    static const pf_camera_source_ops ops = {.info = camera_info,
                                             .start = camera_start,
                                             .next = camera_next,
                                             .release = camera_release,
                                             .stop = camera_stop,
                                             .stats = camera_stats,
                                             .error = camera_error,
                                             .close = camera_close};
    pf_failure failure = {""};
    driver *c = calloc(1, sizeof *c);
    if (c == NULL) {
        io->end(io->self);
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "%s: no memory", kind), error, n);
    }
    c->io = *io;
    c->wish.width = config->width;
    c->wish.height = config->height;
    c->wish.frame_rate = config->frame_rate;
    c->wish.buffers = config->buffers != 0 ? config->buffers : DEFAULT_BUFFERS;
    c->mode = config->mode;
    c->exposure_us = config->exposure_us;
    c->exposure_max_us = config->exposure_max_us;
    c->gain = config->gain;
    c->exposure.circle_u = config->circle_u;
    c->exposure.circle_v = config->circle_v;
    c->exposure.circle_radius = config->circle_radius;
    pf_status status = open_parts(c, config, kind);
    if (status != PF_OK) {
        pf_failure_copy(&c->failure, status, error, n);
        camera_close(c);
        return status;
    }
    source->self = c;
    source->ops = &ops;
    return PF_OK;
}
