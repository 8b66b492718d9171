/* How a line may be written; looking it up is the library's. */
#include "gpio/place.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

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
