/* Which pixel format, size and rate: the best that the camera has (convert.h gives the order). */
#include "camera_v4l2/v4l2.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

#define ENUMERATED_MAX 64u  /* of formats, intervals: a driver that never ends its list is cut short */
#define RATE_SLACK     0.98 /* 29.97 serves who wants 30 */

/* The single-planar view of a format: what of it matters is the first plane. */
typedef struct shape {
    uint32_t fourcc, width, height, stride, size, field;
} shape;

static shape read_shape(const pf_v4l2 *c, const struct v4l2_format *f)
{
    if (c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE) {
        const struct v4l2_pix_format_mplane *p = &f->fmt.pix_mp;
        return (shape){p->pixelformat, p->width, p->height, p->plane_fmt[0].bytesperline, p->plane_fmt[0].sizeimage,
                       p->field};
    }
    const struct v4l2_pix_format *p = &f->fmt.pix;
    return (shape){p->pixelformat, p->width, p->height, p->bytesperline, p->sizeimage, p->field};
}

static struct v4l2_format make_format(const pf_v4l2 *c, uint32_t fourcc, uint32_t width, uint32_t height)
{
    struct v4l2_format f = {.type = c->type};
    if (c->type == V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE) {
        f.fmt.pix_mp.width = width;
        f.fmt.pix_mp.height = height;
        f.fmt.pix_mp.pixelformat = fourcc;
        f.fmt.pix_mp.field = V4L2_FIELD_NONE;
        f.fmt.pix_mp.num_planes = fourcc == V4L2_PIX_FMT_NV12M ? 2 : 1;
    } else {
        f.fmt.pix.width = width;
        f.fmt.pix.height = height;
        f.fmt.pix.pixelformat = fourcc;
        f.fmt.pix.field = V4L2_FIELD_NONE;
    }
    return f;
}

static pf_status query_type(pf_v4l2 *c)
{
    struct v4l2_capability cap = {0};
    pf_status status = pf_v4l2_call(c, VIDIOC_QUERYCAP, &cap, "not a video device");
    if (status != PF_OK)
        return status;
    uint32_t can = cap.capabilities & V4L2_CAP_DEVICE_CAPS ? cap.device_caps : cap.capabilities;
    if (can & V4L2_CAP_VIDEO_CAPTURE)
        c->type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
    else if (can & V4L2_CAP_VIDEO_CAPTURE_MPLANE)
        c->type = V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE;
    else
        return pf_fail(c->failure, PF_ERR_UNSUPPORTED, "%s: does not capture video", c->device);
    if (!(can & V4L2_CAP_STREAMING))
        return pf_fail(c->failure, PF_ERR_UNSUPPORTED, "%s: has no streaming buffers", c->device);
    return PF_OK;
}

/* The highest rate of a format, 1/s; 0 = the driver does not tell. */
static double best_rate(pf_v4l2 *c, uint32_t fourcc, uint32_t width, uint32_t height)
{
    double best = 0;
    for (uint32_t i = 0; i < ENUMERATED_MAX; i++) {
        struct v4l2_frmivalenum e = {.index = i, .pixel_format = fourcc, .width = width, .height = height};
        if (pf_v4l2_ioctl(c, VIDIOC_ENUM_FRAMEINTERVALS, &e) != 0)
            break;
        const struct v4l2_fract *t = e.type == V4L2_FRMIVAL_TYPE_DISCRETE ? &e.discrete : &e.stepwise.min;
        double rate = t->numerator > 0 ? (double)t->denominator / t->numerator : 0;
        if (rate > best)
            best = rate;
        if (e.type != V4L2_FRMIVAL_TYPE_DISCRETE)
            break;
    }
    return best;
}

static bool is_as_asked(const shape *s, const pf_pixel_format *format, uint32_t width, uint32_t height)
{
    return s->fourcc == format->fourcc && s->width == width && s->height == height && s->field == V4L2_FIELD_NONE;
}

/* Bytes from row to row; some cameras tell none. */
static uint32_t stride_of(const shape *s, const pf_pixel_format *format)
{
    const uint32_t row = pf_pixel_format_row(format, s->width);
    return s->stride > row ? s->stride : row;
}

/* Whether a frame has room in what the camera gives it: else every frame would count as damaged. */
static bool has_room(const shape *s, const pf_pixel_format *format)
{
    return pf_pixel_format_fits(format, s->width, s->height, stride_of(s, format), s->size);
}

/* Whether the camera makes this format in this size; it may change what it is asked for. *roomy: and has_room(). */
static bool can_make(pf_v4l2 *c, const pf_pixel_format *format, uint32_t width, uint32_t height, bool *roomy)
{
    struct v4l2_format f = make_format(c, format->fourcc, width, height);
    if (pf_v4l2_ioctl(c, VIDIOC_TRY_FMT, &f) != 0)
        return false;
    const shape s = read_shape(c, &f);
    *roomy = has_room(&s, format);
    return is_as_asked(&s, format, width, height);
}

/* Our first format that the camera makes at the size, of those fast enough if there is one; one that it has no room for
 * only if there is no other. */
static const pf_pixel_format *choose(pf_v4l2 *c, const pf_session_wish *wish, uint32_t width, uint32_t height,
                                     char *has, size_t has_n)
{
    const pf_pixel_format *listed[ENUMERATED_MAX], *slow = NULL, *cramped = NULL;
    uint32_t n = 0, known;
    const pf_pixel_format *ours = pf_pixel_formats(&known);
    has[0] = '\0';
    for (uint32_t i = 0; i < ENUMERATED_MAX; i++) {
        struct v4l2_fmtdesc d = {.index = i, .type = c->type};
        if (pf_v4l2_ioctl(c, VIDIOC_ENUM_FMT, &d) != 0)
            break;
        size_t used = strlen(has);
        (void)snprintf(has + used, has_n - used, " %.4s", (const char *)&d.pixelformat);
        listed[n] = pf_pixel_format_find(d.pixelformat);
        n += listed[n] != NULL;
    }
    for (uint32_t k = 0; k < known; k++) {
        bool is_listed = false, roomy;
        for (uint32_t i = 0; i < n; i++)
            is_listed = is_listed || listed[i] == &ours[k];
        if (!is_listed || (wish->format != NULL && wish->format != &ours[k]) ||
            !can_make(c, &ours[k], width, height, &roomy))
            continue;
        if (!roomy) {
            cramped = cramped != NULL ? cramped : &ours[k];
            continue;
        }
        double rate = wish->frame_rate > 0 ? best_rate(c, ours[k].fourcc, width, height) : 0;
        if (rate == 0 || rate >= wish->frame_rate * RATE_SLACK)
            return &ours[k];
        slow = slow != NULL ? slow : &ours[k];
    }
    return slow != NULL ? slow : cramped;
}

/* Sets the rate, where the camera lets it be set; what it is then. */
static double set_rate(pf_v4l2 *c, double wish)
{
    struct v4l2_streamparm p = {.type = c->type};
    const struct v4l2_fract *t = &p.parm.capture.timeperframe;
    double rate = 0;
    if (wish > 0) {
        p.parm.capture.timeperframe = (struct v4l2_fract){1000, (uint32_t)(wish * 1000 + 0.5)};
        (void)pf_v4l2_ioctl(c, VIDIOC_S_PARM, &p);
    }
    if (pf_v4l2_ioctl(c, VIDIOC_G_PARM, &p) == 0 && t->numerator > 0)
        rate = (double)t->denominator / (double)t->numerator;
    return rate > 0.01 && rate < 10000 ? rate : wish;
}

pf_status pf_v4l2_negotiate(pf_v4l2 *c, const pf_session_wish *wish, pf_session_info *info)
{
    char has[6 * ENUMERATED_MAX];
    pf_status status = query_type(c);
    if (status != PF_OK)
        return status;
    struct v4l2_format f = {.type = c->type};
    uint32_t width = wish->width, height = wish->height;
    if (width == 0) {
        status = pf_v4l2_call(c, VIDIOC_G_FMT, &f, "has no format yet");
        if (status != PF_OK)
            return status;
        shape set = read_shape(c, &f);
        width = set.width;
        height = set.height;
    }
    const pf_pixel_format *format = choose(c, wish, width, height, has, sizeof has);
    if (has[0] == '\0') /* a receiver without a signal, a loopback that nobody writes to */
        return pf_fail(c->failure, PF_ERR_AGAIN, "%s: has no format now", c->device);
    if (format == NULL)
        return pf_fail(c->failure, PF_ERR_UNSUPPORTED, "%s: cannot make frames of %u x %u%s%s; it has:%s", c->device,
                       width, height, wish->format ? " as " : " in a format that is read",
                       wish->format ? wish->format->name : "", has);
    f = make_format(c, format->fourcc, width, height);
    status = pf_v4l2_call(c, VIDIOC_S_FMT, &f, "the format cannot be set");
    if (status != PF_OK)
        return status;
    const shape s = read_shape(c, &f);
    if (!is_as_asked(&s, format, width, height))
        return pf_fail(c->failure, PF_ERR_UNSUPPORTED, "%s: promised %s %u x %u, set %.4s %u x %u", c->device,
                       format->name, width, height, (const char *)&s.fourcc, s.width, s.height);
    info->format = format;
    info->width = width;
    info->height = height;
    info->stride = stride_of(&s, format);
    if (!has_room(&s, format))
        return pf_fail(c->failure, PF_ERR_UNSUPPORTED, "%s: its %u bytes, %u a row, hold no %s of %u x %u", c->device,
                       s.size, s.stride, format->name, width, height);
    info->frame_rate = set_rate(c, wish->frame_rate);
    return PF_OK;
}
