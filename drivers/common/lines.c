#include "common/lines.h"
#include "pipefish/drivers/clock.h"

#include <errno.h>
#include <string.h>
#include <sys/epoll.h>
#include <unistd.h>

pf_status pf_lines_open(pf_lines *lines, const pf_address *address, const char *numeric, const char *what)
{
    struct epoll_event e = {.events = EPOLLIN};
    pf_status status = pf_listener_open(&lines->listener, lines->name, address, numeric, what, &lines->failure);
    if (status != PF_OK)
        return status;
    lines->epoll = epoll_create1(EPOLL_CLOEXEC);
    if (lines->epoll < 0 || epoll_ctl(lines->epoll, EPOLL_CTL_ADD, lines->listener, &e) != 0)
        return pf_fail(&lines->failure, PF_ERR_IO, "%s: epoll: %s", lines->name, strerror(errno));
    return PF_OK;
}

void pf_lines_close(pf_lines *lines)
{
    if (lines->listener >= 0)
        (void)close(lines->listener);
    if (lines->epoll >= 0)
        (void)close(lines->epoll);
}

pf_line pf_line_empty(pf_lines *lines)
{
    return (pf_line){.lines = lines, .fd = -1};
}

void pf_line_watch(pf_line *line, uint32_t events)
{
    struct epoll_event e = {.events = events};
    if (line->events != events &&
        epoll_ctl(line->lines->epoll, line->events == 0 ? EPOLL_CTL_ADD : EPOLL_CTL_MOD, line->fd, &e) == 0)
        line->events = events;
}

void pf_line_drop(pf_line *line)
{
    if (line->fd >= 0)
        (void)close(line->fd); /* which also ends its watch */
    *line = pf_line_empty(line->lines);
}

pf_line *pf_lines_place(const pf_lines *lines)
{
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        if (lines->visitors[i]->fd < 0)
            return lines->visitors[i];
    return NULL;
}

static void watch_listener(pf_lines *lines, uint32_t events)
{
    struct epoll_event e = {.events = events};
    (void)epoll_ctl(lines->epoll, EPOLL_CTL_MOD, lines->listener, &e);
}

pf_status pf_lines_accept(pf_lines *lines, pf_address *peer, int *fd, uint64_t now_ns)
{
    if (now_ns < lines->retry_ns)
        return PF_ERR_AGAIN;
    if (lines->retry_ns != 0)
        watch_listener(lines, EPOLLIN);
    lines->retry_ns = 0;
    *fd = pf_listener_accept(lines->listener, peer);
    if (*fd >= 0)
        return PF_OK;
    if (errno == EAGAIN || errno == EINTR || errno == ECONNABORTED)
        return PF_ERR_AGAIN;
    pf_status status = pf_fail(&lines->failure, PF_ERR_IO, "accept: %s", strerror(errno));
    watch_listener(lines, 0);
    lines->retry_ns = now_ns + PF_TRANSPORT_RETRY_MS * UINT64_C(1000000);
    return status;
}

void pf_line_heard(void *self)
{
    pf_line *line = self;
    line->has_spoken = true;
    if (line == line->lines->host)
        line->lines->heard_ns = pf_now();
}

int pf_line_fd(void *self)
{
    pf_line *line = self;
    return line->lines->epoll;
}

bool pf_line_visitor(void *self, pf_transport *visitor)
{
    pf_lines *lines = ((pf_line *)self)->lines;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        if (!lines->visitors[i]->is_new)
            continue;
        lines->visitors[i]->is_new = false;
        visitor->self = lines->visitors[i];
        visitor->ops = lines->ops;
        return true;
    }
    return false;
}

size_t pf_line_room(void *self)
{
    pf_line *line = self;
    return pf_tcp_queue_room(line->fd);
}

const char *pf_line_name(void *self)
{
    pf_line *line = self;
    return line->lines->name;
}

const char *pf_line_error(void *self)
{
    pf_line *line = self;
    return line->lines->failure.text;
}
