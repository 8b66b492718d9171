/* Which survey this is, and how far it has come. Kept in the spool's value "survey" until the survey's end is stored,
 * so that a restart goes on with the same survey under a new boot id.
 */
#ifndef PIPEFISHD_SURVEY_H
#define PIPEFISHD_SURVEY_H

#include <stdbool.h>

#include "pipefish/drivers/spool.h"

#define PF_SURVEY_KEY      "survey"
#define PF_SURVEY_LOST_MAX 1024u /* ranges of lost keyframes that are remembered */
#define PF_SURVEY_BYTES    (1u + 16u + 32u + 3u * 4u + 8u * PF_SURVEY_LOST_MAX)

typedef struct pf_survey {
    uint8_t id[16];
    uint8_t setup[32];    /* SHA-256 of what must not change within a survey */
    uint32_t boots;       /* starts of the daemon so far, this one included */
    uint32_t next_index;  /* of the next keyframe */
    uint32_t lost_ranges; /* ascending, with a keyframe between any two */
    uint32_t lost_first[PF_SURVEY_LOST_MAX], lost_count[PF_SURVEY_LOST_MAX];
    bool is_resumed; /* not the survey's first boot */
} pf_survey;

/* Goes on with the survey that the spool remembers if it has the same setup, or begins one with a random id. *before
 * gets the survey of another setup that was interrupted, and must be ended; boots = 0: there is none. What the spool
 * remembers may not be a survey: that is told in the log, and one begins. False: error[n] says what failed. */
bool pf_survey_open(pf_survey *survey, pf_survey *before, const pf_spool *spool, const uint8_t setup[32], char *error,
                    size_t n);

/* The survey as the spool keeps it; returns its bytes, PF_SURVEY_BYTES at most. Lost keyframes from next_index on are
 * left out: the next boot uses their numbers again. */
size_t pf_survey_pack(const pf_survey *survey, uint8_t *out);

/* How much a keyframe would be missed by those that the spool has no room for: the number of times that its index can
 * be halved. While the spool is full the odd ones go first, then every second of the rest, and so on: the oldest first
 * of each kind. What is left is spread over the whole survey. A keyframe at which something happened (the first one,
 * after a break, a change of the scene's state) is no part of that: it is never given up. */
uint32_t pf_survey_importance(uint32_t index);

/* Remembers a keyframe that was made but cannot be delivered. Of more than PF_SURVEY_LOST_MAX ranges the closest two
 * become one, which then covers keyframes that are not lost: the host counts those that it has as received. */
void pf_survey_lose(pf_survey *survey, uint32_t index);

#endif
