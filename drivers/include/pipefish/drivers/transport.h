/* A byte stream to the other end: serial line, TCP, TLS. Never blocks; the daemon's loop polls fd. */
#ifndef PIPEFISH_DRIVERS_TRANSPORT_H
#define PIPEFISH_DRIVERS_TRANSPORT_H

#include "pipefish/base.h"

#define PF_TRANSPORT_RETRY_MS 250u
#define PF_VISITORS_MAX       3u /* that may look on while another host has the line */

/* What the host at the other end may do; each may also do what those before it may. */
typedef enum pf_role {
    PF_ROLE_NONE = 0,
    PF_ROLE_REVOKED,    /* nothing, never again */
    PF_ROLE_VIEWER,     /* see status, previews, profile */
    PF_ROLE_OPERATOR,   /* take the survey's objects, which the device then forgets; lamp, stop, shut down */
    PF_ROLE_CALIBRATOR, /* send, confirm and revert profiles; let other hosts in */
} pf_role;

typedef struct pf_transport_stats { /* of a transport that lets in only those it knows; since it was opened */
    uint32_t sessions;              /* hosts let in */
    uint32_t refused_unknown, refused_revoked;
    uint32_t refused_handshake; /* no certificate, another version, no TLS at all */
    uint32_t refused_late;      /* the handshake took too long */
    uint32_t refused_often;     /* too many at once, or after too many failures */
    uint32_t refused_busy;      /* another host has the line, and PF_VISITORS_MAX look on */
} pf_transport_stats;

typedef struct pf_transport {
    void *self;
    const struct pf_transport_ops *ops;
} pf_transport;

typedef struct pf_transport_ops {
    /* Descriptor to poll now: the listener (POLLIN) while nobody is connected, then the connection (POLLIN, and POLLOUT
     * while something waits and room() > 0). -1 = nothing to poll (unplugged: call service again after
     * PF_TRANSPORT_RETRY_MS). It changes only in service, read and write. */
    int (*fd)(void *self);

    /* Accepts or reopens as needed, and sees to what takes too long or is no longer allowed: due every
     * PF_TRANSPORT_RETRY_MS. PF_OK = a stream is there; *fresh is set (else cleared) when it is a new one
     * (pf_link_reset is due); PF_ERR_AGAIN = nobody there yet, or not to be opened yet (error() says why); PF_ERR_IO =
     * it failed now, and may be tried again. */
    pf_status (*service)(void *self, bool *fresh);

    /* *done bytes were moved. PF_OK (maybe fewer than asked, maybe 0), PF_ERR_CLOSED (the stream is over; service). */
    pf_status (*read)(void *self, uint8_t *bytes, size_t capacity, size_t *done);
    pf_status (*write)(void *self, const uint8_t *bytes, size_t n, size_t *done);

    /* What came makes sense: a frame of it was intact. A host of whom that was not said for too long is silent,
     * whatever bytes he sends. NULL: a line that has room for one. */
    void (*heard)(void *self);

    /* Bytes that may be written now without queueing more than a few milliseconds in front of urgent frames: 0, or at
     * least PF_LINK_FRAME_MAX. No descriptor tells when it rises: ask again after a millisecond or so.
     * Serial: one frame more than 5 ms at the baud rate are queued at most; a pseudo-terminal, which does not tell how
     * much it holds, counts as a line of that rate. TCP: 64 KiB. */
    size_t (*room)(void *self);

    /* Who is there. A wire or loopback ends where only those who may touch the device are: whoever speaks there may do
     * everything, and has no name (""). *stats is NULL where nobody is refused. PF_ROLE_NONE: nobody. */
    pf_role (*peer)(void *self, const char **name, const pf_transport_stats **stats);

    /* Hands over a connection that may only look on, for another host has the line or its role is no more: a transport
     * of its own, which ends with its close() and must not outlive this one. Its descriptor is this one's; its service
     * accepts nobody, PF_ERR_CLOSED: it is over. False: nobody new. NULL: a line that has room for one. */
    bool (*visitor)(void *self, struct pf_transport *visitor);

    /* Bytes, at least so many, that came since it was opened and were dropped before read() could have them, as far as
     * the kernel knows. NULL: a stream that loses none. */
    uint32_t (*overruns)(void *self);

    const char *(*name)(void *self);  /* "serial /dev/ttyS0 3000000", "tcp 127.0.0.1:7447" */
    const char *(*error)(void *self); /* last failure in words */
    void (*close)(void *self);
} pf_transport_ops;

typedef struct pf_serial_config {
    const char *device; /* /dev/tty..., or a pty */
    uint32_t baud;      /* 9600..4000000; one the driver cannot set is an error that names those near it */
    bool rtscts;
} pf_serial_config;

/* On failure *transport is untouched and error[n] says what. The device may be absent, vanish and come back: service()
 * opens it under the same path once it is there. PF_OK; PF_ERR_IO (no permission, in use); PF_ERR_ARGUMENT;
 * PF_ERR_UNSUPPORTED (not a terminal, or not at this rate). */
pf_status pf_serial_open(pf_transport *transport, const pf_serial_config *config, char *error, size_t n);

/* Listens; one client has the line, others that come meanwhile look on; the next of them has it when the first has gone
 * or been silent for `silence_ms`. Nothing is encrypted: only loopback addresses are accepted (pf_tls_listen is for the
 * others), and only streams that begin as the link does, with a zero: what else reaches loopback, such as a browser's
 * requests, is closed, and one without an intact frame for 200 ms gives the line to the next. */
typedef struct pf_tcp_config {
    const char *address; /* "127.0.0.1", "::1" */
    uint16_t port;       /* 0 = any; name() tells which */
    uint32_t silence_ms; /* 0 = no limit */
} pf_tcp_config;

/* On failure *transport is untouched and error[n] says what. PF_OK; PF_ERR_IO (port taken); PF_ERR_ARGUMENT (not a
 * numeric address); PF_ERR_UNSUPPORTED (not a loopback address). */
pf_status pf_tcp_listen(pf_transport *transport, const pf_tcp_config *config, char *error, size_t n);

/* What pf_tcp_listen would say of the address, without listening. PF_OK, PF_ERR_ARGUMENT, PF_ERR_UNSUPPORTED. */
pf_status pf_tcp_check(const pf_tcp_config *config, char *error, size_t n);

#endif
