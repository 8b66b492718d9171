/* Bearings of tracks, and projection for prediction. Its own library: the only part of the tracker that needs the
 * camera. */
#include "pipefish/track.h"

void pf_track_bearings(const pf_camera_rays *camera, const pf_track *tracks, uint32_t n, pf_ray_q30 *rays)
{
    for (uint32_t i = 0; i < n; i++)
        rays[i] = pf_camera_rays_at(camera, tracks[i].pos);
}

bool pf_track_project(const void *fixed, const pf_ray_q30 *ray, pf_point_q16 *at)
{
    return pf_camera_fixed_project(fixed, *ray, at) == PF_OK;
}

static pf_ray_q30 ray_of(const void *rays, pf_point_q16 pixel)
{
    return pf_camera_rays_at(rays, pixel);
}

pf_track_lens pf_track_lens_of(const pf_camera_rays *rays, const pf_camera_fixed *fixed)
{
    return (pf_track_lens){ray_of, pf_track_project, rays, fixed};
}
