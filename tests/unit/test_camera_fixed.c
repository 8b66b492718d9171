/* The fixed-point camera against the model in long double (fixed_lenses.h), at the errors that camera_fixed.h states.
 */
#include "fixed.h"
#include "fixed_lenses.h"
#include "unity.h"

#include <stdio.h>
#include <string.h>

#define POINTS 2500

static _Alignas(16) uint8_t workspace[220000];

void setUp(void) {}
void tearDown(void) {}

static const pf_camera_fixed *build(const lens_case *lens)
{
    const char *why;
    const pf_camera_fixed *fixed = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_check(&lens->camera, &why), lens->name);
    size_t size = pf_camera_fixed_workspace_size(&lens->camera);
    TEST_ASSERT_TRUE_MESSAGE(size > 0 && size <= sizeof workspace, lens->name);
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_fixed_init(&fixed, &lens->camera, workspace, size), lens->name);
    return fixed;
}

/* Angles all over the domain: its rim, the axis and its neighbourhood, knots of tables, and everything between. */
static long double sample_theta(const pf_camera *camera, int i, uint32_t *state)
{
    long double u = next_random(state) / 16777216.0L;
    switch (i % 10) {
    case 0:
        return camera->theta_max;
    case 1:
        return camera->theta_max * (i % 20 == 1 ? 0 : 1e-4L * u);
    case 2:
        return camera->theta_max * (next_random(state) % 129) / 128;
    case 3:
        return camera->theta_max * (1 - 1e-3L * u);
    default:
        return camera->theta_max * u;
    }
}

static pf_ray_q30 ray_of(long double theta, long double phi)
{
    return (pf_ray_q30){(int32_t)lrintl(sinl(theta) * cosl(phi) * 1073741824.0L),
                        (int32_t)lrintl(sinl(theta) * sinl(phi) * 1073741824.0L),
                        (int32_t)lrintl(cosl(theta) * 1073741824.0L)};
}

/* Z of a ray or point as it is, in the units it has. */
static long double complex z_of(long double x, long double y, long double z)
{
    long double rho = hypotl(x, y);
    return rho > 0 ? atan2l(rho, z) * (x + y * I) / rho : 0;
}

/* The largest factor by which the pixel moves with Z, pixels per radian. */
static double largest_magnification(const pf_camera *camera, long double complex z)
{
    long double j[2][2];
    true_jacobian(camera, z, j);
    return (double)sqrtl(j[0][0] * j[0][0] + j[0][1] * j[0][1] + j[1][0] * j[1][0] + j[1][1] * j[1][1]);
}

static double projection_bound(const pf_camera *camera, const pf_camera_fixed *fixed, long double complex z,
                               const long double uv[2])
{
    double way = (double)hypotl(uv[0] - camera->c_u, uv[1] - camera->c_v);
    double r_max = (double)fixed->plane_max / (double)((uint64_t)1 << fixed->plane_q);
    double clear = 1 - (fabs(tan(camera->tilt[0])) + fabs(tan(camera->tilt[1]))) * r_max;
    double extent = r_max / clear * (fmax(camera->f_u, camera->f_v) + fabs(camera->skew));
    return 2.2e-5 + 1e-9 * way + 3.5e-10 * largest_magnification(camera, z) +
           (fixed->channels > 1 || clear < 1 ? 3e-9 * extent / clear : 0);
}

/* Proves: every ray of the domain projects, within the stated error, for all lenses; the rim included. */
static void test_projection_is_within_the_stated_error(void)
{
    for (size_t l = 0; l < LENSES_COUNT; l++) {
        const pf_camera *camera = &LENSES[l].camera;
        const pf_camera_fixed *fixed = build(&LENSES[l]);
        uint32_t state = 1;
        double worst = 0, share = 0;
        for (int i = 0; i < POINTS; i++) {
            long double theta = sample_theta(camera, i, &state), phi = next_random(&state) / 2670176.9L;
            pf_ray_q30 ray = ray_of(theta, phi);
            long double complex z = z_of(ray.x, ray.y, ray.z);
            long double uv[2];
            pf_point_q16 pixel;
            TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_fixed_project(fixed, ray, &pixel), LENSES[l].name);
            if (cabsl(z) > camera->theta_max) /* by rounding of the ray */
                z *= camera->theta_max / cabsl(z);
            true_pixel(camera, z, uv);
            double error = (double)hypotl(as_pixels(pixel.x) - uv[0], as_pixels(pixel.y) - uv[1]);
            worst = fmax(worst, error);
            share = fmax(share, error / projection_bound(camera, fixed, z, uv));
        }
        printf("    %-30s %.2e px, %.2f of the bound\n", LENSES[l].name, worst, share);
        TEST_ASSERT_TRUE_MESSAGE(share <= 1, LENSES[l].name);
        TEST_ASSERT_TRUE_MESSAGE(worst <= 1e-4, LENSES[l].name);
    }
}

static double least_singular_value(long double j[2][2])
{
    long double sum = j[0][0] * j[0][0] + j[0][1] * j[0][1] + j[1][0] * j[1][0] + j[1][1] * j[1][1];
    long double det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
    return (double)sqrtl(fmaxl(0, (sum - sqrtl(fmaxl(0, sum * sum - 4 * det * det))) / 2));
}

/* The least factor by which the plane moves with Z: before the sensor's tilt or behind it, where it is smaller. */
static double least_magnification(const pf_camera *camera, long double complex z)
{
    long double j[2][2];
    pf_camera plain = *camera;
    plain.f_u = plain.f_v = 1;
    plain.skew = plain.c_u = plain.c_v = 0;
    if (camera->tilt[0] != 0 || camera->tilt[1] != 0) {
        plain.tilt[0] = plain.tilt[1] = 0;
        double before = least_magnification(&plain, z);
        plain.tilt[0] = camera->tilt[0];
        plain.tilt[1] = camera->tilt[1];
        true_jacobian(&plain, z, j);
        return fmin(before, least_singular_value(j));
    }
    true_jacobian(&plain, z, j);
    return least_singular_value(j);
}

static double back_projection_bound(const pf_camera *camera, const pf_camera_fixed *fixed, double slope)
{
    const double r_max = (double)fixed->plane_max / (double)((uint64_t)1 << fixed->plane_q);
    const bool plain = fixed->channels == 1 && camera->tilt[0] == 0 && camera->tilt[1] == 0 && camera->skew == 0;
    return 2e-9 + (1e-8 + (plain ? 2.5e-9 : 5e-9) * r_max * (1 + fabs(camera->skew) / camera->f_u)) / slope;
}

/* Proves: the ray of a pixel, taken as exact, is within the stated error, 2e-7 rad where r' >= 0.18; what projection
 * gives comes back, the rim included, and projects again to the same pixel within the projection's error. */
static void test_back_projection_is_within_the_stated_error(void)
{
    for (size_t l = 0; l < LENSES_COUNT; l++) {
        const pf_camera *camera = &LENSES[l].camera;
        const pf_camera_fixed *fixed = build(&LENSES[l]);
        uint32_t state = 2;
        double worst = 0, share = 0;
        for (int i = 0; i < POINTS; i++) {
            long double theta = sample_theta(camera, i, &state), phi = next_random(&state) / 2670176.9L;
            pf_ray_q30 ray = ray_of(theta, phi);
            pf_point_q16 pixel, again;
            TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_fixed_project(fixed, ray, &pixel), LENSES[l].name);
            TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_fixed_unproject(fixed, pixel, &ray, NULL), LENSES[l].name);
            TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_fixed_project(fixed, ray, &again), LENSES[l].name);
            TEST_ASSERT_INT32_WITHIN_MESSAGE(12, pixel.x, again.x, LENSES[l].name);
            TEST_ASSERT_INT32_WITHIN_MESSAGE(12, pixel.y, again.y, LENSES[l].name);
            if (i % 10 == 0 || theta < 1e-3L * camera->theta_max)
                continue; /* at the rim the pixel may lie beyond the domain; the axis is a kink of D */

            long double uv[2] = {as_pixels(pixel.x), as_pixels(pixel.y)};
            long double complex z = true_inverse(camera, uv, theta * cexpl(I * phi));
            long double at = cabsl(z), scale = sinl(at) / at;
            double error =
                (double)hypotl(hypotl(as_unit(ray.x) - scale * creall(z), as_unit(ray.y) - scale * cimagl(z)),
                               as_unit(ray.z) - cosl(at));
            double slope = least_magnification(camera, z), bound = back_projection_bound(camera, fixed, slope);
            if (at > camera->theta_max)
                continue;
            if (slope >=
                0.18) { /* none of these lenses reaches beyond r_max = 5, but the one to 85 degrees, of r' >= 1 */
                TEST_ASSERT_TRUE_MESSAGE(error <= 2e-7, LENSES[l].name);
                worst = fmax(worst, error);
            }
            share = fmax(share, error / bound);
        }
        printf("    %-30s %.2e rad, %.2f of the bound\n", LENSES[l].name, worst, share);
        TEST_ASSERT_TRUE_MESSAGE(share <= 1, LENSES[l].name);
    }
}

static void print_camera(const char *what, double share, const pf_camera *c, double theta)
{
    printf("    %s %.2f: radial %u f %g %g skew %g tilt %g %g theta %g of %g asymmetry %g %g cpoly %g mirror %g\n",
           what, share, c->radial, c->f_u, c->f_v, c->skew, c->tilt[0], c->tilt[1], theta, c->theta_max,
           c->asym_radial_theta[0], c->asym_tangential_theta[0], c->cpoly[0], c->mirror);
}

/* Proves: whatever camera is accepted, over all the legal ranges, keeps the stated errors in both directions, and what
 * it projects comes back. */
static void test_random_cameras_keep_the_stated_errors(void)
{
    enum { CAMERAS = 4000, RAYS = 24 };
    uint32_t state = 8, built = 0, legal = 0, refused = 0, n_tilted = 0, n_narrow = 0;
    double projection = 0, back = 0;
    for (int l = 0; l < CAMERAS; l++) {
        pf_camera camera = random_camera(&state);
        const pf_camera_fixed *fixed;
        if (pf_camera_check(&camera, NULL) != PF_OK)
            continue;
        legal++;
        if (pf_camera_fixed_init(&fixed, &camera, workspace, sizeof workspace) != PF_OK)
            continue;
        built++;
        n_tilted += fabs(camera.tilt[0]) + fabs(camera.tilt[1]) > .1;
        n_narrow += fmax(camera.f_u, camera.f_v) > 8 * fmin(camera.f_u, camera.f_v);
        for (int i = 0; i < RAYS; i++) {
            long double theta = sample_theta(&camera, i, &state), phi = next_random(&state) / 2670176.9L, uv[2];
            pf_ray_q30 ray = ray_of(theta, phi);
            pf_point_q16 pixel;
            long double complex z = z_of(ray.x, ray.y, ray.z);
            if (cabsl(z) > camera.theta_max)
                z *= camera.theta_max / cabsl(z);
            true_pixel(&camera, z, uv);
            if (fabsl(uv[0]) > 32767 || fabsl(uv[1]) > 32767)
                continue;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project(fixed, ray, &pixel));
            double error = (double)hypotl(as_pixels(pixel.x) - uv[0], as_pixels(pixel.y) - uv[1]),
                   share = error / projection_bound(&camera, fixed, z, uv);
            if (share > projection)
                print_camera("projection", share, &camera, (double)theta), projection = share;
            if (pf_camera_fixed_unproject(fixed, pixel, &ray, NULL) != PF_OK) {
                if (least_magnification(&camera, z) >= 1e-3 && refused++ < 5)
                    print_camera("refused", 0, &camera, (double)theta);
                continue;
            }
            if (i % 10 == 0 || theta < 1e-3L * camera.theta_max)
                continue;
            uv[0] = as_pixels(pixel.x), uv[1] = as_pixels(pixel.y);
            z = true_inverse(&camera, uv, z);
            long double at = cabsl(z), scale = sinl(at) / at;
            long double again[2];
            true_pixel(&camera, z, again);
            if (!(at <= camera.theta_max && hypotl(again[0] - uv[0], again[1] - uv[1]) < 1e-9L))
                continue; /* the pixel was rounded out of the domain, or so coarsely that Newton is lost */
            error = (double)hypotl(hypotl(as_unit(ray.x) - scale * creall(z), as_unit(ray.y) - scale * cimagl(z)),
                                   as_unit(ray.z) - cosl(at));
            double slope = least_magnification(&camera, z);
            share = error / back_projection_bound(&camera, fixed, slope);
            if (share > back)
                print_camera("back-projection", share, &camera, (double)theta), back = share;
        }
    }
    printf("    %u built of %u legal, %u tilted, %u with aspects above 8; %u refused; %.2f and %.2f of the bounds\n",
           built, legal, n_tilted, n_narrow, refused, projection, back);
    TEST_ASSERT_TRUE(projection <= 1);
    TEST_ASSERT_TRUE(back <= 1);
    TEST_ASSERT_EQUAL_UINT32(0, refused);
    TEST_ASSERT_GREATER_THAN_UINT32(300, n_tilted);
    TEST_ASSERT_GREATER_THAN_UINT32(300, n_narrow);
}

/* Proves: with a shifted pupil, points at all distances and scales project as the model says, and the origin of the
 * back-projected ray is e1 theta^2. */
static void test_points_of_a_shifted_pupil(void)
{
    for (size_t l = 0; l < LENSES_COUNT; l++) {
        const pf_camera *camera = &LENSES[l].camera;
        if (camera->pupil_e1 == 0)
            continue;
        const pf_camera_fixed *fixed = build(&LENSES[l]);
        uint32_t state = 3;
        for (int i = 0; i < POINTS; i++) {
            long double theta = sample_theta(camera, i * 10 + 4 + i % 6, &state),
                        phi = next_random(&state) / 2670176.9L;
            long double distance = 0.04L * powl(25, next_random(&state) / 16777216.0L);
            uint32_t bits = 20 + (uint32_t)i % 9;
            long double scale = (long double)(1 << bits), origin = camera->pupil_e1 * theta * theta;
            int32_t xyz[3] = {(int32_t)lrintl(scale * distance * sinl(theta) * cosl(phi)),
                              (int32_t)lrintl(scale * distance * sinl(theta) * sinl(phi)),
                              (int32_t)lrintl(scale * (distance * cosl(theta) + origin))};
            for (int k = 0; k < 30;
                 k++) { /* the rounded point's theta; converges, the pupil moves less than the point */
                long double complex z = z_of(xyz[0], xyz[1], xyz[2] - scale * camera->pupil_e1 * theta * theta);
                theta = cabsl(z);
                phi = cargl(z);
            }
            long double uv[2];
            pf_point_q16 pixel;
            if (theta > camera->theta_max)
                continue;
            true_pixel(camera, theta * cexpl(I * phi), uv);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project_point(fixed, xyz, bits, &pixel));
            TEST_ASSERT_TRUE(hypotl(as_pixels(pixel.x) - uv[0], as_pixels(pixel.y) - uv[1]) <=
                             projection_bound(camera, fixed, theta * cexpl(I * phi), uv));
            pf_ray_q30 ray;
            int32_t origin_q27;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_unproject(fixed, pixel, &ray, &origin_q27));
            TEST_ASSERT_DOUBLE_WITHIN(8e-9, (double)(camera->pupil_e1 * theta * theta), origin_q27 / 134217728.0);
        }
        const int32_t near[3] = {1 << 12, 1 << 12, 1 << 12}, far[3] = {1 << 26, 1 << 26, 1 << 26};
        pf_point_q16 pixel;
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_fixed_project_point(fixed, near, 20, &pixel));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project_point(fixed, far, 20, &pixel));
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_fixed_project_point(fixed, near, 30, &pixel));
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_camera_fixed_project_point(fixed, far, 31, &pixel));
    }
}

/* Proves: a central camera projects a point as the ray through it, at any scale, down to one unit. */
static void test_a_central_camera_does_not_mind_the_scale(void)
{
    const pf_camera_fixed *fixed = build(&LENSES[0]);
    const int32_t point[3] = {3, -2, 1};
    pf_point_q16 first, pixel;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project_point(fixed, point, 0, &first));
    for (int32_t scale = 2; scale < 1 << 28; scale *= 3) {
        const int32_t more[3] = {3 * scale, -2 * scale, scale};
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project_point(fixed, more, 17, &pixel));
        TEST_ASSERT_INT32_WITHIN(1, first.x, pixel.x);
        TEST_ASSERT_INT32_WITHIN(1, first.y, pixel.y);
    }
    const int32_t extreme[3] = {INT32_MIN, INT32_MIN, INT32_MAX};
    long double uv[2];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project_point(fixed, extreme, 0, &pixel));
    true_pixel(&LENSES[0].camera, z_of(-1, -1, 1), uv);
    TEST_ASSERT_DOUBLE_WITHIN(3e-5, (double)uv[0], as_pixels(pixel.x));
    TEST_ASSERT_DOUBLE_WITHIN(3e-5, (double)uv[1], as_pixels(pixel.y));
}

/* Proves: what lies outside the model is refused with the outputs untouched: beyond theta_max, straight behind, no
 * direction, pixels outside the domain's image, pixels that Q16.16 cannot hold. */
static void test_outside_the_domain_is_refused(void)
{
    for (size_t l = 0; l < LENSES_COUNT; l++) {
        const pf_camera *camera = &LENSES[l].camera;
        const pf_camera_fixed *fixed = build(&LENSES[l]);
        const pf_point_q16 mark = {11, 12};
        pf_point_q16 pixel = mark;
        pf_ray_q30 ray = {7, 7, 7};
        for (int i = 0; i < 24; i++) {
            long double phi = i * 0.2618L, uv[2], beyond = camera->theta_max + fmaxl(6e-9L, 1e-7L * camera->theta_max);
            TEST_ASSERT_EQUAL_INT_MESSAGE(
                PF_ERR_DOMAIN, pf_camera_fixed_project(fixed, ray_of(fminl(beyond, 3.1415926L), phi), &pixel),
                LENSES[l].name);
            true_pixel(camera, camera->theta_max * cexpl(I * phi), uv);
            long double du = uv[0] - camera->c_u, dv = uv[1] - camera->c_v, out = 1 + 2e-4L / hypotl(du, dv);
            if (hypotl(du, dv) * 1.1L > 32000 - fabs(camera->c_u))
                continue;
            pf_point_q16 outside = {(int32_t)lrintl((camera->c_u + du * (out + 1e-7L)) * 65536),
                                    (int32_t)lrintl((camera->c_v + dv * (out + 1e-7L)) * 65536)};
            TEST_ASSERT_EQUAL_INT_MESSAGE(PF_ERR_DOMAIN, pf_camera_fixed_unproject(fixed, outside, &ray, NULL),
                                          LENSES[l].name);
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_fixed_project(fixed, (pf_ray_q30){0, 0, -1073741824}, &pixel));
        TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_fixed_project(fixed, (pf_ray_q30){0, 0, 0}, &pixel));
        for (int32_t x = -1; x <= 1; x += 2)
            for (int32_t y = -1; y <= 1; y++)
                TEST_ASSERT_EQUAL_INT(
                    PF_ERR_DOMAIN,
                    pf_camera_fixed_unproject(fixed, (pf_point_q16){x * INT32_MAX, y * INT32_MAX}, &ray, NULL));
        TEST_ASSERT_EQUAL_MEMORY(&mark, &pixel, sizeof mark);
        TEST_ASSERT_EQUAL_INT32(7, ray.z);
    }
    lens_case shifted = {"principal point far outside", {P9, .theta_max = 1.92}};
    shifted.camera.c_u = 32500;
    const pf_camera_fixed *fixed = build(&shifted);
    pf_point_q16 pixel;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_project(fixed, ray_of(0.5L, 0), &pixel));
    TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_camera_fixed_project(fixed, ray_of(1.0L, 0), &pixel));
}

/* Proves: cameras that fixed point cannot hold to its promise are refused when built, and short workspaces too. */
static void test_what_cannot_be_kept_is_refused_when_built(void)
{
    const lens_case refused[] = {
        {"perspective to 89.99 degrees", {F300, .radial = PF_RADIAL_PERSPECTIVE, .theta_max = 1.5706}},
        {"40000 px from the principal point", {SENSOR, .f_u = 30000, .f_v = 30000, .theta_max = 1.4}},
        {"tilt that magnifies tenfold", {F300, .tilt = {.44, 0}, .theta_max = 1.92}},
        {"tilt that magnifies fivefold", {F300, .tilt = {.35, 0}, .theta_max = 2.2}},
        {"image circle of 40000 px", {F300, .theta_max = 1.5, .circle_radius = 40000}},
    };
    const pf_camera_fixed *fixed = NULL;
    for (size_t i = 0; i < sizeof refused / sizeof refused[0]; i++) {
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_camera_check(&refused[i].camera, NULL), refused[i].name);
        TEST_ASSERT_EQUAL_UINT_MESSAGE(0, pf_camera_fixed_workspace_size(&refused[i].camera), refused[i].name);
        TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED,
                              pf_camera_fixed_init(&fixed, &refused[i].camera, workspace, sizeof workspace));
    }
    size_t size = pf_camera_fixed_workspace_size(&LENSES[0].camera);
    TEST_ASSERT_LESS_THAN_UINT32(2048, size);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_camera_fixed_init(&fixed, &LENSES[0].camera, workspace, size - 1));
    TEST_ASSERT_NULL(fixed);
}

/* Proves: the image's edges and the circle's rim are where pf_camera_in_image has them, to the last bit. */
static void test_in_image_agrees_with_the_double_camera_at_the_rims(void)
{
    lens_case lens = {"circle",
                      {P9, .theta_max = 1.92, .circle_u = 630.25, .circle_v = 411.5, .circle_radius = 395.125}};
    const pf_camera_fixed *fixed = build(&lens);
    uint32_t state = 4, inside = 0, n = 200000;
    for (uint32_t i = 0; i < n; i++) {
        double phi = next_random(&state) / 2670176.9,
               way = 395.125 + (i % 3 ? (next_random(&state) % 9 - 4.) / 65536 : 0);
        pf_point_q16 pixel = {(int32_t)lrint((630.25 + way * cos(phi)) * 65536),
                              (int32_t)lrint((411.5 + way * sin(phi)) * 65536)};
        if (i % 4 == 0)
            pixel.y = i % 8 ? -32768 - (int32_t)(i % 3) + 1 : (800 << 16) - 32768 + (int32_t)(i % 3) - 1;
        const double uv[2] = {as_pixels(pixel.x), as_pixels(pixel.y)};
        bool expected = pf_camera_in_image(&lens.camera, uv);
        TEST_ASSERT_EQUAL_INT(expected, pf_camera_fixed_in_image(fixed, pixel));
        inside += expected;
    }
    TEST_ASSERT_UINT32_WITHIN(n / 4, n / 2, inside);
}

/* Proves: an image circle of less than Q16.16 can tell is a point, not the whole image. */
static void test_the_smallest_image_circle_is_not_the_whole_image(void)
{
    lens_case lens = {"circle", {P9, .theta_max = 1.92, .circle_u = 630.25, .circle_v = 411.5, .circle_radius = 1e-6}};
    const pf_camera_fixed *fixed = build(&lens);
    const int32_t u = 630 * 65536 + 16384, v = 411 * 65536 + 32768;
    TEST_ASSERT_TRUE(pf_camera_fixed_in_image(fixed, (pf_point_q16){u, v}));
    TEST_ASSERT_FALSE(pf_camera_fixed_in_image(fixed, (pf_point_q16){u + 1, v}));
    TEST_ASSERT_FALSE(pf_camera_fixed_in_image(fixed, (pf_point_q16){100 * 65536, 100 * 65536}));
}

/* Proves: square root, angle, sine and cosine within what fixed.h states, at all magnitudes. */
static void test_elementary_functions(void)
{
    uint32_t state = 5;
    for (int i = 0; i < 200000; i++) {
        int64_t x = (int64_t)(next_random(&state) << 7) >> (i % 31),
                y = (int64_t)(next_random(&state) << 7) >> (i % 29);
        x = i & 1 ? -x : x;
        polar p = pf_fixed_polar(x, y);
        long double length = hypotl(x, y);
        if (length == 0)
            continue;
        TEST_ASSERT_TRUE(fabsl(ldexpl(p.root, -(int)p.half) / length - 1) <= 1e-9L);
        TEST_ASSERT_TRUE(fabsl(p.c / 1073741824.0L - x / length) <= 1.2e-9L);
        TEST_ASSERT_TRUE(fabsl(p.s / 1073741824.0L - y / length) <= 1.2e-9L);
        uint64_t rho = (uint64_t)y << 16;
        TEST_ASSERT_TRUE(fabsl(pf_fixed_angle(rho, x) / 4294967296.0L - atan2l(rho, x)) <= 6e-10L);

        uint64_t theta = (uint64_t)(i == 0 ? PI_Q32 : next_random(&state) * (uint64_t)PI_Q32 >> 24);
        int32_t sine, cosine;
        pf_fixed_sine_cosine(theta, &sine, &cosine);
        TEST_ASSERT_TRUE(fabsl(sine / 1073741824.0L - sinl(theta / 4294967296.0L)) <= 9e-10L);
        TEST_ASSERT_TRUE(fabsl(cosine / 1073741824.0L - cosl(theta / 4294967296.0L)) <= 9e-10L);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_projection_is_within_the_stated_error);
    RUN_TEST(test_back_projection_is_within_the_stated_error);
    RUN_TEST(test_random_cameras_keep_the_stated_errors);
    RUN_TEST(test_points_of_a_shifted_pupil);
    RUN_TEST(test_a_central_camera_does_not_mind_the_scale);
    RUN_TEST(test_outside_the_domain_is_refused);
    RUN_TEST(test_what_cannot_be_kept_is_refused_when_built);
    RUN_TEST(test_in_image_agrees_with_the_double_camera_at_the_rims);
    RUN_TEST(test_the_smallest_image_circle_is_not_the_whole_image);
    RUN_TEST(test_elementary_functions);
    return UNITY_END();
}
