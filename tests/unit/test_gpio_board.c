/* The crawler's lamp and stop, with made-up lines in place of libgpiod's and files in place of the kernel's LED.
 * Proves: a lamp is dimmed in steps of its own brightness; a pressed stop, and one whose chip has gone, turn it off
 * whatever its level, and no request turns it on again. Real lines: tests/hil. */
#include "gpio/lines.h"
#include "pipefish/drivers/gpio.h"
#include "temporary.h"
#include "unity.h"

#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

static pf_gpio gpio;
static char error[256];
static atomic_bool is_pressed, has_gone;
static int event = -1;

/* ---- made-up lines: all that lines.h promises */

struct pf_edges {
    int fd;
};

pf_status pf_line_find(const char *name, pf_line_place *place, pf_failure *failure)
{
    (void)name;
    (void)failure;
    memset(place, 0, sizeof *place);
    return PF_OK;
}

pf_status pf_line_output_open(pf_line_output **output, const pf_line_place *place, pf_failure *failure)
{
    (void)output;
    (void)place;
    (void)failure;
    return PF_ERR_UNSUPPORTED;
}

pf_status pf_line_output_set(pf_line_output *output, bool is_active)
{
    (void)output;
    (void)is_active;
    return PF_ERR_UNSUPPORTED;
}

void pf_line_output_close(pf_line_output *output)
{
    (void)output;
}

pf_status pf_edges_open(pf_edges **edges, const pf_line_place *places, uint32_t n, pf_pull pull, uint32_t *levels,
                        pf_failure *failure)
{
    static pf_edges stop;
    (void)places;
    (void)n;
    (void)pull;
    (void)failure;
    stop.fd = event = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    *edges = &stop;
    *levels = is_pressed;
    return PF_OK;
}

int pf_edges_fd(const pf_edges *edges)
{
    return edges->fd;
}

pf_status pf_edges_read(pf_edges *edges, pf_edge out[PF_EDGES_READ_MAX], uint32_t *n)
{
    uint64_t happened;
    *n = 0;
    if (has_gone)
        return PF_ERR_CLOSED;
    if (read(edges->fd, &happened, sizeof happened) == (ssize_t)sizeof happened)
        out[(*n)++] = (pf_edge){.is_active = is_pressed};
    return PF_OK;
}

pf_status pf_edges_levels(pf_edges *edges, uint32_t *levels)
{
    (void)edges;
    *levels = is_pressed;
    return has_gone ? PF_ERR_CLOSED : PF_OK;
}

void pf_edges_close(pf_edges *edges)
{
    if (edges != NULL)
        close(edges->fd);
}

/* ---- the kernel's LED */

/* What was written last: sysfs takes each write as a whole, a file keeps what is longer. */
static long brightness(void)
{
    char text[16] = "";
    FILE *in = fopen(temporary_path("brightness"), "r");
    TEST_ASSERT_NOT_NULL(in);
    TEST_ASSERT_NOT_NULL(fgets(text, sizeof text, in));
    (void)fclose(in);
    (void)temporary_text("brightness", "");
    return strtol(text, NULL, 10);
}

static void open_lamp(double level)
{
    pf_gpio_config config = {.lamp = temporary_root, .stop = "ESTOP", .lamp_level = level};
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_gpio_board_open(&gpio, &config, error, sizeof error), error);
}

static void wait_for_stop(void)
{
    pf_gpio_state state = {0};
    for (int i = 0; i < 3000 && !state.is_stopped; i++) {
        (void)poll(NULL, 0, 10);
        gpio.ops->state(gpio.self, &state);
    }
    TEST_ASSERT_TRUE(state.is_stopped);
}

static void expect_dark_for_good(void)
{
    double level = 1;
    TEST_ASSERT_EQUAL_INT(0, brightness());
    (void)temporary_text("brightness", "untouched");
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, gpio.ops->set_lamp(gpio.self, 0.5));
    TEST_ASSERT_EQUAL_INT(PF_OK, gpio.ops->lamp(gpio.self, &level));
    TEST_ASSERT_EQUAL_DOUBLE(0, level);
    char text[16] = "";
    FILE *in = fopen(temporary_path("brightness"), "r");
    TEST_ASSERT_NOT_NULL(in);
    TEST_ASSERT_NOT_NULL(fgets(text, sizeof text, in));
    (void)fclose(in);
    TEST_ASSERT_EQUAL_STRING("untouched", text);
}

void setUp(void)
{
    temporary_make();
    (void)temporary_text("max_brightness", "255\n");
    (void)temporary_text("brightness", "");
    is_pressed = has_gone = false;
}

void tearDown(void)
{
    if (gpio.self != NULL)
        gpio.ops->close(gpio.self);
    gpio.self = NULL;
    temporary_remove();
}

static void test_a_lamp_is_dimmed_to_the_nearest_step_of_its_brightness(void)
{
    double level;
    open_lamp(0.25);
    TEST_ASSERT_EQUAL_INT(64, brightness()); /* 63.75 */
    TEST_ASSERT_EQUAL_INT(PF_OK, gpio.ops->set_lamp(gpio.self, 0.5));
    TEST_ASSERT_EQUAL_INT(128, brightness()); /* 127.5 */
    TEST_ASSERT_EQUAL_INT(PF_OK, gpio.ops->lamp(gpio.self, &level));
    TEST_ASSERT_EQUAL_DOUBLE(0.5, level);
    TEST_ASSERT_EQUAL_INT(PF_OK, gpio.ops->set_lamp(gpio.self, 1));
    TEST_ASSERT_EQUAL_INT(255, brightness());
}

static void test_a_dimmed_lamp_is_dark_after_the_stop_and_stays_so_when_that_is_released(void)
{
    open_lamp(0.5);
    TEST_ASSERT_EQUAL_INT(128, brightness());
    is_pressed = true;
    TEST_ASSERT_EQUAL_INT(sizeof(uint64_t), write(event, &(uint64_t){1}, sizeof(uint64_t)));
    wait_for_stop();
    is_pressed = false;
    expect_dark_for_good();
}

static void test_a_stop_whose_chip_vanishes_counts_as_pressed(void)
{
    pf_gpio_state state;
    open_lamp(0.5);
    TEST_ASSERT_EQUAL_INT(128, brightness());
    has_gone = true;
    wait_for_stop();
    gpio.ops->state(gpio.self, &state);
    TEST_ASSERT_TRUE(state.is_broken);
    expect_dark_for_good();
}

static void test_a_lamp_stays_dark_that_starts_with_the_stop_pressed(void)
{
    (void)temporary_text("brightness", "0");
    is_pressed = true;
    open_lamp(1);
    expect_dark_for_good();
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_lamp_is_dimmed_to_the_nearest_step_of_its_brightness);
    RUN_TEST(test_a_dimmed_lamp_is_dark_after_the_stop_and_stays_so_when_that_is_released);
    RUN_TEST(test_a_stop_whose_chip_vanishes_counts_as_pressed);
    RUN_TEST(test_a_lamp_stays_dark_that_starts_with_the_stop_pressed);
    return UNITY_END();
}
