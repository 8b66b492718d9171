/* pipefish-line: a serial cable between two pseudo-terminals, with the pace of a UART and the faults of a bad cable.
 * For tests, and for users without hardware. Each direction is a buffer of 4 KiB that empties at baud / 10 bytes a
 * second (8N1); while it is full, nothing more is taken from the writer's pseudo-terminal, which then fills up too.
 */
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define BUFFER_BYTES 4096u
#define CHUNK_BYTES  256u     /* delivered at once at most: 0.85 ms at 3 Mbaud */
#define RETRY_NS     1000000u /* how soon a reader that took nothing is tried again */
#define UNPLUGGED_NS 500000000u

typedef struct options {
    const char *path[2];
    uint32_t baud;
    double corrupt, damage_frames, cut_s;
    uint64_t seed;
} options;

typedef struct end {
    int master, slave; /* the slave is kept open, so that a program may close and reopen it; -1 = unplugged */
} end;

typedef struct faults {
    uint64_t random;
    uint64_t until_fault; /* bytes to the next corrupted one */
    uint32_t frame_byte;  /* of the frame under way: how many have passed */
    bool damage;          /* this frame is to be damaged */
    uint64_t passed, corrupted, damaged;
} faults;

typedef struct direction {
    uint8_t bytes[BUFFER_BYTES];
    uint32_t first, count;
    uint64_t free_ps;  /* when the line has sent what left the buffer, picoseconds since the start */
    uint64_t retry_ns; /* the reader took nothing: not before this */
    faults faults;
} direction;

typedef struct line {
    options options;
    end ends[2];
    direction ways[2]; /* ways[i] leads from ends[i] to the other */
    uint64_t start_ns, byte_ps;
    uint64_t plug_ns; /* when to cut or to plug in next; UINT64_MAX = never */
    uint64_t cuts;
} line;

static volatile sig_atomic_t stopping;

static void on_signal(int number)
{
    (void)number;
    stopping = 1;
}

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

/* SplitMix64 (Steele, Lea & Flood, OOPSLA 2014). */
static uint64_t random_next(uint64_t *state)
{
    uint64_t z = *state += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

/* 0 < u < 1 */
static double random_unit(uint64_t *state)
{
    return ((double)(random_next(state) >> 11) + 0.5) / 9007199254740992.0;
}

/* Bytes before the next corrupted one: geometric with probability p a byte. */
static uint64_t draw_fault(uint64_t *state, double p)
{
    if (p <= 0)
        return UINT64_MAX;
    if (p >= 1)
        return 0;
    double gap = floor(log(random_unit(state)) / log1p(-p));
    return gap < 1e18 ? (uint64_t)gap : UINT64_MAX;
}

/* Another value than `byte`, and not a delimiter: the frame keeps its length. */
static uint8_t spoil(uint64_t *state, uint8_t byte)
{
    uint8_t other;
    do
        other = (uint8_t)(random_next(state) >> 56);
    while (other == byte || other == 0);
    return other;
}

/* What the cable makes of the next byte of a direction. */
static uint8_t pass(const options *o, faults *f, uint8_t byte)
{
    uint8_t out = byte;
    f->passed++;
    if (f->frame_byte == 0)
        f->damage = o->damage_frames > 0 && random_unit(&f->random) < o->damage_frames;
    f->frame_byte = byte == 0 ? 0 : f->frame_byte + 1;
    if (f->damage && f->frame_byte == 2) { /* the first would only break the COBS coding; this one tries the checksum */
        out = spoil(&f->random, byte);
        f->damaged++;
    }
    if (f->until_fault == 0) {
        out ^= (uint8_t)(1 + random_next(&f->random) % 255);
        f->corrupted++;
        f->until_fault = draw_fault(&f->random, o->corrupt);
    } else if (f->until_fault != UINT64_MAX) {
        f->until_fault--;
    }
    return out;
}

/* ---- the ends ---- */

static bool fail(const char *what)
{
    (void)fprintf(stderr, "pipefish-line: %s: %s\n", what, strerror(errno));
    return false;
}

static void unplug(line *l)
{
    for (int i = 0; i < 2; i++) {
        if (l->ends[i].master < 0)
            continue;
        (void)unlink(l->options.path[i]);
        close(l->ends[i].slave);
        close(l->ends[i].master); /* hangs up on whoever has it open */
        l->ends[i] = (end){-1, -1};
        l->ways[i].count = 0;
        l->ways[i].faults.frame_byte = 0;
    }
}

/* Makes a pseudo-terminal and puts a link to it at `path`; an older link is replaced, any other file is not. */
static bool plug_end(end *e, const char *path)
{
    struct termios t;
    struct stat info;
    char slave[64], temporary[4096];
    if (lstat(path, &info) == 0 && !S_ISLNK(info.st_mode)) {
        errno = EEXIST;
        return fail(path);
    }
    e->master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (e->master < 0)
        return fail("no pseudo-terminal");
    if (grantpt(e->master) != 0 || unlockpt(e->master) != 0 || ptsname_r(e->master, slave, sizeof slave) != 0)
        return fail("pseudo-terminal");
    e->slave = open(slave, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (e->slave < 0 || tcgetattr(e->slave, &t) != 0)
        return fail(slave);
    cfmakeraw(&t);
    if (tcsetattr(e->slave, TCSANOW, &t) != 0)
        return fail(slave);
    int n = snprintf(temporary, sizeof temporary, "%s.%ld", path, (long)getpid());
    if (n < 0 || (size_t)n >= sizeof temporary) {
        errno = ENAMETOOLONG;
        return fail(path);
    }
    (void)unlink(temporary);
    if (symlink(slave, temporary) != 0)
        return fail(temporary);
    if (rename(temporary, path) != 0) {
        (void)unlink(temporary);
        return fail(path);
    }
    return true;
}

static bool plug(line *l)
{
    return plug_end(&l->ends[0], l->options.path[0]) && plug_end(&l->ends[1], l->options.path[1]);
}

/* ---- moving bytes ---- */

/* Takes what there is room for; on an idle line the first byte starts now. */
static void take(line *l, int from, uint64_t now)
{
    direction *d = &l->ways[from];
    bool was_idle = d->count == 0;
    while (d->count < BUFFER_BYTES) {
        uint32_t at = (d->first + d->count) % BUFFER_BYTES;
        uint32_t room = at < d->first ? d->first - at : BUFFER_BYTES - at;
        ssize_t k = read(l->ends[from].master, d->bytes + at, room);
        if (k <= 0)
            break;
        d->count += (uint32_t)k;
    }
    uint64_t now_ps = (now - l->start_ns) * 1000u;
    if (was_idle && d->count > 0 && d->free_ps < now_ps)
        d->free_ps = now_ps;
}

/* Gives the other end the bytes whose time has come. */
static void give(line *l, int from, uint64_t now)
{
    direction *d = &l->ways[from];
    uint64_t now_ps = (now - l->start_ns) * 1000u;
    while (d->count > 0 && d->free_ps + l->byte_ps <= now_ps && now >= d->retry_ns) {
        uint64_t due = (now_ps - d->free_ps) / l->byte_ps;
        uint32_t n = d->count < CHUNK_BYTES ? d->count : CHUNK_BYTES, contiguous = BUFFER_BYTES - d->first;
        if (n > due)
            n = (uint32_t)due;
        if (n > contiguous)
            n = contiguous;
        /* The faults are drawn from a copy of the state: only bytes that the reader takes have passed. */
        faults before = d->faults;
        uint8_t out[CHUNK_BYTES];
        for (uint32_t i = 0; i < n; i++)
            out[i] = pass(&l->options, &d->faults, d->bytes[d->first + i]);
        ssize_t k = write(l->ends[1 - from].master, out, n);
        uint32_t taken = k > 0 ? (uint32_t)k : 0;
        if (taken < n) {
            d->faults = before;
            for (uint32_t i = 0; i < taken; i++)
                (void)pass(&l->options, &d->faults, d->bytes[d->first + i]);
        }
        d->first = (d->first + taken) % BUFFER_BYTES;
        d->count -= taken;
        d->free_ps += taken * l->byte_ps;
        if (taken < n) { /* nobody reads: the line stands still, as with flow control */
            d->retry_ns = now + RETRY_NS;
            d->free_ps = now_ps;
        }
    }
}

/* When give() has something to do next. */
static uint64_t next_ns(const line *l, const direction *d)
{
    if (d->count == 0)
        return UINT64_MAX;
    uint64_t n = d->count < CHUNK_BYTES ? d->count : CHUNK_BYTES;
    uint64_t due = l->start_ns + (d->free_ps + n * l->byte_ps) / 1000u + 1;
    return due > d->retry_ns ? due : d->retry_ns;
}

static void wait_for_work(const line *l, const sigset_t *mask)
{
    struct pollfd polled[2];
    uint64_t until = l->plug_ns, now = now_ns();
    for (int i = 0; i < 2; i++) {
        uint64_t due = next_ns(l, &l->ways[i]);
        if (due < until)
            until = due;
        polled[i].fd = l->ways[i].count < BUFFER_BYTES ? l->ends[i].master : -1;
        polled[i].events = POLLIN;
    }
    uint64_t wait = until > now ? until - now : 0;
    struct timespec t = {(time_t)(wait / 1000000000u), (long)(wait % 1000000000u)};
    (void)ppoll(polled, 2, until == UINT64_MAX ? NULL : &t, mask);
}

static bool cut_or_plug(line *l, uint64_t now)
{
    if (l->ends[0].master >= 0) {
        unplug(l);
        l->cuts++;
        l->plug_ns = now + UNPLUGGED_NS;
        return true;
    }
    l->plug_ns = now + (uint64_t)(l->options.cut_s * 1e9);
    return plug(l);
}

static bool relay(line *l)
{
    struct sigaction action = {.sa_handler = on_signal};
    sigset_t blocked, mask;
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGTERM);
    sigaddset(&blocked, SIGINT);
    sigprocmask(SIG_BLOCK, &blocked, &mask); /* they come in ppoll only: none is missed between test and wait */
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    bool ok = plug(l);
    while (ok && !stopping) {
        wait_for_work(l, &mask);
        uint64_t now = now_ns();
        if (now >= l->plug_ns)
            ok = cut_or_plug(l, now);
        for (int i = 0; i < 2 && ok && l->ends[0].master >= 0; i++) {
            give(l, i, now);
            take(l, i, now);
        }
    }
    unplug(l);
    return ok;
}

/* ---- command line ---- */

static const char usage[] =
    "Usage: pipefish-line [options] PATH_A PATH_B\n"
    "An emulated serial cable: two pseudo-terminals, linked from PATH_A and PATH_B, until SIGTERM or SIGINT.\n"
    "Then one line of JSON says what went through.\n"
    "\n"
    "  --baud N          rate, 8N1 [3000000]\n"
    "  --corrupt P       probability that a byte is changed [0]\n"
    "  --drop-frames P   share of zero-delimited frames that get a wrong byte, so that the receiver drops them [0]\n"
    "  --cut SECONDS     pull the cable that long after each plugging in, for half a second [never]\n"
    "  --seed N          of the faults [1]\n"
    "\n"
    "Example: pipefish-line --baud 921600 --corrupt 1e-6 /tmp/crawler /tmp/host\n";

static bool parse_number(const char *text, double min, double max, double *value)
{
    char *rest;
    *value = strtod(text, &rest);
    return rest != text && *rest == '\0' && *value >= min && *value <= max;
}

/* 0 = go on, 1 = help was asked for, 2 = wrong usage */
static int parse_options(int argc, char **argv, options *o)
{
    static const struct option known[] = {
        {"baud", required_argument, NULL, 'b'},
        {"corrupt", required_argument, NULL, 'c'},
        {"drop-frames", required_argument, NULL, 'd'},
        {"cut", required_argument, NULL, 'u'},
        {"seed", required_argument, NULL, 's'},
        {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0},
    };
    int c, index = 0;
    *o = (options){.baud = 3000000, .seed = 1};
    while ((c = getopt_long(argc, argv, "h", known, &index)) != -1) {
        double number = 0;
        bool ok = true;
        if (c == 'h')
            return 1;
        if (c == 'b')
            ok = parse_number(optarg, 300, 100e6, &number);
        else if (c == 'c')
            ok = parse_number(optarg, 0, 1, &o->corrupt);
        else if (c == 'd')
            ok = parse_number(optarg, 0, 1, &o->damage_frames);
        else if (c == 'u')
            ok = parse_number(optarg, 0.01, 1e6, &o->cut_s);
        else if (c == 's')
            ok = parse_number(optarg, 0, 9007199254740992.0, &number);
        else
            return 2;
        if (!ok) {
            (void)fprintf(stderr, "pipefish-line: --%s: \"%s\" is no number in its range\n", known[index].name, optarg);
            return 2;
        }
        if (c == 'b')
            o->baud = (uint32_t)number;
        if (c == 's')
            o->seed = (uint64_t)number;
    }
    if (argc - optind != 2 || strcmp(argv[optind], argv[optind + 1]) == 0) {
        (void)fprintf(stderr, "pipefish-line: two different paths are needed (--help)\n");
        return 2;
    }
    o->path[0] = argv[optind];
    o->path[1] = argv[optind + 1];
    return 0;
}

int main(int argc, char **argv)
{
    static line l;
    int asked = parse_options(argc, argv, &l.options);
    if (asked == 1)
        (void)fputs(usage, stdout);
    if (asked != 0)
        return asked == 1 ? 0 : 2;
    l.start_ns = now_ns();
    l.byte_ps = 10000000000000u / l.options.baud;
    l.plug_ns = l.options.cut_s > 0 ? l.start_ns + (uint64_t)(l.options.cut_s * 1e9) : UINT64_MAX;
    for (int i = 0; i < 2; i++) {
        l.ends[i] = (end){-1, -1};
        l.ways[i].faults.random = 2 * l.options.seed + (uint64_t)i;
        l.ways[i].faults.until_fault = draw_fault(&l.ways[i].faults.random, l.options.corrupt);
    }
    bool ok = relay(&l);
    (void)printf("{\"a_to_b\": %" PRIu64 ", \"b_to_a\": %" PRIu64 ", \"corrupted\": %" PRIu64
                 ", \"damaged_frames\": %" PRIu64 ", \"cuts\": %" PRIu64 "}\n",
                 l.ways[0].faults.passed, l.ways[1].faults.passed,
                 l.ways[0].faults.corrupted + l.ways[1].faults.corrupted,
                 l.ways[0].faults.damaged + l.ways[1].faults.damaged, l.cuts);
    return ok ? 0 : 1;
}
