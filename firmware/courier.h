/* The link thread: transport, link, control requests, status and previews at intervals. It never waits for the disk or
 * the camera, and nothing waits for it.
 */
#ifndef PIPEFISHD_COURIER_H
#define PIPEFISHD_COURIER_H

#include "daemon.h"

typedef struct pf_courier pf_courier;

/* Starts the thread. False: error[n] says why. */
bool pf_courier_open(pf_courier **courier, pf_daemon *daemon, char *error, size_t n);

/* Hands over a Preview message (copied); it is sent with the next chance, a newer one replaces it. */
void pf_courier_preview(pf_courier *courier, const uint8_t *bytes, size_t n);

/* There is something new to be sent. */
void pf_courier_wake(pf_courier *courier);

/* Most bytes of a preview message. */
#define PF_PREVIEW_MAX 16384u

/* Sends a last status, answers for a moment what the host still asks, and ends. */
void pf_courier_close(pf_courier *courier);

#endif
