/* The frame index: one row a frame that the daemon took, in the form of a recording's telemetry (docs/recording.md), so
 * that the same frames played again give the same tracks: gaps, repeated frames and all.
 */
#ifndef PIPEFISHD_INDEX_H
#define PIPEFISHD_INDEX_H

#include "tracking.h"

typedef struct pf_index pf_index;

/* Begins the file FOLDER/<first 8 digits of the survey's id>-<boot, 3 digits>.csv. On a medium that takes none now that
 * is told in the log, and *index is NULL. False: error[n] names it. */
bool pf_index_open(pf_index **index, const char *folder, const uint8_t survey_id[16], uint32_t boot, char *error,
                   size_t n);

/* Adds a row in one write; its frame must have a hash. A medium that fails is told in the log, and takes no more: what
 * is there are all frames up to one. */
void pf_index_add(pf_index *index, const pf_shot *shot);

void pf_index_close(pf_index *index); /* NULL is allowed */

#endif
