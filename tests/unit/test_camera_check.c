/* What pf_camera_check accepts and refuses, over the whole camera family. */
#include "family_lenses.h"
#include "unity.h"

#include <stdlib.h>

void setUp(void) {}
void tearDown(void) {}

/* Smallest eigenvalue of the symmetric part of d(x, y) / d(X, Y) on a grid, from the definition by differences. */
static double least_stretch(const pf_camera *camera)
{
    pf_camera unit = *camera;
    unit.f_u = unit.f_v = 1;
    unit.skew = unit.c_u = unit.c_v = unit.tilt[0] = unit.tilt[1] = 0;
    double least = 1e9;
    const double h = 1e-6;
    for (int i = 0; i <= 40; i++)
        for (int p = 0; p < 36; p++) {
            double theta = 1e-3 + (camera->theta_max - 1e-3) * i / 40, phi = p * 10 * DEGREES, q[4][2], j[2][2];
            for (int s = 0; s < 4; s++) {
                double x = theta * cos(phi) + (s == 0 ? h : s == 1 ? -h : 0);
                double y = theta * sin(phi) + (s == 2 ? h : s == 3 ? -h : 0);
                pixel_truth(&unit, hypot(x, y), atan2(y, x), q[s]);
            }
            for (int row = 0; row < 2; row++) {
                j[row][0] = (q[0][row] - q[1][row]) / (2 * h);
                j[row][1] = (q[2][row] - q[3][row]) / (2 * h);
            }
            double mean = 0.5 * (j[0][0] + j[1][1]), off = 0.5 * (j[0][1] + j[1][0]);
            least = fmin(least, mean - hypot(0.5 * (j[0][0] - j[1][1]), off));
        }
    return least;
}

/* Proves: the check accepts no camera whose map folds, and refuses none that is clear of folding, over random
 * asymmetric cameras of all sizes; the stretch is measured from the definition. */
static void test_check_proves_asymmetric_cameras(void)
{
    int accepted = 0, refused = 0;
    srand(3);
    for (int i = 0; i < 200; i++) {
        static const double degrees[] = {60, 95, 110};
        pf_camera camera = plain(i % 4 == 3 ? PF_RADIAL_EQUISOLID : PF_RADIAL_GENERIC, degrees[i % 3]);
        if (i % 4 != 3)
            add_polynomial(&camera);
        double size = pow(10, -1 + 3.5 * rand() / RAND_MAX);
        if (i % 2)
            add_p23(&camera, size);
        else
            for (int k = 0; k < PF_CPOLY_MAX; k++)
                camera.cpoly[k] = size * 1e-3 * (2.0 * rand() / RAND_MAX - 1);
        double least = least_stretch(&camera);
        pf_status status = pf_camera_check(&camera, NULL);
        accepted += status == PF_OK;
        refused += status != PF_OK;
        if (least < 0)
            TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, status);
        if (least > 0.01)
            TEST_ASSERT_EQUAL_INT(PF_OK, status);
    }
    TEST_ASSERT_TRUE(accepted > 60 && refused > 30);
}

static void assert_refused(const pf_camera *camera, pf_status expected, const char *field)
{
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT(expected, pf_camera_check(camera, &why));
    TEST_ASSERT_EQUAL_STRING_LEN(field, why, strlen(field));
}

/* Proves: each family's own limit of theta_max, the gauge of Paper II's factors, a tilt that sees past its horizon. */
static void test_check_knows_each_family(void)
{
    static const struct {
        uint32_t radial;
        double mirror, limit_degrees;
    } family[] = {{PF_RADIAL_PERSPECTIVE, 0, 90},
                  {PF_RADIAL_ORTHOGRAPHIC, 0, 90},
                  {PF_RADIAL_UNIFIED, 0.5, 120}, /* acos(-m) */
                  {PF_RADIAL_UNIFIED, 2, 120},   /* acos(-1 / m) */
                  {PF_RADIAL_UNIFIED, 0, 90}};
    for (size_t i = 0; i < sizeof family / sizeof family[0]; i++) {
        pf_camera camera = plain(family[i].radial, family[i].limit_degrees - 0.01);
        camera.mirror = family[i].mirror;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&camera, NULL));
        camera.theta_max = (family[i].limit_degrees + 1e-6) * DEGREES;
        assert_refused(&camera, PF_ERR_DOMAIN, "theta_max:");
    }
    for (uint32_t radial = PF_RADIAL_STEREOGRAPHIC; radial <= PF_RADIAL_EQUISOLID; radial++) {
        pf_camera camera = plain(radial, 179);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&camera, NULL));
    }
    pf_camera camera = lens(0);
    camera.asym_radial_phi[0] *= 1.01;
    assert_refused(&camera, PF_ERR_ARGUMENT, "asym_radial_phi:");
    camera = lens(0);
    camera.asym_tangential_phi[1] = 0;
    assert_refused(&camera, PF_ERR_ARGUMENT, "asym_tangential_phi:");
    camera = lens(4);
    camera.tilt[1] = 0.6;
    assert_refused(&camera, PF_ERR_DOMAIN, "tilt:");
    camera = lens(3);
    camera.cpoly[13] = (double)NAN;
    assert_refused(&camera, PF_ERR_ARGUMENT, "cpoly:");
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_check_proves_asymmetric_cameras);
    RUN_TEST(test_check_knows_each_family);
    return UNITY_END();
}
