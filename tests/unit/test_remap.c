/* Remap tables and the drawing by them. */
#include "pipefish/camera_fixed.h"
#include "unity.h"

#include <string.h>

#define W 40
#define H 30

static _Alignas(16) uint8_t workspace[8192];
static uint8_t source[H * (W * 3 + 5)];
static const pf_camera CAMERA = {.width = W,
                                 .height = H,
                                 .radial = PF_RADIAL_EQUIDISTANT,
                                 .f_u = 12,
                                 .f_v = 12,
                                 .c_u = 20,
                                 .c_v = 15,
                                 .theta_max = 1.2,
                                 .circle_u = 20,
                                 .circle_v = 15,
                                 .circle_radius = 14};

void setUp(void)
{
    for (uint32_t i = 0; i < sizeof source; i++)
        source[i] = (uint8_t)(i * 2654435761u >> 24);
}
void tearDown(void) {}

static const pf_camera_fixed *build(double radius)
{
    pf_camera camera = CAMERA;
    const pf_camera_fixed *fixed = NULL;
    camera.circle_radius = radius;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&fixed, &camera, workspace, sizeof workspace));
    return fixed;
}

/* Proves: a pixel becomes the entry of its position rounded to 1/256, the outermost half pixel takes the nearest pixel,
 * what is outside the circle or the sensor is marked. */
static void test_entries_are_positions_rounded(void)
{
    const pf_point_q16 pixels[7] = {
        {20 << 16, 15 << 16},     {(20 << 16) + 128, (15 << 16) - 129}, {(3 << 16) - 128, 0}, {-32768, -32768},
        {(W << 16) - 32768, 100}, {(H << 16), (H << 16) - 32767},       {-32769, 0}};
    const pf_remap_q8 expected[7] = {{20, 15, 0, 0},
                                     {20, 14, 1, 255},
                                     {3, 0, 0, 0},
                                     {0, 0, 0, 0},
                                     {W - 1, 0, 0, 0},
                                     {PF_REMAP_OUTSIDE, 0, 0, 0},
                                     {PF_REMAP_OUTSIDE, 0, 0, 0}};
    pf_remap_q8 map[7];
    pf_remap_from_pixels(build(0), 7, pixels, map);
    for (int i = 0; i < 7; i++)
        TEST_ASSERT_EQUAL_MEMORY(&expected[i], &map[i], sizeof map[i]);
    const pf_point_q16 rim[2] = {{34 << 16, 15 << 16}, {(34 << 16) + 1, 15 << 16}};
    pf_remap_from_pixels(build(14), 2, rim, map);
    TEST_ASSERT_EQUAL_INT16(34, map[0].x);
    TEST_ASSERT_EQUAL_INT16(PF_REMAP_OUTSIDE, map[1].x);
}

/* Proves: viewing rays go through the camera; those beyond theta_max are marked. */
static void test_rays_are_projected(void)
{
    const pf_ray_q30 rays[3] = {{0, 0, 1 << 30}, {903522582, 0, 580145183}, {1 << 30, 0, 0}}; /* 0, 1 and pi / 2 rad */
    pf_remap_q8 map[3];
    pf_remap_from_rays(build(0), 3, rays, map);
    TEST_ASSERT_EQUAL_INT16(20, map[0].x);
    TEST_ASSERT_EQUAL_INT16(32, map[1].x);
    TEST_ASSERT_EQUAL_UINT8(0, map[1].x_q8);
    TEST_ASSERT_EQUAL_INT16(15, map[1].y);
    TEST_ASSERT_EQUAL_INT16(PF_REMAP_OUTSIDE, map[2].x);
}

/* Proves: drawing is bilinear interpolation of each channel, rounded half up, for 1 to 4 channels and a stride of its
 * own; entries on pixels copy them; outside is filled. */
static void test_drawing_interpolates_every_channel(void)
{
    for (uint32_t channels = 1; channels <= 4; channels++) {
        const pf_image image = {source, channels == 4 ? 29 : W, H, W * 3 + 5};
        uint8_t out[4 * W + 4];
        pf_remap_q8 map[W];
        for (int i = 0; i < W; i++)
            map[i] = (pf_remap_q8){(int16_t)(i % 28), (int16_t)(i * 7 % 29), (uint8_t)(i * 37), (uint8_t)(i % 3 * 85)};
        map[5].x = PF_REMAP_OUTSIDE;
        map[6] = (pf_remap_q8){(int16_t)(image.width - 1), H - 1, 0, 0};
        out[W * channels] = 99;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_remap_apply(&image, channels, W, map, 200, out));
        for (uint32_t i = 0; i < W; i++)
            for (uint32_t c = 0; c < channels; c++) {
                double sum = 0;
                for (uint32_t k = 0; k < 4 && i != 5; k++) {
                    double a = map[i].x_q8 / 256.0, b = map[i].y_q8 / 256.0;
                    double weight = (k & 1 ? a : 1 - a) * (k & 2 ? b : 1 - b);
                    if (weight > 0)
                        sum += weight * source[((uint32_t)map[i].y + k / 2) * image.stride +
                                               ((uint32_t)map[i].x + k % 2) * channels + c];
                }
                TEST_ASSERT_EQUAL_UINT8(i == 5 ? 200 : (uint8_t)(sum + 0.5), out[i * channels + c]);
            }
        TEST_ASSERT_EQUAL_UINT8(99, out[W * channels]);
    }
}

/* Proves: a map that would read outside the source is refused before anything is drawn. */
static void test_maps_that_leave_the_source_are_refused(void)
{
    const pf_image image = {source, W, H, W};
    const pf_remap_q8 wrong[6] = {{W, 0, 0, 0},     {0, H, 0, 0},  {W - 1, 0, 1, 0},
                                  {0, H - 1, 0, 1}, {-1, 0, 0, 0}, {0, -1, 0, 0}};
    for (int i = 0; i < 6; i++) {
        const pf_remap_q8 map[2] = {{0, 0, 0, 0}, wrong[i]};
        uint8_t out[2] = {77, 77};
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_remap_apply(&image, 1, 2, map, 0, out));
        TEST_ASSERT_EQUAL_UINT8(77, out[0]);
    }
    uint8_t out[8];
    const pf_remap_q8 map[1] = {{0, 0, 0, 0}};
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_remap_apply(&image, 0, 1, map, 0, out));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_remap_apply(&image, 5, 1, map, 0, out));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_remap_apply(&image, 2, 1, map, 0, out)); /* stride */
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_entries_are_positions_rounded);
    RUN_TEST(test_rays_are_projected);
    RUN_TEST(test_drawing_interpolates_every_channel);
    RUN_TEST(test_maps_that_leave_the_source_are_refused);
    return UNITY_END();
}
