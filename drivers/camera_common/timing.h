/* What a camera driver makes of the kernel's numbers and silences, without a device: frame numbers and times that only
 * rise, and when to restart a stream that has stopped. */
#ifndef PIPEFISH_CAMERA_TIMING_H
#define PIPEFISH_CAMERA_TIMING_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* ---- numbers and times */

typedef struct pf_numbering {
    uint64_t period_ns; /* between frames, nominal; 0 = unknown */
    /* statistics */
    uint64_t gaps;       /* numbers left out: frames that the kernel or the sensor dropped */
    uint64_t bad_times;  /* frames whose stamp was not of the monotonic clock, or did not rise */
    uint64_t bad_counts; /* frames whose number did not rise */
    /* private */
    bool has_last, is_fresh; /* a frame before; the stream has been restarted since */
    uint32_t last_kernel;
    uint64_t last, last_ns;
} pf_numbering;

void pf_numbering_init(pf_numbering *numbering, uint64_t period_ns);

/* The stream was stopped and started, or the camera unplugged: its numbers begin anew. Ours go on, with a gap as long
 * as the time that went by. */
void pf_numbering_restart(pf_numbering *numbering);

/* Gives the frame that the kernel calls `sequence` its number and time. stamp_ns is the kernel's, 0 = it has none;
 * now_ns is when it was taken from the queue. *time_ns is the stamp unless that lies after now, more than two seconds
 * before it, or not after the frame before; then it is `now_ns`, or just after the frame before. Both results rise
 * strictly from call to call. */
void pf_numbering_take(pf_numbering *numbering, uint32_t sequence, uint64_t stamp_ns, uint64_t now_ns, uint64_t *number,
                       uint64_t *time_ns);

/* ---- recovery */

#define PF_RECOVERY_RETRY_NS 250000000u /* between tries to open */
#define PF_RECOVERY_FIRST_NS                                                                                           \
    UINT64_C(1500000000)                /* for the first frame of a stream: sensors wake, USB cameras settle */
#define PF_RECOVERY_LEAST_NS 700000000u /* of silence before a stream counts as stalled, or three periods */
#define PF_RECOVERY_DAMAGED_NS                                                                                         \
    UINT64_C(2000000000) /* after a whole frame; damaged ones that come later are no better than silence */

typedef enum pf_recovery_action {
    PF_RECOVERY_WAIT = 0, /* for a frame, or for the time of the next try */
    PF_RECOVERY_OPEN,     /* try to open and start it */
    PF_RECOVERY_RESTART,  /* stop and start the stream */
    PF_RECOVERY_REOPEN,   /* close it; the next try is due at once */
} pf_recovery_action;

typedef struct pf_recovery {
    /* statistics */
    uint64_t restarts, reopens, unplugs;
    /* private */
    bool is_open, has_frame, was_restarted, is_broken;
    uint32_t fruitless; /* streams without a frame, one after the other */
    uint64_t period_ns, since_ns, whole_ns, retry_ns;
} pf_recovery;

void pf_recovery_init(pf_recovery *recovery, uint64_t period_ns, uint64_t now_ns);

/* What to do now. A stream that has been silent, or gave nothing but damaged frames, is restarted once; if that brings
 * no frame, or the driver refuses, it is reopened. */
pf_recovery_action pf_recovery_next(pf_recovery *recovery, uint64_t now_ns);

/* Nobody asked for frames for so long: that is no silence of the camera's. */
void pf_recovery_pause(pf_recovery *recovery, uint64_t elapsed_ns);

/* What came of it. */
void pf_recovery_opened(pf_recovery *recovery, uint64_t now_ns);
void pf_recovery_restarted(pf_recovery *recovery, uint64_t now_ns);
void pf_recovery_closed(pf_recovery *recovery, uint64_t now_ns); /* or could not be opened */
void pf_recovery_frame(pf_recovery *recovery, uint64_t now_ns);
void pf_recovery_damaged(pf_recovery *recovery, uint64_t now_ns); /* a frame came, and is of no use */
void pf_recovery_error(pf_recovery *recovery);                    /* the queue has failed: do not wait for silence */
void pf_recovery_unplug(pf_recovery *recovery);                   /* the device has gone */

#ifdef __cplusplus
}
#endif

#endif
