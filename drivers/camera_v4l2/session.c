/* V4L2 as a session: opens a device, and has the kernel fill buffers that are read in place. */
#include "camera_v4l2/v4l2.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* A request for one buffer, in either of V4L2's two forms. */
typedef struct request {
    struct v4l2_buffer b;
    struct v4l2_plane planes[VIDEO_MAX_PLANES];
} request;

static struct v4l2_buffer *make_request(const pf_v4l2 *c, request *r, uint32_t index)
{
    memset(r, 0, sizeof *r);
    r->b.type = c->type;
    r->b.memory = V4L2_MEMORY_MMAP;
    r->b.index = index;
    if (c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE) {
        r->b.m.planes = r->planes;
        r->b.length = VIDEO_MAX_PLANES;
    }
    return &r->b;
}

int pf_v4l2_ioctl(pf_v4l2 *c, unsigned long number, void *argument)
{
    if (c->alive != NULL)
        c->alive();
    return c->io.ioctl(c->io.self, c->fd, number, argument);
}

pf_status pf_v4l2_call(pf_v4l2 *c, unsigned long number, void *argument, const char *what)
{
    if (pf_v4l2_ioctl(c, number, argument) == 0)
        return PF_OK;
    return pf_fail(c->failure, errno == EBUSY ? PF_ERR_AGAIN : PF_ERR_IO, "%s: %s: %s", c->device, what,
                   strerror(errno));
}

/* Gives the kernel all buffers that nobody holds; one that is refused is tried again with the next frame. */
static void queue_all(pf_v4l2 *c)
{
    for (uint32_t i = 0; c->is_streaming && i < c->n; i++) {
        pf_v4l2_buffer *b = &c->buffer[i];
        request r;
        if (!b->is_held && !b->is_queued)
            b->is_queued = pf_v4l2_ioctl(c, VIDIOC_QBUF, make_request(c, &r, i)) == 0;
    }
}

static void v4l2_stop(void *self)
{
    pf_v4l2 *c = self;
    if (c->is_streaming)
        (void)pf_v4l2_ioctl(c, VIDIOC_STREAMOFF, &c->type);
    c->is_streaming = false;
    for (uint32_t i = 0; i < c->n; i++)
        c->buffer[i].is_queued = false; /* that is what STREAMOFF does */
}

static void v4l2_close(void *self)
{
    pf_v4l2 *c = self;
    v4l2_stop(c);
    for (uint32_t i = 0; i < c->n; i++)
        if (c->buffer[i].memory != NULL)
            c->io.unmap(c->io.self, c->buffer[i].memory, c->buffer[i].size);
    memset(c->buffer, 0, sizeof c->buffer);
    c->n = 0;
    if (c->fd >= 0)
        c->io.close(c->io.self, c->fd);
    c->fd = -1;
}

static pf_status map_buffers(pf_v4l2 *c, uint32_t n)
{
    const bool is_mplane = c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE;
    for (uint32_t i = 0; i < n; i++) {
        request r;
        pf_status status = pf_v4l2_call(c, VIDIOC_QUERYBUF, make_request(c, &r, i), "a buffer cannot be asked for");
        if (status != PF_OK)
            return status;
        pf_v4l2_buffer *b = &c->buffer[i];
        b->size = is_mplane ? r.planes[0].length : r.b.length;
        b->memory = c->io.map(c->io.self, c->fd, b->size, is_mplane ? r.planes[0].m.mem_offset : r.b.m.offset);
        if (b->memory == NULL)
            return pf_fail(c->failure, PF_ERR_IO, "%s: a buffer cannot be mapped: %s", c->device, strerror(errno));
        c->n = i + 1;
    }
    return PF_OK;
}

static pf_status take_buffers(pf_v4l2 *c, uint32_t wish, pf_session_info *info)
{
    struct v4l2_requestbuffers r = {.count = wish, .type = c->type, .memory = V4L2_MEMORY_MMAP};
    pf_status status = pf_v4l2_call(c, VIDIOC_REQBUFS, &r, "gives no buffers");
    if (status != PF_OK)
        return status;
    info->buffers = r.count < PF_SESSION_BUFFERS_MAX ? r.count : PF_SESSION_BUFFERS_MAX;
    return map_buffers(c, info->buffers);
}

static pf_status v4l2_open(void *self, const pf_session_wish *wish, pf_session_info *info, pf_failure *failure)
{
    pf_v4l2 *c = self;
    memset(info, 0, sizeof *info);
    c->failure = failure;
    c->device = wish->device;
    (void)snprintf(info->id, sizeof info->id, "%s", wish->device);
    c->fd = c->io.open(c->io.self, c->device);
    if (c->fd < 0)
        return pf_fail(
            failure, errno == ENOENT || errno == ENODEV || errno == ENXIO || errno == EBUSY ? PF_ERR_AGAIN : PF_ERR_IO,
            "%s: %s", c->device, strerror(errno));
    pf_status status = pf_v4l2_negotiate(c, wish, info);
    if (status == PF_OK) {
        c->is_compressed = info->format->layout == PF_LAYOUT_JPEG;
        pf_v4l2_controls_find(c, info);
        status = take_buffers(c, wish->buffers, info);
    }
    if (status != PF_OK)
        v4l2_close(c);
    return status;
}

static pf_status v4l2_start(void *self, pf_failure *failure)
{
    pf_v4l2 *c = self;
    c->failure = failure;
    c->is_streaming = true;
    queue_all(c);
    pf_status status = pf_v4l2_call(c, VIDIOC_STREAMON, &c->type, "does not start");
    c->is_streaming = status == PF_OK;
    return status;
}

/* The kernel's stamp, of whatever clock: the numbering believes it only if it can be of ours. */
static uint64_t stamp_of(const struct v4l2_buffer *b)
{
    return b->timestamp.tv_sec < 0
               ? 0
               : (uint64_t)b->timestamp.tv_sec * 1000000000u + (uint64_t)b->timestamp.tv_usec * 1000u;
}

static pf_status v4l2_take(void *self, uint32_t timeout_ms, pf_session_frame *frame, pf_failure *failure)
{
    pf_v4l2 *c = self;
    request r;
    queue_all(c);
    int ready = c->io.wait(c->io.self, c->fd, timeout_ms);
    if (ready == 0)
        return PF_ERR_AGAIN;
    if (pf_v4l2_ioctl(c, VIDIOC_DQBUF, make_request(c, &r, 0)) != 0) {
        if (errno == EAGAIN && ready > 0)
            return PF_ERR_AGAIN;
        return pf_fail(failure, errno == ENODEV ? PF_ERR_CLOSED : PF_ERR_IO, "%s: %s", c->device, strerror(errno));
    }
    if (r.b.index >= c->n)
        return pf_fail(failure, PF_ERR_IO, "%s: gave buffer %u of %u", c->device, r.b.index, c->n);
    pf_v4l2_buffer *b = &c->buffer[r.b.index];
    b->is_queued = false;
    b->is_held = true;
    const bool is_mplane = c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE;
    const size_t skip = is_mplane ? r.planes[0].data_offset : 0,
                 used = is_mplane ? r.planes[0].bytesused : r.b.bytesused;
    *frame = (pf_session_frame){.buffer = r.b.index,
                                .sequence = r.b.sequence,
                                .pixels = b->memory,
                                .n = used,
                                .stamp_ns = stamp_of(&r.b),
                                .is_stamp_first =
                                    (r.b.flags & V4L2_BUF_FLAG_TSTAMP_SRC_MASK) == V4L2_BUF_FLAG_TSTAMP_SRC_SOE,
                                .is_damaged = (r.b.flags & V4L2_BUF_FLAG_ERROR) != 0};
    if (frame->n == 0 && c->is_compressed) /* else what was in the buffer before would be taken for it */
        frame->is_damaged = true;
    if (frame->n == 0 || frame->n > b->size) /* drivers of raw formats may leave it 0 */
        frame->n = b->size;
    if (skip < frame->n) { /* a header, which bytesused counts */
        frame->pixels += skip;
        frame->n -= skip;
    } else {
        frame->is_damaged = true;
    }
    return PF_OK;
}

static void v4l2_give(void *self, uint32_t i)
{
    pf_v4l2 *c = self;
    c->buffer[i].is_held = false;
    queue_all(c);
}

static void v4l2_set(void *self, bool is_automatic, int64_t time, int64_t gain)
{
    pf_v4l2_controls_set(self, is_automatic, time, gain);
}

static void v4l2_keep(void *self, uint32_t i)
{
    pf_v4l2 *c = self;
    pf_v4l2_buffer *b = &c->buffer[i], *place = c->kept;
    while (place->memory != NULL) /* no more frames are held than there are places */
        place++;
    (void)c->io.keep(c->io.self, b->memory, b->size);
    *place = *b;
    b->memory = NULL;
}

static void v4l2_drop(void *self, uint8_t *pixels)
{
    pf_v4l2 *c = self;
    for (uint32_t i = 0; i < PF_CAMERA_HELD_MAX; i++) {
        const pf_v4l2_buffer *b = &c->kept[i];
        if (b->memory == NULL || pixels < b->memory || pixels >= b->memory + b->size)
            continue;
        c->io.unmap(c->io.self, b->memory, b->size);
        c->kept[i].memory = NULL;
    }
}

static uint64_t v4l2_now(void *self)
{
    pf_v4l2 *c = self;
    return c->io.now(c->io.self);
}

static void v4l2_sleep(void *self, uint32_t ms)
{
    pf_v4l2 *c = self;
    c->io.sleep(c->io.self, ms);
}

pf_status pf_v4l2_open_with(pf_camera_source *source, const pf_camera_config *config, const pf_v4l2_io *io, char *error,
                            size_t n)
{
    static const pf_session_io ops = {.now = v4l2_now,
                                      .sleep = v4l2_sleep,
                                      .open = v4l2_open,
                                      .start = v4l2_start,
                                      .stop = v4l2_stop,
                                      .take = v4l2_take,
                                      .give = v4l2_give,
                                      .set = v4l2_set,
                                      .keep = v4l2_keep,
                                      .drop = v4l2_drop,
                                      .close = v4l2_close,
                                      .end = free};
    pf_failure failure = {""};
    pf_session_io session = ops;
    if (config->device == NULL || config->device[0] == '\0')
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_ARGUMENT, "v4l2: no device"), error, n);
    pf_v4l2 *c = calloc(1, sizeof *c);
    if (c == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "v4l2: no memory"), error, n);
    c->io = *io;
    c->alive = config->alive;
    c->fd = -1;
    session.self = c;
    return pf_camera_open(source, config, &session, "v4l2", error, n);
}

pf_status pf_v4l2_open(pf_camera_source *source, const pf_camera_config *config, char *error, size_t n)
{
    return pf_v4l2_open_with(source, config, &pf_v4l2_kernel, error, n);
}
