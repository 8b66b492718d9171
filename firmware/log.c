#include "log.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "config.h"
#include "pipefish/drivers/clock.h"

#define KINDS     256u /* of lines: their formats and levels. More than the daemon has; what has no place is told */
#define BURST     60u  /* lines of one kind that may follow each other at once */
#define REFILL_NS UINT64_C(1000000000) /* until one more may */

typedef struct kind {
    const char *format;
    uint32_t level;    /* what is only "%s" is one format, whoever tells it: an error is not left out for news */
    uint64_t since_ns; /* when `left` was right */
    uint32_t left, withheld;
} kind;

static _Atomic uint32_t most = PF_LOG_INFO;
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER; /* of the kinds */
static kind kinds[KINDS];

/* A switch that chatters or a disk that fails tells itself again and again: on a card a log of that drives out all
 * else. *withheld: lines of this kind that were not told since the last one. */
static bool may_tell(uint32_t level, const char *format, uint32_t *withheld)
{
    uint32_t i = 0;
    bool may = true;
    *withheld = 0;
    pthread_mutex_lock(&mutex);
    const uint64_t now = pf_now(); /* not before: one that another thread has overtaken lies before since_ns */
    while (i < KINDS && kinds[i].format != NULL && (kinds[i].format != format || kinds[i].level != level))
        i++;
    if (i < KINDS) {
        kind *k = &kinds[i];
        if (k->format == NULL)
            *k = (kind){.format = format, .level = level, .since_ns = now, .left = BURST};
        const uint64_t more = (now - k->since_ns) / REFILL_NS;
        k->left = more >= BURST - k->left ? BURST : k->left + (uint32_t)more;
        k->since_ns = k->left == BURST ? now : k->since_ns + more * REFILL_NS;
        may = k->left > 0;
        if (may) {
            k->left--;
            *withheld = k->withheld;
        }
        k->withheld = may ? 0 : k->withheld + 1;
    }
    pthread_mutex_unlock(&mutex);
    return may;
}

/* Names and reasons come from files, devices and hosts: what they say stays in its line. */
static void keep_in_line(char *text)
{
    for (; *text != '\0'; text++)
        if ((unsigned char)*text < ' ' || *text == 0x7F)
            *text = ' ';
}

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
    uint32_t withheld;
    if (level > most || !may_tell(level, format, &withheld))
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
    keep_in_line(line);
    n = strlen(line);
    if (withheld > 0)
        n += (size_t)snprintf(line + n, sizeof line - n, " (and %u more like it)", withheld);
    n = n < sizeof line - 1 ? n : sizeof line - 2;
    line[n] = '\n';
    /* One write, so that lines of two threads do not mix. */
    if (write(STDERR_FILENO, line, n + 1) < 0)
        return;
}
