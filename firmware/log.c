#include "log.h"

#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "config.h"

static _Atomic uint32_t most = PF_LOG_INFO;

void pf_log_set_level(uint32_t level)
{
    most = level;
}

void pf_log(uint32_t level, const char *format, ...)
{
    static const int priority[] = {[PF_LOG_ERROR] = 3, [PF_LOG_WARNING] = 4, [PF_LOG_INFO] = 6, [PF_LOG_DEBUG] = 7};
    char line[1024];
    size_t n;
    va_list arguments;
    if (level > most)
        return;
    n = (size_t)snprintf(line, sizeof line, "<%d>pipefishd: ", priority[level]);
    va_start(arguments, format);
    (void)vsnprintf(line + n, sizeof line - n - 1, format, arguments);
    va_end(arguments);
    n = strlen(line);
    line[n] = '\n';
    /* One write, so that lines of two threads do not mix. */
    if (write(STDERR_FILENO, line, n + 1) < 0)
        return;
}
