/* The V4L2 driver's system calls. */
#include "camera_v4l2/v4l2.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

static int kernel_open(void *self, const char *path)
{
    (void)self;
    return open(path, O_RDWR | O_NONBLOCK | O_CLOEXEC);
}

static void kernel_close(void *self, int fd)
{
    (void)self;
    (void)close(fd);
}

static int kernel_ioctl(void *self, int fd, unsigned long request, void *argument)
{
    int result;
    (void)self;
    do
        result = ioctl(fd, request, argument);
    while (result != 0 && errno == EINTR);
    return result;
}

static void *kernel_map(void *self, int fd, size_t n, int64_t offset)
{
    (void)self;
    void *memory = mmap(NULL, n, PROT_READ, MAP_SHARED, fd, (off_t)offset);
    return memory == MAP_FAILED ? NULL : memory;
}

static void kernel_unmap(void *self, void *memory, size_t n)
{
    (void)self;
    (void)munmap(memory, n);
}

static bool kernel_keep(void *self, void *memory, size_t n)
{
    (void)self;
    return pf_mapping_keep(memory, n);
}

static int kernel_wait(void *self, int fd, uint32_t timeout_ms)
{
    (void)self;
    struct pollfd p = {fd, POLLIN, 0};
    if (poll(&p, 1, (int)timeout_ms) <= 0)
        return 0;
    return p.revents & (POLLERR | POLLHUP | POLLNVAL) ? -1 : 1;
}

static uint64_t kernel_now(void *self)
{
    (void)self;
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

static void kernel_sleep(void *self, uint32_t ms)
{
    (void)self;
    struct timespec t = {ms / 1000, (long)(ms % 1000) * 1000000};
    (void)nanosleep(&t, NULL);
}

const pf_v4l2_io pf_v4l2_kernel = {.open = kernel_open,
                                   .close = kernel_close,
                                   .ioctl = kernel_ioctl,
                                   .map = kernel_map,
                                   .unmap = kernel_unmap,
                                   .keep = kernel_keep,
                                   .wait = kernel_wait,
                                   .now = kernel_now,
                                   .sleep = kernel_sleep};
