#include "camera_common/exposure.h"

#include <math.h>
#include <stdlib.h>

#define GRID 4u

static int64_t clamp_to(const pf_exposure_range *range, double value)
{
    if (!(value > (double)range->min))
        return range->min;
    if (value >= (double)range->max)
        return range->max;
    int64_t step = range->step < 1 ? 1 : range->step;
    return range->min + (int64_t)llround((value - (double)range->min) / (double)step) * step;
}

void pf_exposure_init(pf_exposure *e, int64_t time, int64_t gain)
{
    e->time_now = clamp_to(&e->time, (double)time);
    e->gain_now = clamp_to(&e->gain, (double)gain);
    e->wait = PF_EXPOSURE_DELAY;
    e->steady = 0;
    e->last_way = 0;
    e->is_settled = e->at_limit = false;
}

/* Columns of row y inside the circle: from *begin to before *end. */
static void row_span(const pf_exposure *e, const pf_image *image, uint32_t y, uint32_t *begin, uint32_t *end)
{
    *begin = 0;
    *end = image->width;
    if (e->circle_radius == 0)
        return;
    double dv = (double)y - e->circle_v, square = (double)e->circle_radius * e->circle_radius - dv * dv;
    double half = square > 0 ? sqrt(square) : 0;
    double left = e->circle_u - half, right = e->circle_u + half;
    *begin = left > 0 ? (uint32_t)left : 0;
    *end = square <= 0 ? *begin : right < image->width ? (uint32_t)right : image->width;
}

/* False: there is no pixel to look at. */
static bool measure(pf_exposure *e, const pf_image *image)
{
    uint32_t histogram[256] = {0}, n = 0, saturated = 0, begin, end;
    for (uint32_t y = GRID / 2; y < image->height; y += GRID) {
        row_span(e, image, y, &begin, &end);
        for (uint32_t x = begin + GRID / 2; x < end; x += GRID, n++)
            histogram[image->data[(size_t)y * image->stride + x]]++;
    }
    if (n == 0)
        return false;
    uint32_t below = 0, level = 0;
    while (level < 255 && (uint64_t)(below + histogram[level]) * 100 < (uint64_t)n * PF_EXPOSURE_PERCENTILE)
        below += histogram[level++];
    for (uint32_t v = PF_EXPOSURE_WHITE; v < 256; v++)
        saturated += histogram[v];
    e->percentile = level;
    e->saturated_ppm = (uint32_t)((uint64_t)saturated * 1000000u / n);
    return true;
}

/* Factor of brightness that is wanted. */
static double correction(const pf_exposure *e)
{
    if (e->percentile >= PF_EXPOSURE_WHITE)
        return 0.5; /* how far beyond white nobody knows */
    double ratio = PF_EXPOSURE_TARGET / (double)(e->percentile < 4 ? 4 : e->percentile);
    if (ratio > 4)
        ratio = 4;
    return pow(ratio, 0.8); /* a camera's curve is not linear: rather two steps than one too far */
}

/* One step up or down: exposure first on the way up, gain first on the way down. */
static void step_once(pf_exposure *e, int way)
{
    bool is_time = way > 0 ? e->time_now < e->time.max : e->gain_now <= e->gain.min;
    const pf_exposure_range *range = is_time ? &e->time : &e->gain;
    int64_t *value = is_time ? &e->time_now : &e->gain_now;
    *value = clamp_to(range, (double)(*value + way * (range->step < 1 ? 1 : range->step)));
}

/* Spreads a factor over exposure time, then gain. Steps that are coarser than the band would go up and down for ever:
 * the second turn is not taken. */
static bool apply(pf_exposure *e, double factor)
{
    const int64_t time = e->time_now, gain = e->gain_now;
    const int way = factor > 1 ? 1 : -1;
    double least_time = e->time.min > 0 ? (double)e->time.min : 1;
    double least_gain = e->gain.min > 0 ? (double)e->gain.min : 1;
    double wanted = factor * fmax((double)time, least_time) * fmax((double)gain, least_gain);
    e->time_now = clamp_to(&e->time, wanted / least_gain);
    e->gain_now = clamp_to(&e->gain, wanted / fmax((double)e->time_now, least_time));
    if (e->time_now == time && e->gain_now == gain)
        step_once(e, way);
    bool has_changed = e->time_now != time || e->gain_now != gain;
    bool is_one_step = llabs(e->time_now - time) <= e->time.step && llabs(e->gain_now - gain) <= e->gain.step;
    if (has_changed && is_one_step && e->last_way == -way) {
        e->time_now = time;
        e->gain_now = gain;
        return false;
    }
    e->last_way = is_one_step ? way : 0;
    e->at_limit = !has_changed;
    return has_changed;
}

bool pf_exposure_judge(pf_exposure *e, const pf_image *image)
{
    if (e->wait > 0) {
        e->wait--;
        return false;
    }
    if ((e->holds && e->is_settled) || !measure(e, image))
        return false;
    bool is_near = e->percentile + PF_EXPOSURE_BAND >= PF_EXPOSURE_TARGET &&
                   e->percentile <= PF_EXPOSURE_TARGET + PF_EXPOSURE_BAND;
    bool has_changed = !is_near && apply(e, correction(e));
    if (is_near)
        e->at_limit = false;
    e->steady = has_changed ? 0 : e->steady + 1;
    e->is_settled = e->steady >= PF_EXPOSURE_STEADY;
    e->wait = has_changed ? PF_EXPOSURE_DELAY : 0;
    return has_changed;
}
