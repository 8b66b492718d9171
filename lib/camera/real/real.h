/* What the files of camera/real share. Not for users.
 *
 * Everything asymmetric is written in the frame (u_r, u_phi) that turns with phi: the plane point before the sensor is
 * R u_r + T u_phi, and a term c Z^m conj(Z)^n of cpoly adds c theta^(m+n) e^(i h phi), h = m - n - 1, to R + i T. So
 * the terms of Paper II and of cpoly are one kind of thing, a power of theta times a harmonic of phi, and neither 0/0
 * nor an angle phi occurs: only its cosine and sine.
 */
#ifndef PIPEFISH_CAMERA_REAL_H
#define PIPEFISH_CAMERA_REAL_H

#include "elementary.h"
#include "pipefish/camera.h"

/* A ray that unproject made at theta_max comes back through projection a few units in the last place beyond it. */
#define THETA_SLACK 4e-15

/* Likewise a pixel of theta_max comes back at most this far outside; half of the promised round trip. */
#define RIM_SLACK_PX 5e-10

/* Squares of coordinates in this range neither overflow nor vanish. */
#define POINT_MIN 1e-100
#define POINT_MAX 1e100

/* Up to here a point is on the axis: below, its square has lost digits, and no pixel can tell (theta < 1e-40). */
#define AXIS_RHO 1e-140

#define CPOLY_TERMS 7
extern const int pf_cpoly_power[CPOLY_TERMS], pf_cpoly_harmonic[CPOLY_TERMS];

typedef struct camera_kind {
    bool asymmetric; /* D is not 0 */
    bool cpoly;      /* nor are all c_mn */
    bool tilted;
} camera_kind;

camera_kind pf_camera_kind(const pf_camera *camera);

/* r(theta) / theta of the polynomial, and r'(theta). */
static inline double generic_radial(const pf_camera *camera, double theta, double *slope)
{
    double s = theta * theta;
    *slope = 1 + s * (3 * camera->k2 + s * (5 * camera->k3 + s * (7 * camera->k4 + s * (9 * camera->k5))));
    return 1 + s * (camera->k2 + s * (camera->k3 + s * (camera->k4 + s * camera->k5)));
}

/* r(theta) / theta of any family, and r'(theta). */
double pf_camera_radial(const pf_camera *camera, double theta, double *slope);

/* theta with r(theta) = rd, 0 <= rd <= r(theta_max). */
double pf_camera_radial_solve(const pf_camera *camera, double rd);

/* R / theta, T / theta and, in the frame (u_r, u_phi), the derivatives of the plane point by theta, (r_t, t_t), and by
 * phi over theta, (r_p, t_p): its Jacobian by (X, Y) = theta (cos phi, sin phi). All finite on the axis. */
typedef struct lens_point {
    double r, t, r_t, t_t, r_p, t_p;
} lens_point;

/* Adds D / theta at (theta, phi); c, s = cos phi, sin phi. */
static inline void add_asymmetry(const pf_camera *camera, double theta, double c, double s, double *r, double *t)
{
    const double *a = camera->asym_radial_theta, *b = camera->asym_radial_phi;
    const double *m = camera->asym_tangential_theta, *j = camera->asym_tangential_phi;
    double s2 = theta * theta, c_2 = c * c - s * s, s_2 = 2 * c * s;
    *r += (a[0] + s2 * (a[1] + s2 * a[2])) * (b[0] * c + b[1] * s + b[2] * c_2 + b[3] * s_2);
    *t += (m[0] + s2 * (m[1] + s2 * m[2])) * (j[0] * c + j[1] * s + j[2] * c_2 + j[3] * s_2);
}

/* Adds the terms of cpoly, over theta. */
static inline void add_cpoly(const pf_camera *camera, double theta, double c, double s, double *r, double *t)
{
    const double *k = camera->cpoly;
    double c_2 = c * c - s * s, s_2 = 2 * c * s;
    double c_3 = c * c_2 - s * s_2, s_3 = s * c_2 + c * s_2;
    double c_4 = c_2 * c_2 - s_2 * s_2, s_4 = 2 * c_2 * s_2;
    double r1 = k[0] * c_2 + k[1] * s_2, t1 = k[1] * c_2 - k[0] * s_2; /* h = -2 */
    double r2 = k[2] * c - k[3] * s, t2 = k[2] * s + k[3] * c;         /* 1 */
    r2 += k[4] * c + k[5] * s;                                         /* -1 */
    t2 += k[5] * c - k[4] * s;
    r2 += k[6] * c_3 + k[7] * s_3; /* -3 */
    t2 += k[7] * c_3 - k[6] * s_3;
    double r3 = k[8] * c_2 - k[9] * s_2, t3 = k[8] * s_2 + k[9] * c_2; /* 2 */
    r3 += k[10] * c_2 + k[11] * s_2;                                   /* -2 */
    t3 += k[11] * c_2 - k[10] * s_2;
    r3 += k[12] * c_4 + k[13] * s_4; /* -4 */
    t3 += k[13] * c_4 - k[12] * s_4;
    *r += r1 + theta * (r2 + theta * r3);
    *t += t1 + theta * (t2 + theta * t3);
}

/* cos and sin of h phi, |h| <= 4. */
static inline void harmonic(int h, double c, double s, double *cosine, double *sine)
{
    double ch = 1, sh = 0;
    for (int i = 0; i < (h < 0 ? -h : h); i++) {
        double next = ch * c - sh * s;
        sh = sh * c + ch * s;
        ch = next;
    }
    *cosine = ch;
    *sine = h < 0 ? -sh : sh;
}

/* Tangents of the tilt: d = 1 + along_x X + along_y Y. */
typedef struct sensor_tilt {
    double along_x, along_y;
} sensor_tilt;
sensor_tilt pf_camera_sensor_tilt(const pf_camera *camera);

/* The lens at (theta, phi), with derivatives. */
lens_point pf_camera_lens(const pf_camera *camera, camera_kind kind, double theta, double c, double s);

/* The same where r / theta and r' are known. */
lens_point pf_camera_lens_at(const pf_camera *camera, camera_kind kind, double theta, double c, double s, double radial,
                             double slope);

static inline void add_terms(const pf_camera *camera, camera_kind kind, double theta, double c, double s, double *r,
                             double *t)
{
    if (kind.asymmetric)
        add_asymmetry(camera, theta, c, s, r, t);
    if (kind.cpoly)
        add_cpoly(camera, theta, c, s, r, t);
}

/* The lens at (theta, phi): only r and t. The one expression of the value: batches and single points share its bits. */
static inline void lens_value(const pf_camera *camera, camera_kind kind, double theta, double c, double s, double *r,
                              double *t)
{
    double none;
    *r = pf_camera_radial(camera, theta, &none);
    *t = 0;
    add_terms(camera, kind, theta, c, s, r, t);
}

/* From (r, t) = (R, T) / theta to pixels. */
static inline void sensor_value(const pf_camera *camera, sensor_tilt tilt, double theta, double c, double s, double r,
                                double t, double uv[2])
{
    double x = theta * (r * c - t * s), y = theta * (r * s + t * c);
    if (tilt.along_x != 0 || tilt.along_y != 0) {
        double d = 1 + tilt.along_x * x + tilt.along_y * y;
        x /= d;
        y /= d;
    }
    uv[0] = camera->f_u * x + camera->skew * y + camera->c_u;
    uv[1] = camera->f_v * y + camera->c_v;
}

/* Whether coordinates are finite and of a size whose squares are. */
static inline bool point_is_sound(double x, double y, double z)
{
    double ax = fabs(x), ay = fabs(y), az = fabs(z);
    double largest = ax > ay ? ax : ay;
    largest = az > largest ? az : largest;
    return (ax <= POINT_MAX) & (ay <= POINT_MAX) & (az <= POINT_MAX) & (largest >= POINT_MIN);
}

#endif
