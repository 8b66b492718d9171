#include "store_inside.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "config.h"
#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/messages.h"
#include "pulse.h"

#define HURRY_NS 2000000000u

/* ---- counting */

static void lose(pf_store *s, uint32_t index)
{
    s->stats.keyframes_dropped++;
    pf_survey_lose(&s->survey, index);
}

void pf_store_lose_job(pf_store *s, const pf_job *job)
{
    if (job->kind == PF_OBJECT_KEYFRAME)
        lose(s, job->index);
    else
        s->stats.has_failed = true;
}

const char *pf_job_what(const pf_job *job)
{
    return job->kind == PF_OBJECT_KEYFRAME ? "a keyframe" : "the survey's start or end";
}

void pf_store_note_trouble(pf_store *s, pf_trouble which, const char *why)
{
    s->troubles = why != NULL ? s->troubles | which : s->troubles & ~(unsigned)which;
    if (why != NULL || s->troubles == 0)
        (void)snprintf(s->stats.trouble, sizeof s->stats.trouble, "%s", why != NULL ? why : "");
}

void pf_store_free_job(pf_store *s, pf_job *job)
{
    s->free_job[s->free_count++] = job;
    pthread_cond_broadcast(&s->change);
}

/* ---- the thread */

static void refresh_spool_stats(pf_store *s)
{
    pf_spool_stats stats;
    pthread_mutex_unlock(&s->mutex);
    s->spool.ops->stats(s->spool.self, &stats);
    if (stats.healed != s->told_healed)
        pf_log(PF_LOG_ERROR, "%s", s->spool.ops->healing(s->spool.self));
    s->told_healed = stats.healed;
    pthread_mutex_lock(&s->mutex);
    stats.evicted -= s->not_evicted;
    s->stats.spool = stats;
    pthread_cond_broadcast(&s->change);
}

/* One round: at most one job, and every slot once, so that neither starves the other. */
static bool do_round(pf_store *s)
{
    bool is_busy = false;
    if (s->queue_count > 0 && !s->is_blocked) {
        pf_storing_do(s);
        is_busy = true;
    }
    pf_slots_try_left(s);
    for (uint32_t i = 0; i < s->config.slots; i++) {
        if (s->slots[i].state == SLOT_DONE) {
            pf_slots_empty(s, &s->slots[i]);
            is_busy = true;
        }
        if (s->slots[i].state == SLOT_EMPTY && s->has_more && !s->is_failing && !s->is_rewinding && !s->is_quitting) {
            pf_slots_fill(s, &s->slots[i]);
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
        pf_store_lose_job(s, job);
        pf_store_free_job(s, job);
    } else {
        s->queue[(s->queue_first + s->queue_count++) % s->config.jobs] = job;
        s->has_more =
            true; /* and not before the first: the end of an interrupted survey may have to name what is lost */
        pthread_cond_signal(&s->work);
    }
    pthread_mutex_unlock(&s->mutex);
    if (is_late)
        pf_log(PF_LOG_ERROR, "the store has quit: %s is lost", pf_job_what(job));
}

void pf_store_give_back(pf_store *s, pf_job *job)
{
    pthread_mutex_lock(&s->mutex);
    pf_store_free_job(s, job);
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
