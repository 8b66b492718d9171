/* The whole camera family: asymmetric terms, cpoly, tilt, every radial function, pupil shift. */
#include "../../lib/camera/real/elementary.h"
#include "family_lenses.h"
#include "unity.h"

#include <stdlib.h>

void setUp(void) {}
void tearDown(void) {}

static bool has_kink(const pf_camera *camera)
{
    return camera->asym_radial_theta[0] != 0 || camera->asym_tangential_theta[0] != 0;
}

/* The point `length` along the ray (theta, phi), from where that ray starts. */
static void point_on_ray(const pf_camera *camera, double theta, double phi, double length, double xyz[3])
{
    xyz[0] = length * sin(theta) * cos(phi);
    xyz[1] = length * sin(theta) * sin(phi);
    xyz[2] = length * cos(theta) + camera->pupil_e1 * theta * theta;
}

/* Proves: the polynomials behind everything: the angle within 2 units in the last place (the quotient of a rounded sum
 * and difference has 1.5), sine and cosine within 1.3e-16, the sine of a small angle relative to it. */
static void test_elementary_functions_equal_long_double(void)
{
    double worst_angle = 0, worst_sine = 0, worst_cosine = 0, worst_small = 0;
    for (int i = 0; i <= 500000; i++) {
        double a = i * (PI_ALL / 500000), s, c;
        double rho = (double)sinl((long double)a) * (1 + i % 7), z = (double)cosl((long double)a) * (1 + i % 7);
        long double exact = atan2l(rho, z);
        double unit = exact > 0 ? nextafter((double)exact, 4) - (double)exact : 1;
        worst_angle = fmax(worst_angle, (double)fabsl(angle_of(rho, z) - exact) / unit);
        sine_cosine(a, &s, &c);
        worst_sine = fmax(worst_sine, (double)fabsl(s - sinl((long double)a)));
        worst_cosine = fmax(worst_cosine, (double)fabsl(c - cosl((long double)a)));
        double tiny = a * 1e-9;
        sine_cosine(tiny, &s, &c);
        worst_small = fmax(worst_small, tiny > 0 ? (double)fabsl((s - sinl((long double)tiny)) / tiny) : 0);
    }
    TEST_ASSERT_TRUE(worst_angle <= 2);
    TEST_ASSERT_TRUE(worst_sine <= 1.3e-16);
    TEST_ASSERT_TRUE(worst_cosine <= 1.3e-16);
    TEST_ASSERT_TRUE(worst_small <= 1.3e-16);
}

/* Proves: pixels are the definition's to rounding (1000 px, a dozen operations: 1e-11; near the perspective rim the
 * angle's rounding counts r' = 15 times), for every kind of lens, from the axis to the rim, at several distances. */
static void test_project_equals_the_definition(void)
{
    for (int l = 0; l < LENSES; l++) {
        pf_camera camera = lens(l);
        const char *why;
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_check(&camera, &why), why);
        for (int i = 0; i <= 100; i++)
            for (int p = 0; p < 40; p++) {
                double theta = camera.theta_max * i / 100 * (1 - 1e-12), phi = 0.03 + p * 9 * DEGREES, xyz[3], uv[2],
                       truth[2];
                point_on_ray(&camera, theta, phi, p % 2 ? 0.04 : 2, xyz);
                pixel_truth(&camera, theta, phi, truth);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
                TEST_ASSERT_DOUBLE_WITHIN(5e-11, truth[0], uv[0]);
                TEST_ASSERT_DOUBLE_WITHIN(5e-11, truth[1], uv[1]);
            }
    }
}

/* Proves: pixel -> ray -> pixel within 1e-9 px over the whole domain, rim and axis included, for points anywhere on the
 * ray; the ray is a unit vector, and starts where the pupil is. */
static void test_round_trip_over_the_whole_domain(void)
{
    for (int l = 0; l < LENSES; l++) {
        pf_camera camera = lens(l);
        double worst = 0;
        for (int i = 0; i <= 300; i++)
            for (int p = 0; p < 60; p++) {
                double theta = camera.theta_max * i / 300, phi = 0.011 + p * 6 * DEGREES, uv[2], ray[3], from[3],
                       back[2];
                pixel_truth(&camera, theta, phi, uv);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, from, NULL));
                TEST_ASSERT_DOUBLE_WITHIN(1e-15, 1, sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]));
                TEST_ASSERT_DOUBLE_WITHIN(1e-9, cos(theta), ray[2]);
                TEST_ASSERT_DOUBLE_WITHIN(1e-9 * fabs(camera.pupil_e1), camera.pupil_e1 * theta * theta, from[2]);
                TEST_ASSERT_EQUAL_DOUBLE(0, from[0] * from[0] + from[1] * from[1]);
                double s = p % 3 ? 0.05 : 3;
                const double xyz[3] = {from[0] + s * ray[0], from[1] + s * ray[1], from[2] + s * ray[2]};
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, back, NULL, NULL));
                worst = fmax(worst, hypot(back[0] - uv[0], back[1] - uv[1]));
            }
        TEST_ASSERT_TRUE(worst <= 1e-9);
    }
}

/* Proves: where the projection is so steep (r' up to 1e7) that neither a pixel 2e6 px away nor an angle in doubles is
 * within 5e-10 px of anything, valid pixels still have their rays, as exactly as a ray can tell (4e-15 rad). */
static void test_round_trip_where_the_plane_is_huge(void)
{
    for (int variant = 0; variant < 3; variant++) {
        pf_camera camera = {.width = 1280,
                            .height = 800,
                            .radial = PF_RADIAL_STEREOGRAPHIC,
                            .f_u = 354.6875,
                            .f_v = 354.3125,
                            .skew = -.65625,
                            .c_u = 643.59375,
                            .c_v = 404.75,
                            .theta_max = 3.141,
                            .asym_radial_phi = {.5, .5, -.5, .5}};
        camera.asym_radial_theta[0] = variant == 1 ? -.001953125 : .0078125;
        camera.asym_radial_theta[1] = camera.asym_radial_theta[2] = variant == 1 ? -.001953125 : 0;
        if (variant == 2)
            camera.tilt[0] = 1e-8;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&camera, NULL));
        for (int i = 0; i <= 64; i++)
            for (int j = 0; j < 32; j++) {
                double theta = camera.theta_max * (i <= 32 ? i / 32.0 : 1 - exp2(32 - i)), phi = .1 + j * .19635;
                double xyz[3] = {sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta)}, uv[2], back[2], slope[6];
                double ray[3], steepest = 0;
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, slope, NULL));
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, NULL));
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, ray, back, NULL, NULL));
                for (int k = 0; k < 6; k++)
                    steepest += fabs(slope[k]);
                TEST_ASSERT_TRUE(hypot(back[0] - uv[0], back[1] - uv[1]) <= 1e-9 + 4e-15 * steepest);
            }
    }
}

/* Proves: a pixel outside the image of the domain is refused, one inside accepted, whatever the asymmetry: by a proof
 * where it is far, by the search where it is near, and on both sides of where the two meet. */
static void test_unproject_refuses_beyond_the_rim(void)
{
    const double distance[] = {1e-8, 1e-6, 3e-5, 1e-3, 0.02}; /* radians: 3e-6 to 6 px */
    for (int l = 0; l < LENSES; l++)
        for (int p = 0; p < 720; p++) {
            pf_camera camera = lens(l);
            const double phi = p * 0.5 * DEGREES, by = distance[p % 5];
            double uv[2], ray[3];
            pixel_truth(&camera, camera.theta_max + by, phi, uv);
            TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_unproject(&camera, uv, ray, NULL, NULL));
            pixel_truth(&camera, camera.theta_max - by, phi, uv);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, NULL));
        }
}

/* Proves: far outside, behind a tilted sensor's horizon, and not finite: refused, nothing written. */
static void test_unproject_refuses_the_impossible(void)
{
    const double bad[][2] = {{1e6, 0}, {-1e9, 1e9}, {1e300, -1e300}, {(double)NAN, 0}, {0, (double)INFINITY}};
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
            pf_camera camera = lens(l);
            double out[12], before[12];
            memset(out, 0x5A, sizeof out);
            memcpy(before, out, sizeof out);
            TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_unproject(&camera, bad[i], out, out + 3, out + 6));
            TEST_ASSERT_EQUAL_MEMORY(before, out, sizeof out);
        }
}

/* A five-point difference quotient along one number: `value` is moved and put back. */
static void difference(pf_camera *camera, double xyz[3], double *value, double h, double slope[2])
{
    static const double step[4] = {-2, -1, 1, 2};
    double q[4][2], centre = *value;
    for (int s = 0; s < 4; s++) {
        *value = centre + step[s] * h;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(camera, xyz, q[s], NULL, NULL));
    }
    *value = centre;
    for (int row = 0; row < 2; row++)
        slope[row] = (q[0][row] - 8 * q[1][row] + 8 * q[2][row] - q[3][row]) / (12 * h);
}

/* Proves: both derivatives, by the point and by all 41 parameters, are the five-point difference quotients within 1e-7
 * of their size (at least of the focal length), asymmetric terms included, to 0.5 degrees before the rim. With Paper
 * II's terms the axis, where no derivative exists, is left out by 3 degrees. */
static void test_derivatives_equal_finite_differences(void)
{
    for (int l = 0; l < LENSES; l++)
        for (int i = 0; i <= 40; i++)
            for (int p = 0; p < 7; p++) {
                pf_camera camera = lens(l);
                double first = has_kink(&camera) ? 3 * DEGREES : 0;
                double theta = first + (camera.theta_max - 0.5 * DEGREES - first) * i / 40, phi = 0.2 + p;
                double xyz[3], uv[2], by_point[6], by_param[2 * PF_CAMERA_PARAMS], slope[2];
                point_on_ray(&camera, theta, phi, 0.7, xyz);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, by_point, by_param));
                camera.theta_max += 0.4 * DEGREES;
                for (int axis = 0; axis < 3; axis++) {
                    difference(&camera, xyz, &xyz[axis], 3e-4, slope);
                    for (int row = 0; row < 2; row++)
                        TEST_ASSERT_DOUBLE_WITHIN(1e-7 * fmax(300, fabs(slope[row])), slope[row],
                                                  by_point[3 * row + axis]);
                }
                for (uint32_t k = 0; k < PF_CAMERA_PARAMS; k++) {
                    if (k >= PF_PARAM_K2 && k <= PF_PARAM_K5 && camera.radial != PF_RADIAL_GENERIC)
                        continue; /* not parameters of such a lens: next test */
                    if (k == PF_PARAM_MIRROR && camera.radial != PF_RADIAL_UNIFIED)
                        continue;
                    double h = k <= PF_PARAM_C_V ? 1 : 1e-5;
                    difference(&camera, xyz, pf_camera_param_at(&camera, k), h, slope);
                    for (int row = 0; row < 2; row++)
                        TEST_ASSERT_DOUBLE_WITHIN(1e-7 * fmax(300, fabs(slope[row])), slope[row],
                                                  by_param[PF_CAMERA_PARAMS * (uint32_t)row + k]);
                }
            }
}

/* Proves: a parameter that a lens does not have has derivative 0, and on the axis the derivative by the point is that
 * along phi = 0, one-sided. */
static void test_derivatives_where_there_are_none(void)
{
    pf_camera camera = lens(10);
    const double off_axis[3] = {0.3, 0.2, 0.5}, on_axis[3] = {0, 0, 0.5};
    double uv[2], by_point[6], by_param[2 * PF_CAMERA_PARAMS];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, off_axis, uv, NULL, by_param));
    for (int row = 0; row < 2; row++) {
        for (int k = PF_PARAM_K2; k <= PF_PARAM_K5; k++)
            TEST_ASSERT_EQUAL_DOUBLE(0, by_param[row * PF_CAMERA_PARAMS + k]);
        TEST_ASSERT_EQUAL_DOUBLE(0, by_param[row * PF_CAMERA_PARAMS + PF_PARAM_MIRROR]);
    }
    camera = lens(1);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, on_axis, uv, by_point, NULL));
    const double h = 1e-7, beside[3] = {0.5 * h, 0, 0.5};
    double moved[2];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, beside, moved, NULL, NULL));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, (moved[0] - uv[0]) / (0.5 * h), by_point[0]);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, (moved[1] - uv[1]) / (0.5 * h), by_point[3]);
}

/* Found by the fuzzer: the first-order start lies on the rim three quarters of a radian away from the pixel's own place
 * there, and Newton's step from it leads outwards, where cut off it comes no closer. */
static void test_the_rim_is_found_from_far_along_it(void)
{
    const struct {
        uint32_t first;
        double value[4];
    } parameters[] = {{PF_PARAM_F_U, {356.25, 552.75, 0.125, 881.875}},
                      {PF_PARAM_C_V, {639.125, 0.03125, 0.00390625, -0.0009765625}},
                      {PF_PARAM_K5, {6.103515625e-05}},
                      {PF_PARAM_ASYM_TANGENTIAL_THETA, {-0.125, -0.001953125, -0.001953125}},
                      {PF_PARAM_ASYM_TANGENTIAL_PHI, {-1 / sqrt(13), 2 / sqrt(13), 2 / sqrt(13), 2 / sqrt(13)}},
                      {PF_PARAM_TILT, {0.0109375, -0.0109375}}};
    pf_camera camera = plain(PF_RADIAL_GENERIC, 0);
    camera.height = 800;
    camera.theta_max = 1.5032745098039215;
    for (size_t i = 0; i < sizeof parameters / sizeof parameters[0]; i++)
        for (uint32_t k = 0; k < 4 && parameters[i].value[k] != 0; k++)
            *pf_camera_param_at(&camera, parameters[i].first + k) = parameters[i].value[k];
    camera.asym_radial_phi[3] = -1;
    for (int i = 0; i < PF_CPOLY_MAX; i++)
        camera.cpoly[i] = 0.001953125;
    camera.cpoly[10] = 0.0625;
    camera.cpoly[11] = -0.0087890625;
    camera.cpoly[12] = -0.1162109375;
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_check(&camera, &why), why);
    for (int i = 0; i < 3600; i++) {
        double phi = 0.1 * i * DEGREES, uv[2], ray[3];
        double xyz[3] = {sin(camera.theta_max) * cos(phi), sin(camera.theta_max) * sin(phi), cos(camera.theta_max)};
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, NULL));
        for (int k = 0; k < 3; k++)
            TEST_ASSERT_DOUBLE_WITHIN(1e-11, xyz[k], ray[k]);
    }
}

/* Proves: d ray / d pixel is the five-point difference quotient (step 0.05 px: below 1e-9 where the lens does not
 * flatten), for every lens. */
static void test_derivative_of_unproject(void)
{
    for (int l = 0; l < LENSES; l++)
        for (int i = 1; i <= 20; i++)
            for (int p = 0; p < 8; p++) {
                pf_camera camera = lens(l);
                static const double step[4] = {-2, -1, 1, 2};
                double uv[2], ray[3], q[4][3], jacobian[6], theta = (camera.theta_max - 2 * DEGREES) * i / 20;
                pixel_truth(&camera, theta, 0.05 + 0.8 * p, uv);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, jacobian));
                for (int axis = 0; axis < 2; axis++) {
                    for (int s = 0; s < 4; s++) {
                        double moved[2] = {uv[0], uv[1]};
                        moved[axis] += step[s] * 0.05;
                        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, moved, q[s], NULL, NULL));
                    }
                    for (int row = 0; row < 3; row++) {
                        double slope = (q[0][row] - 8 * q[1][row] + 8 * q[2][row] - q[3][row]) / 0.6;
                        TEST_ASSERT_DOUBLE_WITHIN(1e-9, slope, jacobian[2 * row + axis]);
                    }
                }
            }
}

/* Proves: with a pupil shift, a point so near that rays of the moving pupil may cross is refused; a little further out
 * each point has one ray, and it passes through the point. */
static void test_pupil_refuses_points_where_rays_cross(void)
{
    pf_camera camera = lens(5);
    double limit = camera.pupil_e1 * camera.theta_max * (camera.theta_max + 2);
    srand(1);
    for (int i = 0; i < 20000; i++) {
        double theta = camera.theta_max * rand() / RAND_MAX, phi = 6.3 * rand() / RAND_MAX, uv[2], ray[3], from[3];
        double near[3] = {0.999 * limit * sin(theta), 0, 0.999 * limit * cos(theta)};
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_project(&camera, near, uv, NULL, NULL));
        double scale = 1.001 + i % 5;
        double xyz[3] = {scale * limit * sin(theta) * cos(phi), scale * limit * sin(theta) * sin(phi),
                         scale * limit * cos(theta)};
        if (pf_camera_project(&camera, xyz, uv, NULL, NULL) != PF_OK) {
            TEST_ASSERT_TRUE(theta > camera.theta_max - 0.7); /* the ray to it would be beyond theta_max */
            continue;
        }
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, from, NULL));
        double to[3] = {xyz[0] - from[0], xyz[1] - from[1], xyz[2] - from[2]};
        double cross[3] = {to[1] * ray[2] - to[2] * ray[1], to[2] * ray[0] - to[0] * ray[2],
                           to[0] * ray[1] - to[1] * ray[0]};
        TEST_ASSERT_TRUE(fabs(cross[0]) + fabs(cross[1]) + fabs(cross[2]) < 1e-13);
        TEST_ASSERT_TRUE(to[0] * ray[0] + to[1] * ray[1] + to[2] * ray[2] > 0);
    }
}

/* Proves: batches project to the bits of the single calls, for every lens and every block remainder, and back-project
 * to the same rays within a few units in the last place, with the same items refused. */
static void test_batches_equal_single_calls(void)
{
    enum { N = 64 * 5 + 37 };
    static double xyz[N][3], uv[N][2], ray[N][3], from[N][3];
    static uint8_t ok[N];
    srand(2);
    for (int l = 0; l < LENSES + 1; l++) {
        pf_camera camera = l < LENSES ? lens(l) : lens(0);
        if (l == LENSES)
            memset(camera.asym_radial_theta, 0, sizeof camera.asym_radial_theta),
                memset(camera.asym_tangential_theta, 0, sizeof camera.asym_tangential_theta);
        for (size_t n = 0; n <= N; n += n < 70 ? 1 : 97) {
            for (size_t i = 0; i < n; i++) {
                double theta = 3.2 * rand() / RAND_MAX, phi = 6.3 * rand() / RAND_MAX;
                point_on_ray(&camera, i % 11 ? theta : 0, phi, 1, xyz[i]);
                if (i % 31 == 7)
                    xyz[i][i % 3] = (double)NAN;
            }
            pf_camera_project_n(&camera, n, &xyz[0][0], &uv[0][0], ok);
            for (size_t i = 0; i < n; i++) {
                double single[2];
                TEST_ASSERT_EQUAL_UINT8(pf_camera_project(&camera, xyz[i], single, NULL, NULL) == PF_OK, ok[i]);
                if (ok[i])
                    TEST_ASSERT_EQUAL_MEMORY(single, uv[i], sizeof single);
                else
                    TEST_ASSERT_TRUE(isnan(uv[i][0]) && isnan(uv[i][1]));
            }
            for (size_t i = 0; i < n; i += 5)
                uv[i][0] += (double)(i * 7 % 1000) - 500;
            pf_camera_unproject_n(&camera, n, &uv[0][0], &ray[0][0], &from[0][0], ok);
            for (size_t i = 0; i < n; i++) {
                double single[3], start[3];
                TEST_ASSERT_EQUAL_UINT8(pf_camera_unproject(&camera, uv[i], single, start, NULL) == PF_OK, ok[i]);
                for (int k = 0; k < 3; k++) {
                    TEST_ASSERT_TRUE(ok[i] || (isnan(ray[i][k]) && isnan(from[i][k])));
                    if (ok[i]) {
                        TEST_ASSERT_DOUBLE_WITHIN(2e-14, single[k], ray[i][k]);
                        TEST_ASSERT_DOUBLE_WITHIN(1e-15, start[k], from[i][k]);
                    }
                }
            }
        }
    }
}

/* Proves: r and its slope, for what draws curves. */
static void test_radius(void)
{
    for (int l = 0; l < LENSES; l++)
        for (int i = 0; i <= 50; i++) {
            pf_camera camera = lens(l);
            double theta = camera.theta_max * i / 50, slope;
            TEST_ASSERT_DOUBLE_WITHIN(2e-15 * (1 + (double)radial_truth(&camera, theta) * 10),
                                      (double)radial_truth(&camera, theta), pf_camera_radius(&camera, theta, &slope));
            long double h = 1e-5L;
            TEST_ASSERT_DOUBLE_WITHIN(
                1e-7, (double)((radial_truth(&camera, theta + h) - radial_truth(&camera, theta - h)) / (2 * h)), slope);
        }
}

/* Proves: parameter numbers and places belong together, and end at 41. */
static void test_param_at(void)
{
    pf_camera camera = plain(PF_RADIAL_GENERIC, 90);
    TEST_ASSERT_EQUAL_PTR(&camera.f_u, pf_camera_param_at(&camera, PF_PARAM_F_U));
    TEST_ASSERT_EQUAL_PTR(&camera.k5, pf_camera_param_at(&camera, PF_PARAM_K5));
    TEST_ASSERT_EQUAL_PTR(&camera.asym_radial_phi[3], pf_camera_param_at(&camera, PF_PARAM_ASYM_RADIAL_PHI + 3));
    TEST_ASSERT_EQUAL_PTR(&camera.tilt[1], pf_camera_param_at(&camera, PF_PARAM_TILT + 1));
    TEST_ASSERT_EQUAL_PTR(&camera.cpoly[13], pf_camera_param_at(&camera, PF_CAMERA_PARAMS - 1));
    TEST_ASSERT_NULL(pf_camera_param_at(&camera, PF_CAMERA_PARAMS));
    for (uint32_t a = 0; a < PF_CAMERA_PARAMS; a++)
        for (uint32_t b = 0; b < a; b++)
            TEST_ASSERT_TRUE(pf_camera_param_at(&camera, a) != pf_camera_param_at(&camera, b));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_elementary_functions_equal_long_double);
    RUN_TEST(test_project_equals_the_definition);
    RUN_TEST(test_round_trip_over_the_whole_domain);
    RUN_TEST(test_round_trip_where_the_plane_is_huge);
    RUN_TEST(test_the_rim_is_found_from_far_along_it);
    RUN_TEST(test_unproject_refuses_beyond_the_rim);
    RUN_TEST(test_unproject_refuses_the_impossible);
    RUN_TEST(test_derivatives_equal_finite_differences);
    RUN_TEST(test_derivatives_where_there_are_none);
    RUN_TEST(test_derivative_of_unproject);
    RUN_TEST(test_pupil_refuses_points_where_rays_cross);
    RUN_TEST(test_batches_equal_single_calls);
    RUN_TEST(test_radius);
    RUN_TEST(test_param_at);
    return UNITY_END();
}
