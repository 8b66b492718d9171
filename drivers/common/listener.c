#include "common/listener.h"
#include "pipefish/link.h"

#include <arpa/inet.h>
#include <errno.h>
#include <ifaddrs.h>
#include <linux/sockios.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#define BACKLOG 4

pf_status pf_address_parse(pf_address *address, const char *numeric, uint16_t port, const char *what,
                           pf_failure *failure)
{
    memset(address, 0, sizeof *address);
    if (numeric != NULL && inet_pton(AF_INET, numeric, &address->v4.sin_addr) == 1) {
        address->v4.sin_family = AF_INET;
        address->v4.sin_port = htons(port);
    } else if (numeric != NULL && inet_pton(AF_INET6, numeric, &address->v6.sin6_addr) == 1) {
        address->v6.sin6_family = AF_INET6;
        address->v6.sin6_port = htons(port);
    } else {
        return pf_fail(failure, PF_ERR_ARGUMENT, "%s: \"%s\" is no numeric address such as 127.0.0.1 or ::1", what,
                       numeric != NULL ? numeric : "");
    }
    return PF_OK;
}

bool pf_address_is_loopback(const pf_address *address)
{
    return address->any.sa_family == AF_INET ? (ntohl(address->v4.sin_addr.s_addr) >> 24) == 127
                                             : IN6_IS_ADDR_LOOPBACK(&address->v6.sin6_addr);
}

static void write_name(char *name, const pf_address *a, const char *numeric, const char *what)
{
    bool is_v6 = a->any.sa_family == AF_INET6;
    unsigned port = ntohs(is_v6 ? a->v6.sin6_port : a->v4.sin_port);
    (void)snprintf(name, PF_LISTENER_NAME_MAX, is_v6 ? "%s [%s]:%u" : "%s %s:%u", what, numeric, port);
}

/* Whether one of the interfaces has it now. */
static bool is_there(const pf_address *a)
{
    struct ifaddrs *all = NULL;
    static const uint8_t any[16];
    const bool is_v4 = a->any.sa_family == AF_INET;
    const void *wanted = is_v4 ? (const void *)&a->v4.sin_addr : &a->v6.sin6_addr;
    const size_t n = is_v4 ? 4 : 16;
    bool found = memcmp(wanted, any, n) == 0 || pf_address_is_loopback(a) || getifaddrs(&all) != 0;
    for (const struct ifaddrs *i = all; i != NULL && !found; i = i->ifa_next) {
        if (i->ifa_addr == NULL || i->ifa_addr->sa_family != a->any.sa_family)
            continue;
        const pf_address *own = (const pf_address *)(const void *)i->ifa_addr;
        found = memcmp(wanted, is_v4 ? (const void *)&own->v4.sin_addr : &own->v6.sin6_addr, n) == 0;
    }
    if (all != NULL)
        freeifaddrs(all);
    return found;
}

pf_status pf_listener_open(int *fd, char *name, const pf_address *address, const char *numeric, const char *what,
                           pf_failure *failure)
{
    int on = 1;
    pf_address a = *address;
    socklen_t size = a.any.sa_family == AF_INET ? sizeof a.v4 : sizeof a.v6;
    write_name(name, &a, numeric, what);
    *fd = socket(a.any.sa_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (*fd < 0)
        return pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
    /* Before the cable is in, or the address server has answered, a board does not have its address; one that is being
     * looked at for duplicates is listed and cannot be bound. */
    const bool must_wait = !is_there(&a);
    if (setsockopt(*fd, IPPROTO_IP, IP_FREEBIND, &on, sizeof on) != 0 ||
        setsockopt(*fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on) != 0 || bind(*fd, &a.any, size) != 0 ||
        listen(*fd, BACKLOG) != 0 || getsockname(*fd, &a.any, &size) != 0) {
        pf_status status = pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
        (void)close(*fd);
        *fd = -1;
        return status;
    }
    write_name(name, &a, numeric, what);
    if (must_wait)
        (void)pf_fail(failure, PF_OK, "this device does not have the address %s yet: hosts come in once it has",
                      numeric);
    return PF_OK;
}

int pf_listener_accept(int fd, pf_address *peer)
{
    int on = 1;
    socklen_t size = sizeof *peer;
    memset(peer, 0, sizeof *peer);
    int connection = accept4(fd, &peer->any, &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (connection >= 0)
        (void)setsockopt(connection, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    return connection;
}

size_t pf_tcp_queue_room(int fd)
{
    int waiting = 0;
    if (fd < 0 || ioctl(fd, SIOCOUTQ, &waiting) != 0)
        return 0;
    size_t queued = (size_t)waiting;
    return queued + PF_LINK_FRAME_MAX > PF_TCP_QUEUE_BYTES ? 0 : PF_TCP_QUEUE_BYTES - queued;
}
