/* Projection and back-projection with all derivatives; points are small integers, pixels quarters. */
#include "cameras.h"
#include "hashes.h"

static double d_point[6], d_param[2 * PF_CAMERA_PARAMS], d_pixel[6];

static uint32_t hash_doubles(uint32_t crc, const double *v, size_t n)
{
    for (size_t i = 0; i < n; i++)
        crc = hash_double(crc, v[i]);
    return crc;
}

static double small_integer(uint32_t *state)
{
    return (double)(int32_t)(hash_random(state) % 41u) - 20;
}

uint32_t hash_camera_real(size_t *ram)
{
    uint32_t crc = 0, state = 2;
    *ram = 0;
    for (size_t c = 0; c < CAMERAS_COUNT; c++) {
        const pf_camera *camera = &CAMERAS[c];
        crc = hash_u32(crc, (uint32_t)pf_camera_check(camera, NULL));
        for (int i = 0; i < 60; i++) {
            const double xyz[3] = {small_integer(&state), small_integer(&state), small_integer(&state)};
            double uv[2], ray[3], origin[3];
            pf_status status = pf_camera_project(camera, xyz, uv, d_point, d_param);
            crc = hash_u32(crc, (uint32_t)status);
            if (status == PF_OK)
                crc = hash_doubles(hash_doubles(hash_doubles(crc, uv, 2), d_point, 6), d_param, 2 * PF_CAMERA_PARAMS);
            uv[0] = hash_random(&state) % 640u * 0.25;
            uv[1] = hash_random(&state) % 480u * 0.25;
            status = pf_camera_unproject(camera, uv, ray, origin, d_pixel);
            crc = hash_u32(crc, (uint32_t)status);
            if (status == PF_OK)
                crc = hash_doubles(hash_doubles(hash_doubles(crc, ray, 3), origin, 3), d_pixel, 6);
        }
    }
    return crc;
}
