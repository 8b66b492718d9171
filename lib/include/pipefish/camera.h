/* The generic camera model of Kannala & Brandt (PAMI 2006), in double precision. The only implementation of projection,
 * back-projection and their derivatives in Pipefish: the daemon, calibration, reconstruction and Python call it.
 *
 *   theta = atan2(hypot(x, y), z), phi = atan2(y, x)
 *   r(theta) = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9          (gauge: k1 = 1)
 *   u = f_u x_d + skew y_d + c_u,  v = f_v y_d + c_v,  (x_d, y_d) = r(theta) (cos phi, sin phi)
 *
 * so f_u and f_v are pixels per radian near the axis. The struct carries the whole family (asymmetric terms, sensor
 * tilt, pupil shift, classical radial functions); this version evaluates the p9 part with skew, and pf_camera_check
 * answers PF_ERR_UNSUPPORTED for a camera that needs more, never a silently wrong number.
 *
 * Links against a hosted libm; the integer tables of camera/fixed are for targets without one. All functions are pure.
 */
#ifndef PIPEFISH_CAMERA_H
#define PIPEFISH_CAMERA_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum pf_radial {
    PF_RADIAL_GENERIC = 0, /* the odd polynomial above */
    PF_RADIAL_PERSPECTIVE = 1,
    PF_RADIAL_STEREOGRAPHIC = 2,
    PF_RADIAL_EQUIDISTANT = 3,
    PF_RADIAL_EQUISOLID = 4,
    PF_RADIAL_ORTHOGRAPHIC = 5,
    PF_RADIAL_UNIFIED = 6, /* catadioptric, r = (mirror + 1) sin / (mirror + cos) */
} pf_radial;

#define PF_CPOLY_MAX 14

typedef struct pf_camera {
    uint32_t width, height; /* pixels, 1..16384 */
    uint32_t radial;        /* pf_radial */
    double f_u, f_v;        /* pixels per radian on the axis, 0.1..1e5 */
    double skew;            /* pixels per radian, at most f_u */
    double c_u, c_v;        /* principal point, pixels, -1e5..1e5 (the image circle's centre too) */
    double tilt[2];         /* sensor tilt about x and y, radians */
    double k2, k3, k4, k5;  /* radial polynomial, -1e6..1e6 */
    double asym_radial_theta[3], asym_radial_phi[4]; /* l1..l3, i1..i4 of CALIBRATION 1; phi vectors of unit norm */
    double asym_tangential_theta[3], asym_tangential_phi[4]; /* m1..m3, j1..j4 */
    double cpoly[PF_CPOLY_MAX]; /* smooth asymmetry: coefficients of z^m conj(z)^n, see docs/profile.md */
    double mirror;              /* unified catadioptric parameter */
    double pupil_e1;            /* metres: rays start at (0, 0, pupil_e1 theta^2); 0 = central camera */
    double theta_max;           /* radians, 1e-6 <= theta_max < pi: the model is valid for theta <= theta_max */
    double circle_u, circle_v, circle_radius; /* image circle in pixels; circle_radius 0 = the whole image is lit */
} pf_camera;

/* Order of the parameter derivatives of pf_camera_project. */
typedef enum pf_camera_param {
    PF_PARAM_F_U = 0,
    PF_PARAM_F_V = 1,
    PF_PARAM_SKEW = 2,
    PF_PARAM_C_U = 3,
    PF_PARAM_C_V = 4,
    PF_PARAM_K2 = 5,
    PF_PARAM_K3 = 6,
    PF_PARAM_K4 = 7,
    PF_PARAM_K5 = 8,
    PF_CAMERA_PARAMS = 9, /* grows when the full model arrives */
} pf_camera_param;

/* Checks a camera once, when it is loaded: finite values, ranges, r'(theta) > 0 proved on [0, theta_max] by interval
 * arithmetic (r' above 1e-13 of the sum of its terms' sizes: closer to zero is refused). The other functions here
 * assume a checked camera.
 * Returns PF_OK; PF_ERR_ARGUMENT (out of range or not finite); PF_ERR_DOMAIN (r is not increasing up to theta_max);
 * PF_ERR_UNSUPPORTED (needs terms this version does not evaluate). `why` (may be NULL) gets a static
 * text, "field: reason" ("ok" for PF_OK). */
pf_status pf_camera_check(const pf_camera *camera, const char **why);

/* Projects the point `xyz` (metres, camera frame; any length for a central camera, largest coordinate 1e-100..1e100).
 * out: uv[2] pixels
 *      d_uv_d_xyz, row-major 2x3, or NULL
 *      d_uv_d_param, row-major 2 x PF_CAMERA_PARAMS, or NULL
 * Returns PF_OK, or with the outputs untouched PF_ERR_DOMAIN: theta > theta_max (by more than rounding, 4e-15: what
 * unproject returns at the rim projects again), the origin, or not finite.
 * A projection may lie outside the image; pf_camera_in_image tells. */
pf_status pf_camera_project(const pf_camera *camera, const double xyz[3], double uv[2], double *d_uv_d_xyz,
                            double *d_uv_d_param);

/* Back-projects a pixel to the ray X = origin + s ray, s > 0, |ray| = 1. Safeguarded Newton; the round trip is within
 * 1e-9 px for f <= 1e4 px and sum |k_i| theta_max^(2i-1) <= 100, the rim included.
 * out: ray[3]; origin[3] or NULL (zero for a central camera); d_ray_d_uv, row-major 3x2, or NULL
 * Returns PF_OK, or with the outputs untouched PF_ERR_DOMAIN: beyond r(theta_max), or not finite. */
pf_status pf_camera_unproject(const pf_camera *camera, const double uv[2], double ray[3], double origin[3],
                              double *d_ray_d_uv);

/* Whether a pixel lies on the sensor (-0.5 <= u <= width - 0.5, v likewise) and inside the image circle. NaN: false. */
bool pf_camera_in_image(const pf_camera *camera, const double uv[2]);

/* Batches: xyz (n,3) -> uv (n,2) and the reverse; ok[i] is 1 where item i is valid. Invalid items are NaN.
 * xyz and uv must not overlap. */
void pf_camera_project_n(const pf_camera *camera, size_t n, const double *xyz, double *uv, uint8_t *ok);
void pf_camera_unproject_n(const pf_camera *camera, size_t n, const double *uv, double *ray, uint8_t *ok);

#ifdef __cplusplus
}
#endif
#endif
