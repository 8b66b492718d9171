/* Checks a camera when it is loaded: ranges, and the proof that the model is one-to-one. */
#include "real.h"

#include <float.h>
#include <stdlib.h>

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

/* --- Ranges -------------------------------------------------------------------------------------------------- */

typedef struct range {
    size_t offset;
    double min, max;
    const char *why;
} range;

#define FIELD(field, min, max, why)                                                                                    \
    {                                                                                                                  \
        offsetof(pf_camera, field), min, max, why                                                                      \
    }
/* The limits keep every product finite and the affine part invertible (skew <= f_u: a shear of up to 45 degrees);
 * theta_max >= 1e-6 keeps the rim away from the axis. */
static const range RANGES[] = {
    FIELD(f_u, 0.1, 1e5, "f_u: not within 0.1..1e5 pixels per radian"),
    FIELD(f_v, 0.1, 1e5, "f_v: not within 0.1..1e5 pixels per radian"),
    FIELD(skew, -1e5, 1e5, "skew: not within -f_u..f_u"),
    FIELD(c_u, -1e5, 1e5, "c_u: not within -1e5..1e5 pixels"),
    FIELD(c_v, -1e5, 1e5, "c_v: not within -1e5..1e5 pixels"),
    FIELD(tilt[0], -0.7, 0.7, "tilt[0]: not within -0.7..0.7 radians"),
    FIELD(tilt[1], -0.7, 0.7, "tilt[1]: not within -0.7..0.7 radians"),
    FIELD(k2, -1e6, 1e6, "k2: not within -1e6..1e6"),
    FIELD(k3, -1e6, 1e6, "k3: not within -1e6..1e6"),
    FIELD(k4, -1e6, 1e6, "k4: not within -1e6..1e6"),
    FIELD(k5, -1e6, 1e6, "k5: not within -1e6..1e6"),
    FIELD(mirror, 0, 1e3, "mirror: not within 0..1000"),
    FIELD(pupil_e1, -1, 1, "pupil_e1: not within -1..1 metres"),
    FIELD(theta_max, 1e-6, PF_CAMERA_THETA_MAX, "theta_max: not within 1e-6..pi radians, pi excluded"),
    FIELD(circle_u, -1e5, 1e5, "circle_u: not within -1e5..1e5 pixels"),
    FIELD(circle_v, -1e5, 1e5, "circle_v: not within -1e5..1e5 pixels"),
    FIELD(circle_radius, 0.0, 1e5, "circle_radius: not within 0..1e5 pixels"),
};

#define COEFFICIENT_MAX 1e6 /* as of k2..k5 */

static bool all_within(const double *values, size_t n, double max)
{
    for (size_t i = 0; i < n; i++)
        if (!(values[i] >= -max && values[i] <= max))
            return false;
    return true;
}

/* Whether a pair (a, b) of Paper II's factors has its gauge: b of unit norm where a is in use. */
static bool gauge_is_fixed(const double a[3], const double b[4])
{
    double norm2 = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] + b[3] * b[3];
    return (a[0] == 0 && a[1] == 0 && a[2] == 0) || fabs(sqrt(norm2) - 1) <= 1e-6;
}

static const char *asymmetry_fault(const pf_camera *camera)
{
    if (!all_within(camera->asym_radial_theta, 3, COEFFICIENT_MAX))
        return "asym_radial_theta: not within -1e6..1e6";
    if (!all_within(camera->asym_radial_phi, 4, COEFFICIENT_MAX))
        return "asym_radial_phi: not within -1e6..1e6";
    if (!gauge_is_fixed(camera->asym_radial_theta, camera->asym_radial_phi))
        return "asym_radial_phi: not of unit norm (a factor belongs into asym_radial_theta)";
    if (!all_within(camera->asym_tangential_theta, 3, COEFFICIENT_MAX))
        return "asym_tangential_theta: not within -1e6..1e6";
    if (!all_within(camera->asym_tangential_phi, 4, COEFFICIENT_MAX))
        return "asym_tangential_phi: not within -1e6..1e6";
    if (!gauge_is_fixed(camera->asym_tangential_theta, camera->asym_tangential_phi))
        return "asym_tangential_phi: not of unit norm (a factor belongs into asym_tangential_theta)";
    if (!all_within(camera->cpoly, PF_CPOLY_MAX, COEFFICIENT_MAX))
        return "cpoly: not within -1e6..1e6";
    return NULL;
}

/* NULL, or what is wrong. */
static const char *range_fault(const pf_camera *camera)
{
    if (camera->width < 1 || camera->width > 16384)
        return "width: not within 1..16384 pixels";
    if (camera->height < 1 || camera->height > 16384)
        return "height: not within 1..16384 pixels";
    if (camera->radial > PF_RADIAL_UNIFIED)
        return "radial: not a radial function";
    for (size_t i = 0; i < sizeof RANGES / sizeof RANGES[0]; i++) {
        double value = *(const double *)(const void *)((const unsigned char *)camera + RANGES[i].offset);
        if (!(value >= RANGES[i].min && value <= RANGES[i].max))
            return RANGES[i].why;
    }
    if (fabs(camera->skew) > camera->f_u)
        return "skew: not within -f_u..f_u";
    bool polynomial = camera->k2 != 0 || camera->k3 != 0 || camera->k4 != 0 || camera->k5 != 0;
    if (camera->radial != PF_RADIAL_GENERIC && polynomial)
        return "k2: only the generic radial function has coefficients";
    if (camera->radial != PF_RADIAL_UNIFIED && camera->mirror != 0)
        return "mirror: only the unified radial function has it";
    return asymmetry_fault(camera);
}

/* --- The proof for the symmetric part ------------------------------------------------------------------------ */

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
 * (16 + 2 depth) epsilon A bounds it all, and is also more than Horner's rule errs in generic_radial(): there r' > 0
 * too. */
static bool polynomial_increases(const pf_camera *camera)
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

/* r' > 0 up to theta_max. */
static bool family_increases(const pf_camera *camera)
{
    double sine, cosine;
    sine_cosine(camera->theta_max, &sine, &cosine);
    switch (camera->radial) {
    case PF_RADIAL_GENERIC:
        return polynomial_increases(camera);
    case PF_RADIAL_PERSPECTIVE:
    case PF_RADIAL_ORTHOGRAPHIC:
        return cosine > 1e-6;
    case PF_RADIAL_UNIFIED: /* r' > 0 where m cos > -1, before the pole at cos = -m */
        return camera->mirror * cosine + 1 > 1e-6 && camera->mirror + cosine > 1e-6;
    default: /* theta, 2 tan(theta / 2), 2 sin(theta / 2) rise up to pi */
        return true;
    }
}

/* --- The proof for the whole map ------------------------------------------------------------------------------- */

/* Of what the asymmetric terms add to a quantity: bounds of its derivatives by theta and by phi over 0 <= theta <= t,
 * all phi, as polynomials in t, here of degree i. */
enum { POWER_MAX = 5 };
typedef struct bounds {
    double by_theta[POWER_MAX], by_phi[POWER_MAX];
} bounds;

/* Of the quantities that decide: r_t, t_p and off = r_p + t_t. */
typedef struct proof {
    const pf_camera *camera;
    camera_kind kind;
    bounds r_t, t_p, off;
} proof;

/* Of size theta^(power-1) cos(harmonic phi + anything). */
static void add_bound(bounds *b, double size, int power, int harmonic_number)
{
    if (power > 1)
        b->by_theta[power - 2] += size * (power - 1);
    b->by_phi[power - 1] += size * abs(harmonic_number);
}

static double length(double a, double b)
{
    return sqrt(a * a + b * b);
}

/* R = a theta^p g(phi) has r_t = p a theta^(p-1) g, r_p = a theta^(p-1) g' and t_p = a theta^(p-1) g; T = m theta^p g
 * has t_t = p m theta^(p-1) g, t_p = m theta^(p-1) g' and r_p = -m theta^(p-1) g. R + i T = c theta^p e^(i h phi) has
 * r_t + i t_t = p, r_p = -(h + 1) times its T / theta and t_p = (h + 1) times its R / theta. */
static proof make_proof(const pf_camera *camera, camera_kind kind)
{
    proof q = {.camera = camera, .kind = kind};
    for (int i = 0; i < 3; i++)
        for (int h = 1; h <= 2; h++) {
            const double *b = camera->asym_radial_phi + 2 * h - 2, *j = camera->asym_tangential_phi + 2 * h - 2;
            double radial = fabs(camera->asym_radial_theta[i]) * length(b[0], b[1]);
            double tangential = fabs(camera->asym_tangential_theta[i]) * length(j[0], j[1]);
            int p = 2 * i + 1;
            add_bound(&q.r_t, p * radial, p, h);
            add_bound(&q.t_p, radial + h * tangential, p, h);
            add_bound(&q.off, h * radial + (p - 1) * tangential, p, h);
        }
    for (int i = 0; i < CPOLY_TERMS; i++) {
        double size = length(camera->cpoly[2 * i], camera->cpoly[2 * i + 1]);
        int p = pf_cpoly_power[i], h = pf_cpoly_harmonic[i];
        add_bound(&q.r_t, p * size, p, h);
        add_bound(&q.t_p, abs(h + 1) * size, p, h);
        add_bound(&q.off, abs(p - h - 1) * size, p, h);
    }
    return q;
}

static double polynomial(const double a[POWER_MAX], double t)
{
    double sum = 0;
    for (int i = POWER_MAX; i-- > 0;)
        sum = sum * t + a[i];
    return sum;
}

/* Of |r''| up to t, which also bounds twice the derivative of r / theta. */
static double symmetric_bound(const pf_camera *camera, double t)
{
    double s = t * t, sine, cosine, slope, m = camera->mirror;
    switch (camera->radial) {
    case PF_RADIAL_GENERIC:
        return t * (6 * fabs(camera->k2) +
                    s * (20 * fabs(camera->k3) + s * (42 * fabs(camera->k4) + s * (72 * fabs(camera->k5)))));
    case PF_RADIAL_PERSPECTIVE: /* 2 tan / cos^2 rises */
        return 2 * t * pf_camera_radial(camera, t, &slope) * slope;
    case PF_RADIAL_STEREOGRAPHIC: /* tan(theta / 2) / cos^2(theta / 2) rises */
        return 0.5 * t * pf_camera_radial(camera, t, &slope) * slope;
    case PF_RADIAL_UNIFIED: /* (m + 1) sin (m cos + 2 - m^2) / (m + cos)^3; m + cos falls */
        sine_cosine(t, &sine, &cosine);
        return (m + 1) * (m + 2 + m * m) / ((m + cosine) * (m + cosine) * (m + cosine));
    default: /* 0, sin, sin / 2 */
        return 1;
    }
}

typedef struct slopes {
    double by_theta, by_phi;
} slopes;

typedef struct cell {
    double theta, phi, half_theta, half_phi; /* centre and half sizes */
} cell;

/* What is known of a cell. Neighbours share a half of it, which is kept from one to the next. */
typedef struct view {
    double theta, half_theta, phi; /* for which it holds */
    double c, s;                   /* of phi */
    double over_theta, slope;      /* r / theta and r' at theta */
    double symmetric;              /* the bounds up to the cell's end */
    slopes r_t, t_p, off;
} view;

static slopes slopes_up_to(const bounds *b, double t)
{
    return (slopes){polynomial(b->by_theta, t), polynomial(b->by_phi, t)};
}

static void look(const proof *p, const cell *at, view *v)
{
    if (v->phi != at->phi) { /* in [-pi, pi], of which the functions know half */
        v->phi = at->phi;
        sine_cosine(fabs(at->phi), &v->s, &v->c);
        v->s = at->phi < 0 ? -v->s : v->s;
    }
    if (v->theta != at->theta || v->half_theta != at->half_theta) {
        const double end = at->theta + at->half_theta;
        v->theta = at->theta;
        v->half_theta = at->half_theta;
        v->over_theta = pf_camera_radial(p->camera, at->theta, &v->slope);
        v->symmetric = symmetric_bound(p->camera, end);
        v->r_t = slopes_up_to(&p->r_t, end);
        v->t_p = slopes_up_to(&p->t_p, end);
        v->off = slopes_up_to(&p->off, end);
    }
}

typedef enum verdict { PROVED, DISPROVED, UNDECIDED } verdict;

/* Whether the symmetric part of the Jacobian is positive definite in the whole cell: r_t > 0 and
 * 4 r_t t_p > (r_p + t_t)^2. Values at the centre, less what the derivatives' bounds allow. Sets *split_theta to the
 * better half for UNDECIDED. */
static verdict judge(const proof *p, const cell *at, view *v, bool *split_theta)
{
    look(p, at, v);
    lens_point lens = pf_camera_lens_at(p->camera, p->kind, v->theta, v->c, v->s, v->over_theta, v->slope);
    double off = fabs(lens.r_p + lens.t_t), room = 4 * lens.r_t * lens.t_p - off * off;
    if (!(lens.r_t > 0 && lens.t_p > 0 && room > 0))
        return DISPROVED;
    /* by how much the three change at most, on the way by theta and by phi */
    double theta = at->half_theta, phi = at->half_phi;
    double r_by_theta = theta * (v->symmetric + v->r_t.by_theta), r_by_phi = phi * v->r_t.by_phi;
    double t_by_theta = theta * (0.5 * v->symmetric + v->t_p.by_theta), t_by_phi = phi * v->t_p.by_phi;
    double off_by_theta = theta * v->off.by_theta, off_by_phi = phi * v->off.by_phi;
    double d_r = r_by_theta + r_by_phi, d_t = t_by_theta + t_by_phi, d_off = off_by_theta + off_by_phi;
    double change = 4 * (lens.r_t * d_t + lens.t_p * d_r - d_r * d_t) + 2 * off * d_off + d_off * d_off;
    double rounding = 1e-12 * (1 + lens.r_t * lens.t_p + off * off);
    if (lens.r_t - d_r > 0 && lens.t_p - d_t > 0 && room - change > rounding)
        return PROVED;
    *split_theta = 4 * (lens.r_t * t_by_theta + lens.t_p * r_by_theta) + (2 * off + off_by_theta) * off_by_theta >=
                   4 * (lens.r_t * t_by_phi + lens.t_p * r_by_phi) + (2 * off + off_by_phi) * off_by_phi;
    return UNDECIDED;
}

/* A map that folds mostly does so at the rim, and in a wide part of it: a few points tell that before thousands of
 * cells beside it are proved. */
static bool folds_visibly(const proof *p)
{
    enum { RINGS = 4, SPOKES = 16 };
    view v = {.theta = NAN, .phi = NAN};
    bool ignored;
    for (int i = RINGS; i > 0; i--)
        for (int j = 0; j < SPOKES; j++) {
            cell at = {p->camera->theta_max * i / RINGS, PI_ALL * (2 * j - SPOKES) / SPOKES, 0, 0};
            if (judge(p, &at, &v, &ignored) == DISPROVED)
                return true;
        }
    return false;
}

/* Depth first over halved cells: the stack holds at most one pending right half a level. */
static bool map_is_one_to_one(const pf_camera *camera, camera_kind kind)
{
    enum { MAX_DEPTH = 60, MAX_CELLS = 100000 };
    const proof p = make_proof(camera, kind);
    view known = {.theta = NAN, .phi = NAN};
    cell stack[MAX_DEPTH + 2];
    int top = 0;
    double half = 0.5 * camera->theta_max;
    stack[0] = (cell){half, 0, half * (1 + 4 * DBL_EPSILON), PI_ALL * (1 + 4 * DBL_EPSILON)};
    if (folds_visibly(&p))
        return false;
    for (int cells = 0; top >= 0; cells++) {
        cell at = stack[top];
        bool split_theta = true;
        verdict v = judge(&p, &at, &known, &split_theta);
        if (v == DISPROVED || cells == MAX_CELLS || (v == UNDECIDED && top == MAX_DEPTH))
            return false;
        if (v == PROVED) {
            top--;
            continue;
        }
        cell left = at, right = at;
        if (split_theta) {
            left.half_theta = right.half_theta = 0.5 * at.half_theta;
            left.theta -= left.half_theta;
            right.theta += right.half_theta;
        } else {
            left.half_phi = right.half_phi = 0.5 * at.half_phi;
            left.phi -= left.half_phi;
            right.phi += right.half_phi;
        }
        stack[top++] = left;
        stack[top] = right;
    }
    return true;
}

/* d > 0 wherever the plane point can lie: then the tilt is one-to-one and keeps the orientation. */
static bool tilt_is_clear(const pf_camera *camera)
{
    double reach = pf_camera_radius(camera, camera->theta_max, NULL), t = camera->theta_max;
    for (int i = 0; i < 3; i++, t *= camera->theta_max * camera->theta_max) {
        double a = fabs(camera->asym_radial_theta[i]), m = fabs(camera->asym_tangential_theta[i]);
        for (int j = 0; j < 4; j++)
            reach += t * (a * fabs(camera->asym_radial_phi[j]) + m * fabs(camera->asym_tangential_phi[j]));
    }
    for (int i = 0; i < CPOLY_TERMS; i++) {
        double size = fabs(camera->cpoly[2 * i]) + fabs(camera->cpoly[2 * i + 1]);
        for (int p = 0; p < pf_cpoly_power[i]; p++)
            size *= camera->theta_max;
        reach += size;
    }
    sensor_tilt tilt = pf_camera_sensor_tilt(camera);
    return reach * sqrt(tilt.along_x * tilt.along_x + tilt.along_y * tilt.along_y) < 0.99;
}

pf_status pf_camera_check(const pf_camera *camera, const char **why)
{
    const char *ignored;
    why = why ? why : &ignored;
    *why = camera ? range_fault(camera) : "camera: none given";
    if (*why)
        return PF_ERR_ARGUMENT;
    camera_kind kind = pf_camera_kind(camera);
    if (!family_increases(camera))
        *why = "theta_max: r(theta) stops increasing before it";
    else if ((kind.asymmetric || kind.cpoly) && !map_is_one_to_one(camera, kind))
        *why = "theta_max: with its asymmetric terms the model is not one-to-one up to it, or too nearly not";
    else if (kind.tilted && !tilt_is_clear(camera))
        *why = "tilt: the tilted sensor does not face the whole field";
    else
        *why = "ok";
    return (*why)[0] == 'o' ? PF_OK : PF_ERR_DOMAIN;
}
