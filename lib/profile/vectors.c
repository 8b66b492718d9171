/* Self-test vectors of a profile: points with their pixels, and those pixels with their rays. */
#include "vectors.h"

#include "bytes.h"

/* The model uses IEEE double +, -, *, / and sqrt only, in a fixed order: today's code gives the stored bits on every
 * target, and a tolerance would not be needed. It leaves room for later code that solves or sums in another way, and is
 * what pf_camera_unproject promises of a round trip; a wrong compiler, FPU mode or parameter order is off by far more.
 */
#define PIXEL_TOLERANCE 1e-9 /* pixels */
#define RAY_TOLERANCE   1e-12

/* Of a vector's pixel from its place: the search for the rim ends before the last bits. */
#define PLACE_TOLERANCE 1e-3 /* pixels */

/* Where the vectors lie: a direction in the image (Pythagorean, for this room has no cosine) and the share of the way
 * from the centre to the rim. The centre is a place of its own, a branch of the model; the rim shows each parameter at
 * its largest, and no two directions are opposite, so that no term of the asymmetry vanishes in all of them. */
static const struct {
    double u, v, share;
} PLACE[PF_PROFILE_VECTORS] = {
    {1, 0, 0},
    {-4.0 / 5, 3.0 / 5, 0.25},
    {5.0 / 13, -12.0 / 13, 0.5},
    {0, 1, 0.75},
    {3.0 / 5, 4.0 / 5, 1},
    {-12.0 / 13, 5.0 / 13, 1},
    {-8.0 / 17, -15.0 / 17, 1},
    {24.0 / 25, -7.0 / 25, 1},
};

/* As much as is left inside the rim: less would make the vector hang on the last bit of theta_max. */
#define INSIDE (1 - 0x1p-20)

static bool reaches(const pf_camera *camera, const double step[2], double length, double ray[3], double origin[3])
{
    double uv[2] = {camera->c_u + length * step[0], camera->c_v + length * step[1]};
    return pf_camera_unproject(camera, uv, ray, origin, NULL) == PF_OK;
}

/* Length of the way from the centre to the rim in steps of `step` pixels, to 2^-31 of the rim's: 2e-7 px at 500 px, and
 * below PLACE_TOLERANCE at the largest focal length. */
static double rim(const pf_camera *camera, const double step[2])
{
    double inside = 0, outside = 2 * pf_camera_radius(camera, camera->theta_max, NULL), ray[3], origin[3];
    for (int i = 0; i < 32; i++) {
        double middle = 0.5 * (inside + outside);
        if (reaches(camera, step, middle, ray, origin))
            inside = middle;
        else
            outside = middle;
    }
    return inside;
}

pf_status pf_vectors_at(const pf_camera *camera, uint32_t i, double value[8])
{
    /* Farther from the pupil than the model needs (|pupil_e1| (theta_max^2 + 2 theta_max) < 17 |pupil_e1|), and near
     * enough that a shift of the pupil shows. */
    double shift = camera->pupil_e1 < 0 ? -camera->pupil_e1 : camera->pupil_e1, distance = 1 + 32 * shift;
    double step[2] = {camera->f_u * PLACE[i].u, camera->f_v * PLACE[i].v};
    double length = PLACE[i].share > 0 ? PLACE[i].share * INSIDE * rim(camera, step) : 0;
    double *xyz = value, *uv = value + 3, *ray = value + 5, origin[3];
    /* The image of the domain need not be convex; its centre is always inside. */
    while (!reaches(camera, step, length, ray, origin)) {
        if (length == 0)
            return PF_ERR_DOMAIN;
        length = length > 1e-3 ? 0.5 * length : 0;
    }
    for (int j = 0; j < 3; j++)
        xyz[j] = origin[j] + distance * ray[j];
    pf_status status = pf_camera_project(camera, xyz, uv, NULL, NULL);
    return status == PF_OK ? pf_camera_unproject(camera, uv, ray, NULL, NULL) : status;
}

pf_status pf_vectors_write(const pf_camera *camera, uint8_t *out)
{
    for (uint32_t i = 0; i < PF_PROFILE_VECTORS; i++) {
        double value[8];
        pf_status status = pf_vectors_at(camera, i, value);
        if (status != PF_OK)
            return status;
        for (int j = 0; j < 8; j++, out += 8)
            put_f64(out, value[j]);
    }
    return PF_OK;
}

/* False for NaN. */
static bool agrees(double a, double b, double tolerance)
{
    double difference = a - b;
    return difference <= tolerance && difference >= -tolerance;
}

pf_status pf_vectors_check(const pf_camera *camera, const uint8_t *bytes, uint32_t count, const char **why)
{
    for (uint32_t i = 0; i < count; i++, bytes += PF_VECTOR_BYTES) {
        double value[8], own[8], uv[2], ray[3];
        for (int j = 0; j < 8; j++) {
            value[j] = get_f64(bytes + 8 * j);
            *why = "self_test: not finite";
            if (!agrees(value[j], value[j], 0))
                return PF_ERR_FORMAT;
        }
        *why = "self_test: this device does not project a point where the profile says";
        if (pf_camera_project(camera, value, uv, NULL, NULL) != PF_OK || !agrees(uv[0], value[3], PIXEL_TOLERANCE) ||
            !agrees(uv[1], value[4], PIXEL_TOLERANCE))
            return PF_ERR_SELF_TEST;
        *why = "self_test: this device does not find the ray of a pixel that the profile says";
        if (pf_camera_unproject(camera, value + 3, ray, NULL, NULL) != PF_OK)
            return PF_ERR_SELF_TEST;
        for (int j = 0; j < 3; j++)
            if (!agrees(ray[j], value[5 + j], RAY_TOLERANCE))
                return PF_ERR_SELF_TEST;
        /* Elsewhere, say all in the centre, they would show less than the format promises. */
        *why = "self_test: the vectors do not lie where the format has them";
        if (pf_vectors_at(camera, i, own) != PF_OK || !agrees(own[3], value[3], PLACE_TOLERANCE) ||
            !agrees(own[4], value[4], PLACE_TOLERANCE))
            return PF_ERR_SELF_TEST;
    }
    return PF_OK;
}
