#include "store.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "clock.h"
#include "config.h"
#include "damage.h"
#include "log.h"
#include "pipefish/drivers/sha256.h"
#include "pipefish/messages.h"
#include "pulse.h"

#define HURRY_NS 2000000000u
#define RETRY_NS UINT64_C(1000000000) /* between tries of what failed */

/* What the spool does not do now. */
typedef enum trouble { TROUBLE_STORING = 1, TROUBLE_READING = 2, TROUBLE_REMOVING = 4 } trouble;

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
    uint64_t not_evicted;                 /* of what the spool counts as evicted */
    bool must_keep;                       /* what other surveys left still has ranks: nothing may go for it */
    char lost_break[PF_BREAK_REASON_MAX]; /* of a keyframe that was lost: the next one that is stored tells it */
};

/* ---- the thread's work: each is called without the mutex */

/* Stores a job, and takes the victims out. */
static pf_status store_object(pf_store *s, const pf_job *job, const pf_survey *survey, const char *break_reason,
                              const pf_spool_victim *victims, uint32_t count)
{
    const pf_spool_rank rank = {pf_survey_importance(job->index), job->index};
    bool may_go = job->kind == PF_OBJECT_KEYFRAME && !job->is_event && break_reason[0] == '\0';
    size_t n = job->n; /* the bytes behind are free: a job that waits is stored again */
    uint8_t name[32], value[PF_SURVEY_BYTES];
    size_t value_n = 0; /* of the survey's end: the value is deleted */
    if (break_reason[0] != '\0' && pf_msg_append_break(break_reason, job->bytes, s->config.capacity, &n) != PF_OK)
        return PF_ERR_ARGUMENT;
    if (pf_sha256(job->bytes, n, name) != PF_OK)
        return PF_ERR_IO;
    if (job->kind != PF_OBJECT_SURVEY_END)
        value_n = pf_survey_pack(survey, value);
    return s->spool.ops->exchange(s->spool.self, victims, count, job->kind, name, job->bytes, n, may_go ? &rank : NULL,
                                  PF_SURVEY_KEY, value, value_n);
}

typedef struct sacrifice {
    pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX];
    uint32_t count;
} sacrifice;

/* A full spool makes room for a keyframe by giving up less important ones that no slot holds; the survey that is stored
 * with it remembers them. */
static pf_status store_instead(pf_store *s, const pf_job *job, pf_survey *survey, const char *break_reason,
                               uint64_t cursor, sacrifice *made)
{
    if (s->must_keep && s->spool.ops->keep_all(s->spool.self) != PF_OK)
        return PF_ERR_SPACE;
    s->must_keep = false;
    uint32_t importance = job->is_event ? UINT32_MAX : pf_survey_importance(job->index);
    pf_status status = s->spool.ops->victims(s->spool.self, cursor, importance, job->n, made->victims, &made->count);
    for (uint32_t i = 0; status == PF_OK && i < made->count; i++)
        pf_survey_lose(survey, made->victims[i].number);
    if (status == PF_OK)
        status = store_object(s, job, survey, break_reason, made->victims, made->count);
    if (status != PF_OK)
        made->count = 0;
    return status;
}

static bool is_keyframe(const pf_job *job)
{
    return job->kind == PF_OBJECT_KEYFRAME;
}

static void lose(pf_store *s, uint32_t index)
{
    s->stats.keyframes_dropped++;
    pf_survey_lose(&s->survey, index);
}

static void lose_job(pf_store *s, const pf_job *job)
{
    if (is_keyframe(job))
        lose(s, job->index);
    else
        s->stats.has_failed = true;
}

static const char *what(const pf_job *job)
{
    return is_keyframe(job) ? "a keyframe" : "the survey's start or end";
}

/* With the mutex, right after the call. */
static void note_trouble(pf_store *s, trouble which, bool is_there)
{
    s->troubles = is_there ? s->troubles | which : s->troubles & ~(unsigned)which;
    if (is_there || s->troubles == 0)
        (void)snprintf(s->stats.trouble, sizeof s->stats.trouble, "%s",
                       is_there ? s->spool.ops->error(s->spool.self) : "");
}

static void free_job(pf_store *s, pf_job *job)
{
    s->free_job[s->free_count++] = job;
    pthread_cond_broadcast(&s->change);
}

static void pop_job(pf_store *s)
{
    pf_job *job = s->queue[s->queue_first];
    s->queue_first = (s->queue_first + 1) % s->config.jobs;
    s->queue_count--;
    free_job(s, job);
}

/* Stores the oldest job. Enters and leaves with the mutex. */
static void do_job(pf_store *s)
{
    const pf_job *job = s->queue[s->queue_first];
    pf_survey survey = s->survey;
    uint64_t start = pf_now();
    bool may_wait = !s->is_flushing && (s->config.is_patient || !is_keyframe(job));
    bool is_waiting;
    char break_reason[PF_BREAK_REASON_MAX] = "";
    uint64_t cursor = s->cursor;
    sacrifice made = {.count = 0};
    pf_status status;

    if (is_keyframe(job))
        survey.next_index = job->index + 1;
    pthread_mutex_unlock(&s->mutex);
    if (is_keyframe(job))
        memcpy(break_reason, job->break_reason[0] ? job->break_reason : s->lost_break, sizeof break_reason);
    status = store_object(s, job, &survey, break_reason, NULL, 0);
    if (status == PF_ERR_SPACE && is_keyframe(job) && !s->config.is_patient)
        status = store_instead(s, job, &survey, break_reason, cursor, &made);
    is_waiting = status == PF_ERR_SPACE && may_wait;
    bool is_evicting = is_keyframe(job) && (made.count > 0 || (status == PF_ERR_SPACE && !is_waiting));
    if (is_evicting && !s->was_evicting)
        pf_log(PF_LOG_WARNING, "%s: keyframes are given up from now on, the least important first",
               made.count > 0 ? "the spool is full" : s->spool.ops->error(s->spool.self));
    if (is_waiting && !s->was_blocked)
        pf_log(PF_LOG_WARNING, "%s: waiting until there is room", s->spool.ops->error(s->spool.self));
    else if (status != PF_OK && !is_waiting && !is_evicting)
        pf_log(PF_LOG_ERROR, "%s: %s is lost", s->spool.ops->error(s->spool.self), what(job));
    s->was_blocked = is_waiting;
    s->was_evicting = is_evicting;
    if (is_keyframe(job) && status == PF_OK)
        s->lost_break[0] = '\0';
    else if (is_keyframe(job) && !is_waiting)
        memcpy(s->lost_break, break_reason, sizeof s->lost_break);
    pthread_mutex_lock(&s->mutex);
    note_trouble(s, TROUBLE_STORING, status != PF_OK);
    if (is_waiting) {
        s->is_blocked = !s->is_flushing;
        s->retry_ns = pf_now() + RETRY_NS;
        return;
    }
    if (status == PF_OK) {
        s->has_more = true;
        s->stats.spool.objects++; /* at once: pf_store_is_drained must not see an empty queue and the old number */
        if (is_keyframe(job)) {
            for (uint32_t i = 0; i < made.count; i++)
                pf_survey_lose(&s->survey, made.victims[i].number);
            s->survey.next_index = job->index + 1;
            s->stats.store_ns += pf_now() - start;
            s->stats.stored++;
        }
    } else {
        lose_job(s, job);
    }
    pop_job(s);
}

/* Says once, not every second, that the spool fails; without the mutex, after a call that says how. */
static void note_failure(pf_store *s, trouble which, bool is_failing)
{
    if (is_failing && (s->told & which) == 0)
        pf_log(PF_LOG_ERROR, "%s: trying again", s->spool.ops->error(s->spool.self));
    s->told = is_failing ? s->told | which : s->told & ~(unsigned)which;
}

static void retry_later(pf_store *s)
{
    s->is_failing = true;
    s->retry_ns = pf_now() + RETRY_NS;
}

/* Without the mutex. What the medium has damaged is of no use to anyone, and never acknowledged: it goes, and a
 * keyframe is counted and named in its survey's lost ranges. */
static void give_up_damaged(pf_store *s, const pf_slot *slot, size_t n)
{
    const bool is_frame = slot->item.kind == PF_OBJECT_KEYFRAME;
    uint8_t value[PF_SURVEY_BYTES];
    size_t value_n = 0;
    pf_damage damage = {.is_known = false};
    pf_log(PF_LOG_ERROR, "%s: it is given up", s->spool.ops->error(s->spool.self));
    pf_status status =
        is_frame ? pf_damage_settle(&damage, &s->spool, &slot->item, slot->bytes, s->slot_capacity, n) : PF_OK;
    pthread_mutex_lock(&s->mutex);
    if (is_frame && damage.is_known && !damage.is_named &&
        memcmp(damage.survey_id, s->survey.id, sizeof damage.survey_id) == 0) {
        pf_survey_lose(&s->survey, damage.index);
        value_n = pf_survey_pack(&s->survey, value);
    }
    s->stats.keyframes_dropped += is_frame && status == PF_OK;
    if (damage.is_named)
        s->not_evicted += 2; /* the keyframe, and the end that another has replaced */
    pthread_mutex_unlock(&s->mutex);
    if (status == PF_OK && value_n > 0) /* before it goes, lest a power cut leave it unnamed */
        status = s->spool.ops->set(s->spool.self, PF_SURVEY_KEY, value, value_n);
    if (status == PF_OK && !damage.is_named)
        status = s->spool.ops->remove(s->spool.self, slot->item.row);
    if (status != PF_OK)
        pf_log(PF_LOG_ERROR, "%s: it stays in the spool", s->spool.ops->error(s->spool.self));
}

/* Loads the next object into an empty slot. Enters and leaves with the mutex. */
static void fill_slot(pf_store *s, pf_slot *slot)
{
    uint64_t after = s->cursor, one = 1;
    size_t n = 0;
    pf_status status;
    /* Before the look: what is stored meanwhile sets it again. */
    s->has_more = false;
    pthread_mutex_unlock(&s->mutex);
    status = s->spool.ops->next(s->spool.self, after, &slot->item);
    if (status == PF_OK) {
        status = s->spool.ops->read(s->spool.self, slot->item.row, slot->bytes, s->slot_capacity, &n);
        if (status == PF_ERR_CHECKSUM)
            give_up_damaged(s, slot, n);
        else if (status == PF_ERR_SPACE)
            pf_log(PF_LOG_ERROR, "%s: it stays in the spool", s->spool.ops->error(s->spool.self));
        if (status != PF_ERR_IO)
            after = slot->item.row;
    }
    note_failure(s, TROUBLE_READING, status == PF_ERR_IO);
    pthread_mutex_lock(&s->mutex);
    if (status == PF_OK || status == PF_ERR_IO)
        note_trouble(s, TROUBLE_READING, status != PF_OK);
    if (after != s->cursor || status == PF_ERR_IO)
        s->has_more = true;
    s->cursor = after;
    if (status == PF_ERR_IO)
        retry_later(s);
    if (status != PF_OK)
        return;
    slot->state = SLOT_READY;
    pthread_mutex_unlock(&s->mutex);
    if (write(s->config.wake_fd, &one, sizeof one) < 0)
        pf_log(PF_LOG_ERROR, "cannot wake the courier");
    pthread_mutex_lock(&s->mutex);
}

/* Whether it has gone from the spool. Enters and leaves with the mutex. */
static bool remove_row(pf_store *s, uint64_t row)
{
    bool is_removed;
    pthread_mutex_unlock(&s->mutex);
    is_removed = s->spool.ops->remove(s->spool.self, row) == PF_OK;
    note_failure(s, TROUBLE_REMOVING, !is_removed);
    pthread_mutex_lock(&s->mutex);
    note_trouble(s, TROUBLE_REMOVING, !is_removed);
    if (is_removed)
        s->is_blocked = false;
    else
        s->retry_ns = pf_now() + RETRY_NS;
    return is_removed;
}

/* What cannot be removed stays and counts, and keeps nothing behind it from being sent. */
static void empty_slot(pf_store *s, pf_slot *slot)
{
    if (!remove_row(s, slot->item.row) && s->left_row == 0)
        s->left_row = slot->item.row;
    slot->state = SLOT_EMPTY;
}

/* Once the first that was left can be removed, the host is offered the others again: it has them, and says so. */
static void try_left(pf_store *s)
{
    if (s->left_row != 0 && pf_now() >= s->retry_ns && remove_row(s, s->left_row)) {
        s->left_row = 0;
        s->is_rewinding = true;
    }
    for (uint32_t i = 0; i < s->config.slots; i++)
        if (s->slots[i].state != SLOT_EMPTY)
            return;
    if (s->is_rewinding) {
        s->cursor = 0;
        s->has_more = true;
        s->is_rewinding = false;
    }
}

static void refresh_spool_stats(pf_store *s)
{
    pf_spool_stats stats;
    pthread_mutex_unlock(&s->mutex);
    s->spool.ops->stats(s->spool.self, &stats);
    pthread_mutex_lock(&s->mutex);
    if (stats.healed != s->stats.spool.healed)
        pf_log(PF_LOG_ERROR, "%s", s->spool.ops->error(s->spool.self));
    stats.evicted -= s->not_evicted;
    s->stats.spool = stats;
    pthread_cond_broadcast(&s->change);
}

/* One round: at most one job, and every slot once, so that neither starves the other. */
static bool do_round(pf_store *s)
{
    bool is_busy = false;
    if (s->queue_count > 0 && !s->is_blocked) {
        do_job(s);
        is_busy = true;
    }
    try_left(s);
    for (uint32_t i = 0; i < s->config.slots; i++) {
        if (s->slots[i].state == SLOT_DONE) {
            empty_slot(s, &s->slots[i]);
            is_busy = true;
        }
        if (s->slots[i].state == SLOT_EMPTY && s->has_more && !s->is_failing && !s->is_rewinding && !s->is_quitting) {
            fill_slot(s, &s->slots[i]);
            is_busy = true;
        }
    }
    return is_busy;
}

static void *run(void *argument)
{
    pf_store *s = argument;
    pf_pulse_begin(PF_PULSE_STORE);
    pthread_mutex_lock(&s->mutex);
    refresh_spool_stats(s);
    for (;;) {
        pf_pulse_work();
        if (do_round(s)) {
            refresh_spool_stats(s);
            continue;
        }
        if (s->is_quitting)
            break;
        pf_pulse_rest();
        if (s->is_blocked || s->is_failing ||
            s->left_row != 0) { /* room may come from elsewhere, too: someone cleans up a full disk */
            const struct timespec until = {(time_t)(s->retry_ns / 1000000000u), (long)(s->retry_ns % 1000000000u)};
            (void)pthread_cond_timedwait(&s->work, &s->mutex, &until);
            if (pf_now() >= s->retry_ns)
                s->is_blocked = s->is_failing = false;
        } else {
            pthread_cond_wait(&s->work, &s->mutex);
        }
    }
    pthread_mutex_unlock(&s->mutex);
    pf_pulse_rest();
    return NULL;
}

/* ---- opening and closing */

static bool allocate(pf_store *s)
{
    uint32_t jobs = s->config.jobs;
    s->jobs = calloc(jobs, sizeof *s->jobs);
    s->free_job = calloc(jobs, sizeof(pf_job *));
    s->queue = calloc(jobs, sizeof(pf_job *));
    s->slots = calloc(s->config.slots, sizeof *s->slots);
    if (!s->jobs || !s->free_job || !s->queue || !s->slots)
        return false;
    for (uint32_t i = 0; i < jobs; i++) {
        s->jobs[i].bytes = malloc(s->config.capacity);
        if (!s->jobs[i].bytes)
            return false;
        s->free_job[s->free_count++] = &s->jobs[i];
    }
    for (uint32_t i = 0; i < s->config.slots; i++) {
        s->slots[i].bytes = malloc(s->slot_capacity);
        if (!s->slots[i].bytes)
            return false;
    }
    return true;
}

static void release(pf_store *s)
{
    for (uint32_t i = 0; s->jobs && i < s->config.jobs; i++)
        free(s->jobs[i].bytes);
    for (uint32_t i = 0; s->slots && i < s->config.slots; i++)
        free(s->slots[i].bytes);
    free(s->jobs);
    free(s->free_job);
    free(s->queue);
    free(s->slots);
    free(s);
}

/* An object of an earlier run, with a larger camera perhaps, must fit into a slot as well. */
static bool measure_spool(pf_store *s, char *error, size_t n)
{
    pf_spool_item item = {0};
    pf_status status;
    s->slot_capacity = s->config.capacity;
    while ((status = s->spool.ops->next(s->spool.self, item.row, &item)) == PF_OK)
        if (item.size > s->slot_capacity)
            s->slot_capacity = item.size;
    if (status != PF_ERR_END)
        (void)snprintf(error, n, "%s", s->spool.ops->error(s->spool.self));
    return status == PF_ERR_END;
}

bool pf_store_open(pf_store **store, const pf_spool *spool, const pf_survey *survey, const pf_store_config *config,
                   char *error, size_t n)
{
    pthread_condattr_t attributes;
    pf_store *s = calloc(1, sizeof *s);
    if (s == NULL) {
        (void)snprintf(error, n, "no memory");
        return false;
    }
    s->spool = *spool;
    s->survey = *survey;
    s->config = *config;
    /* What other surveys left is whole, or its end has told what is lost. */
    s->must_keep = !survey->is_resumed && spool->ops->keep_all(spool->self) != PF_OK;
    if (s->must_keep) /* on a disk that is full: what is there can be sent all the same */
        pf_log(PF_LOG_ERROR, "%s", spool->ops->error(spool->self));
    if (!measure_spool(s, error, n)) {
        release(s);
        return false;
    }
    if (!allocate(s)) {
        (void)snprintf(error, n, "no memory for %u + %u objects of %zu bytes", config->jobs, config->slots,
                       s->slot_capacity);
        release(s);
        return false;
    }
    pthread_mutex_init(&s->mutex, NULL);
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(&s->work, &attributes);
    pthread_cond_init(&s->change, &attributes);
    pthread_condattr_destroy(&attributes);
    if (pthread_create(&s->thread, NULL, run, s) != 0) {
        (void)snprintf(error, n, "cannot start the store thread");
        release(s);
        return false;
    }
    *store = s;
    return true;
}

void pf_store_quit(pf_store *s)
{
    pthread_mutex_lock(&s->mutex);
    s->is_quitting = s->is_hurried = s->is_flushing = true;
    s->is_blocked = false;
    pthread_cond_broadcast(&s->work);
    pthread_cond_broadcast(&s->change);
    pthread_mutex_unlock(&s->mutex);
    (void)pthread_join(s->thread, NULL);
}

void pf_store_close(pf_store *s)
{
    pthread_cond_destroy(&s->work);
    pthread_cond_destroy(&s->change);
    pthread_mutex_destroy(&s->mutex);
    release(s);
}

/* ---- the producer's side */

size_t pf_store_capacity(const pf_store *s)
{
    return s->config.capacity;
}

pf_job *pf_store_take(pf_store *s)
{
    pf_job *job = NULL;
    pthread_mutex_lock(&s->mutex);
    pf_pulse_rest(); /* for as long as no host makes room */
    while (s->free_count == 0 && s->config.is_patient && !s->is_hurried)
        pthread_cond_wait(&s->change, &s->mutex);
    pf_pulse_work();
    if (s->config.is_patient) {
        /* In a hurry: the last keyframes may wait for a batch that is being written, not for a disk that hangs. */
        const uint64_t due = pf_now() + HURRY_NS;
        const struct timespec until = {(time_t)(due / 1000000000u), (long)(due % 1000000000u)};
        while (s->free_count == 0 && !s->is_blocked && !s->is_failing &&
               pthread_cond_timedwait(&s->change, &s->mutex, &until) == 0) {
        }
    }
    if (s->free_count > 0) {
        job = s->free_job[--s->free_count];
        *job = (pf_job){.bytes = job->bytes};
    }
    pthread_mutex_unlock(&s->mutex);
    return job;
}

void pf_store_give(pf_store *s, pf_job *job)
{
    bool is_late;
    pthread_mutex_lock(&s->mutex);
    is_late = s->is_quitting;
    if (is_late) {
        lose_job(s, job);
        free_job(s, job);
    } else {
        s->queue[(s->queue_first + s->queue_count++) % s->config.jobs] = job;
        s->has_more =
            true; /* and not before the first: the end of an interrupted survey may have to name what is lost */
        pthread_cond_signal(&s->work);
    }
    pthread_mutex_unlock(&s->mutex);
    if (is_late)
        pf_log(PF_LOG_ERROR, "the store has quit: %s is lost", what(job));
}

void pf_store_give_back(pf_store *s, pf_job *job)
{
    pthread_mutex_lock(&s->mutex);
    free_job(s, job);
    pthread_mutex_unlock(&s->mutex);
}

void pf_store_lose(pf_store *s, uint32_t index)
{
    pthread_mutex_lock(&s->mutex);
    lose(s, index);
    pthread_mutex_unlock(&s->mutex);
}

void pf_store_hurry(pf_store *s)
{
    pthread_mutex_lock(&s->mutex);
    s->is_hurried = true;
    pthread_cond_broadcast(&s->change);
    pthread_mutex_unlock(&s->mutex);
}

void pf_store_flush(pf_store *s)
{
    pthread_mutex_lock(&s->mutex);
    s->is_hurried = s->is_flushing = true;
    s->is_blocked = false;
    pthread_cond_broadcast(&s->work);
    pthread_cond_broadcast(&s->change);
    pthread_mutex_unlock(&s->mutex);
}

void pf_store_settle(pf_store *s)
{
    pthread_mutex_lock(&s->mutex);
    pf_pulse_rest();
    while (s->queue_count > 0)
        pthread_cond_wait(&s->change, &s->mutex);
    pf_pulse_work();
    pthread_mutex_unlock(&s->mutex);
}

/* ---- the courier's side */

pf_slot *pf_store_next_slot(pf_store *s)
{
    pf_slot *next = NULL;
    pthread_mutex_lock(&s->mutex);
    for (uint32_t i = 0; i < s->config.slots; i++)
        if (s->slots[i].state == SLOT_READY && (next == NULL || s->slots[i].item.row < next->item.row))
            next = &s->slots[i];
    if (next != NULL)
        next->state = SLOT_SENDING;
    pthread_mutex_unlock(&s->mutex);
    return next;
}

void pf_store_release_slot(pf_store *s, const uint8_t name[32], bool is_refused)
{
    pthread_mutex_lock(&s->mutex);
    for (uint32_t i = 0; i < s->config.slots; i++) {
        if (s->slots[i].state == SLOT_SENDING && memcmp(s->slots[i].item.name, name, 32) == 0) {
            s->slots[i].state = SLOT_DONE;
            s->stats.refused += is_refused;
        }
    }
    pthread_cond_signal(&s->work);
    pthread_mutex_unlock(&s->mutex);
}

bool pf_store_is_drained(pf_store *s)
{
    bool is_drained;
    pthread_mutex_lock(&s->mutex);
    is_drained = s->queue_count == 0 && s->stats.spool.objects == 0;
    pthread_mutex_unlock(&s->mutex);
    return is_drained;
}

void pf_store_get_stats(pf_store *s, pf_store_stats *stats)
{
    pthread_mutex_lock(&s->mutex);
    *stats = s->stats;
    pthread_mutex_unlock(&s->mutex);
}

void pf_store_get_survey(pf_store *s, pf_survey *survey)
{
    pthread_mutex_lock(&s->mutex);
    *survey = s->survey;
    pthread_mutex_unlock(&s->mutex);
}
