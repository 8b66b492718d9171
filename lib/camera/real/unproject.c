/* Back-projection of single pixels. */
#include "real.h"

#include <float.h>

/* The plane point's direction and the angle that a ray makes there. */
typedef struct plane_angle {
    double theta, c, s;
} plane_angle;

static plane_angle symmetric_inverse(const pf_camera *camera, double x, double y)
{
    double rd = sqrt(x * x + y * y), inverse = rd > 0 ? 1 / rd : 0, none;
    double rd_max = camera->theta_max * pf_camera_radial(camera, camera->theta_max, &none);
    plane_angle at = {rd >= rd_max ? camera->theta_max : pf_camera_radial_solve(camera, rd), rd > 0 ? x * inverse : 1,
                      y * inverse};
    return at;
}

/* Plane point minus target, in the frame (u_r, u_phi) of `at`; returns its squared length. */
static double residual(const lens_point *lens, plane_angle at, double x, double y, double out[2])
{
    out[0] = at.theta * lens->r - (x * at.c + y * at.s);
    out[1] = at.theta * lens->t - (y * at.c - x * at.s);
    return out[0] * out[0] + out[1] * out[1];
}

/* Paper II, eq. 14-16: with the symmetric inverse Phi of the target x and S the asymmetric part there,
 * s = (I + dS/dPhi (dF/dPhi)^-1)^-1 S and the start is the symmetric inverse of x - s. Done in the plane, where the
 * rim's small r' cannot throw the start away. */
static plane_angle first_order_start(const pf_camera *camera, camera_kind kind, double x, double y)
{
    plane_angle at = symmetric_inverse(camera, x, y);
    lens_point lens = pf_camera_lens(camera, kind, at.theta, at.c, at.s);
    double slope, over = pf_camera_radial(camera, at.theta, &slope);
    double f[2] = {1 / slope, 1 / over};
    double m[4] = {1 + (lens.r_t - slope) * f[0], lens.r_p * f[1], lens.t_t * f[0], 1 + (lens.t_p - over) * f[1]};
    double S[2] = {at.theta * (lens.r - over), at.theta * lens.t};
    double det = m[0] * m[3] - m[1] * m[2];
    if (!(det > 0.1 && det < 10)) /* the rule's own linearisation does not hold: Newton starts from Phi */
        return at;
    double radial = (m[3] * S[0] - m[1] * S[1]) / det, tangential = (m[0] * S[1] - m[2] * S[0]) / det;
    return symmetric_inverse(camera, x - (at.c * radial - at.s * tangential), y - (at.s * radial + at.c * tangential));
}

/* at + (radial, tangential) in the chart (X, Y) = theta (cos phi, sin phi), kept within theta_max. */
static plane_angle moved(const pf_camera *camera, plane_angle at, double radial, double tangential)
{
    double along = at.theta + radial;
    double theta = sqrt(along * along + tangential * tangential);
    plane_angle next = at;
    if (theta > 0) {
        double inverse = 1 / theta, c = along * inverse, s = tangential * inverse;
        next.c = at.c * c - at.s * s;
        next.s = at.s * c + at.c * s;
        double norm = 1 / sqrt(next.c * next.c + next.s * next.s);
        next.c *= norm;
        next.s *= norm;
    }
    next.theta = theta < camera->theta_max ? theta : camera->theta_max;
    return next;
}

/* Whether no direction of the domain has the plane point (x, y), far outside its image. The check has proved the map F
 * monotone in the chart: (F(a) - F(b)).(a - b) > 0. With e = F(z) - (x, y) at a point z of the rim, a solution w in the
 * disc would have e.(z - w) > 0; where e points inwards, e_r < 0, the disc's curve leaves w only within
 * 2 theta_max |e_t / e_r| sqrt(1 + (e_t / e_r)^2) of z. So slide along the rim to where e_t vanishes; when what is left
 * of that distance, magnified ten times more than the map does at z, cannot make up e, there is none. Rounding is far
 * below what is asked: a millionth of theta_max, and e far above the slack of the rim. */
static bool is_outside(const pf_camera *camera, camera_kind kind, plane_angle z, double x, double y, double slack)
{
    for (int i = 0; i < 8; i++) {
        lens_point lens = pf_camera_lens(camera, kind, z.theta, z.c, z.s);
        double e[2], size = sqrt(residual(&lens, z, x, y, e));
        if (!(e[0] < 0 && size > 1e3 * slack))
            return false;
        double ratio = fabs(e[1] / e[0]), distance = 2 * camera->theta_max * ratio * sqrt(1 + ratio * ratio);
        double stretch = fabs(lens.r_t) + fabs(lens.r_p) + fabs(lens.t_t) + fabs(lens.t_p);
        if (ratio < 1e-6)
            return 10 * stretch * distance < size && size > 1e3 * stretch * THETA_SLACK;
        z = moved(camera, z, 0, -e[1] * z.theta / (z.theta * lens.t_p - e[0]));
    }
    return false;
}

/* Where Newton's method stands: the plane point's miss e of the target, in the frame (u_r, u_phi) there. */
typedef struct newton {
    plane_angle at;
    lens_point lens;
    double e[2], cost;
} newton;

static newton newton_at(const pf_camera *camera, camera_kind kind, plane_angle at, double x, double y)
{
    newton now = {.at = at, .lens = pf_camera_lens(camera, kind, at.theta, at.c, at.s)};
    now.cost = residual(&now.lens, at, x, y, now.e);
    return now;
}

/* Takes the step, halved until it comes closer to (x, y); false: it does not, and `now` stays. */
static bool comes_closer(const pf_camera *camera, camera_kind kind, newton *now, double radial, double tangential,
                         int halvings, double x, double y)
{
    for (double length = 1; halvings > 0; halvings--, length *= 0.5) {
        newton next = newton_at(camera, kind, moved(camera, now->at, length * radial, length * tangential), x, y);
        if (next.cost < now->cost) {
            *now = next;
            return true;
        }
    }
    return false;
}

/* Newton on the whole map in the chart (X, Y), where the axis is an ordinary point; a step that does not come closer is
 * halved. pf_camera_check has proved the map one-to-one on the disc, so what stops with a residual lies outside, unless
 * the next step is less than a ray can tell: where r' is huge, the last bit of theta is more than the slack. On the rim
 * a step outwards, cut off there, may lead away from what lies along it: then the rim itself is followed (Gauss). */
static bool asymmetric_inverse(const pf_camera *camera, camera_kind kind, double x, double y, double slack,
                               plane_angle *out)
{
    newton now = newton_at(camera, kind, first_order_start(camera, kind, x, y), x, y);
    double step = 0;
    for (int i = 0; i < 100 && now.cost > 0; i++) {
        const lens_point *l = &now.lens;
        const double *e = now.e;
        double det = l->r_t * l->t_p - l->r_p * l->t_t;
        double radial = -(l->t_p * e[0] - l->r_p * e[1]) / det;
        double tangential = -(l->r_t * e[1] - l->t_t * e[0]) / det;
        step = sqrt(radial * radial + tangential * tangential);
        if (step <= DBL_EPSILON * now.at.theta)
            break;
        bool held = now.at.theta == camera->theta_max && radial > 0;
        if (held && is_outside(camera, kind, now.at, x, y, slack))
            return false;
        /* A step of this size that does not come closer is rounding, not the wrong way. */
        int halvings = step <= 1e-12 * now.at.theta ? 1 : 40;
        if (comes_closer(camera, kind, &now, radial, tangential, halvings, x, y))
            continue;
        double along = -(l->r_p * e[0] + l->t_p * e[1]) / (l->r_p * l->r_p + l->t_p * l->t_p);
        if (!(held && comes_closer(camera, kind, &now, 0, along, halvings, x, y)))
            break; /* rounding, or nothing on the rim is closer */
    }
    *out = now.at;
    return now.cost <= slack * slack || step <= THETA_SLACK;
}

/* Derivative of the ray by the pixel: through the inverse of the lens's Jacobian at the result. */
static void by_pixel(const pf_camera *camera, camera_kind kind, plane_angle at, const double ray[3], sensor_tilt tilt,
                     double x_d, double y_d, double d, double *out)
{
    lens_point lens = pf_camera_lens(camera, kind, at.theta, at.c, at.s);
    double det = lens.r_t * lens.t_p - lens.r_p * lens.t_t;
    double sine_over = at.theta > 0 ? (ray[0] * at.c + ray[1] * at.s) / at.theta : 1;
    double sine = ray[0] * at.c + ray[1] * at.s;
    for (int i = 0; i < 2; i++) {
        double dx = i == 0 ? 1 / camera->f_u : -camera->skew / camera->f_u / camera->f_v;
        double dy = i == 0 ? 0 : 1 / camera->f_v;
        double dd = d * d * (tilt.along_x * dx + tilt.along_y * dy); /* X = d x_d, d = 1 / (1 - along . x_d) */
        double dX = d * dx + dd * x_d, dY = d * dy + dd * y_d;
        double radial = dX * at.c + dY * at.s, tangential = dY * at.c - dX * at.s;
        double by_theta = (lens.t_p * radial - lens.r_p * tangential) / det;
        double turn = sine_over * (lens.r_t * tangential - lens.t_t * radial) / det;
        out[i] = ray[2] * by_theta * at.c - turn * at.s;
        out[2 + i] = ray[2] * by_theta * at.s + turn * at.c;
        out[4 + i] = -sine * by_theta;
    }
}

/* How far outside the image of theta_max a plane point (x, y) may lie: RIM_SLACK_PX, and what the operations between it
 * and the pixel round, which is more where the projection is huge or the tilt magnifies. */
static double rim_slack(const pf_camera *camera, sensor_tilt tilt, double x, double y, double d)
{
    double coarsest = (camera->f_u > camera->f_v ? camera->f_u : camera->f_v) + fabs(camera->skew);
    double size = fabs(x) + fabs(y);
    double magnified = d * (1 + (fabs(tilt.along_x) + fabs(tilt.along_y)) * size);
    double on_sensor = size / d + fabs(camera->c_u) / camera->f_u + fabs(camera->c_v) / camera->f_v;
    return RIM_SLACK_PX / coarsest + 8 * DBL_EPSILON * magnified * on_sensor;
}

pf_status pf_camera_unproject(const pf_camera *camera, const double uv[2], double ray[3], double origin[3],
                              double *d_ray_d_uv)
{
    camera_kind kind = pf_camera_kind(camera);
    sensor_tilt tilt = {0, 0};
    if (kind.tilted)
        tilt = pf_camera_sensor_tilt(camera);
    double y_d = (uv[1] - camera->c_v) / camera->f_v;
    double x_d = (uv[0] - camera->c_u - camera->skew * y_d) / camera->f_u;
    double inverse_d = 1 - tilt.along_x * x_d - tilt.along_y * y_d;
    double d = 1 / inverse_d, x = x_d * d, y = y_d * d;
    if (!(inverse_d > 0 && x * x + y * y <= POINT_MAX))
        return PF_ERR_DOMAIN;

    double slack = rim_slack(camera, tilt, x, y, d);
    plane_angle at;
    if (kind.asymmetric || kind.cpoly) {
        if (!asymmetric_inverse(camera, kind, x, y, slack, &at))
            return PF_ERR_DOMAIN;
    } else {
        if (!(sqrt(x * x + y * y) <= pf_camera_radius(camera, camera->theta_max, NULL) + slack))
            return PF_ERR_DOMAIN;
        at = symmetric_inverse(camera, x, y);
    }
    double sine, cosine;
    sine_cosine(at.theta, &sine, &cosine);
    ray[0] = sine * at.c;
    ray[1] = sine * at.s;
    ray[2] = cosine;
    if (origin) {
        origin[0] = origin[1] = 0;
        origin[2] = camera->pupil_e1 * at.theta * at.theta;
    }
    if (d_ray_d_uv)
        by_pixel(camera, kind, at, ray, tilt, x_d, y_d, d, d_ray_d_uv);
    return PF_OK;
}
