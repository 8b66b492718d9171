/* A stored keyframe whose bytes the medium has damaged: nobody can use it, but its survey can say that it is lost. */
#ifndef PIPEFISHD_DAMAGE_H
#define PIPEFISHD_DAMAGE_H

#include <stdbool.h>

#include "pipefish/drivers/spool.h"

typedef struct pf_damage {
    bool is_known; /* from its first bytes: the two below */
    uint8_t survey_id[16];
    uint32_t index;
    bool is_named; /* in the end of its survey, which waits in the spool; and the keyframe is removed */
} pf_damage;

/* bytes[capacity]: what read() gave, n of them; used for the survey's end then. One transaction takes the keyframe and
 * the old end away and stores the new one, behind all objects. PF_OK; PF_ERR_IO, PF_ERR_SPACE: all is as it was. */
pf_status pf_damage_settle(pf_damage *damage, const pf_spool *spool, const pf_spool_item *keyframe, uint8_t *bytes,
                           size_t capacity, size_t n);

#endif
