/* The camera model against truth computed another way: long double acos/asin, or closed forms without any angle. */
#include "pipefish/camera.h"
#include "unity.h"

#include <math.h>
#include <string.h>

#define DEGREES (3.14159265358979323846 / 180)

void setUp(void) {}
void tearDown(void) {}

static pf_camera camera_make(double f_u, double f_v, double skew, double k2, double k3, double k4, double k5,
                             double theta_max_degrees)
{
    pf_camera camera = {.width = 1280, .height = 960, .f_u = f_u, .f_v = f_v, .skew = skew, .c_u = 641.3, .c_v = 478.8};
    camera.k2 = k2;
    camera.k3 = k3;
    camera.k4 = k4;
    camera.k5 = k5;
    camera.theta_max = theta_max_degrees * DEGREES;
    return camera;
}

/* Lenses that differ in what is hard: none, a usual 190 degree lens with skew, one that flattens to r' = 0.004 at the
 * rim, one whose r' dips to 1e-4 midway (Newton leaves the bracket there), and one that steepens. */
#define LENSES 5
static pf_camera lens(int i)
{
    switch (i) {
    case 0:
        return camera_make(300, 300, 0, 0, 0, 0, 0, 110);
    case 1:
        return camera_make(357.2, 355.9, 1.7, -0.031, 0.0042, -0.0011, 0.00006, 110);
    case 2:
        return camera_make(420, 419, -0.4, -1 / (3 * 3.7), 0, 0, 0, 110);
    case 3: /* r' = 1 - 2 s + 1.0001 s^2, at least 1e-4 */
        return camera_make(310, 512, 9, -2.0 / 3, 1.0001 / 5, 0, 0, 110);
    default:
        return camera_make(200, 210, 0, 0.12, 0.03, 0.004, 0.0007, 110);
    }
}

static void direction(double theta, double phi, double length, double xyz[3])
{
    xyz[0] = length * sin(theta) * cos(phi);
    xyz[1] = length * sin(theta) * sin(phi);
    xyz[2] = length * cos(theta);
}

/* The model by another road: theta from acos or asin of the unit vector, sines of phi, powers summed one by one. */
static void project_truth(const pf_camera *camera, const double xyz[3], double uv[2])
{
    long double x = xyz[0], y = xyz[1], z = xyz[2];
    long double n = sqrtl(x * x + y * y + z * z), rho = sqrtl(x * x + y * y);
    long double theta = fabsl(z) < 0.5L * n ? acosl(z / n) : asinl(rho / n);
    if (z <= -0.5L * n)
        theta = acosl(-1.0L) - theta;
    long double r = theta + camera->k2 * powl(theta, 3) + camera->k3 * powl(theta, 5) + camera->k4 * powl(theta, 7) +
                    camera->k5 * powl(theta, 9);
    long double phi = atan2l(y, x);
    uv[0] = (double)(camera->f_u * r * cosl(phi) + camera->skew * r * sinl(phi) + camera->c_u);
    uv[1] = (double)(camera->f_v * r * sinl(phi) + camera->c_v);
}

static const double NEAR_AXIS[] = {0, 1e-300, 1e-160, 1e-20, 1e-12, 0.9e-9, 1.1e-9, 1e-8, 1e-6, 1e-4, 1e-2};
#define NEAR_AXIS_COUNT (sizeof NEAR_AXIS / sizeof NEAR_AXIS[0])

/* Angles from the axis to 110 degrees, dense near the axis. */
static double grid_theta(size_t i)
{
    return i < NEAR_AXIS_COUNT ? NEAR_AXIS[i] : (double)(i - NEAR_AXIS_COUNT + 1) * 109.999 / 80 * DEGREES;
}
#define GRID_THETAS (NEAR_AXIS_COUNT + 80)

/* Proves: pixels are the formula's to the rounding error (4 units in the last place of a 1000 px coordinate), from the
 * axis to 110 degrees, for any length of the vector. */
static void test_project_equals_independent_long_double_evaluation(void)
{
    static const double length[] = {1, 1e-90, 3.7e90};
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < GRID_THETAS; i++)
            for (int p = 0; p < 12; p++) {
                pf_camera camera = lens(l);
                double xyz[3], uv[2], truth[2];
                direction(grid_theta(i), 0.1 + p * 30 * DEGREES, length[p % 3], xyz);
                project_truth(&camera, xyz, truth);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
                TEST_ASSERT_DOUBLE_WITHIN(5e-12, truth[0], uv[0]);
                TEST_ASSERT_DOUBLE_WITHIN(5e-12, truth[1], uv[1]);
            }
}

/* Proves: the polynomial with the series of 2 sin(theta/2) and of sin(theta) gives the equisolid and the orthographic
 * lens, whose pixels need no angle at all, up to the first term left out of the series. */
static void test_project_equals_closed_forms(void)
{
    pf_camera equisolid = camera_make(300, 300, 0, -1.0 / 24, 1.0 / 1920, -1.0 / 322560, 1.0 / 92897280, 120);
    pf_camera orthographic = camera_make(300, 300, 0, -1.0 / 6, 1.0 / 120, -1.0 / 5040, 1.0 / 362880, 80);
    for (int i = 1; i <= 110; i++) {
        double theta = i * DEGREES, xyz[3], uv[2];
        direction(theta, 0, 2, xyz);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&equisolid, xyz, uv, NULL, NULL));
        TEST_ASSERT_DOUBLE_WITHIN(300 * pow(theta, 11) / 1024 / 39916800 + 1e-11, 300 * sqrt(2 - xyz[2]),
                                  uv[0] - equisolid.c_u);
        if (i <= 80) {
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&orthographic, xyz, uv, NULL, NULL));
            TEST_ASSERT_DOUBLE_WITHIN(300 * pow(theta, 11) / 39916800 + 1e-11, 150 * xyz[0], uv[0] - orthographic.c_u);
        }
    }
}

/* Proves: axis directions and signs: x to the right is u, y down is v, z forward, and 90 and 135 degrees are ordinary.
 */
static void test_conventions_of_axes_and_pixels(void)
{
    pf_camera camera = camera_make(100, 200, 0, 0, 0, 0, 0, 170);
    static const struct {
        double xyz[3], theta, du, dv;
    } item[] = {{{0, 0, 5}, 0, 0, 0},    {{1, 0, 1}, 45, 1, 0},   {{0, 1, 1}, 45, 0, 1},
                {{-3, 0, 0}, 90, -1, 0}, {{0, -3, 0}, 90, 0, -1}, {{0, 2, -2}, 135, 0, 1}};
    for (size_t i = 0; i < sizeof item / sizeof item[0]; i++) {
        double uv[2];
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, item[i].xyz, uv, NULL, NULL));
        TEST_ASSERT_DOUBLE_WITHIN(1e-12, camera.c_u + 100 * item[i].theta * DEGREES * item[i].du, uv[0]);
        TEST_ASSERT_DOUBLE_WITHIN(1e-12, camera.c_v + 200 * item[i].theta * DEGREES * item[i].dv, uv[1]);
    }
}

/* Proves: the derivative by the point is the 5-point difference quotient, on the axis, across it and to 110 degrees.
 * Step 1e-3: truncation h^4 f^(5) / 30 ~ 1e-8 px for the sharpest lens, rounding 1e-13 / h ~ 1e-10. */
static void test_derivative_by_point_equals_finite_differences(void)
{
    const double h = 1e-3;
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < GRID_THETAS - 1; i++)
            for (int p = 0; p < 7; p++) {
                pf_camera camera = lens(l);
                camera.theta_max = 112 * DEGREES;
                double xyz[3], uv[2], jacobian[6];
                direction(grid_theta(i), 0.2 + p, 1, xyz);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, jacobian, NULL));
                for (int axis = 0; axis < 3; axis++) {
                    double q[4][2];
                    static const double step[4] = {-2, -1, 1, 2};
                    for (int s = 0; s < 4; s++) {
                        double moved[3] = {xyz[0], xyz[1], xyz[2]};
                        moved[axis] += step[s] * h;
                        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, moved, q[s], NULL, NULL));
                    }
                    for (int row = 0; row < 2; row++) {
                        double slope = (q[0][row] - 8 * q[1][row] + 8 * q[2][row] - q[3][row]) / (12 * h);
                        TEST_ASSERT_DOUBLE_WITHIN(2e-7, slope, jacobian[3 * row + axis]);
                    }
                }
            }
}

/* Proves: on the axis the derivative is exactly f / z, and it scales with the distance. */
static void test_derivative_on_the_axis_is_exact(void)
{
    pf_camera camera = lens(1);
    const double xyz[3] = {0, 0, 0.25};
    double uv[2], j[6];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, j, NULL));
    const double expected[6] = {4 * camera.f_u, 4 * camera.skew, 0, 0, 4 * camera.f_v, 0};
    for (int i = 0; i < 6; i++)
        TEST_ASSERT_EQUAL_DOUBLE(expected[i], j[i]);
    TEST_ASSERT_EQUAL_DOUBLE(camera.c_u, uv[0]);
    TEST_ASSERT_EQUAL_DOUBLE(camera.c_v, uv[1]);
}

/* Proves: the derivatives by the nine parameters; the model is linear in each, so any step is exact but for rounding.
 */
static void test_derivative_by_parameters_equals_finite_differences(void)
{
    static const size_t offset[PF_CAMERA_PARAMS] = {
        offsetof(pf_camera, f_u), offsetof(pf_camera, f_v), offsetof(pf_camera, skew),
        offsetof(pf_camera, c_u), offsetof(pf_camera, c_v), offsetof(pf_camera, k2),
        offsetof(pf_camera, k3),  offsetof(pf_camera, k4),  offsetof(pf_camera, k5)};
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < GRID_THETAS; i++)
            for (int param = 0; param <= PF_PARAM_K5; param++) {
                pf_camera camera = lens(l);
                double xyz[3], uv[2], low[2], high[2], jacobian[2 * PF_CAMERA_PARAMS];
                direction(grid_theta(i), 2.2, 0.3, xyz);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, jacobian));
                double *value = (double *)(void *)((char *)&camera + offset[param]);
                double centre = *value, h = param < PF_PARAM_K2 ? 16 : 0.25;
                *value = centre - h;
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, low, NULL, NULL));
                *value = centre + h;
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, high, NULL, NULL));
                for (int row = 0; row < 2; row++) {
                    double slope = (high[row] - low[row]) / (2 * h);
                    TEST_ASSERT_DOUBLE_WITHIN(1e-8, slope, jacobian[row * PF_CAMERA_PARAMS + param]);
                }
            }
}

static void assert_round_trip(const pf_camera *camera, const double uv[2], double *worst)
{
    double ray[3], origin[3] = {7, 7, 7}, back[2];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(camera, uv, ray, origin, NULL));
    TEST_ASSERT_DOUBLE_WITHIN(4e-16 * 2, 1, sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]));
    for (int i = 0; i < 3; i++)
        TEST_ASSERT_EQUAL_DOUBLE(0, origin[i]);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(camera, ray, back, NULL, NULL));
    *worst = fmax(*worst, hypot(back[0] - uv[0], back[1] - uv[1]));
}

/* Proves: pixel -> ray -> pixel within 1e-9 px for every lens, over the whole domain, with the rim and the axis. */
static void test_round_trip_from_pixels_over_the_whole_domain(void)
{
    for (int l = 0; l < LENSES; l++) {
        pf_camera camera = lens(l);
        double worst = 0;
        int inside = 0;
        for (double v = -900; v < 1900; v += 7.3)
            for (double u = -900; u < 2200; u += 7.3) {
                double uv[2] = {u, v}, ray[3];
                if (pf_camera_unproject(&camera, uv, ray, NULL, NULL) != PF_OK)
                    continue;
                inside++;
                assert_round_trip(&camera, uv, &worst);
            }
        for (size_t i = 0; i < GRID_THETAS; i++)
            for (int p = 0; p < 360; p++) {
                double xyz[3], uv[2];
                direction(grid_theta(i), p * DEGREES, 1, xyz);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
                assert_round_trip(&camera, uv, &worst);
            }
        TEST_ASSERT_TRUE(inside > 3000);
        TEST_ASSERT_TRUE(worst <= 1e-9);
    }
}

/* Proves: a ray at theta_max itself, in any direction, projects, comes back and projects again: rounding at the rim
 * must not turn a valid pixel into a refused one. */
static void test_round_trip_at_the_rim(void)
{
    for (int l = 0; l < LENSES; l++) {
        pf_camera camera = lens(l);
        double worst = 0;
        for (int p = 0; p < 20000; p++) {
            double xyz[3], uv[2];
            direction(camera.theta_max, p * 0.618, 1 + p, xyz);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
            assert_round_trip(&camera, uv, &worst);
        }
        TEST_ASSERT_TRUE(worst <= 1e-9);
    }
}

/* Proves: Newton that starts where r' is 1e-11 (theta = 1; plain Newton leaps 1e10 away and needs hundreds of steps to
 * come back) still lands within 1e-9 px. */
static void test_unproject_survives_a_start_on_a_flat_spot(void)
{
    const double e = 1e-11;
    pf_camera camera = camera_make(310, 300, 0, -1.0 / 3, e / 5, (-1 + e) / 7, (1 + e) / 9, 110);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&camera, NULL));
    double worst = 0;
    for (int sign = -1; sign <= 1; sign += 2)
        for (double off = 1; off > 1e-13; off *= 0.37) {
            const double uv[2] = {camera.c_u + camera.f_u * (1 + sign * off), camera.c_v};
            assert_round_trip(&camera, uv, &worst);
        }
    TEST_ASSERT_TRUE(worst <= 1e-9);
}

/* Proves: direction -> pixel -> direction, to the rounding error divided by how much the lens flattens there. */
static void test_round_trip_from_directions(void)
{
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < GRID_THETAS; i++)
            for (int p = 0; p < 36; p++) {
                pf_camera camera = lens(l);
                double xyz[3], uv[2], ray[3], s = grid_theta(i) * grid_theta(i);
                direction(grid_theta(i), p * 10 * DEGREES, 1, xyz);
                double slope = 1 + 3 * camera.k2 * s + 5 * camera.k3 * s * s + 7 * camera.k4 * s * s * s +
                               9 * camera.k5 * s * s * s * s;
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, NULL));
                for (int axis = 0; axis < 3; axis++)
                    TEST_ASSERT_DOUBLE_WITHIN(1e-14 / fmin(slope, 1), xyz[axis], ray[axis]);
            }
}

/* Proves: d ray / d pixel is the 5-point difference quotient (step 0.05 px: truncation and rounding below 1e-11 where
 * r' is not small), and the inverse of the point's derivative. */
static void test_derivative_of_unproject(void)
{
    const double h = 0.05;
    for (int l = 0; l < LENSES; l++)
        for (size_t i = 0; i < GRID_THETAS - 2; i++)
            for (int p = 0; p < 8; p++) {
                pf_camera camera = lens(l);
                double xyz[3], uv[2], ray[3], back[2], jacobian[6], forward[6];
                direction(grid_theta(i), 0.05 + 0.8 * p, 1, xyz);
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, uv, ray, NULL, jacobian));
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, ray, back, forward, NULL));
                for (int a = 0; a < 2; a++)
                    for (int b = 0; b < 2; b++) {
                        double sum = 0;
                        for (int k = 0; k < 3; k++)
                            sum += forward[3 * a + k] * jacobian[2 * k + b];
                        TEST_ASSERT_DOUBLE_WITHIN(1e-10, a == b, sum);
                    }
                if (l == 3 || (l == 2 && i > NEAR_AXIS_COUNT + 65))
                    continue; /* r' < 0.3: sharper than a difference resolves; the identity above covers it */
                for (int axis = 0; axis < 2; axis++) {
                    double q[4][3];
                    static const double step[4] = {-2, -1, 1, 2};
                    for (int s = 0; s < 4; s++) {
                        double moved[2] = {uv[0], uv[1]};
                        moved[axis] += step[s] * h;
                        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_unproject(&camera, moved, q[s], NULL, NULL));
                    }
                    for (int row = 0; row < 3; row++) {
                        double slope = (q[0][row] - 8 * q[1][row] + 8 * q[2][row] - q[3][row]) / (12 * h);
                        TEST_ASSERT_DOUBLE_WITHIN(1e-10, slope, jacobian[2 * row + axis]);
                    }
                }
            }
}

/* Proves: what has no pixel is refused and nothing is written: the origin, theta = pi, beyond theta_max, NaN, Inf. */
static void test_project_refuses_and_leaves_outputs(void)
{
    pf_camera camera = lens(0), nearly_pi = lens(0);
    nearly_pi.theta_max = 3.1415926535897927;
    double inf = (double)INFINITY, nan = (double)NAN;
    const double bad[][3] = {{0, 0, 0},       {-0.0, -0.0, -0.0}, {0, 0, -1},    {1e-200, 0, -1}, {nan, 0, 1},
                             {0, nan, 1},     {0, 0, nan},        {inf, 0, 1},   {0, -inf, 1},    {0, 0, inf},
                             {inf, inf, inf}, {nan, inf, 1},      {0, 0, 1e101}, {0, 1e-101, 0}};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++)
        for (int c = 0; c < 2; c++) {
            double out[2 + 6 + 2 * PF_CAMERA_PARAMS], before[2 + 6 + 2 * PF_CAMERA_PARAMS];
            memset(out, 0x5A, sizeof out);
            memcpy(before, out, sizeof out);
            TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN,
                                  pf_camera_project(c ? &nearly_pi : &camera, bad[i], out, out + 2, out + 8));
            TEST_ASSERT_EQUAL_MEMORY(before, out, sizeof out);
        }
    double xyz[3], uv[2];
    direction(camera.theta_max + 1e-14, 1, 1, xyz);
    TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_project(&camera, xyz, uv, NULL, NULL));
    direction(camera.theta_max - 1e-14, 1, 1, xyz);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz, uv, NULL, NULL));
}

/* Proves: pixels beyond r(theta_max), NaN and Inf are refused and nothing is written. */
static void test_unproject_refuses_and_leaves_outputs(void)
{
    pf_camera camera = lens(0);
    double inf = (double)INFINITY, nan = (double)NAN, rim = camera.c_u + 300 * camera.theta_max;
    const double bad[][2] = {{nan, 0},        {0, nan}, {inf, 0}, {0, -inf}, {inf, inf}, {rim + 1e-8, camera.c_v},
                             {1e308, -1e308}, {-1e5, 0}};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        double out[12], before[12];
        memset(out, 0x5A, sizeof out);
        memcpy(before, out, sizeof out);
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_unproject(&camera, bad[i], out, out + 3, out + 6));
        TEST_ASSERT_EQUAL_MEMORY(before, out, sizeof out);
    }
}

/* Proves: batches equal the single calls bit by bit, and an invalid item is NaN with ok 0 and harms no neighbour. */
static void test_batches_mark_invalid_items(void)
{
    pf_camera camera = lens(1);
    const double xyz[4][3] = {{0.1, 0.2, 1}, {0, 0, -1}, {(double)NAN, 0, 1}, {1, -2, -0.2}};
    double uv[4][2], ray[4][3];
    uint8_t ok[4];
    pf_camera_project_n(&camera, 4, &xyz[0][0], &uv[0][0], ok);
    for (int i = 0; i < 4; i++) {
        double single[2];
        TEST_ASSERT_EQUAL_UINT8(i == 0 || i == 3, ok[i]);
        if (ok[i]) {
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, xyz[i], single, NULL, NULL));
            TEST_ASSERT_EQUAL_MEMORY(single, uv[i], sizeof single);
        } else {
            TEST_ASSERT_TRUE(isnan(uv[i][0]) && isnan(uv[i][1]));
        }
    }
    pf_camera_unproject_n(&camera, 4, &uv[0][0], &ray[0][0], NULL, ok);
    for (int i = 0; i < 4; i++) {
        TEST_ASSERT_EQUAL_UINT8(i == 0 || i == 3, ok[i]);
        TEST_ASSERT_TRUE(ok[i] ? fabs(hypot(hypot(ray[i][0], ray[i][1]), ray[i][2]) - 1) < 1e-15
                               : isnan(ray[i][0]) && isnan(ray[i][1]) && isnan(ray[i][2]));
    }
}

/* Proves: the sensor ends half a pixel outside the outermost pixel centres, and the image circle cuts further. */
static void test_in_image(void)
{
    pf_camera camera = lens(0);
    const double in[][2] = {{-0.5, -0.5}, {1279.5, 959.5}, {0, 0}};
    const double out[][2] = {{-0.51, 0}, {0, -0.51}, {1279.51, 0}, {0, 959.51}, {(double)NAN, 0}, {0, (double)NAN}};
    for (size_t i = 0; i < 3; i++)
        TEST_ASSERT_TRUE(pf_camera_in_image(&camera, in[i]));
    for (size_t i = 0; i < 6; i++)
        TEST_ASSERT_FALSE(pf_camera_in_image(&camera, out[i]));
    camera.circle_u = 600;
    camera.circle_v = 400;
    camera.circle_radius = 50;
    const double circle[][2] = {{630, 440}, {630, 440.01}, {0, 0}};
    TEST_ASSERT_TRUE(pf_camera_in_image(&camera, circle[0]));
    TEST_ASSERT_FALSE(pf_camera_in_image(&camera, circle[1]));
    TEST_ASSERT_FALSE(pf_camera_in_image(&camera, circle[2]));
}

static void assert_check(pf_status expected, const pf_camera *camera, const char *field)
{
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT(expected, pf_camera_check(camera, &why));
    TEST_ASSERT_NOT_NULL(why);
    TEST_ASSERT_EQUAL_INT(expected, pf_camera_check(camera, NULL));
    TEST_ASSERT_EQUAL_STRING_LEN(field, why, strlen(field));
    TEST_ASSERT_TRUE(expected == PF_OK ? why[strlen(field)] == 0 : why[strlen(field)] == ':');
}

/* Proves: every field is checked for NaN, Inf and its range, and the text starts with the field's name. */
static void test_check_names_the_field(void)
{
    typedef struct {
        const char *name;
        size_t offset;
        double bad;
    } item;
#define ITEM(field, bad)                                                                                               \
    {                                                                                                                  \
#field, offsetof(pf_camera, field), bad                                                                        \
    }
    static const item items[] = {ITEM(f_u, 0),
                                 ITEM(f_v, -1),
                                 ITEM(skew, 301),
                                 ITEM(c_u, 1.1e5),
                                 ITEM(c_v, -1.1e5),
                                 ITEM(k2, 1e7),
                                 ITEM(k3, -1e7),
                                 ITEM(k4, 1e7),
                                 ITEM(k5, -1e7),
                                 ITEM(theta_max, 0),
                                 ITEM(theta_max, 3.15),
                                 ITEM(circle_u, 2e5),
                                 ITEM(circle_v, 2e5),
                                 ITEM(circle_radius, -1),
                                 ITEM(tilt[0], 0.71),
                                 ITEM(tilt[1], -0.71),
                                 ITEM(mirror, -1e-9),
                                 ITEM(mirror, 0.5),
                                 ITEM(pupil_e1, 1.1),
                                 ITEM(asym_radial_theta, -2e6),
                                 ITEM(asym_radial_phi, 2e6),
                                 ITEM(asym_tangential_theta, 2e6),
                                 ITEM(asym_tangential_phi, -2e6),
                                 ITEM(cpoly, 2e6)};
    pf_camera camera;
    for (size_t i = 0; i < sizeof items / sizeof items[0]; i++) {
        const double bad[] = {items[i].bad, (double)NAN, (double)INFINITY, (double)-INFINITY};
        for (int b = 0; b < 4; b++) {
            camera = lens(0);
            memcpy((char *)&camera + items[i].offset, &bad[b], sizeof bad[b]);
            assert_check(PF_ERR_ARGUMENT, &camera, items[i].name);
        }
    }
    const uint32_t sizes[] = {0, 16385, UINT32_MAX};
    for (int i = 0; i < 3; i++) {
        camera = lens(0);
        camera.width = sizes[i];
        assert_check(PF_ERR_ARGUMENT, &camera, "width");
        camera = lens(0);
        camera.height = sizes[i];
        assert_check(PF_ERR_ARGUMENT, &camera, "height");
    }
    camera = lens(0);
    camera.radial = 7;
    assert_check(PF_ERR_ARGUMENT, &camera, "radial");
    camera = lens(1);
    camera.radial = PF_RADIAL_STEREOGRAPHIC;
    assert_check(PF_ERR_ARGUMENT, &camera, "k2");
    assert_check(PF_ERR_ARGUMENT, NULL, "camera");
    for (int l = 0; l < LENSES; l++) {
        camera = lens(l);
        assert_check(PF_OK, &camera, "ok");
    }
}

/* Proves: theta_max just below the first root of r' passes and just above fails (r' = 1 - s / s0, s = theta^2). */
static void test_check_finds_the_first_root_of_the_derivative(void)
{
    for (double root = 0.2; root < 3.1; root += 0.07) {
        pf_camera camera = lens(0);
        camera.k2 = -1 / (3 * root * root);
        camera.theta_max = root * (1 - 1e-11);
        assert_check(PF_OK, &camera, "ok");
        camera.theta_max = root * (1 + 1e-11);
        assert_check(PF_ERR_DOMAIN, &camera, "theta_max");
    }
}

/* Proves: a dip of r' to -+1e-10 between any grid points is seen, at full degree: with t = s / s0,
 * r' = (1 - 2 t + (1 + e) t^2)(1 + t + t^2) has its minimum e / (1 + e) times about 3 near t = 1. */
static void test_check_sees_a_narrow_dip(void)
{
    for (double s0 = 0.05; s0 < 6; s0 *= 1.37)
        for (int sign = -1; sign <= 1; sign++) {
            pf_camera camera = lens(0);
            double e = sign * 1e-10;
            camera.k2 = -1 / s0 / 3;
            camera.k3 = e / (s0 * s0) / 5;
            camera.k4 = (-1 + e) / (s0 * s0 * s0) / 7;
            camera.k5 = (1 + e) / (s0 * s0 * s0 * s0) / 9;
            camera.theta_max = fmin(2 * sqrt(s0), 3.1);
            assert_check(sign > 0 ? PF_OK : PF_ERR_DOMAIN, &camera, sign > 0 ? "ok" : "theta_max");
            camera.theta_max = sqrt(s0) * 0.999;
            assert_check(PF_OK, &camera, "ok");
        }
}

/* Proves: on a tube's wall the central camera of a lens with a pupil that moves by 3 mm has the same image, asymmetric
 * terms included, to 0.04 px, where without that it is off by more than 2 px; a central one is copied; a radius of
 * nothing and a pupil beyond reason are refused, and nothing written. */
static void test_in_a_tube_a_moving_pupil_is_a_central_camera(void)
{
    for (int i = 0; i < 2; i++)
        for (double radius = 0.075; radius < 0.4; radius *= 2) {
            pf_camera camera = lens(i), central, still;
            double worst = 0, without = 0;
            camera.theta_max = 1.65;
            camera.pupil_e1 = 0.00104;
            camera.asym_radial_theta[0] = 0.002;
            camera.asym_radial_phi[1] = 1;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&camera, NULL));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_in_tube(&camera, radius, &central));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_check(&central, NULL));
            TEST_ASSERT_TRUE(central.pupil_e1 == 0);
            still = camera;
            still.pupil_e1 = 0;
            for (double z = -0.02; z < 5; z += 0.05)
                for (double phi = 0; phi < 6.2; phi += 0.7) {
                    const double wall[3] = {radius * cos(phi), radius * sin(phi), radius * z};
                    double a[2], b[2], c[2];
                    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&camera, wall, a, NULL, NULL));
                    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&central, wall, b, NULL, NULL));
                    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_project(&still, wall, c, NULL, NULL));
                    worst = fmax(worst, hypot(a[0] - b[0], a[1] - b[1]));
                    without = fmax(without, hypot(a[0] - c[0], a[1] - c[1]));
                }
            TEST_ASSERT_TRUE(worst < 0.04);
            TEST_ASSERT_TRUE(without > 2);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_in_tube(&still, radius, &central));
            TEST_ASSERT_EQUAL_MEMORY(&still, &central, sizeof central);
            TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_camera_in_tube(&camera, 0, &central));
            TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_camera_in_tube(&camera, NAN, &central));
            camera.pupil_e1 = 1;
            TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, pf_camera_in_tube(&camera, radius, &central));
            TEST_ASSERT_EQUAL_MEMORY(&still, &central, sizeof central);
        }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_project_equals_independent_long_double_evaluation);
    RUN_TEST(test_project_equals_closed_forms);
    RUN_TEST(test_conventions_of_axes_and_pixels);
    RUN_TEST(test_derivative_by_point_equals_finite_differences);
    RUN_TEST(test_derivative_on_the_axis_is_exact);
    RUN_TEST(test_derivative_by_parameters_equals_finite_differences);
    RUN_TEST(test_round_trip_from_pixels_over_the_whole_domain);
    RUN_TEST(test_round_trip_at_the_rim);
    RUN_TEST(test_unproject_survives_a_start_on_a_flat_spot);
    RUN_TEST(test_round_trip_from_directions);
    RUN_TEST(test_derivative_of_unproject);
    RUN_TEST(test_project_refuses_and_leaves_outputs);
    RUN_TEST(test_unproject_refuses_and_leaves_outputs);
    RUN_TEST(test_batches_mark_invalid_items);
    RUN_TEST(test_in_image);
    RUN_TEST(test_check_names_the_field);
    RUN_TEST(test_check_finds_the_first_root_of_the_derivative);
    RUN_TEST(test_check_sees_a_narrow_dip);
    RUN_TEST(test_in_a_tube_a_moving_pupil_is_a_central_camera);
    return UNITY_END();
}
