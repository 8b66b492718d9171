#include "failure.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

pf_status pf_fail(pf_failure *failure, pf_status status, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(failure->text, sizeof failure->text, format, arguments);
    va_end(arguments);
    return status;
}

pf_status pf_failure_copy(const pf_failure *failure, pf_status status, char *error, size_t n)
{
    if (error != NULL && n > 0) {
        size_t length = strnlen(failure->text, n - 1);
        memcpy(error, failure->text, length);
        error[length] = '\0';
    }
    return status;
}
