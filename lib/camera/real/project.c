/* Projection of single points, with derivatives. */
#include "real.h"

#include <float.h>

/* theta of the point (rho, z) of a camera with a pupil shift e1: the root of
 *   f(theta) = rho cos theta - (z - e1 theta^2) sin theta,   f' = -(s - 2 e1 theta sin theta) where s is the length of
 * the ray. Where |X| > |e1| (theta_max^2 + 2 theta_max) every root in [0, theta_max] has f' < 0, so there is at most
 * one: Newton in a bracket finds it. False: none. */
static bool solve_pupil(const pf_camera *camera, double rho, double z, double *theta)
{
    double e1 = camera->pupil_e1, high = camera->theta_max, low = 0, sine, cosine;
    if (sqrt(rho * rho + z * z) <= fabs(e1) * high * (high + 2))
        return false;
    sine_cosine(high, &sine, &cosine);
    if (rho * cosine - (z - e1 * high * high) * sine >= 0) { /* at theta_max or beyond: rounding decides */
        *theta = high;
        return angle_of(rho, z - e1 * high * high) <= high + THETA_SLACK;
    }
    double t = angle_of(rho, z);
    t = t < high ? t : high;
    for (int i = 0; i < 128; i++) {
        sine_cosine(t, &sine, &cosine);
        double zz = z - e1 * t * t, f = rho * cosine - zz * sine;
        double newton = f / (rho * sine + zz * cosine - 2 * e1 * t * sine);
        if (f > 0)
            low = t;
        else
            high = t;
        double next = t + newton;
        if (!(next >= low && next <= high))
            next = 0.5 * (low + high);
        double step = fabs(next - t);
        t = next;
        if (step <= DBL_EPSILON * t)
            break;
    }
    *theta = t;
    return true;
}

/* What the derivatives of one projection share. */
typedef struct projected {
    const pf_camera *camera;
    sensor_tilt tilt;
    lens_point lens;
    double theta, c, s; /* of the point */
    double x, y, d;     /* plane point before the sensor; the tilt's denominator */
} projected;

/* From a change of the plane point, in the frame (u_r, u_phi), to one of the pixel. */
static void to_pixels(const projected *p, double radial, double tangential, double *du, double *dv)
{
    double dx = p->c * radial - p->s * tangential, dy = p->s * radial + p->c * tangential;
    double dd_per_d = (p->tilt.along_x * dx + p->tilt.along_y * dy) / p->d;
    dx = (dx - p->x * dd_per_d) / p->d;
    dy = (dy - p->y * dd_per_d) / p->d;
    *du = p->camera->f_u * dx + p->camera->skew * dy;
    *dv = p->camera->f_v * dy;
}

static void by_point(const projected *p, double rho, double z, double q, double *out)
{
    const double e1 = p->camera->pupil_e1;
    double zz = z - e1 * p->theta * p->theta;
    double length2 = rho * rho + zz * zz;
    double room = length2 - 2 * e1 * p->theta * rho; /* |X - origin| (s - 2 e1 theta sin theta) */
    double by_rho = zz / room, by_z = -rho / room;   /* d theta */
    double across = p->lens.r_p * q, turn = p->lens.t_p * q;
    double du[3], dv[3];
    to_pixels(p, p->lens.r_t * by_rho, p->lens.t_t * by_rho, &du[0], &dv[0]);
    to_pixels(p, across, turn, &du[1], &dv[1]);
    to_pixels(p, p->lens.r_t * by_z, p->lens.t_t * by_z, &du[2], &dv[2]);
    out[0] = du[0] * p->c - du[1] * p->s;
    out[1] = du[0] * p->s + du[1] * p->c;
    out[2] = du[2];
    out[3] = dv[0] * p->c - dv[1] * p->s;
    out[4] = dv[0] * p->s + dv[1] * p->c;
    out[5] = dv[2];
}

/* d theta / d pupil_e1 = theta^2 sin theta / (s - 2 e1 theta sin theta) */
static double by_pupil(const projected *p, double rho, double z)
{
    double e1 = p->camera->pupil_e1, zz = z - e1 * p->theta * p->theta;
    return p->theta * p->theta * rho / (rho * rho + zz * zz - 2 * e1 * p->theta * rho);
}

static void by_lens_parameters(const projected *p, double *du, double *dv)
{
    const pf_camera *camera = p->camera;
    double theta = p->theta, c = p->c, s = p->s, s2 = theta * theta;
    double g[4] = {c, s, c * c - s * s, 2 * c * s};
    double radial = 0, tangential = 0, power = theta;
    for (int i = 0; i < 4; i++) {
        radial += camera->asym_radial_phi[i] * g[i];
        tangential += camera->asym_tangential_phi[i] * g[i];
    }
    for (int i = 0; i < 3; i++, power *= s2) {
        int a = PF_PARAM_ASYM_RADIAL_THETA + i, m = PF_PARAM_ASYM_TANGENTIAL_THETA + i;
        to_pixels(p, power * radial, 0, &du[a], &dv[a]);
        to_pixels(p, 0, power * tangential, &du[m], &dv[m]);
    }
    const double *a = camera->asym_radial_theta, *m = camera->asym_tangential_theta;
    radial = theta * (a[0] + s2 * (a[1] + s2 * a[2]));
    tangential = theta * (m[0] + s2 * (m[1] + s2 * m[2]));
    for (int i = 0; i < 4; i++) {
        int b = PF_PARAM_ASYM_RADIAL_PHI + i, j = PF_PARAM_ASYM_TANGENTIAL_PHI + i;
        to_pixels(p, radial * g[i], 0, &du[b], &dv[b]);
        to_pixels(p, 0, tangential * g[i], &du[j], &dv[j]);
    }
    const double powers[3] = {theta, s2, s2 * theta};
    for (int i = 0; i < CPOLY_TERMS; i++) {
        int h = pf_cpoly_harmonic[i], at = PF_PARAM_CPOLY + 2 * i;
        double ch, sh;
        harmonic(h, c, s, &ch, &sh);
        double r = powers[pf_cpoly_power[i] - 1];
        to_pixels(p, r * ch, r * sh, &du[at], &dv[at]);
        to_pixels(p, -r * sh, r * ch, &du[at + 1], &dv[at + 1]);
    }
}

static void by_parameters(const projected *p, double rho, double z, double *out)
{
    const pf_camera *camera = p->camera;
    double *du = out, *dv = out + PF_CAMERA_PARAMS;
    for (int i = 0; i < 2 * PF_CAMERA_PARAMS; i++)
        out[i] = 0;
    double x_d = p->x / p->d, y_d = p->y / p->d;
    du[PF_PARAM_F_U] = x_d;
    du[PF_PARAM_SKEW] = y_d;
    du[PF_PARAM_C_U] = 1;
    dv[PF_PARAM_F_V] = y_d;
    dv[PF_PARAM_C_V] = 1;
    double s2 = p->theta * p->theta, power = p->theta * s2;
    if (camera->radial == PF_RADIAL_GENERIC)
        for (int i = PF_PARAM_K2; i <= PF_PARAM_K5; i++, power *= s2)
            to_pixels(p, power, 0, &du[i], &dv[i]);
    by_lens_parameters(p, du, dv);
    if (camera->radial == PF_RADIAL_UNIFIED) {
        double sine, cosine, m = camera->mirror;
        sine_cosine(p->theta, &sine, &cosine);
        to_pixels(p, -sine * (1 - cosine) / ((m + cosine) * (m + cosine)), 0, &du[PF_PARAM_MIRROR],
                  &dv[PF_PARAM_MIRROR]);
    }
    double theta = by_pupil(p, rho, z);
    to_pixels(p, p->lens.r_t * theta, p->lens.t_t * theta, &du[PF_PARAM_PUPIL_E1], &dv[PF_PARAM_PUPIL_E1]);

    /* d = 1 + tan(tilt[1]) X - tan(tilt[0]) Y; the tangent's derivative is 1 + tan^2. */
    double turn_x = p->y * (1 + p->tilt.along_y * p->tilt.along_y) / p->d;
    double turn_y = -p->x * (1 + p->tilt.along_x * p->tilt.along_x) / p->d;
    du[PF_PARAM_TILT] = (camera->f_u * x_d + camera->skew * y_d) * turn_x;
    dv[PF_PARAM_TILT] = camera->f_v * y_d * turn_x;
    du[PF_PARAM_TILT + 1] = (camera->f_u * x_d + camera->skew * y_d) * turn_y;
    dv[PF_PARAM_TILT + 1] = camera->f_v * y_d * turn_y;
}

pf_status pf_camera_project(const pf_camera *camera, const double xyz[3], double uv[2], double *d_uv_d_xyz,
                            double *d_uv_d_param)
{
    double x = xyz[0], y = xyz[1], z = xyz[2], theta;
    if (!point_is_sound(x, y, z))
        return PF_ERR_DOMAIN;
    double rho = sqrt(x * x + y * y);
    bool on_axis = rho <= AXIS_RHO;
    if (on_axis && z < 0)
        return PF_ERR_DOMAIN; /* theta = pi: no direction there */
    if (camera->pupil_e1 != 0) {
        if (!solve_pupil(camera, rho, z, &theta))
            return PF_ERR_DOMAIN;
    } else {
        theta = angle_of(rho, z);
        if (!(theta <= camera->theta_max + THETA_SLACK))
            return PF_ERR_DOMAIN;
        theta = theta < camera->theta_max ? theta : camera->theta_max;
    }
    camera_kind kind = pf_camera_kind(camera);
    double inverse = on_axis ? 0 : 1 / rho;
    projected p = {.camera = camera, .theta = theta, .c = on_axis ? 1 : x * inverse, .s = y * inverse};
    if (kind.tilted)
        p.tilt = pf_camera_sensor_tilt(camera);
    if (!d_uv_d_xyz && !d_uv_d_param) {
        double r, t;
        lens_value(camera, kind, theta, p.c, p.s, &r, &t);
        sensor_value(camera, p.tilt, theta, p.c, p.s, r, t, uv);
        return PF_OK;
    }
    p.lens = pf_camera_lens(camera, kind, theta, p.c, p.s);
    sensor_value(camera, p.tilt, theta, p.c, p.s, p.lens.r, p.lens.t, uv);
    p.x = theta * (p.lens.r * p.c - p.lens.t * p.s);
    p.y = theta * (p.lens.r * p.s + p.lens.t * p.c);
    p.d = 1 + p.tilt.along_x * p.x + p.tilt.along_y * p.y;
    if (d_uv_d_xyz)
        by_point(&p, rho, z, on_axis ? 1 / z : theta / rho, d_uv_d_xyz);
    if (d_uv_d_param)
        by_parameters(&p, rho, z, d_uv_d_param);
    return PF_OK;
}

bool pf_camera_in_image(const pf_camera *camera, const double uv[2])
{
    if (!(uv[0] >= -0.5 && uv[0] <= camera->width - 0.5 && uv[1] >= -0.5 && uv[1] <= camera->height - 0.5))
        return false;
    double du = uv[0] - camera->circle_u, dv = uv[1] - camera->circle_v;
    return camera->circle_radius == 0 || du * du + dv * dv <= camera->circle_radius * camera->circle_radius;
}
