/* The part of pf_line_find that needs no library. */
#ifndef PIPEFISH_GPIO_PLACE_H
#define PIPEFISH_GPIO_PLACE_H

#include "gpio/lines.h"

/* Splits a name; *plain is what is left of it, to be looked up, if place->chip stays "". PF_OK, PF_ERR_FORMAT. */
pf_status pf_line_parse(const char *name, pf_line_place *place, const char **plain, pf_failure *failure);

/* Says why the edges of n lines of a chip could not be had, as errno and the chip tell it: PF_ERR_UNSUPPORTED where the
 * kernel has only the first interface, else PF_ERR_IO. */
pf_status pf_line_fail_edges(const pf_line_place *places, uint32_t n, int why, pf_failure *failure);

#endif
