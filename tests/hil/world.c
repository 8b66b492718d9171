/* The world of the emulated board: shows recorded frames to a V4L2 camera and turns its wheel encoder with them.
 *
 *   pipefish-world [--to-and-fro] FRAMES.y4m DEVICE FORMAT RATE FIRST COUNT
 *                  [--encoder PULL_A PULL_B COUNTS.txt | --rotary COUNTS.txt]
 *   pipefish-world --overrun TTY
 *
 * Shows COUNT frames once; or to and fro, until SIGTERM. DEVICE is a V4L2 output node: of v4l2loopback (frames are
 * written, none is lost) or of vivid (its clock and the capturing side's differ). FORMAT: GREY, YUYV, NV12, Y10 or Y12.
 * COUNTS.txt has the encoder's count at each frame, one a line; PULL_A and PULL_B are gpio-sim's files; --rotary is an
 * input device such as the driver rotary-encoder makes, which stands still until SIGUSR1. Frame i is shown when the
 * encoder has reached its count. --overrun makes a 16550 hear itself until the kernel has counted an overrun: beside
 * what the other end must send all that time it is more than its 16 bytes hold.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/serial.h>
#include <linux/uinput.h>
#include <linux/videodev2.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#define BUFFERS           4u
#define LEAST_GAP_S       0.004 /* between two edges: gpio-sim merges what comes faster than its threads */
#define LONGEST_OVERRUN_S 60

typedef struct world {
    FILE *y4m;
    uint32_t width, height, fourcc, stride, scale, extra; /* extra: bits of a pixel beyond eight */
    size_t size, at;                                      /* of a shown frame; of the first frame in the file */
    uint8_t *grey;
    int fd;
    bool is_streaming, has_buffers;
    uint8_t *buffer[BUFFERS];
    uint32_t filled;
    /* encoder */
    int pull[2], rotary; /* rotary: uinput, 0 = none */
    int64_t *counts, count;
    uint32_t n_counts;
} world;

static volatile sig_atomic_t is_over;

static void end(int signal_number)
{
    (void)signal_number;
    is_over = 1;
}

static _Noreturn void fail(const char *what)
{
    (void)fprintf(stderr, "pipefish-world: %s: %s\n", what, strerror(errno));
    exit(1);
}

static void sleep_until(double due)
{
    struct timespec t = {(time_t)due, (long)((due - (double)(time_t)due) * 1e9)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR)
        ;
}

static double now(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

static void open_y4m(world *w, const char *path)
{
    char line[256];
    w->y4m = fopen(path, "rb");
    if (w->y4m == NULL || fgets(line, sizeof line, w->y4m) == NULL ||
        sscanf(line, "YUV4MPEG2 W%u H%u", &w->width, &w->height) != 2)
        fail(path);
    w->at = (size_t)ftell(w->y4m);
    w->grey = malloc((size_t)w->width * w->height);
}

static void read_frame(world *w, uint32_t i)
{
    const size_t n = (size_t)w->width * w->height;
    if (fseek(w->y4m, (long)(w->at + i * (n + 6) + 6), SEEK_SET) != 0 || fread(w->grey, 1, n, w->y4m) != n)
        fail("the frame is not in the recording");
}

static void fill(const world *w, uint8_t *to)
{
    memset(to, 128, w->size);
    for (uint32_t y = 0; y < w->height * w->scale; y++) {
        const uint8_t *from = w->grey + (size_t)(y / w->scale) * w->width;
        uint8_t *row = to + (size_t)y * w->stride;
        for (uint32_t x = 0; x < w->width * w->scale; x++) {
            const uint8_t v = from[w->scale == 2 ? x / 4 * 2 + x % 2 : x];
            if (w->fourcc == V4L2_PIX_FMT_YUYV) {
                row[2 * x] = v;
            } else if (w->extra > 0) { /* the low bits are what a tracker of bytes must not see */
                row[2 * x] = (uint8_t)(v << w->extra | (x & ((1u << w->extra) - 1)));
                row[2 * x + 1] = (uint8_t)(v >> (8 - w->extra));
            } else {
                row[x] = v;
            }
        }
    }
}

static void open_video(world *w, const char *device, const char *format)
{
    struct v4l2_format f = {.type = V4L2_BUF_TYPE_VIDEO_OUTPUT};
    w->fourcc = v4l2_fourcc(format[0], format[1], format[2], format[3] ? format[3] : ' ');
    w->extra = w->fourcc == V4L2_PIX_FMT_Y10 ? 2 : w->fourcc == V4L2_PIX_FMT_Y12 ? 4 : 0;
    w->fd = open(device, O_RDWR);
    if (w->fd < 0 || ioctl(w->fd, VIDIOC_G_FMT, &f) != 0)
        fail(device);
    struct v4l2_capability cap;
    if (ioctl(w->fd, VIDIOC_QUERYCAP, &cap) != 0)
        fail("QUERYCAP");
    /* vivid's HDMI is twice as large, and its capturing side shrinks what comes by leaving out pairs of pixels. */
    w->has_buffers = strcmp((const char *)cap.driver, "vivid") == 0;
    w->scale = w->has_buffers ? 2 : 1;
    f.fmt.pix.width = w->width * w->scale;
    f.fmt.pix.height = w->height * w->scale;
    f.fmt.pix.pixelformat = w->fourcc;
    f.fmt.pix.field = V4L2_FIELD_NONE;
    f.fmt.pix.bytesperline = f.fmt.pix.sizeimage = 0;
    if (ioctl(w->fd, VIDIOC_S_FMT, &f) != 0 || f.fmt.pix.width != w->width * w->scale ||
        f.fmt.pix.pixelformat != w->fourcc) {
        errno = EINVAL;
        fail("the format cannot be set");
    }
    w->stride = f.fmt.pix.bytesperline;
    w->size = f.fmt.pix.sizeimage;
    const uint32_t bytes = w->extra > 0 || w->fourcc == V4L2_PIX_FMT_YUYV ? 2 : 1;
    if (w->stride < f.fmt.pix.width * bytes || w->size < (size_t)w->stride * f.fmt.pix.height) {
        errno = EMSGSIZE; /* v4l2loopback 0.12 counts ten bits for a pixel of Y10, which has sixteen */
        fail("the device has no room for its own format");
    }
    if (!w->has_buffers) {
        w->buffer[0] = malloc(w->size);
        return;
    }
    struct v4l2_requestbuffers r = {.count = BUFFERS, .type = f.type, .memory = V4L2_MEMORY_MMAP};
    if (ioctl(w->fd, VIDIOC_REQBUFS, &r) != 0 || r.count < BUFFERS)
        fail("REQBUFS");
    for (uint32_t i = 0; i < BUFFERS; i++) {
        struct v4l2_buffer b = {.index = i, .type = f.type, .memory = V4L2_MEMORY_MMAP};
        if (ioctl(w->fd, VIDIOC_QUERYBUF, &b) != 0)
            fail("QUERYBUF");
        w->buffer[i] = mmap(NULL, b.length, PROT_READ | PROT_WRITE, MAP_SHARED, w->fd, b.m.offset);
        if (w->buffer[i] == MAP_FAILED)
            fail("mmap");
    }
}

static void show(world *w)
{
    int type = V4L2_BUF_TYPE_VIDEO_OUTPUT;
    struct v4l2_buffer b = {.index = w->filled, .type = (uint32_t)type, .memory = V4L2_MEMORY_MMAP};
    if (!w->has_buffers) {
        fill(w, w->buffer[0]);
        if (write(w->fd, w->buffer[0], w->size) != (ssize_t)w->size)
            fail("write");
        return;
    }
    if (w->filled == BUFFERS && ioctl(w->fd, VIDIOC_DQBUF, &b) != 0)
        fail("DQBUF");
    fill(w, w->buffer[b.index]);
    b.bytesused = (uint32_t)w->size;
    b.field = V4L2_FIELD_NONE;
    if (ioctl(w->fd, VIDIOC_QBUF, &b) != 0)
        fail("QBUF");
    w->filled += w->filled < BUFFERS;
    if (!w->is_streaming && ioctl(w->fd, VIDIOC_STREAMON, &type) != 0)
        fail("STREAMON");
    w->is_streaming = true;
}

static void open_pulls(world *w, char **paths)
{
    for (int i = 0; i < 2; i++) {
        w->pull[i] = open(paths[i], O_WRONLY);
        if (w->pull[i] < 0)
            fail(paths[i]);
    }
}

static void open_rotary(world *w)
{
    struct uinput_setup setup = {.name = "rotary@0"};
    w->rotary = open("/dev/uinput", O_WRONLY);
    if (w->rotary < 0 || ioctl(w->rotary, UI_SET_EVBIT, EV_REL) != 0 || ioctl(w->rotary, UI_SET_RELBIT, REL_X) != 0 ||
        ioctl(w->rotary, UI_DEV_SETUP, &setup) != 0 || ioctl(w->rotary, UI_DEV_CREATE) != 0)
        fail("/dev/uinput");
}

static void open_counts(world *w, const char *path)
{
    FILE *in = fopen(path, "r");
    long long count;
    if (in == NULL)
        fail(path);
    w->counts = calloc(100000, sizeof *w->counts);
    while (w->n_counts < 100000 && fscanf(in, "%lld", &count) == 1)
        w->counts[w->n_counts++] = count;
    (void)fclose(in);
}

/* One quarter of a period: A leads B when the wheel turns forwards. */
static void turn(world *w, int way)
{
    if (w->rotary > 0) {
        struct input_event e[2] = {{.type = EV_REL, .code = REL_X, .value = way}, {.type = EV_SYN, .code = SYN_REPORT}};
        w->count += way;
        if (write(w->rotary, e, sizeof e) != (ssize_t)sizeof e)
            fail("rotary");
        return;
    }
    static const uint8_t phase[4] = {0, 1, 3, 2}; /* bit 0: A, bit 1: B */
    const uint8_t before = phase[w->count & 3];
    w->count += way;
    const uint8_t after = phase[w->count & 3];
    for (int i = 0; i < 2; i++) {
        if (((before ^ after) >> i & 1) == 0)
            continue;
        const char *pull = after >> i & 1 ? "pull-up" : "pull-down";
        if (pwrite(w->pull[i], pull, strlen(pull), 0) < 0)
            fail("pull");
    }
}

/* Turns the wheel from where it is to frame i's count, evenly over `seconds`. */
static void drive(world *w, uint32_t i, double begin, double seconds)
{
    if (i >= w->n_counts)
        return;
    const int64_t way = w->counts[i] - w->count, steps = way < 0 ? -way : way;
    for (int64_t k = 0; k < steps; k++) {
        sleep_until(begin + seconds * (double)k / (double)steps);
        turn(w, way < 0 ? -1 : 1);
        sleep_until(now() + LEAST_GAP_S); /* also when it is late */
    }
}

static int count_overruns(int fd)
{
    struct serial_icounter_struct c;
    if (ioctl(fd, TIOCGICOUNT, &c) != 0)
        fail("TIOCGICOUNT");
    return c.overrun;
}

/* Its loopback bit: what it sends comes in again, whether there is room or not. */
static int overrun(const char *tty)
{
    const int loop = 0x8000; /* TIOCM_LOOP: the kernel's header that has it and glibc's exclude each other */
    static const uint8_t bytes[4096];
    const double begin = now();
    int fd = open(tty, O_RDWR | O_NOCTTY);
    if (fd < 0 || ioctl(fd, TIOCMBIS, &loop) != 0)
        fail(tty);
    const int before = count_overruns(fd);
    while (count_overruns(fd) == before && now() - begin < LONGEST_OVERRUN_S)
        if (write(fd, bytes, sizeof bytes) < 0 || ioctl(fd, TCSBRK, 1) != 0) /* TCSBRK 1: wait until it is sent */
            fail("write");
    if (ioctl(fd, TIOCMBIC, &loop) != 0)
        fail(tty);
    (void)printf("%d overruns in %.2f s\n", count_overruns(fd) - before, now() - begin);
    return count_overruns(fd) == before;
}

/* The next frame is due a period after this one, however late this one was: a world that gets no time shows nothing
 * meanwhile, and then not all at once. */
static void run(world *w, uint32_t first, uint32_t count, double period, bool is_to_and_fro)
{
    /* The camera has a picture from now on: whoever waits for it gets the first frame. */
    const double begin = now();
    const uint32_t there_and_back = count > 1 ? 2 * (count - 1) : 1;
    double due = begin + 1;
    uint32_t shown = 0;
    while (is_to_and_fro ? !is_over : shown < count) {
        const uint32_t at = shown % there_and_back, i = first + (at < count ? at : there_and_back - at);
        read_frame(w, i);
        drive(w, i, due - 0.8 * period, 0.6 * period);
        sleep_until(due);
        show(w);
        due = now() + period;
        if (shown++ == 0) {
            (void)puts("shows");
            (void)fflush(stdout);
        }
    }
    sleep_until(due + 0.2);
    (void)printf("shown %u frames in %.2f s\n", shown, now() - begin);
}

int main(int argc, char **argv)
{
    if (argc == 3 && strcmp(argv[1], "--overrun") == 0)
        return overrun(argv[2]);
    world w = {.fd = -1};
    sigset_t go;
    (void)sigemptyset(&go);
    (void)sigaddset(&go, SIGUSR1);
    (void)sigprocmask(SIG_BLOCK, &go, NULL);
    (void)signal(SIGTERM, end);
    const bool is_to_and_fro = argc > 1 && strcmp(argv[1], "--to-and-fro") == 0;
    argc -= is_to_and_fro;
    argv += is_to_and_fro;
    if (argc < 7) {
        (void)fprintf(
            stderr, "usage: pipefish-world [--to-and-fro] Y4M DEVICE FORMAT RATE FIRST COUNT [--encoder A B COUNTS]\n");
        return 2;
    }
    open_y4m(&w, argv[1]);
    open_video(&w, argv[2], argv[3]);
    const double period = 1 / atof(argv[4]);
    const uint32_t first = (uint32_t)atoi(argv[5]), count = (uint32_t)atoi(argv[6]);
    if (argc == 11) {
        open_pulls(&w, argv + 8);
        open_counts(&w, argv[10]);
    } else if (argc == 9) {
        open_rotary(&w);
        open_counts(&w, argv[8]);
    }
    if (w.n_counts > first) /* the wheel stands where the survey begins */
        w.count = first > 0 ? w.counts[first - 1] : w.counts[0];
    int number;
    if (w.rotary > 0)
        (void)sigwait(&go, &number);
    run(&w, first, count, period, is_to_and_fro);
    return 0;
}
