#include "guard.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/watchdog.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "config.h"
#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pulse.h"

#define SECOND    UINT64_C(1000000000)
#define TICK_NS   50000000
#define EXTEND_NS (5 * SECOND) /* between requests for more time to start in, of EXTEND_S each */
#define EXTEND_S  30

static void tell_manager(pf_guard *g, const char *text)
{
    if (g->manager >= 0 && send(g->manager, text, strlen(text), MSG_NOSIGNAL) < 0 && errno != EAGAIN)
        pf_log(PF_LOG_WARNING, "service manager: %s", strerror(errno));
}

/* sd_notify(3): a datagram socket, in the file system or (with an @) in the abstract namespace. */
static void open_manager(pf_guard *g)
{
    const char *path = getenv("NOTIFY_SOCKET"), *period = getenv("WATCHDOG_USEC"), *whose = getenv("WATCHDOG_PID");
    struct sockaddr_un a = {.sun_family = AF_UNIX};
    size_t n = path != NULL ? strlen(path) : 0;
    if (n < 2 || n >= sizeof a.sun_path || (path[0] != '/' && path[0] != '@'))
        return;
    memcpy(a.sun_path, path, n);
    if (path[0] == '@')
        a.sun_path[0] = '\0';
    g->manager = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (g->manager < 0 ||
        connect(g->manager, (struct sockaddr *)&a, (socklen_t)(offsetof(struct sockaddr_un, sun_path) + n)) != 0) {
        pf_log(PF_LOG_WARNING, "service manager: %s: %s", path, strerror(errno));
        if (g->manager >= 0)
            (void)close(g->manager);
        g->manager = -1;
        return;
    }
    if (period != NULL && (whose == NULL || strtol(whose, NULL, 10) == (long)getpid()))
        g->manager_ns = strtoull(period, NULL, 10) * 1000 / 3;
}

static bool open_device(pf_guard *g, const char *path, uint32_t hang_s, char *error, size_t n)
{
    int seconds = (int)hang_s;
    if (path[0] == '\0')
        return true;
    g->device = open(path, O_WRONLY | O_CLOEXEC);
    if (g->device < 0 || ioctl(g->device, WDIOC_SETTIMEOUT, &seconds) != 0) {
        const int why = errno;
        if (g->device >= 0 && why == EINVAL && ioctl(g->device, WDIOC_GETTIMEOUT, &seconds) == 0)
            (void)snprintf(error, n, "daemon.watchdog_s = %u: %s cannot wait that long (it is at %d s now)", hang_s,
                           path, seconds);
        else
            (void)snprintf(error, n, "daemon.watchdog: %s: %s", path, strerror(why));
        if (g->device >= 0) {
            (void)!write(g->device, "V", 1);
            (void)close(g->device);
        }
        g->device = -1;
        return false;
    }
    g->device_ns = (uint64_t)seconds * SECOND / 4; /* what the driver made of it */
    return true;
}

/* Feeds what is due, while nobody hangs. */
static void feed(pf_guard *g, uint64_t now)
{
    if (g->manager >= 0 && !atomic_load(&g->is_ready) && now >= g->manager_due) {
        char text[64];
        (void)snprintf(text, sizeof text, "EXTEND_TIMEOUT_USEC=%d000000", EXTEND_S);
        tell_manager(g, text);
        g->manager_due = now + EXTEND_NS;
    } else if (g->manager_ns != 0 && atomic_load(&g->is_ready) && now >= g->manager_due) {
        tell_manager(g, "WATCHDOG=1");
        g->manager_due = now + g->manager_ns;
    }
    if (g->device >= 0 && now >= g->device_due) {
        if (write(g->device, "", 1) != 1)
            pf_log(PF_LOG_ERROR, "watchdog: %s", strerror(errno));
        g->device_due = now + g->device_ns;
    }
}

static void look(pf_guard *g, uint64_t now)
{
    const char *hung = pf_pulse_hung(now, g->hang_ns), *before = atomic_load(&g->hung);
    if (hung != before) {
        char text[64];
        if (hung != NULL)
            pf_log(PF_LOG_ERROR, "the %s thread hangs: the watchdogs are not fed", hung);
        else
            pf_log(PF_LOG_WARNING, "the %s thread goes on", before);
        (void)snprintf(text, sizeof text, "STATUS=%s%s", hung != NULL ? "hangs: " : "well", hung != NULL ? hung : "");
        tell_manager(g, text);
        atomic_store(&g->hung, hung);
    }
    if (hung == NULL)
        feed(g, now);
}

static void *watch(void *argument)
{
    pf_guard *g = argument;
    const struct timespec tick = {0, TICK_NS};
    (void)prctl(PR_SET_NAME, "watchdogs");
    bool was_ready = false;
    while (!atomic_load(&g->is_over)) {
        const bool is_ready = atomic_load(&g->is_ready);
        if (is_ready && !was_ready)
            g->manager_due = 0;
        was_ready = is_ready;
        look(g, pf_now());
        if (atomic_load(&g->hung) != NULL)
            pf_recall_up(g->recall, false); /* waits for the disk: nothing is fed now */
        (void)nanosleep(&tick, NULL);
    }
    return NULL;
}

bool pf_guard_open(pf_guard *guard, pf_recall *recall, const char *device, uint32_t hang_s, char *error, size_t n)
{
    *guard = (pf_guard){.recall = recall, .manager = -1, .device = -1, .hang_ns = hang_s * SECOND / 2};
    open_manager(guard);
    if (!open_device(guard, device, hang_s, error, n))
        return false;
    guard->is_running = pthread_create(&guard->thread, NULL, watch, guard) == 0;
    if (!guard->is_running)
        (void)snprintf(error, n, "cannot start the thread of the watchdogs");
    return guard->is_running;
}

void pf_guard_ready(pf_guard *guard)
{
    tell_manager(guard, "READY=1");
    atomic_store(&guard->is_ready, true);
}

void pf_guard_close(pf_guard *guard)
{
    if (guard->is_running) {
        atomic_store(&guard->is_over, true);
        (void)pthread_join(guard->thread, NULL);
        guard->is_running = false;
    }
    tell_manager(guard, "STOPPING=1");
    if (guard->manager >= 0)
        (void)close(guard->manager);
    if (guard->device >= 0) {
        if (write(guard->device, "V", 1) != 1) /* the "magic close" of Linux's watchdog interface */
            pf_log(PF_LOG_ERROR, "watchdog: %s", strerror(errno));
        (void)close(guard->device);
    }
    guard->manager = guard->device = -1;
}
