/* TCP on loopback: a listener, the connection that has the line, and a few that look on. One epoll descriptor holds
 * them all: it is what the daemon polls. */
#include "common/lines.h"
#include "pipefish/drivers/clock.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

/* A page in a browser can have any bytes sent to loopback, behind a request's first line. It must not have the line,
 * nor try session after session until it hits one. */
#define LINK_BEGINS 0                   /* the delimiter in front of the first frame (lib/link/SPEC.md) */
#define BEGIN_NS    UINT64_C(200000000) /* a connection without a frame for so long, as browsers hold some ready */

typedef struct tcp {
    pf_lines lines; /* first: what a line belongs to is a tcp */
    pf_line host, visitors[PF_VISITORS_MAX];
} tcp;

static tcp *owner(const pf_line *l)
{
    return (tcp *)l->lines;
}

static void take(pf_line *l, int fd)
{
    pf_line_drop(l);
    l->fd = fd;
    pf_line_watch(l, EPOLLIN);
}

static bool has_host(const tcp *t, uint64_t now)
{
    const uint64_t most = t->host.has_spoken ? t->lines.silence_ns : BEGIN_NS;
    return t->host.fd >= 0 && (most == 0 || now - t->lines.heard_ns < most);
}

/* The host has hung up; what it said last is to be read first, and the next one waits for so long. */
static bool is_leaving(const tcp *t)
{
    struct pollfd p = {.fd = t->host.fd, .events = POLLRDHUP};
    return t->host.fd >= 0 && poll(&p, 1, 0) > 0;
}

/* Takes the next one that waits, and lets it in where there is room. */
static pf_status admit(tcp *t, bool *fresh)
{
    pf_address peer;
    uint64_t now = pf_now();
    if (is_leaving(t))
        return PF_ERR_AGAIN;
    int fd;
    pf_status status = pf_lines_accept(&t->lines, &peer, &fd, now);
    if (status != PF_OK)
        return status;
    pf_line *place = pf_lines_place(&t->lines);
    if (!has_host(t, now)) {
        take(&t->host, fd);
        t->lines.heard_ns = now;
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
    pf_line *l = self;
    tcp *t = owner(l);
    pf_status status = PF_ERR_CLOSED;
    *fresh = false;
    if (l == &t->host)
        status = admit(t, fresh); /* one each time: the next waits no longer than a round of the daemon's */
    if (l->fd >= 0)
        return PF_OK;
    return status == PF_OK ? PF_ERR_AGAIN : status;
}

static pf_status hang_up(pf_line *l, const char *why)
{
    pf_line_drop(l);
    return pf_fail(&l->lines->failure, PF_ERR_CLOSED, "%s", why);
}

static pf_status tcp_read(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    pf_line *l = self;
    *done = 0;
    if (l->fd < 0)
        return PF_ERR_CLOSED;
    if (capacity == 0)
        return PF_OK;
    ssize_t k = recv(l->fd, bytes, capacity, 0);
    if (k > 0 && !l->has_begun && bytes[0] != LINK_BEGINS)
        return hang_up(l, "what connected does not speak the link");
    if (k > 0) {
        l->has_begun = true;
        *done = (size_t)k;
    } else if (k == 0) {
        return hang_up(l, "the other side closed the connection");
    } else if (errno != EAGAIN && errno != EINTR) {
        return hang_up(l, strerror(errno));
    }
    return PF_OK;
}

static pf_status tcp_write(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    pf_line *l = self;
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
    pf_line_watch(l, *done < n ? EPOLLIN | EPOLLOUT : EPOLLIN);
    return PF_OK;
}

static pf_role tcp_peer(void *self, const char **name, const pf_transport_stats **stats)
{
    pf_line *l = self;
    *name = "";
    *stats = NULL;
    return l->fd >= 0 ? PF_ROLE_CALIBRATOR : PF_ROLE_NONE;
}

static void tcp_close(void *self)
{
    pf_line *l = self;
    tcp *t = owner(l);
    pf_line_drop(l);
    if (l != &t->host)
        return;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        pf_line_drop(&t->visitors[i]);
    pf_lines_close(&t->lines);
    free(t);
}

static const pf_transport_ops tcp_ops = {
    .fd = pf_line_fd,
    .service = tcp_service,
    .visitor = pf_line_visitor,
    .read = tcp_read,
    .write = tcp_write,
    .heard = pf_line_heard,
    .room = pf_line_room,
    .peer = tcp_peer,
    .name = pf_line_name,
    .error = pf_line_error,
    .close = tcp_close,
};

static pf_status parse(pf_address *a, const pf_tcp_config *config, pf_failure *failure)
{
    pf_status status = pf_address_parse(a, config->address, config->port, "tcp", failure);
    if (status == PF_OK && !pf_address_is_loopback(a))
        status = pf_fail(failure, PF_ERR_UNSUPPORTED,
                         "tcp: %s is not a loopback address (127.0.0.1, ::1): what others can reach must be encrypted "
                         "(link.transport = tls)",
                         config->address);
    return status;
}

pf_status pf_tcp_check(const pf_tcp_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_address a;
    return pf_failure_copy(&failure, parse(&a, config, &failure), error, n);
}

pf_status pf_tcp_listen(pf_transport *transport, const pf_tcp_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_address a;
    pf_status status = parse(&a, config, &failure);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    tcp *t = calloc(1, sizeof *t);
    if (t == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "tcp: no memory"), error, n);
    t->lines = (pf_lines){.epoll = -1,
                          .listener = -1,
                          .host = &t->host,
                          .ops = &tcp_ops,
                          .silence_ns = config->silence_ms * UINT64_C(1000000)};
    t->host = pf_line_empty(&t->lines);
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        t->visitors[i] = t->host;
        t->lines.visitors[i] = &t->visitors[i];
    }
    status = pf_lines_open(&t->lines, &a, config->address, "tcp");
    if (status != PF_OK) {
        pf_failure_copy(&t->lines.failure, status, error, n);
        tcp_close(&t->host);
        return status;
    }
    transport->self = &t->host;
    transport->ops = &tcp_ops;
    return PF_OK;
}
