/* The store thread: the only one that touches the disk, so that neither tracking nor the link waits for it. Keyframes
 * come to it in preallocated jobs; the courier gets objects from it in preallocated slots, oldest first, and gives them
 * back when the host has them. All memory is taken at opening. Functions may be called from any thread.
 */
#ifndef PIPEFISHD_STORE_H
#define PIPEFISHD_STORE_H

#include "survey.h"

#define PF_BREAK_REASON_MAX 128u /* bytes, with the zero */
#define PF_TROUBLE_MAX      256u /* likewise */

typedef struct pf_job {
    uint8_t *bytes; /* capacity of pf_store_capacity() */
    size_t n;
    uint32_t kind;                          /* pf_object_kind */
    uint32_t index;                         /* of a keyframe */
    bool is_event;                          /* a keyframe that is never given up (pf_survey_importance) */
    char break_reason[PF_BREAK_REASON_MAX]; /* of a keyframe; "" = tracks go on from the one before. Not in `bytes` */
} pf_job;

typedef struct pf_slot {
    pf_spool_item item;
    uint8_t *bytes;
    uint32_t state; /* private */
} pf_slot;

typedef struct pf_store_config {
    uint32_t jobs;   /* that may wait for the disk, > 0 */
    uint32_t slots;  /* objects under way, > 0 */
    size_t capacity; /* most bytes of an object of this run; slots also hold the largest one already in the spool */
    bool is_patient; /* what does not fit waits until the host has made room; else keyframes are given up: the least
                        important of those that wait and of this one */
    int wake_fd;     /* eventfd of the courier: written when a slot is ready */
} pf_store_config;

typedef struct pf_store_stats {
    pf_spool_stats spool;
    uint64_t keyframes_dropped;   /* made but not stored, or damaged by the medium later; those that made room later are
                                     spool.evicted */
    uint64_t refused;             /* objects that the host will never take */
    uint64_t store_ns, stored;    /* time spent on storing keyframes, and how many */
    bool has_failed;              /* the survey's start or end could not be stored */
    char trouble[PF_TROUBLE_MAX]; /* why something cannot be stored or removed now; "" = well */
} pf_store_stats;

typedef struct pf_store pf_store;

/* Starts the thread; borrows the spool. False: error[n] says why. */
bool pf_store_open(pf_store **store, const pf_spool *spool, const pf_survey *survey, const pf_store_config *config,
                   char *error, size_t n);
size_t pf_store_capacity(const pf_store *store);

/* A job to fill, all but its bytes zero; NULL: none is free (when patient: only after pf_store_hurry). Goes on with
 * give or give_back. */
pf_job *pf_store_take(pf_store *store);
/* The store adds the break reason to a keyframe's message when it stores it: if the keyframe is lost, the next one that
 * is stored carries it. */
void pf_store_give(pf_store *store, pf_job *job);
void pf_store_give_back(pf_store *store, pf_job *job);

/* Counts and remembers a keyframe that will not be stored. */
void pf_store_lose(pf_store *store, uint32_t index);

/* From now on take() waits two seconds at most, and not for a disk that is full or fails: the survey is being stopped.
 */
void pf_store_hurry(pf_store *store);

/* From now on nothing waits for room in the spool: what does not fit is lost, and counted. */
void pf_store_flush(pf_store *store);

/* Waits until every job is stored or dropped: for room in the spool as well, unless pf_store_flush was called. */
void pf_store_settle(pf_store *store);

/* A slot whose object is to be sent, or NULL; and its return: the host has it, or has refused it for ever. */
pf_slot *pf_store_next_slot(pf_store *store);
void pf_store_release_slot(pf_store *store, const uint8_t name[32], bool is_refused);

/* Nothing waits for the disk or the host. */
bool pf_store_is_drained(pf_store *store);

void pf_store_get_stats(pf_store *store, pf_store_stats *stats);
void pf_store_get_survey(pf_store *store, pf_survey *survey);

/* Flushes, stores what is queued, removes what was released, and ends the thread. Nothing may come after it: what does
 * counts as lost. Then close frees all. */
void pf_store_quit(pf_store *store);
void pf_store_close(pf_store *store);

#endif
