#include "guard.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/watchdog.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "config.h"
#include "log.h"
#include "pulse.h"

#define SECOND UINT64_C(1000000000)

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

bool pf_guard_open(pf_guard *guard, const char *device, uint32_t hang_s, char *error, size_t n)
{
    *guard = (pf_guard){.manager = -1, .device = -1, .hang_ns = hang_s * SECOND / 2};
    open_manager(guard);
    return open_device(guard, device, hang_s, error, n);
}

void pf_guard_ready(pf_guard *guard)
{
    tell_manager(guard, "READY=1");
}

void pf_guard_feed(pf_guard *guard, uint64_t now_ns)
{
    const char *hung = pf_pulse_hung(now_ns, guard->hang_ns);
    if (hung != guard->hung) {
        char text[64];
        if (hung != NULL)
            pf_log(PF_LOG_ERROR, "the %s thread hangs: the watchdogs are not fed", hung);
        else
            pf_log(PF_LOG_WARNING, "the %s thread goes on", guard->hung);
        (void)snprintf(text, sizeof text, "STATUS=%s%s", hung != NULL ? "hangs: " : "well", hung != NULL ? hung : "");
        tell_manager(guard, text);
        guard->hung = hung;
    }
    if (hung != NULL)
        return;
    if (guard->manager_ns != 0 && now_ns >= guard->manager_due) {
        tell_manager(guard, "WATCHDOG=1");
        guard->manager_due = now_ns + guard->manager_ns;
    }
    if (guard->device >= 0 && now_ns >= guard->device_due) {
        if (write(guard->device, "", 1) != 1)
            pf_log(PF_LOG_ERROR, "watchdog: %s", strerror(errno));
        guard->device_due = now_ns + guard->device_ns;
    }
}

void pf_guard_close(pf_guard *guard)
{
    tell_manager(guard, "STOPPING=1");
    if (guard->manager >= 0)
        (void)close(guard->manager);
    if (guard->device >= 0) {
        if (write(guard->device, "V", 1) != 1) /* the "magic close" of Linux's watchdog interface */
            pf_log(PF_LOG_ERROR, "watchdog: %s", strerror(errno));
        (void)close(guard->device);
    }
    *guard = (pf_guard){.manager = -1, .device = -1};
}
