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

/* Asks about a line what every kernel with the second interface answers: older ones say EINVAL to all of it, as they do
 * to what is wrong about a request. */
static bool has_second_interface(const pf_line_place *place)
{
    struct gpio_v2_line_info info = {.offset = place->offset};
    int chip = open(place->chip, O_RDWR | O_CLOEXEC);
    bool has = chip < 0 || ioctl(chip, GPIO_V2_GET_LINEINFO_IOCTL, &info) == 0;
    if (chip >= 0)
        (void)close(chip);
    return has;
}

pf_status pf_line_fail_edges(const pf_line_place *place, int why, pf_failure *failure)
{
    if ((why == ENOTTY || why == EINVAL) && !has_second_interface(place))
        return pf_fail(failure, PF_ERR_UNSUPPORTED,
                       "gpio: %s line %u: the kernel is older than 5.10: its edges vanish silently, and none are taken",
                       place->chip, place->offset);
    return pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: %s", place->chip, place->offset, strerror(why));
}
