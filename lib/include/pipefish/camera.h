/* The generic camera model of Kannala & Brandt (PAMI 2006) and its family, in double precision. The only implementation
 * of projection, back-projection and their derivatives in Pipefish: the daemon, calibration, reconstruction and Python
 * call it.
 *
 *   theta = atan2(rho, z - pupil_e1 theta^2), rho = hypot(x, y), phi = atan2(y, x)       (implicit when pupil_e1 != 0)
 *   r(theta) = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9                        (gauge: k1 = 1)
 *              or another radial function, all with r'(0) = 1
 *   R + i T  = r + D_r + i D_t + e^(-i phi) sum c_mn Z^m conj(Z)^n,    Z = theta e^(i phi)
 *   D        = (a0 theta + a1 theta^3 + a2 theta^5)(b0 cos phi + b1 sin phi + b2 cos 2 phi + b3 sin 2 phi)
 *   (x_d, y_d) = (R u_r + T u_phi) / d,  d = 1 + tan(tilt[1]) X - tan(tilt[0]) Y,  (X, Y) = R u_r + T u_phi
 *   u = f_u x_d + skew y_d + c_u,  v = f_v y_d + c_v
 *
 * so f_u and f_v are pixels per radian near the axis, also on a tilted sensor: the affine part of the sensor's
 * homography is f_u, f_v, skew, c_u, c_v, and the tilt is its projective part. The asymmetric terms D (23 parameters
 * with the radial ones, Paper II) are continuous on the axis but have no derivative there; derivatives on it are those
 * along phi = 0. The terms c_mn ("cpoly") are smooth everywhere.
 *
 * Only IEEE double +, -, *, / and sqrt are used, in a fixed order without contraction: the same bits on all targets
 * with IEEE doubles, in soft float too. Needs a hosted sqrt. All functions are pure.
 */
#ifndef PIPEFISH_CAMERA_H
#define PIPEFISH_CAMERA_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum pf_radial {
    PF_RADIAL_GENERIC = 0,       /* the odd polynomial above */
    PF_RADIAL_PERSPECTIVE = 1,   /* tan theta */
    PF_RADIAL_STEREOGRAPHIC = 2, /* 2 tan(theta / 2) */
    PF_RADIAL_EQUIDISTANT = 3,   /* theta */
    PF_RADIAL_EQUISOLID = 4,     /* 2 sin(theta / 2) */
    PF_RADIAL_ORTHOGRAPHIC = 5,  /* sin theta */
    PF_RADIAL_UNIFIED = 6,       /* catadioptric, r = (mirror + 1) sin theta / (mirror + cos theta) */
} pf_radial;

#define PF_CPOLY_MAX        14
#define PF_CAMERA_THETA_MAX 3.1415926535897927 /* the last number before pi */

typedef struct pf_camera {
    uint32_t width, height; /* pixels, 1..16384 */
    uint32_t radial;        /* pf_radial */
    double f_u, f_v;        /* pixels per radian on the axis, 0.1..1e5 */
    double skew;            /* pixels per radian, at most f_u */
    double c_u, c_v;        /* principal point, pixels, -1e5..1e5 (the image circle's centre too) */
    double tilt[2];         /* sensor tilt about x and y, radians, -0.7..0.7 */
    double k2, k3, k4, k5;  /* radial polynomial, -1e6..1e6; 0 unless radial is PF_RADIAL_GENERIC */
    double asym_radial_theta[3], asym_radial_phi[4];         /* a and b of D_r; b of unit norm (1e-6) unless a is 0 */
    double asym_tangential_theta[3], asym_tangential_phi[4]; /* of D_t, likewise */
    double cpoly[PF_CPOLY_MAX]; /* c_01, c_20, c_11, c_02, c_30, c_12, c_03: each real, then imaginary part */
    double mirror;              /* of PF_RADIAL_UNIFIED, 0..1e3; 0 otherwise */
    double pupil_e1;            /* metres, -1..1: rays start at (0, 0, pupil_e1 theta^2); 0 = central camera */
    double theta_max;           /* radians, 1e-6 <= theta_max < pi: the model is valid for theta <= theta_max */
    double circle_u, circle_v, circle_radius; /* image circle in pixels; circle_radius 0 = the whole image is lit */
} pf_camera;

/* Order of the parameter derivatives of pf_camera_project, of covariances and of stored profiles. */
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
    PF_PARAM_ASYM_RADIAL_THETA = 9,      /* 3 */
    PF_PARAM_ASYM_RADIAL_PHI = 12,       /* 4 */
    PF_PARAM_ASYM_TANGENTIAL_THETA = 16, /* 3 */
    PF_PARAM_ASYM_TANGENTIAL_PHI = 19,   /* 4 */
    PF_PARAM_TILT = 23,                  /* 2 */
    PF_PARAM_MIRROR = 25,
    PF_PARAM_PUPIL_E1 = 26,
    PF_PARAM_CPOLY = 27, /* 14 */
    PF_CAMERA_PARAMS = 41,
} pf_camera_param;

/* The parameter as a place in the struct: the only link between the numbers above and the names. NULL beyond them. */
double *pf_camera_param_at(pf_camera *camera, uint32_t param);

/* Checks a camera once, when it is loaded: finite values, ranges, and that the model is one-to-one for theta <=
 * theta_max, proved and not sampled: r' > 0 by Bernstein coefficients; with asymmetric terms the Jacobian's symmetric
 * part positive definite on the disc |Z| <= theta_max (which makes a map of a convex set one-to-one) by bounds on
 * subdivided cells; d > 0 on a tilted sensor. What rounding or 100,000 cells cannot decide is refused. The other
 * functions here assume a checked camera.
 * Returns PF_OK; PF_ERR_ARGUMENT (out of range or not finite); PF_ERR_DOMAIN (not one-to-one up to theta_max, or not
 * proved). `why` (may be NULL) gets a static text, "field: reason" ("ok" for PF_OK). */
pf_status pf_camera_check(const pf_camera *camera, const char **why);

/* r(theta) of the symmetric part, 0 <= theta <= theta_max; *slope (may be NULL) gets r'. */
double pf_camera_radius(const pf_camera *camera, double theta, double *slope);

/* Projects the point `xyz` (metres, camera frame; any length for a central camera, largest coordinate 1e-100..1e100).
 * out: uv[2] pixels
 *      d_uv_d_xyz, row-major 2x3, or NULL
 *      d_uv_d_param, row-major 2 x PF_CAMERA_PARAMS, or NULL; all terms, also those now 0 (mirror, k: 0 where unused)
 * Returns PF_OK, or with the outputs untouched PF_ERR_DOMAIN: theta > theta_max (by more than rounding, 4e-15: what
 * unproject returns at the rim projects again), the origin, not finite, or with a pupil shift a point nearer to the
 * camera than |pupil_e1| (theta_max^2 + 2 theta_max): there, rays of the moving pupil may cross.
 * A projection may lie outside the image; pf_camera_in_image tells. */
pf_status pf_camera_project(const pf_camera *camera, const double xyz[3], double uv[2], double *d_uv_d_xyz,
                            double *d_uv_d_param);

/* Back-projects a pixel to the ray X = origin + s ray, s > 0, |ray| = 1: the first-order rule of Paper II as the start,
 * then safeguarded Newton. The round trip is within 1e-9 px for f <= 1e4 px and sum |k_i| theta_max^(2i-1) <= 100, the
 * rim included; where a radian is more than 1e5 px, within what a ray in doubles can tell: 4e-15 rad.
 * out: ray[3]; origin[3] or NULL (zero for a central camera); d_ray_d_uv, row-major 3x2, or NULL
 * Returns PF_OK, or with the outputs untouched PF_ERR_DOMAIN: outside the image of theta <= theta_max, or not finite.
 */
pf_status pf_camera_unproject(const pf_camera *camera, const double uv[2], double ray[3], double origin[3],
                              double *d_ray_d_uv);

/* The central camera that sees the wall of a straight round tube of this radius (metres, to 1e3), driven along by the
 * optical axis, where `camera` does: with a pupil that moves by millimetres, rays on a wall 0.1 m away do not meet in
 * the centre, and bearings alone would move as on a wall up to a hundredth nearer or farther. Its radial polynomial is
 * fitted, to some 0.01 px for ordinary lenses; terms beyond the symmetric ones are taken as they are. A central camera
 * is copied. `camera` is checked; so is what comes out.
 * Returns PF_OK, or with *central untouched PF_ERR_ARGUMENT (radius) or PF_ERR_UNSUPPORTED: no polynomial is within 0.1
 * px, or it is not one-to-one. */
pf_status pf_camera_in_tube(const pf_camera *camera, double radius, pf_camera *central);

/* Whether a pixel lies on the sensor (-0.5 <= u <= width - 0.5, v likewise) and inside the image circle. NaN: false. */
bool pf_camera_in_image(const pf_camera *camera, const double uv[2]);

/* Batches: xyz (n,3) -> uv (n,2) and the reverse; ok[i] is 1 where item i is valid. Invalid items are NaN. origin
 * (n,3) may be NULL. Inputs and outputs must not overlap. Projection gives the bits of pf_camera_project;
 * back-projection agrees with pf_camera_unproject to a few units in the last place. */
void pf_camera_project_n(const pf_camera *camera, size_t n, const double *xyz, double *uv, uint8_t *ok);
void pf_camera_unproject_n(const pf_camera *camera, size_t n, const double *uv, double *ray, double *origin,
                           uint8_t *ok);

#ifdef __cplusplus
}
#endif
#endif
