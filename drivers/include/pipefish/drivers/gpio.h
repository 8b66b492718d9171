/* Lamp, wheel encoder, emergency stop. Boards without them have a driver that says so (pf_gpio_none). */
#ifndef PIPEFISH_DRIVERS_GPIO_H
#define PIPEFISH_DRIVERS_GPIO_H

#include "pipefish/base.h"

typedef struct pf_gpio {
    void *self;
    const struct pf_gpio_ops *ops;
} pf_gpio;

typedef struct pf_gpio_ops {
    /* 0..1. PF_OK, PF_ERR_UNSUPPORTED (no lamp), PF_ERR_IO. Safe in any state; an emergency stop wins. */
    pf_status (*set_lamp)(void *self, double level);
    pf_status (*lamp)(void *self, double *level);

    /* Count since power-up and edges known to be lost. PF_OK, PF_ERR_UNSUPPORTED, PF_ERR_IO. */
    pf_status (*encoder)(void *self, int64_t *count, uint32_t *missed);

    /* Latched emergency stop. PF_OK, PF_ERR_UNSUPPORTED. */
    pf_status (*stopped)(void *self, bool *is_stopped);

    void (*close)(void *self);
} pf_gpio_ops;

/* No lines at all: every call answers PF_ERR_UNSUPPORTED. Replay uses it: the recording has its own telemetry. */
pf_status pf_gpio_none_open(pf_gpio *gpio);

#endif
