#include "pipefish/drivers/gpio.h"

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

static pf_status none_encoder(void *self, int64_t *count, uint32_t *missed)
{
    (void)self;
    (void)count;
    (void)missed;
    return PF_ERR_UNSUPPORTED;
}

static pf_status none_stopped(void *self, bool *is_stopped)
{
    (void)self;
    (void)is_stopped;
    return PF_ERR_UNSUPPORTED;
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
        .stopped = none_stopped,
        .close = none_close,
    };
    gpio->self = NULL;
    gpio->ops = &ops;
    return PF_OK;
}
