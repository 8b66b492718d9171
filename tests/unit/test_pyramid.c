#include "pipefish/image.h"
#include "unity.h"

#define SIDE 131

static uint8_t frame[SIDE * (SIDE + 5)];
static uint8_t half[SIDE * SIDE], quarter[SIDE * SIDE];
static _Alignas(16) uint8_t block[65536];

void setUp(void) {}
void tearDown(void) {}

static void fill(uint32_t n, uint32_t seed)
{
    for (uint32_t i = 0; i < n; i++) {
        seed = seed * 1664525u + 1013904223u;
        frame[i] = (uint8_t)(seed >> 24);
    }
}

static int mirrored(int i, int n)
{
    while (n > 1 && (i < 0 || i >= n))
        i = i < 0 ? -i : 2 * (n - 1) - i;
    return n > 1 ? i : 0;
}

/* The definition, straight: 25 taps, one rounding. */
static void reference(const uint8_t *from, int w, int h, int stride, uint8_t *to)
{
    static const int tap[5] = {1, 4, 6, 4, 1};
    for (int y = 0; y < (h + 1) / 2; y++)
        for (int x = 0; x < (w + 1) / 2; x++) {
            int sum = 128;
            for (int j = -2; j <= 2; j++)
                for (int i = -2; i <= 2; i++)
                    sum += tap[i + 2] * tap[j + 2] * from[mirrored(2 * y + j, h) * stride + mirrored(2 * x + i, w)];
            to[y * ((w + 1) / 2) + x] = (uint8_t)(sum / 256);
        }
}

static void compare(const pf_image *level, const uint8_t *expected)
{
    for (uint32_t y = 0; y < level->height; y++)
        TEST_ASSERT_EQUAL_UINT8_ARRAY(expected + y * level->width, level->data + (size_t)y * level->stride,
                                      level->width);
}

/* Proves: every level is the mirrored binomial of the one above, for even, odd and tiny sizes and padded rows. */
static void test_levels_equal_the_definition_borders_and_odd_sizes_included(void)
{
    static const uint32_t size[][2] = {{64, 64}, {65, 64}, {64, 67}, {131, 99}, {3, 5}, {2, 2}, {1, 1}, {1, 9}};
    for (uint32_t k = 0; k < sizeof size / sizeof size[0]; k++) {
        const uint32_t w = size[k][0], h = size[k][1], stride = w + (k % 2u) * 5u;
        pf_pyramid p;
        fill(stride * h, k + 1u);
        const size_t need = pf_pyramid_workspace_size(w, h, 3);
        TEST_ASSERT_TRUE(need > 0 && need <= sizeof block);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_pyramid_init(&p, w, h, 3, block, need));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_pyramid_build(&p, &(pf_image){frame, w, h, stride}));
        TEST_ASSERT_EQUAL_PTR(frame, p.level[0].data);
        const int w1 = ((int)w + 1) / 2, h1 = ((int)h + 1) / 2;
        reference(frame, (int)w, (int)h, (int)stride, half);
        reference(half, w1, h1, w1, quarter);
        TEST_ASSERT_EQUAL_UINT32(w1, p.level[1].width);
        TEST_ASSERT_EQUAL_UINT32(h1, p.level[1].height);
        compare(&p.level[1], half);
        compare(&p.level[2], quarter);
    }
}

/* Proves: nothing is written past the size that was asked for. */
static void test_workspace_is_not_overrun(void)
{
    pf_pyramid p;
    const size_t need = pf_pyramid_workspace_size(99, 77, 6);
    for (size_t i = 0; i < 64; i++)
        block[need + i] = 0xA5;
    fill(99 * 77, 3);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_pyramid_init(&p, 99, 77, 6, block, need));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_pyramid_build(&p, &(pf_image){frame, 99, 77, 99}));
    for (size_t i = 0; i < 64; i++)
        TEST_ASSERT_EQUAL_HEX8(0xA5, block[need + i]);
}

/* Proves: each wrong argument is refused with its status. */
static void test_bad_arguments_are_refused(void)
{
    pf_pyramid p;
    TEST_ASSERT_EQUAL_size_t(0, pf_pyramid_workspace_size(0, 64, 3));
    TEST_ASSERT_EQUAL_size_t(0, pf_pyramid_workspace_size(64, 16385, 3));
    TEST_ASSERT_EQUAL_size_t(0, pf_pyramid_workspace_size(64, 64, 0));
    TEST_ASSERT_EQUAL_size_t(0, pf_pyramid_workspace_size(64, 64, 7));
    const size_t need = pf_pyramid_workspace_size(64, 64, 3);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_pyramid_init(&p, 64, 64, 3, NULL, need));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_pyramid_init(&p, 64, 64, 7, block, need));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_pyramid_init(&p, 64, 64, 3, block, need - 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_pyramid_init(&p, 64, 64, 3, block, need));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_pyramid_build(&p, &(pf_image){frame, 63, 64, 64}));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_pyramid_build(&p, &(pf_image){frame, 64, 64, 63}));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_pyramid_build(&p, &(pf_image){NULL, 64, 64, 64}));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_levels_equal_the_definition_borders_and_odd_sizes_included);
    RUN_TEST(test_workspace_is_not_overrun);
    RUN_TEST(test_bad_arguments_are_refused);
    return UNITY_END();
}
