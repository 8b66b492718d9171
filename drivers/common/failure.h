/* What went wrong, in words: each driver keeps one and hands it out through its error(). */
#ifndef PIPEFISH_DRIVERS_FAILURE_H
#define PIPEFISH_DRIVERS_FAILURE_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct pf_failure {
    char text[512]; /* "" = nothing failed yet */
} pf_failure;

/* Writes the text and returns `status`, so that a failing function ends with `return pf_fail(...)`. */
pf_status pf_fail(pf_failure *failure, pf_status status, const char *format, ...) __attribute__((format(printf, 3, 4)));

/* Copies the text into a caller's buffer (NULL or n = 0: nothing is copied) and returns `status`. */
pf_status pf_failure_copy(const pf_failure *failure, pf_status status, char *error, size_t n);

#ifdef __cplusplus
}
#endif

#endif
