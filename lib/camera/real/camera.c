/* Generic camera model in double precision: the p9 part with skew. Formulas: Kannala & Brandt, PAMI 28(8), 2006.
 *
 * Written with g = r(theta) / rho, rho = hypot(x, y), so that (x_d, y_d) = g (x, y) needs no angle phi and has no 0/0
 * on the axis; the derivatives follow from dtheta = (z x, z y, -rho^2) / (rho |X|^2).
 */
#include "pipefish/camera.h"

#include <float.h>
#include <math.h>

/* Within this angle of the axis theta^2 is below the rounding error, so theta / rho = 1 / z, and x_d, y_d is linear. */
#define AXIS_THETA 1e-9

/* A ray that unproject made at theta_max comes back through atan2 a few units in the last place beyond it. */
#define THETA_SLACK 4e-15

/* Likewise a pixel of theta_max comes back at most this far outside; half of the promised round trip. */
#define RIM_SLACK_PX 5e-10

/* Squares of coordinates in this range neither overflow nor vanish. */
#define POINT_MIN 1e-100
#define POINT_MAX 1e100

double *pf_camera_param_at(pf_camera *camera, uint32_t param)
{
    static const struct {
        uint32_t first;
        size_t offset;
    } runs[] = {
        {PF_PARAM_F_U, offsetof(pf_camera, f_u)},
        {PF_PARAM_F_V, offsetof(pf_camera, f_v)},
        {PF_PARAM_SKEW, offsetof(pf_camera, skew)},
        {PF_PARAM_C_U, offsetof(pf_camera, c_u)},
        {PF_PARAM_C_V, offsetof(pf_camera, c_v)},
        {PF_PARAM_K2, offsetof(pf_camera, k2)},
        {PF_PARAM_K3, offsetof(pf_camera, k3)},
        {PF_PARAM_K4, offsetof(pf_camera, k4)},
        {PF_PARAM_K5, offsetof(pf_camera, k5)},
        {PF_PARAM_ASYM_RADIAL_THETA, offsetof(pf_camera, asym_radial_theta)},
        {PF_PARAM_ASYM_RADIAL_PHI, offsetof(pf_camera, asym_radial_phi)},
        {PF_PARAM_ASYM_TANGENTIAL_THETA, offsetof(pf_camera, asym_tangential_theta)},
        {PF_PARAM_ASYM_TANGENTIAL_PHI, offsetof(pf_camera, asym_tangential_phi)},
        {PF_PARAM_TILT, offsetof(pf_camera, tilt)},
        {PF_PARAM_MIRROR, offsetof(pf_camera, mirror)},
        {PF_PARAM_PUPIL_E1, offsetof(pf_camera, pupil_e1)},
        {PF_PARAM_CPOLY, offsetof(pf_camera, cpoly)},
    };
    if (param >= PF_CAMERA_PARAMS)
        return NULL;
    size_t i = sizeof runs / sizeof runs[0] - 1;
    while (runs[i].first > param)
        i--;
    return (double *)(void *)((unsigned char *)camera + runs[i].offset) + (param - runs[i].first);
}

/* ------------------------------------------------------------------------------------------------- checking */

typedef struct range {
    size_t offset;
    double min, max;
    const char *why;
} range;

/* The limits keep every product finite and the affine part invertible (skew <= f_u: a shear of up to 45 degrees);
 * 3.1415926535897927 is the last number before pi, and theta_max >= 1e-6 keeps the rim out of the axis's branch. */
#define FIELD(field, min, max, why)                                                                                    \
    {                                                                                                                  \
        offsetof(pf_camera, field), min, max, why                                                                      \
    }
static const range RANGES[] = {
    FIELD(f_u, 0.1, 1e5, "f_u: not within 0.1..1e5 pixels per radian"),
    FIELD(f_v, 0.1, 1e5, "f_v: not within 0.1..1e5 pixels per radian"),
    FIELD(skew, -1e5, 1e5, "skew: not within -f_u..f_u"),
    FIELD(c_u, -1e5, 1e5, "c_u: not within -1e5..1e5 pixels"),
    FIELD(c_v, -1e5, 1e5, "c_v: not within -1e5..1e5 pixels"),
    FIELD(k2, -1e6, 1e6, "k2: not within -1e6..1e6"),
    FIELD(k3, -1e6, 1e6, "k3: not within -1e6..1e6"),
    FIELD(k4, -1e6, 1e6, "k4: not within -1e6..1e6"),
    FIELD(k5, -1e6, 1e6, "k5: not within -1e6..1e6"),
    FIELD(theta_max, DBL_MIN, 3.1415926535897927,
          "theta_max: not within 0..pi, both excluded"), /* the last before pi */
    FIELD(circle_u, -1e5, 1e5, "circle_u: not within -1e5..1e5 pixels"),
    FIELD(circle_v, -1e5, 1e5, "circle_v: not within -1e5..1e5 pixels"),
    FIELD(circle_radius, 0.0, 1e5, "circle_radius: not within 0..1e5 pixels"),
};

typedef struct term {
    size_t offset, count;
    const char *not_finite, *unsupported;
} term;

#define TERM(field, count)                                                                                             \
    {                                                                                                                  \
        offsetof(pf_camera, field), count, #field ": not finite",                                                      \
            #field ": this version evaluates only cameras with it 0"                                                   \
    }
static const term TERMS[] = {
    TERM(tilt, 2),
    TERM(asym_radial_theta, 3),
    TERM(asym_radial_phi, 4),
    TERM(asym_tangential_theta, 3),
    TERM(asym_tangential_phi, 4),
    TERM(cpoly, PF_CPOLY_MAX),
    TERM(mirror, 1),
    TERM(pupil_e1, 1),
};

static const double *field_at(const pf_camera *camera, size_t offset)
{
    return (const double *)(const void *)((const unsigned char *)camera + offset);
}

static pf_status check_ranges(const pf_camera *camera, const char **why)
{
    *why = "width: not within 1..16384 pixels";
    if (camera->width < 1 || camera->width > 16384)
        return PF_ERR_ARGUMENT;
    *why = "height: not within 1..16384 pixels";
    if (camera->height < 1 || camera->height > 16384)
        return PF_ERR_ARGUMENT;
    *why = "radial: not a radial function";
    if (camera->radial > PF_RADIAL_UNIFIED)
        return PF_ERR_ARGUMENT;
    for (size_t i = 0; i < sizeof RANGES / sizeof RANGES[0]; i++) {
        double value = *field_at(camera, RANGES[i].offset);
        *why = RANGES[i].why;
        if (!(value >= RANGES[i].min && value <= RANGES[i].max))
            return PF_ERR_ARGUMENT;
    }
    *why = "skew: not within -f_u..f_u";
    if (fabs(camera->skew) > camera->f_u)
        return PF_ERR_ARGUMENT;
    for (size_t i = 0; i < sizeof TERMS / sizeof TERMS[0]; i++) {
        *why = TERMS[i].not_finite;
        for (size_t j = 0; j < TERMS[i].count; j++)
            if (!isfinite(field_at(camera, TERMS[i].offset)[j]))
                return PF_ERR_ARGUMENT;
    }
    return PF_OK;
}

static pf_status check_supported(const pf_camera *camera, const char **why)
{
    *why = "radial: this version evaluates only the generic polynomial";
    if (camera->radial != PF_RADIAL_GENERIC)
        return PF_ERR_UNSUPPORTED;
    for (size_t i = 0; i < sizeof TERMS / sizeof TERMS[0]; i++) {
        *why = TERMS[i].unsupported;
        for (size_t j = 0; j < TERMS[i].count; j++)
            if (field_at(camera, TERMS[i].offset)[j] != 0.0)
                return PF_ERR_UNSUPPORTED;
    }
    return PF_OK;
}

#define DEGREE 4 /* of r' in s = theta^2 */

/* Splits Bernstein coefficients at the middle of their interval by de Casteljau's rule. */
static void bernstein_halve(const double b[DEGREE + 1], double left[DEGREE + 1], double right[DEGREE + 1])
{
    double row[DEGREE + 1];
    for (int i = 0; i <= DEGREE; i++)
        row[i] = b[i];
    for (int level = 0; level <= DEGREE; level++) {
        left[level] = row[0];
        right[DEGREE - level] = row[DEGREE - level];
        for (int i = 0; i < DEGREE - level; i++)
            row[i] = 0.5 * (row[i] + row[i + 1]);
    }
}

/* Proves r' > 0 on [0, theta_max]: a polynomial lies in the hull of its Bernstein coefficients, so an interval whose
 * coefficients are all positive is done, one with a non-positive end value disproves it, and the rest is halved. The
 * hull closes in as 4^-depth: 40 levels reach the rounding error, and what that cannot decide is refused.
 *
 * Rounding: with a_i the power coefficients on [0, 1] and A = sum |a_i|, the b_j are convex-like sums (weights <= 1),
 * wrong by at most 12 epsilon A; each halving averages four times and adds at most 4 (epsilon / 2) A. So
 * (16 + 2 depth) epsilon A bounds it all, and is also more than Horner's rule errs in radial(): there r' > 0 too. */
static bool radial_increases(const pf_camera *camera)
{
    enum { MAX_DEPTH = 40 };
    static const double weight[DEGREE + 1][DEGREE + 1] = {/* C(j, i) / C(4, i) */
                                                          {1},
                                                          {1, 1.0 / 4},
                                                          {1, 2.0 / 4, 1.0 / 6},
                                                          {1, 3.0 / 4, 3.0 / 6, 1.0 / 4},
                                                          {1, 1, 1, 1, 1}};
    double s = camera->theta_max * camera->theta_max * (1 + 4 * DBL_EPSILON);
    double a[DEGREE + 1] = {1, 3 * camera->k2 * s, 5 * camera->k3 * s * s, 7 * camera->k4 * s * s * s,
                            9 * camera->k5 * s * s * s * s};
    double stack[MAX_DEPTH + 1][DEGREE + 1];
    int depth[MAX_DEPTH + 1];
    double size = 0;
    for (int j = 0; j <= DEGREE; j++) {
        size += fabs(a[j]);
        stack[0][j] = 0;
        for (int i = 0; i <= j; i++)
            stack[0][j] += weight[j][i] * a[i];
    }
    depth[0] = 0;

    /* Depth first: the stack holds at most one pending right half a level. */
    for (int top = 0; top >= 0;) {
        const double *b = stack[top];
        double error = (16 + 2 * depth[top]) * DBL_EPSILON * size;
        bool positive = true;
        for (int i = 0; i <= DEGREE; i++)
            positive = positive && b[i] > error;
        if (positive) {
            top--;
            continue;
        }
        if (!(b[0] > error && b[DEGREE] > error) || depth[top] == MAX_DEPTH)
            return false;
        double left[DEGREE + 1], right[DEGREE + 1];
        bernstein_halve(b, left, right);
        for (int i = 0; i <= DEGREE; i++) {
            stack[top][i] = right[i];
            stack[top + 1][i] = left[i];
        }
        depth[top + 1] = depth[top] = depth[top] + 1;
        top++;
    }
    return true;
}

pf_status pf_camera_check(const pf_camera *camera, const char **why)
{
    const char *text = "camera: none given";
    pf_status status = camera ? check_ranges(camera, &text) : PF_ERR_ARGUMENT;
    if (status == PF_OK)
        status = check_supported(camera, &text);
    if (status == PF_OK && !radial_increases(camera)) {
        text = "theta_max: r(theta) stops increasing before it";
        status = PF_ERR_DOMAIN;
    }
    if (why)
        *why = status == PF_OK ? "ok" : text;
    return status;
}

/* ------------------------------------------------------------------------------------------ radial function */

/* r(theta) / theta, and r'(theta). */
static double radial(const pf_camera *camera, double theta, double *derivative)
{
    double s = theta * theta;
    *derivative = 1 + s * (3 * camera->k2 + s * (5 * camera->k3 + s * (7 * camera->k4 + s * (9 * camera->k5))));
    return 1 + s * (camera->k2 + s * (camera->k3 + s * (camera->k4 + s * camera->k5)));
}

double pf_camera_radius(const pf_camera *camera, double theta, double *slope)
{
    double derivative, over_theta = radial(camera, theta, &derivative);
    if (slope)
        *slope = derivative;
    return theta * over_theta;
}

/* Solves r(theta) = rd, 0 <= rd <= r(theta_max), by Newton inside a bracket: a step that leaves the bracket, or does
 * not halve the step before the last, becomes a bisection, so about 2 x 53 steps are the most; real lenses take 5. */
static double radial_solve(const pf_camera *camera, double rd)
{
    double low = 0, high = camera->theta_max, derivative;
    double theta = rd < high ? rd : high; /* k1 = 1 */
    double step = high, before_last = high;
    for (int i = 0; i < 128; i++) {
        double residual = theta * radial(camera, theta, &derivative) - rd;
        double newton = residual / derivative;
        if (fabs(newton) <= DBL_EPSILON * theta)
            return fmin(theta - newton, camera->theta_max);
        if (residual > 0)
            high = theta;
        else
            low = theta;
        bool halves = fabs(2 * newton) <= before_last;
        double next = theta - newton;
        if (!halves || !(next > low && next < high))
            next = 0.5 * (low + high);
        before_last = step;
        step = fabs(next - theta);
        theta = next;
    }
    return theta;
}

/* ----------------------------------------------------------------------------------------------- projection */

pf_status pf_camera_project(const pf_camera *camera, const double xyz[3], double uv[2], double *d_uv_d_xyz,
                            double *d_uv_d_param)
{
    double x = xyz[0], y = xyz[1], z = xyz[2];
    double largest = fmax(fmax(fabs(x), fabs(y)), fabs(z));
    if (!(largest >= POINT_MIN && largest <= POINT_MAX) || isnan(x) || isnan(y) || isnan(z))
        return PF_ERR_DOMAIN;
    double rho = sqrt(x * x + y * y);
    bool on_axis = rho <= AXIS_THETA * z;
    if (rho == 0 && !on_axis)
        return PF_ERR_DOMAIN; /* theta = pi */
    double theta = on_axis ? rho / z : atan2(rho, z);
    if (theta > camera->theta_max) {
        if (theta > camera->theta_max + THETA_SLACK)
            return PF_ERR_DOMAIN;
        theta = camera->theta_max;
    }

    double derivative;
    double theta_per_rho = on_axis ? 1 / z : theta / rho;
    double g = theta_per_rho * radial(camera, theta, &derivative);
    double x_d = g * x, y_d = g * y;
    uv[0] = camera->f_u * x_d + camera->skew * y_d + camera->c_u;
    uv[1] = camera->f_v * y_d + camera->c_v;

    if (d_uv_d_xyz) {
        /* d(x_d, y_d) = g I + h u_r u_r^T across the axis, h = r' dtheta/drho - g -> 0 on it; -r' rho / |X|^2 along. */
        double radial_per_length2 = derivative / (rho * rho + z * z);
        double h = on_axis ? 0 : radial_per_length2 * z - g;
        double cosine = on_axis ? 0 : x / rho, sine = on_axis ? 0 : y / rho;
        double dx[3] = {g + h * cosine * cosine, h * cosine * sine, -radial_per_length2 * x};
        double dy[3] = {h * cosine * sine, g + h * sine * sine, -radial_per_length2 * y};
        for (int i = 0; i < 3; i++) {
            d_uv_d_xyz[i] = camera->f_u * dx[i] + camera->skew * dy[i];
            d_uv_d_xyz[3 + i] = camera->f_v * dy[i];
        }
    }
    if (d_uv_d_param) {
        double *du = d_uv_d_param, *dv = d_uv_d_param + PF_CAMERA_PARAMS;
        for (int i = 0; i < 2 * PF_CAMERA_PARAMS; i++)
            d_uv_d_param[i] = 0;
        du[PF_PARAM_F_U] = x_d;
        du[PF_PARAM_SKEW] = y_d;
        du[PF_PARAM_C_U] = 1;
        dv[PF_PARAM_F_V] = y_d;
        dv[PF_PARAM_C_V] = 1;
        double power = theta_per_rho;
        for (int i = PF_PARAM_K2; i <= PF_PARAM_K5; i++) {
            power *= theta * theta;
            du[i] = power * (camera->f_u * x + camera->skew * y);
            dv[i] = power * camera->f_v * y;
        }
    }
    return PF_OK;
}

pf_status pf_camera_unproject(const pf_camera *camera, const double uv[2], double ray[3], double origin[3],
                              double *d_ray_d_uv)
{
    double y_d = (uv[1] - camera->c_v) / camera->f_v;
    double x_d = (uv[0] - camera->c_u - camera->skew * y_d) / camera->f_u;
    double rd = sqrt(x_d * x_d + y_d * y_d);
    double derivative;
    double rd_max = camera->theta_max * radial(camera, camera->theta_max, &derivative);
    if (!(rd <= rd_max + RIM_SLACK_PX / (fmax(camera->f_u, camera->f_v) + fabs(camera->skew))))
        return PF_ERR_DOMAIN;

    bool on_axis = rd <= AXIS_THETA;
    double theta = rd >= rd_max ? camera->theta_max : on_axis ? rd : radial_solve(camera, rd);
    double sine_per_rd = on_axis ? 1 : sin(theta) / rd;
    double cosine = cos(theta);
    ray[0] = sine_per_rd * x_d;
    ray[1] = sine_per_rd * y_d;
    ray[2] = cosine;
    if (origin)
        origin[0] = origin[1] = origin[2] = 0;

    if (d_ray_d_uv) {
        (void)radial(camera, theta, &derivative);
        double a = on_axis ? 0 : x_d / rd, b = on_axis ? 0 : y_d / rd;
        double h = on_axis ? 0 : cosine / derivative - sine_per_rd;
        double along = -sine_per_rd / derivative;
        double dx[3] = {sine_per_rd + h * a * a, h * a * b, along * x_d}; /* d ray / d x_d */
        double dy[3] = {h * a * b, sine_per_rd + h * b * b, along * y_d};
        for (int i = 0; i < 3; i++) {
            d_ray_d_uv[2 * i] = dx[i] / camera->f_u;
            d_ray_d_uv[2 * i + 1] = (dy[i] - dx[i] * (camera->skew / camera->f_u)) / camera->f_v;
        }
    }
    return PF_OK;
}

bool pf_camera_in_image(const pf_camera *camera, const double uv[2])
{
    if (!(uv[0] >= -0.5 && uv[0] <= camera->width - 0.5 && uv[1] >= -0.5 && uv[1] <= camera->height - 0.5))
        return false;
    double du = uv[0] - camera->circle_u, dv = uv[1] - camera->circle_v;
    return camera->circle_radius == 0 || du * du + dv * dv <= camera->circle_radius * camera->circle_radius;
}

/* ------------------------------------------------------------------------------------------------- batches */

void pf_camera_project_n(const pf_camera *camera, size_t n, const double *xyz, double *uv, uint8_t *ok)
{
    for (size_t i = 0; i < n; i++) {
        ok[i] = pf_camera_project(camera, xyz + 3 * i, uv + 2 * i, NULL, NULL) == PF_OK;
        if (!ok[i])
            uv[2 * i] = uv[2 * i + 1] = (double)NAN;
    }
}

void pf_camera_unproject_n(const pf_camera *camera, size_t n, const double *uv, double *ray, double *origin,
                           uint8_t *ok)
{
    for (size_t i = 0; i < n; i++) {
        double from[3] = {(double)NAN, (double)NAN, (double)NAN};
        ok[i] = pf_camera_unproject(camera, uv + 2 * i, ray + 3 * i, from, NULL) == PF_OK;
        if (!ok[i])
            ray[3 * i] = ray[3 * i + 1] = ray[3 * i + 2] = (double)NAN;
        for (size_t j = 0; origin && j < 3; j++)
            origin[3 * i + j] = from[j];
    }
}
