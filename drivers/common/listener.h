/* A TCP socket that listens at a numeric address. */
#ifndef PIPEFISH_DRIVERS_LISTENER_H
#define PIPEFISH_DRIVERS_LISTENER_H

#include "common/failure.h"

#include <netinet/in.h>

typedef union pf_address {
    struct sockaddr any;
    struct sockaddr_in v4;
    struct sockaddr_in6 v6;
} pf_address;

#define PF_LISTENER_NAME_MAX 80u
#define PF_TCP_QUEUE_BYTES   65536u /* most that may wait in the system's queue of a connection */

/* PF_ERR_ARGUMENT: no numeric address. `what` ("tcp") begins the text. */
pf_status pf_address_parse(pf_address *address, const char *numeric, uint16_t port, const char *what,
                           pf_failure *failure);
bool pf_address_is_loopback(const pf_address *address);

/* *fd listens, without blocking; name[PF_LISTENER_NAME_MAX] becomes "tcp 127.0.0.1:7447" with the port that it got.
 * An address that this device does not have yet is waited for: PF_OK, and failure says so. PF_ERR_IO. */
pf_status pf_listener_open(int *fd, char *name, const pf_address *address, const char *numeric, const char *what,
                           pf_failure *failure);

/* The next connection, without blocking and without delay for small frames, or -1 with errno. */
int pf_listener_accept(int fd, pf_address *peer);

/* Room of pf_transport_ops for a connected socket. */
size_t pf_tcp_queue_room(int fd);

#endif
