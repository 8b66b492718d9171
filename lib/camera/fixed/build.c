/* Building a fixed camera: the only place in camera/fixed with floating point, IEEE + - * / alone. */
#include "fixed.h"

#include "../real/real.h"

#define TABLE_ERROR_PX  1e-5
#define TABLE_ERROR_RAD 1e-8 /* of the plane, which is in radians near the axis */
#define EXTENT_PX       32768.0
#define ERROR_PX        1e-4        /* of a projection */
#define SLOPE_MAX       268435456.0 /* 2^28: products in the cubic stay within 63 bits */
#define TILT_CLEAR      0.25

/* H_n at one theta, n = -3..3: real and imaginary parts, and their derivatives by theta. */
#define PARTS 14
typedef struct lens_sample {
    double value[PARTS], slope[PARTS];
} lens_sample;

static uint32_t part_of(int number, bool imaginary)
{
    return (uint32_t)(2 * (number + 3)) + (imaginary ? 1u : 0u);
}

static void add(lens_sample *h, int number, double re, double im, double value, double slope)
{
    uint32_t part = part_of(number, false);
    h->value[part] += re * value;
    h->slope[part] += re * slope;
    h->value[part + 1] += im * value;
    h->slope[part + 1] += im * slope;
}

/* e^(i phi) (re + i im) a(theta) (b0 cos phi + b1 sin phi + b2 cos 2 phi + b3 sin 2 phi) */
static void add_factors(lens_sample *h, double re, double im, const double a[3], const double b[4], double theta)
{
    double s = theta * theta;
    double value = theta * (a[0] + s * (a[1] + s * a[2])), slope = a[0] + s * (3 * a[1] + s * (5 * a[2]));
    for (int n = 1; n <= 2; n++) {
        double c = b[2 * n - 2] / 2,
               d = b[2 * n - 1] / 2; /* c - i d goes with e^(i n phi), c + i d with e^(-i n phi) */
        add(h, 1 + n, re * c + im * d, im * c - re * d, value, slope);
        add(h, 1 - n, re * c - im * d, im * c + re * d, value, slope);
    }
}

static lens_sample sample_lens(const pf_camera *camera, double theta)
{
    lens_sample h = {{0}, {0}};
    double slope, r = pf_camera_radius(camera, theta, &slope);
    add(&h, 1, 1, 0, r, slope);
    add_factors(&h, 1, 0, camera->asym_radial_theta, camera->asym_radial_phi, theta);
    add_factors(&h, 0, 1, camera->asym_tangential_theta, camera->asym_tangential_phi, theta);
    for (int k = 0; k < CPOLY_TERMS; k++) { /* camera/real has their harmonics in the frame that turns with phi */
        const int power = pf_cpoly_power[k];
        double lower = power == 1 ? 1 : power == 2 ? theta : theta * theta;
        add(&h, pf_cpoly_harmonic[k] + 1, camera->cpoly[2 * k], camera->cpoly[2 * k + 1], lower * theta, power * lower);
    }
    return h;
}

static double magnitude_of(double v)
{
    return v < 0 ? -v : v;
}

/* What init works out before it writes: everything but the knots. */
typedef struct plan {
    pf_camera_fixed fixed;
    double per_theta;            /* intervals per radian, as exactly as scale has it */
    double bound, steepest;      /* of |W|; of all channels' change in an interval */
    double tilt[2], pixel_scale; /* of the sensor's homography; largest factor from its plane to pixels */
    double error;                /* of a projection, pixels */
} plan;

static double theta_of(const plan *p, uint32_t index)
{
    return index / p->per_theta;
}

/* The lens at a knot; the last one may lie beyond theta_max by rounding, so it is reached along the tangent. */
static lens_sample sample_knot(const plan *p, const pf_camera *camera, uint32_t index)
{
    double theta = theta_of(p, index), beyond = theta - camera->theta_max;
    lens_sample h = sample_lens(camera, beyond > 0 ? camera->theta_max : theta);
    for (int i = 0; beyond > 0 && i < PARTS; i++)
        h.value[i] += beyond * h.slope[i];
    return h;
}

/* v = *mantissa 2^-*shift with 2^(bits - 1) <= mantissa < 2^bits, v > 0 */
static uint32_t to_mantissa(double v, uint32_t bits, uint32_t *shift)
{
    double limit = (double)((uint64_t)1 << bits);
    *shift = 0;
    while (2 * v < limit && *shift < 62) {
        v *= 2;
        ++*shift;
    }
    return (uint32_t)v;
}

static int64_t rounded(double v)
{
    return v < 0 ? -(int64_t)(0.5 - v) : (int64_t)(v + 0.5);
}

static void set_intervals(plan *p, const pf_camera *camera, uint32_t intervals)
{
    pf_camera_fixed *f = &p->fixed;
    f->intervals = intervals;
    f->scale = to_mantissa(intervals / camera->theta_max / 2, 30, &f->scale_shift);
    p->per_theta = 2 * (double)f->scale / (double)((uint64_t)1 << f->scale_shift);
    /* theta_q32 = position_q31 * 2 / per_theta */
    f->step = to_mantissa(2 / p->per_theta, 31, &f->step_shift);
}

/* The least d = 1 + tilt . W of the sensor's tilt, |W| <= bound. W / d changes by up to 1 / d^2 times as much as W. */
static double clear_of(const plan *p, double bound)
{
    return 1 - (magnitude_of(p->tilt[0]) + magnitude_of(p->tilt[1])) * bound;
}

/* Whether the cubics through the knots stay within TABLE_ERROR_PX in the middle of their intervals, where Hermite's
 * remainder is largest; *bound gets the largest |W| there can be, as a sum of moduli. */
static bool table_suffices(const plan *p, const pf_camera *camera, double pixel_scale, double *bound, double *steepest)
{
    double h = 1 / p->per_theta;
    lens_sample low = sample_knot(p, camera, 0);
    double worst = 0;
    *bound = *steepest = 0;
    for (uint32_t k = 1; k <= p->fixed.intervals; k++) {
        lens_sample high = sample_knot(p, camera, k);
        lens_sample middle = sample_lens(camera, (theta_of(p, k - 1) + h / 2));
        double error = 0, size = 0;
        for (int i = 0; i < PARTS; i++) {
            double cubic = (low.value[i] + high.value[i]) / 2 + h * (low.slope[i] - high.slope[i]) / 8;
            error += magnitude_of(cubic - middle.value[i]);
            size += magnitude_of(high.value[i]);
            double steep = h * magnitude_of(high.slope[i]), rise = magnitude_of(high.value[i] - low.value[i]);
            *steepest = steep > *steepest ? steep : *steepest;
            *steepest = rise > *steepest ? rise : *steepest;
        }
        if (!(error <= TABLE_ERROR_RAD))
            return false;
        worst = error > worst ? error : worst;
        *bound = size > *bound ? size : *bound;
        low = high;
    }
    double clear = clear_of(p, *bound);
    return clear < TILT_CLEAR || worst * pixel_scale / (clear * clear) <= TABLE_ERROR_PX;
}

/* The parts of H that are not zero at some knot. */
static void choose_channels(plan *p, const pf_camera *camera)
{
    pf_camera_fixed *f = &p->fixed;
    bool used[PARTS] = {false};
    for (uint32_t k = 0; k <= f->intervals; k++) {
        lens_sample h = sample_knot(p, camera, k);
        for (int i = 0; i < PARTS; i++)
            used[i] = used[i] || h.value[i] != 0;
    }
    f->channels = 0;
    f->channel[f->channels++] = (channel){1, false};
    for (int n = -3; n <= 3; n++)
        for (int im = 0; im < 2; im++)
            if (n != 1 && used[part_of(n, im != 0)])
                f->channel[f->channels++] = (channel){(int8_t)n, im != 0};
}

/* Chooses the number of intervals and the scale of the plane. */
static pf_status plan_table(plan *p, const pf_camera *camera)
{
    pf_camera_fixed *f = &p->fixed;
    double focal = camera->f_u > camera->f_v ? camera->f_u : camera->f_v, steepest;
    p->pixel_scale = focal + magnitude_of(camera->skew);
    const sensor_tilt tilt = pf_camera_sensor_tilt(camera);
    p->tilt[0] = tilt.along_x;
    p->tilt[1] = tilt.along_y;
    uint32_t intervals = 64;
    do {
        intervals *= 2;
        if (intervals > INTERVALS_MAX)
            return PF_ERR_UNSUPPORTED;
        set_intervals(p, camera, intervals);
    } while (!table_suffices(p, camera, p->pixel_scale, &p->bound, &steepest));

    p->steepest = steepest;
    choose_channels(p, camera);
    double clear = clear_of(p, p->bound), extent = p->bound / clear * p->pixel_scale;
    if (clear < TILT_CLEAR || extent > EXTENT_PX)
        return PF_ERR_UNSUPPORTED;
    /* The bound that camera_fixed.h states: rounding of the pixel and the table, then of the plane, then of the angle.
     */
    p->error = 2.2e-5 + 1e-9 * extent + 3.5e-10 * steepest * p->per_theta * p->pixel_scale / (clear * clear);
    if (p->fixed.channels > 1 || clear < 1)
        p->error += 3e-9 * extent / clear;
    if (p->error > ERROR_PX)
        return PF_ERR_UNSUPPORTED;
    double limit = 2147483000.0; /* a little below 2^31 */
    f->plane_q = 0;
    while (2 * p->bound / clear < limit && 2 * steepest < SLOPE_MAX && f->plane_q < 60) {
        limit /= 2;
        steepest *= 2;
        f->plane_q++;
    }
    if (p->pixel_scale / (clear * clear) * EXTENT_PX >
        (double)((uint64_t)1 << f->plane_q)) /* a unit of the plane above 2^-15 px */
        return PF_ERR_UNSUPPORTED;
    const double scale[2] = {camera->f_u + magnitude_of(camera->skew), camera->f_v};
    for (int i = 0; i < 2; i++) {
        f->pixel_q[i] = 16;
        while (f->pixel_q[i] < 30 &&
               p->bound / clear * scale[i] * (double)((uint64_t)1 << (f->pixel_q[i] + 1)) < 2147483000.0)
            f->pixel_q[i]++;
    }
    return PF_OK;
}

static affine_row make_row(double a, double b)
{
    affine_row row = {0, 0, 0};
    double largest = magnitude_of(a) > magnitude_of(b) ? magnitude_of(a) : magnitude_of(b);
    (void)to_mantissa(largest, 30, &row.shift);
    double scale = (double)((uint64_t)1 << row.shift);
    row.a = (int32_t)rounded(a * scale);
    row.b = (int32_t)rounded(b * scale);
    return row;
}

static void set_sensor(plan *p, const pf_camera *camera)
{
    pf_camera_fixed *f = &p->fixed;
    const double plane = (double)((uint64_t)1 << f->plane_q), u = (double)((uint64_t)1 << f->pixel_q[0]),
                 v = (double)((uint64_t)1 << f->pixel_q[1]);
    f->to_pixel[0] = make_row(camera->f_u * u / plane, camera->skew * u / plane);
    f->to_pixel[1] = make_row(0, camera->f_v * v / plane);
    f->from_pixel[0] = make_row(plane / u / camera->f_u, -(plane / v) * (camera->skew / camera->f_u) / camera->f_v);
    f->from_pixel[1] = make_row(0, plane / v / camera->f_v);
    f->center[0] = rounded(camera->c_u * u);
    f->center[1] = rounded(camera->c_v * v);
    /* A pixel of the rim is off by the projection's error and its own rounding; on the plane that is at most so much
     * by 1 / f, the skew's shear and the tilt, whose d is at most 2 - clear. */
    double focal = camera->f_u < camera->f_v ? camera->f_u : camera->f_v, d = 2 - clear_of(p, p->bound);
    f->rim_slack =
        rounded(plane * (p->error + 1.1e-5) / focal * (1 + magnitude_of(camera->skew) / camera->f_u) * d * d) + 2;
    /* Z in Q30 is half a unit off in both directions, and a unit is a slope of (steepest) plane units to the interval
     * in the largest channel, up to three times that in the harmonics' turning; and each channel rounds. */
    f->rounding = (int64_t)f->channels * 4 + rounded(p->per_theta * p->steepest * plane / (double)ONE_Q30) * 8;
    f->tilt[0] = (int32_t)rounded(p->tilt[0] * (double)ONE_Q30);
    f->tilt[1] = (int32_t)rounded(p->tilt[1] * (double)ONE_Q30);
    f->plane_max = rounded(p->bound * plane);
    f->width = camera->width;
    f->height = camera->height;
    f->circle[0] = rounded(camera->circle_u * 65536);
    f->circle[1] = rounded(camera->circle_v * 65536);
    int64_t radius = rounded(camera->circle_radius * 65536);
    f->circle_radius2 = camera->circle_radius > 0 ? radius * radius : -1;
}

static pf_status make_plan(plan *p, const pf_camera *camera)
{
    pf_camera_fixed *f = &p->fixed;
    *p = (plan){.per_theta = 0};
    if (camera->circle_radius > EXTENT_PX)
        return PF_ERR_UNSUPPORTED;
    pf_status status = plan_table(p, camera);
    if (status != PF_OK)
        return status;
    set_sensor(p, camera);
    f->theta_max = (uint64_t)rounded(camera->theta_max * 4294967296.0);
    f->pupil_e1 = (int32_t)rounded(camera->pupil_e1 * (double)ONE_Q30);
    f->pupil_near =
        rounded(magnitude_of(camera->pupil_e1) * camera->theta_max * (camera->theta_max + 2) * (double)ONE_Q30);
    return PF_OK;
}

_Static_assert(sizeof(pf_camera_fixed) + (INTERVALS_MAX + 1) * CHANNELS_MAX * sizeof(knot) <=
                   PF_CAMERA_FIXED_WORKSPACE_MAX,
               "PF_CAMERA_FIXED_WORKSPACE_MAX");

static size_t plan_size(const plan *p)
{
    return sizeof(pf_camera_fixed) + (size_t)(p->fixed.intervals + 1) * p->fixed.channels * sizeof(knot);
}

size_t pf_camera_fixed_workspace_size(const pf_camera *camera)
{
    plan p;
    return make_plan(&p, camera) == PF_OK ? plan_size(&p) : 0;
}

pf_status pf_camera_fixed_init(const pf_camera_fixed **fixed, const pf_camera *camera, void *workspace, size_t size)
{
    plan p;
    pf_status status = make_plan(&p, camera);
    if (status != PF_OK)
        return status;
    if (!workspace || size < plan_size(&p))
        return PF_ERR_SPACE;
    pf_camera_fixed *f = workspace;
    knot *knots = (knot *)(f + 1);
    *f = p.fixed;
    f->knots = knots;
    double plane = (double)((uint64_t)1 << f->plane_q);
    for (uint32_t k = 0; k <= f->intervals; k++) {
        lens_sample h = sample_knot(&p, camera, k);
        for (uint32_t i = 0; i < f->channels; i++) {
            uint32_t part = part_of(f->channel[i].harmonic, f->channel[i].imaginary);
            *knots++ =
                (knot){(int32_t)rounded(h.value[part] * plane), (int32_t)rounded(h.slope[part] / p.per_theta * plane)};
        }
    }
    *fixed = f;
    return PF_OK;
}
