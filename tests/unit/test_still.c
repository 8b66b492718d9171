/* Proves: a still is one frame for one question; frames that no host takes in one object are refused when asked for,
 * with the reason, and take no memory. Does not prove: how it travels (tests/python/test_stills.py). */
#include "still.h"
#include "unity.h"

#include <string.h>

static pf_still *still;

void setUp(void)
{
    still = NULL;
}

void tearDown(void)
{
    pf_still_close(still);
}

static void test_a_question_gets_the_next_frame_and_another_one_waits(void)
{
    static const uint8_t pixels[6] = {1, 2, 3, 4, 5, 6};
    const pf_msg_raw_frame frame = {.image = {pixels, 3, 2, 3}};
    const uint8_t *bytes, *name;
    size_t n;
    TEST_ASSERT_TRUE(pf_still_open(&still, 3, 2));
    TEST_ASSERT_FALSE(pf_still_take(still, &frame)); /* nobody asked */
    TEST_ASSERT_NULL(pf_still_ask(still));
    TEST_ASSERT_EQUAL_STRING("still: one is under way: try again", pf_still_ask(still));
    TEST_ASSERT_TRUE(pf_still_take(still, &frame));
    TEST_ASSERT_TRUE(pf_still_next(still, &bytes, &n, &name));
    TEST_ASSERT_FALSE(pf_still_next(still, &bytes, &n, &name));
    TEST_ASSERT_NOT_NULL(pf_still_ask(still));
    pf_still_drop(still);
    TEST_ASSERT_NULL(pf_still_ask(still));
}

static void test_frames_that_no_host_takes_are_refused_with_the_reason(void)
{
    TEST_ASSERT_TRUE(pf_still_open(&still, 8192, 4096)); /* 32 MiB of pixels alone */
    TEST_ASSERT_EQUAL_STRING("still: a frame of 8192 x 4096 is larger than the 32 MiB that can be sent at once",
                             pf_still_ask(still));
    TEST_ASSERT_FALSE(pf_still_take(still, &(pf_msg_raw_frame){.image = {NULL, 8192, 4096, 8192}}));
    pf_still_close(still);
    TEST_ASSERT_TRUE(pf_still_open(&still, 8192, 4095));
    TEST_ASSERT_NULL(pf_still_ask(still));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_question_gets_the_next_frame_and_another_one_waits);
    RUN_TEST(test_frames_that_no_host_takes_are_refused_with_the_reason);
    return UNITY_END();
}
