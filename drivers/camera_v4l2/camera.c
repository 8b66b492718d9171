/* A V4L2 camera: opens it, waits for frames, and brings it back when it stalls or is unplugged. */
#include "camera_v4l2/v4l2.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <turbojpeg.h>

#define DEFAULT_BUFFERS 6u /* those held, and as many to be filled meanwhile */

pf_status pf_v4l2_call(pf_v4l2 *c, unsigned long request, void *argument, const char *what)
{
    if (c->io.ioctl(c->io.self, c->fd, request, argument) == 0)
        return PF_OK;
    return pf_fail(&c->failure, PF_ERR_IO, "%s: %s: %s", c->device, what, strerror(errno));
}

static void detach(pf_v4l2 *c)
{
    if (c->fd < 0)
        return;
    pf_v4l2_stream_end(c);
    c->io.close(c->io.self, c->fd);
    c->fd = -1;
}

/* Opens and negotiates. *is_absent: nothing is plugged in under this path, or it has no picture to give yet. */
static pf_status attach(pf_v4l2 *c, bool *is_absent)
{
    c->fd = c->io.open(c->io.self, c->device);
    *is_absent = c->fd < 0 && (errno == ENOENT || errno == ENODEV || errno == ENXIO);
    if (c->fd < 0)
        return pf_fail(&c->failure, PF_ERR_IO, "%s: %s", c->device, strerror(errno));
    pf_status status = pf_v4l2_negotiate(c);
    if (status == PF_OK)
        status = pf_v4l2_controls_open(c);
    *is_absent = status == PF_ERR_AGAIN;
    if (status != PF_OK)
        detach(c);
    else if (c->info.frame_rate > 0)
        c->numbering.period_ns = c->recovery.period_ns = (uint64_t)(1e9 / c->info.frame_rate);
    return status;
}

/* Opens what is not open and starts it; all or nothing. */
static pf_status bring_up(pf_v4l2 *c)
{
    bool is_absent;
    pf_status status = c->fd < 0 ? attach(c, &is_absent) : PF_OK;
    if (status == PF_OK)
        status = pf_v4l2_stream_begin(c);
    if (status != PF_OK)
        detach(c);
    else
        pf_numbering_restart(&c->numbering);
    return status;
}

/* Does what the recovery asks for. True: there is a stream to wait on. */
static bool recover(pf_v4l2 *c, uint64_t now)
{
    switch (pf_recovery_next(&c->recovery, now)) {
    case PF_RECOVERY_WAIT:
        break;
    case PF_RECOVERY_OPEN:
        if (bring_up(c) == PF_OK)
            pf_recovery_opened(&c->recovery, c->io.now(c->io.self));
        else
            pf_recovery_closed(&c->recovery, c->io.now(c->io.self));
        break;
    case PF_RECOVERY_RESTART:
        if (pf_v4l2_stream_restart(c) == PF_OK) {
            pf_numbering_restart(&c->numbering);
            pf_recovery_restarted(&c->recovery, c->io.now(c->io.self));
            break;
        }
        /* fall through */
    case PF_RECOVERY_REOPEN:
        detach(c);
        pf_recovery_closed(&c->recovery, c->io.now(c->io.self));
        break;
    }
    return c->is_streaming;
}

static pf_v4l2_scratch *find_scratch(pf_v4l2 *c)
{
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++)
        if (!c->scratch[i].is_held)
            return &c->scratch[i];
    return NULL;
}

/* Grey pixels of a buffer of a format that is not grey as it lies. */
static pf_status convert(pf_v4l2 *c, const pf_v4l2_buffer *b, size_t n, pf_v4l2_scratch *to)
{
    const uint32_t width = c->info.width, height = c->info.height;
    if (c->format->layout != PF_LAYOUT_JPEG) {
        pf_pixels_to_grey(c->format, b->memory, width, height, c->stride, to->pixels);
        return PF_OK;
    }
    return pf_jpeg_to_grey(c->turbo, b->memory, n, width, height, to->pixels, &c->failure);
}

/* Moment of the kernel's stamp, of whatever clock (the numbering believes it only if it can be of ours), that is the
 * middle of the exposure, as far as the driver tells; 0 = it has none. */
static uint64_t stamp_of(const pf_v4l2 *c, const struct v4l2_buffer *b)
{
    uint64_t half = 0, stamp = (uint64_t)b->timestamp.tv_sec * 1000000000u + (uint64_t)b->timestamp.tv_usec * 1000u;
    if (b->timestamp.tv_sec < 0)
        return 0;
    if (c->time_control.is_there && c->time_unit_us > 0)
        half = (uint64_t)((double)c->exposure.time_now * c->time_unit_us * 500);
    if ((b->flags & V4L2_BUF_FLAG_TSTAMP_SRC_MASK) == V4L2_BUF_FLAG_TSTAMP_SRC_SOE)
        return stamp + half;
    return stamp > half ? stamp - half : stamp;
}

/* Makes a frame of a filled buffer. PF_ERR_CHECKSUM: it is damaged, and the kernel has it back. */
static pf_status make_frame(pf_v4l2 *c, pf_v4l2_buffer *b, const struct v4l2_buffer *taken, size_t n, pf_frame *frame)
{
    const uint32_t width = c->info.width, height = c->info.height;
    pf_status status = PF_OK;
    memset(frame, 0, sizeof *frame);
    if (!pf_pixel_format_fits(c->format, width, height, c->stride, n)) {
        status = pf_fail(&c->failure, PF_ERR_CHECKSUM, "%s: a frame of %zu bytes is too short", c->device, n);
    } else if (c->format->layout == PF_LAYOUT_LUMA) {
        b->is_held = true;
        b->stream->held++;
        frame->handle = b;
        frame->image = (pf_image){b->memory, width, height, c->stride};
    } else {
        pf_v4l2_scratch *to = find_scratch(c); /* next() has seen that fewer are held than there are */
        status = convert(c, b, n, to);
        if (status == PF_OK) {
            to->is_held = true;
            frame->handle = to;
            frame->image = (pf_image){to->pixels, width, height, width};
        }
    }
    uint64_t now = c->io.now(c->io.self);
    if (status == PF_OK)
        pf_numbering_take(&c->numbering, taken->sequence, stamp_of(c, taken), now, &frame->sequence, &frame->time_ns);
    pf_v4l2_stream_queue(c);
    return status;
}

/* Waits for a frame until `end`. */
static pf_status wait_for_frame(pf_v4l2 *c, uint64_t now, uint64_t end, pf_frame *frame)
{
    for (;; now = c->io.now(c->io.self)) {
        pf_v4l2_buffer *buffer;
        struct v4l2_buffer taken;
        size_t n;
        bool is_streaming = recover(c, now);
        uint32_t left_ms = now < end ? (uint32_t)((end - now + 999999u) / 1000000u) : 0;
        if (!is_streaming) {
            if (left_ms == 0)
                return PF_ERR_CLOSED;
            c->io.sleep(c->io.self, left_ms < 20 ? left_ms : 20);
            continue;
        }
        pf_v4l2_stream_queue(c);
        int ready = c->io.wait(c->io.self, c->fd, left_ms);
        pf_status status = ready == 0 ? PF_ERR_AGAIN : pf_v4l2_stream_take(c, &buffer, &taken, &n);
        if (status == PF_OK)
            status = make_frame(c, buffer, &taken, n, frame);
        now = c->io.now(c->io.self);
        if (status == PF_OK) {
            pf_recovery_frame(&c->recovery, now);
            c->held++;
            pf_v4l2_controls_report(c, &frame->telemetry);
            pf_v4l2_controls_judge(c, &frame->image);
            return PF_OK;
        }
        if (status == PF_ERR_CHECKSUM) {
            c->damaged++;
            pf_recovery_frame(&c->recovery, now); /* damaged, but not silent */
        } else if (status == PF_ERR_CLOSED) {
            pf_recovery_unplug(&c->recovery);
        } else if (status == PF_ERR_IO || ready < 0) {
            pf_recovery_error(&c->recovery);
        }
        if (now >= end)
            return PF_ERR_AGAIN;
    }
}

static pf_status v4l2_next(void *self, uint32_t timeout_ms, pf_frame *frame)
{
    pf_v4l2 *c = self;
    const uint64_t now = c->io.now(c->io.self);
    if (!c->is_started)
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: not started", c->device);
    if (c->held >= PF_CAMERA_HELD_MAX)
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: %u frames are held already", c->device, PF_CAMERA_HELD_MAX);
    if (c->is_streaming)
        pf_recovery_pause(&c->recovery, now - c->left_ns);
    pf_status status = wait_for_frame(c, now, now + (uint64_t)timeout_ms * 1000000u, frame);
    c->left_ns = c->io.now(c->io.self);
    return status;
}

static void v4l2_release(void *self, pf_frame *frame)
{
    pf_v4l2 *c = self;
    bool is_scratch = false;
    if (frame->handle == NULL)
        return;
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        if (frame->handle == &c->scratch[i]) {
            c->scratch[i].is_held = false;
            is_scratch = true;
        }
    }
    if (!is_scratch)
        pf_v4l2_stream_release(c, frame->handle);
    c->held--;
    frame->handle = NULL;
    frame->image.data = NULL;
}

static const pf_camera_info *v4l2_info(void *self)
{
    return &((pf_v4l2 *)self)->info;
}

static pf_status v4l2_start(void *self)
{
    pf_v4l2 *c = self;
    pf_recovery *r = &c->recovery;
    r->is_open = false;
    r->retry_ns = c->io.now(c->io.self);
    c->is_started = true;
    return PF_OK; /* next() opens it, now or once it is there */
}

static pf_status v4l2_stop(void *self)
{
    pf_v4l2 *c = self;
    c->is_started = false;
    detach(c);
    return PF_OK;
}

static void v4l2_stats(void *self, pf_camera_stats *stats)
{
    const pf_v4l2 *c = self;
    *stats = (pf_camera_stats){.is_there = c->is_streaming,
                               .damaged = c->damaged,
                               .restarts = c->recovery.restarts,
                               .reopens = c->recovery.reopens,
                               .bad_stamps = c->numbering.bad_times + c->numbering.bad_counts};
}

static const char *v4l2_error(void *self)
{
    return ((pf_v4l2 *)self)->failure.text;
}

static void v4l2_close(void *self)
{
    pf_v4l2 *c = self;
    detach(c);
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++)
        free(c->scratch[i].pixels);
    if (c->turbo != NULL)
        (void)tjDestroy(c->turbo);
    free(c->device);
    free(c);
}

static pf_status check(pf_v4l2 *c, const pf_camera_config *config)
{
    if (config->device == NULL || config->device[0] == '\0')
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "v4l2: no device");
    if ((config->width == 0) != (config->height == 0))
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: width and height go together", config->device);
    if (config->buffers != 0 && (config->buffers < PF_V4L2_BUFFERS_MIN || config->buffers > PF_V4L2_BUFFERS_MAX))
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: %u buffers: must be %u..%u", config->device, config->buffers,
                       PF_V4L2_BUFFERS_MIN, PF_V4L2_BUFFERS_MAX);
    if (config->format != NULL && config->format[0] != '\0') {
        c->wanted = pf_pixel_format_named(config->format);
        if (c->wanted == NULL)
            return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: format %s is not read", config->device, config->format);
    }
    return PF_OK;
}

static pf_status open_parts(pf_v4l2 *c, const pf_camera_config *config)
{
    bool is_absent = false;
    pf_status status = check(c, config);
    if (status != PF_OK)
        return status;
    c->device = strdup(config->device);
    c->turbo = tjInitDecompress();
    if (c->device == NULL || c->turbo == NULL)
        return pf_fail(&c->failure, PF_ERR_SPACE, "%s: no memory", config->device);
    /* Not the camera's own name: a survey goes on over restarts, whether the camera is there at the start or not. */
    (void)snprintf(c->info.source, sizeof c->info.source, "v4l2 %s", c->device);
    pf_recovery_init(&c->recovery, 0, c->io.now(c->io.self));
    pf_numbering_init(&c->numbering, 0);
    status = attach(c, &is_absent);
    if (status != PF_OK && !(is_absent && config->width != 0))
        return status;
    if (status != PF_OK) {
        c->info.width = config->width;
        c->info.height = config->height;
        c->info.frame_rate = config->frame_rate;
    }
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        c->scratch[i].pixels = malloc((size_t)c->info.width * c->info.height);
        if (c->scratch[i].pixels == NULL)
            return pf_fail(&c->failure, PF_ERR_SPACE, "%s: no memory for frames", c->device);
    }
    return PF_OK;
}

pf_status pf_v4l2_open_with(pf_camera_source *source, const pf_camera_config *config, const pf_v4l2_io *io, char *error,
                            size_t n)
{
    static const pf_camera_source_ops ops = {.info = v4l2_info,
                                             .start = v4l2_start,
                                             .next = v4l2_next,
                                             .release = v4l2_release,
                                             .stop = v4l2_stop,
                                             .stats = v4l2_stats,
                                             .error = v4l2_error,
                                             .close = v4l2_close};
    pf_v4l2 *c = calloc(1, sizeof *c);
    pf_failure failure = {""};
    if (c == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "v4l2: no memory"), error, n);
    c->io = *io;
    c->fd = -1;
    c->width = config->width;
    c->height = config->height;
    c->frame_rate = config->frame_rate;
    c->buffers = config->buffers != 0 ? config->buffers : DEFAULT_BUFFERS;
    c->mode = config->mode;
    c->exposure_us = config->exposure_us;
    c->exposure_max_us = config->exposure_max_us;
    c->gain = config->gain;
    c->exposure.circle_u = config->circle_u;
    c->exposure.circle_v = config->circle_v;
    c->exposure.circle_radius = config->circle_radius;
    pf_status status = open_parts(c, config);
    if (status != PF_OK) {
        pf_failure_copy(&c->failure, status, error, n);
        v4l2_close(c);
        return status;
    }
    source->self = c;
    source->ops = &ops;
    return PF_OK;
}

pf_status pf_v4l2_open(pf_camera_source *source, const pf_camera_config *config, char *error, size_t n)
{
    return pf_v4l2_open_with(source, config, &pf_v4l2_kernel, error, n);
}
