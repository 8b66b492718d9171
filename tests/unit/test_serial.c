#include "pipefish/drivers/transport.h"
#include "pipefish/link.h"
#include "temporary.h"
#include "unity.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <linux/serial.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <sys/ioctl.h>
#include <sys/wait.h>
#include <termios.h>
#include <time.h>

static pf_transport line, other;
static int master = -1;
static char error[256];

void setUp(void) {}

static void close_all(void)
{
    if (line.self != NULL)
        line.ops->close(line.self);
    if (other.self != NULL)
        other.ops->close(other.self);
    if (master >= 0)
        close(master);
    line.self = NULL;
    other.self = NULL;
    master = -1;
}

void tearDown(void)
{
    close_all();
}

/* Makes a pseudo-terminal whose other end is `master`, in the cooked mode that terminals start in. */
static const char *make_pty(void)
{
    master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    TEST_ASSERT_TRUE(master >= 0);
    TEST_ASSERT_EQUAL_INT(0, grantpt(master));
    TEST_ASSERT_EQUAL_INT(0, unlockpt(master));
    return ptsname(master);
}

static void open_line(pf_transport *t, const char *device, uint32_t baud)
{
    bool fresh = false;
    pf_serial_config config = {device, baud, false};
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_serial_open(t, &config, error, sizeof error), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->service(t->self, &fresh));
    TEST_ASSERT_TRUE(fresh);
    TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->service(t->self, &fresh));
    TEST_ASSERT_FALSE(fresh);
}

static void wait_readable(int fd)
{
    struct pollfd p = {fd, POLLIN, 0};
    TEST_ASSERT_EQUAL_INT(1, poll(&p, 1, 60000));
}

/* Proves: all byte values pass unchanged both ways (the line is raw), without blocking. */
static void test_every_byte_passes(void)
{
    uint8_t out[256], in[256];
    size_t n, have = 0;
    for (int i = 0; i < 256; i++)
        out[i] = (uint8_t)i;
    open_line(&line, make_pty(), 3000000);
    TEST_ASSERT_NOT_NULL(strstr(line.ops->name(line.self), " 3000000"));
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, in, sizeof in, &n));
    TEST_ASSERT_EQUAL_size_t(0, n);
    TEST_ASSERT_EQUAL_INT(256, write(master, out, 256));
    while (have < 256) {
        wait_readable(line.ops->fd(line.self));
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, in + have, sizeof in - have, &n));
        have += n;
    }
    TEST_ASSERT_EQUAL_MEMORY(out, in, 256);
    TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->write(line.self, out, 256, &n));
    TEST_ASSERT_EQUAL_size_t(256, n);
    memset(in, 0, sizeof in);
    for (have = 0; have < 256; have += n) {
        wait_readable(master);
        ssize_t k = read(master, in + have, sizeof in - have);
        TEST_ASSERT_TRUE(k > 0);
        n = (size_t)k;
    }
    TEST_ASSERT_EQUAL_MEMORY(out, in, 256);
}

/* Proves: a device that vanishes is noticed by reading and by writing, is waited for, and is a fresh stream when it is
 * back under its name. */
static void test_unplugged_and_plugged_in_again(void)
{
    const char *device = temporary_path("tty");
    uint8_t byte = 'x';
    size_t n;
    bool fresh;
    for (int by_writing = 0; by_writing < 2; by_writing++) {
        TEST_ASSERT_EQUAL_INT(0, symlink(make_pty(), device));
        open_line(&line, device, 115200);
        close(master);
        master = -1;
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, by_writing ? line.ops->write(line.self, &byte, 1, &n)
                                                        : line.ops->read(line.self, &byte, 1, &n));
        TEST_ASSERT_TRUE(line.ops->error(line.self)[0] != '\0');
        TEST_ASSERT_EQUAL_INT(-1, line.ops->fd(line.self));
        TEST_ASSERT_EQUAL_size_t(0, line.ops->room(line.self));
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, line.ops->write(line.self, &byte, 1, &n));
        for (int i = 0; i < 3; i++)
            TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, line.ops->service(line.self, &fresh));
        TEST_ASSERT_EQUAL_INT(0, unlink(device));
        TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, line.ops->service(line.self, &fresh));
        TEST_ASSERT_NOT_NULL(strstr(line.ops->error(line.self), device));
        TEST_ASSERT_EQUAL_INT(0, symlink(make_pty(), device));
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->service(line.self, &fresh));
        TEST_ASSERT_TRUE(fresh);
        TEST_ASSERT_EQUAL_INT(1, write(master, "y", 1));
        wait_readable(line.ops->fd(line.self));
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->read(line.self, &byte, 1, &n));
        TEST_ASSERT_EQUAL_HEX8('y', byte);
        close_all();
        TEST_ASSERT_EQUAL_INT(0, unlink(device));
    }
}

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

/* Proves: who writes only what room() allows never has more than 5 ms and one frame under way, at any rate, whatever
 * the clock does meanwhile; and room is nothing or a whole frame at least. */
static void test_room_bounds_the_queue(void)
{
    static const uint32_t bauds[] = {9600, 115200, 921600, 1234567, 3000000, 4000000};
    static uint8_t bytes[65536], drain[65536];
    for (size_t k = 0; k < sizeof bauds / sizeof bauds[0]; k++) {
        double start = seconds();
        open_line(&line, make_pty(), bauds[k]);
        size_t total = 0, frames = 0;
        for (int i = 0; i < 300; i++) {
            size_t room = line.ops->room(line.self), n = 0;
            TEST_ASSERT_TRUE(room == 0 || room >= PF_LINK_FRAME_MAX);
            if (room > 0)
                TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->write(line.self, bytes, room, &n));
            total += n;
            frames += n > 0;
            double sent = (seconds() - start) * bauds[k] / 10;
            TEST_ASSERT_TRUE((double)total <= sent + bauds[k] / 2000.0 + PF_LINK_FRAME_MAX);
            while (read(master, drain, sizeof drain) > 0)
                ;
            usleep(100);
        }
        TEST_ASSERT_TRUE(frames > 0);
        close_all();
    }
}

/* Proves: link.rtscts makes the line one with hardware flow control, and its absence one without, whatever it was
 * before; it is raw, 8N1, in both cases. That a wire stops by it only a wire can show. */
static void test_flow_control_is_set_as_asked(void)
{
    for (int i = 0; i < 2; i++) {
        struct termios t;
        pf_serial_config config = {make_pty(), 921600, i == 0};
        TEST_ASSERT_EQUAL_INT(0, tcgetattr(master, &t));
        t.c_cflag = i == 0 ? t.c_cflag & ~(tcflag_t)CRTSCTS : t.c_cflag | CRTSCTS;
        TEST_ASSERT_EQUAL_INT(0, tcsetattr(master, TCSANOW, &t));
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_serial_open(&line, &config, error, sizeof error), error);
        TEST_ASSERT_EQUAL_INT(0, tcgetattr(line.ops->fd(line.self), &t));
        TEST_ASSERT_EQUAL_INT(i == 0, (t.c_cflag & CRTSCTS) != 0);
        TEST_ASSERT_EQUAL_INT(CS8, t.c_cflag & (CSIZE | CSTOPB | PARENB));
        TEST_ASSERT_EQUAL_INT(0, t.c_lflag);
        TEST_ASSERT_EQUAL_INT(0, t.c_iflag);
        TEST_ASSERT_EQUAL_INT(0, t.c_oflag);
        close_all();
    }
}

/* Proves: with nobody reading at the other end writing never blocks, and a full pty is no room. */
static void test_full_pty_does_not_block(void)
{
    static uint8_t bytes[65536];
    size_t n = 1;
    open_line(&line, make_pty(), 4000000);
    for (int i = 0; i < 100 && n > 0; i++)
        TEST_ASSERT_EQUAL_INT(PF_OK, line.ops->write(line.self, bytes, sizeof bytes, &n));
    TEST_ASSERT_EQUAL_size_t(0, n);
    TEST_ASSERT_EQUAL_size_t(0, line.ops->room(line.self));
}

static void refused(const char *device, uint32_t baud, pf_status expected, const char *word)
{
    pf_serial_config config = {device, baud, false};
    error[0] = '\0';
    TEST_ASSERT_EQUAL_INT_MESSAGE(expected, pf_serial_open(&other, &config, error, sizeof error), error);
    TEST_ASSERT_NULL(other.self);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, word), error);
}

/* Proves: what is no serial line, no rate, or in use, is refused in words; and is free again after closing. */
static void test_wrong_devices_are_refused(void)
{
    refused("/dev/null", 115200, PF_ERR_UNSUPPORTED, "/dev/null: not a terminal");
    refused(temporary_text("file", "x"), 115200, PF_ERR_UNSUPPORTED, "not a terminal");
    refused("", 115200, PF_ERR_ARGUMENT, "no device");
    refused(NULL, 115200, PF_ERR_ARGUMENT, "no device");
    refused("/dev/ttyS0", 9599, PF_ERR_ARGUMENT, "9600..4000000");
    refused("/dev/ttyS0", 4000001, PF_ERR_ARGUMENT, "9600..4000000");
    const char *device = make_pty();
    open_line(&line, device, 115200);
    refused(device, 115200, PF_ERR_IO, "another program uses it");
    line.ops->close(line.self);
    line.self = NULL;
    open_line(&line, device, 115200);
}

/* ---- pipefish-line ---- */

static pid_t cable = -1;
static int cable_out = -1;

/* Starts pipefish-line between two links in the test's folder, and waits until they are there. */
static void start_cable(const char *const options[], size_t n)
{
    char *arguments[16] = {(char *)"pipefish-line"};
    int ends[2];
    size_t count = 1;
    for (size_t i = 0; i < n; i++)
        arguments[count++] = (char *)options[i];
    arguments[count++] = (char *)temporary_path("a");
    arguments[count++] = (char *)temporary_path("b");
    TEST_ASSERT_EQUAL_INT(0, pipe(ends));
    fflush(stdout);
    cable = fork();
    TEST_ASSERT_TRUE(cable >= 0);
    if (cable == 0) {
        dup2(ends[1], STDOUT_FILENO);
        close(ends[0]);
        close(ends[1]);
        execv(PIPEFISH_LINE, arguments);
        _exit(127);
    }
    close(ends[1]);
    cable_out = ends[0];
    bool is_there = false;
    for (int i = 0; i < 6000 && !is_there; i++) { /* looked at once only: it may be cut again right after */
        usleep(10000);
        is_there = access(temporary_path("b"), F_OK) == 0;
    }
    TEST_ASSERT_TRUE(is_there);
}

/* Ends it with SIGTERM; its one line of JSON. */
static const char *stop_cable(void)
{
    static char json[512];
    int status;
    TEST_ASSERT_EQUAL_INT(0, kill(cable, SIGTERM));
    ssize_t n = read(cable_out, json, sizeof json - 1);
    json[n > 0 ? n : 0] = '\0';
    close(cable_out);
    TEST_ASSERT_EQUAL_INT(cable, waitpid(cable, &status, 0));
    TEST_ASSERT_EQUAL_INT(0, status);
    TEST_ASSERT_TRUE_MESSAGE(access(temporary_path("a"), F_OK) != 0, "left its link behind");
    return json;
}

static long number_in(const char *json, const char *key)
{
    const char *at = strstr(json, key);
    TEST_ASSERT_NOT_NULL(at);
    return strtol(at + strlen(key) + 3, NULL, 10);
}

#define CABLE_BYTES 60000u
static uint8_t sent[2][CABLE_BYTES], received[2][CABLE_BYTES];

/* Sends CABLE_BYTES both ways at once as fast as room() allows, until all have come. */
static void exchange(void)
{
    size_t written[2] = {0, 0}, have[2] = {0, 0}, n;
    pf_transport *ends[2] = {&line, &other};
    double give_up = seconds() + 60;
    while (have[0] < CABLE_BYTES || have[1] < CABLE_BYTES) {
        TEST_ASSERT_TRUE_MESSAGE(seconds() < give_up, "bytes are missing");
        for (int i = 0; i < 2; i++) {
            pf_transport *t = ends[i];
            size_t room = t->ops->room(t->self);
            if (room > CABLE_BYTES - written[i])
                room = CABLE_BYTES - written[i];
            TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->write(t->self, sent[i] + written[i], room, &n));
            written[i] += n;
            TEST_ASSERT_EQUAL_INT(PF_OK, t->ops->read(t->self, received[i] + have[i], CABLE_BYTES - have[i], &n));
            have[i] += n;
        }
        usleep(200);
    }
}

static void fill_sent(uint64_t seed)
{
    for (int i = 0; i < 2; i++)
        for (size_t k = 0; k < CABLE_BYTES; k++)
            sent[i][k] = (uint8_t)temporary_random(&seed);
}

/* Proves: the emulated cable carries every byte unchanged both ways, no faster than its rate, also when both ends are
 * closed and opened again; it says what it carried. */
static void test_clean_cable(void)
{
    static const char *const options[] = {"--baud", "1000000"};
    start_cable(options, 2);
    for (int round = 0; round < 2; round++) {
        fill_sent((uint64_t)round);
        open_line(&line, temporary_path("a"), 1000000);
        open_line(&other, temporary_path("b"), 1000000);
        double start = seconds();
        exchange();
        /* a bound from below: 60,000 bytes of 10 bits are 0.6 s of line */
        TEST_ASSERT_TRUE(seconds() - start >= CABLE_BYTES * 10 / 1e6);
        TEST_ASSERT_EQUAL_MEMORY(sent[0], received[1], CABLE_BYTES);
        TEST_ASSERT_EQUAL_MEMORY(sent[1], received[0], CABLE_BYTES);
        close_all();
    }
    const char *json = stop_cable();
    TEST_ASSERT_EQUAL_INT(2 * CABLE_BYTES, number_in(json, "a_to_b"));
    TEST_ASSERT_EQUAL_INT(2 * CABLE_BYTES, number_in(json, "b_to_a"));
    TEST_ASSERT_EQUAL_INT(0, number_in(json, "corrupted"));
}

/* Proves: faults come at the asked rate, are counted, and follow from the seed. 60,000 bytes at 1 % are 600 +- 24
 * (one standard deviation): 5 of them are allowed. */
static void test_cable_faults_are_seeded_and_counted(void)
{
    static const char *const options[] = {"--baud", "4000000", "--corrupt", "0.01", "--seed", "5"};
    static uint8_t first[2][CABLE_BYTES];
    for (int round = 0; round < 2; round++) {
        fill_sent(9);
        start_cable(options, 6);
        open_line(&line, temporary_path("a"), 4000000);
        open_line(&other, temporary_path("b"), 4000000);
        exchange();
        close_all();
        long corrupted = number_in(stop_cable(), "corrupted"), different = 0;
        for (int i = 0; i < 2; i++) {
            long here = 0;
            for (size_t k = 0; k < CABLE_BYTES; k++)
                here += sent[i][k] != received[1 - i][k];
            TEST_ASSERT_INT_WITHIN(120, 600, here);
            different += here;
        }
        TEST_ASSERT_EQUAL_INT(different, corrupted);
        if (round == 0)
            memcpy(first, received, sizeof first);
    }
    TEST_ASSERT_EQUAL_MEMORY(first, received, sizeof first);
}

/* Proves: the asked share of frames is damaged, one byte each, and no delimiter is lost or made. 600 frames at 10 %
 * are 60 +- 7.4: 5 of them are allowed. */
static void test_cable_damages_frames(void)
{
    static const char *const options[] = {"--baud", "4000000", "--drop-frames", "0.1"};
    for (int i = 0; i < 2; i++)
        for (size_t k = 0; k < CABLE_BYTES; k++)
            sent[i][k] = k % 100 == 99 ? 0 : (uint8_t)(1 + k % 251);
    start_cable(options, 4);
    open_line(&line, temporary_path("a"), 4000000);
    open_line(&other, temporary_path("b"), 4000000);
    exchange();
    close_all();
    long damaged = number_in(stop_cable(), "damaged_frames"), different = 0;
    for (int i = 0; i < 2; i++) {
        long here = 0;
        for (size_t k = 0; k < CABLE_BYTES; k++) {
            TEST_ASSERT_EQUAL_INT(sent[i][k] == 0, received[1 - i][k] == 0);
            here += sent[i][k] != received[1 - i][k];
        }
        TEST_ASSERT_INT_WITHIN(37, 60, here);
        different += here;
    }
    TEST_ASSERT_EQUAL_INT(different, damaged);
}

/* Opens a device that may be unplugged at any moment, once it is there. */
static void open_when_there(pf_transport *t, const char *device)
{
    bool fresh;
    pf_serial_config config = {device, 3000000, false};
    double give_up = seconds() + 60;
    while ((t->self == NULL && pf_serial_open(t, &config, error, sizeof error) != PF_OK) ||
           t->ops->service(t->self, &fresh) != PF_OK) {
        TEST_ASSERT_TRUE_MESSAGE(seconds() < give_up, error);
        usleep(5000);
    }
}

/* Proves: a cable that is pulled hangs up on both ends, and the driver finds it again when it is back. */
static void test_cable_is_cut_and_comes_back(void)
{
    static const char *const options[] = {"--cut", "0.3"};
    pf_transport *ends[2] = {&line, &other};
    start_cable(options, 2);
    open_when_there(&line, temporary_path("a"));
    open_when_there(&other, temporary_path("b"));
    for (int i = 0; i < 2; i++) {
        uint8_t byte;
        size_t n;
        bool fresh = false;
        pf_transport *t = ends[i];
        double give_up = seconds() + 60;
        while (t->ops->read(t->self, &byte, 1, &n) == PF_OK && seconds() < give_up)
            usleep(5000);
        TEST_ASSERT_EQUAL_INT(-1, t->ops->fd(t->self));
        while (t->ops->service(t->self, &fresh) == PF_ERR_AGAIN && seconds() < give_up)
            usleep(5000);
        TEST_ASSERT_TRUE(fresh);
    }
    close_all();
    TEST_ASSERT_TRUE(number_in(stop_cable(), "cuts") >= 1);
}

/* ---- the kernel's count of what was dropped, made up here: a pseudo-terminal has none */

static struct {
    bool tells;
    int fifo, room; /* it counts the two apart */
} dropped;

int __real_ioctl(int fd, unsigned long request, ...);
int __wrap_ioctl(int fd, unsigned long request, ...);

int __wrap_ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (request != TIOCGICOUNT || !dropped.tells)
        return __real_ioctl(fd, request, argument);
    *(struct serial_icounter_struct *)argument =
        (struct serial_icounter_struct){.overrun = dropped.fifo, .buf_overrun = dropped.room};
    return 0;
}

static uint32_t overruns(void)
{
    return line.ops->overruns(line.self);
}

/* Proves: only what was dropped since the device was opened counts, over the end of the kernel's counter, and a kernel
 * that does not tell, at first or for a while, changes nothing. */
static void test_dropped_bytes_are_counted_while_the_kernel_tells(void)
{
    for (int tells_first = 0; tells_first < 2; tells_first++) {
        dropped.tells = tells_first;
        dropped.fifo = INT_MAX;
        dropped.room = INT_MAX;
        open_line(&line, make_pty(), 115200);
        TEST_ASSERT_EQUAL_UINT32(0, overruns());
        dropped.tells = true;
        TEST_ASSERT_EQUAL_UINT32(0, overruns()); /* what came before */
        dropped.fifo = INT_MIN + 4;
        TEST_ASSERT_EQUAL_UINT32(5, overruns());
        dropped.tells = false;
        TEST_ASSERT_EQUAL_UINT32(5, overruns());
        dropped.tells = true;
        dropped.room = INT_MIN + 1;
        TEST_ASSERT_EQUAL_UINT32(7, overruns());
        dropped.tells = false;
        close_all();
    }
}

int main(void)
{
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_every_byte_passes);
    RUN_TEST(test_unplugged_and_plugged_in_again);
    RUN_TEST(test_room_bounds_the_queue);
    RUN_TEST(test_flow_control_is_set_as_asked);
    RUN_TEST(test_full_pty_does_not_block);
    RUN_TEST(test_wrong_devices_are_refused);
    RUN_TEST(test_dropped_bytes_are_counted_while_the_kernel_tells);
    RUN_TEST(test_clean_cable);
    RUN_TEST(test_cable_faults_are_seeded_and_counted);
    RUN_TEST(test_cable_damages_frames);
    RUN_TEST(test_cable_is_cut_and_comes_back);
    temporary_remove();
    return UNITY_END();
}
