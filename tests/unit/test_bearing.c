/* Bearings of tracks, with a camera of the test's own: only the room's part (rounding, domain) is under test. */
#include <math.h>

#include "pipefish/track.h"
#include "unity.h"

void setUp(void) {}
void tearDown(void) {}

/* A pinhole of 100 pixels; nothing left of u = 0. */
pf_status pf_camera_unproject(const pf_camera *camera, const double uv[2], double ray[3], double origin[3],
                              double *d_ray_d_uv)
{
    (void)camera, (void)origin, (void)d_ray_d_uv;
    if (uv[0] < 0)
        return PF_ERR_DOMAIN;
    const double n = sqrt(uv[0] * uv[0] + uv[1] * uv[1] + 10000);
    ray[0] = uv[0] / n;
    ray[1] = uv[1] / n;
    ray[2] = 100 / n;
    return PF_OK;
}

/* Proves: rays are the camera's, rounded to nearest in Q1.30 (negative ones too, 1 exactly representable); positions
 * outside the domain give zero. */
static void test_bearings_are_rounded_and_zero_outside_the_domain(void)
{
    const pf_camera camera = {0};
    const pf_track tracks[4] = {
        {.pos = {0, 0}}, {.pos = {30 << 16, -(40 << 16) - 32768}}, {.pos = {-1, 0}}, {.pos = {7 << 16, 12345678}}};
    pf_ray_q30 rays[4];
    pf_track_bearings(&camera, tracks, 4, rays);
    TEST_ASSERT_EQUAL_INT32(1 << 30, rays[0].z);
    for (int i = 0; i < 4; i++) {
        const double uv[2] = {tracks[i].pos.x / 65536.0, tracks[i].pos.y / 65536.0};
        double ray[3] = {0, 0, 0};
        (void)pf_camera_unproject(&camera, uv, ray, NULL, NULL);
        TEST_ASSERT_EQUAL_INT32(lrint(ray[0] * 1073741824.0), rays[i].x);
        TEST_ASSERT_EQUAL_INT32(lrint(ray[1] * 1073741824.0), rays[i].y);
        TEST_ASSERT_EQUAL_INT32(lrint(ray[2] * 1073741824.0), rays[i].z);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_bearings_are_rounded_and_zero_outside_the_domain);
    return UNITY_END();
}
