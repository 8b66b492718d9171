/* CLOCK_MONOTONIC, in nanoseconds: the clock of every time in pipefishd. */
#ifndef PIPEFISH_DRIVERS_CLOCK_H
#define PIPEFISH_DRIVERS_CLOCK_H

#include <stdint.h>
#include <time.h>

static inline uint64_t pf_now(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

#endif
