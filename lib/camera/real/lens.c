/* The lens: from (theta, phi) to the plane point R u_r + T u_phi, and the radial functions. */
#include "real.h"

#include <float.h>

/* m + n and m - n - 1 of c_01, c_20, c_11, c_02, c_30, c_12, c_03. */
const int pf_cpoly_power[CPOLY_TERMS] = {1, 2, 2, 2, 3, 3, 3};
const int pf_cpoly_harmonic[CPOLY_TERMS] = {-2, 1, -1, -3, 2, -2, -4};

static bool any(const double *values, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (values[i] != 0)
            return true;
    return false;
}

camera_kind pf_camera_kind(const pf_camera *camera)
{
    camera_kind kind = {
        any(camera->asym_radial_theta, 3) || any(camera->asym_tangential_theta, 3),
        any(camera->cpoly, PF_CPOLY_MAX),
        any(camera->tilt, 2),
    };
    return kind;
}

static double tangent(double angle) /* |angle| < pi / 2 */
{
    double sine, cosine;
    sine_cosine(fabs(angle), &sine, &cosine);
    return angle < 0 ? -sine / cosine : sine / cosine;
}

sensor_tilt pf_camera_sensor_tilt(const pf_camera *camera)
{
    sensor_tilt tilt = {tangent(camera->tilt[1]), -tangent(camera->tilt[0])};
    return tilt;
}

static double over_angle(double sine, double angle) /* sin x / x */
{
    return angle > 0 ? sine / angle : 1;
}

double pf_camera_radial(const pf_camera *camera, double theta, double *slope)
{
    double sine, cosine, m;
    switch (camera->radial) {
    case PF_RADIAL_GENERIC:
        return generic_radial(camera, theta, slope);
    case PF_RADIAL_PERSPECTIVE:
        sine_cosine(theta, &sine, &cosine);
        *slope = 1 / (cosine * cosine);
        return over_angle(sine, theta) / cosine;
    case PF_RADIAL_STEREOGRAPHIC:
        sine_cosine(0.5 * theta, &sine, &cosine);
        *slope = 1 / (cosine * cosine);
        return over_angle(sine, 0.5 * theta) / cosine;
    case PF_RADIAL_EQUISOLID:
        sine_cosine(0.5 * theta, &sine, &cosine);
        *slope = cosine;
        return over_angle(sine, 0.5 * theta);
    case PF_RADIAL_ORTHOGRAPHIC:
        sine_cosine(theta, &sine, &cosine);
        *slope = cosine;
        return over_angle(sine, theta);
    case PF_RADIAL_UNIFIED:
        sine_cosine(theta, &sine, &cosine);
        m = camera->mirror;
        *slope = (m + 1) * (m * cosine + 1) / ((m + cosine) * (m + cosine));
        return (m + 1) * over_angle(sine, theta) / (m + cosine);
    default: /* equidistant */
        *slope = 1;
        return 1;
    }
}

double pf_camera_radius(const pf_camera *camera, double theta, double *slope)
{
    double derivative, over_theta = pf_camera_radial(camera, theta, &derivative);
    if (slope)
        *slope = derivative;
    return theta * over_theta;
}

/* Newton inside a bracket: a step that leaves the bracket, or does not halve the step before the last, becomes a
 * bisection, so about 2 x 53 steps are the most; real lenses take 5. */
double pf_camera_radial_solve(const pf_camera *camera, double rd)
{
    double low = 0, high = camera->theta_max, slope;
    double theta = rd < high ? rd : high; /* r'(0) = 1 */
    double step = high, before_last = high;
    for (int i = 0; i < 128; i++) {
        double residual = theta * pf_camera_radial(camera, theta, &slope) - rd;
        double newton = residual / slope;
        if (fabs(newton) <= DBL_EPSILON * theta) {
            theta -= newton;
            return theta < camera->theta_max ? theta : camera->theta_max;
        }
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

/* Adds D and its derivatives. */
static void add_asymmetry_slopes(const pf_camera *camera, double theta, double c, double s, lens_point *lens)
{
    const double *a = camera->asym_radial_theta, *b = camera->asym_radial_phi;
    const double *m = camera->asym_tangential_theta, *j = camera->asym_tangential_phi;
    double s2 = theta * theta, c_2 = c * c - s * s, s_2 = 2 * c * s;
    double by_phi_r = b[1] * c - b[0] * s + 2 * (b[3] * c_2 - b[2] * s_2);
    double by_phi_t = j[1] * c - j[0] * s + 2 * (j[3] * c_2 - j[2] * s_2);
    double r = b[0] * c + b[1] * s + b[2] * c_2 + b[3] * s_2;
    double t = j[0] * c + j[1] * s + j[2] * c_2 + j[3] * s_2;
    lens->r_t += (a[0] + s2 * (3 * a[1] + s2 * (5 * a[2]))) * r;
    lens->t_t += (m[0] + s2 * (3 * m[1] + s2 * (5 * m[2]))) * t;
    lens->r_p += (a[0] + s2 * (a[1] + s2 * a[2])) * by_phi_r;
    lens->t_p += (m[0] + s2 * (m[1] + s2 * m[2])) * by_phi_t;
}

static void add_cpoly_slopes(const pf_camera *camera, double theta, double c, double s, lens_point *lens)
{
    enum { HARMONICS = 5 };
    const double power[3] = {1, theta, theta * theta};
    double cosine[HARMONICS] = {1}, sine[HARMONICS] = {0};
    for (int h = 1; h < HARMONICS; h++) {
        cosine[h] = cosine[h - 1] * c - sine[h - 1] * s;
        sine[h] = sine[h - 1] * c + cosine[h - 1] * s;
    }
    for (int i = 0; i < CPOLY_TERMS; i++) {
        int p = pf_cpoly_power[i], h = pf_cpoly_harmonic[i];
        double re = camera->cpoly[2 * i], im = camera->cpoly[2 * i + 1];
        double ch = cosine[h < 0 ? -h : h], sh = h < 0 ? -sine[-h] : sine[h];
        double r = power[p - 1] * (re * ch - im * sh), t = power[p - 1] * (re * sh + im * ch);
        lens->r_t += p * r;
        lens->t_t += p * t;
        lens->r_p -= h * t; /* d/dphi of (r + i t) is i h (r + i t) */
        lens->t_p += h * r;
    }
}

lens_point pf_camera_lens_at(const pf_camera *camera, camera_kind kind, double theta, double c, double s, double radial,
                             double slope)
{
    lens_point lens = {radial, 0, slope, 0, 0, 0};
    add_terms(camera, kind, theta, c, s, &lens.r, &lens.t);
    if (kind.asymmetric)
        add_asymmetry_slopes(camera, theta, c, s, &lens);
    if (kind.cpoly)
        add_cpoly_slopes(camera, theta, c, s, &lens);
    lens.r_p -= lens.t; /* the frame turns with phi */
    lens.t_p += lens.r;
    return lens;
}

lens_point pf_camera_lens(const pf_camera *camera, camera_kind kind, double theta, double c, double s)
{
    double slope, radial = pf_camera_radial(camera, theta, &slope);
    return pf_camera_lens_at(camera, kind, theta, c, s, radial, slope);
}
