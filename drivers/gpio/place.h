/* The part of pf_line_find that needs no library. */
#ifndef PIPEFISH_GPIO_PLACE_H
#define PIPEFISH_GPIO_PLACE_H

#include "gpio/lines.h"

/* Splits a name; *plain is what is left of it, to be looked up, if place->chip stays "". PF_OK, PF_ERR_FORMAT. */
pf_status pf_line_parse(const char *name, pf_line_place *place, const char **plain, pf_failure *failure);

/* Says why a line's edges could not be had, as errno tells it: PF_ERR_UNSUPPORTED where the kernel has only the first
 * interface, else PF_ERR_IO. */
pf_status pf_line_fail_edges(const pf_line_place *place, int why, pf_failure *failure);

#endif
