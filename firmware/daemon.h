/* What the daemon's threads share. Fields are set before the threads start and only read afterwards, unless said
 * otherwise.
 */
#ifndef PIPEFISHD_DAEMON_H
#define PIPEFISHD_DAEMON_H

#include <pthread.h>
#include <stdatomic.h>

#include "config.h"
#include "pipefish/drivers/camera.h"
#include "pipefish/drivers/gpio.h"
#include "pipefish/drivers/spool.h"
#include "pipefish/drivers/transport.h"
#include "pipefish/drivers/trust.h"
#include "pipefish/messages.h"
#include "pipefish/profile.h"
#include "still.h"
#include "store.h"

#define PF_SOFTWARE "pipefishd 0.1.0"
_Static_assert(PF_VERSION_MAJOR == 0 && PF_VERSION_MINOR == 1 && PF_VERSION_PATCH == 0, "PF_SOFTWARE says so");

typedef enum pf_stop {
    PF_STOP_NO = 0,
    PF_STOP_OPERATOR,   /* stop_survey */
    PF_STOP_SHUTDOWN,   /* shutdown: exit when the spool is empty, at the latest after daemon.drain_s */
    PF_STOP_TERMINATED, /* SIGTERM, SIGINT */
} pf_stop;

typedef enum pf_state { PF_STATE_SURVEYING = 0, PF_STATE_DRAINING = 1, PF_STATE_IDLE = 2 } pf_state;

/* Counters of the status message; behind the mutex. */
typedef struct pf_counters {
    pthread_mutex_t mutex;
    uint64_t frames, frames_dropped, frames_tracked;
    pf_camera_stats camera;
    uint32_t tracks_live, tracks_new, tracks_lost;
    uint64_t keyframes;
    uint64_t capture_ns, stage_ns[PF_STAGES], keyframe_ns, frame_max_ns; /* sums; the slowest frame */
    uint64_t first_ns, last_ns; /* when capture began, when the last frame was done */
    pf_msg_telemetry telemetry;
    pf_msg_tracking tracking;
    bool link_up;
    pf_link_stats link;
    uint32_t visitors; /* hosts that look on */
    uint32_t overruns; /* bytes, at least, that the line dropped before anybody read them */
    bool has_clock;
    pf_msg_clock_sync clock;
    bool has_network; /* the transport refuses whom it does not know */
    pf_transport_stats network;
    pf_role peer_role;
    char peer_name[PF_PEER_NAME_MAX];
} pf_counters;

typedef struct pf_keeper pf_keeper;
typedef struct pf_recall pf_recall;

typedef struct pf_daemon {
    pf_config config;
    uint64_t boot_id, started_ns;
    uint8_t survey_id[16];
    char source[256]; /* of the camera, UTF-8 */
    pf_camera_source camera;
    pf_gpio gpio;
    pf_transport transport;
    pf_trust *trust; /* of link.trust; NULL = there is none. The courier's, once it runs */
    pf_spool spool;
    bool has_profile;
    pf_profile profile;
    uint8_t profile_bytes[PF_PROFILE_BINARY_MAX];
    size_t profile_size;
    uint8_t profile_sha256[32];
    pf_recall *recall;
    pf_keeper *keeper; /* of camera.profile_store; NULL = there is none */
    pf_store *store;
    pf_still *still;
    int wake_fd;       /* eventfd: wakes the courier */
    _Atomic int stop;  /* pf_stop; set once, by pf_daemon_stop */
    _Atomic int state; /* pf_state */
    pf_counters counters;
} pf_daemon;

/* Asks for the end of the survey; the first reason counts, but a shutdown also follows a stop by the operator. */
void pf_daemon_stop(pf_daemon *daemon, pf_stop stop);

/* Decodes a profile, recomputes its self-tests and builds its camera in integers, which the pipeline lives on: what
 * this device could not run with is refused before it counts. `workspace` as of pf_profile_integers_check. False: *why.
 */
bool pf_daemon_read_profile(const uint8_t *bytes, size_t n, pf_profile *profile, void *workspace, size_t size,
                            const char **why);

/* The profile in use, of a daemon that has one. The texts are the daemon's. Any thread. */
pf_msg_profile pf_daemon_profile(pf_daemon *daemon);

/* The status message as of now. Any thread. peer[PF_PEER_NAME_MAX]: memory for a text of it. */
void pf_daemon_status(pf_daemon *daemon, pf_msg_status *status, char *peer);

/* The same as a JSON file, replaced as a whole. False: error[n] says why. */
bool pf_daemon_write_status(pf_daemon *daemon, const char *path, char *error, size_t n);

#endif
