#include "pipefish/drivers/gpio.h"

#include <string.h>

static pf_status none_set_lamp(void *self, double level)
{
    (void)self;
    (void)level;
    return PF_ERR_UNSUPPORTED;
}

static pf_status none_lamp(void *self, double *level)
{
    (void)self;
    (void)level;
    return PF_ERR_UNSUPPORTED;
}

static pf_status none_encoder(void *self, uint64_t time_ns, int64_t *count, uint32_t *missed)
{
    (void)self;
    (void)time_ns;
    (void)count;
    (void)missed;
    return PF_ERR_UNSUPPORTED;
}

static void none_indicate(void *self, pf_indication indication)
{
    (void)self;
    (void)indication;
}

static void none_state(void *self, pf_gpio_state *state)
{
    (void)self;
    memset(state, 0, sizeof *state);
}

static void none_close(void *self)
{
    (void)self;
}

pf_status pf_gpio_none_open(pf_gpio *gpio)
{
    static const pf_gpio_ops ops = {
        .set_lamp = none_set_lamp,
        .lamp = none_lamp,
        .encoder = none_encoder,
        .indicate = none_indicate,
        .state = none_state,
        .close = none_close,
    };
    gpio->self = NULL;
    gpio->ops = &ops;
    return PF_OK;
}
