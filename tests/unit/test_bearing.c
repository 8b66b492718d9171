/* Bearings of tracks, from the table of rays: only this room's part is under test, test_camera_rays has the rest. */
#include "pipefish/track.h"
#include "unity.h"

static _Alignas(16) uint8_t camera_workspace[8192], rays_workspace[100000];

void setUp(void) {}
void tearDown(void) {}

/* Proves: each track's bearing is the table's ray of its position, (0, 0, 0) outside the image circle. */
static void test_bearings_are_the_rays_of_the_positions_and_zero_outside(void)
{
    const pf_camera camera = {.width = 320,
                              .height = 240,
                              .radial = PF_RADIAL_EQUIDISTANT,
                              .f_u = 100,
                              .f_v = 100,
                              .c_u = 160,
                              .c_v = 120,
                              .theta_max = 1.6,
                              .circle_u = 160,
                              .circle_v = 120,
                              .circle_radius = 110};
    const pf_track tracks[4] = {{.pos = {160 << 16, 120 << 16}},
                                {.pos = {(160 << 16) + 5147185, 120 << 16}},
                                {.pos = {160 << 16, (120 << 16) - 7208960}},
                                {.pos = {50 << 16, 119 << 16}}};
    const pf_camera_fixed *fixed;
    const pf_camera_rays *table;
    pf_ray_q30 rays[4];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&fixed, &camera, camera_workspace, sizeof camera_workspace));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_rays_init(&table, fixed, 8, rays_workspace, sizeof rays_workspace));
    pf_track_bearings(table, tracks, 4, rays);
    const double expected[4][3] = {{0, 0, 1}, {0.70710678, 0, 0.70710678}, {0, -0.89120736, 0.45359612}, {0, 0, 0}};
    for (int i = 0; i < 4; i++) {
        TEST_ASSERT_DOUBLE_WITHIN(1e-5, expected[i][0], rays[i].x / 1073741824.0);
        TEST_ASSERT_DOUBLE_WITHIN(1e-5, expected[i][1], rays[i].y / 1073741824.0);
        TEST_ASSERT_DOUBLE_WITHIN(1e-5, expected[i][2], rays[i].z / 1073741824.0);
        const pf_ray_q30 at = pf_camera_rays_at(table, tracks[i].pos);
        TEST_ASSERT_EQUAL_MEMORY(&at, &rays[i], sizeof at);
    }
    TEST_ASSERT_EQUAL_INT32(0, rays[3].z);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_bearings_are_the_rays_of_the_positions_and_zero_outside);
    return UNITY_END();
}
