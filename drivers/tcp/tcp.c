/* TCP on loopback: a listener and at most one connection. */
#include "common/listener.h"
#include "pipefish/drivers/transport.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

typedef struct tcp {
    int listener, connection; /* connection -1 = nobody */
    char name[PF_LISTENER_NAME_MAX];
    pf_failure failure;
} tcp;

static int tcp_fd(void *self)
{
    tcp *t = self;
    return t->connection >= 0 ? t->connection : t->listener;
}

static pf_status tcp_service(void *self, bool *fresh)
{
    tcp *t = self;
    pf_address peer;
    *fresh = false;
    if (t->connection >= 0)
        return PF_OK;
    int fd = pf_listener_accept(t->listener, &peer);
    if (fd < 0) {
        if (errno == EAGAIN || errno == EINTR || errno == ECONNABORTED)
            return PF_ERR_AGAIN;
        return pf_fail(&t->failure, PF_ERR_IO, "%s: accept: %s", t->name, strerror(errno));
    }
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
    return pf_tcp_queue_room(t->connection);
}

static pf_role tcp_peer(void *self, const char **name, const pf_transport_stats **stats)
{
    tcp *t = self;
    *name = "";
    *stats = NULL;
    return t->connection >= 0 ? PF_ROLE_CALIBRATOR : PF_ROLE_NONE;
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

pf_status pf_tcp_listen(pf_transport *transport, const pf_tcp_config *config, char *error, size_t n)
{
    static const pf_transport_ops ops = {
        .fd = tcp_fd,
        .service = tcp_service,
        .read = tcp_read,
        .write = tcp_write,
        .room = tcp_room,
        .peer = tcp_peer,
        .name = tcp_name,
        .error = tcp_error,
        .close = tcp_close,
    };
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
    t->connection = -1;
    status = pf_listener_open(&t->listener, t->name, &a, config->address, "tcp", &failure);
    if (status != PF_OK) {
        pf_failure_copy(&failure, status, error, n);
        tcp_close(t);
        return status;
    }
    transport->self = t;
    transport->ops = &ops;
    return PF_OK;
}
