/* The watchdogs that end or restart a daemon that hangs: the service manager's (sd_notify's protocol, when it gives a
 * socket) and the board's own device. Both are fed only while every thread is well. */
#ifndef PIPEFISHD_GUARD_H
#define PIPEFISHD_GUARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct pf_guard {
    int manager; /* socket; -1 = none */
    uint64_t manager_ns, manager_due;
    int device; /* -1 = none */
    uint64_t device_ns, device_due;
    uint64_t hang_ns;
    const char *hung; /* the thread that was last seen hanging */
} pf_guard;

/* `device`: "/dev/watchdog", or "" for none, barks after `hang_s`; a thread hangs after half of it. False: error[n]
 * says why. */
bool pf_guard_open(pf_guard *guard, const char *device, uint32_t hang_s, char *error, size_t n);

/* The daemon is up. */
void pf_guard_ready(pf_guard *guard);

/* Feeds what is due. To be called a few times a second, from the thread that starts and ends all the others. */
void pf_guard_feed(pf_guard *guard, uint64_t now_ns);

/* The daemon ends of itself: the device must not bark. */
void pf_guard_close(pf_guard *guard);

#endif
