/* Exposure and gain of a V4L2 camera. */
#include "camera_v4l2/v4l2.h"

#include <math.h>

static bool query(pf_v4l2 *c, uint32_t id, pf_v4l2_control *control, pf_exposure_range *range)
{
    struct v4l2_queryctrl q = {.id = id};
    if (c->io.ioctl(c->io.self, c->fd, VIDIOC_QUERYCTRL, &q) != 0 ||
        (q.flags & (V4L2_CTRL_FLAG_DISABLED | V4L2_CTRL_FLAG_READ_ONLY)) || q.minimum >= q.maximum)
        return false;
    *control = (pf_v4l2_control){true, id};
    *range = (pf_exposure_range){q.minimum, q.maximum, q.step};
    return true;
}

static bool set(pf_v4l2 *c, uint32_t id, int64_t value)
{
    struct v4l2_control control = {id, (int32_t)value};
    return c->io.ioctl(c->io.self, c->fd, VIDIOC_S_CTRL, &control) == 0;
}

static int64_t get(pf_v4l2 *c, uint32_t id, int64_t fallback)
{
    struct v4l2_control control = {.id = id};
    return c->io.ioctl(c->io.self, c->fd, VIDIOC_G_CTRL, &control) == 0 ? control.value : fallback;
}

/* Microseconds of a line of the sensor, for cameras whose exposure counts lines; 0 = it does not tell. */
static double line_us(pf_v4l2 *c)
{
    struct v4l2_ext_control rate = {.id = V4L2_CID_PIXEL_RATE};
    struct v4l2_ext_controls controls = {.which = V4L2_CTRL_WHICH_CUR_VAL, .count = 1, .controls = &rate};
    int64_t blank = get(c, V4L2_CID_HBLANK, -1);
    if (blank < 0 || c->io.ioctl(c->io.self, c->fd, VIDIOC_G_EXT_CTRLS, &controls) != 0 || rate.value64 <= 0)
        return 0;
    return (double)(blank + c->info.width) * 1e6 / (double)rate.value64;
}

static void find(pf_v4l2 *c)
{
    pf_exposure *e = &c->exposure;
    c->time_control.is_there = c->gain_control.is_there = false;
    c->time_unit_us = 0;
    e->time = e->gain = (pf_exposure_range){1, 1, 1};
    if (query(c, V4L2_CID_EXPOSURE_ABSOLUTE, &c->time_control, &e->time))
        c->time_unit_us = 100;
    else if (query(c, V4L2_CID_EXPOSURE, &c->time_control, &e->time))
        c->time_unit_us = line_us(c);
    if (!query(c, V4L2_CID_ANALOGUE_GAIN, &c->gain_control, &e->gain))
        (void)query(c, V4L2_CID_GAIN, &c->gain_control, &e->gain);
    if (c->time_unit_us > 0 && c->exposure_max_us > 0) {
        int64_t most = (int64_t)((double)c->exposure_max_us / c->time_unit_us);
        if (most < e->time.max)
            e->time.max = most > e->time.min ? most : e->time.min;
    }
}

static void set_both(pf_v4l2 *c)
{
    if (c->time_control.is_there)
        (void)set(c, c->time_control.id, c->exposure.time_now);
    if (c->gain_control.is_there)
        (void)set(c, c->gain_control.id, c->exposure.gain_now);
}

pf_status pf_v4l2_controls_open(pf_v4l2 *c)
{
    pf_exposure *e = &c->exposure;
    find(c);
    if (c->mode == PF_EXPOSURE_FIXED &&
        ((c->exposure_us > 0 && c->time_unit_us <= 0) || (c->gain > 0 && !c->gain_control.is_there)))
        return pf_fail(&c->failure, PF_ERR_UNSUPPORTED, "%s: has no control for the %s that is to be fixed", c->device,
                       c->exposure_us > 0 && c->time_unit_us <= 0 ? "exposure" : "gain");
    if (c->mode == PF_EXPOSURE_DEVICE || (!c->time_control.is_there && !c->gain_control.is_there)) {
        c->time_control.is_there = c->gain_control.is_there = false;
        return PF_OK;
    }
    /* Whatever of its own automatics the camera has. */
    (void)set(c, V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_MANUAL);
    (void)set(c, V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0);
    (void)set(c, V4L2_CID_AUTOGAIN, 0);
    if (!c->has_exposure) {
        int64_t time = c->time_control.is_there ? get(c, c->time_control.id, e->time.min) : 1;
        int64_t gain = c->gain_control.is_there ? get(c, c->gain_control.id, e->gain.min) : 1;
        if (c->mode == PF_EXPOSURE_FIXED && c->exposure_us > 0)
            time = llround((double)c->exposure_us / c->time_unit_us);
        if (c->mode == PF_EXPOSURE_FIXED && c->gain > 0)
            gain = llround(c->gain);
        e->holds = c->mode == PF_EXPOSURE_HOLD;
        pf_exposure_init(e, time, gain);
        c->has_exposure = true;
    }
    set_both(c);
    return PF_OK;
}

void pf_v4l2_controls_judge(pf_v4l2 *c, const pf_image *image)
{
    if ((c->mode != PF_EXPOSURE_AUTO && c->mode != PF_EXPOSURE_HOLD) ||
        (!c->time_control.is_there && !c->gain_control.is_there))
        return;
    if (pf_exposure_judge(&c->exposure, image))
        set_both(c);
}

void pf_v4l2_controls_report(const pf_v4l2 *c, pf_telemetry *t)
{
    t->has_exposure = c->time_control.is_there && c->time_unit_us > 0;
    if (t->has_exposure)
        t->exposure_us = (uint32_t)llround((double)c->exposure.time_now * c->time_unit_us);
    t->has_gain = c->gain_control.is_there;
    if (t->has_gain)
        t->gain = (double)c->exposure.gain_now;
}
