/* The camera model as a shared library for camera_peers.py, with the cameras that are measured. */
#include "pipefish/camera_fixed.h"

#include <stdlib.h>

/* The lens of the example profile: 185 degrees, p9; with Paper II's asymmetric terms (about 1 px) where `asymmetric`.
 */
const pf_camera *bench_camera(int asymmetric);
const pf_camera *bench_camera(int asymmetric)
{
    static pf_camera cameras[2];
    pf_camera camera = {.width = 1280, .height = 800, .f_u = 356.2, .f_v = 355.9, .c_u = 647.3, .c_v = 404.8};
    camera.k2 = -0.031;
    camera.k3 = 0.0042;
    camera.k4 = -0.0011;
    camera.k5 = 0.00006;
    camera.theta_max = 1.92;
    static const double phi[4] = {0.5, -0.5, 0.5, 0.5};
    for (int i = 0; i < 4; i++)
        camera.asym_radial_phi[i] = camera.asym_tangential_phi[i] = asymmetric ? phi[i] : 0;
    for (int i = 0; i < 3; i++)
        camera.asym_radial_theta[i] = camera.asym_tangential_theta[i] = asymmetric ? 1e-3 / (1 + i) : 0;
    cameras[asymmetric != 0] = camera;
    return pf_camera_check(&camera, NULL) == PF_OK ? &cameras[asymmetric != 0] : NULL;
}

/* The first camera's table of rays; never freed. */
const pf_camera_rays *bench_rays(void);
const pf_camera_rays *bench_rays(void)
{
    const pf_camera *camera = bench_camera(0);
    const pf_camera_fixed *fixed;
    const pf_camera_rays *rays;
    size_t n = pf_camera_fixed_workspace_size(camera);
    if (pf_camera_fixed_init(&fixed, camera, malloc(n), n) != PF_OK)
        return NULL;
    const uint32_t step = pf_camera_rays_step(fixed);
    n = pf_camera_rays_workspace_size(fixed, step);
    return pf_camera_rays_init(&rays, fixed, step, malloc(n), n) == PF_OK ? rays : NULL;
}
