#include "survey.h"
#include "unity.h"

#include <stdio.h>
#include <string.h>

/* A spool that holds one value. */
static uint8_t kept[PF_SURVEY_BYTES + 1];
static size_t kept_n;
static pf_survey survey, before;
static const uint8_t setup[32] = {1, 2, 3}, other_setup[32] = {1, 2, 4};
static char error[512];

static pf_status get(void *self, const char *key, void *bytes, size_t capacity, size_t *n)
{
    (void)self;
    TEST_ASSERT_EQUAL_STRING(PF_SURVEY_KEY, key);
    if (kept_n > capacity)
        return PF_ERR_SPACE;
    if (kept_n == 0)
        return PF_ERR_END;
    memcpy(bytes, kept, kept_n);
    *n = kept_n;
    return PF_OK;
}

static const pf_spool_ops ops = {.get = get};
static const pf_spool spool = {NULL, &ops};

void setUp(void)
{
    memset(&survey, 0, sizeof survey);
    memcpy(survey.setup, setup, sizeof setup);
    survey.boots = 1;
    kept_n = 0;
}

void tearDown(void) {}

static void keep(const pf_survey *s)
{
    kept_n = pf_survey_pack(s, kept);
    TEST_ASSERT_TRUE(kept_n <= PF_SURVEY_BYTES);
}

static void reopen(void)
{
    keep(&survey);
    TEST_ASSERT_TRUE_MESSAGE(pf_survey_open(&survey, &before, &spool, setup, error, sizeof error), error);
    TEST_ASSERT_TRUE(survey.is_resumed);
    TEST_ASSERT_EQUAL_UINT32(0, before.boots);
}

static bool is_listed(uint32_t index)
{
    for (uint32_t i = 0; i < survey.lost_ranges; i++)
        if (index >= survey.lost_first[i] && index - survey.lost_first[i] < survey.lost_count[i])
            return true;
    return false;
}

static void check_ascending(void)
{
    for (uint32_t i = 0; i + 1 < survey.lost_ranges; i++)
        TEST_ASSERT_TRUE(survey.lost_first[i] + survey.lost_count[i] < survey.lost_first[i + 1]);
}

/* Proves: losses in any order become the fewest ranges, and none is forgotten or made up. */
static void test_losses_become_ranges(void)
{
    static const uint32_t order[] = {7, 3, 5, 4, 4, 9, 0, 8, 1, 20, 6};
    for (size_t i = 0; i < sizeof order / sizeof order[0]; i++) {
        pf_survey_lose(&survey, order[i]);
        check_ascending();
    }
    TEST_ASSERT_EQUAL_UINT32(3, survey.lost_ranges);
    for (uint32_t i = 0; i < 22; i++)
        TEST_ASSERT_EQUAL(i != 2 && i < 10 ? true : i == 20, is_listed(i));
}

/* Proves: a hundred thousand losses in a row cost one range, and every second keyframe of a long survey may be lost:
 * the list still covers all of them, or the host would wait for ever. */
static void test_no_number_of_losses_is_too_large(void)
{
    for (uint32_t i = 0; i < 100000; i++)
        pf_survey_lose(&survey, i);
    TEST_ASSERT_EQUAL_UINT32(1, survey.lost_ranges);
    for (uint32_t i = 100002; i < 106000; i += 2)
        pf_survey_lose(&survey, i);
    TEST_ASSERT_EQUAL_UINT32(PF_SURVEY_LOST_MAX, survey.lost_ranges);
    check_ascending();
    for (uint32_t i = 100002; i < 106000; i += 2)
        TEST_ASSERT_TRUE(is_listed(i));
    TEST_ASSERT_FALSE(is_listed(105997)); /* the newest ranges are exact */
}

/* Proves: what the spool keeps comes back, without losses whose numbers the next boot uses again. */
static void test_losses_to_come_are_not_kept(void)
{
    memset(survey.id, 0xA5, sizeof survey.id);
    for (uint32_t i = 2; i < 5; i++)
        pf_survey_lose(&survey, i);
    for (uint32_t i = 8; i < 12; i++)
        pf_survey_lose(&survey, i);
    pf_survey_lose(&survey, 14);
    survey.next_index = 10;
    reopen();
    TEST_ASSERT_EQUAL_HEX8(0xA5, survey.id[15]);
    TEST_ASSERT_EQUAL_UINT32(2, survey.boots);
    TEST_ASSERT_EQUAL_UINT32(10, survey.next_index);
    TEST_ASSERT_EQUAL_UINT32(2, survey.lost_ranges);
    for (uint32_t i = 0; i < 20; i++)
        TEST_ASSERT_EQUAL((i >= 2 && i < 5) || i == 8 || i == 9, is_listed(i));
}

static void expect_a_new_survey(void)
{
    static pf_survey last;
    last = survey;
    TEST_ASSERT_TRUE_MESSAGE(pf_survey_open(&survey, &before, &spool, setup, error, sizeof error), error);
    TEST_ASSERT_FALSE(survey.is_resumed);
    TEST_ASSERT_EQUAL_UINT32(1, survey.boots);
    TEST_ASSERT_EQUAL_UINT32(0, survey.next_index);
    TEST_ASSERT_EQUAL_UINT32(0, survey.lost_ranges);
    TEST_ASSERT_EQUAL_UINT32(0, before.boots);
    TEST_ASSERT_TRUE(memcmp(survey.id, last.id, 16) != 0);
    TEST_ASSERT_EQUAL_MEMORY(setup, survey.setup, 32);
}

/* Proves: a full list fits where the spool's value is read to; with a value of another version or length, which the
 * medium may have damaged and nobody in a pipe can repair, another survey begins. */
static void test_a_full_list_and_a_foreign_value(void)
{
    for (uint32_t i = 0; i < 3 * PF_SURVEY_LOST_MAX; i += 2)
        pf_survey_lose(&survey, i);
    survey.next_index = UINT32_MAX;
    reopen();
    TEST_ASSERT_EQUAL_UINT32(PF_SURVEY_LOST_MAX, survey.lost_ranges);
    kept[0] ^= 0x40;
    expect_a_new_survey();
    kept[0] ^= 0x40;
    kept_n--;
    expect_a_new_survey();
    kept[60] ^= 0x40; /* ranges */
    expect_a_new_survey();
    kept_n = PF_SURVEY_BYTES + 1;
    expect_a_new_survey();
}

/* Proves: a value of the right length whose numbers cannot be is no survey either, whichever of them the medium has
 * damaged: a host told of ranges that overlap, or that reach beyond what was made, would count losses that are none. */
static void test_numbers_that_cannot_be_are_no_survey(void)
{
    enum { BOOTS = 49, NEXT = 53, FIRST = 61, COUNT = 65, SECOND = 69 };
    static const struct {
        size_t at;
        uint8_t value[4];
    } damages[] = {{BOOTS, {0}},  {NEXT, {20}},
                   {FIRST, {30}}, {FIRST, {18}},
                   {COUNT, {0}},  {COUNT, {0xFF, 0xFF, 0xFF, 0xFF}},
                   {SECOND, {4}}, {SECOND, {0, 0, 0, 0x80}}};
    for (size_t i = 0; i <= sizeof damages / sizeof damages[0]; i++) {
        setUp();
        survey.next_index = 30;
        pf_survey_lose(&survey, 3);
        pf_survey_lose(&survey, 4);
        pf_survey_lose(&survey, 20);
        reopen();
        keep(&survey);
        if (i < sizeof damages / sizeof damages[0]) {
            memcpy(kept + damages[i].at, damages[i].value, 4);
            expect_a_new_survey();
        }
    }
}

/* Proves: another setup begins another survey and hands back the one that was interrupted, with its losses. */
static void test_another_setup_is_another_survey(void)
{
    survey.boots = 3;
    survey.next_index = 10;
    memset(survey.id, 0xA5, sizeof survey.id);
    pf_survey_lose(&survey, 4);
    keep(&survey);
    TEST_ASSERT_TRUE_MESSAGE(pf_survey_open(&survey, &before, &spool, other_setup, error, sizeof error), error);
    TEST_ASSERT_FALSE(survey.is_resumed);
    TEST_ASSERT_EQUAL_UINT32(1, survey.boots);
    TEST_ASSERT_EQUAL_UINT32(0, survey.next_index);
    TEST_ASSERT_EQUAL_UINT32(0, survey.lost_ranges);
    TEST_ASSERT_TRUE(memcmp(survey.id, before.id, 16) != 0);
    TEST_ASSERT_EQUAL_UINT32(3, before.boots);
    TEST_ASSERT_EQUAL_UINT32(10, before.next_index);
    TEST_ASSERT_EQUAL_UINT32(1, before.lost_ranges);
    TEST_ASSERT_EQUAL_UINT32(4, before.lost_first[0]);
    keep(&survey);
    TEST_ASSERT_TRUE_MESSAGE(pf_survey_open(&survey, &before, &spool, other_setup, error, sizeof error), error);
    TEST_ASSERT_TRUE(survey.is_resumed);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_losses_become_ranges);
    RUN_TEST(test_no_number_of_losses_is_too_large);
    RUN_TEST(test_losses_to_come_are_not_kept);
    RUN_TEST(test_a_full_list_and_a_foreign_value);
    RUN_TEST(test_numbers_that_cannot_be_are_no_survey);
    RUN_TEST(test_another_setup_is_another_survey);
    return UNITY_END();
}
