/* Serial line: raw, non-blocking, any baud rate the device can make (termios2), reopened when it was unplugged. */
#include "common/failure.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/transport.h"
#include "pipefish/link.h"

#include <asm/termbits.h> /* termios2; glibc's termios.h knows fixed rates only, and the two exclude each other */
#include <errno.h>
#include <fcntl.h>
#include <linux/serial.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#define BAUD_MIN 9600u
#define BAUD_MAX 4000000u

/* Unix98 pseudo-terminal slaves, Linux Documentation/admin-guide/devices.txt. */
#define PTY_MAJOR_FIRST 136u
#define PTY_MAJOR_LAST  143u

typedef struct serial {
    char *device;
    uint32_t baud;
    bool rtscts;
    int fd; /* -1 = not there now */
    bool fresh;
    bool is_pty;
    uint32_t overruns, counted; /* bytes that came and were dropped; the kernel's count of them when last it told */
    bool has_counted;           /* it has told since the device was opened */
    /* What a pty's line would still have to send; a real device is asked. */
    double pty_queue;
    uint64_t pty_time_ns;
    char name[160];
    pf_failure failure;
} serial;

/* Sets 8N1, raw, at a rate; *actual is what the driver made of it. */
static int set_line(int fd, uint32_t baud, bool rtscts, uint32_t *actual)
{
    struct termios2 t;
    if (ioctl(fd, TCGETS2, &t) != 0)
        return -1;
    t.c_iflag = 0;
    t.c_oflag = 0;
    t.c_lflag = 0;
    t.c_cflag = CS8 | CREAD | CLOCAL | BOTHER | ((tcflag_t)BOTHER << IBSHIFT);
    if (rtscts)
        t.c_cflag |= CRTSCTS;
    t.c_cc[VMIN] = 1;
    t.c_cc[VTIME] = 0;
    t.c_ispeed = baud;
    t.c_ospeed = baud;
    if (ioctl(fd, TCSETS2, &t) != 0 || ioctl(fd, TCGETS2, &t) != 0)
        return -1;
    *actual = t.c_ospeed;
    return 0;
}

/* A receiver samples the middle of the tenth bit: at 2.5 % each end is off by a quarter of a bit, and both may be. */
static bool is_close(uint32_t actual, uint32_t wanted)
{
    uint32_t difference = actual > wanted ? actual - wanted : wanted - actual;
    return (uint64_t)difference * 40 <= wanted;
}

/* The device cannot make the rate: names the nearest usual ones that it can. */
static pf_status fail_baud(serial *s, int fd, uint32_t actual)
{
    static const uint32_t usual[] = {9600,   19200,   38400,   57600,   115200,  230400,  460800,  500000,  576000,
                                     921600, 1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000};
    uint32_t below = 0, above = 0, made;
    for (size_t i = 0; i < sizeof usual / sizeof usual[0]; i++) {
        if (usual[i] == s->baud || (usual[i] > s->baud && above != 0) ||
            set_line(fd, usual[i], s->rtscts, &made) != 0 || !is_close(made, usual[i]))
            continue;
        if (usual[i] < s->baud)
            below = usual[i];
        else
            above = usual[i];
    }
    char list[64] = "no other usual rate";
    if (below != 0 && above != 0)
        (void)snprintf(list, sizeof list, "%u and %u", below, above);
    else if (below != 0 || above != 0)
        (void)snprintf(list, sizeof list, "%u", below != 0 ? below : above);
    return pf_fail(&s->failure, PF_ERR_UNSUPPORTED, "%s: cannot do %u baud (it made %u); near it, it can do %s",
                   s->device, s->baud, actual, list);
}

static pf_status configure(serial *s, int fd)
{
    struct stat info;
    uint32_t actual;
    if (!isatty(fd) || fstat(fd, &info) != 0)
        return pf_fail(&s->failure, PF_ERR_UNSUPPORTED, "%s: not a terminal device", s->device);
    s->is_pty = major(info.st_rdev) >= PTY_MAJOR_FIRST && major(info.st_rdev) <= PTY_MAJOR_LAST;
    if (flock(fd, LOCK_EX | LOCK_NB) != 0)
        return pf_fail(&s->failure, PF_ERR_IO, "%s: another program uses it", s->device);
    /* TIOCEXCL would outlive a killed daemon on a pty whose other end holds it open; on a device it ends with it. */
    if (!s->is_pty && ioctl(fd, TIOCEXCL) != 0)
        return pf_fail(&s->failure, PF_ERR_IO, "%s: cannot be had alone: %s", s->device, strerror(errno));
    if (set_line(fd, s->baud, s->rtscts, &actual) != 0)
        return pf_fail(&s->failure, errno == EINVAL ? PF_ERR_UNSUPPORTED : PF_ERR_IO, "%s: cannot set %u baud: %s",
                       s->device, s->baud, strerror(errno));
    if (!s->is_pty && !is_close(actual, s->baud))
        return fail_baud(s, fd, actual);
    (void)ioctl(fd, TCFLSH, TCIFLUSH); /* what came before nobody waits for */
    return PF_OK;
}

/* Bytes that the kernel knows were dropped before anybody read them: by the device, its FIFO full (one is counted for
 * each time), or for want of room in the terminal's buffer. It counts from the device's first start on. False: it does
 * not tell. */
static bool count_dropped(int fd, uint32_t *n)
{
    struct serial_icounter_struct c;
    if (ioctl(fd, TIOCGICOUNT, &c) != 0)
        return false;
    *n = (uint32_t)c.overrun + (uint32_t)c.buf_overrun;
    return true;
}

/* *is_absent: nothing is plugged in under this path. */
static pf_status open_device(serial *s, bool *is_absent)
{
    int fd = open(s->device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    *is_absent = fd < 0 && (errno == ENOENT || errno == ENODEV || errno == ENXIO);
    if (fd < 0)
        return pf_fail(&s->failure, PF_ERR_IO, "%s: %s", s->device, strerror(errno));
    pf_status status = configure(s, fd);
    if (status != PF_OK) {
        close(fd);
        return status;
    }
    s->fd = fd;
    s->fresh = true;
    s->has_counted = count_dropped(fd, &s->counted);
    s->pty_queue = 0;
    s->pty_time_ns = pf_now();
    return PF_OK;
}

static pf_status hang_up(serial *s, const char *why)
{
    close(s->fd);
    s->fd = -1;
    return pf_fail(&s->failure, PF_ERR_CLOSED, "%s: %s", s->device, why);
}

static int serial_fd(void *self)
{
    serial *s = self;
    return s->fd;
}

static pf_status serial_service(void *self, bool *fresh)
{
    serial *s = self;
    bool is_absent;
    *fresh = false;
    if (s->fd < 0 && open_device(s, &is_absent) != PF_OK)
        return PF_ERR_AGAIN; /* whatever the reason: a device that is plugged in goes through all of them */
    *fresh = s->fresh;
    s->fresh = false;
    return PF_OK;
}

static pf_status serial_read(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    serial *s = self;
    *done = 0;
    if (s->fd < 0)
        return PF_ERR_CLOSED;
    if (capacity == 0)
        return PF_OK;
    ssize_t k = read(s->fd, bytes, capacity);
    if (k > 0)
        *done = (size_t)k;
    else if (k == 0)
        return hang_up(s, "hung up");
    else if (errno != EAGAIN && errno != EINTR)
        return hang_up(s, strerror(errno));
    return PF_OK;
}

/* Bytes at this rate in 5 ms, 10 bits each. */
static size_t five_ms(const serial *s)
{
    return s->baud / 2000;
}

static void drain_pty(serial *s)
{
    uint64_t now = pf_now();
    s->pty_queue -= (double)(now - s->pty_time_ns) * 1e-9 * s->baud / 10;
    if (s->pty_queue < 0)
        s->pty_queue = 0;
    s->pty_time_ns = now;
}

static pf_status serial_write(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    serial *s = self;
    *done = 0;
    if (s->fd < 0)
        return PF_ERR_CLOSED;
    if (n == 0)
        return PF_OK;
    ssize_t k = write(s->fd, bytes, n);
    if (k < 0 && errno != EAGAIN && errno != EINTR)
        return hang_up(s, strerror(errno));
    if (k > 0)
        *done = (size_t)k;
    if (s->is_pty) {
        drain_pty(s);
        s->pty_queue += (double)*done;
        if (*done < n && s->pty_queue <= (double)five_ms(s)) /* full after all: the other end is slower than we think */
            s->pty_queue = (double)five_ms(s) + 1;
    }
    return PF_OK;
}

static size_t serial_room(void *self)
{
    serial *s = self;
    size_t limit = five_ms(s), queued;
    if (s->fd < 0)
        return 0;
    if (s->is_pty) {
        drain_pty(s);
        queued = (size_t)s->pty_queue;
    } else {
        int waiting = 0;
        if (ioctl(s->fd, TIOCOUTQ, &waiting) != 0)
            waiting = 0; /* a driver that cannot tell; its own buffer is the limit */
        queued = (size_t)waiting;
    }
    if (queued > limit)
        return 0;
    return limit - queued > PF_LINK_FRAME_MAX ? limit - queued : PF_LINK_FRAME_MAX;
}

static pf_role serial_peer(void *self, const char **name, const pf_transport_stats **stats)
{
    (void)self;
    *name = "";
    *stats = NULL;
    return PF_ROLE_CALIBRATOR;
}

static uint32_t serial_overruns(void *self)
{
    serial *s = self;
    uint32_t now;
    if (s->fd >= 0 && count_dropped(s->fd, &now)) {
        s->overruns += s->has_counted ? now - s->counted : 0;
        s->counted = now;
        s->has_counted = true;
    }
    return s->overruns;
}

static const char *serial_name(void *self)
{
    serial *s = self;
    return s->name;
}

static const char *serial_error(void *self)
{
    serial *s = self;
    return s->failure.text;
}

static void serial_close(void *self)
{
    serial *s = self;
    if (s->fd >= 0)
        close(s->fd);
    free(s->device);
    free(s);
}

pf_status pf_serial_open(pf_transport *transport, const pf_serial_config *config, char *error, size_t n)
{
    static const pf_transport_ops ops = {
        .fd = serial_fd,
        .service = serial_service,
        .read = serial_read,
        .write = serial_write,
        .room = serial_room,
        .peer = serial_peer,
        .overruns = serial_overruns,
        .name = serial_name,
        .error = serial_error,
        .close = serial_close,
    };
    pf_failure failure = {""};
    if (config->device == NULL || config->device[0] == '\0')
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_ARGUMENT, "serial: no device"), error, n);
    if (config->baud < BAUD_MIN || config->baud > BAUD_MAX)
        return pf_failure_copy(&failure,
                               pf_fail(&failure, PF_ERR_ARGUMENT, "%s: %u baud: must be %u..%u", config->device,
                                       config->baud, BAUD_MIN, BAUD_MAX),
                               error, n);
    serial *s = calloc(1, sizeof *s);
    if (s == NULL || (s->device = strdup(config->device)) == NULL) {
        free(s);
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "serial: no memory"), error, n);
    }
    s->baud = config->baud;
    s->rtscts = config->rtscts;
    s->fd = -1;
    (void)snprintf(s->name, sizeof s->name, "serial %s %u", s->device, s->baud);
    bool is_absent;
    pf_status status = open_device(s, &is_absent);
    if (status != PF_OK && !is_absent) {
        pf_failure_copy(&s->failure, status, error, n);
        serial_close(s);
        return status;
    }
    transport->self = s;
    transport->ops = &ops;
    return PF_OK;
}
