/* Bearings of tracks. Its own library: the only part of the tracker that needs the camera and a hosted libm. */
#include "pipefish/track.h"

static int32_t to_q30(double v)
{
    const double scaled = v * 1073741824.0;
    return (int32_t)(scaled < 0 ? scaled - 0.5 : scaled + 0.5);
}

void pf_track_bearings(const pf_camera *camera, const pf_track *tracks, uint32_t n, pf_ray_q30 *rays)
{
    for (uint32_t i = 0; i < n; i++) {
        const double uv[2] = {tracks[i].pos.x / 65536.0, tracks[i].pos.y / 65536.0};
        double ray[3];
        rays[i] = (pf_ray_q30){0, 0, 0};
        if (pf_camera_unproject(camera, uv, ray, NULL, NULL) == PF_OK)
            rays[i] = (pf_ray_q30){to_q30(ray[0]), to_q30(ray[1]), to_q30(ray[2])};
    }
}
