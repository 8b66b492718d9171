/* TCP on loopback: a listener, the connection that has the line, and a few that look on. One epoll descriptor holds
 * them all: it is what the daemon polls. */
#include "common/listener.h"
#include "pipefish/drivers/transport.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

typedef struct line {
    struct tcp *owner;
    int fd;          /* -1 = nobody */
    bool is_new;     /* a visitor whom nobody has taken over yet */
    uint32_t events; /* that epoll watches */
} line;

typedef struct tcp {
    int epoll, listener;
    line host, visitors[PF_VISITORS_MAX];
    uint64_t silence_ns, heard_ns; /* of the host */
    char name[PF_LISTENER_NAME_MAX];
    pf_failure failure;
} tcp;

static uint64_t now_ns(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

static int tcp_fd(void *self)
{
    line *l = self;
    return l->owner->epoll;
}

static void watch(line *l, uint32_t events)
{
    struct epoll_event e = {.events = events};
    if (l->events != events &&
        epoll_ctl(l->owner->epoll, l->events == 0 ? EPOLL_CTL_ADD : EPOLL_CTL_MOD, l->fd, &e) == 0)
        l->events = events;
}

static void drop(line *l)
{
    if (l->fd >= 0)
        (void)close(l->fd); /* which also ends its watch */
    *l = (line){.owner = l->owner, .fd = -1};
}

static void take(line *l, int fd)
{
    drop(l);
    l->fd = fd;
    watch(l, EPOLLIN);
}

static bool has_host(const tcp *t, uint64_t now)
{
    return t->host.fd >= 0 && (t->silence_ns == 0 || now - t->heard_ns < t->silence_ns);
}

/* The host has hung up; what it said last is to be read first, and the next one waits for so long. */
static bool is_leaving(const tcp *t)
{
    struct pollfd p = {.fd = t->host.fd, .events = POLLRDHUP};
    return t->host.fd >= 0 && poll(&p, 1, 0) > 0;
}

static line *free_place(tcp *t)
{
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        if (t->visitors[i].fd < 0)
            return &t->visitors[i];
    return NULL;
}

/* Takes the next one that waits, and lets it in where there is room. */
static pf_status admit(tcp *t, bool *fresh)
{
    pf_address peer;
    uint64_t now = now_ns();
    if (is_leaving(t))
        return PF_ERR_AGAIN;
    int fd = pf_listener_accept(t->listener, &peer);
    if (fd < 0) {
        if (errno == EAGAIN || errno == EINTR || errno == ECONNABORTED)
            return PF_ERR_AGAIN;
        return pf_fail(&t->failure, PF_ERR_IO, "accept: %s", strerror(errno));
    }
    line *place = free_place(t);
    if (!has_host(t, now)) {
        take(&t->host, fd);
        t->heard_ns = now;
        *fresh = true;
    } else if (place != NULL) {
        take(place, fd);
        place->is_new = true;
    } else {
        (void)close(fd);
    }
    return PF_OK;
}

static pf_status tcp_service(void *self, bool *fresh)
{
    line *l = self;
    tcp *t = l->owner;
    pf_status status = PF_ERR_CLOSED;
    *fresh = false;
    if (l == &t->host)
        status = admit(t, fresh); /* one each time: the next waits no longer than a round of the daemon's */
    if (l->fd >= 0)
        return PF_OK;
    return status == PF_OK ? PF_ERR_AGAIN : status;
}

static const pf_transport_ops tcp_ops;

static bool tcp_visitor(void *self, pf_transport *visitor)
{
    line *l = self;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        line *v = &l->owner->visitors[i];
        if (!v->is_new)
            continue;
        v->is_new = false;
        visitor->self = v;
        visitor->ops = &tcp_ops;
        return true;
    }
    return false;
}

static pf_status hang_up(line *l, const char *why)
{
    drop(l);
    return pf_fail(&l->owner->failure, PF_ERR_CLOSED, "%s", why);
}

static pf_status tcp_read(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    line *l = self;
    *done = 0;
    if (l->fd < 0)
        return PF_ERR_CLOSED;
    if (capacity == 0)
        return PF_OK;
    ssize_t k = recv(l->fd, bytes, capacity, 0);
    if (k > 0) {
        *done = (size_t)k;
        if (l == &l->owner->host)
            l->owner->heard_ns = now_ns();
    } else if (k == 0) {
        return hang_up(l, "the other side closed the connection");
    } else if (errno != EAGAIN && errno != EINTR) {
        return hang_up(l, strerror(errno));
    }
    return PF_OK;
}

static pf_status tcp_write(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    line *l = self;
    *done = 0;
    if (l->fd < 0)
        return PF_ERR_CLOSED;
    if (n == 0)
        return PF_OK;
    ssize_t k = send(l->fd, bytes, n, MSG_NOSIGNAL);
    if (k > 0)
        *done = (size_t)k;
    else if (k < 0 && errno != EAGAIN && errno != EINTR)
        return hang_up(l, strerror(errno));
    watch(l, *done < n ? EPOLLIN | EPOLLOUT : EPOLLIN);
    return PF_OK;
}

static size_t tcp_room(void *self)
{
    line *l = self;
    return pf_tcp_queue_room(l->fd);
}

static pf_role tcp_peer(void *self, const char **name, const pf_transport_stats **stats)
{
    line *l = self;
    *name = "";
    *stats = NULL;
    return l->fd >= 0 ? PF_ROLE_CALIBRATOR : PF_ROLE_NONE;
}

static const char *tcp_name(void *self)
{
    line *l = self;
    return l->owner->name;
}

static const char *tcp_error(void *self)
{
    line *l = self;
    return l->owner->failure.text;
}

static void tcp_close(void *self)
{
    line *l = self;
    tcp *t = l->owner;
    drop(l);
    if (l != &t->host)
        return;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        drop(&t->visitors[i]);
    if (t->listener >= 0)
        (void)close(t->listener);
    if (t->epoll >= 0)
        (void)close(t->epoll);
    free(t);
}

static pf_status open_sockets(tcp *t, const pf_address *address, const char *numeric)
{
    struct epoll_event e = {.events = EPOLLIN};
    pf_status status = pf_listener_open(&t->listener, t->name, address, numeric, "tcp", &t->failure);
    if (status != PF_OK)
        return status;
    t->epoll = epoll_create1(EPOLL_CLOEXEC);
    if (t->epoll < 0 || epoll_ctl(t->epoll, EPOLL_CTL_ADD, t->listener, &e) != 0)
        return pf_fail(&t->failure, PF_ERR_IO, "%s: epoll: %s", t->name, strerror(errno));
    return PF_OK;
}

static const pf_transport_ops tcp_ops = {
    .fd = tcp_fd,
    .service = tcp_service,
    .visitor = tcp_visitor,
    .read = tcp_read,
    .write = tcp_write,
    .room = tcp_room,
    .peer = tcp_peer,
    .name = tcp_name,
    .error = tcp_error,
    .close = tcp_close,
};

pf_status pf_tcp_listen(pf_transport *transport, const pf_tcp_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_address a;
    pf_status status = pf_address_parse(&a, config->address, config->port, "tcp", &failure);
    if (status == PF_OK && !pf_address_is_loopback(&a))
        status = pf_fail(&failure, PF_ERR_UNSUPPORTED,
                         "tcp: %s is not a loopback address (127.0.0.1, ::1): what others can reach must be encrypted "
                         "(link.transport = tls)",
                         config->address);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    tcp *t = calloc(1, sizeof *t);
    if (t == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "tcp: no memory"), error, n);
    t->epoll = t->listener = -1;
    t->host = (line){.owner = t, .fd = -1};
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        t->visitors[i] = t->host;
    t->silence_ns = config->silence_ms * UINT64_C(1000000);
    status = open_sockets(t, &a, config->address);
    if (status != PF_OK) {
        pf_failure_copy(&t->failure, status, error, n);
        tcp_close(&t->host);
        return status;
    }
    transport->self = &t->host;
    transport->ops = &tcp_ops;
    return PF_OK;
}
