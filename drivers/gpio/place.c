/* How a line may be written; looking it up is the library's. */
#include "gpio/place.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/gpio.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

pf_status pf_line_parse(const char *name, pf_line_place *place, const char **plain, pf_failure *failure)
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
