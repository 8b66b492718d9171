/* Tracking in the daemon: the tracker with its mask, lens and prediction, the states of the scene, the choice of
 * keyframes. One thread at a time.
 */
#ifndef PIPEFISHD_TRACKING_H
#define PIPEFISHD_TRACKING_H

#include "daemon.h"

/* A frame on its way: taken by the capture thread, tracked, then made a keyframe of by the capture thread. */
typedef struct pf_shot {
    pf_frame frame;  /* the driver's until the slot is used again; without a handle its .image is `pixels` */
    uint8_t *pixels; /* NULL: frames are used where they lie */
    pf_msg_telemetry telemetry;
    /* what tracking makes of it */
    uint64_t missing; /* frames before it */
    char break_reason[PF_BREAK_REASON_MAX];
    pf_keyframe_cause cause;
    uint32_t common, n_tracks;
    pf_track *tracks; /* the table, of a keyframe */
    pf_tracker_stats stats;
    pf_msg_tracking tracking; /* since the keyframe before, of a keyframe; else only .scene */
    uint64_t stage_ns[PF_STAGES], track_ns;
} pf_shot;

typedef struct pf_tracking pf_tracking;

/* False: error[n] says what is wrong, file and setting named. */
bool pf_tracking_open(pf_tracking **tracking, const pf_daemon *daemon, char *error, size_t n);
void pf_tracking_close(pf_tracking *tracking); /* NULL is allowed */

/* Tracks a shot, the next of its sequence; its pixels must stay until the one after it has been tracked. The arguments
 * are a pf_tracking and a pf_shot: a worker's. */
void pf_tracking_shot(void *tracking, void *shot);

/* Adds a frame's counters to a sum; states and medians are replaced. */
void pf_tracking_count(pf_msg_tracking *sum, const pf_tracker_stats *stats, uint32_t scene);

/* Radius of the image circle, 0 = none, and its centre: of the configuration, else of the profile. Pixels. */
double pf_tracking_circle(const pf_daemon *daemon, double *u, double *v);

#endif
