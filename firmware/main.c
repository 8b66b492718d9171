/* pipefishd: reads its settings, opens what it needs, starts the threads, and waits for the end. */
#include <errno.h>
#include <getopt.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/random.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include "courier.h"
#include "guard.h"
#include "keeper.h"
#include "log.h"
#include "objects.h"
#include "pairing.h"
#include "pipefish/camera_fixed.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"
#include "pipeline.h"
#include "pulse.h"
#include "recall.h"
#include "tracking.h"
#include "utf8.h"

#define DEFAULT_CONFIG "/etc/pipefish/pipefishd.ini"
#define TICK_MS        50
#define OVERRIDES_MAX  128
#define ALONE_NS       UINT64_C(10000000000) /* without a host, after a signal; hosts pause 5 s at most between tries */
#define ROUND_NS       UINT64_C(1000000000)  /* the GPIO thread goes round several times in it */
#define SILENCES       4 /* keepalives without an answer after which a host counts as gone, as the link has it */

enum { DONE = 0, FAILED = 1, USAGE = 2 };

static const char usage[] =
    "usage: pipefishd [--config FILE] [--set section.key=value]...\n"
    "\n"
    "  --config FILE            settings (default " DEFAULT_CONFIG ")\n"
    "  --set section.key=value  one setting, over the file's; may be repeated\n"
    "  --state DIR              folder that remembers the settings that worked: they come back\n"
    "                           when three starts in a row fail\n"
    "  --pair \"ROLE KEY NAME\"   let a host in over the network (viewer, operator, calibrator; revoked\n"
    "                           = never again), print this device's key; see `pipefish pair`\n"
    "  --check-config           check settings, profile, recording, keys; start nothing\n"
    "  --help-config            print every setting with its meaning: an example file\n"
    "  --version                print the version\n"
    "\n"
    "example: pipefishd --config survey.ini --set camera.speed=fast\n"
    "exit codes: 0 done, 1 failed, 2 wrong usage\n";

typedef struct options {
    const char *config;
    const char *override[OVERRIDES_MAX];
    int overrides;
    const char *pair, *state;
    bool check;
} options;

/* -1 = go on, else the exit code. */
static int parse_options(int argc, char **argv, options *o)
{
    static const struct option known[] = {{"config", required_argument, NULL, 'c'},
                                          {"set", required_argument, NULL, 's'},
                                          {"pair", required_argument, NULL, 'p'},
                                          {"state", required_argument, NULL, 'S'},
                                          {"check-config", no_argument, NULL, 'k'},
                                          {"help-config", no_argument, NULL, 'H'},
                                          {"version", no_argument, NULL, 'V'},
                                          {"help", no_argument, NULL, 'h'},
                                          {NULL, 0, NULL, 0}};
    int choice;
    while ((choice = getopt_long(argc, argv, "h", known, NULL)) != -1) {
        switch (choice) {
        case 'c':
            o->config = optarg;
            break;
        case 's':
            if (o->overrides == OVERRIDES_MAX) {
                (void)fprintf(stderr, "pipefishd: more than %d --set\n", OVERRIDES_MAX);
                return USAGE;
            }
            o->override[o->overrides++] = optarg;
            break;
        case 'S':
            o->state = optarg;
            break;
        case 'p':
            o->pair = optarg;
            break;
        case 'k':
            o->check = true;
            break;
        case 'H':
            pf_config_print_help(stdout);
            return DONE;
        case 'V':
            (void)puts(PF_SOFTWARE);
            return DONE;
        case 'h':
            (void)fputs(usage, stdout);
            return DONE;
        default:
            (void)fputs(usage, stderr);
            return USAGE;
        }
    }
    if (optind < argc) {
        (void)fprintf(stderr, "pipefishd: unexpected argument %s\n%s", argv[optind], usage);
        return USAGE;
    }
    return -1;
}

/* The settings that worked last, in place of those that failed too often. */
static bool recall_config(pf_recall *recall, const options *o, pf_config *config)
{
    char path[1024], error[1536];
    if (!pf_recall_is_due(recall, path, sizeof path))
        return false;
    pf_config_defaults(config);
    if (!pf_config_load(config, path, error, sizeof error) || !pf_config_check(config, path, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return false;
    }
    pf_log(PF_LOG_ERROR, "%u starts in a row failed with %s: the settings of the last good run are used, %s",
           PF_RECALL_STARTS, o->config, path);
    recall->is_recalled = true;
    return true;
}

static bool load_config(const options *o, pf_config *config, char *error, size_t n)
{
    pf_config_defaults(config);
    if (!pf_config_load(config, o->config, error, n))
        return false;
    for (int i = 0; i < o->overrides; i++)
        if (!pf_config_override(config, o->override[i], error, n))
            return false;
    return pf_config_check(config, o->config, error, n);
}

static bool load_profile(pf_daemon *d, bool is_check, char *error, size_t n)
{
    const char *path = d->config.camera.profile, *why = NULL;
    uint8_t bytes[PF_PROFILE_BINARY_MAX + 1];
    FILE *in;
    bool is_read, is_good;
    if (d->config.camera.profile_store[0] != '\0')
        return is_check || pf_keeper_open(d, error, n); /* checked once the size of the frames is known */
    if (path[0] == '\0')
        return true;
    in = fopen(path, "rb");
    if (in == NULL) {
        (void)snprintf(error, n, "camera.profile: %s: %s", path, strerror(errno));
        return false;
    }
    d->profile_size = fread(bytes, 1, sizeof bytes, in);
    is_read = ferror(in) == 0;
    (void)fclose(in);
    if (is_read && d->profile_size > 0 && bytes[0] == '{') {
        (void)snprintf(error, n, "camera.profile: %s: JSON; `pipefish profile convert` makes a binary profile of it",
                       path);
        return false;
    }
    if (!is_read || d->profile_size > PF_PROFILE_BINARY_MAX) {
        (void)snprintf(error, n, "camera.profile: %s: %s", path,
                       is_read ? "too large: not a binary profile" : "cannot be read");
        return false;
    }
    void *workspace = malloc(PF_CAMERA_FIXED_WORKSPACE_MAX);
    is_good =
        pf_daemon_read_profile(bytes, d->profile_size, &d->profile, workspace, PF_CAMERA_FIXED_WORKSPACE_MAX, &why);
    free(workspace);
    if (!is_good) {
        (void)snprintf(error, n, "camera.profile: %s: %s", path, why);
        return false;
    }
    memcpy(d->profile_bytes, bytes, d->profile_size);
    d->has_profile = true;
    return pf_sha256(bytes, d->profile_size, d->profile_sha256) == PF_OK;
}

static pf_status open_live(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    const bool is_v4l2 = c->camera.driver == PF_CAMERA_V4L2;
    double u = 0, v = 0, radius = pf_tracking_circle(d, &u, &v);
    bool has_circle = radius > 0 && u > 0 && v > 0;
    const pf_camera_config config = {.device =
                                         is_v4l2 && c->camera.device[0] == '\0' ? "/dev/video0" : c->camera.device,
                                     .width = c->camera.width,
                                     .height = c->camera.height,
                                     .frame_rate = c->camera.frame_rate,
                                     .format = c->camera.format,
                                     .buffers = c->camera.buffers,
                                     .mode = (pf_exposure_mode)c->camera.exposure,
                                     .exposure_us = c->camera.exposure_us,
                                     .gain = c->camera.gain,
                                     .exposure_max_us = c->camera.exposure_max_us,
                                     .circle_u = has_circle ? (uint32_t)u : 0,
                                     .circle_v = has_circle ? (uint32_t)v : 0,
                                     .circle_radius = has_circle ? (uint32_t)radius : 0,
                                     .alive = pf_pulse_work};
    return (is_v4l2 ? pf_v4l2_open : pf_libcamera_open)(&d->camera, &config, error, n);
}

static pf_status open_replay(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    pf_replay_config replay = {.path = c->camera.path,
                               .csv = c->camera.csv[0] ? c->camera.csv : NULL,
                               .speed = c->camera.speed == PF_SPEED_FAST ? PF_REPLAY_FAST : PF_REPLAY_RECORDED,
                               .loops = c->camera.loops,
                               .loop_gap = (uint64_t)c->tracker.reset_gap + 1, /* tracks must not go on */
                               .frame_rate = c->camera.frame_rate};
    return pf_replay_open(&d->camera, &replay, error, n);
}

static bool fits_camera(const pf_daemon *d, uint32_t width, uint32_t height, char *error, size_t n)
{
    if (!d->has_profile || (d->profile.camera.width == width && d->profile.camera.height == height))
        return true;
    (void)snprintf(error, n, "%s: the profile is for %u x %u, the camera gives %u x %u", d->config.camera.profile,
                   d->profile.camera.width, d->profile.camera.height, width, height);
    return false;
}

static bool open_camera(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    const pf_camera_info *info;
    if ((c->camera.driver == PF_CAMERA_REPLAY ? open_replay : open_live)(d, error, n) != PF_OK)
        return false;
    info = d->camera.ops->info(d->camera.self);
    (void)snprintf(d->source, sizeof d->source, "%s", info->source);
    pf_utf8_clean(d->source);
    if (d->keeper != NULL)
        pf_keeper_set_size(d->keeper, info->width, info->height);
    if (fits_camera(d, info->width, info->height, error, n))
        return true;
    d->camera.ops->close(d->camera.self);
    return false;
}

static bool open_gpio(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    const char *const lines[] = {c->gpio.lamp,       c->gpio.led,         c->gpio.stop,
                                 c->gpio.limit_rear, c->gpio.limit_front, c->gpio.encoder};
    bool has_any = false;
    for (size_t i = 0; i < sizeof lines / sizeof lines[0]; i++)
        has_any = has_any || lines[i][0] != '\0';
    if (!has_any)
        return pf_gpio_none_open(&d->gpio) == PF_OK;
    return pf_gpio_board_open(&d->gpio,
                              &(pf_gpio_config){.lamp = c->gpio.lamp,
                                                .led = c->gpio.led,
                                                .stop = c->gpio.stop,
                                                .limit_front = c->gpio.limit_front,
                                                .limit_rear = c->gpio.limit_rear,
                                                .encoder = c->gpio.encoder,
                                                .encoder_a = c->gpio.encoder_a,
                                                .encoder_b = c->gpio.encoder_b,
                                                .pull = (pf_gpio_pull)c->gpio.pull,
                                                .lamp_level = c->gpio.lamp_level},
                              error, n) == PF_OK;
}

/* Says once what a button or a lost chip has done. */
static void note_gpio(pf_daemon *d, pf_gpio_state *before)
{
    pf_gpio_state now;
    d->gpio.ops->state(d->gpio.self, &now);
    /* A round of less than a second ago says nothing: should this thread hang, it must not be the GPIO's that is named.
     */
    pf_pulse_note(PF_PULSE_GPIO, now.round_ns != 0 && pf_now() - now.round_ns > ROUND_NS ? now.round_ns : 0);
    if (now.is_stopped && !before->is_stopped)
        pf_log(PF_LOG_WARNING, "emergency stop: the lamp is off until the daemon starts anew");
    for (uint32_t bit = PF_LIMIT_FRONT; bit <= PF_LIMIT_REAR; bit <<= 1)
        if ((now.limits ^ before->limits) & bit)
            pf_log(PF_LOG_INFO, "%s limit switch %s", bit == PF_LIMIT_FRONT ? "front" : "rear",
                   now.limits & bit ? "pressed" : "released");
    if (now.missed != before->missed)
        pf_log(PF_LOG_WARNING, "wheel encoder: %u edges lost so far", now.missed);
    if (now.is_broken && !before->is_broken)
        pf_log(PF_LOG_ERROR, "a chip or device of [gpio] has gone");
    *before = now;
}

/* A stored profile that the pipeline cannot open with must not end the daemon, or the host could never send another.
 * The settings' own mistakes are not the profile's: they fail without it too. */
static void settle_profile(pf_daemon *d)
{
    char error[512];
    while (d->keeper != NULL && d->has_profile && !pf_pipeline_can_open(d, error, sizeof error)) {
        char other[512];
        d->has_profile = false;
        bool is_profiles = pf_pipeline_can_open(d, other, sizeof other);
        d->has_profile = true;
        if (!is_profiles)
            return;
        pf_keeper_reject(d->keeper, error);
    }
}

static bool open_transport(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    pf_status status;
    if (!pf_pairing_open(d, error, n))
        return false;
    if (c->link.transport == PF_TRANSPORT_SERIAL)
        status =
            pf_serial_open(&d->transport, &(pf_serial_config){c->link.device, c->link.baud, c->link.rtscts}, error, n);
    else if (c->link.transport == PF_TRANSPORT_TLS)
        status = pf_tls_listen(
            &d->transport,
            &(pf_tls_config){c->link.address, (uint16_t)c->link.port, SILENCES * c->link.keepalive_ms, d->trust}, error,
            n);
    else
        status = pf_tcp_listen(
            &d->transport, &(pf_tcp_config){c->link.address, (uint16_t)c->link.port, SILENCES * c->link.keepalive_ms},
            error, n);
    if (status != PF_OK)
        pf_trust_close(d->trust);
    return status == PF_OK;
}

/* What --check-config looks at beyond settings and profile: mistakes that a running daemon does not make different. A
 * camera or a line may be in use by one. */
static bool check_rest(pf_daemon *d, char *error, size_t n)
{
    const pf_config *c = &d->config;
    uint32_t width = c->camera.width, height = c->camera.height;
    if (c->link.transport == PF_TRANSPORT_TCP &&
        pf_tcp_check(&(pf_tcp_config){.address = c->link.address}, error, n) != PF_OK)
        return false;
    if (c->link.transport == PF_TRANSPORT_TLS &&
        pf_tls_check(&(pf_tls_config){.address = c->link.address}, error, n) != PF_OK)
        return false;
    if (!pf_pairing_check(d, error, n))
        return false;
    if (c->camera.driver == PF_CAMERA_REPLAY) {
        if (!open_camera(d, error, n))
            return false;
        width = d->camera.ops->info(d->camera.self)->width;
        height = d->camera.ops->info(d->camera.self)->height;
        d->camera.ops->close(d->camera.self);
    } else if (width != 0 && !fits_camera(d, width, height, error, n)) {
        return false;
    }
    return c->camera.profile_store[0] == '\0' || pf_keeper_check(d, width, height, error, n);
}

static bool open_random(pf_daemon *d, char *error, size_t n)
{
    while (d->boot_id == 0) {
        if (getrandom(&d->boot_id, sizeof d->boot_id, 0) != (ssize_t)sizeof d->boot_id) {
            (void)snprintf(error, n, "no random numbers: %s", strerror(errno));
            return false;
        }
    }
    return true;
}

/* What one survey has in common over all its boots: with another pipe, camera, lens or wheel it is another survey. */
static bool hash_setup(const pf_daemon *d, uint8_t hash[32])
{
    enum { LINES_MAX = 16 };
    char text[LINES_MAX * PF_CONFIG_LINE_MAX], line[PF_CONFIG_LINE_MAX];
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    size_t n = (size_t)snprintf(text, sizeof text, "%s\n%u x %u\n", d->source, info->width, info->height);
    for (uint32_t i = 0; i < pf_config_keys(); i++) {
        (void)pf_config_line(&d->config, i, line, sizeof line);
        if (strncmp(line, "survey.", 7) != 0 && strncmp(line, "encoder.", 8) != 0)
            continue;
        if (n + sizeof line + sizeof d->profile_sha256 > sizeof text)
            return false;
        n += (size_t)sprintf(text + n, "%s\n", line);
    }
    memcpy(text + n, d->profile_sha256, sizeof d->profile_sha256);
    return pf_sha256(text, n + sizeof d->profile_sha256, hash) == PF_OK;
}

/* Writes the status file if it is due. */
static void note_status(pf_daemon *d, uint64_t *due, bool is_last)
{
    char error[PF_CONFIG_TEXT_MAX + 128];
    uint64_t now = pf_now();
    if (d->config.daemon.status_file[0] == '\0' || (now < *due && !is_last))
        return;
    *due = now + (uint64_t)d->config.status.interval_ms * 1000000u;
    if (!pf_daemon_write_status(d, d->config.daemon.status_file, error, sizeof error))
        pf_log(PF_LOG_WARNING, "status file: %s", error);
}

/* The first signal ends the survey and drains; the second ends at once: what is stored is safe. The kernel leaves a
 * line as it was set, so the lamp is switched off before; one that hangs gets a second, then the alarm ends all. */
static void take_signal(pf_daemon *d, int signals, bool *is_terminated)
{
    struct signalfd_siginfo info;
    if (read(signals, &info, sizeof info) != (ssize_t)sizeof info)
        return;
    if (*is_terminated) {
        pf_log(PF_LOG_WARNING, "second signal: exit at once");
        (void)alarm(1);
        (void)d->gpio.ops->set_lamp(d->gpio.self, 0);
        _exit(FAILED);
    }
    *is_terminated = true;
    pf_log(PF_LOG_INFO, "signal %u: the survey ends", info.ssi_signo);
    pf_daemon_stop(d, PF_STOP_TERMINATED);
}

static bool has_host(pf_daemon *d)
{
    pthread_mutex_lock(&d->counters.mutex);
    bool is_up = d->counters.link_up;
    pthread_mutex_unlock(&d->counters.mutex);
    return is_up;
}

/* Returns when it is time to exit. */
static void supervise(pf_daemon *d, pf_pipeline *pipeline, const pf_guard *guard, int signals)
{
    uint64_t status_due = 0, drain_ns = (uint64_t)d->config.daemon.drain_s * 1000000000u, drain_end = 0;
    const uint64_t up_ns = pf_now() + PF_RECALL_UP_NS;
    uint64_t host_ns = pf_now(); /* when a host was there last */
    bool is_terminated = false, must_exit = false;
    pf_gpio_state gpio = {0};
    for (;;) {
        struct pollfd fd = {.fd = signals, .events = POLLIN};
        bool is_drained, had_to_exit = must_exit;
        if (poll(&fd, 1, TICK_MS) > 0)
            take_signal(d, signals, &is_terminated);
        pf_pulse_work();
        if (pf_now() > up_ns && atomic_load(&guard->hung) == NULL)
            pf_recall_up(d->recall, true);
        if (pf_now() - d->started_ns > PF_RECALL_GOOD_NS)
            pf_recall_good(d->recall, &d->config);
        note_status(d, &status_due, false);
        note_gpio(d, &gpio);
        if (d->keeper != NULL)
            pf_keeper_work(d->keeper);
        if (!is_terminated || has_host(d))
            host_ns = pf_now();
        if (atomic_load(&d->state) == PF_STATE_SURVEYING && !is_terminated)
            continue;
        must_exit = is_terminated || atomic_load(&d->stop) == PF_STOP_SHUTDOWN;
        /* From the end of the survey, or from the signal or the request if that comes later. */
        if (drain_end == 0 || must_exit != had_to_exit)
            drain_end = pf_now() + drain_ns;
        is_drained = pf_pipeline_is_done(pipeline) && pf_store_is_drained(d->store);
        if (is_drained)
            atomic_store(&d->state, PF_STATE_IDLE);
        if ((must_exit || d->config.daemon.exit_when_done) &&
            (is_drained || pf_now() >= drain_end || pf_now() - host_ns >= ALONE_NS))
            return;
    }
}

static int run_survey(pf_daemon *d, const pf_survey *survey, const pf_survey *before, pf_guard *guard, int signals)
{
    const pf_config *c = &d->config;
    const pf_camera_info *camera = d->camera.ops->info(d->camera.self);
    char error[1024];
    pf_courier *courier = NULL;
    pf_pipeline *pipeline = NULL;
    pf_store_stats stats;
    pf_store_config store = {.jobs = c->keyframe.queue,
                             .slots = c->link.send_slots,
                             .capacity = pf_object_max(d),
                             .is_patient = c->camera.driver == PF_CAMERA_REPLAY && c->camera.speed == PF_SPEED_FAST,
                             .wake_fd = d->wake_fd};
    uint64_t status_due = 0;
    bool is_good = false;

    if (c->spool.quota_mb > 0 && (double)store.capacity > c->spool.quota_mb * 1e6) {
        pf_log(PF_LOG_ERROR, "spool.quota_mb = %g: an object of this camera may have %.2f MB", c->spool.quota_mb,
               (double)store.capacity / 1e6);
        return FAILED;
    }
    pf_pulse_work();
    if (!pf_store_open(&d->store, &d->spool, survey, &store, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return FAILED;
    }
    pf_pulse_work();
    if (!pf_still_open(&d->still, camera->width, camera->height))
        (void)snprintf(error, sizeof error, "no memory for a still");
    else if (pf_courier_open(&courier, d, error, sizeof error) &&
             pf_pipeline_open(&pipeline, d, courier, survey, before, error, sizeof error)) {
        pf_log(PF_LOG_INFO, "%s; %s; survey %02x%02x%02x%02x, boot %u; %s", d->source,
               d->transport.ops->name(d->transport.self), survey->id[0], survey->id[1], survey->id[2], survey->id[3],
               survey->boots, survey->is_resumed ? "goes on" : "begins");
        pf_pulse_work();
        is_good = pf_pipeline_start(pipeline, error, sizeof error);
    }
    if (is_good) {
        pf_guard_ready(guard);
        supervise(d, pipeline, guard, signals);
    } else {
        pf_log(PF_LOG_ERROR, "%s", error);
    }
    pf_pulse_note(PF_PULSE_GPIO, 0);
    pf_guard_close(guard); /* what follows has its own limits, and the service manager's for stopping */
    /* The time to drain limits only the sending: every keyframe that was made, and the survey's end, are stored first.
     * The store ends last, for what the host acknowledges while the courier lingers must be removed. */
    pf_store_flush(d->store);
    if (pipeline != NULL)
        is_good = pf_pipeline_close(pipeline) && is_good;
    if (courier != NULL)
        pf_courier_close(courier);
    pf_still_close(d->still);
    pf_store_quit(d->store);
    note_status(d, &status_due, true);
    pf_store_get_stats(d->store, &stats);
    if (stats.spool.objects > 0)
        pf_log(PF_LOG_WARNING, "%llu objects stay in the spool for the next start",
               (unsigned long long)stats.spool.objects);
    is_good = is_good && !stats.has_failed;
    if (is_good)
        pf_recall_good(d->recall, &d->config);
    pf_store_close(d->store);
    return is_good ? DONE : FAILED;
}

/* Each step may take as long as a thread may work on one thing. */
static int open_and_run(pf_daemon *d, pf_guard *guard, int signals)
{
    const pf_config *c = &d->config;
    char error[1024] = "";
    pf_spool_config spool = {
        .path = c->spool.path, .quota = (uint64_t)(c->spool.quota_mb * 1e6), .alive = pf_pulse_work};
    pf_survey survey, before;
    uint8_t setup[32];
    int code = FAILED;

    pf_pulse_begin(PF_PULSE_MAIN);
    d->wake_fd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    if (d->wake_fd < 0 || !open_random(d, error, sizeof error) ||
        !pf_guard_open(guard, d->recall, c->daemon.watchdog, c->daemon.watchdog_s, error, sizeof error) ||
        !open_camera(d, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return FAILED;
    }
    pf_pulse_work();
    settle_profile(d);
    if (!hash_setup(d, setup))
        (void)snprintf(error, sizeof error, "the setup cannot be hashed");
    else if (open_gpio(d, error, sizeof error)) {
        pf_pulse_work();
        if (open_transport(d, error, sizeof error)) {
            pf_pulse_work();
            if (pf_spool_open(&d->spool, &spool, error, sizeof error) == PF_OK) {
                pf_pulse_work();
                if (pf_survey_open(&survey, &before, &d->spool, setup, error, sizeof error)) {
                    memcpy(d->survey_id, survey.id, sizeof d->survey_id);
                    code = run_survey(d, &survey, &before, guard, signals);
                    error[0] = '\0';
                }
                d->spool.ops->close(d->spool.self);
            }
            d->transport.ops->close(d->transport.self);
            pf_trust_close(d->trust);
        }
        d->gpio.ops->close(d->gpio.self);
    }
    d->camera.ops->close(d->camera.self);
    (void)close(d->wake_fd);
    if (error[0] != '\0')
        pf_log(PF_LOG_ERROR, "%s", error);
    return code;
}

int main(int argc, char **argv)
{
    static pf_daemon d; /* 100 kB of settings and counters: not for the stack */
    static pf_recall recall;
    static pf_guard guard = {.manager = -1, .device = -1};
    options o = {.config = DEFAULT_CONFIG};
    char error[1536] = "";
    sigset_t set;
    int code = parse_options(argc, argv, &o), signals;

    if (code >= 0)
        return code;
    d.started_ns = pf_now();
    d.recall = &recall;
    if (!o.check && o.pair == NULL)
        pf_recall_begin(&recall, o.state, o.config);
    if (!recall_config(&recall, &o, &d.config) && !load_config(&o, &d.config, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return FAILED;
    }
    if (o.pair != NULL) {
        code = pf_pairing_add(&d, o.pair, error, sizeof error);
        if (code != DONE)
            pf_log(PF_LOG_ERROR, "%s", error);
        return code;
    }
    if (!load_profile(&d, o.check, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return FAILED;
    }
    if (o.check && !check_rest(&d, error, sizeof error)) {
        pf_log(PF_LOG_ERROR, "%s", error);
        return FAILED;
    }
    if (o.check) {
        (void)printf("%s: ok\n", o.config);
        return DONE;
    }
    pf_log_set_level(d.config.daemon.log_level);
    pthread_mutex_init(&d.counters.mutex, NULL);
    (void)signal(SIGPIPE, SIG_IGN);
    (void)sigemptyset(&set);
    (void)sigaddset(&set, SIGTERM);
    (void)sigaddset(&set, SIGINT);
    (void)pthread_sigmask(SIG_BLOCK, &set, NULL); /* before the threads: only the descriptor gets them */
    signals = signalfd(-1, &set, SFD_CLOEXEC | SFD_NONBLOCK);
    if (signals < 0) {
        pf_log(PF_LOG_ERROR, "signals: %s", strerror(errno));
        return FAILED;
    }
    code = open_and_run(&d, &guard, signals);
    pf_guard_close(&guard); /* where it failed to open something */
    if (d.keeper != NULL)
        pf_keeper_close(d.keeper);
    (void)close(signals);
    return code;
}
