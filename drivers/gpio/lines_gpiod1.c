/* GPIO lines with libgpiod 1.6. Its edge events come from the kernel's first interface, which drops them silently when
 * its buffer of 16 is full; edges are therefore asked for at the kernel's second interface, where they have numbers. */
#include "gpio/lines.h"
#include "gpio/place.h"

#include <errno.h>
#include <fcntl.h>
#include <gpiod.h>
#include <linux/gpio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

#define CONSUMER     "pipefishd"
#define EVENT_BUFFER 1024u

struct pf_line_output {
    struct gpiod_chip *chip;
    struct gpiod_line *line;
};

struct pf_edges {
    int fd;
    uint32_t n, offset[PF_EDGES_LINES_MAX];
};

pf_status pf_line_output_open(pf_line_output **output, const pf_line_place *place, pf_failure *failure)
{
    pf_line_output *o = calloc(1, sizeof *o);
    int flags = place->is_active_low ? GPIOD_LINE_REQUEST_FLAG_ACTIVE_LOW : 0;
    if (o == NULL)
        return pf_fail(failure, PF_ERR_SPACE, "gpio: no memory");
    o->chip = gpiod_chip_open(place->chip);
    o->line = o->chip != NULL ? gpiod_chip_get_line(o->chip, place->offset) : NULL;
    if (o->line == NULL || gpiod_line_request_output_flags(o->line, CONSUMER, flags, 0) != 0) {
        pf_status status =
            pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: %s", place->chip, place->offset, strerror(errno));
        pf_line_output_close(o);
        return status;
    }
    *output = o;
    return PF_OK;
}

pf_status pf_line_output_set(pf_line_output *output, bool is_active)
{
    return gpiod_line_set_value(output->line, is_active) == 0 ? PF_OK : PF_ERR_IO;
}

void pf_line_output_close(pf_line_output *output)
{
    if (output == NULL)
        return;
    if (output->chip != NULL)
        gpiod_chip_close(output->chip); /* with its lines */
    free(output);
}

static uint64_t line_flags(const pf_line_place *place, pf_pull pull)
{
    uint64_t flags = GPIO_V2_LINE_FLAG_INPUT | GPIO_V2_LINE_FLAG_EDGE_RISING | GPIO_V2_LINE_FLAG_EDGE_FALLING;
    if (place->is_active_low)
        flags |= GPIO_V2_LINE_FLAG_ACTIVE_LOW;
    if (pull == PF_PULL_UP)
        flags |= GPIO_V2_LINE_FLAG_BIAS_PULL_UP;
    else if (pull == PF_PULL_DOWN)
        flags |= GPIO_V2_LINE_FLAG_BIAS_PULL_DOWN;
    return flags;
}

pf_status pf_edges_open(pf_edges **edges, const pf_line_place *places, uint32_t n, pf_pull pull, uint32_t *levels,
                        pf_failure *failure)
{
    struct gpio_v2_line_request r = {.num_lines = n, .event_buffer_size = EVENT_BUFFER, .consumer = CONSUMER};
    r.config.flags = line_flags(&places[0], pull);
    for (uint32_t i = 0; i < n; i++) {
        if (strcmp(places[i].chip, places[0].chip) != 0)
            return pf_fail(failure, PF_ERR_ARGUMENT, "gpio: an encoder's lines must be of one chip, not of %s and %s",
                           places[0].chip, places[i].chip);
        r.offsets[i] = places[i].offset;
        r.config.attrs[i].mask = UINT64_C(1) << i;
        r.config.attrs[i].attr.id = GPIO_V2_LINE_ATTR_ID_FLAGS;
        r.config.attrs[i].attr.flags = line_flags(&places[i], pull);
    }
    r.config.num_attrs = n;
    int chip = open(places[0].chip, O_RDWR | O_CLOEXEC);
    if (chip < 0)
        return pf_fail(failure, PF_ERR_IO, "gpio: %s: %s", places[0].chip, strerror(errno));
    int result = ioctl(chip, GPIO_V2_GET_LINE_IOCTL, &r), why = errno;
    (void)close(chip);
    if (result != 0)
        return pf_line_fail_edges(places, n, why, failure);
    pf_edges *e = calloc(1, sizeof *e);
    if (e == NULL || fcntl(r.fd, F_SETFL, O_NONBLOCK) != 0) {
        (void)close(r.fd);
        free(e);
        return pf_fail(failure, PF_ERR_SPACE, "gpio: no memory");
    }
    e->fd = r.fd;
    e->n = n;
    memcpy(e->offset, r.offsets, n * sizeof e->offset[0]);
    *edges = e;
    return pf_edges_levels(e, levels);
}

int pf_edges_fd(const pf_edges *edges)
{
    return edges->fd;
}

pf_status pf_edges_read(pf_edges *edges, pf_edge out[PF_EDGES_READ_MAX], uint32_t *n)
{
    struct gpio_v2_line_event events[PF_EDGES_READ_MAX];
    ssize_t got = read(edges->fd, events, sizeof events);
    *n = 0;
    if (got < 0)
        return errno == EAGAIN || errno == EINTR ? PF_OK : PF_ERR_CLOSED;
    for (size_t i = 0; i < (size_t)got / sizeof events[0]; i++) {
        pf_edge *e = &out[(*n)++];
        e->line = edges->n > 1 && events[i].offset == edges->offset[1];
        e->is_active = events[i].id == GPIO_V2_LINE_EVENT_RISING_EDGE;
        e->number = events[i].seqno;
        e->time_ns = events[i].timestamp_ns;
    }
    return PF_OK;
}

pf_status pf_edges_levels(pf_edges *edges, uint32_t *levels)
{
    struct gpio_v2_line_values values = {.mask = (UINT64_C(1) << edges->n) - 1};
    if (ioctl(edges->fd, GPIO_V2_LINE_GET_VALUES_IOCTL, &values) != 0)
        return PF_ERR_CLOSED;
    *levels = (uint32_t)values.bits;
    return PF_OK;
}

void pf_edges_close(pf_edges *edges)
{
    if (edges == NULL)
        return;
    (void)close(edges->fd);
    free(edges);
}
