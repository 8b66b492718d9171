/* The integer self-test of profiles. */
#include "pipefish/profile_integers.h"
#include "profile_samples.h"
#include "unity.h"

#include <math.h>

void setUp(void) {}
void tearDown(void) {}

#define FAMILY 11u

static _Alignas(16) uint8_t workspace[PF_CAMERA_FIXED_WORKSPACE_MAX];

static pf_profile of_family(uint32_t n)
{
    pf_profile profile = sample();
    profile.camera = family(n);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_make(&profile, workspace, sizeof workspace));
    return profile;
}

/* Proves: the integers are those of the double model within the bounds of fixed point, and there is one for each of the
 * other vectors: the axis, the inside and the rim. */
static void test_integers_are_what_the_model_says(void)
{
    for (uint32_t n = 0; n < FAMILY; n++) {
        pf_profile profile = of_family(n);
        TEST_ASSERT_EQUAL_UINT32(PF_PROFILE_VECTORS, profile.integers_count);
        double widest = 0;
        for (uint32_t i = 0; i < profile.integers_count; i++) {
            const pf_profile_integers *v = &profile.integers[i];
            double uv[2] = {v->pixel.x / 65536.0, v->pixel.y / 65536.0}, ray[3];
            /* The rim's pixel may have been rounded outwards. */
            uv[0] += (profile.camera.c_u - uv[0]) * 1e-7;
            uv[1] += (profile.camera.c_v - uv[1]) * 1e-7;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&profile.camera, uv, ray, NULL, NULL));
            TEST_ASSERT_DOUBLE_WITHIN(1e-6, ray[0], v->ray.x / 1073741824.0);
            TEST_ASSERT_DOUBLE_WITHIN(1e-6, ray[1], v->ray.y / 1073741824.0);
            TEST_ASSERT_DOUBLE_WITHIN(1e-6, ray[2], v->ray.z / 1073741824.0);
            TEST_ASSERT_INT32_WITHIN(8, v->pixel.x, v->back.x);
            TEST_ASSERT_INT32_WITHIN(8, v->pixel.y, v->back.y);
            widest = fmax(widest, acos(ray[2]));
        }
        TEST_ASSERT_TRUE(widest > 0.999 * profile.camera.theta_max);
    }
}

/* Proves: stored integers pass on the device that made them, and one bit of one of them is enough to be refused, with
 * a right checksum. */
static void test_one_bit_is_refused(void)
{
    static uint8_t bytes[PF_PROFILE_BINARY_MAX];
    static pf_profile back;
    for (uint32_t n = 0; n < FAMILY; n++) {
        pf_profile profile = of_family(n);
        const char *why = NULL;
        size_t size = 0;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_encode(&profile, bytes, sizeof bytes, &size, NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_decode(bytes, size, &back, NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_check(&back, workspace, sizeof workspace, &why));
        TEST_ASSERT_EQUAL_STRING("ok", why);
        for (size_t number = 0; number < 7 * (size_t)PF_PROFILE_VECTORS; number++) {
            uint8_t *p = bytes + size - 4 - 28 * PF_PROFILE_VECTORS + 4 * number;
            p[0] ^= 1;
            repair(bytes, size);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_decode(bytes, size, &back, NULL));
            TEST_ASSERT_EQUAL_INT(PF_ERR_SELF_TEST,
                                  pf_profile_integers_check(&back, workspace, sizeof workspace, &why));
            TEST_ASSERT_EQUAL_STRING_LEN("self_test: the fixed-point camera", why, 33);
            TEST_ASSERT_EQUAL_INT(PF_ERR_SELF_TEST,
                                  pf_profile_integers_check(&back, workspace, sizeof workspace, NULL));
            p[0] ^= 1;
        }
    }
}

/* Proves: a pixel that is nowhere (the hostile profile is intact) is refused and not computed. */
static void test_pixels_outside_are_refused(void)
{
    static const int32_t far[] = {INT32_MIN, -20000 * 65536, 20000 * 65536, INT32_MAX};
    for (size_t i = 0; i < 4; i++) {
        pf_profile profile = of_family(i % 2 ? 0 : 10);
        profile.integers[3] = (pf_profile_integers){{far[i], far[3 - i]}, {0, 0, 0}, {0, 0}};
        TEST_ASSERT_EQUAL_INT(PF_ERR_SELF_TEST, pf_profile_integers_check(&profile, workspace, sizeof workspace, NULL));
    }
}

/* Proves: without memory, or with a lens that fixed point cannot hold, nothing passes for tested; a profile without
 * integers needs neither. */
static void test_what_cannot_be_tested_is_told(void)
{
    pf_profile profile = of_family(0);
    const char *why = NULL;
    size_t size = pf_camera_fixed_workspace_size(&profile.camera);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_check(&profile, workspace, size, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_profile_integers_check(&profile, workspace, size - 1, &why));
    TEST_ASSERT_EQUAL_STRING("integers: no memory for the fixed-point camera", why);
    profile.camera.radial = PF_RADIAL_PERSPECTIVE;
    profile.camera.k2 = profile.camera.k3 = profile.camera.k4 = profile.camera.k5 = 0;
    profile.camera.theta_max = 1.5707;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&profile.camera, NULL));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, pf_profile_integers_check(&profile, workspace, sizeof workspace, &why));
    TEST_ASSERT_EQUAL_STRING("integers: this device cannot build the camera in fixed point", why);
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, pf_profile_integers_make(&profile, workspace, sizeof workspace));
    TEST_ASSERT_EQUAL_UINT32(0, profile.integers_count);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_check(&profile, NULL, 0, &why));
    profile = of_family(0);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_profile_integers_make(&profile, workspace, size - 1));
    TEST_ASSERT_EQUAL_UINT32(0, profile.integers_count);
}

/* Proves: a narrow lens far off its frame keeps the integers that Q16.16 pixels can hold. */
static void test_far_pixels_are_left_out(void)
{
    pf_profile profile = sample();
    profile.camera.c_u = 32767;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_make(&profile, workspace, sizeof workspace));
    TEST_ASSERT_TRUE(profile.integers_count >= 3 && profile.integers_count < PF_PROFILE_VECTORS);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_integers_check(&profile, workspace, sizeof workspace, NULL));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_integers_are_what_the_model_says);
    RUN_TEST(test_one_bit_is_refused);
    RUN_TEST(test_pixels_outside_are_refused);
    RUN_TEST(test_what_cannot_be_tested_is_told);
    RUN_TEST(test_far_pixels_are_left_out);
    return UNITY_END();
}
