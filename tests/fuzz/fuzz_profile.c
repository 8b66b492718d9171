/* Profile decoder and camera model. Each input is tried as it is, with magic, length and checksum repaired,
 * and as a mask over a valid profile of version 2 and of version 1, checksum repaired, which reaches the checks of
 * single fields at once (version 1 has no self-test, which few changed cameras would pass); or as steps away from a
 * camera of some kind, each parameter within what its range makes plausible, which reaches the proof of the asymmetric
 * models. Invariants: what decodes encodes, as version 2, to what decodes to the same; a camera that passes its check
 * projects and back-projects its whole domain, to finite numbers and to the pixel it came from; the integers of a
 * profile that has some pass their own test; a refused profile leaves the caller's untouched. */
#include "pipefish/profile_integers.h"

#include "../unit/profile_samples.h"

#include <math.h>
#include <stdlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define KINDS 11u /* of profile_samples.h */
#define SYMMETRIC                                                                                                      \
    7u /* the first of them: quick to prove, so the mask, of which most is not the camera, is over these */

static void require(bool holds)
{
    if (!holds)
        abort();
}

static void repair_all(uint8_t *bytes, size_t n)
{
    static const uint8_t magic[4] = {'P', 'F', 'P', 'R'};
    memcpy(bytes, magic, sizeof magic);
    put_u32(bytes + 8, (uint32_t)n);
    repair(bytes, n);
}

/* Where the header promises a round trip within 1e-9 px. */
static bool is_ordinary(const pf_camera *camera)
{
    double t = camera->theta_max, s = t * t, sum = 0;
    sum += t * s * (fabs(camera->k2) + s * (fabs(camera->k3) + s * (fabs(camera->k4) + s * fabs(camera->k5))));
    for (int i = 0; i < 3; i++)
        sum += 2 * pow(t, 2 * i + 1) * (fabs(camera->asym_radial_theta[i]) + fabs(camera->asym_tangential_theta[i]));
    for (int i = 0; i < (int)PF_CPOLY_MAX; i++)
        sum += fabs(camera->cpoly[i]) * t * s;
    return sum <= 100 && camera->f_u <= 1e4 && camera->f_v <= 1e4;
}

static void use_direction(const pf_camera *camera, double theta, double c, double s)
{
    /* 100 m along the ray: clear of where rays of a moving pupil cross */
    double length = 100, xyz[3] = {c * length * sin(theta), s * length * sin(theta),
                                   length * cos(theta) + camera->pupil_e1 * theta * theta};
    double uv[2], d_xyz[6], d_param[2 * PF_CAMERA_PARAMS], ray[3], origin[3], d_uv[6], back[2];
    require(pf_camera_project(camera, xyz, uv, d_xyz, d_param) == PF_OK);
    require(pf_camera_unproject(camera, uv, ray, origin, d_uv) == PF_OK);
    double sum = uv[0] + uv[1];
    for (int j = 0; j < 6; j++)
        sum += d_xyz[j] + d_uv[j];
    for (int j = 0; j < 2 * PF_CAMERA_PARAMS; j++)
        sum += d_param[j];
    require(isfinite(sum));
    require(fabs(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2] - 1) < 1e-14);
    for (int j = 0; j < 3; j++)
        xyz[j] = origin[j] + length * ray[j];
    require(pf_camera_project(camera, xyz, back, NULL, NULL) == PF_OK);
    double steepest = 0; /* pixels per radian; a ray of doubles is a few units in the last place off */
    for (int j = 0; j < 6; j++)
        steepest += length * fabs(d_xyz[j]);
    if (is_ordinary(camera))
        require(hypot(back[0] - uv[0], back[1] - uv[1]) <= 1e-9 + 4e-15 * steepest);
}

static void use_camera(const pf_camera *camera)
{
    static const double direction[3][2] = {{0.6, -0.8}, {-5 / 13.0, 12 / 13.0}, {-0.96, -0.28}};
    for (int i = 0; i <= 8; i++)
        for (int j = 0; j < 3; j++)
            use_direction(camera, camera->theta_max * i / 8, direction[j][0], direction[j][1]);
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

/* A valid profile of each kind and three sizes of covariance; encoded once, for that includes a proof. */
static size_t valid_profile(uint32_t kind, uint32_t size, uint32_t *free_count, uint8_t *out)
{
    static const uint32_t counts[3] = {0, 2, PF_PROFILE_FREE_MAX};
    static uint8_t bytes[SYMMETRIC][3][PF_PROFILE_BINARY_MAX];
    static size_t length[SYMMETRIC][3];
    *free_count = counts[size];
    if (length[kind][size] == 0) {
        pf_profile profile = sample();
        profile.camera = family(kind);
        profile.free_count = *free_count;
        for (uint32_t i = 0; i < *free_count; i++) {
            profile.free_param[i] = (uint8_t)i;
            profile.covariance[i * (i + 1) / 2 + i] = 1;
        }
        require(pf_profile_encode(&profile, bytes[kind][size], PF_PROFILE_BINARY_MAX, &length[kind][size], NULL) ==
                PF_OK);
    }
    memcpy(out, bytes[kind][size], length[kind][size]);
    return length[kind][size];
}

/* Version 1 of the same profile: without what lies between the free parameters and the covariance, and the vectors. */
static size_t as_version_1(uint8_t *bytes, uint32_t free_count)
{
    size_t covariance = (size_t)4 * free_count * (free_count + 1);
    memmove(bytes + 584, bytes + 808, covariance);
    bytes[4] = 1;
    return 588 + covariance;
}

static void make_unit(double *b)
{
    double norm = sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2] + b[3] * b[3]);
    for (int i = 0; i < 4; i++)
        b[i] = norm > 0 ? b[i] / norm : 0.5;
}

/* A camera of the kind that data[1] says, theta_max by data[2], and each parameter moved by a byte. */
static pf_camera moved_camera(const uint8_t *data, size_t size)
{
    static const struct {
        uint32_t end;
        double most;
    } run[] = {{2, 200},   {3, 100}, {5, 500},  {9, 0.25}, {12, 0.25}, {16, 1},
               {19, 0.25}, {23, 1},  {25, 0.7}, {26, 2},   {27, 0.5},  {41, 0.125}};
    pf_camera camera = family(data[1] % KINDS);
    camera.theta_max = 1e-3 + 3.14 * data[2] / 255;
    for (uint32_t i = 0, r = 0; i < PF_CAMERA_PARAMS && 3 + i < size; i++) {
        r += i == run[r].end;
        *pf_camera_param_at(&camera, i) += run[r].most * (int8_t)data[3 + i] / 128;
    }
    camera.mirror = camera.radial == PF_RADIAL_UNIFIED ? fabs(camera.mirror) : 0;
    if (camera.radial != PF_RADIAL_GENERIC)
        camera.k2 = camera.k3 = camera.k4 = camera.k5 = 0;
    make_unit(camera.asym_radial_phi);
    make_unit(camera.asym_tangential_phi);
    return camera;
}

/* `whole`: with its profile and self-tests, three of them and as many proofs: ten times the work. */
static void try_camera(const pf_camera *camera, bool whole)
{
    static _Alignas(16) uint8_t workspace[PF_CAMERA_FIXED_WORKSPACE_MAX];
    static uint8_t bytes[PF_PROFILE_BINARY_MAX];
    static pf_profile profile, back;
    if (!whole) {
        if (pf_camera_check(camera, NULL) == PF_OK)
            use_camera(camera);
        return;
    }
    size_t n = 0;
    memset(&profile, 0, sizeof profile);
    profile.camera = *camera;
    const char *why = NULL;
    pf_status status = pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why);
    require(status == PF_OK || strncmp(why, "self_test", 9) != 0);
    if (status != PF_OK)
        return;
    require(pf_profile_decode(bytes, n, &back, NULL) == PF_OK);
    require(memcmp(&profile, &back, sizeof profile) == 0);
    use_camera(camera);
    status = pf_profile_integers_make(&profile, workspace, sizeof workspace);
    require(status == PF_OK || status == PF_ERR_UNSUPPORTED);
    require(pf_profile_integers_check(&profile, workspace, sizeof workspace, NULL) == PF_OK);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    if (size < 16 || size > sizeof bytes)
        return 0;
    if (data[0] % 32 == 0) {
        const pf_camera camera = moved_camera(data, size);
        uint32_t sum = 0; /* any change may make a camera that is tried whole, and most do not */
        for (size_t i = 0; i < size; i++)
            sum += data[i];
        try_camera(&camera, data[0] == 0 && sum % 16 == 0);
        return 0;
    }
    try_bytes(data, size);

    memcpy(bytes, data, size);
    repair_all(bytes, size);
    try_bytes(bytes, size);

    uint32_t free_count;
    size_t n = valid_profile(data[1] % SYMMETRIC, data[0] % 3, &free_count, bytes);
    if (data[0] / 3 % 2)
        n = as_version_1(bytes, free_count);
    for (size_t i = 2; i < size && 10 + i < n - 4; i++)
        bytes[10 + i] ^= data[i];
    repair_all(bytes, n);
    try_bytes(bytes, n);
    return 0;
}
