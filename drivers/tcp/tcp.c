/* TCP on loopback: a listener and at most one connection. */
#include "common/failure.h"
#include "pipefish/drivers/transport.h"
#include "pipefish/link.h"

#include <arpa/inet.h>
#include <errno.h>
#include <linux/sockios.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#define QUEUE_MAX_BYTES 65536u
#define BACKLOG         4

typedef struct tcp {
    int listener, connection; /* connection -1 = nobody */
    char name[80];
    pf_failure failure;
} tcp;

typedef union address {
    struct sockaddr any;
    struct sockaddr_in v4;
    struct sockaddr_in6 v6;
} address;

/* A loopback address in numbers; nothing else is listened on before there is TLS. */
static pf_status parse_address(const pf_tcp_config *config, address *a, socklen_t *size, pf_failure *failure)
{
    memset(a, 0, sizeof *a);
    bool is_loopback;
    if (config->address != NULL && inet_pton(AF_INET, config->address, &a->v4.sin_addr) == 1) {
        a->v4.sin_family = AF_INET;
        a->v4.sin_port = htons(config->port);
        *size = sizeof a->v4;
        is_loopback = (ntohl(a->v4.sin_addr.s_addr) >> 24) == 127;
    } else if (config->address != NULL && inet_pton(AF_INET6, config->address, &a->v6.sin6_addr) == 1) {
        a->v6.sin6_family = AF_INET6;
        a->v6.sin6_port = htons(config->port);
        *size = sizeof a->v6;
        is_loopback = IN6_IS_ADDR_LOOPBACK(&a->v6.sin6_addr);
    } else {
        return pf_fail(failure, PF_ERR_ARGUMENT, "tcp: \"%s\" is no numeric address such as 127.0.0.1 or ::1",
                       config->address != NULL ? config->address : "");
    }
    if (!is_loopback)
        return pf_fail(failure, PF_ERR_UNSUPPORTED,
                       "tcp: %s is not a loopback address (127.0.0.1, ::1): listening to others needs TLS, which this "
                       "version does not have",
                       config->address);
    return PF_OK;
}

static int tcp_fd(void *self)
{
    tcp *t = self;
    return t->connection >= 0 ? t->connection : t->listener;
}

static pf_status tcp_service(void *self, bool *fresh)
{
    tcp *t = self;
    int on = 1;
    *fresh = false;
    if (t->connection >= 0)
        return PF_OK;
    int fd = accept4(t->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd < 0) {
        if (errno == EAGAIN || errno == EINTR || errno == ECONNABORTED)
            return PF_ERR_AGAIN;
        return pf_fail(&t->failure, PF_ERR_IO, "%s: accept: %s", t->name, strerror(errno));
    }
    (void)setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    t->connection = fd;
    *fresh = true;
    return PF_OK;
}

static pf_status hang_up(tcp *t, const char *why)
{
    close(t->connection);
    t->connection = -1;
    return pf_fail(&t->failure, PF_ERR_CLOSED, "%s: %s", t->name, why);
}

static pf_status tcp_read(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    tcp *t = self;
    *done = 0;
    if (t->connection < 0)
        return PF_ERR_CLOSED;
    if (capacity == 0)
        return PF_OK;
    ssize_t k = recv(t->connection, bytes, capacity, 0);
    if (k > 0)
        *done = (size_t)k;
    else if (k == 0)
        return hang_up(t, "the other side closed the connection");
    else if (errno != EAGAIN && errno != EINTR)
        return hang_up(t, strerror(errno));
    return PF_OK;
}

static pf_status tcp_write(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    tcp *t = self;
    *done = 0;
    if (t->connection < 0)
        return PF_ERR_CLOSED;
    if (n == 0)
        return PF_OK;
    ssize_t k = send(t->connection, bytes, n, MSG_NOSIGNAL);
    if (k > 0)
        *done = (size_t)k;
    else if (k < 0 && errno != EAGAIN && errno != EINTR)
        return hang_up(t, strerror(errno));
    return PF_OK;
}

static size_t tcp_room(void *self)
{
    tcp *t = self;
    int waiting = 0;
    if (t->connection < 0 || ioctl(t->connection, SIOCOUTQ, &waiting) != 0)
        return 0;
    size_t queued = (size_t)waiting;
    return queued + PF_LINK_FRAME_MAX > QUEUE_MAX_BYTES ? 0 : QUEUE_MAX_BYTES - queued;
}

static const char *tcp_name(void *self)
{
    tcp *t = self;
    return t->name;
}

static const char *tcp_error(void *self)
{
    tcp *t = self;
    return t->failure.text;
}

static void tcp_close(void *self)
{
    tcp *t = self;
    if (t->connection >= 0)
        close(t->connection);
    if (t->listener >= 0)
        close(t->listener);
    free(t);
}

static pf_status listen_on(tcp *t, address *a, socklen_t size)
{
    int on = 1;
    t->listener = socket(a->any.sa_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (t->listener < 0)
        return pf_fail(&t->failure, PF_ERR_IO, "%s: %s", t->name, strerror(errno));
    if (setsockopt(t->listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on) != 0 ||
        bind(t->listener, &a->any, size) != 0 || listen(t->listener, BACKLOG) != 0 ||
        getsockname(t->listener, &a->any, &size) != 0)
        return pf_fail(&t->failure, PF_ERR_IO, "%s: %s", t->name, strerror(errno));
    return PF_OK;
}

static void write_name(tcp *t, const char *numeric, const address *a)
{
    bool is_v6 = a->any.sa_family == AF_INET6;
    unsigned port = ntohs(is_v6 ? a->v6.sin6_port : a->v4.sin_port);
    (void)snprintf(t->name, sizeof t->name, is_v6 ? "tcp [%s]:%u" : "tcp %s:%u", numeric, port);
}

pf_status pf_tcp_listen(pf_transport *transport, const pf_tcp_config *config, char *error, size_t n)
{
    static const pf_transport_ops ops = {
        .fd = tcp_fd,
        .service = tcp_service,
        .read = tcp_read,
        .write = tcp_write,
        .room = tcp_room,
        .name = tcp_name,
        .error = tcp_error,
        .close = tcp_close,
    };
    pf_failure failure = {""};
    address a;
    socklen_t size = 0;
    pf_status status = parse_address(config, &a, &size, &failure);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    tcp *t = calloc(1, sizeof *t);
    if (t == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "tcp: no memory"), error, n);
    t->listener = -1;
    t->connection = -1;
    write_name(t, config->address, &a);
    status = listen_on(t, &a, size);
    if (status != PF_OK) {
        pf_failure_copy(&t->failure, status, error, n);
        tcp_close(t);
        return status;
    }
    write_name(t, config->address, &a);
    transport->self = t;
    transport->ops = &ops;
    return PF_OK;
}
