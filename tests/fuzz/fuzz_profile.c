/* Profile decoder. Each input is tried four ways: as it is; with magic, length and checksum repaired; and as a mask
 * over a valid profile of version 2 and of version 1, checksum repaired, which reaches the checks of single fields at
 * once (version 1 has no self-test, which few changed cameras would pass). Invariants: what decodes encodes, as version
 * 2, to what decodes to the same; the camera of a profile that decodes projects and back-projects its whole domain to
 * finite numbers; a refused profile leaves the caller's untouched. */
#include "pipefish/profile.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void require(bool holds)
{
    if (!holds)
        abort();
}

static void repair(uint8_t *bytes, size_t n)
{
    static const uint8_t magic[4] = {'P', 'F', 'P', 'R'};
    memcpy(bytes, magic, sizeof magic);
    for (size_t i = 0; i < 4; i++)
        bytes[8 + i] = (uint8_t)(n >> (8 * i));
    uint32_t crc = pf_crc32c(0, bytes, n - 4);
    for (size_t i = 0; i < 4; i++)
        bytes[n - 4 + i] = (uint8_t)(crc >> (8 * i));
}

static void use_camera(const pf_camera *camera)
{
    for (int i = 0; i <= 16; i++) {
        /* 100 m along the ray: clear of where rays of a moving pupil cross */
        double theta = camera->theta_max * i / 16, length = 100;
        double xyz[3] = {0.6 * length * sin(theta), -0.8 * length * sin(theta),
                         length * cos(theta) + camera->pupil_e1 * theta * theta};
        double uv[2], d_xyz[6], d_param[2 * PF_CAMERA_PARAMS], ray[3], d_uv[6];
        require(pf_camera_project(camera, xyz, uv, d_xyz, d_param) == PF_OK);
        require(pf_camera_unproject(camera, uv, ray, NULL, d_uv) == PF_OK);
        double sum = uv[0] + uv[1];
        for (int j = 0; j < 6; j++)
            sum += d_xyz[j] + d_uv[j];
        for (int j = 0; j < 2 * PF_CAMERA_PARAMS; j++)
            sum += d_param[j];
        require(isfinite(sum));
        require(fabs(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2] - 1) < 1e-14);
    }
}

static void try_bytes(const uint8_t *bytes, size_t n)
{
    static pf_profile profile, before;
    const char *why = NULL;
    memset(&profile, 0x5A, sizeof profile);
    memcpy(&before, &profile, sizeof profile);
    pf_status status = pf_profile_decode(bytes, n, &profile, &why);
    require(why != NULL && status <= 0);
    if (status != PF_OK) {
        require(memcmp(&profile, &before, sizeof profile) == 0);
        return;
    }
    uint8_t again[PF_PROFILE_BINARY_MAX];
    size_t length = 0;
    require(pf_profile_encode(&profile, again, sizeof again, &length, NULL) == PF_OK);
    require(pf_profile_decode(again, length, &before, NULL) == PF_OK);
    require(memcmp(&profile, &before, sizeof profile) == 0);
    use_camera(&profile.camera);
}

static size_t valid_profile(uint32_t free_count, uint8_t *out)
{
    static pf_profile profile;
    memset(&profile, 0, sizeof profile);
    profile.camera.width = 1280;
    profile.camera.height = 960;
    profile.camera.f_u = profile.camera.f_v = 300;
    profile.camera.theta_max = 1.7;
    profile.free_count = free_count;
    for (uint32_t i = 0; i < free_count; i++) {
        profile.free_param[i] = (uint8_t)i;
        profile.covariance[i * (i + 1) / 2 + i] = 1;
    }
    size_t n = 0;
    require(pf_profile_encode(&profile, out, PF_PROFILE_BINARY_MAX, &n, NULL) == PF_OK);
    return n;
}

/* Version 1 of the same profile: without what lies between the free parameters and the covariance, and the vectors. */
static size_t as_version_1(uint8_t *bytes, uint32_t free_count)
{
    size_t covariance = (size_t)4 * free_count * (free_count + 1);
    memmove(bytes + 584, bytes + 808, covariance);
    bytes[4] = 1;
    return 588 + covariance;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    if (size < 16 || size > sizeof bytes)
        return 0;
    try_bytes(data, size);

    memcpy(bytes, data, size);
    repair(bytes, size);
    try_bytes(bytes, size);

    uint32_t free_count = data[0] % (PF_PROFILE_FREE_MAX + 1);
    for (int version = 1; version <= 2; version++) {
        size_t n = valid_profile(free_count, bytes);
        if (version == 1)
            n = as_version_1(bytes, free_count);
        for (size_t i = 1; i < size && 11 + i < n - 4; i++)
            bytes[11 + i] ^= data[i];
        repair(bytes, n);
        try_bytes(bytes, n);
    }
    return 0;
}
