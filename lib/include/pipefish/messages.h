/* The messages of lib/link/pipefish.proto as plain C: what the device encodes and decodes, without a type of the
 * Protocol Buffers library. Encoders stream from the caller's arrays into the caller's buffer: nothing is copied in
 * between, nothing is allocated. All pointers are borrowed for the call. Units and meanings are the schema's.
 *
 * Every encoder: out[capacity], *n gets the bytes written.
 * Returns PF_OK; PF_ERR_SPACE (capacity too small: *n untouched, out[] undefined); PF_ERR_ARGUMENT (said at each).
 */
#ifndef PIPEFISH_MESSAGES_H
#define PIPEFISH_MESSAGES_H

#include "pipefish/link.h"
#include "pipefish/track.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_SCHEMA_VERSION 1u /* of pipefish.proto; in the link's hello and in Info */

typedef struct pf_msg_time {
    uint64_t boot_id, monotonic_ns;
} pf_msg_time;

typedef struct pf_msg_telemetry { /* a reading counts only if its has_ flag is set */
    pf_msg_time time;
    bool has_encoder, has_attitude, has_exposure, has_gain, has_lamp;
    int64_t encoder_count;
    uint32_t encoder_missed; /* edges */
    float roll_rad, pitch_rad;
    float attitude_sigma_rad; /* 0 = not stated */
    uint32_t exposure_us;
    float gain, lamp;
    bool emergency_stop;
    bool limit_front, limit_rear; /* pressed now */
} pf_msg_telemetry;

typedef struct pf_msg_tracking {
    uint32_t scene; /* pf_scene_flag */
    uint64_t frames, tracked, detected;
    uint64_t state_frames[PF_SCENE_FLAGS]; /* of `frames`, those in each state, in the order of the bits */
    uint64_t lost_by[PF_TRACK_REASONS];
    uint32_t age_median, quality_median, static_blocks;
} pf_msg_tracking;

typedef struct pf_msg_keyframe {
    uint8_t survey_id[16];
    uint32_t index;
    pf_msg_time time;
    uint64_t frame_sequence;
    uint64_t recorded_ns; /* 0 = not a recording */
    uint8_t frame_sha256[32];
    uint32_t width, height; /* pixels */
    const uint8_t *jpeg;
    size_t jpeg_size;
    uint32_t jpeg_quality; /* 1..100 */
    pf_keyframe_cause cause;
    pf_msg_telemetry telemetry;
    const pf_track *tracks; /* n_tracks, ids ascending; lost ones are left out */
    uint32_t n_tracks;
    uint32_t common_tracks;
    pf_msg_tracking tracking;
} pf_msg_keyframe;

/* Most bytes that a keyframe with so many live tracks and so large a JPEG takes, its break reason at most 256 bytes: 10
 * (id)
 * + 5 x 5 (x, y, covariance) + 5 (age) + 3 (quality) + 1 (status) + 2 x 3 (settled) a track. */
#define PF_MSG_KEYFRAME_MAX(n_tracks, jpeg_size) ((size_t)1024 + 50u * (size_t)(n_tracks) + (size_t)(jpeg_size))

typedef struct pf_msg_survey_start {
    uint8_t survey_id[16];
    pf_msg_time time;
    const char *name, *software, *source;
    const uint8_t *profile; /* binary profile; NULL = none */
    size_t profile_size;
    double metres_per_count, metres_per_count_sigma, noise_m_per_sqrt_m;
    uint32_t width, height;
    double frame_rate, nominal_diameter_m;
    const char *const *config; /* config_count lines "section.key = value" */
    uint32_t config_count;
    uint8_t tracker_config_sha256[32];
} pf_msg_survey_start;

typedef struct pf_msg_stages { /* microseconds */
    float capture, pyramid, track, detect, keyframe, store, frame_max;
} pf_msg_stages;

typedef struct pf_msg_spool {
    uint64_t objects, bytes, stored, acknowledged, errors;
    uint32_t evicted;
    bool is_failing; /* something cannot be stored or removed now */
} pf_msg_spool;

typedef struct pf_msg_network {
    const char *peer, *role; /* "" = nobody */
    uint32_t sessions, refused_unknown, refused_revoked, refused_handshake, refused_late, refused_often, refused_busy;
} pf_msg_network;

typedef struct pf_msg_clock_sync {
    uint64_t boot_id;
    int64_t offset_ns;
    uint64_t error_ns;
} pf_msg_clock_sync;

typedef struct pf_msg_profile {
    const char *name, *serial;
    uint8_t sha256[32];
    uint32_t crc32c;
    bool is_trial;
    uint32_t starts_left;
} pf_msg_profile;

/* Why a host may only look on. */
typedef enum pf_msg_looking {
    PF_LOOKING_NO = 0, /* he has the device */
    PF_LOOKING_BUSY,   /* another host has it */
    PF_LOOKING_VIEWER, /* his role is no more */
} pf_msg_looking;

typedef struct pf_msg_status {
    pf_msg_time time;
    uint8_t survey_id[16];
    const char *state;
    uint64_t frames, frames_dropped;
    uint32_t tracks_live, tracks_new, tracks_lost;
    uint64_t keyframes, keyframes_dropped;
    double fps;
    pf_msg_stages stage;
    pf_msg_spool spool;
    bool link_up;
    pf_link_stats link;
    pf_msg_telemetry telemetry;
    uint64_t uptime_ns;
    bool has_clock;
    pf_msg_clock_sync clock;
    bool has_profile;
    pf_msg_profile profile; /* in use */
    pf_msg_tracking tracking;
    bool has_network;
    pf_msg_network network;
    uint32_t visitors;         /* hosts that look on while another has the device */
    pf_msg_looking looking_on; /* who gets this */
} pf_msg_status;

typedef struct pf_msg_survey_end {
    uint8_t survey_id[16];
    pf_msg_time time;
    uint32_t keyframes, boots;
    uint64_t frames;
    const char *reason;
    const pf_msg_status *last_status;        /* NULL = none */
    const uint32_t *lost_first, *lost_count; /* lost_ranges of each */
    uint32_t lost_ranges;
} pf_msg_survey_end;

typedef struct pf_msg_preview {
    pf_msg_time time;
    uint64_t frame_sequence;
    uint32_t width, height;
    const uint8_t *jpeg;
    size_t jpeg_size;
} pf_msg_preview;

typedef struct pf_msg_raw_frame {
    pf_msg_time time;
    uint64_t frame_sequence;
    pf_image image; /* as the camera gave it */
    pf_msg_telemetry telemetry;
} pf_msg_raw_frame;

/* Most bytes that a raw frame with so many pixels takes. */
#define PF_MSG_RAW_FRAME_MAX(pixels) ((size_t)512 + (size_t)(pixels))

typedef struct pf_msg_info {
    const char *software, *source;
    uint64_t boot_id;
    uint32_t schema;
    uint8_t survey_id[16];
    uint8_t profile_sha256[32]; /* of the binary profile; zeros = there is none */
} pf_msg_info;

typedef struct pf_msg_profile_state {
    bool has_in_use, has_stored;
    pf_msg_profile in_use, stored;
    const char *problem; /* "" = none */
    uint32_t slot_erases[2];
} pf_msg_profile_state;

typedef struct pf_msg_reply {
    uint32_t id;
    const char *error; /* "" = done */
    const pf_msg_status
        *status; /* at most one of status, info, profile and paired_key; all NULL = none was asked for */
    const pf_msg_info *info;
    const pf_msg_profile_state *profile;
    const uint8_t *paired_key; /* 32 bytes, the device's */
} pf_msg_reply;

typedef enum pf_request_what {
    PF_REQUEST_UNKNOWN = 0, /* none of those below: a newer host's */
    PF_REQUEST_GET_STATUS = 2,
    PF_REQUEST_GET_INFO = 3,
    PF_REQUEST_STOP_SURVEY = 4,
    PF_REQUEST_SET_LAMP = 5,
    PF_REQUEST_CLOCK_SYNC = 6,
    PF_REQUEST_SHUTDOWN = 7,
    PF_REQUEST_GET_PROFILE = 8,
    PF_REQUEST_CONFIRM_PROFILE = 9,
    PF_REQUEST_REVERT_PROFILE = 10,
    PF_REQUEST_GET_STILL = 11,
    PF_REQUEST_PAIR = 20,
} pf_request_what;

typedef struct pf_msg_pair {
    uint8_t key[32]; /* the host's */
    char role[12], name[48];
} pf_msg_pair;

typedef struct pf_msg_request {
    uint32_t id;
    pf_request_what what;
    float lamp;                 /* PF_REQUEST_SET_LAMP; as sent: may be any float */
    pf_msg_clock_sync clock;    /* PF_REQUEST_CLOCK_SYNC */
    uint8_t profile_sha256[32]; /* PF_REQUEST_CONFIRM_PROFILE */
    pf_msg_pair pair;           /* PF_REQUEST_PAIR; the texts are any UTF-8 */
} pf_msg_request;

/* Marks the keyframe message out[0 .. *n) as the first after a break, for this reason; *n grows. PF_ERR_SPACE. */
pf_status pf_msg_append_break(const char *reason, uint8_t *out, size_t capacity, size_t *n);

/* Adds keyframe `index` to those that the survey's end out[0 .. *n) names as lost; *n grows. PF_ERR_SPACE. */
pf_status pf_msg_append_lost(uint32_t index, uint8_t *out, size_t capacity, size_t *n);

/* Whose a keyframe's message is that is damaged somewhere, from its first bytes alone. PF_ERR_FORMAT: not even those
 * are whole. */
pf_status pf_msg_peek_keyframe(const uint8_t *bytes, size_t n, uint8_t survey_id[16], uint32_t *index);
/* Of a survey's end that is whole. PF_ERR_FORMAT. */
pf_status pf_msg_peek_survey_end(const uint8_t *bytes, size_t n, uint8_t survey_id[16]);

/* PF_ERR_ARGUMENT: n_tracks > 2 PF_TRACKS_MAX (a whole table, lost tracks included) or ids that do not ascend. */
pf_status pf_msg_encode_keyframe(const pf_msg_keyframe *keyframe, uint8_t *out, size_t capacity, size_t *n);
pf_status pf_msg_encode_survey_start(const pf_msg_survey_start *start, uint8_t *out, size_t capacity, size_t *n);
pf_status pf_msg_encode_survey_end(const pf_msg_survey_end *end, uint8_t *out, size_t capacity, size_t *n);
pf_status pf_msg_encode_status(const pf_msg_status *status, uint8_t *out, size_t capacity, size_t *n);
pf_status pf_msg_encode_preview(const pf_msg_preview *preview, uint8_t *out, size_t capacity, size_t *n);
pf_status pf_msg_encode_raw_frame(const pf_msg_raw_frame *frame, uint8_t *out, size_t capacity, size_t *n);
/* PF_ERR_ARGUMENT: both status and info. */
pf_status pf_msg_encode_reply(const pf_msg_reply *reply, uint8_t *out, size_t capacity, size_t *n);

/* Decodes any bytes at all. PF_OK, or with *request untouched PF_ERR_FORMAT. */
pf_status pf_msg_decode_request(const uint8_t *bytes, size_t n, pf_msg_request *request);

#ifdef __cplusplus
}
#endif
#endif
