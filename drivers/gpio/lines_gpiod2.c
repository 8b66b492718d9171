/* GPIO lines with libgpiod 2.x. */
#include "gpio/lines.h"
#include "gpio/place.h"

#include <errno.h>
#include <fcntl.h>
#include <gpiod.h>
#include <stdlib.h>
#include <string.h>

#define CONSUMER     "pipefishd"
#define EVENT_BUFFER 1024u

struct pf_line_output {
    struct gpiod_line_request *request;
    uint32_t offset;
};

struct pf_edges {
    struct gpiod_line_request *request;
    struct gpiod_edge_event_buffer *buffer;
    uint32_t n, offset[PF_EDGES_LINES_MAX];
};

/* Asks for lines of one chip; NULL and errno. */
static struct gpiod_line_request *request_lines(const pf_line_place *places, uint32_t n, bool is_input, pf_pull pull)
{
    struct gpiod_chip *chip = gpiod_chip_open(places[0].chip);
    struct gpiod_line_settings *settings = gpiod_line_settings_new();
    struct gpiod_line_config *lines = gpiod_line_config_new();
    struct gpiod_request_config *config = gpiod_request_config_new();
    struct gpiod_line_request *request = NULL;
    bool ok = chip != NULL && settings != NULL && lines != NULL && config != NULL;
    for (uint32_t i = 0; ok && i < n; i++) {
        unsigned offset = places[i].offset;
        gpiod_line_settings_reset(settings);
        gpiod_line_settings_set_active_low(settings, places[i].is_active_low);
        (void)gpiod_line_settings_set_direction(settings,
                                                is_input ? GPIOD_LINE_DIRECTION_INPUT : GPIOD_LINE_DIRECTION_OUTPUT);
        if (is_input) {
            (void)gpiod_line_settings_set_edge_detection(settings, GPIOD_LINE_EDGE_BOTH);
            (void)gpiod_line_settings_set_bias(settings, pull == PF_PULL_UP     ? GPIOD_LINE_BIAS_PULL_UP
                                                         : pull == PF_PULL_DOWN ? GPIOD_LINE_BIAS_PULL_DOWN
                                                                                : GPIOD_LINE_BIAS_AS_IS);
        }
        ok = gpiod_line_config_add_line_settings(lines, &offset, 1, settings) == 0;
    }
    if (ok) {
        gpiod_request_config_set_consumer(config, CONSUMER);
        gpiod_request_config_set_event_buffer_size(config, EVENT_BUFFER);
        request = gpiod_chip_request_lines(chip, config, lines);
    }
    int why = errno;
    gpiod_request_config_free(config);
    gpiod_line_config_free(lines);
    gpiod_line_settings_free(settings);
    if (chip != NULL)
        gpiod_chip_close(chip);
    errno = why;
    return request;
}

pf_status pf_line_output_open(pf_line_output **output, const pf_line_place *place, pf_failure *failure)
{
    struct gpiod_line_request *request = request_lines(place, 1, false, PF_PULL_NONE);
    pf_line_output *o = request != NULL ? calloc(1, sizeof *o) : NULL;
    if (o == NULL) {
        pf_status status =
            pf_fail(failure, PF_ERR_IO, "gpio: %s line %u: %s", place->chip, place->offset, strerror(errno));
        if (request != NULL)
            gpiod_line_request_release(request);
        return status;
    }
    o->request = request;
    o->offset = place->offset;
    *output = o;
    return PF_OK;
}

pf_status pf_line_output_set(pf_line_output *output, bool is_active)
{
    return gpiod_line_request_set_value(output->request, output->offset,
                                        is_active ? GPIOD_LINE_VALUE_ACTIVE : GPIOD_LINE_VALUE_INACTIVE) == 0
               ? PF_OK
               : PF_ERR_IO;
}

void pf_line_output_close(pf_line_output *output)
{
    if (output == NULL)
        return;
    gpiod_line_request_release(output->request);
    free(output);
}

pf_status pf_edges_open(pf_edges **edges, const pf_line_place *places, uint32_t n, pf_pull pull, uint32_t *levels,
                        pf_failure *failure)
{
    for (uint32_t i = 1; i < n; i++)
        if (strcmp(places[i].chip, places[0].chip) != 0)
            return pf_fail(failure, PF_ERR_ARGUMENT, "gpio: an encoder's lines must be of one chip, not of %s and %s",
                           places[0].chip, places[i].chip);
    struct gpiod_line_request *request = request_lines(places, n, true, pull);
    if (request == NULL)
        return pf_line_fail_edges(places, n, errno, failure);
    pf_edges *e = calloc(1, sizeof *e);
    struct gpiod_edge_event_buffer *buffer = gpiod_edge_event_buffer_new(PF_EDGES_READ_MAX);
    if (e == NULL || buffer == NULL || fcntl(gpiod_line_request_get_fd(request), F_SETFL, O_NONBLOCK) != 0) {
        gpiod_line_request_release(request);
        gpiod_edge_event_buffer_free(buffer);
        free(e);
        return pf_fail(failure, PF_ERR_SPACE, "gpio: no memory");
    }
    *e = (pf_edges){.request = request, .buffer = buffer, .n = n};
    for (uint32_t i = 0; i < n; i++)
        e->offset[i] = places[i].offset;
    *edges = e;
    return pf_edges_levels(e, levels);
}

int pf_edges_fd(const pf_edges *edges)
{
    return gpiod_line_request_get_fd(edges->request);
}

pf_status pf_edges_read(pf_edges *edges, pf_edge out[PF_EDGES_READ_MAX], uint32_t *n)
{
    int got = gpiod_line_request_read_edge_events(edges->request, edges->buffer, PF_EDGES_READ_MAX);
    *n = 0;
    if (got < 0)
        return errno == EAGAIN || errno == EINTR ? PF_OK : PF_ERR_CLOSED;
    for (unsigned long i = 0; i < (unsigned long)got; i++) {
        struct gpiod_edge_event *event = gpiod_edge_event_buffer_get_event(edges->buffer, i);
        pf_edge *e = &out[(*n)++];
        e->line = edges->n > 1 && gpiod_edge_event_get_line_offset(event) == edges->offset[1];
        e->is_active = gpiod_edge_event_get_event_type(event) == GPIOD_EDGE_EVENT_RISING_EDGE;
        e->number = (uint32_t)gpiod_edge_event_get_global_seqno(event);
        e->time_ns = gpiod_edge_event_get_timestamp_ns(event);
    }
    return PF_OK;
}

pf_status pf_edges_levels(pf_edges *edges, uint32_t *levels)
{
    *levels = 0;
    for (uint32_t i = 0; i < edges->n; i++) {
        enum gpiod_line_value value = gpiod_line_request_get_value(edges->request, edges->offset[i]);
        if (value == GPIOD_LINE_VALUE_ERROR)
            return PF_ERR_CLOSED;
        *levels |= (value == GPIOD_LINE_VALUE_ACTIVE ? 1u : 0u) << i;
    }
    return PF_OK;
}

void pf_edges_close(pf_edges *edges)
{
    if (edges == NULL)
        return;
    gpiod_line_request_release(edges->request);
    gpiod_edge_event_buffer_free(edges->buffer);
    free(edges);
}
