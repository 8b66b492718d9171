#include "damage.h"

#include <string.h>

#include "pipefish/drivers/sha256.h"
#include "pipefish/link.h"
#include "pipefish/messages.h"

/* The end of the keyframe's survey, read into bytes. PF_ERR_END: it is not in the spool. */
static pf_status find_end(const pf_damage *damage, const pf_spool *spool, pf_spool_item *end, uint8_t *bytes,
                          size_t capacity, size_t *n)
{
    pf_status status;
    while ((status = spool->ops->next(spool->self, end->row, end)) == PF_OK) {
        uint8_t id[16];
        if (end->kind != PF_OBJECT_SURVEY_END)
            continue;
        status = spool->ops->read(spool->self, end, bytes, capacity, n);
        if (status == PF_ERR_IO)
            return status;
        if (status == PF_OK && pf_msg_peek_survey_end(bytes, *n, id) == PF_OK &&
            memcmp(id, damage->survey_id, sizeof id) == 0)
            return PF_OK;
    }
    return status;
}

pf_status pf_damage_settle(pf_damage *damage, const pf_spool *spool, const pf_spool_item *keyframe, uint8_t *bytes,
                           size_t capacity, size_t n)
{
    pf_spool_item end = {.row = keyframe->row};
    pf_spool_victim victims[2];
    uint8_t name[32];
    *damage = (pf_damage){.is_known = false};
    damage->is_known = pf_msg_peek_keyframe(bytes, n, damage->survey_id, &damage->index) == PF_OK;
    pf_status status = damage->is_known ? find_end(damage, spool, &end, bytes, capacity, &n) : PF_ERR_END;
    if (status == PF_ERR_END)
        return PF_OK;
    if (status == PF_OK)
        status = pf_msg_append_lost(damage->index, bytes, capacity, &n);
    if (status == PF_OK)
        status = pf_sha256(bytes, n, name);
    if (status != PF_OK)
        return status;
    victims[0] = (pf_spool_victim){.row = keyframe->row, .size = keyframe->size};
    victims[1] = (pf_spool_victim){.row = end.row, .size = end.size};
    status = spool->ops->exchange(spool->self, victims, 2, PF_OBJECT_SURVEY_END, name, bytes, n, NULL, NULL, NULL, 0);
    damage->is_named = status == PF_OK;
    return status;
}
