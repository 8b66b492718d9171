/* The wheel encoder's sources, as far as files can stand in for them. Proves: a counter of the kernel's is followed
 * over its end and back, and a name that is none of ours, or a file that is no counter, is refused by name. Not: lines
 * and input devices, which need a kernel (tests/hil). */
#include "gpio/place.h"
#include "gpio/wheel.h"
#include "temporary.h"
#include "unity.h"

#include <errno.h>
#include <linux/gpio.h>
#include <stdarg.h>
#include <string.h>

static pf_wheel wheel;
static pf_failure failure;
static const char *count_path, *ceiling_path;

void setUp(void)
{
    memset(&wheel, 0, sizeof wheel);
    temporary_make();
    count_path = temporary_path("count");
    ceiling_path = temporary_path("ceiling");
}

void tearDown(void)
{
    pf_wheel_close(&wheel);
    temporary_remove();
}

static pf_status open_it(const char *encoder)
{
    return pf_wheel_open(&wheel, &(pf_gpio_config){.encoder = encoder}, &failure);
}

static int64_t count_after(const char *text)
{
    static uint64_t now;
    (void)temporary_text("count", text);
    pf_wheel_read(&wheel, now += 1000);
    return wheel.decoder.count;
}

static void test_a_counter_is_followed_over_its_end_and_back(void)
{
    (void)temporary_text("count", "65530\n");
    (void)temporary_text("ceiling", "65535\n");
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
    (void)temporary_text("count", "18446744073709551615\n");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(count_path));
    TEST_ASSERT_EQUAL_INT64(6, count_after("5\n"));
    TEST_ASSERT_EQUAL_INT64(-4, count_after("18446744073709551611\n"));
}

static void test_a_counter_that_vanishes_is_noticed(void)
{
    (void)temporary_text("count", "5\n");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(count_path));
    TEST_ASSERT_EQUAL_INT64(0, count_after(""));
    TEST_ASSERT_TRUE(wheel.is_broken);
    TEST_ASSERT_EQUAL_INT(-1, pf_wheel_fd(&wheel));
}

static void test_what_is_no_encoder_is_refused_by_name(void)
{
    (void)temporary_text("count", "forward\n");
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, open_it(count_path));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, count_path));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_it("count"));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, "count"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_it("lines")); /* which are not named */
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, open_it("/dev/input/event9999"));
    TEST_ASSERT_EQUAL_INT(PF_OK, open_it(""));
    TEST_ASSERT_EQUAL_INT(PF_WHEEL_NONE, wheel.kind);
}

/* A kernel made up here: how many lines its chip has (0 = it does not tell), and whether it knows of the second
 * interface. As the real one, it says EINVAL to a line that is not there, and the old one to everything it does not
 * know. */
static struct {
    uint32_t lines;
    bool is_old;
} kernel;

int __wrap_ioctl(int fd, unsigned long request, ...);

int __wrap_ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    TEST_ASSERT_TRUE(fd >= 0);
    errno = EINVAL;
    if (request == GPIO_GET_CHIPINFO_IOCTL && kernel.lines > 0) {
        ((struct gpiochip_info *)argument)->lines = kernel.lines;
        return 0;
    }
    return request == GPIO_V2_GET_LINEINFO_IOCTL && !kernel.is_old &&
                   ((const struct gpio_v2_line_info *)argument)->offset < kernel.lines
               ? 0
               : -1;
}

static void expect_refusal(uint32_t second_line, int why, pf_status status, const char *words)
{
    const pf_line_place places[] = {{.chip = "/dev/null", .offset = 3}, {.chip = "/dev/null", .offset = second_line}};
    TEST_ASSERT_EQUAL_INT(status, pf_line_fail_edges(places, 2, why, &failure));
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(failure.text, words), failure.text);
}

static void test_why_there_are_no_edges_is_told_apart(void)
{
    kernel.lines = 54;
    kernel.is_old = true;
    expect_refusal(4, EINVAL, PF_ERR_UNSUPPORTED, "line 3: the kernel is older than 5.10");
    expect_refusal(99, EINVAL, PF_ERR_IO, "line 99: has only 54 lines");
    kernel.is_old = false;
    expect_refusal(99, EINVAL, PF_ERR_IO, "line 99: has only 54 lines");
    expect_refusal(54, EINVAL, PF_ERR_IO, "line 54: has only 54 lines");
    expect_refusal(53, EINVAL, PF_ERR_IO, strerror(EINVAL)); /* a bad request */
    expect_refusal(4, EBUSY, PF_ERR_IO, strerror(EBUSY));
    kernel.lines = 0; /* no chip at all */
    expect_refusal(4, ENOTTY, PF_ERR_UNSUPPORTED, "older than 5.10");
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_counter_is_followed_over_its_end_and_back);
    RUN_TEST(test_a_counter_without_an_end_counts_all_64_bits);
    RUN_TEST(test_a_counter_that_vanishes_is_noticed);
    RUN_TEST(test_what_is_no_encoder_is_refused_by_name);
    RUN_TEST(test_why_there_are_no_edges_is_told_apart);
    return UNITY_END();
}
