/* The watchdogs that end or restart a daemon that hangs: the service manager's (sd_notify's protocol, when it gives a
 * socket) and the board's own device. Both are fed only while every thread is well. */
#ifndef PIPEFISHD_GUARD_H
#define PIPEFISHD_GUARD_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "recall.h"

typedef struct pf_guard {
    pthread_t thread;
    bool is_running;
    _Atomic bool is_ready, is_over;
    pf_recall *recall;
    int manager; /* socket; -1 = none */
    uint64_t manager_ns, manager_due;
    int device; /* -1 = none */
    uint64_t device_ns, device_due;
    uint64_t hang_ns;
    const char *_Atomic hung; /* the thread that hangs; NULL = none */
} pf_guard;

/* Starts a thread that feeds them, from before the daemon's devices are opened: what hangs there is the main thread.
 * Until pf_guard_ready the service manager is told to go on waiting. `device`: "/dev/watchdog", or "" for none, barks
 * after `hang_s`; a thread hangs after half of it. `recall` is told as long as one does, and lives until
 * pf_guard_close; while all is well the thread touches no disk. False: error[n] says why. */
bool pf_guard_open(pf_guard *guard, pf_recall *recall, const char *device, uint32_t hang_s, char *error, size_t n);

/* The daemon is up. */
void pf_guard_ready(pf_guard *guard);

/* The daemon ends of itself: the device must not bark. A second time nothing happens. */
void pf_guard_close(pf_guard *guard);

#endif
