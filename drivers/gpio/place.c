/* How a line may be written, and where it is. Asked of the kernel: libgpiod takes the first line of a name, whichever
 * that is, and a stop button must not be another board's. */
#include "gpio/place.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/gpio.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <unistd.h>

/* Splits a name; *plain is what is left of it, to be looked up, if place->chip stays "". */
static pf_status parse(const char *name, pf_line_place *place, const char **plain, pf_failure *failure)
{
    memset(place, 0, sizeof *place);
    place->is_active_low = *name == '!';
    *plain = name + place->is_active_low;
    if (**plain == '\0')
        return pf_fail(failure, PF_ERR_FORMAT, "gpio: \"%s\" is no name of a line", name);
    const char *colon = strrchr(*plain, ':');
    if (strncmp(*plain, "gpiochip", 8) != 0 || colon == NULL)
        return PF_OK; /* a name of the device tree: colons are allowed there */
    char *end;
    unsigned long offset = strtoul(colon + 1, &end, 10);
    if (colon[1] < '0' || colon[1] > '9' || *end != '\0' || offset > UINT16_MAX ||
        (size_t)(colon - *plain) + sizeof "/dev/" > sizeof place->chip)
        return pf_fail(failure, PF_ERR_FORMAT, "gpio: %s: must be a line's name, or chip:number as gpiochip0:17", name);
    (void)snprintf(place->chip, sizeof place->chip, "/dev/%.*s", (int)(colon - *plain), *plain);
    place->offset = (uint32_t)offset;
    return PF_OK;
}

/* Lines of an open chip; 0 = it does not tell. */
static uint32_t count_lines(int chip)
{
    struct gpiochip_info info = {0};
    return ioctl(chip, GPIO_GET_CHIPINFO_IOCTL, &info) == 0 ? info.lines : 0;
}

static bool is_named(int chip, uint32_t offset, const char *plain)
{
    struct gpio_v2_line_info info = {.offset = offset};
    struct gpioline_info older = {.line_offset = offset};
    if (ioctl(chip, GPIO_V2_GET_LINEINFO_IOCTL, &info) == 0)
        return strncmp(info.name, plain, sizeof info.name) == 0;
    return ioctl(chip, GPIO_GET_LINEINFO_IOCTL, &older) == 0 && strncmp(older.name, plain, sizeof older.name) == 0;
}

typedef struct search {
    const char *plain;
    pf_line_place *place; /* the first found; chip "" = none yet */
    dev_t device;         /* its chip's: another name in /dev may be a link to it */
    bool is_ambiguous;
    int why; /* errno of a chip that could not be asked */
} search;

static void search_chip(search *s, const char *path)
{
    struct stat info = {0};
    int chip = open(path, O_RDWR | O_CLOEXEC);
    if (chip < 0 || fstat(chip, &info) != 0)
        s->why = errno;
    const uint32_t lines = chip >= 0 ? count_lines(chip) : 0;
    for (uint32_t i = 0; i < lines; i++) {
        if (!is_named(chip, i, s->plain))
            continue;
        if (s->place->chip[0] == '\0') {
            (void)snprintf(s->place->chip, sizeof s->place->chip, "%s", path);
            s->place->offset = i;
            s->device = info.st_rdev;
        }
        s->is_ambiguous = s->is_ambiguous || info.st_rdev != s->device || i != s->place->offset;
    }
    if (chip >= 0)
        (void)close(chip);
}

pf_status pf_line_find(const char *name, pf_line_place *place, pf_failure *failure)
{
    search s = {.place = place};
    pf_status status = parse(name, place, &s.plain, failure);
    if (status != PF_OK || place->chip[0] != '\0')
        return status;
    DIR *folder = opendir("/dev");
    for (const struct dirent *e = folder ? readdir(folder) : NULL; e != NULL; e = readdir(folder)) {
        char path[sizeof place->chip];
        if (strncmp(e->d_name, "gpiochip", 8) != 0 || strlen(e->d_name) + sizeof "/dev/" > sizeof path)
            continue;
        (void)snprintf(path, sizeof path, "/dev/%.58s", e->d_name);
        search_chip(&s, path);
    }
    if (folder != NULL)
        (void)closedir(folder);
    if (s.is_ambiguous)
        return pf_fail(failure, PF_ERR_FORMAT, "gpio: several lines are named %s: name its chip, as gpiochip0:17",
                       s.plain);
    if (place->chip[0] == '\0')
        return pf_fail(failure, PF_ERR_END, "gpio: no line is named %s%s%s", s.plain,
                       s.why != 0 ? "; not every chip could be asked: " : "", s.why != 0 ? strerror(s.why) : "");
    return PF_OK;
}

/* Asks about a line that is there what every kernel with the second interface answers: older ones say EINVAL to all of
 * it, as they do to what is wrong about a request. */
static bool has_second_interface(int chip, uint32_t offset)
{
    struct gpio_v2_line_info info = {.offset = offset};
    return ioctl(chip, GPIO_V2_GET_LINEINFO_IOCTL, &info) == 0;
}

static pf_status fail_refused(int chip, const pf_line_place *places, uint32_t n, int why, pf_failure *failure)
{
    const char *name = places[0].chip;
    const uint32_t lines = count_lines(chip);
    for (uint32_t i = 0; i < n && lines > 0; i++)
        if (places[i].offset >= lines)
            return pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: has only %u lines, the first is 0", name,
                           places[i].offset, lines);
    if (!has_second_interface(chip, places[0].offset))
        return pf_fail(failure, PF_ERR_UNSUPPORTED,
                       "gpio: %s line %u: the kernel is older than 5.10: its edges vanish silently, and none are taken",
                       name, places[0].offset);
    return pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: %s", name, places[0].offset, strerror(why));
}

pf_status pf_line_fail_edges(const pf_line_place *places, uint32_t n, int why, pf_failure *failure)
{
    int chip = why == ENOTTY || why == EINVAL ? open(places[0].chip, O_RDWR | O_CLOEXEC) : -1;
    if (chip < 0)
        return pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: %s", places[0].chip, places[0].offset, strerror(why));
    pf_status status = fail_refused(chip, places, n, why, failure);
    (void)close(chip);
    return status;
}
