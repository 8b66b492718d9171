/* Lamp, wheel encoder, emergency stop, limit switches, status LED. Boards without them have a driver that says so
 * (pf_gpio_none). All calls may come from any thread.
 */
#ifndef PIPEFISH_DRIVERS_GPIO_H
#define PIPEFISH_DRIVERS_GPIO_H

#include "pipefish/base.h"

typedef struct pf_gpio {
    void *self;
    const struct pf_gpio_ops *ops;
} pf_gpio;

/* What the status LED shows. */
typedef enum pf_indication {
    PF_INDICATE_IDLE = 0, /* off */
    PF_INDICATE_WORK,     /* on: a survey */
    PF_INDICATE_SEND,     /* slow blinking: the rest is on its way */
    PF_INDICATE_TROUBLE,  /* fast blinking: no camera. An emergency stop blinks so whatever is asked for */
} pf_indication;

enum { PF_LIMIT_FRONT = 1, PF_LIMIT_REAR = 2 };

/* Everything but lamp and count, for whoever reports it. */
typedef struct pf_gpio_state {
    bool has_stop, is_stopped;  /* latched: until the driver is opened again with the button released */
    uint32_t limits;            /* PF_LIMIT_ bits of the switches that are pressed */
    uint32_t missed;            /* encoder edges known to be lost */
    uint32_t repeated, illegal; /* encoder: see pf_quadrature */
    bool is_broken;             /* a chip or an input has gone since opening, or the lamp does not go off */
    uint64_t round_ns;          /* when the driver's thread last went round (it does each 100 ms); 0 = it has none */
    char encoder[80];           /* where counts come from; "" = nowhere */
} pf_gpio_state;

typedef struct pf_gpio_ops {
    /* 0..1; a lamp that can only be switched is on above 0. PF_OK, PF_ERR_UNSUPPORTED (no lamp), PF_ERR_IO,
     * PF_ERR_CLOSED (emergency stop: the lamp stays off). */
    pf_status (*set_lamp)(void *self, double level);
    pf_status (*lamp)(void *self, double *level);

    /* The count at a moment of the monotonic clock, of the last second, and edges known to be lost since opening.
     * PF_OK, PF_ERR_UNSUPPORTED, PF_ERR_IO (its chip or device has gone). */
    pf_status (*encoder)(void *self, uint64_t time_ns, int64_t *count, uint32_t *missed);

    void (*indicate)(void *self, pf_indication indication);
    void (*state)(void *self, pf_gpio_state *state);
    void (*close)(void *self); /* lamp and LED off */
} pf_gpio_ops;

/* No lines at all: every call answers PF_ERR_UNSUPPORTED. Replay uses it: the recording has its own telemetry. */
pf_status pf_gpio_none_open(pf_gpio *gpio);

typedef enum pf_gpio_pull { PF_GPIO_PULL_NONE = 0, PF_GPIO_PULL_UP, PF_GPIO_PULL_DOWN } pf_gpio_pull;

/* Lines are named as the device tree does ("LAMP") or by chip and number ("gpiochip0:17"), with a ! before it where low
 * means active. NULL or "" = there is none. */
typedef struct pf_gpio_config {
    const char *lamp, *led; /* a line, or a folder of /sys/class/leds, whose brightness then can be set (leds-pwm) */
    const char *stop, *limit_front, *limit_rear;
    const char *encoder; /* "lines"; the file of a counter (/sys/bus/counter/devices/counter0/count0/count); an input
                            device (/dev/input/event0, driver rotary-encoder); "auto" = the first of these there is */
    const char *encoder_a, *encoder_b; /* of one chip */
    pf_gpio_pull pull;                 /* of all inputs */
    double lamp_level;                 /* to begin with, unless the stop is pressed */
} pf_gpio_config;

/* On failure *gpio is untouched and error[n] says what. PF_OK; PF_ERR_IO; PF_ERR_END (no such line or file);
 * PF_ERR_FORMAT (not a name, not a counter); PF_ERR_ARGUMENT; PF_ERR_SPACE; PF_ERR_UNSUPPORTED. */
pf_status pf_gpio_board_open(pf_gpio *gpio, const pf_gpio_config *config, char *error, size_t n);

#endif
