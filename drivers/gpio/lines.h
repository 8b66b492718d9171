/* GPIO lines by name, through libgpiod: lines_gpiod1.c for its API 1.6 (Debian 12), lines_gpiod2.c for 2.x. Which one
 * is compiled, the build decides.
 *
 * A line is named as the device tree names it ("LAMP"), or by chip and number ("gpiochip0:17"); a ! before it makes it
 * active low.
 */
#ifndef PIPEFISH_GPIO_LINES_H
#define PIPEFISH_GPIO_LINES_H

#include "common/failure.h"
#include "gpio/quadrature.h"

#define PF_EDGES_LINES_MAX 2u
#define PF_EDGES_READ_MAX  64u

typedef enum pf_pull { PF_PULL_NONE = 0, PF_PULL_UP, PF_PULL_DOWN } pf_pull;

/* Where a named line is. */
typedef struct pf_line_place {
    char chip[64]; /* "/dev/gpiochip0" */
    uint32_t offset;
    bool is_active_low;
} pf_line_place;

/* PF_OK; PF_ERR_END (no such line); PF_ERR_FORMAT (not a name, or that of several lines). */
pf_status pf_line_find(const char *name, pf_line_place *place, pf_failure *failure);

typedef struct pf_line_output pf_line_output;

/* Takes a line as output, inactive. PF_OK, PF_ERR_IO (in use, no permission), PF_ERR_SPACE. */
pf_status pf_line_output_open(pf_line_output **output, const pf_line_place *place, pf_failure *failure);
pf_status pf_line_output_set(pf_line_output *output, bool is_active);
void pf_line_output_close(pf_line_output *output); /* NULL is allowed; the line is let go */

typedef struct pf_edges pf_edges;

/* Watches up to PF_EDGES_LINES_MAX lines of one chip; *levels gets them as they are, a bit a line. Edges since then
 * wait to be read. PF_OK; PF_ERR_IO; PF_ERR_SPACE; PF_ERR_ARGUMENT (of different chips); PF_ERR_UNSUPPORTED (a kernel
 * before 5.10, whose edges have no numbers and vanish silently). */
pf_status pf_edges_open(pf_edges **edges, const pf_line_place *places, uint32_t n, pf_pull pull, uint32_t *levels,
                        pf_failure *failure);
int pf_edges_fd(const pf_edges *edges); /* readable when there are edges */

/* Reads what is there. PF_OK, *n = 0 if nothing; PF_ERR_CLOSED (the chip has gone). */
pf_status pf_edges_read(pf_edges *edges, pf_edge out[PF_EDGES_READ_MAX], uint32_t *n);
pf_status pf_edges_levels(pf_edges *edges, uint32_t *levels);
void pf_edges_close(pf_edges *edges); /* NULL is allowed */

#endif
