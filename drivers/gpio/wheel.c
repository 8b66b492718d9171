#include "gpio/wheel.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/input.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#define COUNTER_PATH "/sys/bus/counter/devices/counter0/count0/count"
#define INPUTS_MAX   32

static bool is_set(const char *text)
{
    return text != NULL && text[0] != '\0';
}

/* ---- the kernel's counter */

/* A number in a file of sysfs. */
static bool read_number(int fd, uint64_t *value)
{
    char text[32];
    ssize_t n = pread(fd, text, sizeof text - 1, 0);
    if (n <= 0)
        return false;
    text[n] = '\0';
    char *end;
    errno = 0;
    *value = strtoull(text, &end, 10);
    return errno == 0 && end != text && (*end == '\n' || *end == '\0');
}

/* The file beside the count that says where it begins again. */
static uint64_t read_modulus(const char *path)
{
    char beside[256];
    uint64_t ceiling = 0;
    const char *slash = strrchr(path, '/');
    (void)snprintf(beside, sizeof beside, "%.*s/ceiling", slash != NULL ? (int)(slash - path) : 1,
                   slash != NULL ? path : ".");
    int fd = open(beside, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return 0;
    if (!read_number(fd, &ceiling))
        ceiling = 0;
    (void)close(fd);
    return ceiling == UINT64_MAX || ceiling == 0 ? 0 : ceiling + 1;
}

static pf_status open_counter(pf_wheel *w, const char *path, pf_failure *failure)
{
    w->fd = open(path, O_RDONLY | O_CLOEXEC);
    if (w->fd < 0)
        return pf_fail(failure, errno == ENOENT ? PF_ERR_END : PF_ERR_IO, "gpio.encoder: %s: %s", path,
                       strerror(errno));
    w->modulus = read_modulus(path);
    if (!read_number(w->fd, &w->raw))
        return pf_fail(failure, PF_ERR_FORMAT, "gpio.encoder: %s: not a counter's value", path);
    w->kind = PF_WHEEL_COUNTER;
    return PF_OK;
}

static void read_counter(pf_wheel *w, uint64_t now_ns)
{
    uint64_t raw;
    if (!read_number(w->fd, &raw)) {
        w->is_broken = true;
        return;
    }
    uint64_t step = raw - w->raw;
    if (w->modulus != 0) {
        step = raw >= w->raw ? raw - w->raw : raw + w->modulus - w->raw;
        if (step > w->modulus / 2) /* the short way round */
            step -= w->modulus;
    }
    w->raw = raw;
    w->decoder.count += (int64_t)step;
    pf_history_add(&w->history, now_ns, w->decoder.count);
}

/* ---- the kernel's rotary encoder */

static pf_status open_input(pf_wheel *w, const char *path, bool must_be_rotary, pf_failure *failure)
{
    unsigned long types = 0;
    char name[64] = "";
    int clock = CLOCK_MONOTONIC;
    w->fd = open(path, O_RDONLY | O_NONBLOCK | O_CLOEXEC);
    if (w->fd < 0)
        return pf_fail(failure, errno == ENOENT ? PF_ERR_END : PF_ERR_IO, "gpio.encoder: %s: %s", path,
                       strerror(errno));
    if (ioctl(w->fd, EVIOCGBIT(0, sizeof types), &types) < 0 || !(types >> EV_REL & 1))
        return pf_fail(failure, PF_ERR_FORMAT, "gpio.encoder: %s: not an input device that counts steps", path);
    (void)ioctl(w->fd, EVIOCGNAME(sizeof name - 1), name);
    if (must_be_rotary && strstr(name, "rotary") == NULL)
        return pf_fail(failure, PF_ERR_END, "gpio.encoder: %s: not a rotary encoder", path);
    if (ioctl(w->fd, EVIOCSCLOCKID, &clock) != 0)
        return pf_fail(failure, PF_ERR_UNSUPPORTED, "gpio.encoder: %s: has no monotonic times", path);
    w->kind = PF_WHEEL_INPUT;
    return PF_OK;
}

static void read_input(pf_wheel *w)
{
    struct input_event e;
    ssize_t n;
    while ((n = read(w->fd, &e, sizeof e)) == (ssize_t)sizeof e) {
        if (e.type == EV_SYN && e.code == SYN_DROPPED)
            w->decoder.missed++; /* at least one */
        if (e.type != EV_REL)
            continue;
        w->decoder.count += e.value;
        pf_history_add(&w->history, (uint64_t)e.input_event_sec * 1000000000u + (uint64_t)e.input_event_usec * 1000u,
                       w->decoder.count);
    }
    if (n < 0 && errno != EAGAIN && errno != EINTR)
        w->is_broken = true;
}

/* ---- two lines */

static pf_status open_lines(pf_wheel *w, const pf_gpio_config *c, pf_failure *failure)
{
    pf_line_place places[2];
    uint32_t levels;
    if (!is_set(c->encoder_a) || !is_set(c->encoder_b))
        return pf_fail(failure, PF_ERR_ARGUMENT, "gpio.encoder: its lines are not named");
    pf_status status = pf_line_find(c->encoder_a, &places[0], failure);
    if (status == PF_OK)
        status = pf_line_find(c->encoder_b, &places[1], failure);
    if (status == PF_OK)
        status = pf_edges_open(&w->edges, places, 2, (pf_pull)c->pull, &levels, failure);
    if (status != PF_OK)
        return status;
    pf_quadrature_init(&w->decoder, levels & 1u, levels >> 1 & 1u);
    w->kind = PF_WHEEL_LINES;
    return PF_OK;
}

static void decode(pf_wheel *w, uint64_t now_ns)
{
    pf_edge e;
    while (pf_edge_order_next(&w->order, now_ns, &e)) {
        pf_quadrature_edge(&w->decoder, (int)e.line, e.is_active, e.number);
        pf_history_add(&w->history, e.time_ns, w->decoder.count);
    }
}

static void read_lines(pf_wheel *w, uint64_t now_ns)
{
    pf_edge edge[PF_EDGES_READ_MAX];
    uint32_t n;
    do {
        if (pf_edges_read(w->edges, edge, &n) != PF_OK) {
            w->is_broken = true;
            return;
        }
        for (uint32_t i = 0; i < n; i++) {
            pf_edge_order_add(&w->order, &edge[i]);
            decode(w, now_ns);
        }
    } while (n == PF_EDGES_READ_MAX);
    decode(w, now_ns);
}

/* ---- any of them */

/* A name that does not fit is no reason to fail. */
static void name_it(pf_wheel *w, const char *name)
{
    (void)snprintf(w->name, sizeof w->name, "%.79s", name);
}

static pf_status open_auto(pf_wheel *w, const pf_gpio_config *c, pf_failure *failure)
{
    if (open_counter(w, COUNTER_PATH, failure) == PF_OK) {
        name_it(w, COUNTER_PATH);
        return PF_OK;
    }
    pf_wheel_close(w);
    for (int i = 0; i < INPUTS_MAX; i++) {
        char path[32];
        (void)snprintf(path, sizeof path, "/dev/input/event%d", i);
        if (open_input(w, path, true, failure) == PF_OK) {
            name_it(w, path);
            return PF_OK;
        }
        pf_wheel_close(w);
    }
    name_it(w, "lines");
    return open_lines(w, c, failure);
}

pf_status pf_wheel_open(pf_wheel *w, const pf_gpio_config *c, pf_failure *failure)
{
    w->fd = -1;
    if (!is_set(c->encoder))
        return PF_OK;
    pf_history_add(&w->history, 0, 0); /* of frames that were exposed before the first edge */
    name_it(w, c->encoder);
    if (strcmp(c->encoder, "auto") == 0)
        return open_auto(w, c, failure);
    if (strcmp(c->encoder, "lines") == 0)
        return open_lines(w, c, failure);
    if (strncmp(c->encoder, "/dev/input/", 11) == 0)
        return open_input(w, c->encoder, false, failure);
    if (c->encoder[0] == '/')
        return open_counter(w, c->encoder, failure);
    return pf_fail(failure, PF_ERR_ARGUMENT, "gpio.encoder = %s: must be auto, lines, or a path", c->encoder);
}

int pf_wheel_fd(const pf_wheel *w)
{
    if (w->is_broken)
        return -1;
    return w->kind == PF_WHEEL_LINES ? pf_edges_fd(w->edges) : w->kind == PF_WHEEL_INPUT ? w->fd : -1;
}

void pf_wheel_read(pf_wheel *w, uint64_t now_ns)
{
    if (w->is_broken)
        return;
    if (w->kind == PF_WHEEL_COUNTER)
        read_counter(w, now_ns);
    else if (w->kind == PF_WHEEL_INPUT)
        read_input(w);
    else if (w->kind == PF_WHEEL_LINES)
        read_lines(w, now_ns);
}

void pf_wheel_close(pf_wheel *w)
{
    if (w->fd >= 0)
        (void)close(w->fd);
    w->fd = -1;
    pf_edges_close(w->edges);
    w->edges = NULL;
    w->kind = PF_WHEEL_NONE;
}
