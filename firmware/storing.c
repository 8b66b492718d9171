#include "store_inside.h"

#include <string.h>

#include "config.h"
#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"
#include "pipefish/messages.h"

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

static void pop_job(pf_store *s)
{
    pf_job *job = s->queue[s->queue_first];
    s->queue_first = (s->queue_first + 1) % s->config.jobs;
    s->queue_count--;
    pf_store_free_job(s, job);
}

void pf_storing_do(pf_store *s)
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
        pf_log(PF_LOG_ERROR, "%s: %s is lost", s->spool.ops->error(s->spool.self), pf_job_what(job));
    s->was_blocked = is_waiting;
    s->was_evicting = is_evicting;
    if (is_keyframe(job) && status == PF_OK)
        s->lost_break[0] = '\0';
    else if (is_keyframe(job) && !is_waiting)
        memcpy(s->lost_break, break_reason, sizeof s->lost_break);
    const char *why = status != PF_OK ? s->spool.ops->error(s->spool.self) : NULL;
    pthread_mutex_lock(&s->mutex);
    pf_store_note_trouble(s, TROUBLE_STORING, why);
    if (is_waiting) {
        s->is_blocked = !s->is_flushing;
        s->retry_ns = pf_now() + RETRY_NS;
        return;
    }
    if (status == PF_OK) {
        s->has_more = true;
        /* At once: who sees the empty queue must not see the old numbers beside it. */
        s->stats.spool.objects += 1 - (uint64_t)made.count;
        s->stats.spool.evicted += made.count;
        if (is_keyframe(job)) {
            for (uint32_t i = 0; i < made.count; i++)
                pf_survey_lose(&s->survey, made.victims[i].number);
            s->survey.next_index = job->index + 1;
            s->stats.store_ns += pf_now() - start;
            s->stats.stored++;
        }
    } else {
        pf_store_lose_job(s, job);
    }
    pop_job(s);
}
