/* Proves: COBS gives the published codes, loses nothing at any length, stays within its bound, never writes a zero, and
 * refuses what is no code. */
#include "pipefish/link.h"
#include "unity.h"

#include <string.h>

void setUp(void) {}
void tearDown(void) {}

static void expect(const uint8_t *bytes, size_t n, const uint8_t *code, size_t n_code)
{
    uint8_t out[1200], back[1200];
    size_t n_back = 0;
    TEST_ASSERT_EQUAL_size_t(n_code, pf_cobs_encode(bytes, n, out));
    TEST_ASSERT_EQUAL_MEMORY(code, out, n_code);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_cobs_decode(out, n_code, back, &n_back));
    TEST_ASSERT_EQUAL_size_t(n, n_back);
    if (n > 0)
        TEST_ASSERT_EQUAL_MEMORY(bytes, back, n);
}
#define EXPECT(bytes, ...)                                                                                             \
    do {                                                                                                               \
        const uint8_t code[] = {__VA_ARGS__};                                                                          \
        expect((const uint8_t *)(bytes), sizeof(bytes) - 1, code, sizeof code);                                        \
    } while (0)

static void test_short_vectors(void)
{
    EXPECT("", 1);
    EXPECT("\0", 1, 1);
    EXPECT("\0\0", 1, 1, 1);
    EXPECT("\x11\x22\0\x33", 3, 0x11, 0x22, 2, 0x33);
    EXPECT("\x11\0\0\0", 2, 0x11, 1, 1, 1);
}

/* 1..254 fills one block exactly; 255 bytes begin another; a zero after a full block is a block of its own. */
static void test_full_blocks(void)
{
    uint8_t bytes[600], code[610];
    for (int i = 0; i < 600; i++)
        bytes[i] = (uint8_t)(i % 254 + 1);
    code[0] = 0xFF;
    memcpy(code + 1, bytes, 254);
    expect(bytes, 254, code, 255);
    code[0] = 0xFE;
    expect(bytes, 253, code, 254);
    code[0] = 0xFF;
    code[255] = 2;
    code[256] = bytes[254];
    expect(bytes, 255, code, 257);
    bytes[254] = 0;
    code[255] = code[256] = 1;
    expect(bytes, 255, code, 257);
    bytes[254] = 1;
    code[255] = 0xFF;
    memcpy(code + 256, bytes + 254, 254);
    expect(bytes, 508, code, 510);
}

/* Encoders that close a full last block with an empty one are understood. */
static void test_full_block_with_an_empty_one_behind_is_accepted(void)
{
    uint8_t code[256], out[256];
    size_t n = 0;
    memset(code, 7, sizeof code);
    code[0] = 0xFF;
    code[255] = 1;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_cobs_decode(code, 256, out, &n));
    TEST_ASSERT_EQUAL_size_t(254, n);
}

static void test_every_length_comes_back_and_holds_the_bound(void)
{
    uint8_t bytes[1100], code[1110], back[1110];
    uint32_t x = 1;
    for (size_t n = 0; n <= sizeof bytes; n++)
        for (uint32_t zeros = 0; zeros < 4; zeros++) { /* none, one in 256, one in 4, most */
            for (size_t i = 0; i < n; i++) {
                x = x * 1664525u + 1013904223u;
                uint8_t b = (uint8_t)(x >> 24);
                bytes[i] = zeros == 0 ? b | 1 : zeros == 1 ? b : zeros == 2 ? (b < 64 ? 0 : b) : (b < 200 ? 0 : b);
            }
            size_t n_code = pf_cobs_encode(bytes, n, code), n_back = 0;
            TEST_ASSERT_TRUE(n_code <= n + n / 254 + 1);
            for (size_t i = 0; i < n_code; i++)
                TEST_ASSERT_TRUE(code[i] != 0);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_cobs_decode(code, n_code, back, &n_back));
            TEST_ASSERT_EQUAL_size_t(n, n_back);
            TEST_ASSERT_TRUE(n == 0 || memcmp(bytes, back, n) == 0);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_cobs_decode(code, n_code, code, &n_back)); /* in place */
            TEST_ASSERT_TRUE(n_back == n && (n == 0 || memcmp(bytes, code, n) == 0));
        }
}

static void test_what_is_no_code_is_refused(void)
{
    uint8_t out[16];
    size_t n;
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_cobs_decode((const uint8_t *)"", 0, out, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_cobs_decode((const uint8_t *)"\0", 1, out, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_cobs_decode((const uint8_t *)"\3\1", 2, out, &n));       /* too short */
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_cobs_decode((const uint8_t *)"\3\0\1", 3, out, &n));     /* zero inside */
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_cobs_decode((const uint8_t *)"\2\1\0\2\1", 5, out, &n)); /* zero as code */
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_short_vectors);
    RUN_TEST(test_full_blocks);
    RUN_TEST(test_full_block_with_an_empty_one_behind_is_accepted);
    RUN_TEST(test_every_length_comes_back_and_holds_the_bound);
    RUN_TEST(test_what_is_no_code_is_refused);
    return UNITY_END();
}
