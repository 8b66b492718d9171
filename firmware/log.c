#include "log.h"

#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
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
    /* systemd sets this and reads the priority from the prefix; people need not see it. */
    if (getenv("JOURNAL_STREAM"))
        n = (size_t)snprintf(line, sizeof line, "<%d>pipefishd: ", priority[level]);
    else
        n = (size_t)snprintf(line, sizeof line, "pipefishd: %s",
                             level == PF_LOG_ERROR     ? "error: "
                             : level == PF_LOG_WARNING ? "warning: "
                                                       : "");
    va_start(arguments, format);
    (void)vsnprintf(line + n, sizeof line - n - 1, format, arguments);
    va_end(arguments);
    n = strlen(line);
    line[n] = '\n';
    /* One write, so that lines of two threads do not mix. */
    if (write(STDERR_FILENO, line, n + 1) < 0)
        return;
}
