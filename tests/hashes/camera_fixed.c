/* Tables, projection of rays and points, back-projection, the table of rays, remapping. */
#include "pipefish/camera_fixed.h"
#include "cameras.h"
#include "hashes.h"

static _Alignas(16) uint8_t camera_block[30000], rays_block[40000];

static uint32_t hash_point(uint32_t crc, pf_status status, pf_point_q16 p)
{
    return hash_u32(hash_u32(hash_u32(crc, (uint32_t)status), (uint32_t)p.x), (uint32_t)p.y);
}

static uint32_t hash_ray(uint32_t crc, pf_ray_q30 r)
{
    return hash_u32(hash_u32(hash_u32(crc, (uint32_t)r.x), (uint32_t)r.y), (uint32_t)r.z);
}

static uint32_t hash_transforms(uint32_t crc, const pf_camera_fixed *fixed, uint32_t *state)
{
    for (int i = 0; i < 300; i++) {
        const pf_ray_q30 to = {(int32_t)(hash_random(state) << 8) / 2, (int32_t)(hash_random(state) << 8) / 2,
                               (int32_t)(hash_random(state) << 8) / 2};
        const int32_t point[3] = {to.x >> 4, to.y >> 4, to.z >> 4};
        pf_point_q16 pixel = {0, 0};
        pf_ray_q30 ray = {0, 0, 0};
        int32_t origin = 0;
        pf_status status = pf_camera_fixed_project(fixed, to, &pixel);
        crc = hash_point(crc, status, pixel);
        status = pf_camera_fixed_project_point(fixed, point, 28, &pixel);
        crc = hash_point(crc, status, pixel);
        pixel = (pf_point_q16){(int32_t)(hash_random(state) % 10500000u), (int32_t)(hash_random(state) % 7900000u)};
        status = pf_camera_fixed_unproject(fixed, pixel, &ray, &origin);
        crc = hash_u32(hash_u32(hash_ray(crc, ray), (uint32_t)status), (uint32_t)origin);
    }
    return crc;
}

static uint32_t hash_tables(uint32_t crc, const pf_camera_fixed *fixed, const pf_camera_rays *rays, uint32_t *state)
{
    enum { N = 50 };
    pf_point_q16 pixels[N];
    pf_ray_q30 out[N];
    pf_remap_q8 map[N];
    for (int k = 0; k < 6; k++) {
        for (int i = 0; i < N; i++)
            pixels[i] =
                (pf_point_q16){(int32_t)(hash_random(state) % 10500000u), (int32_t)(hash_random(state) % 7900000u)};
        pf_camera_rays_lookup(rays, N, pixels, out);
        pf_remap_from_rays(fixed, N, out, map);
        for (int i = 0; i < N; i++) {
            crc = hash_ray(crc, out[i]);
            crc = hash_u32(crc, (uint32_t)(uint16_t)map[i].x << 16 | (uint16_t)map[i].y);
            crc = hash_u32(crc, (uint32_t)map[i].x_q8 << 8 | map[i].y_q8);
        }
    }
    return crc;
}

uint32_t hash_camera_fixed(size_t *ram)
{
    uint32_t crc = 0, state = 3;
    *ram = 0;
    for (size_t c = 0; c < CAMERAS_COUNT; c++) {
        const pf_camera_fixed *fixed;
        const pf_camera_rays *rays;
        size_t size = pf_camera_fixed_workspace_size(&CAMERAS[c]);
        if (size > sizeof camera_block ||
            pf_camera_fixed_init(&fixed, &CAMERAS[c], camera_block, sizeof camera_block) != PF_OK)
            return 0;
        crc = hash_transforms(crc, fixed, &state);
        if (c >= 3) /* the tables know nothing of the lens */
            continue;
        if (pf_camera_rays_init(&rays, fixed, 8, rays_block, sizeof rays_block) != PF_OK)
            return 0;
        *ram = c == 0 ? size + pf_camera_rays_workspace_size(fixed, 8) : *ram; /* of the ordinary lens */
        crc = hash_u32(hash_tables(crc, fixed, rays, &state), c == 0 ? pf_camera_rays_step(fixed) : 0);
    }
    return crc;
}
