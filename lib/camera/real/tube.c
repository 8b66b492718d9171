/* A camera whose pupil moves, as it is in a tube: seen from its centre, whatever it sees of the wall is a little
 * farther ahead than the ray's own direction says, and by how much is a function of the angle alone. */
#include <math.h>

#include "elementary.h"
#include "pipefish/camera.h"

#define TERMS 5  /* of the radial polynomial */
#define NODES 96 /* angles at which it is fitted */

/* Solves the positive a x = b in place of b, by elimination. */
static void solve(double a[TERMS][TERMS], double b[TERMS])
{
    for (int k = 0; k < TERMS; k++)
        for (int i = k + 1; i < TERMS; i++) {
            const double f = a[i][k] / a[k][k];
            for (int j = k; j < TERMS; j++)
                a[i][j] -= f * a[k][j];
            b[i] -= f * b[k];
        }
    for (int k = TERMS; k-- > 0;) {
        for (int j = k + 1; j < TERMS; j++)
            b[k] -= a[k][j] * b[j];
        b[k] /= a[k][k];
    }
}

/* The odd powers of x from the first on. */
static void powers(double x, double p[TERMS])
{
    p[0] = x;
    for (int i = 1; i < TERMS; i++)
        p[i] = p[i - 1] * x * x;
}

/* From the centre, the angle of what the ray at `theta` meets on a wall `radius` off the axis. */
static double angle_in_tube(const pf_camera *camera, double radius, double theta)
{
    double s, c;
    sine_cosine(theta, &s, &c);
    return angle_of(s, c + s * camera->pupil_e1 * theta * theta / radius);
}

pf_status pf_camera_in_tube(const pf_camera *camera, double radius, pf_camera *central)
{
    double a[TERMS][TERMS] = {{0}}, b[TERMS] = {0}, p[TERMS], worst = 0;
    if (!(radius > 0 && radius <= 1e3))
        return PF_ERR_ARGUMENT;
    pf_camera out = *camera;
    if (camera->pupil_e1 == 0) {
        *central = out;
        return PF_OK;
    }
    const double most = angle_in_tube(camera, radius, camera->theta_max);
    for (int n = 1; n <= NODES; n++) {
        const double theta = camera->theta_max * n / NODES, r = pf_camera_radius(camera, theta, NULL);
        powers(angle_in_tube(camera, radius, theta) / most, p);
        for (int i = 0; i < TERMS; i++) {
            b[i] += p[i] * r;
            for (int j = 0; j < TERMS; j++)
                a[i][j] += p[i] * p[j];
        }
    }
    solve(a, b);
    for (int n = 1; n <= NODES; n++) {
        const double theta = camera->theta_max * n / NODES;
        double off = -pf_camera_radius(camera, theta, NULL);
        powers(angle_in_tube(camera, radius, theta) / most, p);
        for (int i = 0; i < TERMS; i++)
            off += p[i] * b[i];
        worst = fmax(worst, fabs(off) * fmax(camera->f_u, camera->f_v));
    }
    const double first = b[0] / most, square = most * most;
    if (!(worst <= 0.1 && first > 0))
        return PF_ERR_UNSUPPORTED;
    out.radial = PF_RADIAL_GENERIC;
    out.mirror = 0;
    out.pupil_e1 = 0;
    out.theta_max = most;
    out.f_u *= first;
    out.f_v *= first;
    out.skew *= first;
    out.k2 = b[1] / b[0] / square;
    out.k3 = b[2] / b[0] / square / square;
    out.k4 = b[3] / b[0] / square / square / square;
    out.k5 = b[4] / b[0] / square / square / square / square;
    if (pf_camera_check(&out, NULL) != PF_OK)
        return PF_ERR_UNSUPPORTED;
    *central = out;
    return PF_OK;
}
