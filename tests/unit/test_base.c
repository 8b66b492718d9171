#include "pipefish/base.h"
#include "unity.h"

void setUp(void) {}
void tearDown(void) {}

/* Proves: the checksum is CRC-32C as published (RFC 3720 B.4), and can be continued at any split. */
static void test_crc32c_matches_published_vectors(void)
{
    uint8_t buffer[32];
    TEST_ASSERT_EQUAL_HEX32(0xE3069283u, pf_crc32c(0, "123456789", 9));
    for (size_t i = 0; i < 32; i++)
        buffer[i] = 0;
    TEST_ASSERT_EQUAL_HEX32(0x8A9136AAu, pf_crc32c(0, buffer, 32));
    for (size_t i = 0; i < 32; i++)
        buffer[i] = 0xFF;
    TEST_ASSERT_EQUAL_HEX32(0x62A8AB43u, pf_crc32c(0, buffer, 32));
    for (size_t i = 0; i < 32; i++)
        buffer[i] = (uint8_t)i;
    TEST_ASSERT_EQUAL_HEX32(0x46DD794Eu, pf_crc32c(0, buffer, 32));
    for (size_t split = 0; split <= 32; split++)
        TEST_ASSERT_EQUAL_HEX32(0x46DD794Eu, pf_crc32c(pf_crc32c(0, buffer, split), buffer + split, 32 - split));
}

/* Proves: every status has a text of its own. */
static void test_every_status_has_its_own_text(void)
{
    for (int a = PF_ERR_SELF_TEST; a <= PF_OK; a++)
        for (int b = PF_ERR_SELF_TEST; b < a; b++)
            TEST_ASSERT_TRUE(pf_status_text((pf_status)a) != pf_status_text((pf_status)b));
    TEST_ASSERT_EQUAL_STRING("unknown status", pf_status_text((pf_status)-99));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_crc32c_matches_published_vectors);
    RUN_TEST(test_every_status_has_its_own_text);
    return UNITY_END();
}
