/* A spool's file that has become unreadable: it is set aside, and what can be read of it goes into a new one. */
#ifndef PIPEFISH_SPOOL_SALVAGE_H
#define PIPEFISH_SPOOL_SALVAGE_H

#include "common/failure.h"

#include <sqlite3.h>

#define PF_SALVAGE_PATH_MAX 1024u

/* Whether a file that SQLite does not take was a spool: its header or its schema says so. Another program's file is
 * left alone. */
bool pf_spool_was_one(const char *path, uint32_t application_id);

/* Gives the file, and the log beside it, the name <path>.damaged-1 or the next that is free: aside[]. PF_OK, PF_ERR_IO.
 */
pf_status pf_spool_set_aside(const char *path, char aside[PF_SALVAGE_PATH_MAX], pf_failure *failure);

/* Copies every object that is whole by its SHA-256, under its row number, and every value, in one transaction. Returns
 * how many objects; those that cannot be reached from either end of the damaged table are lost. */
uint64_t pf_spool_salvage(sqlite3 *to, const char *aside);

#endif
