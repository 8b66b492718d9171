/* Exposure and gain of a V4L2 camera. */
#include "camera_v4l2/v4l2.h"

/* False: there is no such control, or it cannot be set. */
static bool ask(pf_v4l2 *c, uint32_t id, struct v4l2_queryctrl *q)
{
    *q = (struct v4l2_queryctrl){.id = id};
    return pf_v4l2_ioctl(c, VIDIOC_QUERYCTRL, q) == 0 &&
           !(q->flags & (V4L2_CTRL_FLAG_DISABLED | V4L2_CTRL_FLAG_READ_ONLY));
}

static bool query(pf_v4l2 *c, uint32_t id, pf_v4l2_control *control, pf_exposure_range *range)
{
    struct v4l2_queryctrl q;
    if (!ask(c, id, &q) || q.minimum >= q.maximum)
        return false;
    *control = (pf_v4l2_control){.is_there = true, .id = id};
    *range = (pf_exposure_range){q.minimum, q.maximum, q.step};
    return true;
}

static bool set(pf_v4l2 *c, uint32_t id, int64_t value)
{
    struct v4l2_control control = {id, (int32_t)value};
    return pf_v4l2_ioctl(c, VIDIOC_S_CTRL, &control) == 0;
}

static int64_t get(pf_v4l2 *c, uint32_t id, int64_t fallback)
{
    struct v4l2_control control = {.id = id};
    return pf_v4l2_ioctl(c, VIDIOC_G_CTRL, &control) == 0 ? control.value : fallback;
}

/* Microseconds of a line of the sensor, for cameras whose exposure counts lines; 0 = it does not tell. */
static double line_us(pf_v4l2 *c, uint32_t width)
{
    struct v4l2_ext_control rate = {.id = V4L2_CID_PIXEL_RATE};
    struct v4l2_ext_controls controls = {.which = V4L2_CTRL_WHICH_CUR_VAL, .count = 1, .controls = &rate};
    int64_t blank = get(c, V4L2_CID_HBLANK, -1);
    if (blank < 0 || pf_v4l2_ioctl(c, VIDIOC_G_EXT_CTRLS, &controls) != 0 || rate.value64 <= 0)
        return 0;
    return (double)(blank + width) * 1e6 / (double)rate.value64;
}

void pf_v4l2_controls_find(pf_v4l2 *c, pf_session_info *info)
{
    c->time_control = c->gain_control = (pf_v4l2_control){0};
    info->time_unit_us = 0;
    info->gain_unit = 1;
    if (query(c, V4L2_CID_EXPOSURE_ABSOLUTE, &c->time_control, &info->time))
        info->time_unit_us = 100;
    else if (query(c, V4L2_CID_EXPOSURE, &c->time_control, &info->time))
        info->time_unit_us = line_us(c, info->width);
    if (!query(c, V4L2_CID_ANALOGUE_GAIN, &c->gain_control, &info->gain))
        (void)query(c, V4L2_CID_GAIN, &c->gain_control, &info->gain);
    info->has_time = c->time_control.is_there;
    info->has_gain = c->gain_control.is_there;
    info->time_now = info->has_time ? get(c, c->time_control.id, info->time.min) : 0;
    info->gain_now = info->has_gain ? get(c, c->gain_control.id, info->gain.min) : 0;
}

/* False: it has the control, and it did not take the value. */
static bool settle(pf_v4l2 *c, uint32_t id, int64_t value)
{
    struct v4l2_queryctrl q;
    return set(c, id, value) || !ask(c, id, &q);
}

/* Its own automatics, whichever it has. They stay as they are set when the device is closed, so what an earlier run
 * switched off must be switched on. The frame rate never gives way to the exposure. */
static bool set_automatic_time(pf_v4l2 *c, bool is_on)
{
    bool is_done;
    if (!is_on)
        is_done = settle(c, V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_MANUAL);
    else /* a fixed iris: most USB cameras */
        is_done = set(c, V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_AUTO) ||
                  settle(c, V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_APERTURE_PRIORITY);
    return settle(c, V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0) && is_done;
}

void pf_v4l2_controls_set(pf_v4l2 *c, bool is_automatic, int64_t time, int64_t gain)
{
    pf_v4l2_control *t = &c->time_control, *g = &c->gain_control;
    const bool sets_time = !is_automatic && time != PF_SESSION_AS_IS,
               sets_gain = !is_automatic && gain != PF_SESSION_AS_IS;
    /* What it did not take, a device that is busy, is asked for again the next time. */
    if (is_automatic || (sets_time && !t->is_manual))
        t->is_manual = set_automatic_time(c, is_automatic) && !is_automatic;
    if (is_automatic || (sets_gain && !g->is_manual))
        g->is_manual = settle(c, V4L2_CID_AUTOGAIN, is_automatic) && !is_automatic;
    if (sets_time && t->is_there)
        (void)set(c, t->id, time);
    if (sets_gain && g->is_there)
        (void)set(c, g->id, gain);
}
