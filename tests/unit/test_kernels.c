/* Proves: the vector kernels give the bits of the portable ones, for every window, random inputs and the extremes (all
 * black, all white, checkered, black beside white, random masks).
 * Where there are no vectors it proves only that samples stay within their bounds. Does not prove that they are right:
 * test_track does. */
#include <stdbool.h>
#include <string.h>

#include "../../lib/track/kernels.h"
#include "unity.h"

#define SIDE  96
#define GUARD 0x5A5A

typedef struct results {
    int16_t out[5][PATCH_MAX];
    pf_template_sums template;
    pf_step_sums step;
    pf_affine_sums affine;
    pf_normal_sums normal;
} results;

static uint8_t image[SIDE * SIDE];
static int16_t mask[PATCH_MAX], in[5][PATCH_MAX];
static results got[2];
static uint32_t state;

void setUp(void)
{
    state = 1;
}
void tearDown(void) {}

static uint32_t next_random(void)
{
    state = state * 1664525u + 1013904223u;
    return state >> 16;
}

/* Kinds of picture, the worst that the sums must hold included. */
static void fill(uint32_t kind)
{
    for (uint32_t y = 0; y < SIDE; y++)
        for (uint32_t x = 0; x < SIDE; x++) {
            const uint32_t r = next_random();
            const uint32_t v[7] = {r & 255u,
                                   (r & 1u) * 255u,
                                   0,
                                   255,
                                   ((x / 2u + y / 2u) & 1u) * 255u,
                                   (x > SIDE / 2u) * 255u,
                                   ((x / 2u) & 1u) * 255u};
            image[y * SIDE + x] = (uint8_t)v[kind % 7u];
        }
}

static void fill_mask(int32_t window, int32_t groups, bool whole)
{
    for (int32_t k = 0; k < PATCH_MAX; k++)
        mask[k] = (int16_t) - (k % PATCH_ROW < window && (whole || next_random() % 4u != 0));
    for (int32_t k = 0; k < PATCH_MAX; k++)
        if (k % PATCH_ROW >= 8 * groups)
            mask[k] = GUARD; /* must not be read */
}

/* Compares what was written, and that nothing else was. */
static void compare(const char *what, uint32_t arrays)
{
    for (uint32_t k = 0; k < arrays; k++)
        TEST_ASSERT_EQUAL_INT16_ARRAY_MESSAGE(got[0].out[k], got[1].out[k], PATCH_MAX, what);
    TEST_ASSERT_EQUAL_MEMORY_MESSAGE(&got[0].template, &got[1].template, sizeof got[0].template, what);
    TEST_ASSERT_EQUAL_MEMORY_MESSAGE(&got[0].step, &got[1].step, sizeof got[0].step, what);
    TEST_ASSERT_EQUAL_MEMORY_MESSAGE(&got[0].normal, &got[1].normal, sizeof got[0].normal, what);
    TEST_ASSERT_EQUAL_MEMORY_MESSAGE(&got[0].affine, &got[1].affine, sizeof got[0].affine, what);
}

static void clear(void)
{
    memset(got, 0, sizeof got);
    for (uint32_t s = 0; s < 2; s++)
        for (uint32_t k = 0; k < 5; k++)
            for (uint32_t i = 0; i < PATCH_MAX; i++)
                got[s].out[k][i] = GUARD;
}

/* Calls a kernel of both sets; `r` is where its results go. */
#define BOTH(name, ...)                                                                                                \
    do {                                                                                                               \
        results *r = &got[0];                                                                                          \
        pf_c_##name(__VA_ARGS__);                                                                                      \
        r = &got[1];                                                                                                   \
        PF_KERNEL(name)(__VA_ARGS__);                                                                                  \
    } while (0)

static int16_t fraction(void)
{
    const uint32_t r = next_random();
    return (int16_t)(r % 8u == 0 ? 0 : r % 8u == 1 ? 32767 : r & 32767u);
}

static void test_translation_kernels_are_the_same_bits(void)
{
    for (int32_t window = 7; window <= WINDOW_MAX; window += 2)
        for (uint32_t kind = 0; kind < 28; kind++) {
            const int32_t groups = (window + 7) / 8, wide = (window + 9) / 8;
            fill(kind);
            fill_mask(window, groups, kind % 2u);
            const pf_spot spot = {image + next_random() % 40u * SIDE + next_random() % 40u, SIDE, fraction(),
                                  fraction()};
            clear();
            BOTH(sample, &spot, window + 2, wide, r->out[0]);
            compare("sample", 1);
            memcpy(in[0], got[0].out[0], sizeof in[0]);
            for (int32_t i = 0; i < window * PATCH_ROW; i++)
                TEST_ASSERT_TRUE(i % PATCH_ROW >= 8 * wide || (in[0][i] >= -2040 && in[0][i] <= 2040));
            clear();
            BOTH(template, in[0], mask, window, groups, r->out[0], r->out[1], r->out[2], &r->template);
            compare("template", 3);
            memcpy(in[1], got[0].out[0], sizeof in[1]);
            memcpy(in[2], got[0].out[1], sizeof in[2]);
            memcpy(in[3], got[0].out[2], sizeof in[3]);
            fill(kind / 7u);
            clear();
            BOTH(step, &spot, mask, window, groups, in[1], in[2], in[3], &r->step);
            compare("step", 0);
        }
}

static void test_affine_kernels_are_the_same_bits(void)
{
    for (int32_t window = 7; window <= WINDOW_MAX; window += 2)
        for (uint32_t kind = 0; kind < 28; kind++) {
            const int32_t groups = (window + 7) / 8;
            fill(kind);
            fill_mask(window, groups, kind % 2u);
            const int16_t smooth[2] = {(int16_t)(next_random() % 4097u), (int16_t)(kind % 3u * 2048u)};
            for (uint32_t i = 0; i < 2; i++) {
                clear();
                BOTH(unpack, image + i, mask, window, groups,
                     &(pf_gradients){r->out[0], r->out[1], r->out[2], r->out[3], r->out[4], {smooth[0], smooth[1]}});
                compare("unpack", 5);
            }
            for (uint32_t k = 0; k < 5; k++)
                memcpy(in[k], got[0].out[k], sizeof in[k]);
            const int32_t most = ((1 << 24) - (1 << 12)) / (3 * (window / 2) * (window / 2)); /* of pf_bow_between */
            int32_t bow[6];
            for (uint32_t k = 0; k < 6; k++)
                bow[k] = kind % 4u == 0   ? most
                         : kind % 4u == 1 ? -most
                                          : (int32_t)(next_random() % 512u) * most / 256 - most;
            clear();
            memcpy(got[0].out[0], in[0], sizeof in[0]);
            memcpy(got[1].out[0], in[0], sizeof in[0]);
            BOTH(bend, bow, window, groups, &(pf_gradients){r->out[0], in[1], in[2], in[3], in[4], {0, 0}});
            compare("bend", 1);
            for (int32_t i = 0; i < window * PATCH_ROW; i++)
                TEST_ASSERT_TRUE(i % PATCH_ROW >= 8 * groups ||
                                 (got[0].out[0][i] >= -2040 && got[0].out[0][i] <= 2040));
            fill(kind / 7u);
            /* near identity, as tracks are; and now and then whatever */
            const uint32_t range = kind % 5u == 0 ? 60000u : 18000u;
            int32_t a[4];
            for (uint32_t k = 0; k < 4; k++)
                a[k] = (int32_t)(next_random() % range) - (int32_t)(range / 2u) + (k % 3u == 0 ? 65536 : 0);
            const int32_t spare = 22 << 16;
            const pf_warp warp = {image,
                                  SIDE,
                                  SIDE,
                                  SIDE,
                                  (SIDE << 15) + (int32_t)(next_random() * 40u) % spare - spare / 2,
                                  (SIDE << 15) + (int32_t)(next_random() * 40u) % spare - spare / 2,
                                  {a[0], a[1], a[2], a[3]}};
            clear();
            BOTH(warp, &warp, mask, window, groups, r->out[0]);
            compare("warp", 1);
            clear();
            const pf_gradients g = {in[0], in[1], in[2], in[3], in[4], {0, 0}};
            memcpy(got[1].out[0], in[0], sizeof in[0]);
            BOTH(affine, kind % 3u ? in[0] : in[1], &g, window, groups, &r->affine);
            BOTH(normal, &g, window, groups, &r->normal);
            compare("affine", 0);
            int8_t relief[31 * 32];
            for (uint32_t i = 0; i < sizeof relief; i++)
                relief[i] = (int8_t)(kind % 2u ? (int32_t)(next_random() % 255u) - 127 : 127);
            const int16_t *c = kind % 3u ? in[0] : in[1];
            TEST_ASSERT_EQUAL_INT64(pf_c_relief(relief, c, window, groups),
                                    PF_KERNEL(relief)(relief, c, window, groups));
        }
}

static void test_corner_kernels_are_the_same_bits(void)
{
    static pf_tensor_row row[2][3], sum[2];
    for (int32_t n = 1; n <= 70; n++)
        for (uint32_t kind = 0; kind < 7; kind++) {
            const pf_tensor_row *const rows[2][3] = {{&row[0][0], &row[0][1], &row[0][2]},
                                                     {&row[1][0], &row[1][1], &row[1][2]}};
            int32_t bound[2];
            fill(kind);
            memset(row, 0, sizeof row);
            memset(sum, 0, sizeof sum);
            for (uint32_t j = 0; j < 3; j++)
                for (uint32_t s = 0; s < 2; s++)
                    (s ? PF_KERNEL(tensor) : pf_c_tensor)(image + (j + 5) * SIDE + 3, SIDE, n + 2, &row[s][j]);
            TEST_ASSERT_EQUAL_MEMORY(row[0], row[1], sizeof row[0]);
            for (uint32_t s = 0; s < 2; s++)
                bound[s] = (s ? PF_KERNEL(corners) : pf_c_corners)(rows[s], n, &sum[s]);
            TEST_ASSERT_EQUAL_MEMORY(&sum[0], &sum[1], sizeof sum[0]);
            TEST_ASSERT_EQUAL_INT32(bound[0], bound[1]);
        }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_translation_kernels_are_the_same_bits);
    RUN_TEST(test_affine_kernels_are_the_same_bits);
    RUN_TEST(test_corner_kernels_are_the_same_bits);
    return UNITY_END();
}
