/* The camera profile in the device's own store (lib/include/pipefish/profile_store.h): loads it at the start, takes new
 * ones from the host, confirms them and goes back. The store is on a disk, so the work is done by the main thread; the
 * link thread hands over one job at a time and asks whether it is done.
 *
 * What is in use does not change while the daemon runs: a survey has one camera. A new profile is for the next start.
 */
#ifndef PIPEFISHD_KEEPER_H
#define PIPEFISHD_KEEPER_H

#include "daemon.h"

typedef enum pf_keeper_what { PF_KEEPER_STORE = 0, PF_KEEPER_CONFIRM = 1, PF_KEEPER_REVERT = 2 } pf_keeper_what;

typedef struct pf_keeper_job {
    pf_keeper_what what;
    uint32_t id;        /* the caller's */
    uint8_t sha256[32]; /* store, confirm: of the profile */
    bool has_failed;    /* when done: `problem` of the state says why */
} pf_keeper_job;

/* Opens camera.profile_store, makes it if it is not there, counts a start, and loads the profile into the daemon. A
 * profile that cannot be used is no reason to fail: the host could then not send another one. False: error[n]. */
bool pf_keeper_open(pf_daemon *daemon, char *error, size_t n);
/* Only looks: for --check-config. width, height: of the camera's frames; 0 = not known. False: error[n], also for a
 * stored profile that cannot be used. */
bool pf_keeper_check(pf_daemon *daemon, uint32_t width, uint32_t height, char *error, size_t n);
void pf_keeper_close(pf_keeper *keeper);

/* The camera's frame size is known: a profile of another one is not used. */
void pf_keeper_set_size(pf_keeper *keeper, uint32_t width, uint32_t height);

/* The pipeline cannot work with the profile in use: a trial is over and the profile before comes back, else none is
 * used. Before the threads start. */
void pf_keeper_reject(pf_keeper *keeper, const char *why);

/* Main thread: does the job that waits, if there is one. */
void pf_keeper_work(pf_keeper *keeper);

/* Link thread. ask: hands over a job (store: with bytes, at most PF_PROFILE_BINARY_MAX, copied); false: one is under
 * way. done: takes the job back when it is done; false: not yet, or there is none. */
bool pf_keeper_ask(pf_keeper *keeper, const pf_keeper_job *job, const uint8_t *bytes, size_t n);
bool pf_keeper_done(pf_keeper *keeper, pf_keeper_job *job);

/* Any thread. The state points into the texts, and into the daemon. */
typedef struct pf_keeper_texts {
    char name[PF_PROFILE_NAME_MAX], serial[PF_PROFILE_NAME_MAX]; /* of the stored profile */
    char problem[192];
} pf_keeper_texts;
void pf_keeper_state(pf_keeper *keeper, pf_msg_profile_state *state, pf_keeper_texts *texts);

/* Any thread. Whether that profile is the stored one and on trial, and for how many starts more. */
bool pf_keeper_trial(pf_keeper *keeper, const uint8_t sha256[32], uint32_t *starts_left);

#endif
