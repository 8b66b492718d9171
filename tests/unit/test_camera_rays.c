/* The table of rays against the exact back-projection, which test_camera_fixed has checked against long double. */
#include "fixed_lenses.h"
#include "rays.h"
#include "unity.h"

#include <stdio.h>
#include <stdlib.h>

#define POINTS 10000u

static pf_point_q16 pixels[POINTS];
static pf_ray_q30 rays[POINTS];

void setUp(void) {}
void tearDown(void) {}

typedef struct built {
    void *memory, *table_memory;
    const pf_camera_fixed *fixed;
    const pf_camera_rays *table;
} built;

static built build(const pf_camera *camera, uint32_t step)
{
    built b;
    size_t size = pf_camera_fixed_workspace_size(camera);
    b.memory = malloc(size);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&b.fixed, camera, b.memory, size));
    step = step ? step : pf_camera_rays_step(b.fixed);
    size = pf_camera_rays_workspace_size(b.fixed, step);
    b.table_memory = malloc(size);
    TEST_ASSERT_NOT_NULL(b.table_memory);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_camera_rays_init(&b.table, b.fixed, step, b.table_memory, size - 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_rays_init(&b.table, b.fixed, step, b.table_memory, size));
    return b;
}

static void release(built b)
{
    free(b.memory);
    free(b.table_memory);
}

/* Looks all pixels up and compares with the exact rays: where there is one, and how far off. */
static double worst_error(const built *b, const char *name)
{
    double worst = 0;
    pf_camera_rays_lookup(b->table, POINTS, pixels, rays);
    for (uint32_t i = 0; i < POINTS; i++) {
        pf_ray_q30 exact = {0, 0, 0};
        if (pf_camera_fixed_in_image(b->fixed, pixels[i]))
            (void)pf_camera_fixed_unproject(b->fixed, pixels[i], &exact, NULL);
        TEST_ASSERT_EQUAL_INT_MESSAGE((exact.x | exact.y | exact.z) != 0, (rays[i].x | rays[i].y | rays[i].z) != 0,
                                      name);
        worst = fmax(worst, hypot(hypot(as_unit(rays[i].x) - as_unit(exact.x), as_unit(rays[i].y) - as_unit(exact.y)),
                                  as_unit(rays[i].z) - as_unit(exact.z)));
    }
    return worst;
}

static void scatter(const pf_camera *camera, uint32_t seed)
{
    for (uint32_t i = 0; i < POINTS; i++) {
        pixels[i].x = (int32_t)(((uint64_t)next_random(&seed) * (camera->width + 20) << 16 >> 24)) - (10 << 16);
        pixels[i].y = (int32_t)(((uint64_t)next_random(&seed) * (camera->height + 20) << 16 >> 24)) - (10 << 16);
    }
}

/* Proves: for every lens, all over the image and around it, a ray from the table is within 1e-5 rad of the exact one
 * and there is one exactly where there should be one. */
static void test_rays_are_within_the_stated_error_for_all_lenses(void)
{
    for (size_t l = 0; l < LENSES_COUNT; l++) {
        pf_camera camera = LENSES[l].camera;
        if (camera.width > 640) { /* a quarter of the image, from the axis to a corner, is enough */
            camera.width = 660, camera.height = 420;
            camera.c_u = 20.3, camera.c_v = 19.2;
        }
        if (camera.theta_max < 1e-5)
            continue; /* a tenth of a pixel */
        built b = build(&camera, 0);
        scatter(&camera, (uint32_t)l);
        double worst = worst_error(&b, LENSES[l].name);
        pf_camera_rays_stats stats = pf_camera_rays_count(b.table);
        printf("    %-30s %.2e rad, %u cells, %.1f %% exact\n", LENSES[l].name, worst, (unsigned)stats.cells,
               100.0 * stats.exact / stats.cells);
        TEST_ASSERT_TRUE_MESSAGE(worst <= 1e-5, LENSES[l].name);
        release(b);
    }
}

/* Proves: a step too coarse for the lens costs time, not accuracy. */
static void test_a_coarse_step_is_as_accurate(void)
{
    for (uint32_t step = 8; step <= 64; step *= 2) {
        built b = build(&LENSES[0].camera, step);
        scatter(&LENSES[0].camera, step);
        TEST_ASSERT_TRUE(worst_error(&b, "coarse step") <= 1e-5);
        release(b);
    }
}

/* Proves: at the rim of the image circle, at the sensor's edges and at the rim of the domain the table knows to the
 * last bit what is inside; cells with the circle's rim through them are tabulated. */
static void test_the_mask_is_exact_at_the_rims(void)
{
    pf_camera camera = LENSES[0].camera;
    camera.circle_u = 651.7;
    camera.circle_v = 402.1;
    camera.circle_radius = 398.25;
    built b = build(&camera, 16);
    pf_camera_rays_stats stats = pf_camera_rays_count(b.table);
    TEST_ASSERT_EQUAL_UINT32(0, stats.exact);
    TEST_ASSERT_GREATER_THAN_UINT32(100, stats.rim);
    TEST_ASSERT_GREATER_THAN_UINT32(1900, stats.outside);
    uint32_t state = 9, inside = 0;
    for (uint32_t i = 0; i < POINTS; i++) {
        double phi = next_random(&state) / 2670176.9, way = 398.25 + ((int)(next_random(&state) % 9) - 4) / 65536.0;
        pixels[i] = (pf_point_q16){(int32_t)lrint((651.7 + way * cos(phi)) * 65536),
                                   (int32_t)lrint((402.1 + way * sin(phi)) * 65536)};
        inside += pf_camera_fixed_in_image(b.fixed, pixels[i]);
    }
    TEST_ASSERT_UINT32_WITHIN(POINTS / 4, POINTS / 2, inside);
    TEST_ASSERT_TRUE(worst_error(&b, "circle") <= 1e-5);
    release(b);

    camera = LENSES[0].camera;
    camera.theta_max = 1.1; /* the domain ends within the image */
    b = build(&camera, 16);
    for (uint32_t i = 0; i < POINTS; i++) {
        long double uv[2], phi = next_random(&state) / 2670176.9L;
        true_pixel(&camera, (1.1L + 1e-7L * ((int)(next_random(&state) % 9) - 4)) * cexpl(I * phi), uv);
        pixels[i] = (pf_point_q16){(int32_t)lrintl(uv[0] * 65536), (int32_t)lrintl(uv[1] * 65536)};
    }
    TEST_ASSERT_TRUE(worst_error(&b, "domain") <= 1e-5);
    for (uint32_t i = 0; i < POINTS; i++) {
        int32_t edge = (int32_t)(i / 8 % 5) - 2, along = (int32_t)(next_random(&state) % (790u << 16));
        pixels[i] = i & 1 ? (pf_point_q16){(i & 2 ? -32768 : (1280 << 16) - 32768) + edge, along}
                          : (pf_point_q16){along, (i & 2 ? -32768 : (800 << 16) - 32768) + edge};
    }
    pixels[0] = (pf_point_q16){INT32_MIN, INT32_MIN};
    pixels[1] = (pf_point_q16){INT32_MAX, INT32_MAX};
    TEST_ASSERT_TRUE(worst_error(&b, "edges") <= 1e-5);
    release(b);
}

/* Proves: the vectors give the bits of the portable look-up, with any number left over. */
static void test_vectors_give_the_same_bits(void)
{
    pf_camera camera = LENSES[0].camera;
    camera.circle_u = 640;
    camera.circle_v = 400;
    camera.circle_radius = 390;
    built b = build(&camera, 16);
    scatter(&camera, 77);
    for (int32_t i = 0; i < 4000; i++) /* corners of cells, where s or t is -32768 */
        pixels[i] = (pf_point_q16){(i % 80) * 16 * 65536 - 32768 + i % 7, (i / 80) * 16 * 65536 - 32768 + i % 5};
    for (size_t n = 0; n < POINTS; n = n < 9 ? n + 1 : n * 2 + 1) {
        rays[n] = (pf_ray_q30){-1, -2, -3};
        pf_camera_rays_lookup(b.table, n, pixels, rays);
        TEST_ASSERT_EQUAL_INT32(-1, rays[n].x);
    }
    pf_camera_rays_lookup(b.table, POINTS, pixels, rays);
    for (uint32_t i = 0; i < POINTS; i++) {
        pf_ray_q30 one = pf_camera_rays_at(b.table, pixels[i]);
        TEST_ASSERT_EQUAL_MEMORY(&one, &rays[i], sizeof one);
    }
#ifdef PF_SIMD /* what a processor without wider vectors does */
    static pf_ray_q30 fours[POINTS];
    TEST_ASSERT_GREATER_THAN(POINTS - 4, pf_fixed_lookup_fours(b.table, POINTS, pixels, fours));
    TEST_ASSERT_EQUAL_MEMORY(fours, rays, (POINTS & ~3u) * sizeof *rays);
#endif
    release(b);
}

/* Proves: steps that are no step are refused; the chosen one suits the lens. */
static void test_steps_are_checked(void)
{
    built b = build(&LENSES[0].camera, 16);
    const pf_camera_rays *table;
    TEST_ASSERT_EQUAL_UINT32(8, pf_camera_rays_step(b.fixed)); /* it flattens at the rim */
    static const uint32_t wrong[] = {0, 1, 2, 3, 12, 128, 1u << 31};
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
        TEST_ASSERT_EQUAL_UINT(0, pf_camera_rays_workspace_size(b.fixed, wrong[i]));
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_camera_rays_init(&table, b.fixed, wrong[i], b.table_memory, 1000000));
    }
    release(b);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_rays_are_within_the_stated_error_for_all_lenses);
    RUN_TEST(test_a_coarse_step_is_as_accurate);
    RUN_TEST(test_the_mask_is_exact_at_the_rims);
    RUN_TEST(test_vectors_give_the_same_bits);
    RUN_TEST(test_steps_are_checked);
    return UNITY_END();
}
