#include "v4l2_kernel.h"
#include "unity.h"

#include <errno.h>
#include <string.h>

v4l2_kernel k;

static bool fails(void)
{
    if (++k.calls != k.fail_at)
        return false;
    errno = k.fail_with;
    return true;
}

static int fake_open(void *self, const char *path)
{
    (void)self;
    TEST_ASSERT_EQUAL_STRING("/dev/video0", path);
    if (fails())
        return -1;
    errno = ENOENT;
    if (!k.is_plugged)
        return -1;
    errno = EBUSY;
    if (k.is_busy && k.is_busy_file)
        return -1;
    TEST_ASSERT_FALSE_MESSAGE(k.is_open, "opened twice");
    k.is_open = true;
    return 5;
}

static void stop(void)
{
    k.is_streaming = false;
    k.n_done = 0;
    memset(k.is_queued, 0, sizeof k.is_queued);
}

static void fake_close(void *self, int fd)
{
    (void)self;
    for (uint32_t i = 0; i < MAPS; i++)
        TEST_ASSERT_FALSE_MESSAGE(k.is_mapped[i] && !k.is_kept[i], "closed, but a mapping keeps it open");
    TEST_ASSERT_EQUAL_INT(5, fd);
    k.is_open = false;
    stop();
}

static int set_format(struct v4l2_format *f)
{
    struct v4l2_pix_format one = f->fmt.pix, *p = k.is_mplane ? &one : &f->fmt.pix;
    if (k.is_mplane)
        p->pixelformat = f->fmt.pix_mp.pixelformat;
    bool has = false;
    for (uint32_t i = 0; i < k.n_formats; i++)
        has = has || k.formats[i].fourcc == p->pixelformat;
    p->width = k.width;
    p->height = k.height;
    p->pixelformat = has ? p->pixelformat : k.formats[0].fourcc;
    p->field = V4L2_FIELD_NONE;
    p->bytesperline = STRIDE * (p->pixelformat == V4L2_PIX_FMT_YUYV ? 2 : 1);
    p->sizeimage = k.image_size;
    if (k.is_mplane)
        f->fmt.pix_mp = (struct v4l2_pix_format_mplane){
            .width = p->width,
            .height = p->height,
            .pixelformat = p->pixelformat,
            .field = p->field,
            .num_planes = 1,
            .plane_fmt[0] = {.bytesperline = p->bytesperline, .sizeimage = p->sizeimage}};
    return 0;
}

static int buffer_call(unsigned long request, struct v4l2_buffer *b)
{
    if (request == VIDIOC_QUERYBUF) {
        if (k.is_mplane) {
            b->m.planes[0].length = BYTES;
            b->m.planes[0].m.mem_offset = b->index;
        } else {
            b->length = BYTES;
            b->m.offset = b->index;
        }
    } else if (request == VIDIOC_QBUF) {
        TEST_ASSERT_FALSE_MESSAGE(k.is_queued[b->index], "queued twice");
        k.is_queued[b->index] = true;
    } else {
        errno = k.has_error ? EIO : EAGAIN;
        if (k.has_error || k.n_done == 0)
            return -1;
        b->index = k.done[0];
        memmove(k.done, k.done + 1, --k.n_done * sizeof k.done[0]);
        k.is_queued[b->index] = false;
        if (k.is_mplane) {
            b->m.planes[0].bytesused = BYTES;
            b->m.planes[0].data_offset = k.header;
        } else {
            b->bytesused = BYTES;
        }
        b->sequence = k.numbers[b->index];
        b->flags = k.flags[b->index] | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
        b->timestamp.tv_sec = (long)(k.stamps[b->index] / 1000000000u);
        b->timestamp.tv_usec = (long)(k.stamps[b->index] % 1000000000u / 1000);
    }
    return 0;
}

static int enumerate(unsigned long request, void *argument)
{
    errno = EINVAL;
    if (request == VIDIOC_ENUM_FMT) {
        struct v4l2_fmtdesc *d = argument;
        if (d->index >= k.n_formats)
            return -1;
        d->pixelformat = k.formats[d->index].fourcc;
        return 0;
    }
    struct v4l2_frmivalenum *e = argument;
    for (uint32_t i = 0; i < k.n_formats; i++) {
        if (k.formats[i].fourcc == e->pixel_format && k.formats[i].rate != 0 && e->index == 0) {
            e->type = V4L2_FRMIVAL_TYPE_DISCRETE;
            e->discrete = (struct v4l2_fract){1, k.formats[i].rate};
            return 0;
        }
    }
    return -1;
}

/* A USB camera's: the exposure, and who sets it. */
static int control_call(unsigned long request, void *argument)
{
    struct v4l2_queryctrl *q = argument;
    struct v4l2_control *c = argument;
    errno = EINVAL;
    if (request == VIDIOC_QUERYCTRL && q->id == V4L2_CID_EXPOSURE_ABSOLUTE) {
        q->maximum = 5000;
        q->minimum = q->step = 1;
        q->flags = 0;
        return 0;
    }
    if (request != VIDIOC_S_CTRL || c->id != V4L2_CID_EXPOSURE_AUTO || c->value == V4L2_EXPOSURE_AUTO)
        return -1;
    k.exposure_auto = c->value;
    return 0;
}

static int fake_ioctl(void *self, int fd, unsigned long request, void *argument)
{
    (void)self;
    TEST_ASSERT_TRUE(k.is_open && fd == 5);
    k.now += k.call_ns;
    errno = ETIMEDOUT;
    if (k.call_ns > 0 && request != VIDIOC_QUERYCAP && request != VIDIOC_ENUM_FMT && request != VIDIOC_TRY_FMT &&
        request != VIDIOC_S_FMT && request != VIDIOC_REQBUFS && request != VIDIOC_QUERYBUF)
        return -1;
    errno = ENODEV;
    if (!k.is_plugged || fails())
        return -1;
    switch (request) {
    case VIDIOC_QUERYCAP:
        ((struct v4l2_capability *)argument)->capabilities =
            (k.is_mplane ? V4L2_CAP_VIDEO_CAPTURE_MPLANE : V4L2_CAP_VIDEO_CAPTURE) | V4L2_CAP_STREAMING;
        return 0;
    case VIDIOC_ENUM_FMT:
    case VIDIOC_ENUM_FRAMEINTERVALS:
        return enumerate(request, argument);
    case VIDIOC_S_FMT:
        errno = EBUSY; /* as all drivers say as soon as another file has buffers */
        if (k.is_busy && k.is_busy_early)
            return -1;
        k.fourcc = ((struct v4l2_format *)argument)->fmt.pix.pixelformat;
        return set_format(argument);
    case VIDIOC_G_FMT:
    case VIDIOC_TRY_FMT:
        return set_format(argument);
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM:
        ((struct v4l2_streamparm *)argument)->parm.capture.timeperframe =
            (struct v4l2_fract){(uint32_t)(k.period / MS), 1000};
        return 0;
    case VIDIOC_REQBUFS:
        errno = EBUSY;
        if (k.is_busy)
            return -1;
        k.n_buffers = 6;
        ((struct v4l2_requestbuffers *)argument)->count = k.n_buffers;
        k.base = k.n_maps;
        return 0;
    case VIDIOC_QUERYBUF:
    case VIDIOC_QBUF:
    case VIDIOC_DQBUF:
        return buffer_call(request, argument);
    case VIDIOC_STREAMON:
        k.is_streaming = true;
        k.has_error = false;
        k.sequence = 0;
        k.next_frame = k.now + k.period;
        return 0;
    case VIDIOC_STREAMOFF:
        k.restarts++;
        k.is_silent = k.is_silent && !k.restart_helps;
        stop();
        return 0;
    default:
        return control_call(request, argument);
    }
}

static void *fake_map(void *self, int fd, size_t n, int64_t offset)
{
    (void)self;
    TEST_ASSERT_TRUE(k.is_open && fd == 5 && n == BYTES && k.n_maps < MAPS && offset < SLOTS);
    if (fails())
        return NULL;
    k.is_mapped[k.n_maps] = true;
    return k.memory[k.n_maps++];
}

static void fake_unmap(void *self, void *memory, size_t n)
{
    (void)self;
    const size_t i = (size_t)((uint8_t *)memory - k.memory[0]) / BYTES;
    TEST_ASSERT_TRUE(n == BYTES && i < MAPS && k.is_mapped[i]);
    k.is_mapped[i] = false;
    memset(memory, 0xDD, n);
}

static bool fake_keep(void *self, void *memory, size_t n)
{
    (void)self;
    const size_t i = (size_t)((uint8_t *)memory - k.memory[0]) / BYTES;
    TEST_ASSERT_TRUE(n == BYTES && i < MAPS && k.is_mapped[i]);
    k.is_kept[i] = true;
    return true;
}

/* Fills the queued buffers whose time has come. */
static void run_camera(uint64_t until)
{
    while (k.is_streaming && k.is_plugged && !k.is_silent && k.next_frame <= until) {
        for (uint32_t i = 0; i < k.n_buffers; i++) {
            bool is_done = false;
            for (uint32_t j = 0; j < k.n_done; j++)
                is_done = is_done || k.done[j] == i;
            if (!k.is_queued[i] || is_done)
                continue;
            memset(k.memory[k.base + i], 0xEE, k.header);
            memset(k.memory[k.base + i] + k.header, (int)(k.sequence & 0xFF), BYTES - k.header);
            k.numbers[i] = k.sequence;
            k.stamps[i] = k.next_frame;
            k.flags[i] = k.damaged_next > 0 ? V4L2_BUF_FLAG_ERROR : 0;
            k.damaged_next -= k.damaged_next > 0;
            k.done[k.n_done++] = i;
            break;
        }
        k.sequence++;
        k.next_frame += k.period;
    }
}

static int fake_wait(void *self, int fd, uint32_t timeout_ms)
{
    (void)self;
    TEST_ASSERT_TRUE(k.is_open && fd == 5);
    if (!k.is_plugged || k.has_error) {
        k.now += MS;
        return -1;
    }
    uint64_t until = k.now + timeout_ms * MS;
    if (k.n_done == 0)
        k.now = k.is_streaming && !k.is_silent && k.next_frame < until && k.next_frame > k.now ? k.next_frame : until;
    run_camera(k.now);
    return k.n_done > 0;
}

static uint64_t fake_now(void *self)
{
    (void)self;
    run_camera(k.now);
    return k.now;
}

static void fake_sleep(void *self, uint32_t ms)
{
    (void)self;
    k.now += ms * MS;
}

const pf_v4l2_io v4l2_kernel_io = {.open = fake_open,
                                   .close = fake_close,
                                   .ioctl = fake_ioctl,
                                   .map = fake_map,
                                   .unmap = fake_unmap,
                                   .keep = fake_keep,
                                   .wait = fake_wait,
                                   .now = fake_now,
                                   .sleep = fake_sleep};

void v4l2_kernel_reset(void)
{
    memset(&k, 0, sizeof k);
    k.now = 1000 * MS;
    k.period = 100 * MS;
    k.is_plugged = true;
    k.formats[0] = (fake_format){V4L2_PIX_FMT_YUYV, 0};
    k.formats[1] = (fake_format){V4L2_PIX_FMT_GREY, 0};
    k.n_formats = 2;
    k.image_size = BYTES;
    k.width = W;
    k.height = H;
}
