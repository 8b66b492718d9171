/* The wheel encoder's sources, as far as files can stand in for them. Proves: a counter of the kernel's is followed
 * over its end and back, and a name that is none of ours, or a file that is no counter, is refused by name. Not: lines
 * and input devices, which need a kernel (tests/hil). */
#include "gpio/wheel.h"
#include "unity.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static pf_wheel wheel;
static pf_failure failure;
static char folder[256], count_path[300], ceiling_path[300];

static void put(const char *path, const char *text)
{
    FILE *out = fopen(path, "w");
    TEST_ASSERT_NOT_NULL(out);
    TEST_ASSERT_TRUE(fputs(text, out) >= 0);
    TEST_ASSERT_EQUAL_INT(0, fclose(out));
}

void setUp(void)
{
    memset(&wheel, 0, sizeof wheel);
    (void)snprintf(folder, sizeof folder, "/tmp/test_wheel.XXXXXX");
    TEST_ASSERT_NOT_NULL(mkdtemp(folder));
    (void)snprintf(count_path, sizeof count_path, "%s/count", folder);
    (void)snprintf(ceiling_path, sizeof ceiling_path, "%s/ceiling", folder);
}

void tearDown(void)
{
    pf_wheel_close(&wheel);
    (void)unlink(count_path);
    (void)unlink(ceiling_path);
    (void)rmdir(folder);
}

static pf_status open_it(const char *encoder)
{
    return pf_wheel_open(&wheel, &(pf_gpio_config){.encoder = encoder}, &failure);
}

static int64_t count_after(const char *text)
{
    static uint64_t now;
    put(count_path, text);
    pf_wheel_read(&wheel, now += 1000);
    return wheel.decoder.count;
}

static void test_a_counter_is_followed_over_its_end_and_back(void)
{
    put(count_path, "65530\n");
    put(ceiling_path, "65535\n");
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_it(count_path), failure.text);
    TEST_ASSERT_EQUAL_INT(PF_WHEEL_COUNTER, wheel.kind);
    TEST_ASSERT_EQUAL_INT64(0, count_after("65530\n"));
    TEST_ASSERT_EQUAL_INT64(10, count_after("4\n"));
    TEST_ASSERT_EQUAL_INT64(1010, count_after("1004\n"));
    TEST_ASSERT_EQUAL_INT64(-6, count_after("65524\n"));
    TEST_ASSERT_EQUAL_INT64(1010, pf_history_at(&wheel.history, 3999, 0));
    TEST_ASSERT_EQUAL_INT64(0, pf_history_at(&wheel.history, 1, 99)); /* before the first reading */
}

static void test_a_counter_without_an_end_counts_all_64_bits(void)
{
    put(count_path, "18446744073709551615\n");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(count_path));
    TEST_ASSERT_EQUAL_INT64(6, count_after("5\n"));
    TEST_ASSERT_EQUAL_INT64(-4, count_after("18446744073709551611\n"));
}

static void test_a_counter_that_vanishes_is_noticed(void)
{
    put(count_path, "5\n");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(count_path));
    TEST_ASSERT_EQUAL_INT64(0, count_after(""));
    TEST_ASSERT_TRUE(wheel.is_broken);
    TEST_ASSERT_EQUAL_INT(-1, pf_wheel_fd(&wheel));
}

static void test_what_is_no_encoder_is_refused_by_name(void)
{
    put(count_path, "forward\n");
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, open_it(count_path));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, count_path));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_it("count"));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, "count"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_it("lines")); /* which are not named */
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, open_it("/dev/input/event9999"));
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(""));
    TEST_ASSERT_EQUAL_INT(PF_WHEEL_NONE, wheel.kind);
}

/* A device that knows nothing of the second interface stands in for a kernel before 5.10. */
static void test_edges_of_a_kernel_without_numbers_are_refused_and_the_kernel_is_named(void)
{
    pf_line_place place = {.chip = "/dev/null", .offset = 3};
    pf_edges *edges = NULL;
    uint32_t levels;
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, pf_edges_open(&edges, &place, 1, PF_PULL_NONE, &levels, &failure));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, "line 3: the kernel is older than 5.10"));
    TEST_ASSERT_NULL(edges);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_counter_is_followed_over_its_end_and_back);
    RUN_TEST(test_a_counter_without_an_end_counts_all_64_bits);
    RUN_TEST(test_a_counter_that_vanishes_is_noticed);
    RUN_TEST(test_what_is_no_encoder_is_refused_by_name);
    RUN_TEST(test_edges_of_a_kernel_without_numbers_are_refused_and_the_kernel_is_named);
    return UNITY_END();
}
