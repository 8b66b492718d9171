/* One integer-generated sequence, replayed on every target: the same constant must come out of x86 with and without
 * sanitizers, aarch64 and Cortex-M7. Proves: tracks, covariances, predictions, states and keyframe choices are the same
 * bits everywhere. Does not prove that they are right: the other tests do. */
#include "golden.h"
#include "unity.h"

#define FRAMES 100
#define GOLDEN 0x2952EE21u

void setUp(void) {}
void tearDown(void) {}

static void test_replayed_sequence_has_the_golden_hash(void)
{
    golden g;
    TEST_ASSERT_TRUE(golden_replay(FRAMES, &g));
    TEST_ASSERT_GREATER_THAN_UINT32(FRAMES * 30, g.tracked);
    TEST_ASSERT_GREATER_THAN_UINT32(5, g.keyframes);
    TEST_ASSERT_GREATER_THAN_UINT32(0, g.astray);
    TEST_ASSERT_NOT_EQUAL_UINT32(0, g.flags);
    TEST_ASSERT_EQUAL_HEX32(GOLDEN, g.crc);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_replayed_sequence_has_the_golden_hash);
    return UNITY_END();
}
