/* CLOCK_MONOTONIC, in nanoseconds. */
#ifndef PIPEFISH_DRIVERS_MONOTONIC_H
#define PIPEFISH_DRIVERS_MONOTONIC_H

#include <stdint.h>
#include <time.h>

static inline uint64_t pf_monotonic_ns(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

#endif
