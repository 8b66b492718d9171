/* The daemon's settings. One table in config.c has every key with its type, unit, default, range and meaning; parsing,
 * checks, --help-config and the survey's record of its settings all come from it.
 */
#ifndef PIPEFISHD_CONFIG_H
#define PIPEFISHD_CONFIG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#define PF_CONFIG_TEXT_MAX 512u /* bytes of a text setting, with its zero */
#define PF_CONFIG_LINE_MAX 640u /* bytes of "section.key = value", with its zero */
#define PF_CONFIG_KEYS_MAX 128u

enum { PF_CAMERA_REPLAY = 0, PF_CAMERA_V4L2 = 1, PF_CAMERA_LIBCAMERA = 2 };
enum { PF_SPEED_RECORDED = 0, PF_SPEED_FAST = 1 };
enum { PF_CELLS_GRID = 0, PF_CELLS_POLAR = 1 };
enum { PF_TRANSPORT_SERIAL = 0, PF_TRANSPORT_TCP = 1, PF_TRANSPORT_TLS = 2 };
enum { PF_LOG_ERROR = 0, PF_LOG_WARNING = 1, PF_LOG_INFO = 2, PF_LOG_DEBUG = 3 };

typedef char pf_config_text[PF_CONFIG_TEXT_MAX];

typedef struct pf_config {
    struct {
        pf_config_text name;
        double nominal_diameter_mm;
    } survey;
    struct {
        uint32_t driver, speed;
        pf_config_text path, csv, profile, profile_store, device, format, index;
        uint32_t loops, trial_starts, black_level, white_level;
        uint32_t width, height, buffers, exposure, exposure_us, exposure_max_us;
        double frame_rate, gain, line_time_us;
        bool zero_copy;
    } camera;
    struct {
        uint32_t max_tracks, levels, window, iterations, cell, min_eigen;
        double fb_px, min_zncc, noise;
        double circle_u, circle_v, circle_radius;
        uint32_t reset_gap, cells;
        pf_config_text mask;
        bool static_mask, prediction;
    } tracker;
    struct {
        double step_mm, parallax_deg;
        uint32_t min_common, min_interval, jpeg_quality, queue;
    } keyframe;
    struct {
        double metres_per_count, sigma, noise;
    } encoder;
    struct {
        pf_config_text lamp, led, stop, limit_front, limit_rear, encoder, encoder_a, encoder_b;
        uint32_t pull;
        double lamp_level;
    } gpio;
    struct {
        uint32_t transport;
        pf_config_text device, address, trust;
        uint32_t baud, port;
        bool rtscts;
        uint32_t window, send_slots, max_fragment, keepalive_ms, rto_min_ms;
    } link;
    struct {
        pf_config_text path;
        double quota_mb;
    } spool;
    struct {
        uint32_t interval_ms, preview_interval_ms, preview_quality;
    } status;
    struct {
        uint32_t drain_s;
        bool exit_when_done;
        pf_config_text status_file;
        uint32_t log_level, threads, watchdog_s;
        pf_config_text watchdog;
    } daemon;
    unsigned line[PF_CONFIG_KEYS_MAX]; /* where each key of the table was set; 0 = its default */
} pf_config;

void pf_config_defaults(pf_config *config);

/* Parses an INI text over `config`. False: error[n] holds "file:line: what". */
bool pf_config_parse(pf_config *config, const char *text, size_t text_n, const char *file, char *error, size_t n);

/* Reads and parses a file of at most 1 MiB. */
bool pf_config_load(pf_config *config, const char *file, char *error, size_t n);

/* "section.key=value", over whatever was set before. */
bool pf_config_override(pf_config *config, const char *assignment, char *error, size_t n);

/* What no single key can tell: settings that need one another. `file` is named in the error. */
bool pf_config_check(const pf_config *config, const char *file, char *error, size_t n);

/* The whole documentation, itself a valid INI file with every key at its default: pipefishd.ini.example. */
void pf_config_print_help(FILE *out);

/* "section.key = value" of key i; the number of keys. */
size_t pf_config_line(const pf_config *config, uint32_t i, char *out, size_t n);
uint32_t pf_config_keys(void);

#endif
