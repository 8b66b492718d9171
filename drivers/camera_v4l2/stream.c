/* The buffers that the kernel fills and the daemon reads in place. */
#include "camera_v4l2/v4l2.h"

#include <errno.h>
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

static void drop_if_unused(pf_v4l2 *c, pf_v4l2_stream *s)
{
    if (s->is_live || s->held > 0)
        return;
    for (uint32_t i = 0; i < s->n; i++)
        if (s->buffer[i].memory != NULL)
            c->io.unmap(c->io.self, s->buffer[i].memory, s->buffer[i].size);
    memset(s, 0, sizeof *s);
}

static pf_status map_buffers(pf_v4l2 *c, pf_v4l2_stream *s, uint32_t n)
{
    const bool is_mplane = c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE;
    for (uint32_t i = 0; i < n; i++) {
        request r;
        pf_status status = pf_v4l2_call(c, VIDIOC_QUERYBUF, make_request(c, &r, i), "a buffer cannot be asked for");
        if (status != PF_OK)
            return status;
        pf_v4l2_buffer *b = &s->buffer[i];
        b->stream = s;
        b->size = is_mplane ? r.planes[0].length : r.b.length;
        b->memory = c->io.map(c->io.self, c->fd, b->size, is_mplane ? r.planes[0].m.mem_offset : r.b.m.offset);
        if (b->memory == NULL)
            return pf_fail(&c->failure, PF_ERR_IO, "%s: a buffer cannot be mapped: %s", c->device, strerror(errno));
        s->n = i + 1;
    }
    return PF_OK;
}

static pf_status switch_on(pf_v4l2 *c)
{
    pf_v4l2_stream_queue(c);
    pf_status status = pf_v4l2_call(c, VIDIOC_STREAMON, &c->type, "does not start");
    c->is_streaming = status == PF_OK;
    return status;
}

pf_status pf_v4l2_stream_begin(pf_v4l2 *c)
{
    pf_v4l2_stream *s = NULL;
    for (uint32_t i = 0; i < PF_V4L2_STREAMS && s == NULL; i++)
        if (!c->stream[i].is_live && c->stream[i].held == 0)
            s = &c->stream[i];
    if (s == NULL) /* each old one holds a frame, and there are more of them than frames may be held */
        return pf_fail(&c->failure, PF_ERR_ARGUMENT, "%s: too many frames are held", c->device);
    struct v4l2_requestbuffers r = {.count = c->buffers, .type = c->type, .memory = V4L2_MEMORY_MMAP};
    pf_status status = pf_v4l2_call(c, VIDIOC_REQBUFS, &r, "gives no buffers");
    if (status != PF_OK)
        return status;
    if (r.count < PF_V4L2_BUFFERS_MIN)
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: gives %u buffers; %u are needed", c->device, r.count,
                       PF_V4L2_BUFFERS_MIN);
    memset(s, 0, sizeof *s);
    status = map_buffers(c, s, r.count < PF_V4L2_BUFFERS_MAX ? r.count : PF_V4L2_BUFFERS_MAX);
    if (status != PF_OK) {
        drop_if_unused(c, s);
        return status;
    }
    s->is_live = true;
    c->live = s;
    return switch_on(c);
}

pf_status pf_v4l2_stream_restart(pf_v4l2 *c)
{
    (void)c->io.ioctl(c->io.self, c->fd, VIDIOC_STREAMOFF, &c->type);
    c->is_streaming = false;
    for (uint32_t i = 0; i < c->live->n; i++)
        c->live->buffer[i].is_queued = false; /* that is what STREAMOFF does */
    return switch_on(c);
}

void pf_v4l2_stream_end(pf_v4l2 *c)
{
    pf_v4l2_stream *s = c->live;
    if (c->is_streaming)
        (void)c->io.ioctl(c->io.self, c->fd, VIDIOC_STREAMOFF, &c->type);
    c->is_streaming = false;
    c->live = NULL;
    if (s == NULL)
        return;
    s->is_live = false;
    for (uint32_t i = 0; i < s->n; i++) {
        pf_v4l2_buffer *b = &s->buffer[i];
        if (b->is_held) {
            (void)c->io.keep(c->io.self, b->memory, b->size);
        } else {
            c->io.unmap(c->io.self, b->memory, b->size);
            b->memory = NULL;
        }
    }
    drop_if_unused(c, s);
}

void pf_v4l2_stream_queue(pf_v4l2 *c)
{
    for (uint32_t i = 0; c->live != NULL && i < c->live->n; i++) {
        pf_v4l2_buffer *b = &c->live->buffer[i];
        request r;
        if (!b->is_held && !b->is_queued) /* one that is refused is tried again at the next frame */
            b->is_queued = c->io.ioctl(c->io.self, c->fd, VIDIOC_QBUF, make_request(c, &r, i)) == 0;
    }
}

void pf_v4l2_stream_release(pf_v4l2 *c, pf_v4l2_buffer *b)
{
    pf_v4l2_stream *s = b->stream;
    b->is_held = false;
    s->held--;
    if (s->is_live)
        pf_v4l2_stream_queue(c);
    drop_if_unused(c, s);
}

pf_status pf_v4l2_stream_take(pf_v4l2 *c, pf_v4l2_buffer **buffer, struct v4l2_buffer *taken, size_t *n)
{
    const bool is_mplane = c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE;
    request r;
    if (c->io.ioctl(c->io.self, c->fd, VIDIOC_DQBUF, make_request(c, &r, 0)) != 0) {
        if (errno == EAGAIN)
            return PF_ERR_AGAIN;
        return pf_fail(&c->failure, errno == ENODEV ? PF_ERR_CLOSED : PF_ERR_IO, "%s: %s", c->device, strerror(errno));
    }
    if (r.b.index >= c->live->n)
        return pf_fail(&c->failure, PF_ERR_IO, "%s: gave buffer %u of %u", c->device, r.b.index, c->live->n);
    pf_v4l2_buffer *b = &c->live->buffer[r.b.index];
    b->is_queued = false;
    *buffer = b;
    *taken = r.b;
    *n = is_mplane ? r.planes[0].bytesused : r.b.bytesused;
    if (*n == 0 || *n > b->size) /* drivers of raw formats may leave it 0 */
        *n = b->size;
    if (r.b.flags & V4L2_BUF_FLAG_ERROR) {
        pf_v4l2_stream_queue(c);
        return pf_fail(&c->failure, PF_ERR_CHECKSUM, "%s: frame %u is damaged", c->device, r.b.sequence);
    }
    return PF_OK;
}
