/* A thread that does one thing to one item at a time. */
#ifndef PIPEFISHD_WORKER_H
#define PIPEFISHD_WORKER_H

#include <stdbool.h>
#include <stddef.h>

typedef struct pf_worker pf_worker;

/* Starts the thread, which calls work(user, item) for each item given. False: error[n] says why. */
bool pf_worker_open(pf_worker **worker, void (*work)(void *user, void *item), void *user, char *error, size_t n);

/* Hands an item over; the one before must have been waited for. */
void pf_worker_give(pf_worker *worker, void *item);

/* Until the item is done; what the worker wrote can then be read, and what it used be changed. */
void pf_worker_wait(pf_worker *worker);

/* Waits, ends the thread and frees all. NULL is allowed. */
void pf_worker_close(pf_worker *worker);

#endif
