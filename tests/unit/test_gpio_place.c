/* Where a line of a name is, on chips made up here (--wrap). Proves: a name is found on any chip, by either of the
 * kernel's interfaces; one that several lines have is refused, for the wrong one of two stop buttons stops nothing; a
 * chip that has two names in /dev is one chip; chips that cannot be asked are told. Real chips: tests/hil. */
#include "gpio/lines.h"
#include "unity.h"

#include <dirent.h>
#include <errno.h>
#include <linux/gpio.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

enum { CHIPS = 4, LINES = 3, FIRST_FD = 1000 };

static struct {
    const char *file; /* NULL = not there */
    dev_t device;
    const char *lines[LINES];
    bool is_forbidden;
} chips[CHIPS];
static bool is_older; /* the kernel: it has the first interface only */
static int at;        /* in /dev */
static int open_files;
static pf_failure failure;
static pf_line_place place;

DIR *__wrap_opendir(const char *path);
struct dirent *__wrap_readdir(DIR *folder);
int __wrap_closedir(DIR *folder);
int __wrap_open(const char *path, int flags, ...);
int __wrap_close(int fd);
int __wrap_fstat(int fd, struct stat *info);
int __wrap_ioctl(int fd, unsigned long request, void *argument);
int __real_close(int fd);

DIR *__wrap_opendir(const char *path)
{
    TEST_ASSERT_EQUAL_STRING("/dev", path);
    at = 0;
    open_files++;
    return (DIR *)&at;
}

struct dirent *__wrap_readdir(DIR *folder)
{
    static struct dirent entry;
    TEST_ASSERT_EQUAL_PTR(&at, folder);
    while (at < CHIPS && chips[at].file == NULL)
        at++;
    if (at == CHIPS)
        return NULL;
    (void)snprintf(entry.d_name, sizeof entry.d_name, "%s", chips[at++].file);
    return &entry;
}

int __wrap_closedir(DIR *folder)
{
    TEST_ASSERT_EQUAL_PTR(&at, folder);
    open_files--;
    return 0;
}

int __wrap_open(const char *path, int flags, ...)
{
    (void)flags;
    for (int i = 0; i < CHIPS; i++)
        if (chips[i].file != NULL && strncmp(path, "/dev/", 5) == 0 && strcmp(path + 5, chips[i].file) == 0) {
            errno = EACCES;
            open_files += !chips[i].is_forbidden;
            return chips[i].is_forbidden ? -1 : FIRST_FD + i;
        }
    TEST_FAIL_MESSAGE(path);
    return -1;
}

int __wrap_close(int fd)
{
    if (fd < FIRST_FD)
        return __real_close(fd);
    open_files--;
    return 0;
}

int __wrap_fstat(int fd, struct stat *info)
{
    info->st_rdev = chips[fd - FIRST_FD].device;
    return 0;
}

int __wrap_ioctl(int fd, unsigned long request, void *argument)
{
    struct gpiochip_info *chip = argument;
    struct gpio_v2_line_info *line = argument;
    struct gpioline_info *older = argument;
    errno = EINVAL;
    if (request == GPIO_GET_CHIPINFO_IOCTL)
        chip->lines = LINES;
    else if (request == GPIO_V2_GET_LINEINFO_IOCTL && !is_older && chips[fd - FIRST_FD].lines[line->offset] != NULL)
        (void)snprintf(line->name, sizeof line->name, "%s", chips[fd - FIRST_FD].lines[line->offset]);
    else if (request == GPIO_GET_LINEINFO_IOCTL && is_older && chips[fd - FIRST_FD].lines[older->line_offset] != NULL)
        (void)snprintf(older->name, sizeof older->name, "%s", chips[fd - FIRST_FD].lines[older->line_offset]);
    else if (request == GPIO_V2_GET_LINEINFO_IOCTL && is_older)
        return -1;
    return 0;
}

void setUp(void)
{
    memset(chips, 0, sizeof chips);
    chips[0].file = "null";
    chips[1].file = "gpiochip0";
    chips[1].device = 10;
    chips[1].lines[2] = "LAMP";
    chips[2].file = "gpiochip1";
    chips[2].device = 11;
    chips[2].lines[0] = "LAMP2";
    chips[2].lines[1] = "STOP";
    is_older = false;
    failure.text[0] = '\0';
}

void tearDown(void)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(0, open_files, "left open");
}

static void expect(const char *name, const char *chip, uint32_t offset)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_line_find(name, &place, &failure), failure.text);
    TEST_ASSERT_EQUAL_STRING(chip, place.chip);
    TEST_ASSERT_EQUAL_UINT32(offset, place.offset);
    TEST_ASSERT_EQUAL(name[0] == '!', place.is_active_low);
}

static void test_a_name_is_found_on_any_chip(void)
{
    for (int i = 0; i < 2; i++) {
        is_older = i == 1;
        expect("LAMP", "/dev/gpiochip0", 2);
        expect("!STOP", "/dev/gpiochip1", 1);
        expect("gpiochip1:7", "/dev/gpiochip1", 7);
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, pf_line_find("LAM", &place, &failure));
        TEST_ASSERT_EQUAL_STRING("gpio: no line is named LAM", failure.text);
    }
}

static void test_a_name_of_several_lines_is_refused(void)
{
    chips[1].lines[0] = "STOP";
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_line_find("STOP", &place, &failure));
    TEST_ASSERT_EQUAL_STRING("gpio: several lines are named STOP: name its chip, as gpiochip0:17", failure.text);
    expect("gpiochip0:0", "/dev/gpiochip0", 0);
    chips[1].lines[0] = "LAMP"; /* of one chip */
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_line_find("LAMP", &place, &failure));
    expect("STOP", "/dev/gpiochip1", 1);
}

/* Raspberry Pi OS keeps the old name of a Pi 5's chip as a link. */
static void test_a_chip_of_two_names_is_one(void)
{
    chips[3].file = "gpiochip4";
    chips[3].device = 10;
    chips[3].lines[2] = "LAMP";
    expect("LAMP", "/dev/gpiochip0", 2);
}

static void test_a_chip_that_cannot_be_asked_is_told(void)
{
    chips[2].is_forbidden = true;
    expect("LAMP", "/dev/gpiochip0", 2);
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, pf_line_find("STOP", &place, &failure));
    TEST_ASSERT_EQUAL_STRING("gpio: no line is named STOP; not every chip could be asked: Permission denied",
                             failure.text);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_name_is_found_on_any_chip);
    RUN_TEST(test_a_name_of_several_lines_is_refused);
    RUN_TEST(test_a_chip_of_two_names_is_one);
    RUN_TEST(test_a_chip_that_cannot_be_asked_is_told);
    return UNITY_END();
}
