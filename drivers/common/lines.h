/* What transports that listen have in common: a listener, the connection that has the line, a few that look on, and the
 * epoll descriptor that holds them all, which the daemon polls. A transport's `self` is a pf_line, which begins
 * whatever else it knows of the connection. */
#ifndef PIPEFISH_DRIVERS_LINES_H
#define PIPEFISH_DRIVERS_LINES_H

#include "common/listener.h"
#include "pipefish/drivers/transport.h"

typedef struct pf_line {
    struct pf_lines *lines;
    int fd;          /* -1 = nobody */
    uint32_t events; /* that epoll watches */
    bool is_new;     /* a visitor whom nobody has taken over yet */
    bool has_begun;  /* tcp: its first byte has come */
    bool has_spoken; /* a frame of it was intact */
} pf_line;

typedef struct pf_lines {
    int epoll, listener;
    pf_line *host, *visitors[PF_VISITORS_MAX];
    const pf_transport_ops *ops;   /* of a visitor */
    uint64_t silence_ns, heard_ns; /* of the host; 0 = no limit */
    uint64_t retry_ns;             /* the listener is left alone until then; 0 = it is not */
    char name[PF_LISTENER_NAME_MAX];
    pf_failure failure;
} pf_lines;

/* Listens; what is pointed to is the caller's. PF_ERR_IO. */
pf_status pf_lines_open(pf_lines *lines, const pf_address *address, const char *numeric, const char *what);

/* After the connections. */
void pf_lines_close(pf_lines *lines);

/* Nobody. */
pf_line pf_line_empty(pf_lines *lines);

/* Sets what epoll watches. */
void pf_line_watch(pf_line *line, uint32_t events);

/* Ends the connection, if there is one. */
void pf_line_drop(pf_line *line);

/* A place for one that looks on, or NULL. */
pf_line *pf_lines_place(const pf_lines *lines);

/* Takes the next one that waits. PF_ERR_AGAIN: nobody, or not now; PF_ERR_IO: it failed, and is tried again after
 * PF_TRANSPORT_RETRY_MS: one that waits while no descriptor is free would keep the daemon awake. */
pf_status pf_lines_accept(pf_lines *lines, pf_address *peer, int *fd, uint64_t now_ns);

/* Of pf_transport_ops. */
int pf_line_fd(void *self);
void pf_line_heard(void *self);
bool pf_line_visitor(void *self, pf_transport *visitor);
size_t pf_line_room(void *self);
const char *pf_line_name(void *self);
const char *pf_line_error(void *self);

#endif
