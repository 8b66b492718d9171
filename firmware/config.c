#include "config.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "ini.h"
#include "utf8.h"

typedef enum kind { TEXT, NUMBER, INTEGER, SWITCH, CHOICE } kind;

typedef struct setting {
    const char *section, *key;
    kind kind;
    size_t offset;
    const char *unit, *fallback;
    double min, max;
    const char *choices; /* "a|b": the value is the index */
    const char *help;
} setting;

#define AT(member) offsetof(pf_config, member)

static const setting settings[] = {
    {"survey", "name", TEXT, AT(survey.name), "", "", 0, 0, NULL, "what the operator calls this survey"},
    {"survey", "nominal_diameter_mm", NUMBER, AT(survey.nominal_diameter_mm), "mm", "0", 0, 20000, NULL,
     "of the pipe; 0 = unknown"},

    {"camera", "driver", CHOICE, AT(camera.driver), "", "replay", 0, 0, "replay|v4l2|libcamera",
     "where frames come from; replay plays a recording, v4l2 is a camera of the kernel's, libcamera one that it puts "
     "together"},
    {"camera", "path", TEXT, AT(camera.path), "", "", 0, 0, NULL,
     "replay: the recording: a .y4m file, or a folder of PNG, JPEG or PGM images; required"},
    {"camera", "csv", TEXT, AT(camera.csv), "", "", 0, 0, NULL,
     "its telemetry; empty = beside it (path with .csv, or telemetry.csv in the folder), if it is there"},
    {"camera", "speed", CHOICE, AT(camera.speed), "", "recorded", 0, 0, "recorded|fast",
     "recorded = as it happened, late frames are dropped; fast = as fast as possible, nothing is dropped"},
    {"camera", "loops", INTEGER, AT(camera.loops), "", "1", 0, 1000000, NULL,
     "play it so often; 0 = for ever; each begins with a marked break"},
    {"camera", "frame_rate", NUMBER, AT(camera.frame_rate), "1/s", "0", 0, 10000, NULL,
     "replay: of a recording without times; 0 = 10. cameras: to ask for; 0 = as the camera is set"},
    {"camera", "device", TEXT, AT(camera.device), "", "", 0, 0, NULL,
     "v4l2: the camera, empty = /dev/video0; a link in /dev/v4l/by-path stays the same when it is plugged in again. "
     "libcamera: a part of the camera's id (the log tells it), empty = the first"},
    {"camera", "width", INTEGER, AT(camera.width), "px", "0", 0, 16384, NULL,
     "cameras: of the frames; 0 = as the camera is set. If it is given the daemon starts without the camera and waits"},
    {"camera", "height", INTEGER, AT(camera.height), "px", "0", 0, 16384, NULL, "cameras: together with width"},
    {"camera", "format", TEXT, AT(camera.format), "", "", 0, 0, NULL,
     "cameras: GREY NV12 NM12 NV21 YU12 Y10P Y12P Y10 Y12 YUYV UYVY RGB3 BGR3 MJPG or JPEG; empty = the first of "
     "these it has"},
    {"camera", "buffers", INTEGER, AT(camera.buffers), "", "6", 4, 32, NULL,
     "cameras: frames that there is room for, three of them in use here; more = longer pauses are bridged"},
    {"camera", "exposure", CHOICE, AT(camera.exposure), "", "auto", 0, 0, "auto|hold|fixed|device",
     "cameras: auto = ours, for a lamp-lit pipe; hold = auto until it has settled, then fixed: for calibration; fixed "
     "= "
     "as "
     "set here; device = the camera's own"},
    {"camera", "exposure_us", INTEGER, AT(camera.exposure_us), "us", "0", 0, 1000000, NULL,
     "cameras: with exposure = fixed; 0 = as the camera is set"},
    {"camera", "gain", NUMBER, AT(camera.gain), "", "0", 0, 1000000, NULL,
     "cameras: with exposure = fixed, in the camera's own units (libcamera: a factor); 0 = as the camera is set"},
    {"camera", "exposure_max_us", INTEGER, AT(camera.exposure_max_us), "us", "10000", 0, 1000000, NULL,
     "cameras: longest exposure of auto and hold, against motion blur; 0 = the camera's limit"},
    {"camera", "line_time_us", NUMBER, AT(camera.line_time_us), "us", "0", -1000, 1000, NULL,
     "of a rolling shutter, for the host: from one row's exposure to the next one's; below 0 = from the last row up"},
    {"camera", "zero_copy", SWITCH, AT(camera.zero_copy), "", "true", 0, 0, NULL,
     "track frames where the driver put them; false = copy each first, for boards that read such memory slowly"},
    {"camera", "index", TEXT, AT(camera.index), "", "", 0, 0, NULL,
     "folder for an index of the frames taken, with their hashes: a CSV a start, to replay from; empty = none"},
    {"camera", "profile", TEXT, AT(camera.profile), "", "", 0, 0, NULL,
     "binary calibration profile; empty = none: no bearings, keyframes by encoder and common tracks only"},
    {"camera", "profile_store", TEXT, AT(camera.profile_store), "", "", 0, 0, NULL,
     "instead of profile: file that keeps profiles which the host sends (pipefish flash); made at the first start"},
    {"camera", "trial_starts", INTEGER, AT(camera.trial_starts), "", "1", 1, 4, NULL,
     "starts with a new profile that nobody confirmed before the one before comes back; fewer than the service's "
     "tries"},
    {"camera", "black_level", INTEGER, AT(camera.black_level), "grey levels", "0", 0, 254, NULL,
     "what the camera calls black; 16 for video range. Frames are stretched from here to white_level as they come"},
    {"camera", "white_level", INTEGER, AT(camera.white_level), "grey levels", "255", 1, 255, NULL,
     "what it calls white; 235 for video range"},

    {"tracker", "max_tracks", INTEGER, AT(tracker.max_tracks), "", "400", 8, 2048, NULL, "tracks alive at once"},
    {"tracker", "levels", INTEGER, AT(tracker.levels), "", "4", 1, 6, NULL, "pyramid levels; more = faster motion"},
    {"tracker", "window", INTEGER, AT(tracker.window), "px", "21", 7, 31, NULL, "side of the patch, odd"},
    {"tracker", "iterations", INTEGER, AT(tracker.iterations), "", "10", 1, 30, NULL, "most steps a level"},
    {"tracker", "cell", INTEGER, AT(tracker.cell), "px", "0", 0, 256, NULL,
     "side of a detection cell, 16..256; 0 = from max_tracks"},
    {"tracker", "min_eigen", INTEGER, AT(tracker.min_eigen), "grey^2", "0", 0, 16384, NULL,
     "least texture of a new corner; 0 = the tracker's own"},
    {"tracker", "fb_px", NUMBER, AT(tracker.fb_px), "px", "0.5", 0.01, 16, NULL, "most forward-backward distance"},
    {"tracker", "min_zncc", NUMBER, AT(tracker.min_zncc), "", "0.8", 0.01, 0.9999, NULL,
     "least similarity to the patch of the frame before"},
    {"tracker", "noise", NUMBER, AT(tracker.noise), "grey levels", "2", 0.01, 64, NULL,
     "sigma of the image noise; scales the covariances"},
    {"tracker", "circle_u", NUMBER, AT(tracker.circle_u), "px", "0", -16384, 16384, NULL,
     "centre of the image circle, if circle_radius is set"},
    {"tracker", "circle_v", NUMBER, AT(tracker.circle_v), "px", "0", -16384, 16384, NULL, "its other coordinate"},
    {"tracker", "circle_radius", NUMBER, AT(tracker.circle_radius), "px", "0", 0, 16384, NULL,
     "radius of the image circle; 0 = the profile's; without one the whole image is used"},
    {"tracker", "reset_gap", INTEGER, AT(tracker.reset_gap), "frames", "5", 0, 1000000, NULL,
     "after a gap of more missing frames than this all tracks begin anew: a marked break"},
    {"tracker", "mask", TEXT, AT(tracker.mask), "", "", 0, 0, NULL,
     "picture of the frame's size (PGM, PNG), black where nothing is to be tracked; empty = none"},
    {"tracker", "static_mask", SWITCH, AT(tracker.static_mask), "", "true", 0, 0, NULL,
     "find by itself what stands still in the picture while the rest moves, and mask it"},
    {"tracker", "cells", CHOICE, AT(tracker.cells), "", "grid", 0, 0, "grid|polar",
     "how new tracks are spread: over the picture, or over rings and sectors of the image circle"},
    {"tracker", "prediction", SWITCH, AT(tracker.prediction), "", "true", 0, 0, NULL,
     "look for tracks where the last motion, the encoder and the roll put them; needs a profile"},

    {"keyframe", "step_mm", NUMBER, AT(keyframe.step_mm), "mm", "0", 0, 100000, NULL,
     "distance between keyframes by the encoder; 0 = a quarter of the nominal radius"},
    {"keyframe", "parallax_deg", NUMBER, AT(keyframe.parallax_deg), "deg", "10", 0.1, 90, NULL,
     "without an encoder: median parallax between keyframes; needs a profile"},
    {"keyframe", "min_common", INTEGER, AT(keyframe.min_common), "tracks", "100", 1, 2048, NULL,
     "a keyframe is forced when fewer tracks are shared with the last one"},
    {"keyframe", "min_interval", INTEGER, AT(keyframe.min_interval), "frames", "2", 1, 1000, NULL,
     "at least so many frames between keyframes"},
    {"keyframe", "jpeg_quality", INTEGER, AT(keyframe.jpeg_quality), "", "90", 1, 100, NULL, "of keyframe images"},
    {"keyframe", "queue", INTEGER, AT(keyframe.queue), "", "32", 2, 64, NULL,
     "keyframes that may wait in memory for a disk that pauses, as cards do for a second or two"},

    {"encoder", "metres_per_count", NUMBER, AT(encoder.metres_per_count), "m", "0", -1, 1, NULL,
     "of the wheel encoder; 0 = no encoder"},
    {"encoder", "sigma", NUMBER, AT(encoder.sigma), "m", "0", 0, 1, NULL, "standard deviation of metres_per_count"},
    {"encoder", "noise", NUMBER, AT(encoder.noise), "m/sqrt(m)", "0.005", 0, 1, NULL,
     "random error of the distance over one metre"},

    {"gpio", "lamp", TEXT, AT(gpio.lamp), "", "", 0, 0, NULL,
     "line of the lamp, as LAMP or gpiochip0:17 (! before it: active low), or a folder of /sys/class/leds, which can "
     "be "
     "dimmed; empty = none, as for all lines below"},
    {"gpio", "lamp_level", NUMBER, AT(gpio.lamp_level), "", "1", 0, 1, NULL, "of the lamp at the start"},
    {"gpio", "led", TEXT, AT(gpio.led), "", "", 0, 0, NULL,
     "status LED: on = survey, slow blinking = sending the rest, fast = no camera, or emergency stop"},
    {"gpio", "stop", TEXT, AT(gpio.stop), "", "", 0, 0, NULL,
     "line of the emergency stop: lamp off until the daemon starts anew with the button released"},
    {"gpio", "limit_front", TEXT, AT(gpio.limit_front), "", "", 0, 0, NULL, "line of the front limit switch"},
    {"gpio", "limit_rear", TEXT, AT(gpio.limit_rear), "", "", 0, 0, NULL, "line of the rear limit switch"},
    {"gpio", "encoder", TEXT, AT(gpio.encoder), "", "", 0, 0, NULL,
     "lines = encoder_a and encoder_b; a file /sys/bus/counter/devices/counter0/count0/count; an input device "
     "/dev/input/event0; auto = the first of counter, rotary input, lines that there is"},
    {"gpio", "encoder_a", TEXT, AT(gpio.encoder_a), "", "", 0, 0, NULL,
     "line A of the wheel encoder; forwards, A leads"},
    {"gpio", "encoder_b", TEXT, AT(gpio.encoder_b), "", "", 0, 0, NULL, "line B, of the same chip"},
    {"gpio", "pull", CHOICE, AT(gpio.pull), "", "none", 0, 0, "none|up|down", "resistor in the chip, of all inputs"},

    {"link", "transport", CHOICE, AT(link.transport), "", "tcp", 0, 0, "serial|tcp|tls",
     "how the host is reached; tcp is not encrypted, and on this machine only"},
    {"link", "device", TEXT, AT(link.device), "", "", 0, 0, NULL, "serial: the device, as /dev/ttyS0; required"},
    {"link", "baud", INTEGER, AT(link.baud), "baud", "921600", 9600, 4000000, NULL, "serial: the rate"},
    {"link", "rtscts", SWITCH, AT(link.rtscts), "", "false", 0, 0, NULL, "serial: hardware flow control"},
    {"link", "address", TEXT, AT(link.address), "", "127.0.0.1", 0, 0, NULL,
     "tcp: the loopback address to listen on; tls: any address of this machine, 0.0.0.0 for all"},
    {"link", "port", INTEGER, AT(link.port), "", "7447", 0, 65535, NULL, "tcp, tls: the port; 0 = any (the log tells)"},
    {"link", "trust", TEXT, AT(link.trust), "", "", 0, 0, NULL,
     "folder with this device's key and the hosts that it lets in (pipefish pair); made at the first start; required "
     "for "
     "tls"},
    {"link", "window", INTEGER, AT(link.window), "bytes", "65536", 1024, 1048576, NULL,
     "most unacknowledged bytes under way"},
    {"link", "send_slots", INTEGER, AT(link.send_slots), "", "4", 1, 16, NULL, "objects under way at once"},
    {"link", "max_fragment", INTEGER, AT(link.max_fragment), "bytes", "1024", 64, 1024, NULL,
     "of a frame on the wire; smaller = previews and replies wait less on a slow line"},
    {"link", "keepalive_ms", INTEGER, AT(link.keepalive_ms), "ms", "1000", 10, 60000, NULL,
     "ping interval; after four of them in silence the host counts as gone"},
    {"link", "rto_min_ms", INTEGER, AT(link.rto_min_ms), "ms", "50", 1, 10000, NULL, "least time to a repetition"},

    {"spool", "path", TEXT, AT(spool.path), "", "/var/lib/pipefish/spool.db", 0, 0, NULL,
     "file that keeps what the host has not acknowledged; its folder must exist"},
    {"spool", "quota_mb", NUMBER, AT(spool.quota_mb), "MB", "4096", 0, 4000000, NULL,
     "most megabytes that may wait in it; 0 = no limit"},

    {"status", "interval_ms", INTEGER, AT(status.interval_ms), "ms", "1000", 50, 3600000, NULL,
     "between status messages, and of the status file"},
    {"status", "preview_interval_ms", INTEGER, AT(status.preview_interval_ms), "ms", "1000", 0, 3600000, NULL,
     "between previews; 0 = none"},
    {"status", "preview_quality", INTEGER, AT(status.preview_quality), "", "50", 1, 100, NULL, "JPEG, of previews"},

    {"daemon", "drain_s", INTEGER, AT(daemon.drain_s), "s", "60", 0, 1000000, NULL,
     "how long to go on sending after the survey ended (after SIGTERM 10 s at most without a host); the rest stays"},
    {"daemon", "exit_when_done", SWITCH, AT(daemon.exit_when_done), "", "true", 0, 0, NULL,
     "false = after the survey the daemon goes on serving the host until SIGTERM"},
    {"daemon", "status_file", TEXT, AT(daemon.status_file), "", "", 0, 0, NULL,
     "JSON file with the status message's figures, replaced at intervals and at the end; empty = none"},
    {"daemon", "threads", INTEGER, AT(daemon.threads), "", "2", 1, 2, NULL,
     "2 = while a frame is tracked the next one is taken and the last one's keyframe made; the results are the same"},
    {"daemon", "watchdog", TEXT, AT(daemon.watchdog), "", "", 0, 0, NULL,
     "the board's watchdog, as /dev/watchdog, if the system does not feed it; empty = none"},
    {"daemon", "watchdog_s", INTEGER, AT(daemon.watchdog_s), "s", "20", 2, 600, NULL,
     "it resets the board after so long; a thread that works on one thing for half of it hangs, and no watchdog is "
     "fed, the "
     "service manager's neither"},
    {"daemon", "log_level", CHOICE, AT(daemon.log_level), "", "info", 0, 0, "error|warning|info|debug",
     "what goes to standard error"},
};

#define SETTINGS (sizeof settings / sizeof settings[0])
_Static_assert(SETTINGS <= PF_CONFIG_KEYS_MAX, "pf_config.line has a place for every key");

uint32_t pf_config_keys(void)
{
    return (uint32_t)SETTINGS;
}

/* The index of a word in "a|b|c", or -1. */
static int find_choice(const char *choices, const char *word)
{
    size_t n = strlen(word);
    for (int i = 0; choices != NULL; i++) {
        const char *bar = strchr(choices, '|');
        size_t length = bar ? (size_t)(bar - choices) : strlen(choices);
        if (length == n && memcmp(choices, word, n) == 0)
            return i;
        choices = bar ? bar + 1 : NULL;
    }
    return -1;
}

static void choice_text(const char *choices, uint32_t index, char *out, size_t n)
{
    for (; index > 0; index--)
        choices = strchr(choices, '|') + 1;
    (void)snprintf(out, n, "%.*s", (int)strcspn(choices, "|"), choices);
}

static bool parse_number(const setting *s, const char *value, double *number, char *error, size_t n)
{
    char *end;
    errno = 0;
    *number = strtod(value, &end);
    if (*value == '\0' || *end != '\0' || errno != 0 || !isfinite(*number) || strpbrk(value, "xXpP") != NULL) {
        (void)snprintf(error, n, "%s.%s = %.80s: not a number", s->section, s->key, value);
        return false;
    }
    if (s->kind == INTEGER && *number != floor(*number)) {
        (void)snprintf(error, n, "%s.%s = %.80s: not a whole number", s->section, s->key, value);
        return false;
    }
    if (*number < s->min || *number > s->max) {
        (void)snprintf(error, n, "%s.%s = %.80s: must be %.10g..%.10g%s%s", s->section, s->key, value, s->min, s->max,
                       s->unit[0] ? " " : "", s->unit);
        return false;
    }
    return true;
}

static bool set_value(pf_config *config, const setting *s, const char *value, char *error, size_t n)
{
    char *field = (char *)config + s->offset;
    double number;
    int choice;
    switch (s->kind) {
    case TEXT:
        if (strlen(value) >= PF_CONFIG_TEXT_MAX) {
            (void)snprintf(error, n, "%s.%s: longer than %u bytes", s->section, s->key, PF_CONFIG_TEXT_MAX - 1);
            return false;
        }
        if (!pf_utf8_check(value)) {
            (void)snprintf(error, n, "%s.%s: not UTF-8, or with control characters", s->section, s->key);
            return false;
        }
        memcpy(field, value, strlen(value) + 1);
        return true;
    case NUMBER:
        if (!parse_number(s, value, &number, error, n))
            return false;
        memcpy(field, &number, sizeof number);
        return true;
    case INTEGER:
        if (!parse_number(s, value, &number, error, n))
            return false;
        memcpy(field, &(uint32_t){(uint32_t)number}, sizeof(uint32_t));
        return true;
    case SWITCH:
        choice = find_choice("false|true", value);
        if (choice < 0) {
            (void)snprintf(error, n, "%s.%s = %.80s: must be true or false", s->section, s->key, value);
            return false;
        }
        memcpy(field, &(bool){choice == 1}, sizeof(bool));
        return true;
    case CHOICE:
        choice = find_choice(s->choices, value);
        if (choice < 0) {
            (void)snprintf(error, n, "%s.%s = %.80s: this build has: %s", s->section, s->key, value, s->choices);
            return false;
        }
        memcpy(field, &(uint32_t){(uint32_t)choice}, sizeof(uint32_t));
        return true;
    }
    return false;
}

void pf_config_defaults(pf_config *config)
{
    char error[256];
    memset(config, 0, sizeof *config);
    for (size_t i = 0; i < SETTINGS; i++)
        if (!set_value(config, &settings[i], settings[i].fallback, error, sizeof error))
            abort(); /* the table contradicts itself: tests/unit/test_ini.c */
}

static void append(char *text, size_t n, const char *more)
{
    size_t used = strlen(text);
    (void)snprintf(text + used, n - used, "%s", more);
}

/* The setting's number, or -1 with a text that lists what there is. */
static int find_setting(const char *section, const char *key, char *error, size_t n)
{
    bool have_section = false;
    for (size_t i = 0; i < SETTINGS; i++) {
        if (strcmp(settings[i].section, section) != 0)
            continue;
        have_section = true;
        if (strcmp(settings[i].key, key) == 0)
            return (int)i;
    }
    if (have_section)
        (void)snprintf(error, n, "unknown key %.80s in [%s]; it has:", key, section);
    else
        (void)snprintf(error, n, "unknown section [%.80s]; there are:", section);
    for (size_t i = 0; i < SETTINGS; i++) {
        bool is_first = i == 0 || strcmp(settings[i].section, settings[i - 1].section) != 0;
        if (have_section ? strcmp(settings[i].section, section) != 0 : !is_first)
            continue;
        append(error, n, " ");
        append(error, n, have_section ? settings[i].key : settings[i].section);
    }
    return -1;
}

static bool take_item(void *user, const pf_ini_item *item, char *error, size_t n)
{
    pf_config *config = user;
    int i = find_setting(item->section, item->key, error, n);
    if (i < 0)
        return false;
    if (config->line[i] != 0) {
        (void)snprintf(error, n, "%s.%s is set a second time; the first is in line %u", item->section, item->key,
                       config->line[i]);
        return false;
    }
    config->line[i] = item->line;
    return set_value(config, &settings[i], item->value, error, n);
}

bool pf_config_parse(pf_config *config, const char *text, size_t text_n, const char *file, char *error, size_t n)
{
    return pf_ini_parse(text, text_n, file, take_item, config, error, n);
}

bool pf_config_load(pf_config *config, const char *file, char *error, size_t n)
{
    enum { LIMIT = 1 << 20 };
    FILE *in = fopen(file, "rb");
    char *text;
    size_t size;
    bool ok = false;
    if (in == NULL) {
        (void)snprintf(error, n, "%s: %s", file, strerror(errno));
        return false;
    }
    text = malloc(LIMIT + 1);
    size = text ? fread(text, 1, LIMIT + 1, in) : 0;
    if (text == NULL)
        (void)snprintf(error, n, "%s: no memory", file);
    else if (ferror(in))
        (void)snprintf(error, n, "%s: %s", file, strerror(errno));
    else if (size > LIMIT)
        (void)snprintf(error, n, "%s: larger than 1 MiB: not a configuration", file);
    else
        ok = pf_config_parse(config, text, size, file, error, n);
    free(text);
    (void)fclose(in);
    return ok;
}

bool pf_config_override(pf_config *config, const char *assignment, char *error, size_t n)
{
    char name[128], why[1024] = "";
    const char *dot = strchr(assignment, '.'), *equals = strchr(assignment, '=');
    int i;
    if (dot == NULL || equals == NULL || dot > equals || (size_t)(equals - assignment) >= sizeof name) {
        (void)snprintf(error, n, "--set %.200s: must be section.key=value", assignment);
        return false;
    }
    memcpy(name, assignment, (size_t)(equals - assignment));
    name[equals - assignment] = '\0';
    name[dot - assignment] = '\0';
    i = find_setting(name, name + (dot - assignment) + 1, why, sizeof why);
    if (i < 0 || !set_value(config, &settings[i], equals + 1, why, sizeof why)) {
        (void)snprintf(error, n, "--set %.200s: %s", assignment, why);
        return false;
    }
    return true;
}

bool pf_config_check(const pf_config *c, const char *file, char *error, size_t n)
{
    const char *why = NULL;
    if (c->camera.driver == PF_CAMERA_REPLAY && c->camera.path[0] == '\0')
        why = "camera.path: must be set: the recording to play; or camera.driver, for a camera";
    else if ((c->camera.width == 0) != (c->camera.height == 0))
        why = "camera.width and camera.height: both or neither";
    else if (c->camera.profile[0] != '\0' && c->camera.profile_store[0] != '\0')
        why = "camera.profile_store: not together with camera.profile";
    else if (c->camera.black_level >= c->camera.white_level)
        why = "camera.black_level: must be below camera.white_level";
    else if (c->link.transport == PF_TRANSPORT_SERIAL && c->link.device[0] == '\0')
        why = "link.device: must be set for link.transport = serial";
    else if (c->link.transport != PF_TRANSPORT_SERIAL && c->link.address[0] == '\0')
        why = "link.address: must be set for link.transport = tcp and tls";
    else if (c->link.transport == PF_TRANSPORT_TLS && c->link.trust[0] == '\0')
        why = "link.trust: must be set for link.transport = tls: the folder of the keys";
    else if (c->spool.path[0] == '\0')
        why = "spool.path: must be set";
    else if (c->tracker.window % 2 == 0)
        why = "tracker.window: must be odd";
    else if (c->tracker.cell != 0 && c->tracker.cell < 16)
        why = "tracker.cell: must be 0 or 16..256";
    else if (c->camera.driver != PF_CAMERA_REPLAY && c->encoder.metres_per_count != 0 && c->gpio.encoder[0] == '\0')
        why = "gpio.encoder: must be set for encoder.metres_per_count: no counts come without it";
    else if ((c->gpio.encoder_a[0] == '\0') != (c->gpio.encoder_b[0] == '\0'))
        why = "gpio.encoder_a and gpio.encoder_b: both or neither";
    else if (c->gpio.encoder_a[0] != '\0' && c->gpio.encoder[0] == '\0')
        why = "gpio.encoder: must be set (auto or lines) for encoder_a and encoder_b";
    if (why != NULL)
        (void)snprintf(error, n, "%s: %s", file, why);
    return why == NULL;
}

size_t pf_config_line(const pf_config *config, uint32_t i, char *out, size_t n)
{
    const setting *s = &settings[i];
    const char *field = (const char *)config + s->offset;
    char value[PF_CONFIG_TEXT_MAX];
    double number;
    uint32_t integer;
    bool is_on;
    switch (s->kind) {
    case TEXT:
        memcpy(value, field, sizeof value);
        break;
    case NUMBER:
        memcpy(&number, field, sizeof number);
        (void)snprintf(value, sizeof value, "%.15g", number);
        break;
    case INTEGER:
        memcpy(&integer, field, sizeof integer);
        (void)snprintf(value, sizeof value, "%u", integer);
        break;
    case SWITCH:
        memcpy(&is_on, field, sizeof is_on);
        (void)snprintf(value, sizeof value, "%s", is_on ? "true" : "false");
        break;
    case CHOICE:
        memcpy(&integer, field, sizeof integer);
        choice_text(s->choices, integer, value, sizeof value);
        break;
    }
    return (size_t)snprintf(out, n, "%s.%s = %s", s->section, s->key, value);
}

void pf_config_print_help(FILE *out)
{
    (void)fputs("# Settings of pipefishd, each with its default. `pipefishd --help-config` prints this file;\n"
                "# `pipefishd --config FILE --check-config` checks one of yours.\n",
                out);
    for (size_t i = 0; i < SETTINGS; i++) {
        const setting *s = &settings[i];
        if (i == 0 || strcmp(s->section, settings[i - 1].section) != 0)
            (void)fprintf(out, "\n[%s]\n", s->section);
        (void)fprintf(out, "# %s", s->help);
        if (s->kind == NUMBER || s->kind == INTEGER)
            (void)fprintf(out, " (%s%s%.10g..%.10g)", s->unit, s->unit[0] ? ", " : "", s->min, s->max);
        else if (s->kind == CHOICE)
            (void)fprintf(out, " (%s)", s->choices);
        else if (s->kind == SWITCH)
            (void)fprintf(out, " (true|false)");
        (void)fprintf(out, "\n%s =%s%s\n", s->key, s->fallback[0] ? " " : "", s->fallback);
    }
}
