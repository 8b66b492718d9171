/* A crawler's lamp, wheel, buttons and LED. One thread of its own watches the inputs: what a button does must not wait
 * for anybody. */
#include "gpio/wheel.h"
#include "pipefish/drivers/clock.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#define TICK_MS 100u /* of the LED, and between two readings of a counter */
#define BUTTONS 3u   /* the stop, two limit switches */

/* A lamp: a line, or the kernel's LED with its brightness. */
typedef struct light {
    pf_line_output *line;
    int fd; /* brightness; -1 = none */
    long max;
    double level;
} light;

typedef struct button {
    pf_edges *edges;
    bool is_pressed, is_broken;
} button;

typedef struct board {
    pthread_t thread;
    bool is_running;
    int wake; /* eventfd */
    light lamp, led;
    pthread_mutex_t mutex; /* of all below, and of the lamp */
    bool is_over, is_stopped, lamp_is_broken;
    pf_indication indication;
    uint32_t ticks;
    uint64_t round_ns;
    button button[BUTTONS];
    pf_wheel wheel;
    pf_failure failure;
} board;

/* ---- lights */

static pf_status open_light(light *l, const char *what, const char *name, pf_failure *failure)
{
    pf_line_place place;
    l->fd = -1;
    if (name == NULL || name[0] == '\0')
        return PF_OK;
    if (name[0] != '/') {
        pf_status status = pf_line_find(name, &place, failure);
        return status == PF_OK ? pf_line_output_open(&l->line, &place, failure) : status;
    }
    char path[256], text[16] = "";
    (void)snprintf(path, sizeof path, "%.200s/max_brightness", name);
    FILE *in = fopen(path, "r");
    bool is_read = in != NULL && fgets(text, sizeof text, in) != NULL;
    if (in != NULL)
        (void)fclose(in);
    (void)snprintf(path, sizeof path, "%.200s/brightness", name);
    l->fd = is_read ? open(path, O_WRONLY | O_CLOEXEC) : -1;
    l->max = strtol(text, NULL, 10);
    if (l->fd < 0 || l->max < 1)
        return pf_fail(failure, PF_ERR_IO, "gpio.%s: %s: %s", what, path,
                       l->fd < 0 ? strerror(errno) : "its max_brightness is no number");
    return PF_OK;
}

static bool has_light(const light *l)
{
    return l->line != NULL || l->fd >= 0;
}

static pf_status set_light(light *l, double level)
{
    char text[24];
    pf_status status = PF_ERR_UNSUPPORTED;
    if (l->line != NULL) {
        level = level > 0 ? 1 : 0;
        status = pf_line_output_set(l->line, level > 0);
    } else if (l->fd >= 0) {
        int n = snprintf(text, sizeof text, "%ld", (long)(level * (double)l->max + 0.5));
        status = pwrite(l->fd, text, (size_t)n, 0) == n ? PF_OK : PF_ERR_IO;
    }
    if (status == PF_OK)
        l->level = level;
    return status;
}

static void close_light(light *l)
{
    if (has_light(l))
        (void)set_light(l, 0);
    pf_line_output_close(l->line);
    if (l->fd >= 0)
        (void)close(l->fd);
}

/* ---- inputs */

static pf_status open_button(button *b, const char *name, pf_pull pull, pf_failure *failure)
{
    pf_line_place place;
    uint32_t level = 0;
    if (name == NULL || name[0] == '\0')
        return PF_OK;
    pf_status status = pf_line_find(name, &place, failure);
    if (status == PF_OK)
        status = pf_edges_open(&b->edges, &place, 1, pull, &level, failure);
    b->is_pressed = level != 0;
    return status;
}

/* True: it has been pressed meanwhile, however short. */
static bool read_button(button *b)
{
    pf_edge edge[PF_EDGES_READ_MAX];
    uint32_t n = 0, level = 0;
    bool was_pressed = false;
    do {
        if (pf_edges_read(b->edges, edge, &n) != PF_OK) {
            b->is_broken = true;
            return false;
        }
        for (uint32_t i = 0; i < n; i++)
            was_pressed = was_pressed || edge[i].is_active;
    } while (n == PF_EDGES_READ_MAX);
    if (pf_edges_levels(b->edges, &level) != PF_OK)
        b->is_broken = true;
    b->is_pressed = level != 0;
    return was_pressed || b->is_pressed;
}

/* The lamp of a crawler that is stopped goes off, however often that has to be tried. */
static void keep_dark(board *b)
{
    if (b->is_stopped && has_light(&b->lamp) && b->lamp.level > 0)
        b->lamp_is_broken = set_light(&b->lamp, 0) != PF_OK;
}

/* A button that cannot be read any more counts as pressed. */
static void stop_if_pressed(board *b)
{
    bool must = (b->button[0].edges != NULL && read_button(&b->button[0])) || b->button[0].is_broken;
    b->is_stopped = b->is_stopped || must;
    keep_dark(b);
}

/* Each tick: an edge may be lost on its way (an expander on a bus, an overrun), a level stays. */
static void check_stop(board *b)
{
    button *stop = &b->button[0];
    uint32_t level = 0;
    if (stop->edges != NULL && !stop->is_broken) {
        stop->is_broken = pf_edges_levels(stop->edges, &level) != PF_OK;
        stop->is_pressed = level != 0;
        b->is_stopped = b->is_stopped || stop->is_pressed || stop->is_broken;
    }
    keep_dark(b);
}

static void show(board *b)
{
    const bool slow = b->ticks / 5 % 2 == 0, fast = b->ticks % 2 == 0;
    bool is_on = b->is_stopped || b->indication == PF_INDICATE_TROUBLE ? fast
                 : b->indication == PF_INDICATE_SEND                   ? slow
                                                                       : b->indication == PF_INDICATE_WORK;
    if (has_light(&b->led) && (b->led.level > 0) != is_on)
        (void)set_light(&b->led, is_on ? 1 : 0);
}

static void *watch(void *argument)
{
    board *b = argument;
    uint64_t tick = pf_now();
    (void)pthread_setname_np(pthread_self(), "GPIO");
    pthread_mutex_lock(&b->mutex);
    while (!b->is_over) {
        struct pollfd fd[2 + BUTTONS] = {{b->wake, POLLIN, 0}, {pf_wheel_fd(&b->wheel), POLLIN, 0}};
        for (uint32_t i = 0; i < BUTTONS; i++)
            fd[2 + i] = (struct pollfd){
                b->button[i].edges != NULL && !b->button[i].is_broken ? pf_edges_fd(b->button[i].edges) : -1, POLLIN,
                0};
        pthread_mutex_unlock(&b->mutex);
        (void)poll(fd, 2 + BUTTONS, (int)TICK_MS);
        uint64_t now = pf_now();
        pthread_mutex_lock(&b->mutex);
        b->round_ns = now;
        if (fd[2].revents != 0)
            stop_if_pressed(b);
        for (uint32_t i = 1; i < BUTTONS; i++)
            if (fd[2 + i].revents != 0)
                (void)read_button(&b->button[i]);
        if (fd[1].revents != 0 || fd[1].fd < 0)
            pf_wheel_read(&b->wheel, now);
        if (now - tick >= TICK_MS * 1000000u) {
            tick = now;
            b->ticks++;
            check_stop(b);
            show(b);
        }
    }
    pthread_mutex_unlock(&b->mutex);
    return NULL;
}

/* ---- the interface */

static pf_status board_set_lamp(void *self, double level)
{
    board *b = self;
    pf_status status = PF_ERR_CLOSED;
    pthread_mutex_lock(&b->mutex);
    if (!has_light(&b->lamp))
        status = PF_ERR_UNSUPPORTED;
    else if (!b->is_stopped)
        status = set_light(&b->lamp, level);
    pthread_mutex_unlock(&b->mutex);
    return status;
}

static pf_status board_lamp(void *self, double *level)
{
    board *b = self;
    pthread_mutex_lock(&b->mutex);
    bool has = has_light(&b->lamp);
    *level = b->lamp.level;
    pthread_mutex_unlock(&b->mutex);
    return has ? PF_OK : PF_ERR_UNSUPPORTED;
}

static pf_status board_encoder(void *self, uint64_t time_ns, int64_t *count, uint32_t *missed)
{
    board *b = self;
    pf_status status = b->wheel.kind == PF_WHEEL_NONE ? PF_ERR_UNSUPPORTED : PF_OK;
    if (status != PF_OK)
        return status;
    pthread_mutex_lock(&b->mutex);
    pf_wheel_read(&b->wheel, pf_now()); /* what the thread has not come to yet */
    *count = pf_history_at(&b->wheel.history, time_ns, b->wheel.decoder.count);
    *missed = b->wheel.decoder.missed;
    if (b->wheel.is_broken)
        status = PF_ERR_IO;
    pthread_mutex_unlock(&b->mutex);
    return status;
}

static void board_indicate(void *self, pf_indication indication)
{
    board *b = self;
    pthread_mutex_lock(&b->mutex);
    b->indication = indication;
    pthread_mutex_unlock(&b->mutex);
}

static void board_state(void *self, pf_gpio_state *state)
{
    board *b = self;
    pthread_mutex_lock(&b->mutex);
    *state = (pf_gpio_state){.has_stop = b->button[0].edges != NULL,
                             .is_stopped = b->is_stopped,
                             .limits = (b->button[1].is_pressed ? PF_LIMIT_FRONT : 0u) |
                                       (b->button[2].is_pressed ? PF_LIMIT_REAR : 0u),
                             .missed = b->wheel.decoder.missed,
                             .repeated = b->wheel.decoder.repeated,
                             .illegal = b->wheel.decoder.illegal,
                             .round_ns = b->round_ns,
                             .is_broken = b->wheel.is_broken || b->lamp_is_broken};
    for (uint32_t i = 0; i < BUTTONS; i++)
        state->is_broken = state->is_broken || b->button[i].is_broken;
    memcpy(state->encoder, b->wheel.name, sizeof state->encoder);
    pthread_mutex_unlock(&b->mutex);
}

static void board_close(void *self)
{
    board *b = self;
    if (b->is_running) {
        pthread_mutex_lock(&b->mutex);
        b->is_over = true;
        pthread_mutex_unlock(&b->mutex);
        ssize_t woken = write(b->wake, &(uint64_t){1}, sizeof(uint64_t));
        (void)woken; /* or it wakes by itself, a tick later */
        (void)pthread_join(b->thread, NULL);
    }
    close_light(&b->lamp);
    close_light(&b->led);
    for (uint32_t i = 0; i < BUTTONS; i++)
        pf_edges_close(b->button[i].edges);
    pf_wheel_close(&b->wheel);
    if (b->wake >= 0)
        (void)close(b->wake);
    (void)pthread_mutex_destroy(&b->mutex);
    free(b);
}

static pf_status open_parts(board *b, const pf_gpio_config *c)
{
    const pf_pull pull = (pf_pull)c->pull;
    pf_failure *f = &b->failure;
    const char *const names[BUTTONS] = {c->stop, c->limit_front, c->limit_rear};
    pf_status status = open_light(&b->lamp, "lamp", c->lamp, f);
    if (status == PF_OK)
        status = open_light(&b->led, "led", c->led, f);
    for (uint32_t i = 0; status == PF_OK && i < BUTTONS; i++)
        status = open_button(&b->button[i], names[i], pull, f);
    if (status == PF_OK)
        status = pf_wheel_open(&b->wheel, c, f);
    if (status != PF_OK)
        return status;
    b->is_stopped = b->button[0].is_pressed;
    if (has_light(&b->lamp) && !b->is_stopped && set_light(&b->lamp, c->lamp_level) != PF_OK)
        return pf_fail(f, PF_ERR_IO, "gpio.lamp: %s: cannot be set", c->lamp);
    b->round_ns = pf_now();
    b->wake = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    if (b->wake < 0 || pthread_create(&b->thread, NULL, watch, b) != 0)
        return pf_fail(f, PF_ERR_SPACE, "gpio: cannot start its thread");
    b->is_running = true;
    return PF_OK;
}

pf_status pf_gpio_board_open(pf_gpio *gpio, const pf_gpio_config *config, char *error, size_t n)
{
    static const pf_gpio_ops ops = {.set_lamp = board_set_lamp,
                                    .lamp = board_lamp,
                                    .encoder = board_encoder,
                                    .indicate = board_indicate,
                                    .state = board_state,
                                    .close = board_close};
    board *b = calloc(1, sizeof *b);
    pf_failure failure = {""};
    if (b == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "gpio: no memory"), error, n);
    b->wake = b->lamp.fd = b->led.fd = b->wheel.fd = -1;
    (void)pthread_mutex_init(&b->mutex, NULL);
    pf_status status = open_parts(b, config);
    if (status != PF_OK) {
        pf_failure_copy(&b->failure, status, error, n);
        board_close(b);
        return status;
    }
    gpio->self = b;
    gpio->ops = &ops;
    return PF_OK;
}
