#include "store_inside.h"

#include <string.h>
#include <unistd.h>

#include "config.h"
#include "damage.h"
#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/messages.h"

/* Says once, not every second, that the spool fails; without the mutex, after a call that says how. Returns why, or
 * NULL. */
static const char *note_failure(pf_store *s, pf_trouble which, bool is_failing)
{
    const char *why = is_failing ? s->spool.ops->error(s->spool.self) : NULL;
    if (is_failing && (s->told & which) == 0)
        pf_log(PF_LOG_ERROR, "%s: trying again", why);
    s->told = is_failing ? s->told | which : s->told & ~(unsigned)which;
    return why;
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

void pf_slots_fill(pf_store *s, pf_slot *slot)
{
    uint64_t after = s->cursor, one = 1;
    size_t n = 0;
    pf_status status;
    /* Before the look: what is stored meanwhile sets it again. */
    s->has_more = false;
    pthread_mutex_unlock(&s->mutex);
    status = s->spool.ops->next(s->spool.self, after, &slot->item);
    if (status == PF_OK) {
        status = s->spool.ops->read(s->spool.self, &slot->item, slot->bytes, s->slot_capacity, &n);
        if (status == PF_ERR_CHECKSUM)
            give_up_damaged(s, slot, n);
        else if (status == PF_ERR_SPACE)
            pf_log(PF_LOG_ERROR, "%s: it stays in the spool", s->spool.ops->error(s->spool.self));
        if (status != PF_ERR_IO)
            after = slot->item.row;
    }
    const char *why = note_failure(s, TROUBLE_READING, status == PF_ERR_IO);
    pthread_mutex_lock(&s->mutex);
    if (status == PF_OK || status == PF_ERR_IO)
        pf_store_note_trouble(s, TROUBLE_READING, why);
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
    const char *why = note_failure(s, TROUBLE_REMOVING, !is_removed);
    pthread_mutex_lock(&s->mutex);
    pf_store_note_trouble(s, TROUBLE_REMOVING, why);
    if (is_removed)
        s->is_blocked = false;
    else
        s->retry_ns = pf_now() + RETRY_NS;
    return is_removed;
}

void pf_slots_empty(pf_store *s, pf_slot *slot)
{
    if (!remove_row(s, slot->item.row) && s->left_row == 0)
        s->left_row = slot->item.row;
    slot->state = SLOT_EMPTY;
}

void pf_slots_try_left(pf_store *s)
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
