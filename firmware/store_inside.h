/* What the store's rooms share: storing.c puts jobs into the spool, slots.c takes objects out of it for the courier,
 * and store.c has the thread that calls both, and the doors of store.h. */
#ifndef PIPEFISHD_STORE_INSIDE_H
#define PIPEFISHD_STORE_INSIDE_H

#include <pthread.h>

#include "store.h"

#define RETRY_NS UINT64_C(1000000000) /* between tries of what failed */

/* What the spool does not do now. */
typedef enum pf_trouble { TROUBLE_STORING = 1, TROUBLE_READING = 2, TROUBLE_REMOVING = 4 } pf_trouble;

enum { SLOT_EMPTY = 0, SLOT_READY, SLOT_SENDING, SLOT_DONE };

struct pf_store {
    pf_spool spool;
    pf_store_config config;
    pthread_t thread;
    pthread_mutex_t mutex; /* guards all below; never held during a call of the spool */
    pthread_cond_t work;   /* something for the thread */
    pthread_cond_t change; /* something for those who wait on it */
    pf_survey survey;
    pf_job *jobs;      /* the memory of all jobs */
    pf_job **free_job; /* stack */
    uint32_t free_count;
    pf_job **queue; /* ring, oldest first */
    uint32_t queue_first, queue_count;
    bool is_blocked;   /* the oldest job waits for room in the spool */
    bool is_failing;   /* the spool cannot be read now */
    uint64_t retry_ns; /* when to try again at the latest */
    uint64_t left_row; /* the first object that could not be removed: tried again for all of them; 0 = none */
    bool is_rewinding; /* it can again: as soon as no slot holds one, all that are left are offered once more */
    unsigned troubles; /* those that are there */
    bool has_more;     /* the spool may hold an object after `cursor` */
    uint64_t cursor;   /* row of the last object that went into a slot */
    pf_slot *slots;
    size_t slot_capacity;
    bool is_hurried, is_flushing, is_quitting;
    pf_store_stats stats;
    /* The thread's own: */
    bool was_blocked, was_evicting;       /* has said so */
    unsigned told;                        /* troubles that it has told */
    uint64_t told_healed;                 /* damaged files that it has told of */
    uint64_t not_evicted;                 /* of what the spool counts as evicted */
    bool must_keep;                       /* what other surveys left still has ranks: nothing may go for it */
    char lost_break[PF_BREAK_REASON_MAX]; /* of a keyframe that was lost: the next one that is stored tells it */
};

/* All are called by the store's thread, enter and leave with the mutex, and give it back while they ask the spool. */

/* Stores the oldest job. */
void pf_storing_do(pf_store *store);

/* Loads the next object into an empty slot. */
void pf_slots_fill(pf_store *store, pf_slot *slot);

/* What the host has goes. What cannot be removed stays and counts, and keeps nothing behind it from being sent. */
void pf_slots_empty(pf_store *store, pf_slot *slot);

/* Once the first that was left can be removed, the host is offered the others again: it has them, and says so. */
void pf_slots_try_left(pf_store *store);

/* A trouble is there, and why, in the spool's words, asked for before the mutex was taken; or (NULL) it is not. */
void pf_store_note_trouble(pf_store *store, pf_trouble which, const char *why);

/* Counts and remembers a job that will not be stored. */
void pf_store_lose_job(pf_store *store, const pf_job *job);
const char *pf_job_what(const pf_job *job);

/* Back to those that are free. */
void pf_store_free_job(pf_store *store, pf_job *job);

#endif
