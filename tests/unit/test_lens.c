/* The lens table against the camera it was made of. */
#include <math.h>

#include "pipefish/track.h"
#include "unity.h"

void setUp(void) {}
void tearDown(void) {}

static const pf_camera cameras[] = {
    {.width = 1280,
     .height = 800,
     .f_u = 330,
     .f_v = 328,
     .skew = 1.5,
     .c_u = 640.3,
     .c_v = 401.7,
     .k2 = -0.05,
     .k3 = 0.008,
     .k4 = -0.0009,
     .theta_max = 1.75,
     .circle_u = 640,
     .circle_v = 400},
    {.width = 320, .height = 240, .f_u = 75, .f_v = 75, .c_u = 160, .c_v = 120, .theta_max = 1.57},
    {.width = 1280, .height = 800, .f_u = 400, .f_v = 400, .c_u = 640, .c_v = 400, .theta_max = 0.7},
};

/* Proves: projection within 0.02 px and bearings within 0.01 px of the camera's, axis and rim included; nothing beyond.
 */
static void test_table_is_the_camera(void)
{
    for (size_t c = 0; c < sizeof cameras / sizeof cameras[0]; c++) {
        const pf_camera *camera = &cameras[c];
        pf_lens lens;
        double worst = 0, worst_back = 0;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(camera, NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_lens_make(&lens, camera));
        for (int i = 0; i <= 1000; i++) {
            const double theta = camera->theta_max * i / 1000 * (1 - 1e-6), phi = 2.4 * i;
            const double ray[3] = {sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta)};
            const pf_ray_q30 q = {(int32_t)lrint(ray[0] * 1073741824), (int32_t)lrint(ray[1] * 1073741824),
                                  (int32_t)lrint(ray[2] * 1073741824)};
            double uv[2], xyz[3], again[2];
            pf_point_q16 at;
            pf_track track = {0};
            pf_ray_q30 back;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(camera, ray, uv, NULL, NULL));
            TEST_ASSERT_TRUE(pf_lens_project(&lens, &q, &at));
            worst = fmax(worst, hypot(at.x / 65536.0 - uv[0], at.y / 65536.0 - uv[1]));
            track.pos = at;
            pf_lens_bearings(&lens, &track, 1, &back);
            xyz[0] = back.x / 1073741824.0, xyz[1] = back.y / 1073741824.0, xyz[2] = back.z / 1073741824.0;
            TEST_ASSERT_DOUBLE_WITHIN(1e-6, 1, xyz[0] * xyz[0] + xyz[1] * xyz[1] + xyz[2] * xyz[2]);
            TEST_ASSERT_TRUE(pf_lens_project(&lens, &back, &track.pos));
            again[0] = track.pos.x / 65536.0, again[1] = track.pos.y / 65536.0;
            worst_back = fmax(worst_back, hypot(again[0] - at.x / 65536.0, again[1] - at.y / 65536.0));
        }
        TEST_ASSERT_TRUE(worst < 0.02 && worst_back < 0.01);
    }
}

/* Proves: beyond the lens there is no projection and no bearing, and an invalid ray has no place. */
static void test_beyond_the_lens_there_is_nothing(void)
{
    const pf_camera *camera = &cameras[1];
    const pf_ray_q30 behind = {0, 30000000, -1073000000}, none = {0, 0, 0};
    const pf_track far = {.pos = {300 << 16, 120 << 16}};
    pf_ray_q30 ray = {1, 1, 1};
    pf_point_q16 at;
    pf_lens lens;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_lens_make(&lens, camera));
    TEST_ASSERT_FALSE(pf_lens_project(&lens, &behind, &at));
    TEST_ASSERT_FALSE(pf_lens_project(&lens, &none, &at));
    pf_lens_bearings(&lens, &far, 1, &ray);
    TEST_ASSERT_TRUE(ray.x == 0 && ray.y == 0 && ray.z == 0);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_table_is_the_camera);
    RUN_TEST(test_beyond_the_lens_there_is_nothing);
    return UNITY_END();
}
