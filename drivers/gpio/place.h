/* What needs no library: pf_line_find, and why edges are refused. */
#ifndef PIPEFISH_GPIO_PLACE_H
#define PIPEFISH_GPIO_PLACE_H

#include "gpio/lines.h"

/* Says why the edges of n lines of a chip could not be had, as errno and the chip tell it: PF_ERR_UNSUPPORTED where the
 * kernel has only the first interface, else PF_ERR_IO. */
pf_status pf_line_fail_edges(const pf_line_place *places, uint32_t n, int why, pf_failure *failure);

#endif
