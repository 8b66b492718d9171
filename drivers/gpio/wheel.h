/* The wheel encoder: the kernel's counter, the kernel's rotary-encoder input, or two GPIO lines decoded here. One
 * thread at a time. */
#ifndef PIPEFISH_GPIO_WHEEL_H
#define PIPEFISH_GPIO_WHEEL_H

#include "gpio/lines.h"
#include "gpio/quadrature.h"
#include "pipefish/drivers/gpio.h"

typedef enum pf_wheel_kind { PF_WHEEL_NONE = 0, PF_WHEEL_COUNTER, PF_WHEEL_INPUT, PF_WHEEL_LINES } pf_wheel_kind;

typedef struct pf_wheel {
    pf_wheel_kind kind;
    char name[80];
    int fd;           /* counter, input */
    pf_edges *edges;  /* lines */
    uint64_t modulus; /* counter: its values are of 0 .. modulus - 1; 0 = all 64 bits */
    uint64_t raw;     /* counter: as read last */
    bool is_broken;
    pf_edge_order order;   /* lines */
    pf_quadrature decoder; /* count and lost edges of all kinds */
    pf_history history;
} pf_wheel;

/* As pf_gpio_board_open; *wheel must be zeros. */
pf_status pf_wheel_open(pf_wheel *wheel, const pf_gpio_config *config, pf_failure *failure);

int pf_wheel_fd(const pf_wheel *wheel); /* to poll; -1 = read it at intervals instead */

/* Takes in what has happened. Sets is_broken if the device has gone. */
void pf_wheel_read(pf_wheel *wheel, uint64_t now_ns);

void pf_wheel_close(pf_wheel *wheel);

#endif
